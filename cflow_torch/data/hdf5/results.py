"""A method's flow as a key of OpenSceneFlow's HDF5 scenes, where the harness's viewers look for it."""

from __future__ import annotations

import os
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Iterable, Tuple, Union

import numpy as np

from cflow_torch.data.atomic import atomic_name, remove_stale
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.hdf5.stored import import_h5py, member
from cflow_torch.types import Array, CFlowError, as_numpy

# Keys that scenes bring, and names that the viewers give a meaning of their own.
RESERVED_KEYS = frozenset(
    (
        *("lidar", "lidar_id", "lidar_dt", "lidar_center", "ground_mask", "pose", "ego_motion", "eval_mask"),
        *("flow", "flow_is_valid", "flow_category_indices", "flow_instance_id"),
        *("dufo", "cluster", "dufocluster", "nnd", "label", "raw", "pc0_dynamic", "pc1_dynamic", "pch1_dynamic"),
        *("pc0", "pc1", "gm0", "gm1", "pose0", "pose1"),
    )
)
_writing = partial(file_errors, mend="give a complete scene, and make room beside it for a copy", doing="write")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


def check_result_name(name: str) -> None:
    """Refuse names that are taken or that a viewer's command line cannot carry.

    Raises:
        CFlowError: as said.
    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise CFlowError(
            f"{name!r} is no result name: begin with a letter, then letters, digits, '_', '-', '.', at most 64"
        )
    if name in RESERVED_KEYS:
        raise CFlowError(f"{name} is a key of the scenes themselves, choose another name, for example cflow")


def check_writable(file: Union[str, Path]) -> None:
    """Refuse a scene that must not be changed.

    Raises:
        CFlowError: no such file, or it or its folder is read-only.
    """
    file = Path(file).resolve()
    if not file.is_file():
        raise CFlowError(f"{file} does not exist; give a scene (.h5)")
    # The mode as well as the right: the superuser may write everything, but a file marked read-only is meant to be.
    if not file.stat().st_mode & 0o222 or not os.access(file, os.W_OK) or not os.access(file.parent, os.W_OK):
        raise CFlowError(f"{file} or its folder is read-only: copy the scene, or make it writable")


def write_hdf5_results(file: Union[str, Path], name: str, results: Iterable[Tuple[int, Array]]) -> int:
    """Write the total flow of sweeps into a scene under a result name.

    Args:
        file: `<scene>.h5`; every other key keeps its contents.
        name: of the result; a result of that name is replaced.
        results: (time stamp of sweep t, (N, 3) TOTAL flow) pairs, metres until the next sweep, axes of ego1, one row
            per point of the sweep, ground included; taken one by one.

    Returns:
        Number of sweeps written.

    Convention:
        float32, neither chunked nor compressed, as the harness stores it. NaN rows are kept (viewers show them white).
        All results go into a copy beside the file, which takes its place at the end: whatever happens on the way, the
        scene is the old one or the new one. Readers that have it open go on with the old one. Two writers at once: the
        later one wins, the results of the other are lost.

    Raises:
        CFlowError: h5py is missing; the name is taken; the file is read-only or no scene; a sweep is not in it; rows do
            not agree. The scene is then unchanged.

    Cost: one copy of the scene, in time and, until the end, in space.
    """
    h5py = import_h5py()
    check_result_name(name)
    check_writable(file)
    file = Path(file).resolve()  # a link stays a link
    remove_stale(file.parent)  # copies of writers that were killed
    count = 0
    with atomic_name(file) as copy:
        shutil.copy(file, copy)
        with _writing(file):
            scene = h5py.File(copy, "r+")
        try:
            for timestamp, flow in results:
                _write(scene, file, str(timestamp), name, as_numpy(flow))
                count += 1
        finally:
            with _writing(file):
                scene.close()
    return count


def _write(scene: Any, file: Path, timestamp: str, name: str, flow: np.ndarray) -> None:
    where = f"{file}: sweep {timestamp}"
    sweep = member(scene, timestamp, file)
    points = None if sweep is None else member(sweep, "lidar", where)
    if sweep is None or points is None:
        raise CFlowError(f"{file} has no sweep {timestamp}")
    with _writing(where):
        rows = len(points)
        if flow.shape != (rows, 3):
            raise CFlowError(f"{file}: the flow of sweep {timestamp} has shape {flow.shape}, expected ({rows}, 3)")
        older = member(sweep, name, where)
        if older is None:
            sweep.create_dataset(name, data=flow.astype(np.float32))
            return
        # Two names of one dataset: another key would change as well.
        if older.shape != (rows, 3) or older.dtype != np.float32 or import_h5py().h5o.get_info(older.id).rc > 1:
            raise CFlowError(f"{file}: {name} of sweep {timestamp} is no flow result, it is not replaced")
        older[...] = flow  # in its old place: deleting would leave a hole that HDF5 never gives back
