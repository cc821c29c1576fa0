"""Reader of the Waymo Open Dataset, version 1 (tfrecord), and of its scene-flow release, without TensorFlow."""

from __future__ import annotations

import os
import struct
import zlib
from typing import Any, Dict, Iterator, List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.data.boxes import flow_from_boxes
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import Place, as_path, parts
from cflow_torch.data.waymo.range_image import LASERS, NO_LABEL_ZONE, LaserCalibration, range_image_points
from cflow_torch.data.waymo.reader import BOX_CATEGORY, upright_boxes
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import relative_transform, rigid_transform

_HEAD = 1 << 16  # bytes of a record in which its time is looked for first
_LATEST = 1 << 53  # microseconds, the year 2255: in nanoseconds, too, they are 64-bit numbers
_MOST_FIELDS = 1 << 16  # of one message; a frame has some hundred
_MOST_IMAGE = 1 << 26  # bytes of an unpacked range image
_OTHER = max(BOX_CATEGORY) + 1  # a class that is none of those with a category
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # wire types
# What a foreign message leads to.
_BROKEN = (IndexError, ValueError, KeyError, struct.error, zlib.error, TypeError, OverflowError, MemoryError)


class WaymoRecordLog:
    """One segment; implements the `Log` protocol.

    Args:
        file: `segment-<context>_with_camera_labels.tfrecord`. The checksums in it are not checked.
        lasers: which LiDARs, names in `waymo_range_image.LASERS`.
        stored_flow: truth from the stored velocities (files of the scene-flow release) instead of box tracks.

    Convention: frames, units, order of points and box truth as in `waymo.WaymoLog`; first returns only. A stored
        velocity is that from frame t-1 to t, without the motion of the vehicle, in its axes; the flow to t+1 is
        `T_ego1_ego0 (p + v (t1 - t0)) - p`. Class -1 (no label) and no-label zones are invalid.

    Raises:
        CFlowError: no such file, not a tfrecord of frames, truncated; fewer than two frames.
    """

    def __init__(self, file: Place, lasers: Sequence[str] = tuple(LASERS), stored_flow: bool = False) -> None:
        self.file = as_path(file)
        if not lasers or set(lasers) - set(LASERS):
            raise CFlowError(f"lasers are some of {', '.join(LASERS)}; got {list(lasers)}")
        self.log_id = self.file.stem
        self._lasers, self._stored_flow = sorted(LASERS[name] for name in lasers), stored_flow
        try:
            self._span = dict(sorted(self._find_frames()))
        except FileNotFoundError:
            raise CFlowError(f"{self.file} is missing; give a segment-*.tfrecord") from None
        except (OSError, *_BROKEN) as error:
            raise CFlowError(
                f"{self.file} is no tfrecord of Waymo frames, or truncated: {error}; copy it again"
            ) from error
        self.timestamps: Sequence[int] = [time * 1000 for time in self._span]
        if len(self.timestamps) < 2:
            raise CFlowError(f"{self.file} has {len(self.timestamps)} frames; scene flow needs two or more")

    def __len__(self) -> int:
        return len(self.timestamps)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`, without ground mask. Raises CFlowError if there is none or it cannot be read."""
        frame = self._frame(index)
        return Sweep(frame["points"], None, frame["pose"], self.timestamps[index])

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1), None for the last sweep. Raises CFlowError as `sweep` does."""
        frame = self._frame(index)
        if index == len(self) - 1:
            return None
        after = self._frame(index + 1)
        T, points = relative_transform(after["pose"], frame["pose"]), frame["points"].astype(np.float64)
        if not self._stored_flow:
            labels = flow_from_boxes(frame["points"], frame["boxes"], after["boxes"], T)
            return FlowLabels(labels.flow, labels.category, labels.is_valid & ~frame["zone"])
        velocity, kind = frame["velocity"][:, :3], _classes(frame["velocity"])
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        moved = (points + np.where(kind[:, None] < 0, 0, velocity) * seconds) @ T[:3, :3].T + T[:3, 3]
        category = np.array([BOX_CATEGORY.get(k, 0) for k in range(_OTHER + 1)], np.uint8)
        is_valid = (kind >= 0) & ~frame["zone"]
        return FlowLabels((moved - points).astype(np.float32), category[np.maximum(kind, 0)], is_valid)

    def _find_frames(self) -> Iterator[Tuple[int, Tuple[int, int]]]:
        """(microseconds, (first byte, end)) of every frame; touches little of the file."""
        with parts(self.file) as file:
            size, begin = file.seek(0, os.SEEK_END), 0
            head, start = b"", 0  # what was read last, and where it lies: small records share it
            while begin < size:
                if _end(head, begin - start) > len(head):
                    file.seek(begin)
                    head, start = file.read(_HEAD), begin
                first = begin - start + 12  # after the length and its checksum
                end = _end(head, begin - start)
                if start + end + 4 > size:
                    raise ValueError(f"a record of {end - first} bytes at byte {begin + 12} of {size}")
                try:
                    time = _time(head, first, end)
                except IndexError:  # not near the beginning
                    file.seek(begin)
                    time = _time(file.read(12 + end - first), 12, 12 + end - first)
                yield time, (start + first, start + end)
                begin = start + end + 4

    def _frame(self, index: int) -> Dict[str, Any]:
        if not 0 <= index < len(self):
            raise CFlowError(f"segment {self.log_id} has sweeps 0 ... {len(self) - 1}, asked for {index}")
        first, end = self._span[self.timestamps[index] // 1000]
        try:
            with parts(self.file) as file:
                file.seek(first)
                data = file.read(end - first)
            return self._decode(data)
        except (OSError, *_BROKEN) as error:
            raise CFlowError(f"{self.file}: frame {index} cannot be read: {error}; copy the file again") from error

    def _decode(self, data: bytes) -> Dict[str, Any]:
        frame = _message(data)
        pose = rigid_transform(_doubles(_message(frame[3][0])[1]).reshape(4, 4), "pose")
        calibration = {c[1][0]: c for c in map(_message, _message(frame[1][0])[3])}
        images = {laser[1][0]: _message(laser[2][0]) for laser in map(_message, frame.get(5, [])) if 2 in laser}
        points, zone = [np.zeros((0, 3))], [np.zeros(0, bool)]
        flow: List[np.ndarray] = [np.zeros((0, 4))]
        for laser in (number for number in self._lasers if number in images):
            image, mount = images[laser], calibration[laser]
            low, high = (_doubles(mount[n])[0] if n in mount else 0.0 for n in (3, 4))
            table = _doubles(mount[2]) if 2 in mount else None
            T_ego_sensor = rigid_transform(_doubles(_message(mount[5][0])[1]).reshape(4, 4), "extrinsic")
            returns = _matrix(image[2][0])
            poses = _matrix(image[4][0]) if 4 in image else None
            there, pixels = range_image_points(returns, LaserCalibration(T_ego_sensor, table, low, high), poses, pose)
            points.append(there)
            zone.append(_per_pixel(returns, returns)[pixels, NO_LABEL_ZONE] == 1)
            stored = _per_pixel(_matrix(image[5][0]), returns) if 5 in image else None
            flow.append(np.full((len(pixels), 4), -1.0) if stored is None else stored[pixels, :4].astype(np.float64))
        boxes = []
        for label in map(_message, frame.get(6, [])):
            if BOX_CATEGORY[label[3][0]]:
                box = {n: _doubles(value)[0] for n, value in _message(label[1][0]).items()}
                values = [box.get(n, 0.0) for n in (5, 4, 6, 7, 1, 2, 3)]  # a message has the width before the length
                boxes.append((str(label[4][0], "utf-8"), BOX_CATEGORY[label[3][0]], values))
        arrays = {"points": np.concatenate(points).astype(np.float32), "velocity": np.concatenate(flow)}
        return {"pose": pose, "boxes": upright_boxes(boxes), "zone": np.concatenate(zone), **arrays}


def _classes(velocity: np.ndarray) -> np.ndarray:
    """(N,) int64 class of stored velocities: -1 = none, which a velocity that is not finite has too."""
    known = np.isfinite(velocity).all(axis=1)
    return np.where(known, np.clip(np.where(known, velocity[:, 3], -1), -1, _OTHER), -1).astype(np.int64)


def _end(data: bytes, at: int) -> int:
    """Where the record ends that begins at a place in some bytes; at least where its length ends."""
    return at + 12 + (struct.unpack_from("<Q", data, at)[0] if at + 8 <= len(data) else 0)


def _time(data: bytes, first: int, end: int) -> int:
    """Microseconds of a frame."""
    for number, value in _fields(data, first, end):
        if number == 2 and isinstance(value, int) and value < _LATEST:
            return value
    raise ValueError("a frame without time")


def _varint(data: Any, at: int) -> Tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if data[at - 1] < 0x80:
            return value, at
        if shift > 63:
            raise ValueError("a number of more than 64 bits")


def _fields(data: Any, at: int, end: int) -> Iterator[Tuple[int, Any]]:
    """(number, value) of each field of a message: an integer, or bytes."""
    while at < end:
        tag, at = _varint(data, at)
        number, kind = tag >> 3, tag & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if kind == _BYTES:
            length, at = _varint(data, at)
        elif kind in (_EIGHT, _FOUR):
            length = 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"wire type {kind}")
        if at + length > end:
            raise ValueError("a field longer than its message")
        yield number, slice(at, at + length)
        at += length


def _message(data: bytes) -> Dict[int, List[Any]]:
    """Field number -> values, in order."""
    fields: Dict[int, List[Any]] = {}
    view = memoryview(data)
    for count, (number, value) in enumerate(_fields(view, 0, len(view))):
        if count >= _MOST_FIELDS:
            raise ValueError(f"a message of more than {_MOST_FIELDS} fields")
        fields.setdefault(number, []).append(view[value] if isinstance(value, slice) else value)
    return fields


def _doubles(values: Sequence[Any]) -> np.ndarray:
    """Repeated doubles, packed or not."""
    return np.frombuffer(b"".join(values), dtype="<f8")


def _matrix(compressed: Any) -> np.ndarray:
    """MatrixFloat: values and shape."""
    unpacking = zlib.decompressobj()
    content = unpacking.decompress(compressed, _MOST_IMAGE)
    if not unpacking.eof:
        raise ValueError(f"an image that is truncated or unpacks to more than {_MOST_IMAGE} bytes")
    matrix = _message(content)
    shape = [size for size in _message(matrix[2][0])[1] if isinstance(size, int)]
    return np.frombuffer(b"".join(matrix[1]), dtype="<f4").reshape(shape)


def _per_pixel(matrix: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """(H * W, channels) of a matrix that lies over the image of the returns."""
    if matrix.shape[:2] != returns.shape[:2] or matrix.ndim != 3 or matrix.shape[2] < 4:
        raise ValueError(f"an image of shape {matrix.shape} over one of {returns.shape}")
    return matrix.reshape(-1, matrix.shape[2])
