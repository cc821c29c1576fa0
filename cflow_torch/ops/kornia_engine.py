"""Morphology and labelling by kornia on dense images (`labeling=kornia`), with the results of the sparse engine."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.types import CFlowError


def close_3x3_kornia(image: Tensor) -> Tensor:
    """Dilate, then erode (B, H, W) bool images with a 3 x 3 square of ones. No pixel is lost at the border."""
    from kornia.morphology import closing

    return closing(image[:, None].float(), torch.ones(3, 3, device=image.device))[:, 0] > 0.5


def connected_components_kornia(occupancy: Tensor, pixels: Tensor, connectivity: int = 8, reach: int = 1) -> Tensor:
    """Label the set pixels by kornia's union-find. Arguments and result are those of `connected_components`.

    Raises:
        CFlowError: kornia is older than 0.9 and has no exact labelling (the iterative one splits long components).

    Convention:
        kornia labels with 8-connectivity. For connectivity 4 we label an image of twice the size, in which we set the
        pixel between two set pixels that share a side. In that image, both connectivities give the same components.

    Cost: linear in B * H * W.
    """
    from kornia.morphology import dilation

    try:
        from kornia.contrib import connected_components_union_find
    except ImportError:
        from kornia import __version__ as version

        raise CFlowError(
            f"labeling='kornia' needs kornia >= 0.9 (exact union-find labelling), found {version}: "
            "upgrade kornia or use labeling='sparse', which gives the same result"
        ) from None
    image = occupancy
    if reach == 3:
        image = dilation(image[:, None].float(), torch.ones(3, 3, device=image.device))[:, 0] > 0.5
    if connectivity == 8:
        labels = connected_components_union_find(image[:, None])
    else:
        num_images, height, width = image.shape
        linked = image.new_zeros((num_images, 2 * height, 2 * width))
        linked[:, ::2, ::2] = image
        linked[:, 1:-1:2, ::2] = image[:, 1:] & image[:, :-1]
        linked[:, ::2, 1:-1:2] = image[:, :, 1:] & image[:, :, :-1]
        labels = connected_components_union_find(linked[:, None])[..., ::2, ::2]
    components = Groups(labels.flatten()[pixels], 4 * image.numel() + 1)
    return components.spread(components.first())
