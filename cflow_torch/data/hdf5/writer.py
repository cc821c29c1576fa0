"""Write OpenSceneFlow's HDF5 scenes: any log, a method's flow, labels for self-supervised training, and index files."""

from __future__ import annotations

import os
import pickle
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping

import numpy as np

from cflow_torch.data.atomic import atomic_file, atomic_name, remove_stale
from cflow_torch.data.boxes import rows_in_box
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.hdf5.reader import (
    EXTRINSIC,
    HDF5Log,
    find_hdf5_scenes,
    import_h5py,
    member,
    open_scene,
    sweep_names,
)
from cflow_torch.data.log import Log
from cflow_torch.types import Array, CFlowError, as_numpy, check_array

LABELS = ("dufo", "cluster", "dufocluster", "nnd")  # keys of labels for self-supervised training
LABELLED = "cflow_labels"  # attribute of a scene: how its labels were made
# Keys of the scenes themselves, and names that have a special meaning in the viewers.
RESERVED_KEYS = {
    *("lidar", "lidar_id", "lidar_dt", "lidar_center", "ground_mask", "pose", "ego_motion", "eval_mask"),
    *("flow", "flow_is_valid", "flow_category_indices", "flow_instance_id"),
    *(*LABELS, "label", "raw", "pc0_dynamic", "pc1_dynamic", "pch1_dynamic"),
    *("pc0", "pc1", "gm0", "gm1", "pose0", "pose1"),
}
_writing = partial(file_errors, hint="pass a complete scene, and free space for a copy of it", doing="write")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


def write_hdf5_log(log: Log, root: Path) -> None:
    """Write a log as the scene `root/<log_id>.h5`, see `write_hdf5_scene`."""
    write_hdf5_scene(log, root / f"{log.log_id}.h5")


def write_hdf5_scene(log: Log, file: str | Path, eval_step: int = 5) -> None:
    """Write a log as one scene in the ego frame: one group per sweep, named by its time stamp.

    Args:
        log: any log with poses; a simulated one also gives lidar_id, lidar_dt, lidar_center and flow_instance_id.
        file: `<scene>.h5`.
        eval_step: sweeps 0, `eval_step`, ... get an `eval_mask` (valid and not ground) if they have labels; 0 = none.

    Convention:
        lidar, flow, ego_motion, lidar_dt, lidar_center are float32, poses float64, masks bool, flow_category_indices
        and lidar_id uint8, flow_instance_id int16. eval_mask is (N, 1). The last sweep has no flow and no ego_motion.
        Arrays are neither chunked nor compressed. The attribute `ego_T_lidar`, which OpenSceneFlow's own files lack, is
        the identity. The file appears complete or not at all.

    Raises:
        CFlowError: h5py is missing, a sweep has no pose, or time stamps are negative or not distinct.
    """
    h5py = import_h5py()
    if len(set(log.timestamps)) < len(log.timestamps) or min(log.timestamps, default=0) < 0:
        raise CFlowError(f"log {log.log_id}: time stamps must be distinct and at least 0, because they name the groups")
    object_ids: dict[str, int] = {}
    with atomic_name(Path(file)) as new, h5py.File(new, "w") as scene:
        scene.attrs[EXTRINSIC] = np.eye(4)
        for index, stamp in enumerate(log.timestamps):
            group = scene.create_group(str(int(stamp)))
            for key, value in _sweep(log, index, eval_step, object_ids).items():
                group.create_dataset(key, data=value)


def write_index_files(folder: str | Path) -> None:
    """Write `index_total.pkl`, `index_flow.pkl` and `index_eval.pkl` for all scenes of a folder.

    Each is OpenSceneFlow's pickled list of [scene, name of the sweep], both strings.
    """
    folder = Path(folder)
    sweeps = []
    for file in (file for file in find_hdf5_scenes(folder) if file.parent == folder):
        with HDF5Log(file, ego_T_lidar=None) as log:
            sweeps += [([log.log_id, log.sweep_name(k)], log.keys(k)) for k in range(len(log))]
    for name, needed in (("total", "lidar"), ("flow", "flow"), ("eval", "eval_mask")):
        with atomic_file(folder / f"index_{name}.pkl") as index:
            pickle.dump([entry for entry, keys in sweeps if needed in keys], index, protocol=4)


