"""Waymo Open, version 2: reader."""

from cflow_torch.data.waymo.reader import WaymoLog, find_waymo_segments

__all__ = ["WaymoLog", "find_waymo_segments"]
