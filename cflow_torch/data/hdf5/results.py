"""Write into OpenSceneFlow's HDF5 scenes: a method's flow, and labels for self-supervised training."""

from __future__ import annotations

import os
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping

import numpy as np

from cflow_torch.data.atomic import atomic_name
from cflow_torch.data.files import file_errors
from cflow_torch.data.hdf5.reader import import_h5py, member, open_scene
from cflow_torch.data.paths import is_timestamp
from cflow_torch.types import Array, CFlowError, as_numpy, check_array

LABELS = ("dufo", "cluster", "dufocluster", "nnd")  # keys of labels for self-supervised training
LABELLED = "cflow_labels"  # attribute of a scene that has ours
# Keys of the scenes themselves, and names that have a special meaning in the viewers.
RESERVED_KEYS = {
    *("lidar", "lidar_id", "lidar_dt", "lidar_center", "ground_mask", "pose", "ego_motion", "eval_mask"),
    *("flow", "flow_is_valid", "flow_category_indices", "flow_instance_id"),
    *(*LABELS, "label", "raw", "pc0_dynamic", "pc1_dynamic", "pch1_dynamic"),
    *("pc0", "pc1", "gm0", "gm1", "pose0", "pose1"),
}
_writing = partial(file_errors, hint="pass a complete scene, and free space for a copy of it", doing="write")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


def check_result_name(name: str) -> None:
    """Raise a `CFlowError` for a result name that is taken or that a viewer's command line cannot carry."""
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise CFlowError(f"{name!r} is not a result name: use up to 64 letters, digits, '_', '-', '.', a letter first")
    if name in RESERVED_KEYS:
        raise CFlowError(f"{name} is a key of the scenes themselves; choose another name, for example cflow")


def check_writable(file: str | Path) -> None:
    """Raise a `CFlowError` if a scene does not exist, or if it or its folder is read-only."""
    file = Path(file).resolve()
    if not file.is_file():
        raise CFlowError(f"{file} does not exist; pass a scene (.h5)")
    # Check the mode, too: the superuser may write everything, but a file marked read-only must not be changed.
    if not file.stat().st_mode & 0o222 or not os.access(file, os.W_OK) or not os.access(file.parent, os.W_OK):
        raise CFlowError(f"{file} or its folder is read-only: copy the scene, or make it writable")


def write_hdf5_results(file: str | Path, name: str, results: Iterable[tuple[int, Array]]) -> int:
    """Write the total flow of sweeps into a scene under a result name.

    Args:
        file: `<scene>.h5`; every other key keeps its contents.
        name: name of the result; we replace a result of the same name.
        results: pairs of the time stamp of sweep t and the (N, 3) TOTAL flow, metres per sweep interval, axes of ego1,
            one row per point of the sweep, ground included; consumed one by one.

    Returns:
        Number of sweeps written.

    Convention:
        The flow is float32, compressed as the points of the sweep are. NaN rows are kept (viewers show them white).
        All results go into a copy next to the file, which replaces it at the end, so the scene is always the old or the
        new one. Readers that have it open continue with the old one. Only one process may write into a scene at a time.

    Raises:
        CFlowError: the name, the scene or a result cannot be used. The scene is then unchanged.

    Cost: one copy of the scene, in time and, until the end, in space.
    """
    check_result_name(name)
    return _write(file, ((timestamp, {name: as_numpy(flow)}) for timestamp, flow in results), _store_flow)


def write_hdf5_labels(
    file: str | Path,
    labels: Iterable[tuple[int, Mapping[str, np.ndarray]]],
    made_by: str = "",
    overwrite: bool = False,
) -> int:
    """Write labels for self-supervised training into a copy of a scene, which replaces it. Return the number of sweeps.

    Args:
        file: `<scene>.h5`; every other key keeps its contents.
        labels: (time stamp, {key: (N,) values}) of sweeps, keys of `LABELS` and `ground_mask`, which is only written
            if the sweep has none; consumed one by one.
        made_by: description of the method, stored as the attribute `LABELLED` of the scene.
        overwrite: replace existing labels; if it is False, a scene with labels is a `CFlowError`.
    """
    if not overwrite and labelled_by(file) is not None:
        raise CFlowError(f"{file} already has labels: overwrite=true replaces them, or label a copy")
    return _write(file, labels, _store_label, **{LABELLED: made_by})


def labelled_by(file: str | Path) -> str | None:
    """Return the method that made the labels of a scene; "" = unknown, None = the scene has no labels."""
    with open_scene(Path(file)) as scene, file_errors(file):
        has_labels = any(set(scene[stamp]) & set(LABELS) for stamp in scene if is_timestamp(stamp))
        made_by = scene.attrs.get(LABELLED, "" if has_labels else None)
        return None if made_by is None else str(made_by)


def _write(file: str | Path, sweeps: Iterable[Any], store: Callable[..., None], **attributes: str) -> int:
    """Store the arrays of sweeps in a copy of a scene, which then replaces it; return the number of sweeps."""
    check_writable(file)
    file = Path(file).resolve()  # a link stays a link
    for left in file.parent.glob(f".{file.name}.*.tmp"):  # copies of writers that were killed
        left.unlink()
    count = 0
    with atomic_name(file) as copy:
        shutil.copy(file, copy)
        with _writing(file), import_h5py().File(copy, "r+") as scene:
            for timestamp, arrays in sweeps:
                sweep = member(scene, str(timestamp), file)
                points = None if sweep is None else member(sweep, "lidar", f"{file}: sweep {timestamp}")
                if points is None:
                    raise CFlowError(f"{file} has no sweep {timestamp}")
                for key, values in arrays.items():
                    with _writing(f"{file}: {key} of sweep {timestamp}"):
                        store(sweep, key, member(sweep, key, file), values)
                count += 1
            scene.attrs.update(attributes)
    return count


def _store_flow(sweep: Any, name: str, older: Any, flow: np.ndarray) -> None:
    check_array(flow, name, (len(sweep["lidar"]), 3), "f", f"({len(sweep['lidar'])}, 3) floats")
    if older is not None and (older.shape, older.dtype) != (flow.shape, np.float32):
        raise CFlowError(f"{name} is not a flow result, so it is not replaced")
    _store(sweep, name, older, flow.astype(np.float32))


def _store_label(sweep: Any, key: str, older: Any, values: np.ndarray) -> None:
    check_array(values, key, (len(sweep["lidar"]),), "biuf", f"({len(sweep['lidar'])},) numbers")
    if older is not None and key not in LABELS:
        return
    if older is not None and (older.shape, older.dtype) != (values.shape, values.dtype):
        del sweep[key]
        older = None
    _store(sweep, key, older, values)


def _store(sweep: Any, key: str, older: Any, values: np.ndarray) -> None:
    if older is not None:
        older[...] = values  # in place, because HDF5 never frees the space of a deleted dataset
        return
    points = sweep["lidar"]
    filters = {name: getattr(points, name) for name in ("compression", "compression_opts", "shuffle")}
    sweep.create_dataset(key, data=values, **(filters if points.compression and len(values) else {}))
