"""AevaScenes: frames with known numbers, pickled strings, broken files."""

from __future__ import annotations

import io
import json
import math
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cflow_torch.data.aevascenes import AevaScenesLog, Cloud
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.types import CFlowError

STAMPS = (1_700_000_000_000_000_000, 1_700_000_000_100_000_000, 1_700_000_000_200_000_000)


def pose(yaw: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, Any]:
    rotation = {"w": math.cos(yaw / 2), "x": 0.0, "y": 0.0, "z": math.sin(yaw / 2)}
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": rotation}


def box(track: str, kind: str, x: float) -> dict[str, Any]:
    size = {"x": 4.0, "y": 2.0, "z": 2.0}
    return {"id": track, "class": kind, "reference_frame": "VEHICLE", "dimensions": size, "pose": pose(x=x)}


def save(file: Path, **arrays: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, **arrays)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames, two LiDARs; version 2 with both clouds."""
    folder, frames = tmp_path / "seq", []
    for i, stamp in enumerate(STAMPS):
        clouds: dict[str, Any] = {}
        for lidar in ("left_lidar", "rear_lidar"):
            clouds[lidar] = {}
            for kind, shift in (("compensated", 0.0), ("raw", 0.5)):
                path = f"pointcloud_{kind}/{lidar}_{stamp}.npz"
                xyz = np.array([[1, 0, 0], [10, 0, 0]], np.float32) + np.float32(shift)
                names = np.array([["road"], ["car"]], dtype=object)
                save(folder / path, xyz=xyz, velocity=np.array([[1.5], [-2]], np.float32), semantic_labels=names)
                clouds[lidar][f"point_cloud_{kind}_path"] = path
        boxes = [box("a", "car", 2.0 + i), box("b", "pole_trunk", 2 - i)]
        frames.append({"timestamp_ns": stamp, "ego_pose": pose(x=float(i)), "point_cloud": clouds, "boxes": boxes})
    mounts = {"left_lidar": pose(math.pi / 2, y=1.0), "rear_lidar": pose(math.pi, x=-1.0, z=2.0)}
    metadata = {"sequence_uuid": "x", "sensors": {"lidars": list(mounts)}, "vehicle_to_lidar_extrinsics": mounts}
    text = json.dumps({"metadata": metadata, "frames": [frames[1], frames[0], frames[2]]})  # in no order
    (folder / "sequence.json").write_text(text)
    return folder


def edit(folder: Path, change: Any) -> None:
    """Change the parsed content of sequence.json; frames[1] is the first in time."""
    content = json.loads((folder / "sequence.json").read_text())
    change(content)
    (folder / "sequence.json").write_text(json.dumps(content))


def test_lidars_are_mounted_and_merged(folder: Path) -> None:
    log = AevaScenesLog(folder)
    assert (log.log_id, tuple(log.timestamps), log.lidars) == ("seq", STAMPS, ("left_lidar", "rear_lidar"))
    sweep = log.sweep(1)
    # The left LiDAR points along +y from (0, 1, 0), the rear one along -x from (-1, 0, 2).
    np.testing.assert_allclose(sweep.points, [[0, 2, 0], [0, 11, 0], [-2, 0, 2], [-11, 0, 2]], atol=1e-6)
    assert sweep.points.dtype == np.float32 and sweep.timestamp_ns == STAMPS[1]
    assert sweep.is_ground.tolist() == [True, False, True, False]
    np.testing.assert_array_equal(sweep.pose[:3, 3], [1, 0, 0])
    np.testing.assert_array_equal(log.radial_velocity(1), np.float32([1.5, -2, 1.5, -2]))
    rear = AevaScenesLog(folder, lidars=("rear_lidar",), clouds="raw", ground=False).sweep(1)
    np.testing.assert_allclose(rear.points, [[-2.5, -0.5, 2.5], [-11.5, -0.5, 2.5]], atol=1e-6)
    assert rear.is_ground is None


def test_boxes_become_flow(folder: Path) -> None:
    """In the vehicle frame, the box of the car moves 1 m forward and the world 1 m back; poles are static."""
    for lidar in ("left_lidar", "rear_lidar"):
        file = folder / "pointcloud_compensated" / f"{lidar}_{STAMPS[0]}.npz"
        save(file, xyz=np.array([[0, -1e-3, 0], [0, -2.5, 0.0]], np.float32), velocity=np.zeros((2, 1), np.float32))
    labels = AevaScenesLog(folder).labels(0)
    # Vehicle frame: left (0.001, 1, 0), (2.5, 1, 0); rear (-1, 0.001, 2), (-1, 2.5, 2). The car is at x = 0 to 4.
    np.testing.assert_array_equal(labels.category, [19, 19, 0, 0])
    np.testing.assert_allclose(labels.flow, [[1, 0, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0]], atol=1e-6)
    assert labels.is_valid.all() and AevaScenesLog(folder).labels(2) is None
    assert AevaScenesLog(folder).sweep(0).is_ground is None  # these clouds have no class names
    edit(folder, lambda content: content["frames"][1].update(boxes=[box("c", "bicyclist", 0.0)]))
    labels = AevaScenesLog(folder).labels(0)  # a track that ends
    assert labels.category.tolist() == [CATEGORY_INDEX["BICYCLIST"], 0, 0, 0] and not labels.is_valid[0]
    edit(folder, lambda content: [frame.update(boxes=None) for frame in content["frames"]])
    assert AevaScenesLog(folder).labels(0) is None


def npz_with_pickle(file: Path, pickled: bytes) -> Path:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": (2, 1)})
    save(file, xyz=np.zeros((2, 3)))
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("semantic_labels.npy", header.getvalue() + pickled)
    return file


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_class_names_of_every_pickle_protocol_are_read(tmp_path: Path, protocol: int) -> None:
    names = np.array([["car"], ["Straße"]], dtype=object)
    scalars = np.array([[np.str_("car")], [np.str_("Straße")]], dtype=object)
    for array in (names, np.asfortranarray(names), scalars):
        file = npz_with_pickle(tmp_path / "a.npz", pickle.dumps(array, protocol=protocol))
        assert Cloud(file).column("semantic_labels", np.str_).tolist() == ["car", "Straße"]
    save(tmp_path / "b.npz", xyz=np.zeros((2, 3)), semantic_labels=np.array([["car"], ["road"]]))
    assert Cloud(tmp_path / "b.npz").column("semantic_labels", np.str_).tolist() == ["car", "road"]


def test_times_with_fractions_are_an_error(tmp_path: Path) -> None:
    save(tmp_path / "a.npz", xyz=np.zeros((3, 3)), time_offset_ns=np.full(3, 0.5))
    with pytest.raises(CFlowError, match="a.npz: time_offset_ns.*Cannot cast"):
        Cloud(tmp_path / "a.npz").column("time_offset_ns", np.int64)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda file: file.unlink(), "is missing; copy"),
        (lambda file: save(file, points=np.zeros((3, 3))), "xyz is not a file in the archive"),
        (lambda file: save(file, xyz=np.zeros((3, 2))), r"xyz has shape \(3, 2\)"),
        (lambda file: save(file, xyz=np.zeros((3, 3), int)), "xyz has dtype int64"),
        (lambda file: save(file, xyz=np.zeros((3, 3)), semantic_labels=np.full(4, "car")), "cannot reshape"),
    ],
)
def test_a_bad_cloud_costs_one_sweep(folder: Path, damage: Any, message: str) -> None:
    log, file = AevaScenesLog(folder), folder / "pointcloud_compensated" / f"left_lidar_{STAMPS[0]}.npz"
    damage(file)
    with pytest.raises(CFlowError, match=message) as error:
        log.sweep(0)
    assert file.name in str(error.value) and len(log.sweep(1).points) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.clear(), "'metadata'"),
        (lambda c: c["frames"][1].update(timestamp_ns="noon"), "cannot read .*TypeError"),
        (lambda c: c["frames"][1]["ego_pose"]["rotation"].update(w=3.0), "not a rigid motion"),
        (lambda c: c["frames"][1]["point_cloud"]["left_lidar"].clear(), "no compensated cloud.*version 2"),
        (lambda c: c["frames"][1]["boxes"][0].update(reference_frame="WORLD"), "must be in VEHICLE, got .*WORLD"),
        (lambda c: c["frames"][1].update(boxes=[box("a", "car", 0.0)] * 2), "only one box per sweep"),
    ],
)
def test_a_bad_sequence_is_refused(folder: Path, change: Any, message: str) -> None:
    edit(folder, change)
    with pytest.raises(CFlowError, match=message) as error:
        AevaScenesLog(folder).labels(0)
    assert "sequence.json" in str(error.value)
