"""CorrelationFlow inside OpenSceneFlow, by a replay of that harness (`miniature_opensceneflow`).

First the replay itself: it must give the numbers that the harness printed for the real pair. Then the module `CFlow`
in every layout that the replay makes.
"""

from __future__ import annotations

import copy
import json
import sys
import types
import warnings
from pathlib import Path
from typing import Any, Dict, List, Optional

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor, nn
from torch.utils.data import default_collate

pytest.importorskip("h5py")

import h5py
import miniature_opensceneflow as osf
import pyarrow.feather as feather
from opensceneflow_labels import moved, up_lidar, write_own_scene
from scenes import RANGE, pose, same_bits, scene

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.cli.main import main
from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.data.hdf5.frames import recognized_extrinsics
from cflow_torch.data.hdf5.writer import write_index_files
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.evaluation import SceneFlowMetrics
from cflow_torch.integrations.opensceneflow import CFlow, write_null_checkpoint
from cflow_torch.integrations.opensceneflow.__main__ import main as write_checkpoint
from cflow_torch.types import Sweep

SMALL = {"pixel_sizes": [0.25], "point_cloud_range": list(RANGE), "max_extent": 5.0}
VARIANTS: Dict[str, Dict[str, Any]] = {
    "dense": {"method": "dense", "num_frames": 6, "proof": False, "height_slices": 0, **SMALL},
    "proof": {"method": "dense", "num_frames": 6, **SMALL},  # the preset's
    "keypoints": {"method": "keypoints", "patch_size": 11, "ratio_threshold": 1.0, **SMALL, "pixel_sizes": [0.1]},
}
EGO_T_LIDAR = np.array([[0.8, -0.6, 0, 1.35], [0.6, 0.8, 0, 0.2], [0, 0, 1, 1.6], [0, 0, 0, 1]])
AV2_STAMP = 315_966_265_259_836_000  # Argoverse 2 counts from a moment of its own
PLACE = pose(5400.0, -1200.0, 0.7, 12.0)  # city coordinates are far from the origin


class SmallDrive:
    """Seven sweeps of `scenes.scene`, without its NaN and infinite points, as a log far from the world's origin."""

    def __init__(self, seed: int = 0, first_stamp: int = AV2_STAMP, raised: float = 0.0) -> None:
        made = scene(seed, num_history=5)
        self.log_id = f"drive-{seed}"
        self._sweeps = []
        for index, sweep in enumerate((*made.pch[::-1], made.pc0, made.pc1)):
            finite = np.isfinite(sweep.points).all(axis=1)
            finite[: index + 10 * seed] = False  # every sweep has another number of points
            points = (sweep.points + np.float32([0, 0, raised]))[finite]
            self._sweeps.append(Sweep(points, sweep.is_ground[finite], PLACE @ sweep.pose))
        self.timestamps = [first_stamp + k * 100_000_000 for k in range(len(self._sweeps))]

    def sweep(self, index: int) -> Sweep:
        return self._sweeps[index]

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Ego motion, and for one point in five a motion of its own: made-up truth of some category."""
        if index == len(self._sweeps) - 1:
            return None
        rng = np.random.default_rng(index)
        points = self._sweeps[index].points.astype(np.float64)
        T = np.linalg.inv(self._sweeps[index + 1].pose) @ self._sweeps[index].pose
        moves = rng.random(len(points)) < 0.2
        flow = moved(T, points) - points + moves[:, None] * rng.normal(0, 0.5, points.shape)
        return FlowLabels(
            flow.astype(np.float32), np.where(moves, 19, 0).astype(np.uint8), rng.random(len(points)) < 0.9
        )


def store(folder: Path, *drives: Any, **settings: Any) -> Path:
    """A folder of scenes with its index files."""
    for drive in drives:
        write_hdf5_scene(drive, folder / f"{drive.log_id}.h5", **{"pose_dtype": "float32", "eval_step": 1, **settings})
    write_index_files(folder)
    return folder


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of seven sweeps, points and poses of the ego frame."""
    return store(tmp_path_factory.mktemp("small"), SmallDrive(0), SmallDrive(1))


