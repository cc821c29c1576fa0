"""OpenSceneFlow in miniature: how that harness feeds a model and what it makes of the answer, replayed without it.

Written from what commit 848bf86 does, in words and code of our own. `SceneDataset` gives the items, `path_b`, `path_a`
and `collate_for_training` the three batch layouts, `run` puts the total flow together, `evaluate` is the script
`eval.py`. Unlike the harness nothing here swallows an exception. Scores come from `cflow_torch.evaluation`, which
`test_golden.py` holds against the harness's own functions.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Iterator

import h5py
import numpy as np
import torch
from pyarrow import feather
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import default_collate

from cflow_torch.data.log import FlowLabels
from cflow_torch.data.rigid_motion import poses_from_quaternions
from cflow_torch.evaluation import EvalFrame, SceneFlowMetrics

TRUTH = ("flow", "flow_is_valid", "flow_category_indices", "flow_instance_id")
IF_STORED = ("ego_motion", "lidar_dt", "lidar_center", "dufo", *TRUTH)
Batch = Dict[str, Any]
Model = Callable[[Batch], Dict[str, Any]]


class SceneDataset:
    """Items of a folder of scenes, in the order of its index.

    Args:
        folder: scenes and `index_total.pkl`; for `eval` also `index_eval.pkl` or `index_flow.pkl`.
        num_frames: sweeps of an item, history + 2.
        eval: True: the frames of the evaluation index, history clamped to the first sweep of the scene. False: every
            frame, clamped to those that have a whole history and a successor.
    """

    def __init__(self, folder: Path, num_frames: int = 2, eval: bool = True) -> None:
        self.folder, self.num_history, self.eval = Path(folder), num_frames - 2, eval
        self.total = self._index("total")
        self.frames = self.total
        if eval:
            has_eval = (self.folder / "index_eval.pkl").is_file()
            self.frames = self._index("eval" if has_eval else "flow")
        self.bounds: dict[str, tuple[int, int]] = {}  # first and last row of each scene in the index
        for row, (scene, _) in enumerate(self.total):
            self.bounds[scene] = (self.bounds.get(scene, (row, row))[0], row)

    def _index(self, name: str) -> list[list[str]]:
        with open(self.folder / f"index_{name}.pkl", "rb") as file:
            return pickle.load(file)

    def __len__(self) -> int:
        return len(self.frames)

    def row(self, item: int) -> int:
        """Place in the index of sweep t of an item."""
        first, last = self.bounds[self.frames[item][0]]
        if not self.eval:
            return max(first + self.num_history, min(last - 1, item))
        row = self.total.index(self.frames[item])  # finds lists only, not tuples
        return row if row < last else self.row(item - 1)

    def __getitem__(self, item: int) -> Batch:
        row = self.row(item)
        scene, stamp = self.total[row]
        first, _ = self.bounds[scene]
        sources = {"0": row, "1": row + 1}
        sources.update({f"h{i}": max(row - i, first) for i in range(1, self.num_history + 1)})
        values: Batch = {"scene_id": scene, "timestamp": stamp, "eval_flag": self.eval}
        with h5py.File(self.folder / f"{scene}.h5", "r") as file:
            for end, source in sources.items():
                group = file[self.total[source][1]]
                values[f"pc{end}"] = group["lidar"][:][:, :3]
                values[f"gm{end}"] = group["ground_mask"][:]
                values[f"pose{end}"] = group["pose"][:]
            group = file[stamp]
            values.update({key: group[key][:] for key in IF_STORED if key in group})
            if self.eval:
                not_ground = ~values["gm0"]
                stored = group["eval_mask"][:].reshape(-1) if "eval_mask" in group else not_ground
                values["eval_mask"] = stored & not_ground
        return values


def load(folder: Path, item: int = 0, num_frames: int = 2, eval: bool = True) -> Batch:
    """One item as a batch of one, as the data loader collates it: (1, N, ...) tensors, lists of strings."""
    return default_collate([SceneDataset(folder, num_frames, eval)[item]])


# -------------------------------------------------------------------------------------------------- batch layouts


def path_b(batch: Batch, top_num_frames: int = 2) -> Batch:
    """What the Lightning path hands to a model: pc0 and pc1 without ground, and the history without ground as far as
    the TOP-LEVEL number of frames reaches, which need not be the model's; all masks in full length."""
    history = [f"h{i}" for i in range(1, top_num_frames - 1)]
    return {**batch, "origin_pc0": batch["pc0"].clone(), **_without_ground(batch, ["0", "1", *history])}


