"""Raw nuScenes: reader."""

from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes

__all__ = ["NuScenesLog", "find_nuscenes_scenes"]
