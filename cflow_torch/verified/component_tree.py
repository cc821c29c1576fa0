"""The component tree: components of the finest pixels at several pixel sizes, and which of them are objects.

A component at one pixel size holds parts at the next finer one. It may be one object whose parts are too small to be
followed, or several objects that move apart. Each has evidence: what its own best motion explains beyond noise. If the
whole has more than its parts together, they take its motion; if not, each keeps its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.dense.clustering import Clusters, cluster_images
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import bounding_boxes, segment_amin
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.long_vehicles import ends_travel


@dataclass(frozen=True)
class Level:
    """Components at one pixel size, all windows.

    Args:
        block: k, finest pixels a side of a pixel of this level.
        is_undilated: whether pixels must touch to belong together.
        images: (B, S, height, width) uint8, slices of each pixel.
        clusters: M components; their boxes and pixels are in pixels of this level.
        component: (P,) int64, component of each occupied finest pixel, M = none.
        too_long: (M,) bool, longer at t+1 than other objects, and not seen to travel: it does not move.
        travels: (M,) bool, as long, but both ends are seen to travel, see `ends_travel`.
    """

    block: int
    is_undilated: bool
    images: Tensor
    clusters: Clusters
    component: Tensor
    too_long: Tensor
    travels: Tensor

    @property
    def num_components(self) -> int:
        """M."""
        return self.clusters.window.numel()

    def parents(self, above: Level) -> Tensor:
        """The component of a coarser level that holds each component.

        Components are nested but where an oversized one was eroded and fell apart: then one pixel decides.

        Args:
            above: N components.

        Returns:
            (M,) int64, component of the first pixel (in the order of the list) that has one above; N = none has.
        """
        held = flat_nonzero(above.component < above.num_components)
        own = self.component.index_select(0, held)
        first = segment_amin(held, own, self.num_components + 1, self.component.numel())[: self.num_components]
        return F.pad(above.component, (0, 1), value=above.num_components).index_select(0, first)

    def equals_parent(self, above: Level, parent: Tensor) -> Tensor:
        """(M,) bool: which components have the same pixels as their parent, so that its estimates are theirs.

        Args:
            above: N components.
            parent: (M,) int64, as `parents` gives it.
        """
        count, count_above = self.num_components, above.num_components
        size = torch.bincount(self.component, minlength=count + 1)[:count]
        size_above = torch.bincount(above.component, minlength=count_above + 1)
        own_parent = F.pad(parent, (0, 1), value=count_above).index_select(0, self.component)
        shared = flat_nonzero((own_parent == above.component) & (above.component < count_above))
        common = torch.bincount(self.component.index_select(0, shared), minlength=count + 1)[:count]
        return (common == size) & (common == size_above.index_select(0, parent)) & (parent < count_above)


def find_components(sweeps: HeightSlicedSweeps, block: int, is_undilated: bool, config: VerifiedConfig) -> Level:
    """Components at one pixel size.

    Args:
        sweeps: P occupied pixels.
        block: k, finest pixels a side of a pixel of this level.
        is_undilated: False = Alg. clustering (dilated, eroded again if oversized); True = plain components, for the
            parts of those.
        config: `connectivity`, `max_extent`, `labeling`, `max_object`.

    Returns:
        The level. No point is projected again. Lengths at t+1 are the longer side of the box of the finest pixels.

    Cost: as `cluster_images`, and some passes over the images of this level and the finest pixels.
    """
    images, column = sweeps.coarsen(block)
    pixel_size = sweeps.grid.pixel_size
    clusters, columns = cluster_images(images, pixel_size * block, config, 1 if is_undilated else 3)
    count, area = clusters.window.numel(), images[0, 0].numel()
    of_column = torch.empty(sweeps.num_windows * area, dtype=torch.int64, device=column.device)
    of_column.scatter_(0, torch.add(columns.pixel, columns.window, alpha=area), columns.cluster)
    component = of_column.index_select(0, column)  # empty columns are never asked for
    newest = flat_nonzero((sweeps.step == 0) & (component < count))
    row, col, own = (values.index_select(0, newest) for values in (sweeps.row, sweeps.col, component))
    _, size = bounding_boxes(row, col, own, count)  # every component has pixels at t+1
    longest = math.inf if config.max_object is None else config.max_object
    is_long = torch.maximum(size[:, 0], size[:, 1]).double() * pixel_size > longest
    travels = ends_travel(sweeps, component, is_long)
    return Level(block, is_undilated, images, clusters, component, is_long & ~travels, travels)


@dataclass(frozen=True)
class Objects:
    """The components that won: what moves together. Numbered by window, then by their first pixel in the list.

    Args:
        of_pixel: (P,) int64, object of each occupied finest pixel, G = none.
        component: (G,) int64, which component it is, counted through all levels, coarse to fine: M_0 of the coarsest
            level, then M_1 of the next, ...
        first: (G,) int64, position of its first pixel in the list.
    """

    of_pixel: Tensor
    component: Tensor
    first: Tensor

    @property
    def count(self) -> int:
        """G."""
        return self.component.numel()

    def split(self, part: Tensor, wanted: Tensor, num_components: int) -> Objects:
        """Parts of them taken out as objects of their own.

        Args:
            part: (P,) int64, part of each pixel, H = none.
            wanted: (H,) bool, the parts that are taken out.
            num_components: of all levels; the parts are numbered after them.
        """
        none = num_components + wanted.numel()
        whole = F.pad(self.component, (0, 1), value=none).index_select(0, self.of_pixel)
        is_out = F.pad(wanted, (0, 1)).index_select(0, part)
        return number_objects(torch.where(is_out, num_components + part, whole), none)

    def pixels_of(self, wanted: Tensor) -> Tensor:
        """(P,) int64, `of_pixel` for the objects that are wanted, (G,) bool; G for all other pixels."""
        return torch.where(F.pad(wanted, (0, 1)).index_select(0, self.of_pixel), self.of_pixel, self.count)


def select_objects(levels: Sequence[Level], evidence: Sequence[Tensor]) -> Objects:
    """Bottom up: a component wins where it has more evidence than its parts together.

    Args:
        levels: coarse to fine.
        evidence: of each level (M,) int64, at least 0; sums must stay below 2^63.

    Returns:
        The winners. A pixel belongs to the coarsest of its components that won; if none did, to its finest one. Pixels
        of no finest component (not linked between sweeps) go with a coarser one that wins.

    Convention:
        The whole must have more; at a draw the parts keep their own motion. Evidence of a part that is no longer held
        by anything (see `Level.parents`) is lost to what lies above.

    Cost: a few passes over the pixels per level; the only Python loop is over levels.
    """
    first_of_level = [0]
    for level in levels:
        first_of_level.append(first_of_level[-1] + level.num_components)
    num_components = first_of_level[-1]

    part, value = levels[-1], evidence[-1]
    of_pixel = torch.where(part.component < value.numel(), part.component + first_of_level[-2], num_components)
    for whole, own, offset in reversed(list(zip(levels[:-1], evidence[:-1], first_of_level))):
        total = torch.zeros(own.numel() + 1, dtype=torch.int64, device=own.device)
        total = total.index_add_(0, part.parents(whole), value)[:-1]
        wins = F.pad(own > total, (0, 1))
        of_pixel = torch.where(wins.index_select(0, whole.component), whole.component + offset, of_pixel)
        part, value = whole, torch.maximum(own, total)

    return number_objects(of_pixel, num_components)


def number_objects(of_pixel: Tensor, num_components: int) -> Objects:
    """Objects by the component, (P,) int64, that each pixel belongs to; `num_components` = none."""
    position = torch.arange(of_pixel.numel(), device=of_pixel.device)
    first = segment_amin(position, of_pixel, num_components + 1, of_pixel.numel())[:num_components]
    first, component = first.sort()
    count = int((first < of_pixel.numel()).sum())
    first, component = first[:count], component[:count]
    number = torch.full((num_components + 1,), count, dtype=torch.int64, device=first.device)
    number.scatter_(0, component, torch.arange(count, device=first.device))
    return Objects(number.index_select(0, of_pixel), component, first)
