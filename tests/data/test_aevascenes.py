"""AevaScenes: round trips of simulated drives in both layouts, frames by hand, pickled strings, broken files."""

from __future__ import annotations

import io
import json
import math
import os
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest

from cflow_torch.data.aevascenes.npz_strings import read_npz_member
from cflow_torch.data.aevascenes.reader import CATEGORY_NAME, GROUND, AevaScenesLog, find_aevascenes_sequences
from cflow_torch.data.boxes import Boxes as Tracks
from cflow_torch.data.boxes import flow_from_boxes
from cflow_torch.data.log import window
from cflow_torch.data.categories import CATEGORIES, CATEGORY_INDEX, meta_class
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.simulator.writers import aevascenes as aevascenes_writer
from cflow_torch.simulator.writers.aevascenes import CLASS_OF, write_aevascenes_sequence
from cflow_torch.types import CFlowError

STAMPS = (1_700_000_000_000_000_000, 1_700_000_000_100_000_000, 1_700_000_000_200_000_000)


@pytest.fixture(scope="module")
def drive() -> Any:
    return make_drive(seed=3, num_sweeps=3, profile="demo")


@pytest.fixture(scope="module")
def written(drive: Any, tmp_path_factory: Any) -> Path:
    return write_aevascenes_sequence(drive, tmp_path_factory.mktemp("aeva") / "train")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(written, tmp_path / written.name))


