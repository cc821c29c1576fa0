"""Ground: find it without a map, and its height and slope around objects."""

from cflow_torch.ground.segmentation import find_ground, has_ground

__all__ = ["find_ground", "has_ground"]