@pytest.fixture(scope="module")
def own(av2_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real pair as the harness's own extraction stores it."""
    folder = tmp_path_factory.mktemp("own")
    write_own_scene(av2_folder, folder / f"{av2_folder.name}.h5")
    write_index_files(folder)
    return folder


@pytest.fixture(scope="module")
def official(av2_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real pair with the official truth in the ego frame and float64 poses, by the project's writer."""
    return store_real(tmp_path_factory.mktemp("official"), av2_folder, pose_dtype="float64")


def store_real(folder: Path, av2_folder: Path, **settings: Any) -> Path:
    """The real pair by the project's writer, with the official evaluation mask."""
    log = AV2Log(av2_folder)
    store(folder, log, **settings)
    points, is_ground = np.asarray(log.sweep(0).points), np.asarray(log.sweep(0).is_ground)
    with h5py.File(folder / f"{log.log_id}.h5", "r+") as file:
        mask = ~is_ground & (np.abs(points[:, :2]) <= 50).all(axis=1)
        file[str(log.timestamps[0])]["eval_mask"][...] = mask[:, None]
    return folder


# ---------------------------------------------------------------------------------------------- the replay: data


def stamps(batch: Dict[str, Any], num_history: int) -> List[int]:
    """Number of the sweep behind pc1, pc0, pch1, ..., told by its pose (the scenes differ in it)."""
    keys = ["pose1", "pose0", *(f"poseh{i}" for i in range(1, num_history + 1))]
    drive = SmallDrive(0)
    poses = [drive.sweep(k).pose.astype(np.float32) for k in range(7)]
    return [next(k for k in range(7) if np.array_equal(batch[key], poses[k])) for key in keys]


def test_items_clamp_as_the_harness_does(small: Path) -> None:
    dataset = osf.SceneDataset(small, num_frames=6)
    assert len(dataset) == 12, "six labelled frames of each scene"
    assert stamps(dataset[5], 4) == [6, 5, 4, 3, 2, 1]
    assert stamps(dataset[2], 4) == [3, 2, 1, 0, 0, 0], "the first sweep of the scene is repeated"
    assert stamps(dataset[0], 4) == [1, 0, 0, 0, 0, 0], "even sweep t itself"
    assert dataset[6]["scene_id"] == "drive-1" and dataset.row(6) == 7
    every = osf.SceneDataset(small, num_frames=6, eval=False)
    assert [every.row(item) for item in range(14)] == [4, 4, 4, 4, 4, 5, 5, 11, 11, 11, 11, 11, 12, 12]
    dataset.frames = [*dataset.total]
    assert dataset.row(6) == 5, "the last sweep of a scene has no successor: the frame before again"


def test_layout_of_the_lightning_path(own: Path) -> None:
    raw = osf.load(own, num_frames=3)
    batch = osf.path_b(raw)
    expected = {
        "pc0": (torch.float32, (1, 81_856, 3)),
        "pc1": (torch.float32, (1, 82_080, 3)),
        "pch1": (torch.float32, (1, 99_229, 3)),
        "origin_pc0": (torch.float32, (1, 99_229, 3)),
        "gm0": (torch.bool, (1, 99_229)),
        "gmh1": (torch.bool, (1, 99_229)),
        "pose0": (torch.float32, (1, 4, 4)),
        "ego_motion": (torch.float32, (1, 4, 4)),
        "flow": (torch.float32, (1, 99_229, 3)),
        "flow_is_valid": (torch.bool, (1, 99_229)),
        "flow_category_indices": (torch.uint8, (1, 99_229)),
        "eval_mask": (torch.bool, (1, 99_229)),
        "eval_flag": (torch.bool, (1,)),
    }
    assert {key: (batch[key].dtype, tuple(batch[key].shape)) for key in expected} == expected
    assert batch["timestamp"] == [str(AV2_STAMP)] and batch["scene_id"] == [next(own.glob("*.h5")).stem]
    assert batch["eval_mask"].sum() == 78_507
    assert osf.path_b(raw, top_num_frames=3)["pch1"].shape == (1, 81_856, 3)


def test_layout_of_training(small: Path) -> None:
    dataset = osf.SceneDataset(small, num_frames=4)
    items = [dataset[0], dataset[9]]
    batch = osf.collate_for_training(items)
    counts = [int((~item["gm0"]).sum()) for item in items]
    assert counts[0] != counts[1] and batch["pc0"].shape == (2, max(counts), 3)
    padding = batch["pc0"].isnan().all(dim=2)
    assert padding.sum(dim=1).tolist() == [max(counts) - count for count in counts]
    assert not batch["flow"][padding].any() and batch["flow_is_valid"].dtype == torch.bool
    assert isinstance(batch["poseh2"], list) and batch["poseh2"][1].shape == (4, 4)
    assert not [key for key in batch if key.startswith("gm") or key in ("eval_mask", "origin_pc0", "timestamp")]


# ---------------------------------------------------------------------------------------------- the replay: golden


PRINTED = 5e-8  # metres: the printed digits; float32 positions 50 m away make a mean uncertain by about as much


def check(results: Dict[str, Any], digits: float = PRINTED, **expected: float) -> None:
    """Three-way scores and static errors of classes."""
    classes = {name: row["static_epe"] for name, row in results["bucketed"]["classes"].items()}
    found = {**results["three_way"], **classes, "MEAN": results["bucketed"]["mean"]["static_epe"]}
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=digits, rel=0), name


def test_the_harness_s_own_truth(own: Path, av2_folder: Path) -> None:
    truth = osf.load(own)
    official = AV2Log(av2_folder).labels(0)
    assert official is not None
    difference = np.linalg.norm(truth["flow"][0].numpy() - official.flow, axis=1)
    assert (difference > 1e-3).sum() == 804


def test_zero_on_the_harness_s_own_scene(own: Path) -> None:
    results = osf.evaluate(osf.Returns(), own)
    check(results, 5e-7, epe_fd=0.676812, epe_3way=0.231902, CAR=0.010684)  # six digits are known
    check(results, epe_fs=0.0107423, epe_bs=0.0081513, dynamic_iou=0.0)
    check(results, BACKGROUND=0.0081513, PEDESTRIAN=0.00892663, WHEELED_VRU=0.00994298, MEAN=0.00942622)
    for name in ("CAR", "PEDESTRIAN"):
        assert results["bucketed"]["classes"][name]["dynamic_error"] == 1.0


def correct_static_warp(ego_T_lidar: np.ndarray) -> Any:
    """Model of a static world in the sensor frame: T_s p - T p, T as the harness has it."""

    def residual(batch: osf.Batch) -> Tensor:
        T = osf.relative_pose(batch["pose0"][0], batch["pose1"][0]).double().numpy()
        points = batch["origin_pc0"][0].double().numpy()
        T_lidar = np.linalg.inv(ego_T_lidar) @ T @ ego_T_lidar
        return torch.from_numpy((moved(T_lidar, points) - moved(T, points)).astype(np.float32))

    return residual


def test_correct_static_warp_on_the_harness_s_own_scene(own: Path, av2_folder: Path) -> None:
    results = osf.evaluate(osf.Returns(correct_static_warp(up_lidar(av2_folder))), own)
    check(results, 5e-7, epe_fd=0.674522, epe_3way=0.227345)
    check(results, epe_fs=0.00618095, epe_bs=0.00133243)


def test_zero_with_the_official_truth(official: Path) -> None:
    results = osf.evaluate(osf.Returns(), official)
    check(results, 1e-6, epe_fd=0.6740044185, epe_fs=0.0060820697, epe_bs=8.2264e-04, epe_3way=0.2269697108)


def test_zero_with_the_official_ego_motion(official: Path, av2_folder: Path, tmp_path: Path) -> None:
    """The ego motion that the test log stores, as poses: t+1 is the world."""
    file = tmp_path / next(official.glob("*.h5")).name
    file.write_bytes(next(official.glob("*.h5")).read_bytes())
    with h5py.File(file, "r+") as new:
        first, second = sorted(new)
        new[first]["pose"][...] = np.load(av2_folder / "ego_motion.npz")["ego_motion"][0]
        new[second]["pose"][...] = np.eye(4)
    write_index_files(tmp_path)
    results = osf.evaluate(osf.Returns(), tmp_path)
    check(results, 1e-6, epe_fd=0.6737206772, epe_fs=0.0062896596, epe_bs=6.2128e-07, epe_3way=0.2266703194)
    check(results, 1e-6, CAR=0.00620734, PEDESTRIAN=0.00582801, WHEELED_VRU=0.00385737, MEAN=0.00397334)


@pytest.mark.parametrize("style", ["full", "tensor", "valid"])
def test_truth_returned(style: str, own: Path) -> None:
    results = osf.evaluate(osf.Returns(osf.true_residual, style), own)
    three_way = results["three_way"]
    assert three_way["epe_fd"] < 2e-9 and three_way["epe_bs"] < 1e-10  # the harness: 9.77e-10, 1.46e-11
    assert results["bucketed"]["classes"]["CAR"]["dynamic_error"] < 1e-8
    assert three_way["dynamic_iou"] == pytest.approx(1.0, abs=1e-8)


def test_the_second_path_ignores_indices(own: Path) -> None:
    assert osf.evaluate(osf.Returns(osf.true_residual), own, path="A")["three_way"]["epe_fd"] < 2e-9
    assert osf.evaluate(osf.Returns(osf.true_residual, "valid"), own, path="A")["three_way"]["epe_fd"] > 0.1


def test_files_for_the_leaderboards(own: Path, tmp_path: Path) -> None:
    model = osf.Returns(osf.true_residual)
    (outcome,) = osf.outcomes(model, own)
    for version in (1, 2, 3):
        osf.write_test_files(model, own, tmp_path / str(version), version)
    one, two, three = (feather.read_table(str(next((tmp_path / f"{v}").rglob("*.feather")))) for v in (1, 2, 3))
    assert (one.num_rows, two.num_rows, three.num_rows) == (78_507, 99_229, 99_229)
    flow = ["flow_tx_m", "flow_ty_m", "flow_tz_m"]
    assert one.column_names == [*flow, "is_dynamic"] and two.column_names == ["is_valid", *flow]
    assert three.column_names == flow and all(str(three[name].type) == "halffloat" for name in flow)
    mask = outcome.batch["eval_mask"].numpy()
    total = outcome.final_flow.numpy().astype(np.float16)[mask]
    assert np.array_equal(one["flow_tx_m"].to_numpy(), total[:, 0])
    residual = (outcome.final_flow - outcome.pose_flow).numpy()
    assert not residual[outcome.batch["gm0"].numpy()].any(), "ground has no residual"
    assert np.array_equal(three["flow_ty_m"].to_numpy(), residual[:, 1].astype(np.float16))
    is_dynamic = np.linalg.norm(residual[mask], axis=1) >= 0.05
    assert one["is_dynamic"].to_pylist() == is_dynamic.tolist() and 1000 < is_dynamic.sum() < 3000


# ---------------------------------------------------------------------------------------------- the module: same flow


def answer(model: nn.Module, batch: osf.Batch) -> Dict[str, List[Tensor]]:
    with torch.inference_mode():
        return model(batch)


def core(folder: Path, variant: str, index: int, num_frames: int, ego_T_lidar: Any = None) -> Tensor:
    """(N', 3) residual of the points that are not ground, by the method itself on the scene as our reader reads it."""
    settings = {key: value for key, value in VARIANTS[variant].items() if key != "num_frames"}
    config = make_config("default", **settings)
    if variant != "keypoints":
        config = config.replace(num_history=num_frames - 2)
    with HDF5Log(folder / "drive-0.h5", ego_T_lidar=ego_T_lidar) as log:
        sweeps = window(log, index, config.num_history)
    (result,) = make_model(config)([sweeps])
    return result.residual_flow[torch.from_numpy(~sweeps.pc0.is_ground)]


CASES = [("dense", 2), ("dense", 4), ("dense", 6), ("proof", 6), ("keypoints", 2)]


@pytest.mark.parametrize(("variant", "num_frames"), CASES)
@pytest.mark.parametrize("index", [5, 2, 0])  # 2, 0: the harness repeats the first sweep, the core has a shorter window
def test_every_layout_gives_the_method_s_flow(variant: str, num_frames: int, index: int, small: Path) -> None:
    expected = core(small, variant, index, num_frames)
    assert (expected.norm(dim=1) > 0.05).sum() > 50, "there is motion to find"
    model = CFlow(**{**VARIANTS[variant], "num_frames": num_frames})
    raw = osf.load(small, index, num_frames)
    layouts = {
        "history with ground": osf.path_b(raw, 2),
        "history without ground": osf.path_b(raw, num_frames),
        "part of it": osf.path_b(raw, 3 if num_frames > 2 else 2),
        "second path": osf.path_a(raw),
        "float64": {k: v.double() if k.startswith(("pc", "pose")) else v for k, v in osf.path_b(raw).items()},
        "lists": {k: list(v) if k.startswith(("pc", "pose", "gm")) else v for k, v in osf.path_b(raw).items()},
        "training": osf.collate_for_training([osf.SceneDataset(small, num_frames)[index]]),
    }
    for name, batch in layouts.items():
        before = copy.deepcopy(batch)
        found = answer(model, batch)
        assert same_bits(found["flow"][0], expected), name
        assert found["pc0_valid_point_idxes"][0].tolist() == list(range(len(expected))), name
        assert list(before) == list(batch), "the batch has the same keys"
        for key, value in batch.items():
            if isinstance(value, Tensor):
                assert same_bits(value, before[key]), f"{key} was modified"


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("output", ["full", "valid"])
def test_padding_changes_nothing(variant: str, output: str, small: Path) -> None:
    model = CFlow(**VARIANTS[variant], output=output)
    dataset = osf.SceneDataset(small, 6)
    items = [dataset[5], dataset[8]]
    together = osf.collate_for_training(items)
    found = answer(model, together)
    assert len({len(flow) for flow in found["flow"]}) == 2
    metrics = SceneFlowMetrics("opensceneflow")
    for b, item in enumerate(items):
        alone = answer(model, osf.collate_for_training([item]))
        for key in ("flow", "pc0_valid_point_idxes", "pc0_points_lst", "pc1_points_lst"):
            assert same_bits(found[key][b], alone[key][0]), key
        assert same_bits(found["flow"][b], answer(model, osf.path_b(default_collate([item])))["flow"][0])
        rows = found["pc0_valid_point_idxes"][b]
        assert found["pose_flow"][b].shape == together["pc0"][b].shape
        T = osf.relative_pose(together["pose0"][b], together["pose1"][b])
        true_pose_flow = osf.pose_flow_of(together["pc0"][b], T)[rows]
        assert (found["pose_flow"][b][rows] - true_pose_flow).abs().max() < 2e-3, "float32 poses, 5 km away"
        assert same_bits(found["pc0_points_lst"][b], together["pc0"][b][rows])
    for frame in osf.training_frames(together, found):
        metrics.update(frame)
    assert metrics.num_frames == 2 and metrics.num_nan == 0 and metrics.num_points > 500


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("ego_T_lidar", [None, EGO_T_LIDAR], ids=["same-frame", "extrinsics"])
def test_full_and_valid_output_mean_the_same(variant: str, ego_T_lidar: Any, small: Path) -> None:
    batch = osf.path_b(osf.load(small, 5, 6))
    full, valid = (CFlow(**VARIANTS[variant], output=output, ego_T_lidar=ego_T_lidar) for output in ("full", "valid"))
    with torch.inference_mode():
        first, second = osf.run(full, batch), osf.run(valid, batch)
    assert 0 < len(second.answer["flow"]) < len(first.answer["flow"]) == batch["pc0"].shape[1]
    in_range = torch.zeros(len(first.final_flow), dtype=torch.bool)
    in_range[(~first.batch["gm0"]).nonzero()[:, 0][second.answer["pc0_valid_point_idxes"]]] = True
    assert same_bits(first.final_flow[in_range], second.final_flow[in_range])
    if ego_T_lidar is None:
        assert same_bits(first.final_flow, second.final_flow)
    else:  # rows that are left out keep the harness's own pose flow, which is that of another frame
        assert same_bits(second.final_flow[~in_range], second.pose_flow[~in_range])
    ground = first.batch["gm0"]
    assert same_bits(first.final_flow[ground], first.pose_flow[ground])


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_harness_s_matmul_precision_changes_nothing(variant: str, small: Path) -> None:
    model, batch = CFlow(**VARIANTS[variant]), osf.path_b(osf.load(small, 5, 6))
    expected = answer(model, batch)["flow"][0]
    try:
        torch.set_float32_matmul_precision("medium")
        assert same_bits(answer(model, batch)["flow"][0], expected)
    finally:
        torch.set_float32_matmul_precision("highest")


@pytest.mark.parametrize("key", ["pc0", "pc1", "pch1"])
def test_rows_of_nan_beside_a_mask(key: str, small: Path) -> None:
    """Some data sets store NaN for no return: such rows are no points, and every other row has its flow."""
    model, batch = CFlow(**VARIANTS["dense"]), osf.path_b(osf.load(small, 5, 6), top_num_frames=6)
    expected = answer(model, batch)["flow"][0]
    nan = torch.full((1, 3, 3), float("nan"))
    index = key[2:]
    holed = {
        **batch,
        key: torch.cat([nan, batch[key]], dim=1),
        f"gm{index}": torch.cat([torch.zeros(1, 3, dtype=torch.bool), batch[f"gm{index}"]], dim=1),
    }
    if key == "pc0":
        holed["origin_pc0"] = torch.cat([nan, batch["origin_pc0"]], dim=1)
    with torch.inference_mode():
        outcome = osf.run(model, holed)
    flow = outcome.answer["flow"]
    assert same_bits(flow[3:] if key == "pc0" else flow, expected)
    if key == "pc0":
        assert not flow[:3].any() and outcome.final_flow[:3].isnan().all() and not outcome.final_flow[3:].isnan().any()


def test_empty_and_all_ground(small: Path) -> None:
    model, raw = CFlow(**VARIANTS["dense"]), osf.load(small, 5, 6)
    for end in ("0", "1", "h2"):
        bare = {**raw, f"gm{end}": torch.ones_like(raw[f"gm{end}"])}
        with torch.inference_mode():
            outcome = osf.run(model, osf.path_b(bare, top_num_frames=6))
        assert outcome.final_flow.shape == outcome.pose_flow.shape and outcome.final_flow.isfinite().all()
        if end != "h2":
            assert same_bits(outcome.final_flow, outcome.pose_flow), "nothing to match, nothing found"


def test_truth_in_the_batch_is_not_read(small: Path) -> None:
    model, batch = CFlow(**VARIANTS["dense"]), osf.path_b(osf.load(small, 5, 6))
    expected = answer(model, batch)["flow"][0]
    without = {k: v for k, v in batch.items() if not k.startswith(("flow", "eval", "ego", "lidar"))}
    assert same_bits(answer(model, without)["flow"][0], expected)


def test_less_history_than_asked_for_is_said_once(small: Path) -> None:
    model, batch = CFlow(**VARIANTS["dense"]), osf.path_a(osf.load(small, 5, 2))
    with pytest.warns(UserWarning, match="num_frames") as said:
        found = answer(model, batch)
        again = answer(model, batch)
    assert len(said) == 1
    assert same_bits(found["flow"][0], core(small, "dense", 5, 2)) and same_bits(again["flow"][0], found["flow"][0])


# ---------------------------------------------------------------------------------------------- the module: bad batches


def broken(batch: osf.Batch, key: str, value: Any) -> osf.Batch:
    """The batch with a key replaced: None = taken out, a function = applied."""
    new = dict(batch)
    old = new.pop(key)
    if value is not None:
        new[key] = value(old.clone())
    return new


def with_nan(tensor: Tensor) -> Tensor:
    tensor[0, 1, 3] = float("nan")
    return tensor


BAD = {
    "missing": (None, ["pc0", "pc1", "pose0", "pose1", "poseh1", "poseh4"]),
    "NaN": (with_nan, ["pose0", "pose1", "poseh1", "poseh3"]),
    "infinite": (lambda t: t + float("inf"), ["pose1"]),
    "two columns": (lambda t: t[..., :2], ["pc0", "pc1", "pch2"]),
    "whole numbers": (lambda t: t.long(), ["pc0", "pc1", "pch1"]),
    "one dimension too few": (lambda t: t[0], ["pc0", "pch1", "pose0", "poseh2", "gm0"]),
    "3 x 4": (lambda t: t[:, :3], ["pose0", "pose1", "poseh1"]),
    "not rigid": (lambda t: 2 * t, ["pose0", "pose1", "poseh4"]),
    "no samples": (lambda t: t[:0], ["pc0", "pc1", "pose1", "gm0", "gmh1"]),
    "of another sweep": (lambda t: t[:, :-7], ["gm0", "gm1", "gmh1", "gmh4"]),
    "no mask": (lambda t: t.float(), ["gm0", "gm1", "gmh2"]),
    "an array": (lambda t: t.numpy(), ["pc0", "pch3"]),
    "a word": (lambda t: "pose", ["pose0", "pose1", "poseh1"]),
    "nothing": (lambda t: None, ["pc0", "pc1", "pose1", "gm0"]),
}


@pytest.mark.parametrize(("what", "key"), [(what, key) for what, (_, keys) in BAD.items() for key in keys])
def test_a_bad_batch_is_named(what: str, key: str, small: Path) -> None:
    batch = broken(osf.path_b(osf.load(small, 5, 6)), key, BAD[what][0])
    with pytest.raises(CFlowError, match=f"['\"]{key}['\"]"):
        answer(CFlow(**VARIANTS["dense"]), batch)


# ---------------------------------------------------------------------------------------------- the module: as a module


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_to_learn_load_or_reset(variant: str, small: Path) -> None:
    model, batch = CFlow(**VARIANTS[variant]), osf.path_b(osf.load(small, 5, 6))
    assert not list(model.parameters()) and not list(model.buffers()) and not model.state_dict()
    learnt = (nn.modules.conv._ConvNd, nn.Linear, nn.modules.batchnorm._BatchNorm)
    assert not [module for module in model.modules() if isinstance(module, learnt)]
    expected = answer(model, batch)["flow"][0]
    model.apply(osf.reset_weights)
    model.load_state_dict({}, strict=True)
    model = model.to("cpu").eval().train()
    assert same_bits(answer(model, batch)["flow"][0], expected)


class FakeTiming:
    """Notes what is asked of it, as `dztimer.Timing` takes it."""

    def __init__(self) -> None:
        self.calls: List[str] = []
        self.parts: Dict[int, FakeTiming] = {}

    def __getitem__(self, key: int) -> FakeTiming:
        return self.parts.setdefault(key, FakeTiming())

    def start(self, name: str) -> None:
        self.calls.append(name)

    def stop(self) -> None:
        self.calls.append("stop")

    def print(self, random_colors: bool = False, bold: bool = False) -> None:
        self.calls.append("print")


def test_timer_of_the_harness(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = types.ModuleType("dztimer")
    fake.Timing = FakeTiming  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "dztimer", fake)
    model = CFlow(**VARIANTS["dense"])
    assert isinstance(model.timer, FakeTiming)
    osf.run(model, osf.path_b(osf.load(small, 5, 6)))
    assert model.timer[12].calls == ["One Scan", "stop"]


def test_no_timer_installed(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dztimer", None)
    model = CFlow(**VARIANTS["dense"])
    osf.run(model, osf.path_b(osf.load(small, 5, 6)))
    model.timer[5].start("Training Step")
    model.timer[5][1].start("Compute Loss")
    model.timer[5][1].stop()
    model.timer.print(random_colors=False, bold=False)


def test_unknown_settings_are_named_not_fatal() -> None:
    with pytest.warns(UserWarning, match="decoder_option, num_iters"):
        CFlow(num_iters=4, decoder_option="gru", voxel_size=[0.2, 0.2, 6], grid_feature_size=[512, 512, 1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CFlow(voxel_size=[0.2, 0.2, 6], grid_feature_size=[512, 512, 1])


@pytest.mark.parametrize(
    "settings",
    [
        {"output": "half"},
        {"num_frames": 1},
        {"num_frames": 2.5},
        {"method": "keypoints", "num_frames": 6},
        {"pixel_sizes": [0.1, 0.2]},
        {"ego_T_lidar": "yes"},
        {"ego_T_lidar": [[1, 2], [3, 4]]},
    ],
)
def test_bad_settings(settings: Dict[str, Any]) -> None:
    with pytest.raises(CFlowError):
        CFlow(**settings)


# ---------------------------------------------------------------------------------------------- the harness's scripts


def test_save_writes_the_total_flow(small: Path, tmp_path: Path) -> None:
    for file in small.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    model = CFlow(**{**VARIANTS["dense"], "num_frames": 4})
    for _ in range(2):
        osf.save(model, tmp_path, "cflow", num_frames=4)
    index = 5
    with HDF5Log(tmp_path / "drive-0.h5", ego_T_lidar=None) as log:
        written = [k for k in range(7) if "cflow" in log.keys(k)]
        assert written == [2, 3, 4, 5], "sweeps with a whole history and a successor"
        stored, sweep = log.values(index, "cflow"), log.sweep(index)
        T = np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose
    assert stored.dtype == np.float32
    residual = np.zeros_like(stored)
    residual[~sweep.is_ground] = core(small, "dense", index, 4)
    points = sweep.points.astype(np.float64)
    np.testing.assert_allclose(stored, moved(T, points) - points + residual, rtol=0, atol=2e-3)


@pytest.mark.parametrize("path", ["A", "B"])
def test_scores_over_scenes(path: str, small: Path) -> None:
    model = CFlow(**VARIANTS["dense"])
    results = osf.evaluate(model, small, num_frames=6, top_num_frames=6, path=path)
    assert results["num_frames"] == 12 and results["num_nan"] == 0
    again = osf.evaluate(model, small, num_frames=6, top_num_frames=2)
    assert plain_scores(results) == plain_scores(again), "whatever the layout"


def test_checkpoint_without_weights(tmp_path: Path) -> None:
    file = write_null_checkpoint(tmp_path / "mine.ckpt")
    stored = torch.load(file, weights_only=True)
    assert stored["state_dict"] == {} and stored["epoch"] == 0 and stored["global_step"] == 0
    assert stored["pytorch-lightning_version"].count(".") == 2
    cfg = stored["hyper_parameters"]["cfg"]
    assert cfg == {"model": {"name": "mine"}, "output": "mine", "num_frames": 2}, "no target: the YAML's stays"
    assert stored["hyper_parameters"]["eval"] is True

    def plain(value: Any) -> bool:
        if type(value) is dict:
            return all(type(key) is str and plain(inner) for key, inner in value.items())
        return type(value) in (str, int, bool)

    assert plain(stored)
    with pytest.raises(CFlowError, match="mine.ckpt"):
        write_null_checkpoint(file)


def test_checkpoint_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    file = tmp_path / "cflow.ckpt"
    monkeypatch.setattr(sys, "argv", ["opensceneflow", str(file)])
    assert write_checkpoint() == 0 and str(file) in capsys.readouterr().out
    assert torch.load(file, weights_only=True)["hyper_parameters"]["cfg"]["model"] == {"name": "cflow"}
    assert write_checkpoint() == 1 and "overwrite" in capsys.readouterr().err


EVAL_YAML = """
dataset_path: ???
checkpoint: ???
data_mode: val
save_res: false
leaderboard_version: 1
supervised_flag: true
num_frames: 2
slurm_id: 00000
output: ${model.name}-${slurm_id}
gpus: 1
seed: 42069
defaults:
  - hydra: default
  - model: deflow
"""
SEARCH = "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]"


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    """A stand-in for the harness's `conf`: a model of its own, and `eval.yaml`."""
    folder = tmp_path / "conf"
    for name in ("hydra", "model"):
        (folder / name).mkdir(parents=True)
    (folder / "eval.yaml").write_text(EVAL_YAML)
    (folder / "hydra" / "default.yaml").write_text(f"run:\n  dir: {tmp_path}/logs\nsweep:\n  dir: {tmp_path}/logs\n")
    (folder / "model" / "deflow.yaml").write_text("name: deflow\ntarget:\n  _target_: builtins.dict\n")
    return folder


def composed(conf: Path, *overrides: str) -> Any:
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(conf), version_base=None):
        return compose("eval", [SEARCH, "dataset_path=data", "checkpoint=x.ckpt", *overrides])


@pytest.mark.parametrize(("name", "preset"), [("cflow", "default"), ("cflow_keypoints", "keypoints")])
def test_configuration_is_found_and_is_the_preset(name: str, preset: str, conf: Path, tmp_path: Path) -> None:
    from omegaconf import OmegaConf

    checkpoint = write_null_checkpoint(tmp_path / "cflow.ckpt")
    cfg = composed(conf, f"model={name}")
    assert cfg.model.name == name and not cfg.model.get("iter_only", False)
    target = OmegaConf.to_container(cfg.model.target, resolve=False)
    assert "${" not in json.dumps(target), "eval.yaml and save.yaml have nothing to refer to"
    tunable = {"num_frames", "ego_T_lidar", "output", "device", *Config().as_dict()} - {"num_history"}
    assert set(target) == {"_target_", "voxel_size", *tunable}
    expected = make_config(preset).as_dict()
    for key in set(expected) - {"num_history", "point_cloud_range"}:
        assert target[key] == expected[key], key
    assert target["num_frames"] == expected["num_history"] + 2
    low, high = target["point_cloud_range"][:3], target["point_cloud_range"][3:]
    assert np.isfinite(low + high).all() and low[:2] + high[:2] == expected["point_cloud_range"][:2] + high[:2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = osf.build(cfg, checkpoint)
    assert isinstance(model, CFlow) and cfg.output == "cflow-e0-val-v1"
    cells = [int((b - a) / size) for a, b, size in zip(low, high, target["voxel_size"])]
    assert list(cfg.model.target.grid_feature_size) == cells and all(cell >= 1 for cell in cells)
    assert model.config == make_config(preset, point_cloud_range=tuple(low + high))


@pytest.mark.parametrize("name", ["cflow", "cflow_keypoints"])
def test_every_setting_can_be_overridden_without_plus(name: str, conf: Path, tmp_path: Path) -> None:
    from hydra.errors import ConfigCompositionException

    changes = {
        "pixel_sizes": "[0.3]",
        "point_cloud_range": "[-20,-20,-5,20,20,5]",
        "connectivity": "4",
        "max_extent": "11.5",
        "max_speed": "40",
        "sweep_interval": "0.2",
        "sectional_view": "true",
        "clustering": "hdbscan",
        "min_cluster_size": "7",
        "correlation": "conv",
        "densify": "nearest",
        "patch_size": "21",
        "ratio_threshold": "1.3",
        "gate_radius": "1.5",
        "mutual_check": "true",
        "second_best_distance": "2.0",
        "max_memory": "100000000",
        "device": "cpu",
        "output": "valid",
        "proof": "false",
        "height_slices": "0",
        "ego_T_lidar": str(EGO_T_LIDAR.tolist()).replace(" ", ""),
    }
    cfg = composed(conf, f"model={name}", *(f"model.target.{key}={value}" for key, value in changes.items()))
    model = osf.build(cfg, write_null_checkpoint(tmp_path / "cflow.ckpt"))
    fields = {key: value for key, value in model.config.as_dict().items() if key in changes}
    assert len(fields) == 19
    for key, value in fields.items():
        assert value == yaml.safe_load(changes[key]), key
    assert model.output == "valid" and np.allclose(model.ego_T_lidar, EGO_T_LIDAR)
    with pytest.raises(ConfigCompositionException):
        composed(conf, f"model={name}", "model.target.no_such_setting=1")


def test_a_sweep_by_the_harness_s_own_m(
    conf: Path, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hydra

    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "val").symlink_to(small, target_is_directory=True)
    checkpoint = write_null_checkpoint(tmp_path / "cflow.ckpt")
    scores: Dict[float, float] = {}

    def script(cfg: Any) -> None:
        model = osf.build(cfg, Path(cfg.checkpoint))
        folder = Path(cfg.dataset_path) / cfg.data_mode
        frames = {"num_frames": cfg.model.target.num_frames, "top_num_frames": cfg.num_frames}
        scores[cfg.model.target.pixel_sizes[0]] = osf.evaluate(model, folder, **frames)["three_way"]["epe_3way"]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        sys,
        "argv",
        [
            *("eval.py", "-m", SEARCH, "hydra/job_logging=none", "hydra/hydra_logging=none", "model=cflow"),
            *(f"checkpoint={checkpoint}", f"dataset_path={tmp_path / 'data'}", "model.target.max_extent=5"),
            "model.target.pixel_sizes=[0.5],[0.25],[0.2]",
        ],
    )
    hydra.main(version_base=None, config_path=str(conf), config_name="eval")(script)()
    assert sorted(scores) == [0.2, 0.25, 0.5] and len(set(scores.values())) == 3


# ---------------------------------------------------------------------------------------------- ego_T_lidar


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with points in the sensor frame and poses of the ego frame, which the file does not tell."""
    settings = {"points_frame": "sensor", "ego_T_lidar": EGO_T_LIDAR, "store_extrinsics": False}
    return store(tmp_path_factory.mktemp("sensor"), SmallDrive(0), **settings)


@pytest.mark.parametrize("given", [EGO_T_LIDAR, EGO_T_LIDAR.tolist(), torch.from_numpy(EGO_T_LIDAR)])
def test_extrinsics_mend_the_harness_s_pose_flow(given: Any, sensor: Path) -> None:
    index = 5
    model = CFlow(**VARIANTS["dense"], ego_T_lidar=given)
    with torch.inference_mode():
        outcome = osf.run(model, osf.path_b(osf.load(sensor, index, 6)))
    with HDF5Log(sensor / "drive-0.h5", ego_T_lidar=EGO_T_LIDAR) as log:
        sweep = log.sweep(index)
        T_lidar = np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose
    rows = ~sweep.is_ground
    points = sweep.points[rows].astype(np.float64)
    expected = moved(T_lidar, points) - points + core(sensor, "dense", index, 6, EGO_T_LIDAR).numpy()
    found = outcome.final_flow.numpy()[rows]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)  # the harness rounds poses 5 km away
    T = np.linalg.inv(log_pose(sensor, index + 1)) @ log_pose(sensor, index)
    correction = moved(T_lidar, points) - moved(T, points)
    assert np.abs(correction).max() > 0.02, "without extrinsics the static world would move"
    residual = core(sensor, "dense", index, 6, EGO_T_LIDAR).numpy()
    np.testing.assert_allclose(outcome.answer["flow"].numpy(), residual + correction, rtol=0, atol=1e-3)


def log_pose(folder: Path, index: int) -> np.ndarray:
    """(4, 4) float64 pose as it is stored."""
    with HDF5Log(folder / "drive-0.h5", ego_T_lidar=None) as log:
        return np.asarray(log.sweep(index).pose)


@pytest.mark.parametrize(
    ("height", "first_stamp", "recognized"),
    [(-1.6, AV2_STAMP, True), (0.0, AV2_STAMP, False), (-1.6, 10**18, False)],
    ids=["av2-sensor", "av2-ego", "another-set"],
)
def test_auto_recognizes_argoverse(height: float, first_stamp: int, recognized: bool, tmp_path: Path) -> None:
    store(tmp_path, SmallDrive(0, first_stamp, height))
    settings = {**VARIANTS["dense"], "point_cloud_range": [-8, -7, -10, 8, 7, 10]}
    raw = osf.load(tmp_path, 5, 6)
    extrinsics = recognized_extrinsics(first_stamp, raw["pc0"][0].numpy(), raw["gm0"][0].numpy())
    assert np.array_equal(extrinsics, np.eye(4)) != recognized
    explicit = CFlow(**settings, ego_T_lidar=extrinsics if recognized else None)
    for layout in (osf.path_a, osf.path_b):
        found = answer(CFlow(**settings, ego_T_lidar="auto"), layout(raw))["flow"][0]
        assert same_bits(found, answer(explicit, layout(raw))["flow"][0])
        assert same_bits(found, answer(CFlow(**settings), layout(raw))["flow"][0]) != recognized


# ---------------------------------------------------------------------------------------------- the real pair


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


def plain_scores(results: Dict[str, Any]) -> Dict[str, float]:
    """Every finite number of the results, by its path; files have null for the others."""
    found: Dict[str, float] = {}

    def walk(path: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{path}/{key}", inner)
        elif isinstance(value, (list, tuple)):
            for key, inner in enumerate(value):
                walk(f"{path}/{key}", inner)
        elif isinstance(value, (int, float)) and np.isfinite(value):
            found[path] = float(value)

    walk("", results)
    return found


def test_auto_takes_a_time_stamp_as_a_tensor() -> None:
    points = torch.tensor([[[5.0, 0.0, -2.0], [6.0, 0.0, -2.0], [6.0, 1.0, float("nan")], [7.0, 0.0, 0.5]]])
    batch = {
        "pc0": points,
        "pc1": points,
        "gm0": torch.tensor([[True, True, True, False]]),
        "gm1": torch.tensor([[True, True, True, False]]),
        "pose0": pose_matrix()[None],
        "pose1": torch.eye(4)[None],
    }
    flows = [
        CFlow(num_frames=2, ego_T_lidar="auto")({**batch, "timestamp": stamp})["flow"][0]
        for stamp in (["315966070559696000"], torch.tensor([315966070559696000]), torch.tensor([1]))
    ]
    assert torch.equal(flows[0], flows[1]) and not torch.equal(flows[0], flows[2])


def test_ground_without_height_recognizes_nothing() -> None:
    points = np.full((4, 3), np.nan, np.float32)
    found = recognized_extrinsics(315_966_070_559_696_000, points, np.ones(4, bool))
    assert np.array_equal(found, np.eye(4))


def pose_matrix() -> torch.Tensor:
    """A turn, so that it matters where the LiDAR sits."""
    pose = torch.eye(4)
    pose[:2, :2] = torch.tensor([[0.995004165, -0.099833417], [0.099833417, 0.995004165]])
    return pose


@pytest.mark.parametrize("points_frame", ["ego", "sensor"])
@pytest.mark.parametrize("pose_dtype", ["float32", "float64"])
@pytest.mark.parametrize("model", ["default", "keypoints"])
def test_real_pair_scores_as_cflow_eval(
    model: str, pose_dtype: str, points_frame: str, av2_folder: Path, tmp_path: Path
) -> None:
    """Batches do not tell the time of t+1, so that the gate of the key points is the one for 0.1 s; the pair's
    0.100196 s make a gate of 2 m a little wider. A gate of 2.03 m and the wider one hold the same pixels. Nor do they
    hold ground, so `clearance` has nothing to go by."""
    extrinsics = up_lidar(av2_folder) if points_frame == "sensor" else None
    layout = {"points_frame": points_frame, "ego_T_lidar": extrinsics, "pose_dtype": pose_dtype}
    folder, out = store_real(tmp_path / "scenes", av2_folder, **layout), tmp_path / "out"
    call = ["eval", "data=hdf5", f"data.root={folder}", f"model={model}", "definition=opensceneflow", f"output={out}"]
    main([*call, "model.gate_radius=2.03", "model.clearance=null"])
    expected = plain_scores(json.loads((out / "results.json").read_text())["results"])
    settings = make_config(model, gate_radius=2.03).as_dict()
    num_frames = settings.pop("num_history") + 2
    module = CFlow(**settings, num_frames=num_frames, ego_T_lidar=extrinsics)
    for path in ("A", "B"):
        found = plain_scores(osf.evaluate(module, folder, num_frames=num_frames, top_num_frames=num_frames, path=path))
        assert found == expected


def test_real_pair_is_worth_it(own: Path) -> None:
    """Both variants on the harness's own scene, as a user runs them: far better than standing still."""
    for preset, frames in (("default", 6), ("keypoints", 2)):
        settings = make_config(preset).as_dict()
        settings.pop("num_history")
        module = CFlow(**settings, num_frames=frames, ego_T_lidar="auto")
        results = osf.evaluate(module, own, num_frames=frames)
        assert results["three_way"]["epe_fd"] < 0.25, preset  # 0.676812 without any motion
        assert results["three_way"]["epe_bs"] < 0.0081513, f"{preset}: static points stay put better than with zeros"
        assert results["num_nan"] == 0
