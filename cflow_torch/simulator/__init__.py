"""Simulated drives for the demo, tests and benchmarks: scenes, ray-casting LiDARs, exact flow, and writers."""

from __future__ import annotations

from cflow_torch.simulator.drive import Drive, make_drive

__all__ = ["Drive", "make_drive"]
