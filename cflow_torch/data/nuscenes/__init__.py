"""Raw nuScenes: reader and writer."""

from __future__ import annotations

from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes
from cflow_torch.data.nuscenes.writer import write_nuscenes

__all__ = ["NuScenesLog", "find_nuscenes_scenes", "write_nuscenes"]
