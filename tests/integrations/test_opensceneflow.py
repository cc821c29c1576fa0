"""CorrelationFlow inside OpenSceneFlow, by a replay of that harness (`miniature_opensceneflow`).

The module `CFlow` in every layout that the replay makes.
"""

from __future__ import annotations

import copy
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

pytest.importorskip("h5py")

import miniature_opensceneflow as osf
from scenes import RANGE, pose, same_bits, scene

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.cli.main import main
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.data.hdf5.frames import recognized_extrinsics
from cflow_torch.data.hdf5.writer import write_index_files
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.data.rigid_motion import transform_points
from cflow_torch.integrations.opensceneflow import CFlow, write_null_checkpoint
from cflow_torch.integrations.opensceneflow.__main__ import main as write_checkpoint
from cflow_torch.types import Sweep

SMALL = {"pixel_sizes": [0.25], "point_cloud_range": list(RANGE)}
KEYS = {"method": "keypoints", "patch_size": 11, "ratio_threshold": 1.0}
VARIANTS: dict[str, dict[str, Any]] = {
    "dense": {"method": "dense", "num_frames": 6, **SMALL, "max_extent": 5.0},
    # Batches hold no ground, so there is nothing to stand out of.
    "verified": {"preset": "fast", "num_frames": 6, **SMALL, "min_height": None, "significance": 0.0},
    "keypoints": {**SMALL, **KEYS, "pixel_sizes": [0.1], "max_extent": 5.0},
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

    def labels(self, index: int) -> FlowLabels | None:
        """Some truth, which no method reads."""
        if index == len(self._sweeps) - 1:
            return None
        n = len(self._sweeps[index].points)
        return FlowLabels(np.full((n, 3), 0.5, np.float32), np.full(n, 19, np.uint8), np.ones(n, bool))


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


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


# ---------------------------------------------------------------------------------------------- the module: same flow


def answer(model: nn.Module, batch: osf.Batch) -> dict[str, list[Tensor]]:
    with torch.inference_mode():
        return model(batch)


def core(folder: Path, variant: str, index: int, num_frames: int, ego_T_lidar: Any = None) -> Tensor:
    """(N', 3) residual of the points that are not ground, by the method itself on the scene as our reader reads it."""
    settings = {key: value for key, value in VARIANTS[variant].items() if key != "num_frames"}
    history = {} if variant == "keypoints" else {"num_history": num_frames - 2}
    config = make_config(**settings, **history)
    with HDF5Log(folder / "drive-0.h5", ego_T_lidar=ego_T_lidar) as log:
        sweeps = window(log, index, config.num_history)
    (result,) = make_model(config)([sweeps])
    return result.residual_flow[torch.from_numpy(~sweeps.pc0.is_ground)]


CASES = [("dense", 2), ("dense", 4), ("dense", 6), ("verified", 6), ("keypoints", 2)]


@pytest.mark.parametrize(("variant", "num_frames"), CASES)
@pytest.mark.parametrize("index", [5, 2, 0])  # 2, 0: the harness repeats the first sweep, the core has a shorter window
def test_every_layout_gives_the_method_s_flow(variant: str, num_frames: int, index: int, small: Path) -> None:
    expected = core(small, variant, index, num_frames)
    if (variant, index) != ("verified", 0):  # two sweeps of so few points prove no motion
        assert (expected.norm(dim=1) > 0.05).sum() > 50, "there is motion to find"
    model = CFlow(**{**VARIANTS[variant], "num_frames": num_frames})
    raw = osf.load(small, index, num_frames)
    full = osf.path_b(raw)
    layouts = {
        "history with ground": full,
        "history without ground": osf.path_b(raw, num_frames),
        "part of it": osf.path_b(raw, 3 if num_frames > 2 else 2),
        "second path": osf.path_a(raw),
        "float64": {k: v.double() if k.startswith(("pc", "pose")) else v for k, v in full.items()},
        "lists": {k: list(v) if k.startswith(("pc", "pose", "gm")) else v for k, v in full.items()},
        "training": osf.collate_for_training([osf.SceneDataset(small, num_frames)[index]]),
        "no truth": {k: v for k, v in full.items() if not k.startswith(("flow", "eval", "ego", "lidar"))},
    }
    for name, batch in layouts.items():
        before = copy.deepcopy(batch)
        found = answer(model, batch)
        assert same_bits(found["flow"][0], expected), name
        assert found["pc0_valid_point_idxes"][0].tolist() == list(range(len(expected))), name
        assert list(before) == list(batch), "the batch has the same keys"
        assert all(same_bits(value, before[key]) for key, value in batch.items() if isinstance(value, Tensor)), name


@pytest.mark.parametrize("variant", VARIANTS)
def test_padding_changes_nothing(variant: str, small: Path) -> None:
    model = CFlow(**VARIANTS[variant], output="valid")
    dataset = osf.SceneDataset(small, 6)
    items = [dataset[5], dataset[8]]
    together = osf.collate_for_training(items)
    found = answer(model, together)
    assert len({len(flow) for flow in found["flow"]}) == 2
    for b, item in enumerate(items):
        alone = answer(model, osf.collate_for_training([item]))
        for key in ("flow", "pc0_valid_point_idxes", "pc0_points_lst", "pc1_points_lst"):
            assert same_bits(found[key][b], alone[key][0]), key
        assert same_bits(found["flow"][b], answer(model, osf.path_b(default_collate([item])))["flow"][0])
        rows = found["pc0_valid_point_idxes"][b]
        assert found["pose_flow"][b].shape == together["pc0"][b].shape
        T = osf.relative_pose(together["pose0"][b], together["pose1"][b])
        true_pose_flow = osf.pose_flow_of(together["pc0"][b], T)[rows]
        assert (found["pose_flow"][b][rows] - true_pose_flow).abs().max() < 1e-5
        assert same_bits(found["pc0_points_lst"][b], together["pc0"][b][rows])


@pytest.mark.parametrize("ego_T_lidar", [None, EGO_T_LIDAR], ids=["same-frame", "extrinsics"])
def test_full_and_valid_output_mean_the_same(ego_T_lidar: Any, small: Path) -> None:
    batch = osf.path_b(osf.load(small, 5, 6))
    full, valid = (CFlow(**VARIANTS["dense"], output=output, ego_T_lidar=ego_T_lidar) for output in ("full", "valid"))
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


def test_rows_of_nan_beside_a_mask(small: Path) -> None:
    """Some data sets store NaN for no return: such rows are no points, and every other row has its flow."""
    model, batch = CFlow(**VARIANTS["dense"]), osf.path_b(osf.load(small, 5, 6), top_num_frames=6)
    expected = answer(model, batch)["flow"][0]
    nan, no_ground = torch.full((1, 3, 3), float("nan")), torch.zeros(1, 3, dtype=torch.bool)
    holed = dict(batch)
    for end in ("0", "1", "h1"):
        holed[f"pc{end}"] = torch.cat([nan, batch[f"pc{end}"]], dim=1)
        holed[f"gm{end}"] = torch.cat([no_ground, batch[f"gm{end}"]], dim=1)
    holed["origin_pc0"] = torch.cat([nan, batch["origin_pc0"]], dim=1)
    with torch.inference_mode():
        outcome = osf.run(model, holed)
    flow = outcome.answer["flow"]
    assert same_bits(flow[3:], expected) and not flow[:3].any()
    assert outcome.final_flow[:3].isnan().all() and not outcome.final_flow[3:].isnan().any()


def test_less_history_than_asked_for_is_said_once(small: Path) -> None:
    model, batch = CFlow(**VARIANTS["dense"]), osf.path_a(osf.load(small, 5, 2))
    with pytest.warns(UserWarning, match="num_frames") as said:
        found, again = (answer(model, batch)["flow"][0] for _ in range(2))
    assert len(said) == 1
    assert same_bits(found, core(small, "dense", 5, 2)) and same_bits(again, found)


BAD: dict[str, Any] = {
    "missing": (None, ["pc0", "pose0", "poseh4"]),
    "NaN": (lambda t: t * float("nan"), ["pose1", "poseh3"]),
    "one dimension too few": (lambda t: t[0], ["pc0", "pose0", "gm0"]),
    "not rigid": (lambda t: 2 * t, ["poseh4"]),
    "no samples": (lambda t: t[:0], ["pc1", "pose1", "gmh1"]),
    "of another sweep": (lambda t: t[:, :-7], ["gm0", "gmh4"]),
    "nothing": (lambda t: None, ["pose1", "gm0"]),
}


@pytest.mark.parametrize(("what", "key"), [(what, key) for what, (_, keys) in BAD.items() for key in keys])
def test_a_bad_batch_is_named(what: str, key: str, small: Path) -> None:
    batch, change = osf.path_b(osf.load(small, 5, 6)), BAD[what][0]
    old = batch.pop(key)
    if change is not None:
        batch[key] = change(old.clone())
    with pytest.raises(CFlowError, match=f"['\"]{key}['\"]"):
        answer(CFlow(**VARIANTS["dense"]), batch)


# ---------------------------------------------------------------------------------------------- the module: as a module


def test_settings_of_the_method_and_others() -> None:
    assert CFlow().config == make_config() and CFlow(preset="fast").config == make_config("fast")
    assert CFlow(method="dense", num_frames=4).config == make_config("paper", num_history=2)
    assert CFlow(method="keypoints", num_frames=2).config == make_config("keypoints")
    assert CFlow(pixel_size=0.2, voxel_size=[1], grid_feature_size=[1]).config == make_config(pixel_size=0.2)
    names = r"labeling, num_iters, patch_size, proof; .*'verified' has pixel_size"
    with pytest.warns(UserWarning, match=names) as said:
        model = CFlow(num_iters=4, proof=False, patch_size=11, labeling="kornia", significance=2.0)
    assert len(said) == 1 and model.config == make_config(significance=2.0)
    wrong: list[dict[str, Any]] = [{"output": "half"}, {"num_frames": 1}, {"num_frames": 2.5}, {"ego_T_lidar": "yes"}]
    wrong += [{"method": "keypoints", "num_frames": 6}, {"method": "dense", "preset": "fast"}]
    for settings in (*wrong, {"pixel_sizes": [0.1, 0.2]}, {"ego_T_lidar": [[1, 2], [3, 4]]}):
        with pytest.raises(CFlowError):
            CFlow(**settings)


# ---------------------------------------------------------------------------------------------- the harness's scripts


def test_checkpoint_without_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    file = tmp_path / "mine.ckpt"
    monkeypatch.setattr(sys, "argv", ["opensceneflow", str(file)])
    write_checkpoint()
    assert str(file) in capsys.readouterr().out
    stored = torch.load(file, weights_only=True)
    assert stored.pop("pytorch-lightning_version").count(".") == 2
    cfg = {"model": {"name": "mine"}, "output": "mine", "num_frames": 2}  # no target: the YAML's stays
    expected = {"epoch": 0, "global_step": 0, "state_dict": {}, "hyper_parameters": {"cfg": cfg, "eval": True}}
    assert stored == expected and json.loads(json.dumps(stored)) == expected, "plain containers"
    with pytest.raises(SystemExit, match="error: .*mine.ckpt is there already.*overwrite"):
        write_checkpoint()


EVAL_YAML = """
dataset_path: ???
checkpoint: ???
data_mode: val
leaderboard_version: 1
num_frames: 2
slurm_id: 00000
output: ${model.name}-${slurm_id}
defaults:
  - model: deflow
"""
PRESETS = {"cflow": "default", "cflow_fast": "fast", "cflow_paper": "paper", "cflow_keypoints": "keypoints"}


def composed(folder: Path, *overrides: str) -> Any:
    """A stand-in for the harness's `conf`, a model and `eval.yaml`, composed with ours on the search path."""
    from hydra import compose, initialize_config_dir

    (folder / "conf" / "model").mkdir(parents=True, exist_ok=True)
    (folder / "conf" / "eval.yaml").write_text(EVAL_YAML)
    (folder / "conf" / "model" / "deflow.yaml").write_text("name: deflow\ntarget:\n  _target_: builtins.dict\n")
    search = "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]"
    with initialize_config_dir(str(folder / "conf"), version_base=None):
        return compose("eval", [search, "dataset_path=data", "checkpoint=x.ckpt", *overrides])


@pytest.mark.parametrize("name", PRESETS)
def test_configuration_is_found_and_is_the_preset(name: str, tmp_path: Path) -> None:
    from hydra.errors import ConfigCompositionException
    from omegaconf import OmegaConf

    checkpoint = write_null_checkpoint(tmp_path / "cflow.ckpt")
    cfg = composed(tmp_path, f"model={name}")
    assert cfg.model.name == name and not cfg.model.get("iter_only", False)
    target = OmegaConf.to_container(cfg.model.target, resolve=False)
    assert "${" not in json.dumps(target), "eval.yaml and save.yaml have nothing to refer to"
    expected = make_config(PRESETS[name])
    ours = {"_target_", "voxel_size", "num_frames", "ego_T_lidar", "output", "device"}
    assert set(target) == ours | (set(expected.as_dict()) - {"num_history", "num_future"}), (
        "every setting, so that no + is needed"
    )
    box = target["point_cloud_range"]
    expected = expected.replace(point_cloud_range=box)
    assert np.isfinite(box).all(), "the harness computes with it"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = osf.build(cfg, checkpoint)
    assert isinstance(model, CFlow) and model.config == expected and cfg.output == "cflow-e0-val-v1"
    assert min(cfg.model.target.grid_feature_size) >= 1
    changes = ["pixel_sizes=[0.3]", "sweep_interval=0.2", "max_speed=null", "output=valid", "ego_T_lidar=null"]
    model = osf.build(composed(tmp_path, f"model={name}", *(f"model.target.{text}" for text in changes)), checkpoint)
    assert model.config == expected.replace(pixel_size=0.3, sweep_interval=0.2, max_speed=None)
    assert model.output == "valid" and model.ego_T_lidar is None
    with pytest.raises(ConfigCompositionException):
        composed(tmp_path, f"model={name}", "model.target.no_such_setting=1")


# ---------------------------------------------------------------------------------------------- ego_T_lidar


def test_extrinsics_mend_the_harness_s_pose_flow(tmp_path: Path) -> None:
    """A scene with points in the sensor frame and poses of the ego frame, which the file does not tell."""
    layout = {"points_frame": "sensor", "ego_T_lidar": EGO_T_LIDAR, "store_extrinsics": False}
    folder, index = store(tmp_path, SmallDrive(0), **layout), 5
    model = CFlow(**VARIANTS["dense"], ego_T_lidar=EGO_T_LIDAR.tolist())
    with torch.inference_mode():
        outcome = osf.run(model, osf.path_b(osf.load(folder, index, 6)))
    motions = []
    for ego_T_lidar in (EGO_T_LIDAR, None):
        with HDF5Log(folder / "drive-0.h5", ego_T_lidar=ego_T_lidar) as log:
            sweep = log.sweep(index)
            motions.append(np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose)
    rows, points = ~sweep.is_ground, sweep.points[~sweep.is_ground].astype(np.float64)
    residual = core(folder, "dense", index, 6, EGO_T_LIDAR).numpy()
    expected = transform_points(points, motions[0]) - points + residual
    np.testing.assert_allclose(outcome.final_flow.numpy()[rows], expected, rtol=0, atol=1e-5)
    correction = transform_points(points, motions[0]) - transform_points(points, motions[1])
    assert np.abs(correction).max() > 0.02, "without extrinsics the static world would move"
    np.testing.assert_allclose(outcome.answer["flow"].numpy(), residual + correction, rtol=0, atol=3e-4)


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
    models = [CFlow(**settings, ego_T_lidar=given) for given in ("auto", extrinsics if recognized else None, None)]
    stamp = torch.tensor([int(raw["timestamp"][0])])
    for batch in (osf.path_a(raw), osf.path_b(raw), {**osf.path_b(raw), "timestamp": stamp}):
        auto, explicit, without = (answer(model, batch)["flow"][0] for model in models)
        assert same_bits(auto, explicit) and same_bits(auto, without) != recognized
    no_height = np.full((4, 3), np.nan, np.float32)
    assert np.array_equal(recognized_extrinsics(first_stamp, no_height, np.ones(4, bool)), np.eye(4))


# ---------------------------------------------------------------------------------------------- the real pair


@pytest.mark.parametrize(("preset", "points_frame"), [("fast", "sensor"), ("keypoints", "ego")])
def test_real_pair_scores_as_cflow_eval(preset: str, points_frame: str, av2_folder: Path, tmp_path: Path) -> None:
    """Batches do not tell the time of t+1, so that the gate of the key points is the one for 0.1 s; the pair's
    0.100196 s make a gate of 2 m a little wider. A gate of 2.03 m and the wider one hold the same pixels. Nor do they
    hold ground, so `min_height` has nothing to go by."""
    settings = {"gate_radius": 2.03} if preset == "keypoints" else {"min_height": None}
    extrinsics = osf.up_lidar(av2_folder) if points_frame == "sensor" else None
    folder = store(tmp_path / "scenes", AV2Log(av2_folder), points_frame=points_frame, ego_T_lidar=extrinsics)
    out = tmp_path / "out"
    call = ["eval", "data=hdf5", f"data.root={folder}", f"model={preset}", "definition=opensceneflow", f"output={out}"]
    main([*call, *(f"model.{key}={json.dumps(value)}" for key, value in settings.items())])
    expected = json.loads((out / "results.json").read_text())["results"]
    module = CFlow(preset=preset, **settings, ego_T_lidar=extrinsics)
    frames = module.config.num_history + 2
    for path in ("A", "B"):
        results = osf.evaluate(module, folder, num_frames=frames, top_num_frames=frames, path=path)
        assert json.loads(json.dumps(results).replace("NaN", "null").replace("Infinity", '"inf"')) == expected
