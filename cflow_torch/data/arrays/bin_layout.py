"""Files of numbers without a header: find out how many numbers of which type make a point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.types import CFlowError

KITTI_COLUMNS = 4  # x, y, z, reflectance
# Numbers of a point, and more if none of these explains enough, or if only one of more does explain all (by a column of
# zeros): beams in turns look like points of several times as many numbers.
_COLUMNS, _MORE_COLUMNS = range(3, 9), range(9, 17)
_SMALLEST, _LARGEST = 1e-6, 1e7  # sizes that coordinates, intensities, rings and times have, besides 0
_SHARE = 0.95  # of the numbers have such a size; of numbers read in a wrong type, less than 0.8
# Least share of the variance; that if all x come first, as points are sorted, too; and the share of the best that a
# smaller number needs.
_EXPLAINED, _EXPLAINED_PLANAR, _AS_GOOD = 0.05, 0.2, 0.9
_FARTHEST, _LONGEST_RECORD = 1e4, 64  # size of coordinates, and bytes of a record
_FEWEST = 1000  # points of a file that tell its layout
_FIX = (
    "give the numbers per point (data.bin_columns=4 in KITTI, 5 in nuScenes), convert other types with numpy.save, or "
    "read the data sets of KISS-ICP's loaders by these (data=kiss_icp data.loader=nclt)"
)
_CLOUDCOMPARE = b"CCB"  # first bytes of its own format
_MOST, _BLOCK = 1 << 17, 100  # numbers that we test, in blocks of so many points


class BinLayout(NamedTuple):
    """Numbers of a point, x, y, z first."""

    columns: int = KITTI_COLUMNS
    kind: str = "<f4"
    rest: int = 0  # bytes of numbers of other types after them
    is_planar: bool = False  # the file holds x of all points, then y, and so on

    @property
    def step(self) -> int:
        """Bytes per point."""
        return self.columns * np.dtype(self.kind).itemsize + self.rest

    def table(self, content: bytes) -> np.ndarray:
        """Return the numbers in a file of whole points, (N, columns)."""
        if self.is_planar:
            return np.ascontiguousarray(np.frombuffer(content, self.kind).reshape(self.columns, -1).T)
        octets = np.frombuffer(content, np.uint8).reshape(-1, self.step)
        return np.ascontiguousarray(octets[:, : self.step - self.rest]).view(self.kind)

    def rows(self, content: bytes, is_kept: np.ndarray) -> bytes:
        """Return the content of a file with some of the points, (N,) bool."""
        if self.is_planar:
            return np.ascontiguousarray(self.table(content)[is_kept].T).tobytes()
        return np.frombuffer(content, np.uint8).reshape(-1, self.step)[is_kept].tobytes()

    def fits(self, content: bytes) -> bool:
        """Test whether a file has this layout, by its first points. Files that are too short to tell have it."""
        if len(content) % self.step:
            return False
        if self.rest:
            return _are_records(content, self)
        start = content if self.is_planar else content[: _FEWEST * self.step]
        return len(content) < _FEWEST * self.step or self.explained(start) >= _EXPLAINED

    def explained(self, content: bytes) -> float:
        """Return the share of the variance of log sizes that the columns explain, 0 to 1, see `_explained`."""
        if self.is_planar:
            content = self.table(content).tobytes()
        return _explained(_numbers(content, self.kind, self.columns), self.columns)

    def __str__(self) -> str:
        rest = f" and {self.rest} other bytes" if self.rest else ""
        order = ", all x first" if self.is_planar else ""
        return f"{self.columns} float{8 * np.dtype(self.kind).itemsize}{rest} per point{order}"


def find_bin_layout(content: bytes, columns: int | None = None) -> BinLayout:
    """Recognise the layout of a headerless file.

    Args:
        content: the whole file.
        columns: numbers per point; None = find out. Then only x, y and z tell the type: a time may have any size.

    Convention: the type is the one, float32 or float64, in which numbers have sizes of coordinates. Columns differ in
        size (z is smaller than x and y, intensities are larger). We choose the number of columns, 3 to 8, or up to 16,
        that explains most of the variance of log sizes. Ties: the smallest. If none does, the file may hold all x, then
        all y, and so on (Oxford RobotCar). Given columns need not explain anything if no others do. A file that is
        empty or too short to tell is KITTI's. If no type fits, points may be records of several types that begin with
        x, y, z in float32 (ring and time after them are integers or float64): the fewest bytes in which they do.

    Raises:
        CFlowError: no layout fits. The message names `bin_columns`.
    """
    if content.startswith(_CLOUDCOMPARE):
        raise CFlowError("it has CloudCompare's own format, which is not read: save it there as .ply")
    kind = _type_of(content, columns)
    if columns is not None and not kind:
        raise CFlowError(f"x, y, z of {columns} numbers per point are no coordinates in float32 or float64: {_FIX}")
    if columns is not None:
        return _given_layout(content, BinLayout(columns, kind))
    good = _good_layouts(content, kind) if kind else []
    step = BinLayout().step
    if not good and kind == "<f4" and len(content) < _FEWEST * step and len(content) % step == 0:
        good = [BinLayout()]
    if not kind:
        records = (BinLayout(3, "<f4", rest) for rest in range(1, _LONGEST_RECORD - 11))
        record = next((layout for layout in records if _are_records(content, layout)), None)
        good = [] if record is None else [record]
    if not good:
        raise CFlowError(
            f"it has {len(content)} bytes, and does not look like points of 3 to {_MORE_COLUMNS[-1]} float32 or "
            f"float64 numbers, x, y, z first, or records that begin with these: {_FIX}"
        )
    return good[0]


def _good_layouts(content: bytes, kind: str) -> list[BinLayout]:
    """Return the layouts of a file that explain enough of its numbers, that of the fewest columns first.

    If only some explain them that the size of the file does not fit, it is truncated, and has none.
    """
    explained = {each: each.explained(content) for each in (BinLayout(count, kind) for count in _COLUMNS)}
    more = {each: each.explained(content) for each in (BinLayout(count, kind) for count in _MORE_COLUMNS)}
    best, least = max(explained.values()), _EXPLAINED
    if best < least or max(more.values()) == 1 > best:
        explained.update(more)
    if max(explained.values()) < least:
        return [
            layout
            for layout in (BinLayout(count, kind, is_planar=True) for count in _COLUMNS)
            if _is_peak(layout, content)
        ]
    fitting = {layout: share for layout, share in explained.items() if len(content) % layout.step == 0}
    least = max(_AS_GOOD * max(fitting.values(), default=0.0), least)
    return [layout for layout, share in fitting.items() if share >= least]


def _is_peak(planar: BinLayout, content: bytes) -> bool:
    """Test whether a planar layout explains a file, and more of it than one column more does."""
    more = planar._replace(columns=planar.columns + 1)
    shares = [each.explained(content[: len(content) // each.step * each.step]) for each in (planar, more)]
    return len(content) % planar.step == 0 and shares[0] >= _EXPLAINED_PLANAR and shares[0] > shares[1]


def _given_layout(content: bytes, given: BinLayout) -> BinLayout:
    """Return the layout of a file with a given number of columns, which may be planar."""
    if given.explained(content) >= _EXPLAINED or len(content) < _FEWEST * given.step:
        return given
    good = _good_layouts(content, given.kind)
    planar = given._replace(is_planar=True)
    if good and planar not in good:
        raise CFlowError(f"it does not look like {given}, but like {good[0]}: give data.bin_columns={good[0].columns}")
    return planar if good else given


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
    known = (1, None) if columns is None else (columns, 3)
    is_float32, is_float64 = (are_plausible(_numbers(content, kind, *known)) for kind in ("<f4", "<f8"))
    if not is_float32:
        return "<f8" if is_float64 else ""
    # The lower halves of float64 numbers with few digits are zeros, so they look like float32, too.
    is_zero = _numbers(content, "<f4", 1) == 0
    has_halves = len(is_zero) > 1 and is_zero[::2].mean() > 0.5 > is_zero[1::2].mean()
    return "<f8" if is_float64 and has_halves else "<f4"


def are_plausible(numbers: np.ndarray, largest: float = _LARGEST) -> bool:
    """Test whether floats, of any shape, are in a type and byte order that fits: nearly all have usual sizes."""
    size = np.abs(numbers)
    is_usual = (size == 0) | ~np.isfinite(size) | ((size > _SMALLEST) & (size < largest))
    return bool(is_usual.sum() >= _SHARE * is_usual.size)


def _numbers(content: bytes, kind: str, columns: int, known: int | None = None) -> np.ndarray:
    """Return the numbers of the file, or evenly spaced blocks of points. Blocks keep the column of each number.

    If only x, y and z are `known`, they are only these.
    """
    numbers = np.frombuffer(content, kind, len(content) // np.dtype(kind).itemsize)
    points = numbers[: len(numbers) // columns * columns].reshape(-1, columns)[:, :known]
    if points.size > _MOST:
        blocks = points[: len(points) // _BLOCK * _BLOCK].reshape(-1, _BLOCK * points.shape[1])
        points = blocks[:: points.size // _MOST + 1]
    with np.errstate(invalid="ignore"):  # numbers of another type may be signalling NaN
        return points.reshape(-1).astype(np.float64)


def _explained(numbers: np.ndarray, columns: int) -> float:
    """Return the share of the variance of log sizes that the column explains, less what chance explains, 0 to 1.

    Zeros, NaN and infinite values are ignored, because they mean "no return". But a column of zeros besides x, y, z
    explains all. Of many columns, x, y, z may be others than the first three, which the check tells.
    """
    known = np.isfinite(numbers) & (numbers != 0)
    sizes = np.log(np.clip(np.abs(numbers[known]), 1e-2, None))
    column = np.flatnonzero(known) % columns
    counts = np.bincount(column, minlength=columns)
    if not (counts[:3].all() if columns in _COLUMNS else counts[:3].any()):
        return 0.0
    if not counts.all():
        return 1.0
    means = np.bincount(column, sizes, columns) / counts
    between = float(counts @ (means - sizes.mean()) ** 2) / len(sizes)
    return max(between / max(float(sizes.var()), 1e-9) - 10 * columns / len(sizes), 0.0)