def path_a(batch: Batch) -> Batch:
    """What the "iter_only" path hands to a model: the history keeps its ground."""
    return {**batch, "origin_pc0": batch["pc0"].clone(), **_without_ground(batch, ["0", "1"])}


def _without_ground(batch: Batch, ends: list[str]) -> Batch:
    return {f"pc{end}": batch[f"pc{end}"][~batch[f"gm{end}"]][None] for end in ends}


def collate_for_training(items: list[Batch]) -> Batch:
    """Items of several frames as training sees them: no ground, points padded with NaN, labels with 0, poses in lists;
    no masks, no time stamps."""
    batch: Batch = {"scene_id": [item["scene_id"] for item in items]}
    for key in items[0]:
        if key.startswith("pose") or key == "ego_motion":
            batch[key] = [torch.tensor(item[key]) for item in items]
        elif key.startswith(("pc", "flow")):
            mask = f"gm{key[2:]}" if key.startswith("pc") else "gm0"
            kept = [torch.tensor(item[key][~item[mask]]) for item in items]
            padding = float("nan") if key.startswith("pc") else 0
            batch[key] = pad_sequence(kept, batch_first=True, padding_value=padding)
    return batch


# -------------------------------------------------------------------------------------------------- what it makes of it


@dataclass(frozen=True)
class Outcome:
    """One frame after the model: the batch without its first dimension, total and pose flow (N, 3) float32, and what
    the model returned."""

    batch: Batch
    final_flow: Tensor
    pose_flow: Tensor
    answer: dict[str, Any]


def relative_pose(pose0: Tensor, pose1: Tensor) -> Tensor:
    """(4, 4) float32 T of sweep t to sweep t+1. The inverse of `pose1` is its transpose; its translation is summed in
    the precision of the poses, which for float32 poses far from the origin costs tenths of a millimetre; the product
    is float64."""
    inverse = torch.eye(4, dtype=torch.float64)
    inverse[:3, :3] = pose1[:3, :3].T
    inverse[:3, 3] = -(pose1[:3, :3].T * pose1[:3, 3]).sum(dim=1)
    return (inverse @ pose0.double()).float()


def pose_flow_of(points: Tensor, T: Tensor) -> Tensor:
    """(N, 3) float32 T p - p, in float32 throughout."""
    return points @ T[:3, :3].T + T[:3, 3] - points


def run(model: Any, batch: Batch, use_indices: bool = True) -> Outcome:
    """Run a model on a batch of one and put the final flow together.

    Args:
        model: callable; its `timer`, if it has one, is used as the harness does.
        batch: what `path_b` or `path_a` made.
        use_indices: read `pc0_valid_point_idxes` if it is there; path A never does.
    """
    timer = getattr(model, "timer", None)
    if timer is not None:
        timer[12].start("One Scan")
    answer = model(batch)
    if timer is not None:
        timer[12].stop()
    one = {key: value[0] for key, value in batch.items() if len(value) > 0}
    answer = {key: value[0] for key, value in answer.items() if value is not None and len(value) > 0}
    points, rows = one["origin_pc0"], ~one["gm0"]
    pose_flow = pose_flow_of(points, relative_pose(one["pose0"], one["pose1"]))
    kept = pose_flow[rows]
    if use_indices and "pc0_valid_point_idxes" in answer:
        found = answer["pc0_valid_point_idxes"]
        kept[found] = kept[found] + answer["flow"]
    else:
        kept = kept + answer["flow"]
    final_flow = pose_flow.clone()
    final_flow[rows] = kept
    return Outcome(one, final_flow, pose_flow, answer)


