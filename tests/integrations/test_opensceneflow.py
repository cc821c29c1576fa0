"""`CFlow`, the model of OpenSceneFlow, on batches as that harness makes them.

tests/integrations/test_opensceneflow_end_to_end.py runs the harness itself.
"""

from __future__ import annotations

import copy
import json
import sys
import warnings
from pathlib import Path
from typing import Any, Dict, Sequence

import numpy as np
import pytest
import torch
from scenes import RANGE, pose, same_bits, scene
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from cflow_torch import CFlowError, Sweep, Window, make_config, make_model
from cflow_torch.data.hdf5.frames import harness_motion, harness_pose_flow, recognized_extrinsics
from cflow_torch.integrations.opensceneflow import CFlow
from cflow_torch.integrations.opensceneflow.__main__ import main as write_checkpoint
from cflow_torch.transforms import transform_points

Batch = Dict[str, Any]
SMALL = {"pixel_sizes": [0.25], "point_cloud_range": list(RANGE)}
VARIANTS: dict[str, dict[str, Any]] = {
    "dense": {"preset": "paper", "num_frames": 6, **SMALL, "max_extent": 5.0},
    # Batches contain no ground, so no height above ground is known.
    "verified": {"preset": "default", "num_frames": 6, **SMALL, "min_height": None, "significance": 0.0},
    "keypoints": {**SMALL, "preset": "keypoints", "patch_size": 11, "ratio_threshold": 1.0, "pixel_sizes": [0.1]},
}
EGO_T_LIDAR = np.array([[0.8, -0.6, 0, 1.35], [0.6, 0.8, 0, 0.2], [0, 0, 1, 1.6], [0, 0, 0, 1]])
AV2_STAMP = 315_966_265_259_836_000  # Argoverse 2 has an epoch of its own
PLACE = pose(5400.0, -1200.0, 0.7, 12.0)  # city coordinates are far from the origin


def small_drive(seed: int = 0, raised: float = 0.0) -> list[Sweep]:
    """Seven sweeps, oldest first, of `scenes.scene` without NaN and infinite points, far from the world's origin."""
    made = scene(seed, num_history=5)
    sweeps = []
    for index, sweep in enumerate((*made.pch[::-1], made.pc0, made.pc1)):
        finite = np.isfinite(sweep.points).all(axis=1)
        finite[: index + 10 * seed] = False  # every sweep has a different number of points
        points = (sweep.points + np.float32([0, 0, raised]))[finite]
        sweeps.append(Sweep(points, sweep.is_ground[finite], (PLACE @ sweep.pose).astype(np.float32)))
    return sweeps


def make_batch(sweeps: Sequence[Sweep], index: int, num_frames: int = 6, filtered: Any = 0, stamp: int = 0) -> Batch:
    """A batch of one as eval.py passes it to a model.

    pc0, pc1 and the first `filtered` history sweeps have no ground any more; all masks keep their full length. Before
    the first sweep of the scene, the first sweep is repeated.
    """
    ends = {"0": index, "1": index + 1, **{f"h{i}": max(index - i, 0) for i in range(1, num_frames - 1)}}
    batch: Batch = {"scene_id": ["drive"], "timestamp": [str(stamp)], "eval_flag": torch.tensor([True])}
    for name, source in ends.items():
        sweep = sweeps[source]
        points, is_ground = torch.from_numpy(sweep.points), torch.from_numpy(sweep.is_ground)
        is_filtered = name in "01" or int(name[1:]) <= filtered
        batch[f"pc{name}"] = (points[~is_ground] if is_filtered else points)[None]
        batch[f"gm{name}"], batch[f"pose{name}"] = is_ground[None], torch.from_numpy(sweep.pose)[None]
    truth = torch.full_like(batch["pc0"], float("nan"))  # which no method may read
    return {**batch, "origin_pc0": torch.from_numpy(sweeps[index].points)[None], "flow": truth}


