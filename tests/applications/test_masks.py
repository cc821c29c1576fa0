"""Masks show moving points and boxes where a camera sees them, at the time of its image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import pose
from staged_cars import Staged, straight

from cflow_torch import CFlowError, track
from cflow_torch.data.camera import Camera, intrinsic_matrix

Image = pytest.importorskip("PIL.Image", reason="needs the extra viz: pip install Pillow")
from test_tracking import calls_on_a_drive  # noqa: E402

from cflow_torch.applications.instance_files import write_drivestudio_masks  # noqa: E402
from cflow_torch.applications.masks import dynamic_mask, write_masks  # noqa: E402
from cflow_torch.data.av2 import AV2Log  # noqa: E402

AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # T_camera_ego
CAMERA = Camera("front", "7", (200, 100), intrinsic_matrix(100, 100, 100, 50), AHEAD)
NO_POINTS, NO_BOXES = np.zeros((0, 3)), np.zeros((0, 8, 3))


def box(centre: Any, size: Any) -> np.ndarray:
    """(1, 8, 3) corners."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return (np.asarray(centre) + signs * np.asarray(size) / 2)[None]


def extent(mask: np.ndarray) -> tuple[int, int, int, int]:
    """First and last column, first and last row of the pixels that are set."""
    rows, columns = np.nonzero(mask == 255)
    return columns.min(), columns.max(), rows.min(), rows.max()


def test_a_box_covers_its_outline_in_the_image() -> None:
    """Its near face, 10 m ahead and 2 x 1 m large, is 20 x 10 pixels."""
    mask = dynamic_mask(CAMERA, NO_POINTS, box((11, 0, 0), (2, 2, 1)))
    assert mask.shape == (100, 200) and set(np.unique(mask)) == {0, 255}
    np.testing.assert_allclose(extent(mask), (90, 110, 45, 55), atol=1)
    to_the_left = dynamic_mask(CAMERA, NO_POINTS, box((11, 5, 0), (2, 2, 1)))
    assert extent(to_the_left)[1] < 70 and (to_the_left > 0).sum() > (mask > 0).sum(), "two faces are seen"


def test_a_box_beside_the_camera_is_cut_off_and_one_behind_is_not_seen() -> None:
    passing = dynamic_mask(CAMERA, NO_POINTS, box((0, 2, 0), (10, 1, 1)))  # from -5 to 5 m ahead
    columns = extent(passing)
    assert columns[0] == 0 and 60 <= columns[1] <= 71
    assert not dynamic_mask(CAMERA, NO_POINTS, box((-11, 0, 0), (2, 2, 1))).any()


def test_points_are_discs_that_shrink_with_the_distance() -> None:
    points = np.array([[10.0, 0, 0], [40, 15, 0], [-10, 0, 0], [10, 40, 0]])
    mask = dynamic_mask(CAMERA, points, NO_BOXES)
    assert mask[50, 100] == 255 and mask[50, 62] == 255
    assert 2 <= (mask[:, 90:] > 0).sum() <= 16 and 1 <= (mask[:, :90] > 0).sum() <= 6
    assert not dynamic_mask(CAMERA, points[2:], NO_BOXES).any(), "behind and beside the image"


class Filmed(Staged):
    """A vehicle at rest that has turned, with a camera whose images are taken 50 ms after the sweeps."""

    def cameras(self, index: int) -> list[Camera]:
        self._timestamp(index)
        return [CAMERA._replace(image=f"{index:03d}", seconds=0.05), CAMERA._replace(name="other", image=f"{index}")]


