#!/usr/bin/env python3
"""Motion that a bird's-eye view merges: under trees, beside walls, in crowds, at the border. One table, in Markdown.

  python scripts/benchmarks/merged_motion.py                                  everything; the five sensors take minutes
  python scripts/benchmarks/merged_motion.py --only crown c2 facade           some rows, or families of rows
  python scripts/benchmarks/merged_motion.py --preset default fast            presets beside each other
  python scripts/benchmarks/merged_motion.py --set --set significance=1       as it is, and with something changed

Rows: real data (CFLOW_DATA, else ../shared/data) within 35 m (crown, 7fab, a0: h = 0; c2, a4: h = 4); small simulated
drives (failure_drives.py and merged_drives.py in scripts/figures), a window per seed, h = 4, the preset's region,
scored within 35 m, "border" within 76.8 m; sim: drives of five sensors, h = 4, region +-70 m, mean over the sensors.

Columns: end-point errors in metres over all points of the row (small drives: mean over the drives), ground excluded.
dynamic: of objects that move by 0.05 m a sweep or more (of a small drive, those that it is about). pedestrian: mean of
error over speed. static: background. stands: all that stands, parked cars too. near, far: mean dynamic
bucket-normalised error at 0-35 m and 35-70 m. missed: moving points whose flow is less than half of the true one.
flagged: share of these with a confidence below the value that 1 % of what stands is below, and below 0.5; with the
share of what stands below 0.5. s: median time of a window; ratio: to the first setting, window by window. The last
lines: 1 % of what stands in all these rows together, and the mean over the rows of the share that is flagged.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import List, Optional, Sequence

import numpy as np
import torch
from merged_figures import Measured, Misses, measure, merged_misses
from merged_rows import Row, all_rows, chosen
from report import number
from rows import Setting
from run import override, seed_range

from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.types import CFlowError

FLAGGED = 0.01  # share of what stands
HEADER = (
    *("row", "setting", "dynamic", "pedestrian", "static", "stands", "near", "far", "missed", "flagged at 1 %"),
    *("flagged < .5", "stands < .5", "windows", "moving", "s", "ratio", "target"),
)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Print the table, row by row; returns the exit status."""
    given = parse(arguments)
    torch.set_num_threads(given.threads)
    settings = [
        Setting(" ".join([preset, *(f"{key}={value}" for key, value in changes)]), preset, dict(changes))
        for preset in given.preset
        for changes in given.set or [[]]
    ]
    misses: List[List[Misses]] = [[] for _ in settings]
    try:
        rows = chosen(list(all_rows(given.scene_seeds, given.seeds, given.cache)), given.only)
        print(line(HEADER) + line(["---"] * len(HEADER)), end="", flush=True)
        for row in rows:
            own = settings if row.preset is None else [Setting(row.preset, row.preset)]
            measured = measure(row.sets, own)
            for setting, figures in zip(own, measured):
                print(line(cells(row, setting.name, figures, measured[0])), end="", flush=True)
            if row.preset is None:
                for of_setting, figures in zip(misses, measured):
                    of_setting.append(figures.misses)
    except CFlowError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = [row for row in rows if row.preset is None]
    for name, group in (("real rows", [row.is_real for row in rows]), ("all rows", [True] * len(rows))):
        for setting, parts in zip(settings, misses):
            if sum(group) > 1:
                shown = total_cells([part for part, is_in in zip(parts, group) if is_in])
                print(line([name, setting.name, *shown]), end="", flush=True)
    return 0


def cells(row: Row, setting: str, figures: Measured, first: Measured) -> List[str]:
    """A row of the table; `first`: the figures of the first setting."""
    errors = [number(figures.errors[key]) for key in ("dynamic", "pedestrian", "static", "stands", "near", "far")]
    time = [f"{figures.seconds:.3f}", f"{figures.ratio_to(first):.2f}"]
    counts = [str(len(figures.times)), str(figures.misses.moving)]
    return [row.name, setting, *errors, *miss_cells(figures.misses), *counts, *time, row.target]


def miss_cells(misses: Misses) -> List[str]:
    """How many are missed; shares that are flagged."""
    at_share = misses.flagged_below(misses.confidence_at(FLAGGED))
    shares = (at_share, misses.flagged_below(0.5), misses.standing_below(0.5))
    return [str(misses.missed), *(number(share) for share in shares)]


def total_cells(parts: Sequence[Misses]) -> List[str]:
    """What several rows have together: of the shares the mean over the rows, so that no large object decides."""
    together = merged_misses(parts)
    by_row = [[part.flagged_below(bound) for part in parts] for bound in (together.confidence_at(FLAGGED), 0.5)]
    shares = [*(mean_of_present(np.array(of_rows)) for of_rows in by_row), together.standing_below(0.5)]
    flags = [str(together.missed), *(number(share) for share in shares)]
    return [*[""] * 6, *flags, "", str(together.moving), "", "", "flagged ≥ .8"]


def line(texts: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(texts)} |\n"


def parse(arguments: Optional[Sequence[str]]) -> argparse.Namespace:
    """Arguments of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="ROW")
    parser.add_argument("--preset", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", type=override, action="append", metavar="NAME=VALUE", help="once a setting")
    parser.add_argument(
        "--seeds", nargs="+", type=seed_range, default=[(400, 403)], metavar="FIRST-LAST", help="five sensors"
    )
    parser.add_argument("--scene-seeds", type=seed_range, default=(0, 4), metavar="FIRST-LAST", help="small drives")
    cache = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")
    parser.add_argument("--cache", type=Path, default=cache, help="folder for simulated drives; default $CFLOW_CACHE")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
