"""Windows for the ablation: real data, sets derived from it, simulated drives, small simulated drives.

We chose settings on the groups "real", "merged", "scenes" and "sim" with seeds 100 ... 103. Up to 0.3.0 we did not use
"odd", the other windows of KITTI, nor other seeds.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Callable, NamedTuple, Sequence

import numpy as np
from derived_sets import CUTS, POSE_ERRORS, chain_flow, cut_sweep, paste_static, with_pose_errors, with_refined_poses

from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.catalog import open_log
from cflow_torch.data.hdf5 import HDF5Log
from cflow_torch.data.log import CachedLog, FlowLabels, window
from cflow_torch.evaluation.frame import EvalFrame, ego_motion_flow
from cflow_torch.simulator.benchmark import benchmark_logs
from cflow_torch.simulator.drive import make_drive
from cflow_torch.transforms import relative_transform
from cflow_torch.types import CFlowError, Window

sys.path.append(str(Path(__file__).resolve().parents[1] / "figures"))
sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
import drives  # noqa: E402
from writers import FORMATS  # noqa: E402

DATA = Path(os.environ.get("CFLOW_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
CACHE = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")  # of simulated drives
HISTORY = FUTURE = 4
NEAR, REGION = 35.0, 70.0  # metres, half sides: scored box of real data; region of simulated drives
PROFILES = ("av2", "nuscenes", "truckscenes", "waymo", "aevascenes")
SCENES = ("street", "highway", "crossing", "narrow")
SIMULATED_SWEEPS, SIMULATED_WINDOWS = 15, (9, 12)  # per drive
MOTORWAY_SWEEPS = 8
CUT_PAIRS = (5, 6, 7, 8)  # of each drive whose sweeps are cut
SCENE_SEEDS = (0, 1, 2, 3, 4)  # of the small drives
GROUPS = ("real", "odd", "merged", "pandaset", "poses", "scenes", "sim", "motorway", "cut")
AV2 = DATA / "av2-7fab2350" / "val" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
KITTI, KITTI_LATER = (DATA / "kitti-0000" / f"kitti-0000-{part}.h5" for part in ("a", "c2"))
CROWN = DATA / "av2-crown" / "av2-crown.h5"
PANDASET = {part: DATA / "pandaset-002" / f"panda-002-{part}.h5" for part in ("a1", "c")}


class Item(NamedTuple):
    """One window, and its truth as an evaluation frame of zero residual flow."""

    window: Window  # sweeps with poses
    frame: EvalFrame


@dataclass(frozen=True)
class ScoredSet:
    """A set of windows that are scored together."""

    name: str  # for example "kitti h=4" or "sim waymo 100-103 h=4"; unique
    group: str  # one of `GROUPS`
    load: Callable[[], list[Item]]  # function that returns the windows
    history: int = HISTORY  # number of older sweeps
    half_side: float | None = NEAR  # metres, of the region of the estimate; None = that of the preset
    step: int = 1  # sweeps of the recording from t to t+1
    reach: float = NEAR  # metres, half side of the scored box
    nearest: float = 0.0  # metres, half side of a box in it that is not scored
    mean: str = ""  # name of the mean over the sensors to which the set belongs, "" = none

    @cached_property
    def items(self) -> list[Item]:
        """The windows, with at least `history` older sweeps."""
        return self.load()


def make_sets(names: Sequence[str], seeds: Sequence[range]) -> list[ScoredSet]:
    """Return the sets of some names, of groups or of single sets; "walkers" selects "walkers-0.1" and so on.

    Sets of "sim", "motorway" and "cut" are returned once per range of seeds. For "sim", four seeds, or a multiple, have
    an even mix of scenes. Simulated drives that are not in the cache are made.
    """
    # With history, only windows with the whole history.
    sets = [
        ScoredSet("av2 pair h=0", "real", av2_pair, 0),
        ScoredSet("kitti h=0", "real", lambda: kitti(KITTI), 0),
        ScoredSet("kitti h=4", "real", lambda: kitti(KITTI)[4::2]),
        ScoredSet("third sweeps h=0", "real", lambda: kitti_steps(3)[::2], 0, step=3),
        ScoredSet("fifth sweeps h=0", "real", lambda: kitti_steps(5)[::2], 0, step=5),
        ScoredSet("merge h=0", "real", merged, 0),
        ScoredSet("kitti odd h=4", "odd", lambda: kitti(KITTI)[5::2]),
        ScoredSet("crown h=0", "merged", lambda: kitti(CROWN), 0),
        ScoredSet("later kitti h=4", "merged", lambda: kitti(KITTI_LATER)[4::2]),
        ScoredSet("pandaset a1 h=4", "pandaset", lambda: kitti(PANDASET["a1"])[4:]),
        ScoredSet("pandaset c h=4", "pandaset", lambda: kitti(PANDASET["c"])[4:]),
    ]
    drives_of_poses = (("kitti", KITTI, 0), ("pandaset a1", PANDASET["a1"], 4), ("later kitti", KITTI_LATER, 4))
    for drive, path, history in drives_of_poses:
        name = f"{drive} h={history}, "
        sets += [ScoredSet(name + each, "poses", partial(wrong_poses, path, each), history) for each in POSE_ERRORS]
        refined = partial(wrong_poses, path, "noise of 2 cm, 0.1 degrees", refine=True)
        sets.append(ScoredSet(f"{name}noise of 2 cm, 0.1 degrees, refined", "poses", refined, history))
    for name, stage in _SCENES.items():
        reach = drives.BORDERS[-1] if name == "border" else NEAR
        sets.append(ScoredSet(name, "scenes", partial(staged, stage), half_side=None, reach=reach))
    for drawn in seeds:
        for profile in PROFILES:
            name, mean = (f"sim {word}{drawn[0]}-{drawn[-1]} h={HISTORY}" for word in (f"{profile} ", ""))
            sets.append(ScoredSet(name, "sim", partial(simulated, profile, drawn), half_side=REGION, mean=mean))
            name, mean = (f"motorway {word}{drawn[0]}-{drawn[-1]} h={HISTORY}" for word in (f"{profile} ", ""))
            sets.append(ScoredSet(name, "motorway", partial(motorway, profile, drawn), half_side=REGION, mean=mean))
        for cut in CUTS:
            name = f"cut {cut} {drawn[0]}-{drawn[-1]} h={HISTORY}"
            sets.append(ScoredSet(name, "cut", partial(cut_drives, cut, drawn), half_side=None))
    for name in names:
        if not any(_is_of(scored, name) for scored in sets):
            raise CFlowError(f"set {name!r} does not exist; give {', '.join((*GROUPS, *(s.name for s in sets)))}")
    return [scored for scored in sets if any(_is_of(scored, name) for name in names)]


def _is_of(scored: ScoredSet, name: str) -> bool:
    return name in (scored.name, scored.group) or scored.name.startswith(f"{name}-")


def between(pair: Window) -> np.ndarray:
    """(4, 4) float64 `T_ego1_ego0`."""
    return relative_transform(pair.pc1.pose, pair.pc0.pose)


def make_item(
    scored: Window, labels: FlowLabels, eval_mask: np.ndarray | None = None, pose_flow: np.ndarray | None = None
) -> Item:
    """An item with the ego motion of the poses, unless the flow that ego motion causes is given."""
    masks = {"is_ground": scored.pc0.is_ground, "eval_mask": eval_mask}
    of_pair = {"pose_flow": pose_flow, "T_ego1_ego0": between(scored)}
    return Item(scored, EvalFrame(scored.pc0.points, labels, np.zeros_like(labels.flow), **of_pair, **masks))


def av2_pair() -> list[Item]:
    """The real Argoverse 2 pair, with the ego motion of its labels, which differs from the poses by 0.8 mm."""
    log = AV2Log(AV2)
    pair = window(log, 0)
    with np.load(AV2 / "ego_motion.npz") as stored:
        T_ego1_ego0 = stored["ego_motion"][0].astype(np.float64)
    return [make_item(pair, log.labels(0), pose_flow=ego_motion_flow(pair.pc0.points, T_ego1_ego0))]


def wrong_poses(path: Path, error: str, refine: bool = False) -> list[Item]:
    """Every other window of a scene, with wrong poses; `refine` = corrected as by `data.odometry=refine`."""
    items = []
    for number, (given, frame) in enumerate(kitti(path)[HISTORY::2]):
        wrong = with_pose_errors(replace(given, pcf=()), error, number)
        items.append(Item(with_refined_poses(wrong) if refine else wrong, frame))
    return items


def scene(path: Path) -> CachedLog:
    """A labelled scene that keeps its sweeps in memory."""
    log = HDF5Log(path)
    return CachedLog(log, len(log))


def kitti(path: Path) -> list[Item]:
    """All labelled pairs of a part of KITTI 0000, or of another scene in that layout."""
    log = scene(path)
    pairs = range(len(log) - 1)
    return [make_item(window(log, i, HISTORY, FUTURE), log.labels(i), log.eval_mask(i)) for i in pairs]


def kitti_steps(step: int) -> list[Item]:
    """Pairs (t, t + step) of KITTI 0000, with the labels of the pairs in between chained object by object."""
    log = scene(KITTI)
    items = []
    for start in range(len(log) - step):
        pairs = []
        for i in range(start, start + step):
            labels, sweep = log.labels(i), log.sweep(i)
            usable = labels.is_valid & ~sweep.is_ground
            pairs.append((sweep.points, log.values(i, "flow_instance_id"), labels.flow, usable))
        scored = Window(log.sweep(start), log.sweep(start + step))
        first = log.labels(start)
        flow, is_known = chain_flow(pairs, ego_motion_flow(scored.pc0.points, between(scored)))
        labels = FlowLabels(flow, first.category, first.is_valid & is_known)
        items.append(make_item(scored, labels, log.eval_mask(start)))
    return items


def merged() -> list[Item]:
    """The pairs of KITTI 0000, with a static component pasted next to every moving object."""
    log = scene(KITTI)
    instances = (log.values(number, "flow_instance_id") for number in range(len(log) - 1))
    pairs = enumerate(zip(kitti(KITTI), instances))
    return [make_item(*paste_static(*item, instance, number)) for number, (item, instance) in pairs]


def simulated(profile: str, seeds: Sequence[int]) -> list[Item]:
    """Windows of the simulated drives of one sensor, read with the reader of its data set."""
    chosen = FORMATS[profile]
    items = []
    for source in benchmark_logs(CACHE, profile, seeds, SIMULATED_SWEEPS, SCENES, chosen):
        log = CachedLog(open_log(chosen.data_set, source, check=False, **chosen.settings), SIMULATED_SWEEPS)
        pairs = range(HISTORY, len(log) - 1)
        for wanted in SIMULATED_WINDOWS:  # not every sweep of every data set has labels
            nearest = sorted(pairs, key=lambda i: abs(i - wanted))  # noqa: B023
            index = next(i for i in nearest if log.labels(i) is not None)
            items.append(make_item(window(log, index, HISTORY, FUTURE), log.labels(index)))
    return items


def motorway(profile: str, seeds: Sequence[int]) -> list[Item]:
    """A window of each simulated drive on a motorway with oncoming traffic."""
    items = []
    for seed in seeds:
        log = CachedLog(make_drive(seed, MOTORWAY_SWEEPS, profile, "highway"), MOTORWAY_SWEEPS)
        index = MOTORWAY_SWEEPS - 2 - 1
        items.append(make_item(window(log, index, HISTORY), log.labels(index)))
    return items


def cut_drives(cut: str, seeds: Sequence[int]) -> list[Item]:
    """Windows of simulated streets whose sweeps measure a part of the circle, see `CUTS`."""
    items = []
    for seed in seeds:
        log = CachedLog(make_drive(seed, CUT_PAIRS[-1] + 2, "demo", "street"), CUT_PAIRS[-1] + 2)
        for pair in CUT_PAIRS:
            given = window(log, pair, HISTORY)
            indices = (pair, pair + 1, *range(pair - 1, -1, -1))  # in the order of the sweeps of a window
            partial_sweeps = [cut_sweep(sweep, cut, index, pair) for sweep, index in zip(given.sweeps, indices)]
            kept = partial_sweeps[0][1]
            labels = log.labels(pair)
            labels = FlowLabels(labels.flow[kept], labels.category[kept], labels.is_valid[kept])
            items.append(make_item(given.with_sweeps(sweep for sweep, _ in partial_sweeps), labels))
    return items


def staged(stage: Callable[[int], drives.Staged]) -> list[Item]:
    """The pair of a small drive, once per seed. Scored are its objects and all static points, no other moving ones."""
    items = []
    for seed in SCENE_SEEDS:
        drive, _, _, bodies, _ = stage(seed)
        sweeps, labels = window(drive, drives.PAIR, HISTORY, FUTURE), drive.labels(drives.PAIR)
        residual = labels.flow - ego_motion_flow(sweeps.pc0.points, between(sweeps))
        is_scored = np.isin(drives.body_of(drive), list(bodies)) | (np.linalg.norm(residual, axis=1) < MOVING)
        items.append(make_item(sweeps, labels, is_scored))
    return items


_STAGES = (
    *(drives.hedge, drives.crowd, drives.tram, drives.rolling_shutter, drives.appearing, drives.tree),
    *(drives.bridge, drives.gantry, drives.wires, drives.abreast, drives.border),
)
_SCENES: dict[str, Callable[[int], drives.Staged]] = {
    **{stage.__name__: stage for stage in _STAGES},
    **{f"walkers-{gap:g}": partial(drives.walkers, gap=gap) for gap in (0.1, 0.2, 0.3, 0.5)},
    **{
        f"facade-{profile}-{step:g}": partial(drives.facade, step=step, profile=profile)
        for profile in ("av2", "waymo")
        for step in (0.1, 0.3, 0.55, 1.0, 1.5)  # metres of the vehicle per sweep
    },
}
