"""Columns: the height slices of all sweeps of a window, at each place that any of them occupies or is next to.

Most of a bird's-eye view is empty, so a dense image of every sweep is slow to make and to read. One dense image per
window tells which column is at a place, and small tables have a row for each column.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import (
    constant,
    draw,
    flat_nonzero,
    floor_divide,
    index_dtype,
    lazy_zeros,
    mark,
    nonzero_pairs,
)
from cflow_torch.verified.spacing import Spacing
from cflow_torch.windows.bev_grid import Grid, Lattice

NUM_SLICES = 4
OWN = (1 << NUM_SLICES) - 1  # the bits of the pixel itself
BORDER = 2  # empty rows and columns around an image; no step searches farther around a pixel
_COUNTS = tuple(bin(slices).count("1") for slices in range(OWN + 1))
_EMPTY = torch.iinfo(torch.int32).max  # where a table of pixels has none
_WORD = 8  # sweeps whose slices make up one int64
_OWN_OF_WORD = OWN * 0x0101010101010101  # the bits of the pixels themselves in a word
SLICE_HEIGHT = 0.5  # metres


@dataclass(frozen=True)
class Pixels:
    """K occupied pixels of sweeps. Step 0 is sweep t+1, 1 is t, 2 is t-1, ..."""

    # (K, 6) int32 or int64: slot of t+1 at the same place, counted through all columns; cell of row 0 and col 0 in
    # the image; window, step, row, col. We keep a row per pixel, because pixels are often selected at random, which
    # took a quarter of the time that a row per number took.
    place: Tensor
    slices: Tensor  # (K,) uint8, one bit for each height slice

    @cached_property
    def first_slot(self) -> Tensor:
        """(K,) int64, slot of sweep t+1 at the same place; that of sweep `step` is `step` slots on."""
        return self.place[:, 0].long()

    @cached_property
    def window(self) -> Tensor:
        """(K,) int64."""
        return self.place[:, 2].long()

    @cached_property
    def step(self) -> Tensor:
        """(K,) int64."""
        return self.place[:, 3].long()

    @cached_property
    def row_col(self) -> Tensor:
        """(2, K) int64."""
        return self.place[:, 4:].t().to(torch.int64, memory_format=torch.contiguous_format)

    def __getitem__(self, index: Tensor) -> Pixels:
        """Select pixels by their positions in the list, (L,) int64."""
        return Pixels(self.place.index_select(0, index), self.slices.index_select(0, index))

    def __len__(self) -> int:
        return len(self.slices)

    def followed_by(self, other: Pixels) -> Pixels:
        """Concatenate two lists of pixels."""
        return Pixels(torch.cat((self.place, other.place)), torch.cat((self.slices, other.slices)))


@dataclass(frozen=True)
class Columns:
    """The columns of B windows, and of B windows of copies.

    `lattice` numbers the cells of the images. Only this class knows how slots and entries of `rank` are numbered.

    The image of a window has an empty border of `BORDER` cells (b), so that only distant cells need a test:

        b b b b b b b b
        b b b b b b b b
        b b 0 1 2 3 b b      0 = no sweep occupies this cell or one of the 8 around it
        b b 0 4 5 6 b b      n = column n
        b b b b b b b b
        b b b b b b b b

    The tables have a row for each column, and a slot for each sweep: slot 0 for t+1, 1 for t, 2 for t-1, ... The number
    of slots is a multiple of 8, so a row is read as whole words.

    A byte of `slices` holds two sets of height slices:

        bit          7 6 5 4                         3 2 1 0
        slices of    the pixels within the reach     the pixel itself

    Near the sensor, the reach is 3 x 3 pixels (`Spacing`).
    """

    grid: Grid  # H rows and W columns, without the border
    image: Tensor  # (2 B * area,) int32, column of each cell; 0 = none
    cell: Tensor  # (C + 1,) int64, cell of each column; column 0 is the empty one
    slices: Tensor  # (C + 1, T) uint8
    rank: Tensor  # (S, C + 1) int32, position of each pixel in the list of pixels; `_EMPTY` = the pixel is empty
    reach: Tensor | None  # (C + 1,) uint8, pixels, see `Spacing`; None = 1 everywhere
    most_reach: int
    tall: Tensor | None  # (K,) int64, the tall columns, for `draw`; None = there are none, or all is drawn

    @classmethod
    def at(cls, is_occupied: Tensor, grid: Grid, num_steps: int, spacing: Spacing) -> Columns:
        """Make empty columns at and around the occupied cells, (B * area,) bool, which this overwrites.

        The border must be False.
        """
        lattice = grid.lattice(border=BORDER)
        device = is_occupied.device
        is_column = mark(is_occupied, (flat_nonzero(is_occupied) + lattice.square(1, device)).view(-1))
        cell = _inside(is_column, lattice)  # [C]
        for reach in range(2, spacing.most + 1):
            cell = _grow(is_column, cell, grid, spacing, reach)
        # The cell of column 0 is the last one of the second row. It is in the border, and so are all cells around it.
        cell = torch.cat((constant((2 * lattice.stride - 1,), torch.int64, device), cell))
        reach_of, tall = _reach_and_tall(grid, cell, spacing)
        num_slots = _WORD * -(-num_steps // _WORD)
        columns = cls(
            grid=grid,
            image=lazy_zeros(2 * len(is_column), torch.int32, device),
            cell=cell,
            slices=torch.zeros((len(cell), num_slots), dtype=torch.uint8, device=device),
            rank=torch.full((num_steps, len(cell)), _EMPTY, dtype=torch.int32, device=device),
            reach=reach_of,
            most_reach=spacing.most,
            tall=tall,
        )
        columns._number(1)
        return columns

    def _number(self, first: int) -> None:
        """Write the numbers of the columns into the image, beginning with that of column 1."""
        number = torch.arange(first, first + len(self.cell) - 1, dtype=torch.int32, device=self.image.device)
        self.image.index_copy_(0, self.cell[1:], number)

    def for_copies(self, column: Tensor) -> tuple[Columns, Tensor]:
        """Make empty columns for copies of pixels in some columns, (K,) int64, and around these, within their reach.

        They are at the same places in windows B ... 2 B - 1. `followed_by` appends them to these columns. The second
        result is the column of each copy, (K,) int64.
        """
        is_near = draw(column, len(self.cell))
        for reach in range(1, self.most_reach + 1):
            around = self.cell.index_select(0, flat_nonzero(is_near)) + self.lattice.square(1, column.device)
            beside = self.image.index_select(0, around.view(-1)).long()
            if self.reach is not None:  # other windows of the batch may have a larger one
                is_nearer = self.reach.index_select(0, beside) < reach
                beside = beside.masked_fill(is_nearer, 0)  # the empty column
            mark(is_near, beside)
        is_near[0] = True  # the empty column stays the first one
        near = flat_nonzero(is_near)
        half = len(self.image) // 2
        copies = replace(
            self,
            cell=self.cell.index_select(0, near) + half,
            slices=torch.zeros_like(self.slices[: len(near)]),
            rank=torch.full_like(self.rank[:, : len(near)], _EMPTY),
            reach=None if self.reach is None else self.reach.index_select(0, near),
            tall=None if self.tall is None else flat_nonzero(draw(self.tall, len(self.cell)).index_select(0, near)),
        )
        copies._number(1)
        return copies, self.image.index_select(0, self.cell.index_select(0, column) + half).long()

    def followed_by(self, copies: Columns) -> Columns:
        """Append the columns of copies, which are then numbered after these columns."""
        copies._number(len(self.cell))
        return replace(
            self,
            cell=torch.cat((self.cell, copies.cell[1:])),
            slices=torch.cat((self.slices, copies.slices[1:])),
            rank=torch.cat((self.rank, copies.rank[:, 1:]), 1),
            reach=None if self.reach is None or copies.reach is None else torch.cat((self.reach, copies.reach[1:])),
            tall=None,
        )

    @cached_property
    def lattice(self) -> Lattice:
        """Numbers the cells of the images."""
        return self.grid.lattice(border=BORDER)

    @property
    def num_slots(self) -> int:
        """T."""
        return self.slices.shape[1]

    def look_up(self, pixels: Pixels, step: Tensor | int, shift: Tensor | None = None) -> Tensor:
        """Return the bytes of the pixels that are `shift` away in another sweep of the same window.

        Args:
            pixels: K pixels.
            step: the other sweep, (K,) int64, or one for all.
            shift: (K, C, 2) integers, C shifts of each pixel, rows down and columns to the right; None = none.

        Returns:
            (K, C) uint8, or (K,) without shifts; 0 outside of the images.
        """
        if shift is None:
            return self.slices.view(-1).index_select(0, pixels.first_slot + step)
        slot = step[:, None] if isinstance(step, Tensor) else step
        index = self._column_at(pixels, shift) * self.num_slots + slot  # [K, C]
        return self.slices.view(-1).index_select(0, index.view(-1)).view_as(index)

    def _column_at(self, pixels: Pixels, shift: Tensor) -> Tensor:
        """Return the column of the cells that are `shift` away, (K, C) int32."""
        # These lines take 3 % of a window, so they are in place, and in 32 bits unless there are too many cells.
        _, start, _, _, row, col = pixels.place[..., None].unbind(1)  # [K, 1] each
        index = (row + shift[..., 0]).clamp_(-1, self.grid.height).mul_(self.lattice.stride)  # [K, C]
        index += (col + shift[..., 1]).clamp_(-1, self.grid.width)
        index += start
        return self.image.index_select(0, index.view(-1)).view_as(index)

    def are_wide(self, pixels: Pixels, groups: Groups) -> Tensor:
        """Tell which of M groups of K pixels have one with a reach of more than one pixel, (M,) bool."""
        if self.reach is None:
            return torch.zeros(groups.count, dtype=torch.bool, device=self.image.device)
        return groups.any(self.reach_of(pixels) > 1)

    def reach_of(self, pixels: Pixels) -> Tensor:
        """Return the reach of K pixels (`Spacing`), (K,) uint8."""
        if self.reach is None:
            return torch.ones_like(pixels.slices)
        return self.reach.index_select(0, self.column_of(pixels))

    def column_of(self, pixels: Pixels) -> Tensor:
        """Return the column of K pixels, (K,) int64."""
        return floor_divide(pixels.first_slot, self.num_slots)

    def words(self, pixels: Pixels) -> Tensor:
        """Return the bytes of all sweeps at the same place as each pixel, a byte for each slot: (K, words) int64."""
        return self.slices.view(torch.int64).index_select(0, self.column_of(pixels))

    def around(self, pixels: Pixels, reach: int, count: int) -> Groups:
        """Return which of the `count` pixels of the list are around K pixels, up to `reach` pixels each way.

        The result has an item for each pixel of the square in raster order, and for each of the K pixels:
        (2 reach + 1)^2 K items, grouped by the pixel of the list.
        """
        column = self.column_of(pixels)
        cell = self.cell.index_select(0, column) + self.lattice.square(reach, column.device)
        beside = self.image.index_select(0, cell.view(-1)).view_as(cell)  # [(2 reach + 1)^2, K]
        return self.pixel_at(self.entry(pixels.step, beside).view(-1), count)

    def pixel_in(self, window: Tensor, step: int, row_col: Tensor, count: int) -> Groups:
        """Return which of the `count` pixels of the list are in cells of a sweep.

        `window` is (K,) int64, and `row_col`, (2, M, K) int64, may be outside of the images. The result has M K items.
        """
        row = row_col[0].clamp(-1, self.grid.height)
        col = row_col[1].clamp(-1, self.grid.width)
        column = self.image.index_select(0, self.lattice.cell(window, row, col).view(-1))
        return self.pixel_at(self.entry(step, column), count)

    def entry(self, step: Tensor | int, column: Tensor) -> Tensor:
        """Return the entries of `rank` of sweeps in columns, in the shape and dtype of both together."""
        return column + step * len(self.cell)

    def pixel_at(self, entry: Tensor, count: int) -> Groups:
        """Group K entries of `rank`, (K,), by their pixel, one of `count` in the list."""
        rank = self.rank.view(-1).index_select(0, entry).long()
        return Groups(rank.clamp_(max=count), count)

    def as_words(self, values: Tensor) -> Tensor:
        """Return (C + 1, S) bytes as words, with a byte for each slot: (C + 1, T / 8) int64."""
        return F.pad(values, (0, self.num_slots - values.shape[1])).view(torch.int64)

    def or_around(self, words: Tensor) -> Tensor:
        """Return the bitwise OR over the 3 x 3 columns around each column, (C + 1, ...) int64."""
        left, right, above, below = self._neighbours
        words = words | words.index_select(0, left) | words.index_select(0, right)
        return words | words.index_select(0, above) | words.index_select(0, below)

    def beside(self, values: Tensor) -> Tensor:
        """Return the values to the left and right of each column, above and below, (4, C + 1); `values` is (C + 1,).

        `values[0]`, of the empty column, stands for places without a column.
        """
        return values.index_select(0, self._neighbours.view(-1)).view(4, -1)

    def sum_along(self, values: Tensor, is_vertical: bool) -> Tensor:
        """Sum four numbers of each column and the two beside it, (C + 1, 4) int16; the first row is 0.

        The two are to the left and to the right, or above and below. The four numbers of a column are one word of eight
        bytes, so a lookup takes all four (float32 took three times as long). Sums must fit into 16 bits.
        """
        words = values.view(torch.int64)[:, 0]
        for side in self._neighbours[2:] if is_vertical else self._neighbours[:2]:
            values = values + words.index_select(0, side).view(torch.int16).view(-1, 4)
        return values

    def _or_within_reach(self, words: Tensor) -> Tensor:
        """Return the slices within the reach of each column, in the bits of those of the pixels, (C + 1, W) int64."""
        around = self._or_within_pixels(words)
        if self.tall is None:
            return around
        of_tall = around.index_select(0, self.tall)
        above = of_tall << 1 | of_tall >> (NUM_SLICES - 1)  # the highest slice is below the lowest one
        below = of_tall >> 1 | of_tall << (NUM_SLICES - 1)
        return around.index_copy(0, self.tall, of_tall | (above | below) & _OWN_OF_WORD)

    def _or_within_pixels(self, words: Tensor) -> Tensor:
        """Return the slices up to the reach of each column away, (C + 1, W) int64.

        The slices up to r + 1 pixels away are those up to r away from the 3 x 3 columns around. So we widen the columns
        of a larger reach pixel by pixel. A column beside one of reach r + 1 has at least reach r.
        """
        within = self.or_around(words)  # up to one pixel away
        if self.reach is None:
            return within
        wide = flat_nonzero(self.reach > 1)  # [K]
        reach_of_wide = self.reach.index_select(0, wide)[:, None]  # [K, 1]
        around = self.cell.index_select(0, wide) + self.lattice.square(1, wide.device)
        # The 3 x 3 columns around each one, which is in the middle: [9 K].
        beside = self.image.index_select(0, around.view(-1))
        for reach in range(2, self.most_reach + 1):
            of_beside = within.index_select(0, beside).view(9, -1, words.shape[1])  # [9, K, W]
            wider = reduce(torch.bitwise_or, of_beside.unbind(0))
            within = within.index_copy(0, wide, torch.where(reach_of_wide >= reach, wider, of_beside[4]))
        return within

    @cached_property
    def _neighbours(self) -> Tensor:
        """(4, C + 1) int32, column to the left and to the right of each column, above and below it; 0 = none."""
        stride = self.lattice.stride
        steps = constant(((-1,), (1,), (-stride,), (stride,)), torch.int64, self.image.device)
        beside = self.cell + steps
        return self.image.index_select(0, beside.view(-1)).view_as(beside)

    def draw(self, slices: Tensor, columns_before: int = 0, pixels_before: int = 0) -> Pixels:
        """Draw the height slices of sweeps, and list their pixels, in order of step, window, row and column.

        Args:
            slices: (C + 1, S) uint8, slices of the pixels themselves; row 0 is 0.
            columns_before: number of columns that these will follow.
            pixels_before: number of pixels that are in the list already.
        """
        words = self.as_words(slices)
        self.slices.view(torch.int64).copy_(words | self._or_within_reach(words) << NUM_SLICES)
        drawn = slices.t().contiguous()  # [S, C + 1]
        step, column = nonzero_pairs(drawn.bool())
        entry = self.entry(step, column)
        number = torch.arange(pixels_before, pixels_before + len(entry), dtype=torch.int32, device=entry.device)
        self.rank.view(-1).index_copy_(0, entry, number)
        first_slot = (column + columns_before) * self.num_slots
        window, row_col = self.lattice.split(self.cell.index_select(0, column))
        place = torch.stack((first_slot, self.lattice.start(window), window, step, *row_col), 1)
        # With copies, there are at most twice as many columns.
        dtype = index_dtype(max(len(self.image), 2 * self.slices.numel()), place.device)
        return Pixels(place.to(dtype), drawn.view(-1).index_select(0, entry))

    def fill(self, is_unknown: Tensor) -> None:
        """Set all bits where it is not known what a sweep would have, (C + 1, S) bool.

        There, nothing is missing. A cell without a column stays empty. The pixels that are drawn already stay as
        they are.
        """
        filled = self.slices[1:, : is_unknown.shape[1]]
        filled |= is_unknown[1:].view(torch.uint8) * 255

    def are_filled(self, pixels: Pixels, step: Tensor | int, shift: Tensor | None = None) -> Tensor:
        """Tell where another sweep has slices, but no pixel, see `fill`: bool, with the arguments of `look_up`."""
        has_slices = self.look_up(pixels, step, shift) & OWN > 0
        if shift is None:
            entry = self.entry(step, self.column_of(pixels))  # [K]
        else:
            of_pixel = step[:, None] if isinstance(step, Tensor) else step
            entry = self.entry(of_pixel, self._column_at(pixels, shift))  # [K, C]
        return has_slices & (self.rank.view(-1).index_select(0, entry.view(-1)).view_as(entry) == _EMPTY)


def _inside(is_column: Tensor, lattice: Lattice) -> Tensor:
    """Clear the borders of images, (B * area,) bool, and list the cells that remain, (C,) int64."""
    border = lattice.border
    images = is_column.view(-1, lattice.height + 2 * border, lattice.stride)
    images[:, :border] = images[:, -border:] = False
    images[:, :, :border] = images[:, :, -border:] = False
    return flat_nonzero(is_column)


def _grow(is_column: Tensor, cell: Tensor, grid: Grid, spacing: Spacing, reach: int) -> Tensor:
    """Add the cells next to columns where the reach is at least `reach`, and return the cells of all columns.

    `is_column`, (B * area,) bool, which this overwrites, and `cell`, (C,) int64, tell the same columns.
    """
    # A neighbour of a column may have this reach although the column itself is nearer.
    lattice = grid.lattice(border=BORDER)
    candidates = flat_nonzero(spacing.are_wide(grid, *lattice.split(cell), reach, margin=2.0))
    around = (cell.index_select(0, candidates) + lattice.square(1, cell.device)).view(-1)
    wide = flat_nonzero(spacing.are_wide(grid, *lattice.split(around), reach))
    return _inside(mark(is_column, around.index_select(0, wide)), lattice)


def _reach_and_tall(grid: Grid, cell: Tensor, spacing: Spacing) -> tuple[Tensor | None, Tensor | None]:
    """Return `Columns.reach` and `Columns.tall` of columns, from their cells, (C + 1,) int64."""
    if spacing.most == 1 and not spacing.has_tall:
        return None, None
    window, row_col = grid.lattice(border=BORDER).split(cell)
    reach = spacing.reach(grid, window, row_col) if spacing.most > 1 else None
    tall = flat_nonzero(spacing.are_tall(grid, window, row_col, SLICE_HEIGHT)) if spacing.has_tall else None
    return reach, tall


def count_slices(slices: Tensor) -> Tensor:
    """Count the slices in each value, (...) uint8 with bits 0 ... 3 only: (...) int64."""
    counts = constant(_COUNTS, torch.int64, slices.device)
    return counts.index_select(0, slices.reshape(-1).int()).view(slices.shape)
