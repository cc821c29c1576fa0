"""Raw nuScenes: reader."""

from __future__ import annotations

from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes

__all__ = ["NuScenesLog", "find_nuscenes_scenes"]
