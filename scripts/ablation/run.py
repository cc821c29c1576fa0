#!/usr/bin/env python3
"""What each part of the method brings: rows of settings (rows.py) on real and simulated sets (sets.py).

  python scripts/ablation/run.py --seeds 100-103 400-403                  every row
  python scripts/ablation/run.py --only default fast --sets real odd      some rows, some sets
  python scripts/ablation/run.py --preset default --set significance=1    any setting

Sets: real (CFLOW_DATA, else ../shared/data), odd (the other windows of the same KITTI drive), sim (simulated drives of
five sensors, h = 4), sim0 (the same, h = 0), merged (what a bird's-eye view merges: a car under a crown, walkers by a
wall). Every setting gets the history and the region of the set. Seeds 100-103
were used to choose settings, 400-403 to look at the choice; 300 and above are for the last score only.

OUTPUT gets ablation.md and ablation.csv, row by row. Figures are kept one by one in OUTPUT/rows: after an interruption
call it again. Those of other code are made anew.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import re
import sys
import time
from pathlib import Path
from typing import Any, Dict, Optional, Sequence, Tuple

import torch
import yaml
from report import flat_cells, markdown, shown_cells
from rows import ROWS, Setting
from score import Figures, Store, with_means
from sets import make_sets

from cflow_torch.data.records import write_text
from cflow_torch.types import CFlowError

GROUPS = ("real", "odd", "sim", "sim0", "merged")
NOTE = """Real data: +-35 m, ground excluded; EPE in metres over all points, dynamic / static (KITTI h=0: dynamic /
pedestrian, error over speed / static). Simulated drives: region +-70 m; mean over five sensors of the mean dynamic
bucket-normalised error (error over speed), 0-35 m / 35-70 m, and of the static EPE within 35 m; classes over the points
of all sensors.
"""


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Score the rows; returns the exit status."""
    given = parse(arguments)
    torch.set_num_threads(given.threads)
    rows = [row for row in ROWS if not given.only or row.name in given.only]
    if given.preset:
        overrides = dict(given.set)
        rows = [Setting(" ".join([given.preset, *(f"{k}={v}" for k, v in overrides.items())]), given.preset, overrides)]
    scores: Dict[str, Dict[str, Figures]] = {}
    try:
        sets, store = make_sets(given.sets, given.seeds, given.cache), Store(given.output / "rows")
        for number, setting in enumerate(rows, 1):
            start = time.monotonic()
            figures = {scored.name: store.get(scored, setting.for_set(scored)) for scored in sets}
            scores[setting.name] = with_means(figures)
            page = f"{NOTE}\n{markdown(shown_cells(scores))}"
            write_text(given.output / "ablation.md", page)
            write_text(given.output / "ablation.csv", comma_separated(flat_cells(scores)))
            print(f"{number}/{len(rows)} {setting.name}: {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
    except CFlowError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(page)
    return 0


def comma_separated(cells: Sequence[Sequence[str]]) -> str:
    """The table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(cells)
    return text.getvalue()


def parse(arguments: Optional[Sequence[str]]) -> argparse.Namespace:
    """Arguments of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", choices=GROUPS, default=list(GROUPS[:3]))
    parser.add_argument("--seeds", nargs="+", type=seed_range, default=[(100, 103)], metavar="FIRST-LAST")
    parser.add_argument("--only", nargs="+", choices=[row.name for row in ROWS], metavar="ROW")
    parser.add_argument("--preset", help="score this one with what --set changes, in place of the rows")
    parser.add_argument("--set", nargs="+", type=override, default=[], metavar="NAME=VALUE")
    parser.add_argument("--output", type=Path, default=Path("outputs/ablation"))
    cache = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")
    parser.add_argument("--cache", type=Path, default=cache, help="folder for simulated drives; default $CFLOW_CACHE")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args(arguments)


def seed_range(text: str) -> Tuple[int, int]:
    """First and last seed of "100-103"."""
    match = re.fullmatch(r"(\d+)-(\d+)", text)
    if match is None or int(match[1]) > int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}: give a first and a last seed, for example 100-103")
    return int(match[1]), int(match[2])


def override(text: str) -> Tuple[str, Any]:
    """Name and value of "significance=1"."""
    name, found, value = text.partition("=")
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME=VALUE, for example significance=1")
    return name, yaml.safe_load(value)


if __name__ == "__main__":
    sys.exit(main())
