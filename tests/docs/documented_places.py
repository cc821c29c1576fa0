"""Tiny simulated data in place of the paths that the documents name, and the names that their Python blocks use."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any, Callable, Dict, Union

import numpy as np
import pyarrow as pa
from pyarrow import feather
from test_waymo import GridRecording
from tiny_recording import TinyRecording

from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.evaluation.submission import get_version, plan_log
from cflow_torch.simulator import Drive, make_drive
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.simulator.writers.truckscenes import write_truckscenes
from cflow_torch.simulator.writers.waymo import write_waymo_segment

NUM_SWEEPS = 5


def tiny_drive(seed: int = 3, num_sweeps: int = NUM_SWEEPS) -> Drive:
    """28,800 rays a sweep."""
    return make_drive(seed=seed, num_sweeps=num_sweeps, profile="demo")


def _av2(folder: Path) -> Path:
    write_av2_log(tiny_drive(), folder)
    return folder


def _hdf5(folder: Path) -> Path:
    from cflow_torch.data.hdf5.writer import write_hdf5_scene, write_index_files

    drive = tiny_drive(num_sweeps=6)
    write_hdf5_scene(drive, folder / f"{drive.log_id}.h5")
    write_index_files(folder)
    return folder


def _arrays(folder: Path) -> Path:
    return write_array_log(tiny_drive(num_sweeps=7), folder, ".npz")


def _masks(file: Path) -> Path:
    """The official masks of version 1 for the log in /data/av2/test: a zip of one bool column per frame."""
    log = AV2Log(write_av2_log(tiny_drive(), file.parent / "masked"))
    with zipfile.ZipFile(file, "w") as archive:
        for planned in plan_log(log, get_version(1)):
            sink = pa.BufferOutputStream()
            mask = np.arange(len(log.sweep(planned.index).points)) % 3 == 0
            feather.write_feather(pa.table({"mask": pa.array(mask)}), sink)
            archive.writestr(f"{log.log_id}/{log.timestamps[planned.index]}.feather", sink.getvalue().to_pybytes())
    return file


def _nuscenes(folder: Path) -> Path:
    write_nuscenes(tiny_drive(), folder)
    return folder


def _long_nuscenes(folder: Path) -> Path:
    write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=24), folder)
    return folder


def _long_waymo(folder: Path) -> Path:
    recording = GridRecording()
    recording.timestamps = tuple(recording.timestamps[0] + i * 100_000_000 for i in range(12))
    recording.poses = np.stack([recording.ego(0.1 * i) for i in range(12)])
    write_waymo_segment(recording, folder)
    return folder


def _written(write: Callable[..., Any], num_sweeps: int = NUM_SWEEPS) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(tiny_drive(num_sweeps=num_sweeps), folder)
        return folder

    return make


# What a document names -> what is put in its place; text: what another name has. An address of an object store becomes
# one of the local files.
PLACES: Dict[str, Union[str, Callable[[Path], Path]]] = {
    "/data/av2/val": _av2,
    "/data/av2/train": "/data/av2/val",
    "/data/av2/test": "/data/av2/val",
    "/data/av2/test-masks.zip": _masks,
    "s3://bucket/av2/val": "/data/av2/val",
    "s3://bucket/val": "/data/av2/val",
    "s3://bucket/flow": lambda folder: folder,
    "LOG": lambda folder: write_av2_log(tiny_drive(), folder),
    "/data/av2/val/LOG": "LOG",
    "/data/scenes": _hdf5,
    "/data/test": "/data/scenes",
    "/data/challenge_public/test": "/data/scenes",
    "/data/waymo": "/data/scenes",
    "KITTI_0000": "/data/scenes",
    "simulated/val": "/data/scenes",
    "simulated/test": "/data/scenes",
    "DIR": _hdf5,  # is written to
    "/data/nuscenes": _nuscenes,
    "/data/truckscenes": _written(write_truckscenes),
    "/data/aevascenes": _written(write_aevascenes_sequence),
    "/data/my_drive": _arrays,
    "my_drive": "/data/my_drive",
    "/scratch": lambda folder: folder,
    "CACHE": lambda folder: folder,
}
# Names relative to the reader's folder, in Python blocks.
LINKS: Dict[str, Callable[[Path], Path]] = {
    "my_drive": _arrays,
    "nuscenes": _long_nuscenes,
    "waymo/validation": _long_waymo,
    "scene.h5": lambda folder: next(_hdf5(folder).glob("*.h5")),
}


class Places:
    """Makes each place once, when it is first named."""

    def __init__(self, root: Path) -> None:
        self.root, self._made = root, {}  # type: Path, Dict[str, Path]

    def __getitem__(self, name: str) -> Path:
        make = PLACES.get(name) or LINKS[name]
        if isinstance(make, str):
            return self[make]
        if name not in self._made:
            folder = self.root / re.sub(r"\W+", "_", name.rpartition(".")[0] or name) / Path(name).name
            folder.parent.mkdir(parents=True, exist_ok=True)
            self._made[name] = make(folder)
        return self._made[name]

    def fill(self, text: str, relative: bool = True) -> str:
        """`text` with every placeholder replaced by a place that exists; those like LOG only if `relative`."""
        chosen = (name for name in PLACES if relative or name.startswith(("/", "s3:")))
        names = "|".join(re.escape(name) for name in sorted(chosen, key=len, reverse=True))

        def place(match: re.Match[str]) -> str:
            path = self[match[0]]
            return path.as_uri() if match[0].startswith("s3:") else str(path)

        return re.sub(rf"(?<![\w/.-])(?:{names})(?![\w.-])", place, text)

    def link(self, folder: Path, text: str) -> None:
        """Puts what `text` opens by relative names into `folder`."""
        for name in (name for name in LINKS if f'"{name}"' in text):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(self[name])


def namespace() -> Dict[str, Any]:
    """The names that the documents' Python blocks take as given."""
    import cflow_torch
    from cflow_torch.data.arrays import ArraysLog
    from cflow_torch.data.hdf5 import HDF5Log
    from cflow_torch.evaluation import SceneFlowMetrics
    from cflow_torch.evaluation.frame import EvalFrame
    from cflow_torch.evaluation.protocol import CHALLENGE_DATA_SETS
    from cflow_torch.windows.ego_motion import relative_transform
    from cflow_torch.windows.ground import find_ground, find_ground_batch

    drive = tiny_drive(num_sweeps=6)
    pair, labels = window(drive, 1, 1), drive.labels(1)
    pc0, pc1 = pair.pc0, pair.pc1
    T = relative_transform(pc0.pose, pc1.pose)
    result = cflow_torch.CorrelationFlow.from_preset("default")([pair])[0]
    metrics = SceneFlowMetrics("challenge_2026")
    metrics.update(EvalFrame.from_result(pair, result, labels))
    return {
        **{name: getattr(cflow_torch, name) for name in cflow_torch.__all__},
        "np": np,
        "ArraysLog": ArraysLog,
        "HDF5Log": HDF5Log,
        "find_ground": find_ground,
        "find_ground_batch": find_ground_batch,
        "window": pair,
        "result": result,
        "pc0": pc0.points,
        "pc1": pc1.points,
        "gm0": pc0.is_ground,
        "gm1": pc1.is_ground,
        "ground0": pc0.is_ground,
        "ground1": pc1.is_ground,
        "pose0": pc0.pose,
        "pose1": pc1.pose,
        "T_ego1_ego0": T,
        "T": np.eye(4),
        "points": pc0.points,
        "points0": pc0.points,
        "points1": pc1.points,
        "points2": pc1.points,
        "log": drive,
        "offset_ns": np.zeros(3),
        "frames": [(pc0.points, labels, result.numpy()["flow"], T, pc0.is_ground)],
        "scored": dict.fromkeys(CHALLENGE_DATA_SETS, metrics),
    }
