"""Write any log as a scene in OpenSceneFlow's HDF5 layout, and the index files next to the scenes."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from cflow_torch.data.atomic import atomic_file, atomic_name
from cflow_torch.data.boxes import points_in_box
from cflow_torch.data.hdf5.reader import EXTRINSIC, HDF5Log, find_hdf5_scenes, import_h5py
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError


def write_hdf5_scene(log: Log, file: str | Path, eval_step: int = 5) -> None:
    """Write a log as one scene in the ego frame: one group per sweep, named by its time stamp.

    Args:
        log: any log with poses; a `Recording` also provides lidar_id, lidar_dt, lidar_center and flow_instance_id.
        file: `<scene>.h5`.
        eval_step: every how many labelled sweeps get an `eval_mask` (valid and not ground); 0 = none.

    Convention:
        lidar, flow, ego_motion, lidar_dt, lidar_center are float32, poses float64, masks bool, flow_category_indices
        and lidar_id uint8, flow_instance_id int16. eval_mask is (N, 1). The last sweep has no flow and no ego_motion.
        Arrays are neither chunked nor compressed. The attribute `ego_T_lidar`, which the harness's own files lack, is
        the identity. The file appears complete or not at all.

    Raises:
        CFlowError: h5py is missing, a sweep has no pose, or time stamps are not distinct numbers.
    """
    h5py = import_h5py()
    if len(set(log.timestamps)) < len(log.timestamps) or min(log.timestamps, default=0) < 0:
        raise CFlowError(f"log {log.log_id}: time stamps must be distinct and at least 0, because they name the groups")
    identity: dict[str, int] = {}
    with atomic_name(Path(file)) as new, h5py.File(new, "w") as scene:
        scene.attrs[EXTRINSIC] = np.eye(4)
        for index, stamp in enumerate(log.timestamps):
            group = scene.create_group(str(int(stamp)))
            for key, value in _sweep(log, index, eval_step, identity).items():
                group.create_dataset(key, data=value)


def write_index_files(folder: str | Path) -> None:
    """Write `index_total.pkl`, `index_flow.pkl` and `index_eval.pkl` for all scenes of a folder.

    Each is OpenSceneFlow's pickled list of [scene, time stamp], both strings.
    """
    folder = Path(folder)
    total, flow, scored = [], [], []
    for file in find_hdf5_scenes(folder):
        with HDF5Log(file, ego_T_lidar=None) as log:
            keys = [log.keys(k) for k in range(len(log.timestamps))]
            for stamp, names in zip(log.timestamps, keys):
                entry = [log.log_id, str(stamp)]
                total.append(entry)
                flow += [entry] * ("flow" in names)
                scored += [entry] * ("eval_mask" in names)
    for name, entries in (("total", total), ("flow", flow), ("eval", scored)):
        with atomic_file(folder / f"index_{name}.pkl") as index:
            pickle.dump(entries, index, protocol=4)


def _sweep(log: Log, index: int, eval_step: int, identity: dict[str, int]) -> dict[str, np.ndarray]:
    """Return the keys and values of one group. `identity` holds the object ids of the tracks so far."""
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
    if hasattr(log, "units"):
        units = log.units(index)
        number = np.arange(1, len(units) + 1, dtype=np.uint8)
        values["lidar_id"] = np.repeat(number, [len(unit.points) for unit in units])
        values["lidar_dt"] = np.concatenate([unit.offset_ns / 1e9 for unit in units]).astype(np.float32)
        values["lidar_center"] = np.stack([unit.T_ego_sensor for unit in units]).astype(np.float32)
    if hasattr(log, "boxes"):
        boxes, instance = log.boxes(index), np.zeros(len(points), np.int16)  # 0 = in no box
        for track, size, T_ego_box in zip(boxes.track_id, boxes.size, boxes.pose):
            instance[points_in_box(points, size, T_ego_box)] = identity.setdefault(track, len(identity) + 1)
        values["flow_instance_id"] = instance
    return values
