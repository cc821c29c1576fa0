"""Raw MAN TruckScenes: reader."""

from __future__ import annotations

from cflow_torch.data.truckscenes.reader import TruckScenesLog, find_truckscenes_scenes

__all__ = ["TruckScenesLog", "find_truckscenes_scenes"]
