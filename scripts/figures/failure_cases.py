#!/usr/bin/env python3
"""Draw the pictures of docs/limits.md and print its table of failures, from small simulated drives (drives.py).

  python scripts/figures/failure_cases.py                         docs/pictures/limit_*.png, and the table
  python scripts/figures/failure_cases.py --only rail fast        some cases

A row of the table has the mean end-point error of the named objects, in metres per sweep: its mean over the seeds, the
smallest and the largest, and the mean confidence. A picture shows one seed: the first setting above the last, each with
estimate, truth and error.
"""

from __future__ import annotations

import argparse
import math
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Callable, NamedTuple, Sequence

import drives
import numpy as np
from drives import PAIR, Staged, body_of
from PIL import Image

from cflow_torch import Sweep, make_config, make_model
from cflow_torch.data.log import window
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.ground import find_ground
from cflow_torch.simulator.drive import Drive
from cflow_torch.viz import plot_flow

SEEDS = range(5)
FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
WIDE = (-100.0, -100.0, -math.inf, 100.0, 100.0, math.inf)


class Attempt(NamedTuple):
    name: str  # preset and overrides
    residual: np.ndarray  # (N, 3) estimated total flow minus the flow of the TRUE ego motion, metres per sweep
    error: float  # mean end-point error of the scored objects, metres per sweep
    confidence: float  # their mean confidence, NaN if the method has none


class Case(NamedTuple):
    """A failure: a drive with its scored objects, and the results by several settings. The first one fails."""

    staged: Staged
    truth: np.ndarray  # (N, 3) true residual flow, metres per sweep
    attempts: list[Attempt]


Setting = Callable[[Staged], Attempt]


def by(
    preset: str, name: str = "", change: Callable[[Sweep], Sweep] = lambda sweep: sweep, **overrides: Any
) -> Setting:
    """A setting: estimates the flow of the scored pair of a drive, whose sweeps may be changed.

    Its name in the table is the preset and the overrides, unless one is given.
    """
    described = name or ", ".join([f"`{preset}`", *(f"{k}={v}" for k, v in overrides.items())])

    def attempt(staged: Staged) -> Attempt:
        config, drive = make_config(preset, **overrides), staged.drive
        given = window(drive, PAIR, config.num_history, config.num_future)
        (result,) = make_model(config)([given.with_sweeps(map(change, given.sweeps))])
        is_scored = np.isin(body_of(drive), list(staged.bodies))
        residual, truth = (residual_of(flow, drive) for flow in (result.flow.numpy(), drive.labels(PAIR).flow))
        error = np.linalg.norm(residual - truth, axis=1)[is_scored].mean()
        confidence = math.nan if result.confidence is None else result.confidence.numpy()[is_scored].mean()
        return Attempt(described, residual, float(error), float(confidence))

    return attempt


