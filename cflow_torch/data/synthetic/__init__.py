"""A synthetic drive: a street scene, a ray-casting LiDAR, and exact flow."""

from __future__ import annotations

from cflow_torch.data.synthetic.drive import Drive, make_drive

__all__ = ["Drive", "make_drive"]