def outcomes(
    model: Any, folder: Path, num_frames: int = 2, top_num_frames: int = 2, path: str = "B", eval: bool = True
) -> Iterator[Outcome]:
    """Every frame of a folder through a path, "A" or "B". Path A gives the data set the top-level number of frames."""
    dataset = SceneDataset(folder, top_num_frames if path == "A" else num_frames, eval)
    for item in range(len(dataset)):
        batch = default_collate([dataset[item]])
        if path == "A":
            with torch.no_grad():
                yield run(model, path_a(batch), use_indices=False)
        else:
            with torch.inference_mode():
                yield run(model, path_b(batch, top_num_frames))


def evaluate(model: Any, folder: Path, **layout: Any) -> dict[str, Any]:
    """`eval.py data_mode=val`: scores of all frames to evaluate; `layout` as for `outcomes`."""
    metrics = SceneFlowMetrics("opensceneflow")
    for outcome in outcomes(model, folder, **layout):
        metrics.update(frame_of(outcome))
    return metrics.compute()


def frame_of(outcome: Outcome) -> EvalFrame:
    """What `eval.py` scores: the points of the evaluation mask, total flow against stored truth."""
    batch = outcome.batch
    labels = FlowLabels(*(batch[key].numpy() for key in ("flow", "flow_category_indices", "flow_is_valid")))
    flows = {"flow": outcome.final_flow, "pose_flow": outcome.pose_flow}
    return EvalFrame(batch["origin_pc0"], labels, eval_mask=batch["eval_mask"], **flows)


def up_lidar(log_folder: Path) -> np.ndarray:
    """(4, 4) float64 T_ego_lidar of the upper LiDAR of an Argoverse 2 log, in whose frame the harness stores points."""
    rows = feather.read_table(str(log_folder / "calibration" / "egovehicle_SE3_sensor.feather")).to_pylist()
    (row,) = (row for row in rows if row["sensor_name"] == "up_lidar")
    shift, turn = ([row[name] for name in names] for names in (("tx_m", "ty_m", "tz_m"), ("qw", "qx", "qy", "qz")))
    return poses_from_quaternions([shift], [turn], str)[0]


# -------------------------------------------------------------------------------------------------- building a model


def reset_weights(module: nn.Module) -> None:
    """What the harness does to every module after building the model."""
    if isinstance(module, (nn.Conv2d, nn.Linear)):
        nn.init.xavier_uniform_(module.weight.data)
        if module.bias is not None:
            nn.init.zeros_(module.bias.data)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.ones_(module.weight.data)
        nn.init.zeros_(module.bias.data)


def build(cfg: Any, checkpoint: Path) -> nn.Module:
    """The model that `eval.py` makes of its settings and a checkpoint: what the checkpoint says about the model wins,
    the target gets `grid_feature_size`, every module is reset, then the weights are loaded strictly."""
    from hydra.utils import instantiate
    from omegaconf import DictConfig, open_dict

    stored = torch.load(checkpoint, weights_only=True)
    given = DictConfig(stored["hyper_parameters"])
    cfg.output = f"{given.cfg.output}-e{stored['epoch']}-{cfg.data_mode}-v{cfg.leaderboard_version}"
    cfg.model.update(given.cfg.model)
    target = cfg.model.target
    low_high = zip(target.point_cloud_range[:3], target.point_cloud_range[3:], target.voxel_size)
    with open_dict(target):
        target["grid_feature_size"] = [abs(int((low - high) / size)) for low, high, size in low_high]
    model: nn.Module = instantiate(target)
    model.apply(reset_weights)
    model.load_state_dict(stored["state_dict"], strict=True)
    return model.eval()
