"""Readers give the time of each point where the format stores it: a drive that rolls comes back with its times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import TinyRecording

from cflow_torch.data.aevascenes import AevaScenesLog
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.data.truckscenes import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.simulator.drive import Drive, make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.simulator.writers.truckscenes import write_truckscenes


@pytest.fixture(scope="module")
def drive():
    scene = make_drive(seed=1, num_sweeps=2, profile="demo").scene
    return Drive(scene, replace(PROFILES["demo"], is_rolling=True), 1, 2, "rolling")


def as_hdf5(drive, folder):
    write_hdf5_scene(drive, folder / "scene.h5")
    return HDF5Log(folder / "scene.h5")


@pytest.mark.parametrize(
    "written",
    [
        lambda drive, folder: AV2Log(write_av2_log(drive, folder)),
        lambda drive, folder: AevaScenesLog(write_aevascenes_sequence(drive, folder)),
        as_hdf5,
    ],
    ids=["av2", "aevascenes", "hdf5"],
)
def test_times_come_back(drive, tmp_path, written):
    log = written(drive, tmp_path)
    for index in range(2):
        times = log.sweep(index).point_times
        assert times.max() > 0.09 and np.abs(times - drive.sweep(index).point_times).max() < 1e-8


def test_times_of_trucks_count_from_the_stamp_of_the_sweep(tmp_path):
    """Also of LiDARs whose own sweeps are stamped otherwise; stored in whole microseconds since 1970."""
    recording = TinyRecording(("LIDAR_RIGHT", "LIDAR_LEFT", "LIDAR_REAR"), origin=(6e5, 5e6, 0.0))
    root = write_truckscenes(recording, tmp_path)
    (source,) = find_truckscenes_scenes(root)
    sweep = TruckScenesLog(source, own_vehicle=None).sweep(2)
    expected = np.concatenate([unit.offset_ns for unit in recording.units(2)]) * 1e-9
    assert np.abs(sweep.point_times - expected).max() < 2e-6 and np.ptp(expected) > 0.01
    assert TruckScenesLog(source, own_vehicle=None, deskew=False).sweep(2).point_times is None