def misplace(sweep: Sweep) -> Sweep:
    """Replace the pose by that of a frame 1.4 m behind the frame of the points."""
    return replace(sweep, pose=sweep.pose @ np.array([[1, 0, 0, -1.4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


_DEFAULT, _PAIR = (by("default"),), by("default", num_history=0)
_PAPER_AND_DEFAULT = (by("paper"), *_DEFAULT)
_GROUND_LEFT_IN = by("default", "`default`, ground=None", lambda sweep: replace(sweep, is_ground=None))
_GROUND_FOUND = by("default", "`default`, ground='auto'", lambda s: replace(s, is_ground=find_ground(s.points)))
_WRONG_FRAME = [by(preset, f"`{preset}`, wrong frame", misplace) for preset in ("paper", "default")]
# The drive, the settings (the first one fails), and the seed of the picture.
CASES: dict[str, tuple[Callable[[int], Staged], Sequence[Setting], int | None]] = {
    "long_side": (drives.tram, [by(p, num_history=h) for p, h in (("default", 0), ("offline", 0), ("default", 4))], 0),
    "rail": (drives.rail, _PAPER_AND_DEFAULT, 0),
    "bridge": (drives.bridge, _DEFAULT, 0),
    "gantry": (drives.gantry, _DEFAULT, None),
    "crowd": (drives.crowd, (*_DEFAULT, _PAIR), None),
    "touching": (drives.touching, _PAPER_AND_DEFAULT, 0),
    "turning": (drives.turning, (by("paper", num_history=4), *_DEFAULT, _PAIR), 4),
    "abreast": (drives.abreast, _DEFAULT, None),
    "vertical": (drives.vertical, [by("paper", num_history=4, sectional_view=on) for on in (False, True)], None),
    "fast": (drives.fast, (by("default", max_speed=40), by("default")), 2),
    "oncoming": (drives.oncoming, (*_DEFAULT, _PAIR), 0),
    "sparse": (drives.sparse, (_PAIR, *_DEFAULT), 0),
    "beyond_region": (drives.far, (by("default"), by("default", "`default`, ±100 m", point_cloud_range=WIDE)), None),
    "ground_left_in": (drives.street, (_GROUND_LEFT_IN, _GROUND_FOUND), 1),
    "wrong_frame": (drives.turn, (*_WRONG_FRAME, by("default", "`default`, right frame")), 0),
    "appearing": (drives.appearing, (by("default"), by("offline")), 0),
    "appeared": (partial(drives.appearing, later=4), _DEFAULT, None),
    "rolling_shutter": (drives.rolling_shutter, _DEFAULT, None),
    "frozen_world": (partial(drives.rolling_shutter, profile="av2"), _DEFAULT, None),
}


def make_case(name: str, seed: int) -> Case:
    stage, settings, _ = CASES[name]
    staged = stage(seed)
    truth = residual_of(staged.drive.labels(PAIR).flow, staged.drive)
    return Case(staged, truth, [setting(staged) for setting in settings])


def residual_of(flow: np.ndarray, drive: Drive) -> np.ndarray:
    """(N, 3) total flow of the scored pair minus that of the true ego motion, metres per sweep."""
    T_ego1_ego0 = np.linalg.inv(drive.poses[PAIR + 1]) @ drive.poses[PAIR]
    return flow - ego_motion_flow(drive.sweep(PAIR).points, T_ego1_ego0)


def draw(case: Case) -> Image.Image:
    """A row of estimate, truth and error for the first and the last setting, with the same colours."""
    low, high = case.staged.view[:2], case.staged.view[2:]
    sweep, truth = case.staged.drive.sweep(PAIR), case.truth
    kept = ~sweep.is_ground
    shown = np.all((sweep.points[:, :2] >= low) & (sweep.points[:, :2] <= high), axis=1) & kept
    longest = np.linalg.norm(truth[shown], axis=1).max()
    rows = []
    for attempt in case.attempts[:1] + case.attempts[1:][-1:]:
        figure = plot_flow(
            sweep.points[kept],
            attempt.residual[kept],
            point_cloud_range=(*low, -math.inf, *high, math.inf),
            max_flow=max(math.ceil(10 * longest) / 10, 0.5),
            truth=truth[kept],
            title=f"{attempt.name.replace('`', '')}: error {attempt.error:.2f} m ({case.staged.whose})",
        )
        figure.canvas.draw()
        rows.append(np.asarray(figure.canvas.buffer_rgba())[:, :, :3])
    picture = Image.fromarray(np.concatenate(rows))
    return picture.quantize(palette=picture.quantize(256))  # half the bytes; dithering keeps the colour wheel smooth


def print_rows(cases: Sequence[Case]) -> None:
    """Print the rows of a failure: one per setting, over several seeds."""
    heading = (cases[0].staged.title, cases[0].staged.whose)
    for attempts in zip(*(case.attempts for case in cases)):
        errors, trust = np.array([(attempt.error, attempt.confidence) for attempt in attempts]).T
        error = " | ".join(f"{value:.3f}" for value in (errors.mean(), errors.min(), errors.max()))
        shown = "-" if np.isnan(trust).any() else f"{trust.mean():.2f}"
        print(f"| {' | '.join((*heading, attempts[0].name, error, shown))} |", flush=True)
        heading = ("", "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), default=tuple(CASES), metavar="CASE")
    given = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # one of the cases leaves the ground in
    print("| | of | setting | error, m | smallest | largest | confidence |\n|---|---|---|---|---|---|---|")
    for name in given.only:
        cases = [make_case(name, seed) for seed in SEEDS]
        print_rows(cases)
        *_, drawn = CASES[name]
        if drawn is not None:
            draw(cases[drawn]).save(FOLDER / f"limit_{name}.png", optimize=True)


if __name__ == "__main__":
    main()