def check_result_name(name: str) -> None:
    """Raise a `CFlowError` if a result name is reserved, or is not a letter followed by up to 63 of `A-Za-z0-9_.-`."""
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
            one row per point of the sweep, ground included. We write each before we ask for the next.

    Returns:
        Number of sweeps written.

    Convention:
        The flow is float32, compressed as the points of the sweep are. NaN rows are kept (viewers show them white).
        All results go into a copy next to the scene, which replaces it at the end, unless there is an error. Only one
        process may write into a scene at a time.
    """
    check_result_name(name)
    return _write(file, ((timestamp, {name: as_numpy(flow)}) for timestamp, flow in results), _store_flow)


def write_hdf5_labels(
    file: str | Path,
    labels: Iterable[tuple[int, Mapping[str, np.ndarray]]],
    made_by: str = "",
    overwrite: bool = False,
) -> int:
    """Write labels for self-supervised training into a copy that then replaces the scene. Return the number of sweeps.

    Args:
        file: `<scene>.h5`; every other key keeps its contents.
        labels: (time stamp, {key: (N,) values}) of sweeps. Keys are those of `LABELS`, and `ground_mask`, which we
            write only if the sweep has none. We write each sweep before we ask for the next.
        made_by: description of the method, stored as the attribute `LABELLED` of the scene.
        overwrite: replace existing labels; False = a scene with labels is a `CFlowError`.
    """
    if not overwrite and labelled_by(file) is not None:
        raise CFlowError(f"{file} already has labels: overwrite=true replaces them, or label a copy")
    return _write(file, labels, _store_label, **{LABELLED: made_by})


def labelled_by(file: str | Path) -> str | None:
    """Return how the labels of a scene were made (`made_by`); "" = unknown, None = the scene has no labels."""
    with open_scene(Path(file)) as scene, file_errors(file):
        has_labels = any(set(scene[name]) & set(LABELS) for name in sweep_names(scene).values())
        made_by = scene.attrs.get(LABELLED, "" if has_labels else None)
        return None if made_by is None else str(made_by)


def _sweep(log: Log, index: int, eval_step: int, object_ids: dict[str, int]) -> dict[str, np.ndarray]:
    """Return the keys and values of one group. `object_ids` maps the tracks so far to their ids."""
    sweep, labels = log.sweep(index), log.labels(index)
    if sweep.pose is None:
        raise CFlowError(f"sweep {index} of log {log.log_id} has no pose, which the layout needs")
    points, pose = np.asarray(sweep.points)[:, :3].astype(np.float32), np.asarray(sweep.pose, np.float64)
    values: dict[str, np.ndarray] = {"lidar": points, "pose": pose}
    if sweep.is_ground is not None:
        values["ground_mask"] = np.asarray(sweep.is_ground, bool)
    if index < len(log.timestamps) - 1:
        following = np.asarray(log.sweep(index + 1).pose, np.float64)
        values["ego_motion"] = (np.linalg.inv(following) @ pose).astype(np.float32)
    if labels is not None:
        values["flow"] = labels.flow.astype(np.float32)
        values["flow_is_valid"] = labels.is_valid
        values["flow_category_indices"] = labels.category.astype(np.uint8)
        if eval_step and index % eval_step == 0:
            ground = values.get("ground_mask", np.zeros(len(points), bool))
            values["eval_mask"] = (labels.is_valid & ~ground)[:, None]
    units = log.units(index)
    if units is not None:
        number = np.arange(1, len(units) + 1, dtype=np.uint8)
        values["lidar_id"] = np.repeat(number, [len(unit.points) for unit in units])
        values["lidar_dt"] = np.concatenate([unit.offset_ns / 1e9 for unit in units]).astype(np.float32)
        values["lidar_center"] = np.stack([unit.T_ego_sensor for unit in units]).astype(np.float32)
    boxes = log.boxes(index)
    if boxes is not None:
        instance = np.zeros(len(points), np.int16)  # 0 = in no box
        for track, size, T_ego_box in zip(boxes.track_id, boxes.size, boxes.pose):
            instance[rows_in_box(points, size, T_ego_box)] = object_ids.setdefault(track, len(object_ids) + 1)
        values["flow_instance_id"] = instance
    return values


def _write(file: str | Path, sweeps: Iterable[Any], store: Callable[..., None], **attributes: str) -> int:
    """Store the arrays of sweeps in a copy of a scene, which then replaces it; return the number of sweeps."""
    check_writable(file)
    file = Path(file).resolve()  # a link stays a link
    remove_stale(file.parent)  # copies of writers that were killed
    count = 0
    with atomic_name(file) as copy:
        shutil.copy(file, copy)
        with _writing(file), import_h5py().File(copy, "r+") as scene:
            names = sweep_names(scene)
            for timestamp, arrays in sweeps:
                sweep = member(scene, names.get(int(timestamp), str(timestamp)), file)
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
