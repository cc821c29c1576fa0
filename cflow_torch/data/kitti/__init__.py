"""KITTI in its four layouts: raw drives, odometry, SemanticKITTI, tracking."""

from cflow_torch.data.kitti.drives import KITTIDrive, find_kitti_drives
from cflow_torch.data.kitti.reader import KITTILog

__all__ = ["KITTIDrive", "KITTILog", "find_kitti_drives"]
