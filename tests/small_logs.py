"""Write a small log of each data set."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from tiny_recording import TinyRecording
from writers.aevascenes import write_aevascenes_sequence
from writers.nuscenes import write_nuscenes
from writers.truckscenes import write_truckscenes
from writers.waymo import write_waymo_segment

from cflow_torch.data.arrays import write_array_log
from cflow_torch.simulator import Drive, make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.writers.av2 import write_av2_log

SMALL_LOGS = ("av2", "aevascenes", "arrays", "bags", "hdf5", "nuscenes", "truckscenes", "waymo")


class SmallDrive(Drive):
    """A drive that keeps the returns of its sweeps, which do not depend on how many sweeps it has."""

    def _scan(self, index: int) -> Any:
        key = self._seed, index
        if key not in _RETURNS:
            _RETURNS[key] = super()._scan(index)
        return _RETURNS[key]


_RETURNS: dict[tuple[int, int], Any] = {}  # of the small drives, by seed and sweep


@lru_cache(maxsize=None)
def make_small_drive(num_sweeps: int, seed: int = 3) -> Drive:
    """A street that many tests write, with half of the columns of the profile demo."""
    (unit,) = PROFILES["demo"].units
    profile = replace(PROFILES["demo"], units=(replace(unit, num_columns=unit.num_columns // 2),))
    return SmallDrive(make_drive(seed, 1, "demo").scene, profile, seed, num_sweeps, f"synthetic-demo-{seed:04d}")


def write_small_log(name: str, folder: Path) -> Path:
    """Write three sweeps or more and return the folder."""
    drive = make_small_drive(num_sweeps=3)
    if name == "av2":
        write_av2_log(drive, folder)
    elif name == "aevascenes":
        write_aevascenes_sequence(TinyRecording(("front", "rear"), num_sweeps=3), folder)
    elif name == "arrays":
        write_array_log(drive, folder, ".npz")
    elif name == "bags":
        pytest.importorskip("rosbags")
        from bag_writer import write_bag

        folder.mkdir()
        write_bag(folder, "mcap", TinyRecording(("velodyne",), num_sweeps=3))
    elif name == "hdf5":
        pytest.importorskip("h5py")
        from cflow_torch.data.hdf5.writer import write_hdf5_scene, write_index_files

        write_hdf5_scene(drive, folder / f"{drive.log_id}.h5")
        write_index_files(folder)
    elif name == "nuscenes":
        write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=3), folder)
    elif name == "truckscenes":
        write_truckscenes(TinyRecording(("LIDAR_LEFT", "LIDAR_RIGHT"), num_sweeps=3), folder)
    else:
        roof = replace(PROFILES["waymo"].units[0], num_columns=265)
        write_waymo_segment(Drive(drive.scene, replace(PROFILES["waymo"], units=(roof,)), 3, 2, "small"), folder)
    return folder
