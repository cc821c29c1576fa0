"""Raw MAN TruckScenes: reader and writer."""

from __future__ import annotations

from cflow_torch.data.truckscenes.reader import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.data.truckscenes.writer import write_truckscenes

__all__ = ["TruckScenesLog", "find_truckscenes_scenes", "write_truckscenes"]