def test_masks_follow_objects_to_the_time_of_the_image(tmp_path: Path) -> None:
    """A car crosses to the left at 9 m/s, so 0.45 m until the image; the vehicle looks along the world's y axis."""
    vehicle = pose(0, -20, np.pi / 2, 0)
    log = Filmed([straight((2.05, -8), (-0.9, 0.0))], np.tile(vehicle, (12, 1, 1)))
    table = track(log, log.results())
    write_masks(tmp_path, log, [(3, log.result(3))], table)
    later, now = (np.asarray(Image.open(tmp_path / name)) for name in ("front/003.png", "other/3.png"))
    assert later.shape == (100, 200) and sorted(file.name for file in tmp_path.rglob("*.png")) == ["003.png", "3.png"]
    car = log.sweep(3).points[log.world(3)[2] == 0]
    pixels = CAMERA.project(CAMERA.see(car))
    first, last = extent(now)[:2]
    assert -8 < first - pixels[:, 0].min() < 1 and -1 < last - pixels[:, 0].max() < 8, "the whole car, and little more"
    shift = 100 * 0.45 / 12  # pixels, at 12 m
    np.testing.assert_allclose(np.subtract(extent(now), extent(later))[:2], shift, atol=1.1)
    empty = {name: values[:0] for name, values in table.items()}
    write_masks(tmp_path / "points", log, [(3, log.result(3))], empty)
    of_points = np.asarray(Image.open(tmp_path / "points" / "other" / "3.png"))
    row, column = np.nonzero(of_points)
    assert (now[row, column] == 255).mean() > 0.95, "the points are inside the box"


def test_returns_of_the_own_vehicle_do_not_hide_the_world(tmp_path: Path) -> None:
    """The camera is on the roof, whose points move with the vehicle."""
    poses = np.stack([pose(0.9 * k, 0, 0.0) for k in range(12)])
    log = Filmed([straight((-2.25, -0.95), (0.9, 0.0)), straight((8, -3), (0.9, 0.0))], poses)
    write_masks(tmp_path, log, [(3, log.result(3))], track(log, log.results()))
    mask = np.asarray(Image.open(tmp_path / "front" / "003.png"))
    assert 0.01 < (mask > 0).mean() < 0.2, "only the other car"


def test_masks_of_drivestudio_have_its_names_and_every_frame(tmp_path: Path) -> None:
    """The last sweep has no flow: there, the car is where its flow in the sweep before has moved it."""
    log = Filmed([straight((2, -8), (-0.9, 0.0))], np.tile(pose(0, -20, np.pi / 2, 0), (12, 1, 1)))
    table = track(log, log.results())
    write_drivestudio_masks(tmp_path, log, log.results(), table, ("other", "front"))
    names = {f"{frame:03d}_{camera}.png" for frame in range(12) for camera in (0, 1)}
    for kind in ("all", "human", "vehicle"):
        assert {file.name for file in (tmp_path / kind).iterdir()} == names
    masks = {kind: np.asarray(Image.open(tmp_path / kind / "011_0.png")) for kind in ("all", "human", "vehicle")}
    assert not masks["human"].any() and masks["vehicle"].any()
    assert np.array_equal(masks["all"], np.maximum(masks["vehicle"], masks["all"]))
    car = log.sweep(11).points[log.world(11)[2] == 0]
    column, row = CAMERA.project(CAMERA.see(car)).astype(int).T
    is_in_image = (column >= 0) & (column < 200)
    assert (masks["vehicle"][row, column.clip(0, 199)] > 0)[is_in_image].mean() > 0.99
    person = {**table, "class": np.full(len(table["id"]), "pedestrian")}
    write_drivestudio_masks(tmp_path / "people", log, log.results()[:1], person, ("front",))
    assert not np.asarray(Image.open(tmp_path / "people" / "vehicle" / "000_0.png")).any()
    assert np.asarray(Image.open(tmp_path / "people" / "human" / "000_0.png")).any()
    write_drivestudio_masks(tmp_path / "any", log, log.results(), table)
    assert {file.name for file in (tmp_path / "any" / "all").iterdir()} == names, "all cameras, in their order"


