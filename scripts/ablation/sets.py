"""Windows for the ablation: real data, sets derived from it, simulated drives, small simulated drives.

We chose settings on the groups "real", "merged", "scenes" and "sim" with seeds 100 ... 103. Up to 0.3.0 we did not use
"odd", the other windows of KITTI, nor other seeds.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Callable, Sequence

import numpy as np
from derived_sets import MOVES, chain_flow, paste_static

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.catalog import open_log
from cflow_torch.data.hdf5 import HDF5Log
from cflow_torch.data.log import CachedLog, FlowLabels, window
from cflow_torch.evaluation.frame import EvalFrame, ego_motion_flow
from cflow_torch.simulator.benchmark import benchmark_logs, format_of
from cflow_torch.types import CFlowError, Window, as_numpy
from cflow_torch.windows.ego_motion import relative_transform

sys.path.append(str(Path(__file__).resolve().parents[1] / "figures"))
import drives  # noqa: E402

HISTORY = FUTURE = 4
NEAR, REGION = 35.0, 70.0  # metres, half sides: scored box of real data; region of simulated drives
PROFILES = ("av2", "nuscenes", "truckscenes", "waymo", "aevascenes")
SCENES = ("street", "highway", "crossing", "narrow")
SIMULATED_SWEEPS, SIMULATED_WINDOWS = 15, (9, 12)  # per drive
SCENE_SEEDS = (0, 1, 2, 3, 4)  # of the small drives
GROUPS = ("real", "odd", "merged", "pandaset", "scenes", "sim")
AV2 = Path("av2-7fab2350", "val", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
KITTI = Path("kitti-0000", "kitti-0000-a.h5")
KITTI_LATER = Path("kitti-0000", "kitti-0000-c2.h5")
CROWN = Path("av2-crown", "av2-crown.h5")
PANDASET = {part: Path("pandaset-002", f"panda-002-{part}.h5") for part in ("a1", "c")}


@dataclass(frozen=True)
class Item:
    """One window and its truth."""

    window: Window  # sweeps with poses
    labels: FlowLabels  # truth, rows of `window.pc0`
    pose_flow: np.ndarray  # (N, 3) float32, metres, axes of t+1: the part of the true flow that ego motion causes
    eval_mask: np.ndarray | None = None  # (N,) bool, True = scored; None = all valid points that are not ground

    def frame(self, residual_flow: Any) -> EvalFrame:
        """The input of the metrics, for (N, 3) estimated residual flow."""
        pc0, of_pair = self.window.pc0, {"pose_flow": self.pose_flow, "T_ego1_ego0": between(self.window)}
        masks = {"is_ground": pc0.is_ground, "eval_mask": self.eval_mask}
        return EvalFrame(pc0.points, self.labels, residual_flow, **of_pair, **masks)


@dataclass(frozen=True)
class ScoredSet:
    """A set of windows that are scored together."""

    name: str  # for example "kitti h=4" or "sim waymo 100-103 h=4"; unique
    group: str  # one of `GROUPS`
    history: int  # number of older sweeps
    half_side: float | None  # metres, of the region of the estimate; None = that of the preset
    load: Callable[[], list[Item]]  # function that returns the windows
    step: int = 1  # sweeps of the recording from t to t+1
    reach: float = NEAR  # metres, half side of the scored box
    mean: str = ""  # name of the mean over the sensors to which the set belongs, "" = none

    def items(self) -> list[Item]:
        """The windows, with `history` older sweeps."""
        return [replace(i, window=replace(i.window, pch=i.window.pch[: self.history])) for i in self.load()]


def make_sets(names: Sequence[str], seeds: Sequence[tuple[int, int]], cache: Path) -> list[ScoredSet]:
    """Return the sets of some names, of groups or of single sets; "walkers" selects "walkers-0.1" and so on.

    Sets of "sim" are returned once per range of seeds, first and last; four seeds, or a multiple, have an even mix of
    scenes. Simulated drives that are not in the cache are made.
    """
    sets = [ScoredSet(name, group, history, NEAR, load, step) for name, group, history, load, step in _REAL]
    for name, stage in _SCENES.items():
        reach = drives.BORDERS[-1] if name == "border" else NEAR
        sets.append(ScoredSet(name, "scenes", HISTORY, None, partial(staged, stage), reach=reach))
    for first, last in seeds:
        for profile in PROFILES:
            name, mean = (f"sim {word}{first}-{last} h={HISTORY}" for word in (f"{profile} ", ""))
            load = partial(simulated, profile, range(first, last + 1), cache)
            sets.append(ScoredSet(name, "sim", HISTORY, REGION, load, mean=mean))
    for name in names:
        if not any(_is_of(scored, name) for scored in sets):
            raise CFlowError(f"set {name!r} does not exist; give {', '.join((*GROUPS, *(s.name for s in sets)))}")
    return [scored for scored in sets if any(_is_of(scored, name) for name in names)]


def _is_of(scored: ScoredSet, name: str) -> bool:
    return name in (scored.name, scored.group) or scored.name.startswith(f"{name}-")


def between(pair: Window) -> np.ndarray:
    """(4, 4) float64 `T_ego1_ego0`."""
    return relative_transform(pair.pc1.pose, pair.pc0.pose)


def make_item(scored: Window, labels: FlowLabels, eval_mask: np.ndarray | None = None) -> Item:
    """An item with the ego motion of the poses."""
    return Item(scored, labels, ego_motion_flow(as_numpy(scored.pc0.points)[:, :3], between(scored)), eval_mask)


def data_root() -> Path:
    """Folder of the real data: $CFLOW_DATA, else ../shared/data next to the checkout; a `CFlowError` if it lacks it."""
    root = Path(os.environ.get("CFLOW_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    for part in (AV2, KITTI):
        if not (root / part).exists():
            raise CFlowError(f"no {part} in {root}: set CFLOW_DATA to the folder of the real data, or give --sets sim")
    return root


@lru_cache(maxsize=None)
def av2_pair() -> list[Item]:
    """The real Argoverse 2 pair, with the ego motion of its labels, which differs from the poses by 0.8 mm."""
    folder = data_root() / AV2
    log = AV2Log(folder)
    item = make_item(window(log, 0), log.labels(0))
    with np.load(folder / "ego_motion.npz") as stored:
        T_ego1_ego0 = stored["ego_motion"][0].astype(np.float64)
    return [replace(item, pose_flow=ego_motion_flow(item.window.pc0.points, T_ego1_ego0))]


@lru_cache(maxsize=None)
def _scene(path: Path) -> tuple[HDF5Log, CachedLog]:
    log = HDF5Log(data_root() / path)
    return log, CachedLog(log, len(log.timestamps))


@lru_cache(maxsize=None)
def kitti(path: Path = KITTI) -> list[Item]:
    """All labelled pairs of a part of KITTI 0000, or of another scene in that layout."""
    log, sweeps = _scene(path)
    pairs = range(len(log.timestamps) - 1)
    return [make_item(window(sweeps, i, HISTORY, FUTURE), log.labels(i), log.eval_mask(i)) for i in pairs]


@lru_cache(maxsize=None)
def kitti_steps(step: int) -> list[Item]:
    """Pairs (t, t + step) of KITTI 0000, with the labels of the pairs in between chained object by object."""
    log, sweeps = _scene(KITTI)
    items = []
    for start in range(len(log.timestamps) - step):
        pairs = []
        for i in range(start, start + step):
            labels, sweep = log.labels(i), sweeps.sweep(i)
            usable = labels.is_valid & ~sweep.is_ground
            pairs.append((sweep.points, log.values(i, "flow_instance_id"), labels.flow, usable))
        scored = Window(sweeps.sweep(start), sweeps.sweep(start + step))
        first = log.labels(start)
        flow, is_known = chain_flow(pairs, ego_motion_flow(scored.pc0.points, between(scored)))
        labels = FlowLabels(flow, first.category, first.is_valid & is_known)
        items.append(make_item(scored, labels, log.eval_mask(start)))
    return items


@lru_cache(maxsize=None)
def merged() -> list[Item]:
    """The pairs of KITTI 0000, with a static component pasted next to every moving object."""
    log, _ = _scene(KITTI)
    items = []
    for number, item in enumerate(kitti()):
        pair = Window(item.window.pc0, item.window.pc1)
        scored = item.eval_mask & item.labels.is_valid
        made = paste_static(pair, item.labels, log.values(number, "flow_instance_id"), scored, number)
        more = len(made[1].flow) - len(item.labels.flow)
        items.append(make_item(*made, np.concatenate([item.eval_mask, np.ones(more, bool)])))
    return items


@lru_cache(maxsize=None)
def simulated(profile: str, seeds: Sequence[int], cache: Path) -> list[Item]:
    """Windows of the simulated drives of one sensor, read with the reader of its data set."""
    chosen = format_of(profile)
    items = []
    for source in benchmark_logs(cache, profile, seeds, SIMULATED_SWEEPS, SCENES):
        log = open_log(chosen.data_set, source, check=False, **dict(chosen.settings))
        sweeps = CachedLog(log, SIMULATED_SWEEPS)
        pairs = range(HISTORY, len(log.timestamps) - 1)
        for wanted in SIMULATED_WINDOWS:  # not every sweep of every data set has labels
            nearest = sorted(pairs, key=lambda i: abs(i - wanted))  # noqa: B023
            index = next(i for i in nearest if log.labels(i) is not None)
            items.append(make_item(window(sweeps, index, HISTORY, FUTURE), log.labels(index)))
    return items


@lru_cache(maxsize=None)
def staged(stage: Callable[[int], drives.Staged]) -> list[Item]:
    """The pair of a small drive, once per seed. Scored are its objects and all static points, no other moving ones."""
    items = []
    for seed in SCENE_SEEDS:
        drive, _, _, bodies, _ = stage(seed)
        item = make_item(window(drive, drives.PAIR, HISTORY, FUTURE), drive.labels(drives.PAIR))
        moves = np.linalg.norm(item.labels.flow - item.pose_flow, axis=1) >= MOVES
        is_other = moves & ~np.isin(drives.body_of(drive), list(bodies))
        items.append(replace(item, eval_mask=~is_other))
    return items


def _sliced(load: Callable[[], list[Item]], start: int, step: int = 2) -> Callable[[], list[Item]]:
    return lambda: load()[start::step]


_STEPS = {step: partial(kitti_steps, step) for step in (3, 5)}
# Name, group, history, windows, step. With h = 4, only windows with the whole history.
_REAL: tuple[tuple[str, str, int, Callable[[], list[Item]], int], ...] = (
    ("av2 pair h=0", "real", 0, av2_pair, 1),
    ("kitti h=0", "real", 0, kitti, 1),
    ("kitti h=4", "real", 4, _sliced(kitti, 4), 1),
    ("third sweeps h=0", "real", 0, _sliced(_STEPS[3], 0), 3),
    ("fifth sweeps h=0", "real", 0, _sliced(_STEPS[5], 0), 5),
    ("merge h=0", "real", 0, merged, 1),
    ("kitti odd h=4", "odd", 4, _sliced(kitti, 5), 1),
    ("third sweeps odd h=0", "odd", 0, _sliced(_STEPS[3], 1), 3),
    ("fifth sweeps odd h=0", "odd", 0, _sliced(_STEPS[5], 1), 5),
    ("crown h=0", "merged", 0, partial(kitti, CROWN), 1),
    ("later kitti h=4", "merged", 4, _sliced(partial(kitti, KITTI_LATER), 4), 1),
    *(
        (f"pandaset {part} h=4", "pandaset", 4, _sliced(partial(kitti, path), HISTORY, 1), 1)
        for part, path in PANDASET.items()
    ),
)
_STAGES = (drives.hedge, drives.crowd, drives.tram, drives.rolling_shutter, drives.appearing, drives.tree)
_STAGES += (drives.bridge, drives.gantry, drives.wires, drives.abreast, drives.border)
_SCENES: dict[str, Callable[[int], drives.Staged]] = {
    **{stage.__name__: stage for stage in _STAGES},
    **{f"walkers-{gap:g}": partial(drives.walkers, gap=gap) for gap in (0.1, 0.2, 0.3, 0.5)},
    **{
        f"facade-{profile}-{step:g}": partial(drives.facade, step=step, profile=profile)
        for profile in ("av2", "waymo")
        for step in (0.1, 0.3, 0.55, 1.0, 1.5)  # metres of the vehicle per sweep
    },
}
