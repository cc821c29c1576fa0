"""The rows of merged_motion.py: real sets, small simulated drives, the five simulated sensors; each with its target."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Callable, Dict, Iterator, List, Optional, Sequence, Tuple

import numpy as np

_SCRIPTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(_SCRIPTS / folder) for folder in ("ablation", "figures")]

import failure_drives  # noqa: E402
import merged_drives  # noqa: E402
from failure_drives import PAIR, Staged  # noqa: E402
from sets import HISTORY, NEAR, Item, ScoredSet, make_item, make_sets  # noqa: E402

from cflow_torch.config import PRESETS  # noqa: E402
from cflow_torch.data.log import window  # noqa: E402
from cflow_torch.types import CFlowError  # noqa: E402

MOVES = 0.05  # metres per sweep
STEPS = (0.1, 0.3, 0.55, 1.0, 1.5)  # metres per sweep of the vehicle beside façades
GAPS = (0.1, 0.2, 0.3, 0.5)  # metres from walkers to a wall
FUTURE = 4  # sweeps after t+1 that the windows of small drives have


@dataclass(frozen=True)
class Row:
    """A line of the table per setting.

    Args:
        name: "crown" or "facade-av2-0.55".
        sets: what it is the score of; several = the mean over sensors.
        target: as the table shows it.
        preset: that it is the score of, whatever is asked for.
    """

    name: str
    sets: Tuple[ScoredSet, ...]
    target: str = ""
    preset: Optional[str] = None

    @property
    def is_real(self) -> bool:
        """Whether its points were measured."""
        return self.sets[0].group in ("real", "merged")


_REAL = {
    "crown": ("crown h=0", "≤ .06 / – / ≤ .003"),
    "7fab": ("av2 pair h=0", "≤ .037 / ≤ .4 / ≤ .0007"),
    "c2": ("later kitti h=4", "≤ .032 / ≤ .28 / ≤ .0014"),
    "a0": ("kitti h=0", "≤ .0338 / – / ≤ .0007"),
    "a4": ("kitti h=4", "≤ .0224 / – / ≤ .0003"),
}
_SCENES: Dict[str, Tuple[Callable[..., Staged], str]] = {
    "hedge": (failure_drives.hedge, "dynamic ≤ .02"),
    "crowd": (failure_drives.crowd, "dynamic ≤ .06"),
    "tram": (failure_drives.tram, "dynamic ≤ .05"),
    "rolling": (failure_drives.rolling_shutter, "dynamic ≤ .04"),
    "appears": (failure_drives.appearing, ""),
}
for _gap in GAPS:
    _SCENES[f"walkers-{_gap:g}"] = (partial(merged_drives.walkers, gap=_gap), "")
for _name in ("tree", "bridge", "gantry", "wires", "train", "abreast", "border"):
    _SCENES[_name] = (getattr(merged_drives, _name), "")
for _profile in ("av2", "waymo"):
    for _step in STEPS:
        _drive = partial(merged_drives.facade, step=_step, profile=_profile)
        _SCENES[f"facade-{_profile}-{_step:g}"] = (_drive, "stands ≤ .002")


def all_rows(scene_seeds: Tuple[int, int], seeds: Sequence[Tuple[int, int]], cache: Path) -> Iterator[Row]:
    """Every row; nothing is loaded yet.

    Args:
        scene_seeds: first and last seed of the small drives.
        seeds: first and last seed of each range of drives of the five sensors.
        cache: folder for the drives of the five sensors.
    """
    real = {scored.name: scored for scored in make_sets(("real", "merged"), (), cache)}
    for name, (of_set, target) in _REAL.items():
        yield Row(name, (real[of_set],), target)
    small = {name: _small_set(name, stage, scene_seeds) for name, (stage, _) in _SCENES.items()}
    for name, (_, target) in _SCENES.items():
        yield Row(name, (small[name],), target)
    if "offline" in PRESETS:
        yield Row("appears-offline", (small["appears"],), "dynamic ≤ .10", "offline")
    for start, end in seeds:
        sets = tuple(make_sets(("sim",), ((start, end),), cache))
        yield Row(f"sim-{start}-{end}", sets, "near ≤ .09, far ≤ .25, static ≤ .004")


def _small_set(name: str, stage: Callable[[int], Staged], seeds: Tuple[int, int]) -> ScoredSet:
    reach = merged_drives.BORDERS[-1] if name == "border" else NEAR
    return ScoredSet(name, "scene", HISTORY, None, partial(_items, stage, *seeds), reach=reach)


def chosen(rows: Sequence[Row], only: Optional[Sequence[str]]) -> List[Row]:
    """The rows of some names; "facade" stands for "facade-av2-0.1" and so on. None = all.

    Raises:
        CFlowError: no row has such a name.
    """
    if not only:
        return list(rows)
    for name in only:
        if not any(_is_of(row, name) for row in rows):
            raise CFlowError(f"there is no row {name!r}; there are {', '.join(row.name for row in rows)}")
    return [row for row in rows if any(_is_of(row, name) for name in only)]


def _is_of(row: Row, name: str) -> bool:
    return row.name == name or row.name.startswith(f"{name}-")


@lru_cache(maxsize=None)
def _items(stage: Callable[[int], Staged], first: int, last: int) -> List[Item]:
    """A window per seed. What moves but is not looked at does not count; what stands does."""
    items = []
    for seed in range(first, last + 1):
        staged = stage(seed)
        drive, labels = staged.drive, staged.drive.labels(PAIR)
        item = make_item(window(drive, PAIR, HISTORY, FUTURE), labels)
        moves = np.linalg.norm(labels.flow - item.pose_flow, axis=1) >= MOVES
        is_other = moves & ~np.isin(failure_drives.body_of(drive), list(staged.bodies))
        items.append(Item(item.window, labels, item.pose_flow, ~is_other))
    return items
