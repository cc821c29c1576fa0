"""Where a mask is set."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def flat_nonzero(mask: Tensor) -> Tensor:
    """Flat indices of the set elements, ascending: `mask.flatten().nonzero()[:, 0]`.

    Args:
        mask: (...) bool.

    Returns:
        (K,) int64.

    Cost: one pass and, on a GPU, one synchronisation. On the CPU NumPy finds them about five times faster than torch
    does in a sparse mask of half a million pixels.
    """
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero()[:, 0]