def make_training_batch(drives: Sequence[Sequence[Sweep]], index: int, num_frames: int = 6) -> Batch:
    """Frames of several drives as train.py collates them: no ground, no masks, padding with NaN, lists of poses."""
    single = [make_batch(sweeps, index, num_frames, filtered=num_frames) for sweeps in drives]
    batch: Batch = {}
    for key in single[0]:
        values = [one[key][0] for one in single]
        if key.startswith("pose"):
            batch[key] = values
        elif key.startswith("pc"):
            batch[key] = pad_sequence(values, batch_first=True, padding_value=float("nan"))
    return batch


def estimate(model: nn.Module, batch: Batch) -> dict[str, list[Tensor]]:
    with torch.inference_mode():
        return model(batch)


def total_flow(model: nn.Module, batch: Batch) -> Tensor:
    """(N, 3) total flow as eval.py assembles it: its own pose flow, plus what the model returns off the ground."""
    found = estimate(model, batch)
    total = harness_pose_flow(batch["origin_pc0"][0], harness_motion(batch["pose0"][0], batch["pose1"][0]))
    rows = (~batch["gm0"][0]).nonzero()[:, 0][found["pc0_valid_point_idxes"][0]]
    total[rows] += found["flow"][0]
    return total


def residual_of_method(
    sweeps: Sequence[Sweep], variant: str, index: int, num_frames: int, ego_T_lidar: np.ndarray | None = None
) -> Tensor:
    """(N', 3) residual flow of the points that are not ground, by the method itself."""
    settings = {key: value for key, value in VARIANTS[variant].items() if key != "num_frames"}
    history = {} if variant == "keypoints" else {"num_history": num_frames - 2}
    extrinsics = np.eye(4) if ego_T_lidar is None else ego_T_lidar
    own = [Sweep(s.points[~s.is_ground], None, s.pose.astype(np.float64) @ extrinsics) for s in sweeps]
    pch = tuple(own[max(index + 2 - num_frames, 0) : index][::-1])
    (result,) = make_model(make_config(**settings, **history))([Window(own[index], own[index + 1], pch)])
    return result.residual_flow


@pytest.fixture(scope="module")
def drive() -> list[Sweep]:
    return small_drive()


@pytest.mark.parametrize(
    ("variant", "num_frames", "index"),
    [
        *(("dense", 2, 5), ("keypoints", 2, 5)),
        # 2 and 0: the harness repeats the first sweep in place of older ones.
        *(("dense", 6, 2), ("dense", 4, 0), ("verified", 6, 4), ("verified", 6, 0)),
        *(pytest.param("dense", 4, index, marks=pytest.mark.slow) for index in (5, 2)),
        *(pytest.param("dense", 6, index, marks=pytest.mark.slow) for index in (5, 0)),
        pytest.param("verified", 6, 2, marks=pytest.mark.slow),
    ],
)
def test_every_layout_gives_the_flow_of_the_method(variant, num_frames, index, drive):
    expected = residual_of_method(drive, variant, index, num_frames)
    if (variant, index) != ("verified", 0):  # two sweeps with so few points are not enough evidence of motion
        assert (expected.norm(dim=1) > 0.05).sum() > 50, "there is motion to find"
    model = CFlow(**{**VARIANTS[variant], "num_frames": num_frames})
    full = make_batch(drive, index, num_frames)
    layouts = {
        "history with ground": full,
        "history without ground": make_batch(drive, index, num_frames, filtered=4),
        "part of the history without ground": make_batch(drive, index, num_frames, filtered=1),
        "float64": {k: v.double() if k.startswith(("pc", "pose")) else v for k, v in full.items()},
        "lists": {k: list(v) if k.startswith(("pc", "pose", "gm")) else v for k, v in full.items()},
        "training": make_training_batch([drive], index, num_frames),
    }
    for name, batch in layouts.items():
        before = copy.deepcopy(batch)
        found = estimate(model, batch)
        assert same_bits(found["flow"][0], expected), name
        assert found["pc0_valid_point_idxes"][0].tolist() == list(range(len(expected))), name
        assert list(before) == list(batch), "the batch has the same keys"
        assert all(same_bits(value, before[key]) for key, value in batch.items() if isinstance(value, Tensor)), name


