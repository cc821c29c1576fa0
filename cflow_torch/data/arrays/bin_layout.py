"""Files of numbers without a header: find out how many numbers of which type make a point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.types import CFlowError

KITTI_COLUMNS = 4  # x, y, z, reflectance
_COLUMNS = range(3, 9)
_SMALLEST, _LARGEST = 1e-6, 1e7  # sizes that coordinates, intensities, rings and times have, besides 0
_SHARE = 0.95  # of the numbers have such a size; of numbers read in a wrong type, less than 0.8
_EXPLAINED, _AS_GOOD = 0.05, 0.9  # least share of the variance, and the share of the best that a smaller number needs
_FARTHEST, _LONGEST_RECORD = 1e4, 64  # size of coordinates, and bytes of a record
_FEWEST = 1000  # points of a file that tell its layout
_FIX = "give the numbers per point (data.bin_columns=4 in KITTI, 5 in nuScenes), or convert other types with numpy.save"
_MOST, _BLOCK = 1 << 17, 840  # numbers that we test; a multiple of all numbers of columns


class BinLayout(NamedTuple):
    """Numbers of a point, x, y, z first."""

    columns: int = KITTI_COLUMNS
    kind: str = "<f4"
    rest: int = 0  # bytes of numbers of other types after them

    @property
    def step(self) -> int:
        """Bytes per point."""
        return self.columns * np.dtype(self.kind).itemsize + self.rest

    def table(self, content: bytes) -> np.ndarray:
        """Return the numbers in a file of whole points, (N, columns)."""
        octets = np.frombuffer(content, np.uint8).reshape(-1, self.step)
        return np.ascontiguousarray(octets[:, : self.step - self.rest]).view(self.kind)

    def fits(self, content: bytes) -> bool:
        """Test whether a file has this layout, by its first points. Files that are too short to tell have it."""
        if len(content) % self.step:
            return False
        if self.rest:
            return _are_records(content, self)
        start = content[: _BLOCK * 10 * np.dtype(self.kind).itemsize]
        return len(content) < _FEWEST * self.step or _explained(_numbers(start, self.kind), self.columns) >= _EXPLAINED

    def __str__(self) -> str:
        rest = f" and {self.rest} other bytes" if self.rest else ""
        return f"{self.columns} float{8 * np.dtype(self.kind).itemsize}{rest} per point"


def find_bin_layout(content: bytes, columns: int | None = None) -> BinLayout:
    """Recognise the layout of a headerless file.

    Args:
        content: the whole file.
        columns: numbers per point; None = find out. Then only x, y and z tell the type: a time may have any size.

    Convention: the type is the one, float32 or float64, in which numbers have sizes of coordinates. Columns differ in
        size (z is smaller than x and y, intensities are larger). We choose the number of columns, 3 to 8, that explains
        most of the variance of log sizes. Ties: the smallest. A file that is empty or too short to tell is KITTI's. If
        no type fits, points may be records of several types that begin with x, y, z in float32 (ring and time after
        them are integers or float64): the fewest bytes in which they do.

    Raises:
        CFlowError: no layout fits. The message names `bin_columns`.
    """
    kind = _type_of(content, columns)
    if columns is not None:
        if not kind:
            raise CFlowError(f"x, y, z of {columns} numbers per point are no coordinates in float32 or float64: {_FIX}")
        return BinLayout(columns, kind)
    layouts = [BinLayout(count, kind) for count in _COLUMNS if kind]
    fitting = [layout for layout in layouts if len(content) % layout.step == 0]
    explained = {layout: _explained(_numbers(content, layout.kind), layout.columns) for layout in fitting}
    least = max(_AS_GOOD * max(explained.values(), default=0.0), _EXPLAINED)
    good = [layout for layout in fitting if explained[layout] >= least]
    if not good and len(content) < _FEWEST * BinLayout().step and BinLayout() in fitting:
        good = [BinLayout()]
    if not kind:
        records = (BinLayout(3, "<f4", rest) for rest in range(1, _LONGEST_RECORD - 11))
        record = next((layout for layout in records if _are_records(content, layout)), None)
        good = [] if record is None else [record]
    if not good:
        counts = ", ".join(map(str, _COLUMNS))
        raise CFlowError(
            f"it has {len(content)} bytes, and does not look like points of {counts} float32 or float64 numbers, x, y, "
            f"z first, or records that begin with these: {_FIX}"
        )
    return min(good)  # of the fewest columns


def _are_records(content: bytes, layout: BinLayout) -> bool:
    """Test whether points begin with x, y, z: as numbers of another place in a record, they would be of any size."""
    if len(content) % layout.step or len(content) < _FEWEST * layout.step:
        return False
    with np.errstate(invalid="ignore"):  # numbers of another type may be signalling NaN
        points = layout.table(content[: _FEWEST * layout.step]).astype(np.float64)
    # Columns of one number are padding or counters, read as floats.
    have_values = all(len(np.unique(column)) > _FEWEST // 4 for column in points.T)
    return have_values and are_plausible(points, _FARTHEST)


def _type_of(content: bytes, columns: int | None) -> str:
    """Return the type of the numbers, "<f4" or "<f8"; "" = neither. float32 can look like float64, but not reverse."""
    is_float32, is_float64 = (are_plausible(_numbers(content, kind, columns)) for kind in ("<f4", "<f8"))
    if not is_float32:
        return "<f8" if is_float64 else ""
    # The lower halves of float64 numbers with few digits are zeros, so they look like float32, too.
    is_zero = _numbers(content, "<f4") == 0
    has_halves = len(is_zero) > 1 and is_zero[::2].mean() > 0.5 > is_zero[1::2].mean()
    return "<f8" if is_float64 and has_halves else "<f4"


def are_plausible(numbers: np.ndarray, largest: float = _LARGEST) -> bool:
    """Test whether floats, of any shape, are in a type and byte order that fits: nearly all have usual sizes."""
    size = np.abs(numbers)
    is_usual = (size == 0) | ~np.isfinite(size) | ((size > _SMALLEST) & (size < largest))
    return bool(is_usual.sum() >= _SHARE * is_usual.size)


def _numbers(content: bytes, kind: str, columns: int | None = None) -> np.ndarray:
    """Return the numbers of the file, or evenly spaced blocks of them. Blocks keep the column of each number.

    With `columns`, they are only x, y and z.
    """
    numbers = np.frombuffer(content, kind, len(content) // np.dtype(kind).itemsize)
    if columns is not None:
        numbers = numbers[: len(numbers) // columns * columns].reshape(-1, columns)[:, :3].reshape(-1)
    if len(numbers) > _MOST:
        blocks = numbers[: len(numbers) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
        numbers = blocks[:: len(numbers) // _MOST + 1].reshape(-1)
    with np.errstate(invalid="ignore"):  # numbers of another type may be signalling NaN
        return numbers.astype(np.float64)


def _explained(numbers: np.ndarray, columns: int) -> float:
    """Return the share of the variance of log sizes that the column explains, less what chance explains, 0 to 1.

    Zeros, NaN and infinite values are ignored, because they mean "no return". But a column of zeros besides x, y, z
    explains all.
    """
    known = np.isfinite(numbers) & (numbers != 0)
    sizes = np.log(np.clip(np.abs(numbers[known]), 1e-2, None))
    column = np.flatnonzero(known) % columns
    counts = np.bincount(column, minlength=columns)
    if not counts[:3].all():
        return 0.0
    if not counts.all():
        return 1.0
    means = np.bincount(column, sizes, columns) / counts
    between = float(counts @ (means - sizes.mean()) ** 2) / len(sizes)
    return max(between / max(float(sizes.var()), 1e-9) - 10 * columns / len(sizes), 0.0)