def test_an_image_of_several_sweeps_has_the_mask_of_the_nearest(tmp_path: Path) -> None:
    """A camera of 4 Hz: its image is taken with sweep 3, and is the nearest one of sweeps 2 and 4, too."""

    class Slow(Staged):
        def cameras(self, index: int) -> list[Camera]:
            seconds = 0.1 * (3 - index)
            return [CAMERA._replace(image="slow" if index in (2, 3, 4) else f"{index}", seconds=seconds)]

    log = Slow([straight((2, -8), (-0.9, 0.0))], np.tile(pose(0, -20, np.pi / 2, 0), (12, 1, 1)))
    results = log.results()
    results[4][1].residual_flow[:] = 0
    empty = {name: values[:0] for name, values in track(log, results).items()}
    write_masks(tmp_path / "all", log, results[2:5], empty)
    write_masks(tmp_path / "one", log, results[3:4], empty)
    masks = [np.asarray(Image.open(tmp_path / name / "front" / "slow.png")) for name in ("all", "one")]
    assert np.array_equal(*masks) and masks[0].any()


def test_a_log_without_cameras_is_an_error(tmp_path: Path) -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    with pytest.raises(CFlowError, match="no calibration of cameras"):
        write_masks(tmp_path, log, log.results(), track(log, log.results()))


def test_the_command_writes_masks_and_overwrites_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    call = calls_on_a_drive(tmp_path)
    run = ("engine.workers=1", "masks=true")
    assert call("flow", "flow", *run) == 2 and "no calibration of cameras" in capsys.readouterr().err
    assert not list((tmp_path / "flow").glob("*/*.feather")), "it is told before anything is computed"
    camera = CAMERA._replace(name="ring_front_center", T_camera_ego=AHEAD @ pose(0, 0, 0, -1.5))
    monkeypatch.setattr(AV2Log, "cameras", lambda log, index: [camera._replace(image=str(log.timestamps[index]))])
    assert call("flow", "flow", *run) == 0
    (folder,) = (tmp_path / "flow").glob("*/masks/ring_front_center")
    flow_files = {file.stem for file in folder.parents[1].glob("*.feather")}
    assert {file.stem for file in folder.iterdir()} == flow_files and (folder.parents[1] / "tracks.parquet").exists()
    assert any(np.asarray(Image.open(file)).any() for file in folder.iterdir())
    assert call("flow", "flow", *run, "tracks=drivestudio") == 0
    of_drivestudio = folder.parents[1] / "dynamic_masks"
    frames = sorted(file.name for file in (of_drivestudio / "all").iterdir())
    assert frames == [f"{frame:03d}_0.png" for frame in range(len(flow_files) + 1)]
    assert call("flow", "flow", "engine.workers=1", "overwrite=true") == 0
    assert not folder.exists() and not of_drivestudio.exists(), "masks of another run"


def test_masks_of_the_real_log_cover_its_labelled_moving_points(av2_folder: Path) -> None:
    """The labels are of people; the flow has found at least most of what the ring cameras see of them."""
    from cflow_torch import make_config, make_model
    from cflow_torch.applications.masks import _moving_points
    from cflow_torch.data.log import window

    log = AV2Log(av2_folder)
    result = make_model(make_config("default"))([window(log, 0)])[0]
    points, _ = _moving_points(log, 0, result)
    sweep, after = log.sweep(0), log.sweep(1)
    labels = log.labels(0)
    moved = sweep.points + labels.flow
    still = sweep.points @ (np.linalg.inv(after.pose) @ sweep.pose)[:3, :3].T
    still += (np.linalg.inv(after.pose) @ sweep.pose)[:3, 3]
    distance = np.linalg.norm(sweep.points[:, :2], axis=1)
    truth = (np.linalg.norm(moved - still, axis=1) > 0.2) & ~sweep.is_ground & (distance < 35) & labels.is_valid
    covered = seen = 0
    for camera in log.cameras(0):
        mask = dynamic_mask(camera, points, NO_BOXES)
        assert (mask > 0).mean() < 0.2
        pixels = camera.project(camera.see(sweep.points[truth]))
        width, height = camera.size
        inside = (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
        column, row = pixels[inside].astype(int).T
        covered += int((mask[row, column] > 0).sum())
        seen += int(inside.sum())
    assert seen > 500 and covered > 0.95 * seen
