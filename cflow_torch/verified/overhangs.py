"""Objects under overhangs: a car under the crown of a tree shares its bird's-eye component with the crown.

The car and the crown are separate in space, so we divide the points of components that may move into connected 3-D
components. A 3-D component that is under another one and above none becomes a node. We draw copies of its points alone,
in a further window of the same batch.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from cflow_torch.ops.indices import (
    constant,
    flat_nonzero,
    floor_divide,
    lazy_empty,
    lazy_zeros,
    lookup,
    members_of,
    split_index,
    take_columns,
)
from cflow_torch.ops.labeling import union_find
from cflow_torch.ops.segments import segment_amin, segment_minmax
from cflow_torch.verified.component_tree import Components, Nodes
from cflow_torch.verified.height_slices import SLICE_HEIGHT, HeightSlicedSweeps

_CELL = 0.4  # metres, side of a cell; it is as high as a slice
_NUM_SLICES = 32  # of a window, from its lowest point up. The ends stay empty; the last but one takes all higher points
_GAP = 3  # slices from a cell to the next one above it, at least; the body and the roof of a car are closer
_LARGEST = 10  # slices from the lowest to the highest cell of an object, at most; this suffices for a bus


def add_overhung(sweeps: HeightSlicedSweeps, components: Components, nodes: Nodes) -> tuple[HeightSlicedSweeps, Nodes]:
    """Add nodes for components under other components.

    Returns:
        The sweeps with copies of the points under other components, and the nodes, with the added ones at the end.

    Convention:
        We search the components of the finest dilated level that may move. Cells of 0.4 m x 0.4 m x 0.5 m are connected
        to their 26 neighbours. A component is under another one if, in any column, the next occupied cell above one of
        its cells belongs to the other one, with at least two empty cells between. We add it if it is above no other
        component and at most eleven cells high. If two added components share a pixel of a sweep, the pixel belongs to
        the one whose first cell has the lower index.

    Cost: linear in the points that may move; 13 lookups for each cell, a few rounds of union-find.
    """
    level, num_own, num_points = components.num_levels - 2, sweeps.num_pixels, sweeps.batch.image.numel()
    may_move = components.may_move.index_select(0, components.roots[level])
    rows = flat_nonzero(lookup(may_move, sweeps.pixel_of_point))
    rows, component, num_names = _components_under(sweeps, rows)
    if len(rows) == 0:
        return sweeps, nodes
    sweeps = sweeps.with_copies(rows)
    num_copies = sweeps.num_pixels - num_own
    component = segment_amin(component, sweeps.pixel_of_point[num_points:] - num_own, num_copies, num_names)
    seen = torch.zeros(2 * num_names, dtype=torch.bool, device=rows.device)
    seen.index_fill_(0, component + num_names * (sweeps.pixels.step[num_own:] > 0), True)
    name = flat_nonzero(seen[:num_names] & seen[num_names:])  # at t+1 and before
    kept, node = members_of(name, component, num_names)
    pixel = kept + num_own
    window = torch.zeros_like(name).scatter_(0, node, sweeps.pixels.window.index_select(0, pixel))
    count = nodes.count + len(name)
    number = torch.arange(nodes.count, count, device=name.device)
    parent = nodes.parent.masked_fill(nodes.parent == nodes.count, count)
    return sweeps, Nodes(
        component=torch.cat((nodes.component, components.count + number)),
        level=torch.cat((nodes.level, torch.full_like(name, components.num_levels + 1))),
        parent=torch.cat((parent, torch.full_like(name, count))),
        window=torch.cat((nodes.window, window)),
        travels=torch.cat((nodes.travels, torch.zeros_like(name, dtype=torch.bool))),
        pixel=torch.cat((nodes.pixel, pixel)),
        node=torch.cat((nodes.node, node + nodes.count)),
    )


def _components_under(sweeps: HeightSlicedSweeps, rows: Tensor) -> tuple[Tensor, Tensor, int]:
    """Select the points, `rows`, that are in a 3-D component to be added. Return them, (K,) int64, the component of
    each, (K,) int64, named by its first cell, and the number of names."""
    batch, grid = sweeps.batch, sweeps.grid
    # An empty cell all around saves bounds checks of neighbours.
    num_rows, num_cols = (int((grid.upper[axis] - grid.lower[axis]) / _CELL) + 3 for axis in (1, 0))
    side = constant((_CELL,), torch.float64, rows.device)  # see `Grid.pixel`
    corner = constant(grid.lower[:2], torch.float64, rows.device)
    position = take_columns(batch.positions, rows)
    window = floor_divide(batch.image.index_select(0, rows).long(), batch.num_steps)
    col, row = (position[:2] - corner[:, None]).div_(side).long().add_(1)
    height = (position[2] / SLICE_HEIGHT).floor_().clamp_(-(2.0**40), 2.0**40).long()
    lowest = segment_amin(height, window, batch.num_windows, 1 << 41)
    height = height.sub_(lowest.index_select(0, window)).clamp_(max=_NUM_SLICES - 3).add_(1)
    column = torch.add(row, window, alpha=num_rows).mul_(num_cols).add_(col)
    index = torch.add(height, column, alpha=_NUM_SLICES)

    shape = batch.num_windows * num_rows * num_cols * _NUM_SLICES
    is_occupied = lazy_zeros(shape, torch.bool, rows.device).index_fill_(0, index, True)
    cells = flat_nonzero(is_occupied)
    count = cells.numel()
    number = lazy_empty(shape, torch.int32, rows.device)
    number.scatter_(0, cells, torch.arange(count, dtype=torch.int32, device=rows.device))
    # 13 of the 26 neighbours of a cell. The links to the others are found from their other end.
    half = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
    offsets = tuple((down * num_cols + right) * _NUM_SLICES + up for down, right, up in half)
    near = cells[:, None] + constant(offsets, torch.int64, rows.device)
    links = flat_nonzero(is_occupied.index_select(0, near.view(-1)))
    targets = number.index_select(0, near.view(-1).index_select(0, links)).long()
    component = union_find(count, floor_divide(links, near.shape[1]), targets)

    column, height = split_index(cells, _NUM_SLICES)
    is_same = (height[1:] - height[:-1] < _GAP) | (component[1:] == component[:-1]) | (column[1:] != column[:-1])
    is_under = torch.zeros(count + 1, dtype=torch.bool, device=rows.device)
    is_under.index_fill_(0, component[:-1].masked_fill(is_same, count), True)
    is_under.index_fill_(0, component[1:].masked_fill(is_same, count), False)  # it is above another one
    foot, top = segment_minmax(height, component, count)
    is_wanted = is_under[:-1] & (top - foot <= _LARGEST)
    is_wanted = is_occupied.index_copy_(0, cells, is_wanted.index_select(0, component))
    under = flat_nonzero(is_wanted.index_select(0, index))
    cell = number.index_select(0, index.index_select(0, under)).long()
    return rows.index_select(0, under), component.index_select(0, cell), count