def pose(yaw: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Dict[str, Any]:
    rotation = {"w": math.cos(yaw / 2), "x": 0.0, "y": 0.0, "z": math.sin(yaw / 2)}
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": rotation}


def box(track: str, kind: str, x: float) -> Dict[str, Any]:
    size = {"x": 4.0, "y": 2.0, "z": 2.0}
    return {"id": track, "class": kind, "reference_frame": "VEHICLE", "dimensions": size, "pose": pose(x=x)}


def write_small(folder: Path, **changes: Any) -> Path:
    """Three frames, two LiDARs; version 2 with both clouds. `changes` replace parts of the first frame."""
    frames = []
    for i, stamp in enumerate(STAMPS):
        clouds: Dict[str, Any] = {}
        for lidar in ("left_lidar", "rear_lidar"):
            clouds[lidar] = {}
            for kind, shift in (("compensated", 0.0), ("raw", 0.5)):
                path = f"pointcloud_{kind}/{lidar}_{stamp}.npz"
                xyz = np.array([[1, 0, 0], [10, 0, 0]], np.float32) + np.float32(shift)
                save(folder / path, xyz=xyz, velocity=np.array([[1.5], [-2]], np.float32),
                     semantic_labels=np.array([["road"], ["car"]], dtype=object))  # fmt: skip
                clouds[lidar][f"point_cloud_{kind}_path"] = path
        boxes = [box("a", "car", 2.0 + i), box("b", "pole_trunk", 2 - i)]
        frames.append({"timestamp_ns": stamp, "ego_pose": pose(x=float(i)), "point_cloud": clouds, "boxes": boxes})
    frames[0].update(changes)
    mounts = {"left_lidar": pose(math.pi / 2, y=1.0), "rear_lidar": pose(math.pi, x=-1.0, z=2.0)}
    metadata = {"sequence_uuid": "x", "sensors": {"lidars": list(mounts)}, "vehicle_to_lidar_extrinsics": mounts}
    text = json.dumps({"metadata": metadata, "frames": [frames[1], frames[0], frames[2]]})  # in no order
    (folder / "sequence.json").write_text(text)
    return folder


def save(file: Path, **arrays: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, **arrays)


# ---------------------------------------------------------------------------------------------- frames by hand


def test_frames_by_hand(tmp_path: Path) -> None:
    log = AevaScenesLog(write_small(tmp_path / "seq"))
    assert (log.log_id, tuple(log.timestamps), log.lidars) == ("seq", STAMPS, ("left_lidar", "rear_lidar"))
    sweep = log.sweep(1)
    # The left one looks along +y from (0, 1, 0), the rear one along -x from (-1, 0, 2).
    np.testing.assert_allclose(sweep.points, [[0, 2, 0], [0, 11, 0], [-2, 0, 2], [-11, 0, 2]], atol=1e-6)
    assert sweep.points.dtype == np.float32 and sweep.timestamp_ns == STAMPS[1]
    assert sweep.is_ground.tolist() == [True, False, True, False]
    np.testing.assert_array_equal(sweep.pose[:3, 3], [1, 0, 0])
    np.testing.assert_array_equal(log.radial_velocity(1), np.float32([1.5, -2, 1.5, -2]))
    rear = AevaScenesLog(tmp_path / "seq", lidars=("rear_lidar",), clouds="raw", ground=False).sweep(1)
    np.testing.assert_allclose(rear.points, [[-2.5, -0.5, 2.5], [-11.5, -0.5, 2.5]], atol=1e-6)
    assert rear.is_ground is None


def test_truth_by_hand(tmp_path: Path) -> None:
    """The box of the car moves 1 m ahead in the vehicle's frame, the world 1 m back; a pole never moves."""
    folder = write_small(tmp_path / "seq")
    for lidar in ("left_lidar", "rear_lidar"):
        file = folder / "pointcloud_compensated" / f"{lidar}_{STAMPS[0]}.npz"
        save(file, xyz=np.array([[0, 0, 0], [0, -2.5, 0.0]], np.float32), velocity=np.zeros((2, 1), np.float32))
    labels = AevaScenesLog(folder).labels(0)
    # Vehicle frame: left (0, 1, 0), (2.5, 1, 0); rear (-1, 0, 2), (-1, 2.5, 2). The car reaches from x = 0 to 4.
    np.testing.assert_array_equal(labels.category, [19, 19, 0, 0])
    np.testing.assert_allclose(labels.flow, [[1, 0, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0]], atol=1e-6)
    assert labels.is_valid.all()
    assert AevaScenesLog(folder).sweep(0).is_ground is None  # these clouds have no class names
    assert AevaScenesLog(folder).labels(2) is None


def test_a_track_that_ends_is_not_valid(tmp_path: Path) -> None:
    log = AevaScenesLog(write_small(tmp_path / "seq", boxes=[box("c", "bicyclist", 0.0), box("p", "animal", -9.0)]))
    labels = log.labels(0)
    assert labels.category.tolist() == [CATEGORY_INDEX["BICYCLIST"] * (abs(y) <= 1.1) for y in (2, 11, 99, 99)]
    labels = AevaScenesLog(write_small(tmp_path / "other", boxes=[box("c", "bicyclist", -2.0)])).labels(0)
    assert labels.category.tolist() == [0, 0, 0, 0]


def test_sequences_without_boxes_have_no_truth(tmp_path: Path) -> None:
    folder = write_small(tmp_path / "seq")
    content = json.loads((folder / "sequence.json").read_text())
    for frame, boxes in zip(content["frames"], ([], None, [])):
        frame["boxes"] = boxes
    del content["frames"][0]["boxes"]
    (folder / "sequence.json").write_text(json.dumps(content))
    assert AevaScenesLog(folder).labels(0) is None


# ---------------------------------------------------------------------------------------------- round trips


def truth(drive: Any, index: int) -> Any:
    """By the drive's own boxes, named as the format names them."""
    tracks = []
    for boxes in (drive.boxes(index), drive.boxes(index + 1)):
        names = [CATEGORY_NAME[CLASS_OF[name]] for name in boxes.category]
        category = np.array([CATEGORY_INDEX[name] for name in names], np.uint8)
        tracks.append(Tracks(boxes.track_id, category, boxes.size, boxes.pose))
    T_ego1_ego0 = np.linalg.inv(drive.poses[index + 1]) @ drive.poses[index]
    return flow_from_boxes(drive.sweep(index).points, tracks[0], tracks[1], T_ego1_ego0)


@pytest.mark.parametrize(("profile", "layout"), [("demo", "v2"), ("demo", "v0.1"), ("aevascenes", "v2")])
def test_a_simulated_drive_comes_back(tmp_path: Path, profile: str, layout: str) -> None:
    num_sweeps = 2 if profile == "aevascenes" else 3  # of 360,000 points each
    drive = make_drive(seed=3, num_sweeps=num_sweeps, profile=profile)
    log = AevaScenesLog(write_aevascenes_sequence(drive, tmp_path, layout=layout))
    assert (log.log_id, tuple(log.timestamps), len(log)) == (drive.log_id, tuple(drive.timestamps), num_sweeps)
    for index in range(num_sweeps):
        sweep, true, units = log.sweep(index), drive.sweep(index), drive.units(index)
        moved = [u.points.astype(float) @ u.T_ego_sensor[:3, :3].T + u.T_ego_sensor[:3, 3] for u in units]
        # Coordinates of the units are stored as they are; a quaternion is good to 1e-15. Float32 rounds at 8e-6 m.
        step = np.spacing(np.abs(np.concatenate(moved)).astype(np.float32))
        assert (np.abs(sweep.points - np.concatenate(moved)) <= step).all()
        assert np.abs(sweep.points - true.points).max() < 1e-4
        assert np.array_equal(sweep.is_ground, true.is_ground) and sweep.timestamp_ns == true.timestamp_ns
        assert np.abs(sweep.pose - np.linalg.inv(drive.poses[0]) @ drive.poses[index]).max() < 1e-12
        assert np.array_equal(log.radial_velocity(index), np.concatenate([u.radial_velocity for u in units]))
    assert np.array_equal(log.sweep(0).pose, np.eye(4))
    for index in range(num_sweeps - 1):
        labels, true, exact = log.labels(index), truth(drive, index), drive.labels(index)
        same = (labels.category == true.category) & (labels.is_valid == true.is_valid)
        assert same.mean() > 0.9999  # but for points within a rounding of a face
        assert np.abs(labels.flow - true.flow)[same].max() < 1e-5
        # Truth from boxes takes the ground below an object and misses what moved while the LiDAR looked.
        assert (np.abs(labels.flow - exact.flow).max(1) < 1e-3).mean() > 0.97
        named = (labels.category > 0) & (exact.category > 0)
        assert (meta_class(labels.category) == meta_class(exact.category))[named].mean() > 0.99
        assert named.sum() > 100
    assert log.labels(num_sweeps - 1) is None
    assert len(window(log, num_sweeps - 2, num_history=9).pch) == num_sweeps - 2


def test_layout_of_the_files(drive: Any, written: Path) -> None:
    assert os.listdir(written.parent) == [drive.log_id]
    assert sorted(os.listdir(written)) == ["pointcloud_compensated", "sequence.json"]
    content = json.loads((written / "sequence.json").read_text())
    assert set(content) == {"metadata", "frames"}
    assert content["metadata"]["sensors"] == {"lidars": ["up_lidar"], "cameras": []}
    frame = content["frames"][1]
    path = frame["point_cloud"]["up_lidar"]["point_cloud_compensated_path"]
    assert path == f"pointcloud_compensated/up_lidar_{drive.timestamps[1]}.npz"
    unit = drive.units(1)[0]
    with np.load(written / path, allow_pickle=True) as cloud:  # our own file
        rows = len(unit.points)
        kinds = {name: (cloud[name].shape, cloud[name].dtype) for name in cloud.files}
        assert kinds == {
            "xyz": ((rows, 3), np.float32),
            "velocity": ((rows, 1), np.float32),
            "reflectivity": ((rows, 1), np.float32),
            "line_index": ((rows, 1), np.uint32),
            "time_offset_ns": ((rows, 1), np.uint32),
            "semantic_labels": ((rows, 1), np.dtype(object)),
            "semantic_labels_idx": ((rows, 1), np.int64),
        }
        assert np.array_equal(cloud["xyz"], unit.points) and np.array_equal(cloud["line_index"][:, 0], unit.ring)
        assert np.array_equal(cloud["time_offset_ns"][:, 0], unit.offset_ns)
        names = set(cloud["semantic_labels"][:, 0].tolist())
        assert {"road", "car", "other_structure"} <= names <= set(CATEGORY_NAME)
    boxes, place = frame["boxes"], drive.boxes(1)
    assert [b["id"] for b in boxes] == list(place.track_id)
    centres = [drive.poses[i][:3, :3] @ drive.boxes(i).pose[0, :3, 3] + drive.poses[i][:3, 3] for i in (0, 2)]
    velocity = drive.poses[1][:3, :3].T @ (centres[1] - centres[0]) / 0.2
    np.testing.assert_allclose(list(boxes[0]["linear_velocity"].values()), velocity, atol=1e-9)


def test_every_category_has_a_class_or_is_refused() -> None:
    assert set(CATEGORY_NAME.values()) <= set(CATEGORIES) and set(CLASS_OF.values()) <= set(CATEGORY_NAME)
    assert len(CATEGORY_NAME) == 25 and set(GROUND) <= set(CATEGORY_NAME)
    assert set(CATEGORIES) - set(CLASS_OF) == {"NONE"}
    there_and_back = [CATEGORY_INDEX[CATEGORY_NAME[CLASS_OF[name]]] for name in CATEGORIES[1:]]
    assert np.array_equal(meta_class(np.array(there_and_back)), meta_class(np.arange(1, 31)))


# ---------------------------------------------------------------------------------------------- the writer


def test_an_existing_sequence_is_only_replaced_on_request(folder: Path, drive: Any) -> None:
    with pytest.raises(CFlowError, match="overwrite=True"):
        write_aevascenes_sequence(drive, folder.parent)
    (folder / "sequence.json").write_text("old")
    assert write_aevascenes_sequence(drive, folder.parent, overwrite=True) == folder
    assert len(AevaScenesLog(folder)) == 3 and os.listdir(folder.parent) == [folder.name]


@pytest.mark.parametrize("stage", ["write", "move"])
def test_a_failed_write_changes_nothing(folder: Path, drive: Any, monkeypatch: Any, stage: str) -> None:
    (folder / "sequence.json").write_text("old")
    real, calls = os.replace, []

    def fail(*paths: Any) -> None:
        calls.append(paths)
        if stage == "write" or len(calls) == 2:
            raise OSError("disk full")
        real(*paths)

    if stage == "write":
        monkeypatch.setattr(aevascenes_writer, "_add_velocities", fail)
    else:
        monkeypatch.setattr(aevascenes_writer.os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_aevascenes_sequence(drive, folder.parent, overwrite=True)
    assert os.listdir(folder.parent) == [folder.name] and (folder / "sequence.json").read_text() == "old"


def test_recordings_that_do_not_fit(drive: Any, tmp_path: Path) -> None:
    class Changed:
        log_id, timestamps, poses = "changed", drive.timestamps, drive.poses
        sweep, boxes, units = drive.sweep, drive.boxes, drive.units

    with pytest.raises(CFlowError, match="v2, v0.1"):
        write_aevascenes_sequence(Changed(), tmp_path, layout="v3")
    early = Changed()
    early.units = lambda i: [UnitReturns(**{**vars(u), "offset_ns": u.offset_ns - 10**8}) for u in drive.units(i)]
    with pytest.raises(CFlowError, match="sweep 0 .*time stamp"):
        write_aevascenes_sequence(early, tmp_path)
    for name in ("../up", "", ".hidden"):
        early.log_id = name
        with pytest.raises(CFlowError, match="folder name"):
            write_aevascenes_sequence(early, tmp_path)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------------- strings and pickles


class Bomb:
    """Its pickle runs a command when it is loaded."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.marker),))


def npz_with_pickle(file: Path, pickled: bytes, shape: str = "(2, 1)") -> Path:
    header = io.BytesIO()
    values = {"descr": "|O", "fortran_order": False, "shape": eval(shape)}  # noqa: S307
    np.lib.format.write_array_header_1_0(header, values)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("semantic_labels.npy", header.getvalue() + pickled)
    return file


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_strings_of_every_kind(tmp_path: Path, protocol: int) -> None:
    names = np.array([["car"], ["Straße"]], dtype=object)
    scalars = np.array([[np.str_("car")], [np.str_("Straße")]], dtype=object)
    for array in (names, np.asfortranarray(names), scalars):
        if protocol == 2 and array is not names:
            continue
        file = npz_with_pickle(tmp_path / "a.npz", pickle.dumps(array, protocol=protocol))
        if protocol == 2:  # Python 2's way to write bytes; no release has it
            with pytest.raises(CFlowError, match="_codecs"):
                read_npz_member(file, "semantic_labels", strings=True)
            continue
        found = read_npz_member(file, "semantic_labels", strings=True)
        assert found.tolist() == [["car"], ["Straße"]] and found.dtype.kind == "U"
    save(tmp_path / "b.npz", semantic_labels=np.array([["car"], ["road"]]))
    assert read_npz_member(tmp_path / "b.npz", "semantic_labels", strings=True).tolist() == [["car"], ["road"]]
    assert read_npz_member(tmp_path / "b.npz", "nothing") is None


def test_a_pickle_never_runs(tmp_path: Path) -> None:
    marker = tmp_path / "it ran"
    array = np.array([[Bomb(marker)], ["car"]], dtype=object)
    save(tmp_path / "a.npz", semantic_labels=array, xyz=array)
    npz_with_pickle(tmp_path / "b.npz", pickle.dumps(Bomb(marker)))
    for file in ("a.npz", "b.npz"):
        with pytest.raises(CFlowError, match=rf"{file}.*asks for \w+\.mkdir"):
            read_npz_member(tmp_path / file, "semantic_labels", strings=True)
    with pytest.raises(CFlowError, match="xyz has dtype object"):
        read_npz_member(tmp_path / "a.npz", "xyz")
    assert not marker.exists()
    np.load(tmp_path / "a.npz", allow_pickle=True)["xyz"]  # the bomb is real
    assert marker.exists()


@pytest.mark.parametrize(
    "pickled",
    [
        pickle.dumps(["car", "road"]),
        pickle.dumps(np.array([["car"], [3]], dtype=object)),
        pickle.dumps(np.array([["car"], ["road"], ["car"]], dtype=object)),
        pickle.dumps(np.array([["car"], [None]], dtype=object)),
        pickle.dumps(np.array([["car"], [np.float64(3)]], dtype=object)),
        pickle.dumps(np.array([["car"], ["road"]], dtype=object))[:-20],
        b"",
        b"\x80\x04no pickle",
    ],
)
def test_what_holds_no_strings_is_refused(tmp_path: Path, pickled: bytes) -> None:
    with pytest.raises(CFlowError, match="cannot read semantic_labels of .*a.npz"):
        read_npz_member(npz_with_pickle(tmp_path / "a.npz", pickled), "semantic_labels", strings=True)
    save(tmp_path / "b.npz", semantic_labels=np.arange(3))
    with pytest.raises(CFlowError, match="must hold strings"):
        read_npz_member(tmp_path / "b.npz", "semantic_labels", strings=True)


# ---------------------------------------------------------------------------------------------- broken sequences


def first_cloud(folder: Path) -> Path:
    return min((folder / "pointcloud_compensated").glob("*.npz"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda file: file.write_bytes(file.read_bytes()[:5000]), "cannot read .*damaged"),
        (lambda file: file.write_bytes(b""), "cannot read .*damaged"),
        (lambda file: file.write_text("a poem, not an archive"), "cannot read .*damaged"),
        (lambda file: file.unlink(), "is missing; copy"),
        (lambda file: save(file, points=np.zeros((3, 3))), "no array xyz.*points"),
        (lambda file: save(file, xyz=np.zeros((3, 2))), r"\(N, 3\)"),
        (lambda file: save(file, xyz=np.zeros((3, 3), int)), "floating"),
        (lambda file: save(file, xyz=np.zeros((3, 3)), semantic_labels=np.array(["car"] * 4)), "3 points but 4"),
    ],
    ids=["truncated", "empty", "foreign", "missing", "other arrays", "flat", "integers", "too many names"],
)
def test_damaged_cloud(folder: Path, damage: Any, message: str) -> None:
    log = AevaScenesLog(folder)
    damage(first_cloud(folder))
    with pytest.raises(CFlowError, match=message) as error:
        log.sweep(0)
    assert str(first_cloud(folder) if first_cloud(folder).exists() else ".npz").split(os.sep)[-1][-9:] in str(
        error.value
    )
    log.sweep(1)  # sweeps are read when asked for


def cut_text(text: str) -> str:
    return text[: len(text) // 2]


def edit(change: Any) -> Any:
    """A change of the text that changes the parsed content."""

    def changed(text: str) -> str:
        content = json.loads(text)
        change(content)
        return json.dumps(content)

    return changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cut_text, "cannot read .*truncated"),
        (lambda _: "", "cannot read"),
        (lambda _: "[" * 100_000, "cannot read"),
        (lambda _: '{"scenes": []}', "no 'metadata'"),
        (lambda _: "[1, 2]", "no 'metadata'"),
        (edit(lambda c: c.update(frames="many")), "list of objects"),
        (edit(lambda c: c.update(frames=c["frames"][:1])), "1 frames"),
        (edit(lambda c: c.update(frames=c["frames"] * 2)), "6 frames with 3 different"),
        (edit(lambda c: c["metadata"].pop("vehicle_to_lidar_extrinsics")), "vehicle_to_lidar_extrinsics"),
        (edit(lambda c: c["metadata"]["vehicle_to_lidar_extrinsics"].clear()), "no 'up_lidar'"),
        (edit(lambda c: c["metadata"]["sensors"].update(lidars=6)), "list of names"),
        (edit(lambda c: c["frames"][0].update(timestamp_ns="noon")), "must be integers"),
        (edit(lambda c: c["frames"][0].pop("ego_pose")), "no 'ego_pose'"),
        (edit(lambda c: c["frames"][0]["ego_pose"]["rotation"].update(w=3.0)), "length 1"),
        (edit(lambda c: c["frames"][0]["ego_pose"]["translation"].update(x=None)), "finite numbers"),
        (edit(lambda c: c["frames"][0]["ego_pose"]["translation"].update(x=float("nan"))), "finite numbers"),
        (edit(lambda c: c["frames"][0].pop("point_cloud")), "no 'point_cloud'"),
        (edit(lambda c: c["frames"][0]["point_cloud"]["up_lidar"].clear()), "no compensated cloud"),
        (
            edit(lambda c: c["frames"][0]["point_cloud"]["up_lidar"].update(point_cloud_compensated_path="../x")),
            "leaves",
        ),
        (edit(lambda c: c["frames"][0]["boxes"][0].update({"class": "tank"})), "unknown class 'tank'"),
        (edit(lambda c: c["frames"][0]["boxes"][0].update(reference_frame="WORLD")), "VEHICLE, got 'WORLD'"),
        (edit(lambda c: c["frames"][0]["boxes"][0].pop("dimensions")), "no 'dimensions'"),
        (edit(lambda c: c["frames"][0]["boxes"][0].update(id=c["frames"][0]["boxes"][1]["id"])), "named twice"),
    ],
)
def test_damaged_sequence(folder: Path, change: Any, message: str) -> None:
    file = folder / "sequence.json"
    file.write_text(change(file.read_text()))
    with pytest.raises(CFlowError, match=message) as error:
        AevaScenesLog(folder).labels(0)
    assert "sequence.json" in str(error.value)


def test_no_such_thing(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CFlowError, match="no sequence.json"):
        AevaScenesLog(tmp_path)
    with pytest.raises(CFlowError, match="compensated, raw"):
        AevaScenesLog(folder, clouds="skewed")
    with pytest.raises(CFlowError, match="roof"):
        AevaScenesLog(folder, lidars=("roof",))
    with pytest.raises(CFlowError, match="raw clouds come with version 2"):
        AevaScenesLog(folder, clouds="raw").sweep(0)
    for ask in (AevaScenesLog(folder).sweep, AevaScenesLog(folder).labels, AevaScenesLog(folder).radial_velocity):
        with pytest.raises(CFlowError, match="0 ... 2"):
            ask(3)


def test_finding_sequences(folder: Path, tmp_path: Path) -> None:
    other = write_small(tmp_path / "data" / "validation" / "b")
    assert find_aevascenes_sequences(tmp_path) == sorted([folder, other])
    assert find_aevascenes_sequences(folder) == [folder]
    assert find_aevascenes_sequences(other.parent) == [other]
    assert find_aevascenes_sequences(folder / "pointcloud_compensated") == []
    with pytest.raises(CFlowError, match="no folder"):
        find_aevascenes_sequences(tmp_path / "nowhere")