@pytest.mark.parametrize("variant", VARIANTS)
def test_padding_changes_nothing(variant: str, drive: list[Sweep]) -> None:
    model = CFlow(**VARIANTS[variant], output="valid")
    drives = [drive, small_drive(1)]
    together = make_training_batch(drives, 5)
    found = estimate(model, together)
    assert len({len(flow) for flow in found["flow"]}) == 2
    for b, sweeps in enumerate(drives):
        alone = estimate(model, make_training_batch([sweeps], 5))
        for key in ("flow", "pc0_valid_point_idxes"):
            assert same_bits(found[key][b], alone[key][0]), key
        assert same_bits(found["flow"][b], estimate(model, make_batch(sweeps, 5))["flow"][0])
        rows = found["pc0_valid_point_idxes"][b]
        assert found["pose_flow"][b].shape == together["pc0"][b].shape
        T = harness_motion(together["pose0"][b], together["pose1"][b])
        pose_flow = harness_pose_flow(together["pc0"][b], T)[rows]
        assert (found["pose_flow"][b][rows] - pose_flow).abs().max() < 1e-5


def test_full_and_valid_output_give_the_same_total_flow(drive: list[Sweep]) -> None:
    batch = make_batch(drive, 5)
    full, valid = (CFlow(**VARIANTS["dense"], output=output) for output in ("full", "valid"))
    first = total_flow(full, batch)
    assert same_bits(first, total_flow(valid, batch))
    assert 0 < len(estimate(valid, batch)["pc0_valid_point_idxes"][0]) < batch["pc0"].shape[1]
    pose_flow = harness_pose_flow(batch["origin_pc0"][0], harness_motion(batch["pose0"][0], batch["pose1"][0]))
    assert same_bits(first[batch["gm0"][0]], pose_flow[batch["gm0"][0]])


def test_rows_of_nan_in_a_batch_with_masks_are_ignored(drive: list[Sweep]) -> None:
    """Some data sets store NaN where a beam has no return."""
    model, batch = CFlow(**VARIANTS["dense"]), make_batch(drive, 5, filtered=4)
    expected = total_flow(model, batch)
    nan, no_ground = torch.full((1, 3, 3), float("nan")), torch.zeros(1, 3, dtype=torch.bool)
    for end in ("0", "1", "h1"):
        batch[f"pc{end}"] = torch.cat([nan, batch[f"pc{end}"]], dim=1)
        batch[f"gm{end}"] = torch.cat([no_ground, batch[f"gm{end}"]], dim=1)
    batch["origin_pc0"] = torch.cat([nan, batch["origin_pc0"]], dim=1)
    assert not estimate(model, batch)["flow"][0][:3].any()
    total = total_flow(model, batch)
    assert same_bits(total[3:], expected) and total[:3].isnan().all()


def test_one_warning_about_less_history_than_num_frames(drive: list[Sweep]) -> None:
    model, batch = CFlow(**VARIANTS["dense"]), make_batch(drive, 5, num_frames=2)
    with pytest.warns(UserWarning, match="num_frames") as caught:
        found, again = (estimate(model, batch)["flow"][0] for _ in range(2))
    assert len(caught) == 1
    assert same_bits(found, residual_of_method(drive, "dense", 5, 2)) and same_bits(again, found)


BAD: dict[str, Any] = {
    "missing": (None, ["pc0", "pose0", "poseh4"]),
    "NaN": (lambda t: t * float("nan"), ["pose1"]),
    "one dimension too few": (lambda t: t[0], ["pc0", "pose0", "gm0"]),
    "not rigid": (lambda t: 2 * t, ["poseh4"]),
    "no samples": (lambda t: t[:0], ["pc1", "gmh1"]),
    "of another sweep": (lambda t: t[:, :-7], ["gm0", "gmh4"]),
    "nothing": (lambda t: None, ["pose1", "gm0"]),
}


