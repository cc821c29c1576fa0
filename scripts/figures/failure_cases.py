#!/usr/bin/env python3
"""The failures of docs/limits.md: its pictures and its table, from small simulated drives (failure_scenes.py).

  python scripts/figures/failure_cases.py                         docs/pictures/limit_*.png, and the table
  python scripts/figures/failure_cases.py --only rail fast        some of them
  python scripts/figures/failure_cases.py --pictures ""           the table alone

Each row is the mean over the seeds of the mean end-point error of the points named, metres per sweep, smallest and
largest in brackets, and their mean confidence (docs/verified.md). Pictures show one seed: the first
setting above the last, each with estimate, truth and error.
"""

from __future__ import annotations

import argparse
import io
import math
import warnings
from pathlib import Path
from typing import Iterator, Optional, Sequence

import numpy as np
from failure_scenes import CASES, Case
from PIL import Image

from cflow_torch.viz import plot_flow

# The case, and the seed that is drawn.
PICTURED = {
    "long_side": 0,
    "rail": 0,
    "touching": 0,
    "turning": 4,
    "fast": 2,
    "ground_left_in": 1,
    "wrong_frame": 0,
    "appearing": 0,
    "bridge": 0,
}
SEEDS = (0, 1, 2, 3, 4)
FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"


def draw(case: Case) -> Image.Image:
    """A row of estimate, truth and error for the first and the last setting, on one scale of colours."""
    low, high = case.view[:2], case.view[2:]
    kept = ~case.is_ground
    shown = np.all((case.points[:, :2] >= low) & (case.points[:, :2] <= high), axis=1) & kept
    longest = np.linalg.norm(case.truth[shown], axis=1).max()
    rows = []
    tried = list(zip(case.attempts, case.errors()))
    for attempt, error in tried[:1] + tried[1:][-1:]:
        figure = plot_flow(
            case.points[kept],
            attempt.residual[kept],
            point_cloud_range=(*low, -math.inf, *high, math.inf),
            max_flow=max(math.ceil(10 * longest) / 10, 0.5),
            truth=case.truth[kept],
            title=f"{attempt.name.replace('`', '')}: error {error:.2f} m ({case.whose})",
        )
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=figure.dpi)
        rows.append(np.asarray(Image.open(buffer).convert("RGB")))
    picture = Image.fromarray(np.concatenate(rows))
    return picture.quantize(
        palette=picture.quantize(256)
    )  # half of the bytes; dithered, so that the wheel stays smooth


def table(names: Sequence[str], seeds: Sequence[int]) -> Iterator[str]:
    """Lines of Markdown."""
    yield "| | of | setting | error, m | confidence |"
    yield "|---|---|---|---|---|"
    for name in names:
        cases = [CASES[name](seed) for seed in seeds]
        errors, confidences = np.array([c.errors() for c in cases]), np.array([c.confidences() for c in cases])
        for i, attempt in enumerate(cases[0].attempts):
            heading = (cases[0].title, cases[0].whose) if i == 0 else ("", "")
            error = f"{errors[:, i].mean():.3f} ({errors[:, i].min():.3f}–{errors[:, i].max():.3f})"
            trust = "-" if np.isnan(confidences[:, i]).any() else f"{confidences[:, i].mean():.2f}"
            yield f"| {' | '.join((*heading, attempt.name, error, trust))} |"


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """Print the table, draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), default=tuple(CASES), metavar="CASE")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--pictures", default=str(FOLDER), metavar="FOLDER", help='"" = none')
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore", UserWarning)  # that ground was left in, which is one of the cases
    print("\n".join(table(given.only, given.seeds)))
    for name in (name for name in given.only if name in PICTURED and given.pictures):
        Path(given.pictures).mkdir(parents=True, exist_ok=True)
        draw(CASES[name](PICTURED[name])).save(Path(given.pictures) / f"limit_{name}.png", optimize=True)


if __name__ == "__main__":
    main()
