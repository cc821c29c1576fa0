"""Linear algebra on many small matrices at once. Their axes come first, (3, 3, K), so operations are elementwise."""

from __future__ import annotations

import torch
from torch import Tensor


def adjugate(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Adjugate and determinant of symmetric 3 x 3 matrices. The inverse is the adjugate over the determinant.

    Args:
        matrix: (3, 3, K) float64.

    Returns:
        (3, 3, K) and (K,) float64.

    Convention: whole numbers give whole numbers, exact below 2^53. Each result depends on its own matrix only.
    """
    # A row of the adjugate is the cross product of the two other rows.
    twice = torch.cat((matrix, matrix))
    rows = torch.linalg.cross(twice[1:4], twice[2:5], dim=1)
    return rows, (matrix[0] * rows[0]).sum(0)