@pytest.mark.parametrize(("what", "key"), [(what, key) for what, (_, keys) in BAD.items() for key in keys])
def test_the_error_names_the_bad_key_of_a_batch(what: str, key: str, drive: list[Sweep]) -> None:
    batch, change = make_batch(drive, 5), BAD[what][0]
    old = batch.pop(key)
    if change is not None:
        batch[key] = change(old.clone())
    with pytest.raises(CFlowError, match=f"['\"]{key}['\"]"):
        estimate(CFlow(**VARIANTS["dense"]), batch)


def test_settings_of_the_method_and_others() -> None:
    assert CFlow().config == make_config() and CFlow(preset="paper").config == make_config("paper")
    assert CFlow(preset="paper", num_frames=4).config == make_config("paper", num_history=2)
    assert CFlow(preset="keypoints", num_frames=2).config == make_config("keypoints")
    assert CFlow(pixel_size=0.2, voxel_size=[1], grid_feature_size=[1]).config == make_config(pixel_size=0.2)
    names = r"labeling, num_iters, patch_size, proof; .*'verified' has pixel_size"
    with pytest.warns(UserWarning, match=names) as caught:
        model = CFlow(num_iters=4, proof=False, patch_size=11, labeling="kornia", significance=2.0)
    assert len(caught) == 1 and model.config == make_config(significance=2.0)
    wrong: list[dict[str, Any]] = [{"output": "half"}, {"num_frames": 1}, {"num_frames": 2.5}, {"ego_T_lidar": "yes"}]
    wrong += [{"preset": "keypoints", "num_frames": 6}, {"method": "dense"}]
    for settings in (*wrong, {"pixel_sizes": [0.1, 0.2]}, {"ego_T_lidar": [[1, 2], [3, 4]]}):
        with pytest.raises(CFlowError):
            CFlow(**settings)


def test_checkpoint_without_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    file = tmp_path / "mine.ckpt"
    monkeypatch.setattr(sys, "argv", ["opensceneflow", str(file)])
    write_checkpoint()
    assert str(file) in capsys.readouterr().out
    stored = torch.load(file, weights_only=True)
    assert stored.pop("pytorch-lightning_version").count(".") == 2
    cfg = {"model": {"name": "mine"}, "output": "mine", "num_frames": 2}  # without a target, that of the YAML counts
    expected = {"epoch": 0, "global_step": 0, "state_dict": {}, "hyper_parameters": {"cfg": cfg, "eval": True}}
    assert stored == expected and json.loads(json.dumps(stored)) == expected, "plain containers"
    with pytest.raises(SystemExit, match="error: .*mine.ckpt exists already.*overwrite"):
        write_checkpoint()


PRESETS = {"cflow": "default", **{f"cflow_{name}": name for name in ("live", "paper", "keypoints", "paper_keypoints")}}


