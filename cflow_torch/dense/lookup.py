"""Numerators of the normalised cross-correlation at a few given shifts, by looking pixels up: no transform."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from cflow_torch.dense.packing import Images
from cflow_torch.ops.bits import popcount
from cflow_torch.ops.exact import exact_sqrt


class Coincidences(Protocol):
    """What J templates share with their targets at given shifts."""

    def at(self, shift: Tensor) -> Tensor:
        """(P,) bool or uint8, of each template pixel. Args: shift: (J, 2) int64, (dy, dx)."""
        ...

    def count(self, matches: Tensor) -> Tensor:
        """(J,) int64, what each template has among some, given as by `at`."""
        ...


class Lookup:
    """J templates and their N targets.

    Args:
        template, target, target_of_job, size: as for `best_shifts`.

    Cost: one pass over the area of the targets; each shift that is looked up costs one access a template pixel.
    """

    def __init__(self, template: Images, target: Images, target_of_job: Tensor, size: Tensor) -> None:
        self._job = template.image
        self._num_jobs = target_of_job.numel()
        self._energies = template.energy(self._num_jobs) * target.energy(len(size)).index_select(0, target_of_job)
        area = size[:, 0] * size[:, 1]
        start = area.cumsum(0) - area
        # The last sample is what lies outside of a target.
        drawn = torch.ones_like(target.row, dtype=torch.bool) if target.slices is None else target.slices
        self._table = torch.zeros(int(area.sum()) + 1, dtype=drawn.dtype, device=size.device)
        width = size[:, 1].index_select(0, target.image)
        self._table[start.index_select(0, target.image) + target.row * width + target.col] = drawn
        own = target_of_job.index_select(0, self._job)
        self._row, self._col, self._slices = template.row, template.col, template.slices
        self._height, self._width = size.index_select(0, own).t().contiguous()
        self._start = start.index_select(0, own)

    def at(self, shift: Tensor) -> Tensor:
        """(P,) bool: which template pixels fall on a pixel of their target; with slices (P,) uint8: in which of them.

        Args:
            shift: (J, 2) int64, (dy, dx) of each template; any, also beyond what `best_shifts` searches.
        """
        dy, dx = shift.index_select(0, self._job).unbind(1)
        row, col = self._row + dy, self._col + dx
        inside = (row >= 0) & (row < self._height) & (col >= 0) & (col < self._width)
        place = self._start + row * self._width + col
        found = self._table.index_select(0, torch.where(inside, place, self._table.numel() - 1))
        return found if self._slices is None else found & self._slices

    def count(self, matches: Tensor) -> Tensor:
        """(J,) int64, number of each template's pixels (in every slice) among some, given as by `at`."""
        number = matches.long() if self._slices is None else popcount(matches)
        return torch.zeros(self._num_jobs, dtype=torch.int64, device=matches.device).index_add_(0, self._job, number)

    def score_of_no_shift(self) -> Tensor:
        """(J,) float32, NCC at shift 0: c / sqrt(E_m E_1), where the window holds all of the target."""
        count = self.count(self.at(torch.zeros((self._num_jobs, 2), dtype=torch.int64, device=self._job.device)))
        return (count.double() / exact_sqrt(self._energies.double())).float()
