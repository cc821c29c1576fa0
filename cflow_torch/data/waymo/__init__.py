"""Waymo Open Dataset, version 2: reader (experimental)."""

from cflow_torch.data.waymo.reader import WaymoLog, find_waymo_segments

__all__ = ["WaymoLog", "find_waymo_segments"]