@pytest.mark.parametrize("name", PRESETS)
def test_configuration_has_every_setting_of_the_preset(name: str) -> None:
    from hydra import compose, initialize_config_module
    from hydra.errors import ConfigCompositionException
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    changes = ["pixel_sizes=[0.3]", "sweep_interval=0.2", "max_speed=null", "output=valid", "ego_T_lidar=null"]
    with initialize_config_module("cflow_torch.configs.opensceneflow", version_base=None):
        cfg = compose(f"model/{name}").model
        changed = compose(f"model/{name}", [f"model.target.{text}" for text in changes]).model
        with pytest.raises(ConfigCompositionException):
            compose(f"model/{name}", ["model.target.no_such_setting=1"])
    assert cfg.name == name and not cfg.iter_only
    target = OmegaConf.to_container(cfg.target, resolve=False)
    assert "${" not in json.dumps(target), "eval.yaml and save.yaml have nothing to refer to"
    expected = make_config(PRESETS[name])
    ours = {"_target_", "preset", "voxel_size", "num_frames", "ego_T_lidar", "output", "device"}
    assert set(target) == ours | (set(expected.as_dict()) - {"method", "num_history", "num_future"}), (
        "overrides need no +"
    )
    x0, y0, _, x1, y1, _ = expected.point_cloud_range
    assert target["point_cloud_range"] == [x0, y0, -1000, x1, y1, 1000], "finite: the harness computes with it"
    expected = expected.replace(point_cloud_range=target["point_cloud_range"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = instantiate(cfg.target, grid_feature_size=[512, 512, 1])
    assert isinstance(model, CFlow) and model.config == expected and not model.state_dict()
    model = instantiate(changed.target)
    assert model.config == expected.replace(pixel_size=0.3, sweep_interval=0.2, max_speed=None)
    assert model.output == "valid" and model.ego_T_lidar is None


def test_extrinsics_correct_the_pose_flow_of_the_harness(drive: list[Sweep]) -> None:
    """The points are those of the sensor and the poses those of the vehicle, which no key of the batch tells."""
    index, inverse = 5, np.linalg.inv(EGO_T_LIDAR)
    seen = [Sweep(transform_points(s.points, inverse).astype(np.float32), s.is_ground, s.pose) for s in drive]
    model = CFlow(**VARIANTS["dense"], ego_T_lidar=EGO_T_LIDAR.tolist())
    batch = make_batch(seen, index)
    total, found = total_flow(model, batch).numpy(), estimate(model, batch)["flow"][0].numpy()
    poses = [seen[i].pose.astype(np.float64) for i in (index, index + 1)]
    T_ego1_ego0 = np.linalg.inv(poses[1]) @ poses[0]
    T_lidar1_lidar0 = inverse @ T_ego1_ego0 @ EGO_T_LIDAR
    rows = ~seen[index].is_ground
    points = seen[index].points[rows].astype(np.float64)
    residual = residual_of_method(seen, "dense", index, 6, EGO_T_LIDAR).numpy()
    expected = transform_points(points, T_lidar1_lidar0) - points + residual
    np.testing.assert_allclose(total[rows], expected, rtol=0, atol=1e-5)
    correction = transform_points(points, T_lidar1_lidar0) - transform_points(points, T_ego1_ego0)
    assert np.abs(correction).max() > 0.02, "without extrinsics the static world would move"
    np.testing.assert_allclose(found, residual + correction, rtol=0, atol=3e-4)
    valid = estimate(CFlow(**VARIANTS["dense"], ego_T_lidar=EGO_T_LIDAR.tolist(), output="valid"), batch)
    np.testing.assert_array_equal(valid["flow"][0], found[valid["pc0_valid_point_idxes"][0]])


@pytest.mark.parametrize(
    ("height", "stamp", "is_recognized"),
    [(-1.6, AV2_STAMP, True), (0.0, AV2_STAMP, False), (-1.6, 10**18, False)],
    ids=["av2-sensor", "av2-ego", "another-set"],
)
def test_auto_recognizes_argoverse(height: float, stamp: int, is_recognized: bool) -> None:
    sweeps = small_drive(raised=height)
    settings = {**VARIANTS["dense"], "point_cloud_range": [-8, -7, -10, 8, 7, 10]}
    extrinsics = recognized_extrinsics(stamp, sweeps[5].points, sweeps[5].is_ground)
    assert np.array_equal(extrinsics, np.eye(4)) != is_recognized
    models = [CFlow(**settings, ego_T_lidar=given) for given in ("auto", extrinsics if is_recognized else None, None)]
    batch = make_batch(sweeps, 5, stamp=stamp)
    for given in (batch, {**batch, "timestamp": torch.tensor([stamp])}):
        auto, explicit, without = (estimate(model, given)["flow"][0] for model in models)
        assert same_bits(auto, explicit) and same_bits(auto, without) != is_recognized
    no_height = np.full((4, 3), np.nan, np.float32)
    assert np.array_equal(recognized_extrinsics(stamp, no_height, np.ones(4, bool)), np.eye(4))
