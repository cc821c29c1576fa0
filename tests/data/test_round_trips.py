"""A simulated drive comes back from each format: points, poses, ground, times of points, and truth from its boxes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Callable, NamedTuple

import numpy as np
import pytest
from scipy.spatial import cKDTree
from writers.aevascenes import CLASS_OF, write_aevascenes_sequence
from writers.nuscenes import write_nuscenes
from writers.waymo import BOX_TYPE, write_waymo_segment

from cflow_torch.data.aevascenes import CATEGORY_NAME, AevaScenesLog
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.boxes import Boxes, flow_from_boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import window
from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes
from cflow_torch.data.waymo.reader import BOX_CATEGORY, WaymoLog
from cflow_torch.simulator.drive import Drive, make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.transforms import upright_poses


class Format(NamedTuple):
    """How to write and open a log, the largest error of a point in metres, what is stored, and its categories."""

    write_and_open: Callable[[Drive, Path], Any]
    error: float
    has_ground: bool = False
    has_times: bool = False
    category: Callable[[str], str] = str


def as_nuscenes(drive: Drive, folder: Path) -> NuScenesLog:
    (source,) = find_nuscenes_scenes(write_nuscenes(drive, folder, key_frame_interval=0.1))
    return NuScenesLog(source, own_vehicle=None)


def as_aevascenes(drive: Drive, folder: Path, layout: str) -> AevaScenesLog:
    return AevaScenesLog(write_aevascenes_sequence(drive, folder, layout=layout))


def category_of_aeva(name: str) -> str:
    return CATEGORY_NAME[CLASS_OF[name]]


FORMATS = {
    "av2": Format(lambda drive, folder: AV2Log(write_av2_log(drive, folder)), 0.04, False, True),  # float16
    "aevascenes": Format(partial(as_aevascenes, layout="v2"), 1e-4, True, True, category_of_aeva),
    "aevascenes 0.1": Format(partial(as_aevascenes, layout="v0.1"), 1e-4, True, True, category_of_aeva),
    # The float32 rounding of one rotation is 2e-5 m at 200 m.
    "nuscenes": Format(as_nuscenes, 5e-5, category=lambda n: {"BICYCLIST": "BICYCLE", "TRUCK_CAB": "TRUCK"}.get(n, n)),
    "waymo": Format(
        lambda d, folder: WaymoLog(write_waymo_segment(d, folder)), 1e-4, category=lambda n: BOX_CATEGORY[BOX_TYPE[n]]
    ),
}


@pytest.fixture(scope="module")
def drives() -> dict[str, Drive]:
    """Small LiDARs that rotate while the vehicle moves; those of Waymo have a range image, so shots lie on its grid."""
    scene = make_drive(seed=1, num_sweeps=3, profile="demo").scene
    roof, left = (replace(unit, num_columns=200) for unit in PROFILES["waymo"].units[:2])
    waymo = Drive(scene, replace(PROFILES["waymo"], units=(roof, left)), 1, 3, "waymo")
    return {"demo": Drive(scene, replace(PROFILES["demo"], is_rolling=True), 1, 3, "rolling"), "waymo": waymo}


@pytest.mark.parametrize("name", FORMATS)
def test_drives_and_the_truth_of_their_boxes_come_back(name: str, drives: dict[str, Drive], tmp_path: Path) -> None:
    drive, form = drives.get(name, drives["demo"]), FORMATS[name]
    log = form.write_and_open(drive, tmp_path)
    assert log.log_id == drive.log_id and len(log) == 3 and len(window(log, 1, num_history=4).pch) == 1
    for index in range(3):
        sweep, true = log.sweep(index), drive.sweep(index)
        assert sweep.points.dtype == np.float32 and len(sweep.points) == len(true.points)
        distance, row = cKDTree(sweep.points).query(true.points)
        assert distance.max() < form.error and (name == "waymo" or np.array_equal(row, np.arange(len(row))))
        motion = np.linalg.inv(drive.poses[0]) @ drive.poses[index]
        assert np.abs(np.linalg.inv(log.sweep(0).pose) @ sweep.pose - motion).max() < 1e-9
        assert abs(sweep.timestamp_ns - true.timestamp_ns) < 1000
        assert not form.has_ground or np.array_equal(sweep.is_ground, true.is_ground)
        if form.has_times:
            assert sweep.point_times.max() > 0.09 and np.abs(sweep.point_times - true.point_times).max() < 1e-8

    assert log.labels(2) is None
    if name == "av2":  # stores exact flow as well
        return
    tracks = []
    for boxes in (drive.boxes(0), drive.boxes(1)):
        category = [CATEGORY_INDEX[form.category(each)] for each in boxes.names]
        pose = boxes.pose
        if name == "waymo":  # stores headings only
            heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
            pose = upright_poses(np.column_stack([heading, pose[:, :3, 3]]))
        tracks.append(Boxes(boxes.track_id, np.array(category, np.uint8), boxes.size, pose))
    true = flow_from_boxes(log.sweep(0).points, *tracks, np.linalg.inv(drive.poses[1]) @ drive.poses[0])
    labels = log.labels(0)
    same = (labels.category == true.category) & (labels.is_valid == true.is_valid)
    assert same.mean() > 0.9999, "but for points within a rounding of a face"
    assert np.abs(labels.flow - true.flow)[same].max() < 1e-5 and len(np.unique(labels.category)) > 2
