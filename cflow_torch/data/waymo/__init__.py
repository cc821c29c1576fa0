"""Waymo Open: reader and writer of version 2, reader of version 1."""

from __future__ import annotations

from cflow_torch.data.waymo.reader import WaymoLog, find_waymo_segments
from cflow_torch.data.waymo.writer import write_waymo_segment

__all__ = ["WaymoLog", "find_waymo_segments", "write_waymo_segment"]
