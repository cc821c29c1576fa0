"""Scenes of HDF5, read and written into; index files."""

from __future__ import annotations

import os
import random
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence, Tuple

import numpy as np
from hypothesis import strategies as st

from cflow_torch import CFlowError
from cflow_torch.data.hdf5.index_file import read_index
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.hdf5.results import write_hdf5_results
from fuzzing.hostile_hdf5 import FOREIGN, KEYS, POINTS, STAMPS, WOUNDS, scene_image, write_outside
from fuzzing.hostile_pickles import hostile_pickle, whole_pickles
from fuzzing.mutation import damaged
from fuzzing.target import Target

_IMAGES = 1000  # crafted scenes, each made once: that takes longer than to read one


def every(calls: Sequence[Callable[[], Any]], check: Callable[[Any], None]) -> None:
    """Make all calls, check what they give; the first CFlowError, after all, so that none hides another fault."""
    errors = []
    for call in calls:
        try:
            check(call())
        except CFlowError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _of_this_scene(value: Any) -> None:
    for array in (value, getattr(value, "points", None), getattr(value, "flow", None)):
        if isinstance(array, np.ndarray) and (array == FOREIGN).any():
            raise AssertionError("a link, an external or a virtual dataset was followed")


def read_scene(folder: Path) -> None:
    with HDF5Log(folder / "scene.h5") as log:
        calls: List[Callable[[], Any]] = [log.eval_frames, lambda: log.poses]
        for index in range(min(len(log.timestamps), len(STAMPS))):
            methods = (log.sweep, log.labels, log.eval_mask, log.keys)
            calls += [lambda method=method, index=index: method(index) for method in methods]
        calls += [lambda key=key: log.values(0, key) for key in ("lidar", "mine") if key in _keys(log, 0)]
        calls.append(lambda: log.stored_motion(0))
        every(calls, _of_this_scene)


def write_results(folder: Path) -> None:
    file = folder / "scene.h5"
    before, around = file.read_bytes(), _around(folder)
    flow = np.full((POINTS, 3), 0.25, np.float32)
    try:
        write_hdf5_results(file, "mine", [(stamp, flow) for stamp in STAMPS])
    except CFlowError:
        assert file.read_bytes() == before, "a failed write changed the scene"
        raise
    finally:
        assert _around(folder) == around, "something beside the scene was written"
    with HDF5Log(file, ego_T_lidar=None) as log:
        for stamp in STAMPS:
            assert (log.values(log.timestamps.index(stamp), "mine") == flow).all(), "what was written is not there"


def _keys(log: HDF5Log, index: int) -> List[str]:
    try:
        return list(log.keys(index))
    except CFlowError:
        return []


def _around(folder: Path) -> Dict[str, bytes]:
    others = [name for name in os.listdir(folder) if name not in ("scene.h5", "corpus", "tokens")]
    return {name: (folder / name).read_bytes() for name in others}


def _seeds() -> List[bytes]:
    kinds: Tuple[Dict[str, Any], ...] = (
        {},
        {"compression": "gzip", "shuffle": True},
        {"chunks": True},
        {"chunks": True, "maxshape": True},
    )
    old = [scene_image(random.Random(0), libver="earliest", **kind) for kind in kinds]
    return [*old, *(scene_image(random.Random(0), libver="latest", **kind) for kind in kinds)]


def _seeds_with_results() -> List[bytes]:
    return [
        scene_image(random.Random(0), libver=version, results=n) for version in ("earliest", "latest") for n in (0, 1)
    ]


@lru_cache(_IMAGES)
def _image(number: int) -> bytes:
    chance = random.Random(number)
    wounds = [chance.choice(WOUNDS) for _ in range(chance.choice((1, 1, 2, 4)))]
    libver = chance.choice(("earliest", "latest"))
    return scene_image(chance, libver=libver, wounds=wounds, results=chance.choice((0, 1)))


class _Images(Sequence[bytes]):
    """The crafted scenes, made when they are asked for."""

    def __len__(self) -> int:
        return _IMAGES

    def __getitem__(self, number: Any) -> Any:
        return _image(number)


def _read_index(folder: Path) -> None:
    try:
        read_index(folder / "index_eval.pkl")
    finally:
        assert os.listdir(folder / "calm") == [], "a pickle ran something"


_TOKENS = (b"OHDR", b"TREE", b"HEAP", b"SNOD", b"OCHK", b"FRHP", b"BTHD", b"FADB", *(key.encode() for key in KEYS))
_INSTRUCTIONS = (b"]", b"(", b"e", b"a", b"h\0", b"\x8c\x01a", b"cos\nsystem\n", b"R", b"\x95" + b"\xff" * 8, b"2")
_CRAFTED = st.integers(0, _IMAGES - 1).map(_image) | damaged(_Images(), _TOKENS)
TARGETS: Tuple[Target, ...] = (
    Target(
        *("hdf5", "scene.h5", _seeds, read_scene),
        prepare=write_outside,
        crafted=_CRAFTED,
        tokens=_TOKENS,
        needs="h5py",
    ),
    Target(
        *("hdf5-results", "scene.h5", _seeds_with_results, write_results),
        prepare=write_outside,
        crafted=_CRAFTED,
        tokens=_TOKENS,
        needs="h5py",
    ),
    Target(
        *("hdf5-index", "index_eval.pkl", whole_pickles, _read_index),
        prepare=lambda folder: (folder / "calm").mkdir(exist_ok=True),
        crafted=st.integers(0, (1 << 64) - 1).map(hostile_pickle),
        tokens=_INSTRUCTIONS,
    ),
)
