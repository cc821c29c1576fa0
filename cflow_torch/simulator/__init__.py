"""A synthetic drive: a street scene, a ray-casting LiDAR, and exact flow."""

from __future__ import annotations

from cflow_torch.simulator.drive import Drive, make_drive

__all__ = ["Drive", "make_drive"]
