#!/usr/bin/env python3
"""Every figure of docs/beyond.md: sets, target table, ablation, times.

  python scripts/beyond.py targets                                   presets beside each other and the targets
  python scripts/beyond.py ablation --seeds 100-103 400-403          each option alone, each one taken away
  python scripts/beyond.py times                                     time over that of the paper's method
  python scripts/beyond.py score --preset default --set children=false proof_z=1 --sets real sim     any setting

Sets: real (CFLOW_DATA, else ../shared/data), odd (the other windows of the same KITTI drive), sim (simulated drives of
five sensors, h = 4), sim0 (the same, h = 0). Every setting gets the history and the region of the set. Seeds 100-103
were used to choose settings, 400-403 to look at the choice; 300 and above are for the last score only.

Figures are kept one by one in OUTPUT/rows: after an interruption call it again. Those of other code are made anew,
unless --any-code is given. OUTPUT gets results.json and targets.md, ablation.md, ablation.csv, times.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import torch
import yaml
from beyond_rows import DEFAULT, FAST, PRESETS, Setting, ablation
from beyond_score import Store, changed, code_key
from beyond_sets import ScoredSet, make_sets
from beyond_tables import ablation_cells, flat_cells, markdown, sensor_cells, target_cells, with_means
from beyond_times import measure, record, time_cells
from paper_tables import comma_separated

from cflow_torch import __version__
from cflow_torch.data.records import strict, write_text
from cflow_torch.types import CFlowError

GROUPS = ("real", "odd", "sim", "sim0")
TIMED = ("kitti h=0", "kitti h=4", "sim av2")  # starts of names of sets
NOTE = (
    "Real data: +-35 m, ground excluded; EPE in metres over all points. Simulated drives: region +-70 m; mean over\n"
    "five sensors of the mean dynamic bucket-normalised error (error / speed) and of the static EPE within 35 m;\n"
    "classes over the points of all sensors.\n"
)
CELLS = "Cells: dynamic / static; KITTI h=0 dynamic / pedestrian / static; simulated 0-35 m / 35-70 m / static.\n"


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Run a command; returns the exit status."""
    given = parse(arguments)
    if given.threads:
        torch.set_num_threads(given.threads)
    try:
        return int(COMMANDS[given.command](given))
    except CFlowError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def score(given: argparse.Namespace) -> int:
    """Print the figures of one setting."""
    overrides = dict(given.set)
    setting = Setting(" ".join([given.preset, *(f"{k}={v}" for k, v in overrides.items())]), given.preset, overrides)
    figures = with_means(score_sets(setting, sets_of(given), Store(given.output / "rows", given.any_code), given.box))
    print(
        json.dumps(strict({name: {k: v for k, v in f.items() if k != "sums"} for name, f in figures.items()}), indent=1)
    )
    return 0


def targets(given: argparse.Namespace) -> int:
    """The presets on every set, as target table, and per sensor."""
    scores = {setting.name: figures for setting, figures in score_rows(PRESETS, given)}
    page = [f"{NOTE}\n{command(given)}", markdown(target_cells(scores))]
    if len(sensor_cells(scores)) > 1:
        page.append(markdown(sensor_cells(scores)))
    finish(given, scores, PRESETS, "targets.md", "\n".join(page))
    return 0


def ablate(given: argparse.Namespace) -> int:
    """The rows of the ablation; the table grows row by row."""
    rows, scores = ablation(), {}
    for setting, figures in score_rows(rows, given):
        scores[setting.name] = figures
        cells = ablation_cells(scores)
        write_text(given.output / "ablation.csv", comma_separated(flat_cells(scores)))
        finish(given, scores, rows, "ablation.md", f"{NOTE}{CELLS}\n{command(given)}\n{markdown(cells)}")
    return 0


def times(given: argparse.Namespace) -> int:
    """Ratios of times."""
    sets = [s for s in sets_of(given) if s.name.startswith(TIMED) and s.group in ("real", "sim")]
    threads = given.threads or os.cpu_count() or 1
    timed = measure(sets, (DEFAULT, FAST), given.rounds, threads)
    title = (
        f"Time over that of `paper` at equal h, region and scales: {given.rounds} rounds in turn, {threads} thread(s)."
    )
    page = f"{title}\n\n{command(given)}\n{markdown(time_cells(timed))}"
    write_text(given.output / "times.json", json.dumps(record(timed, threads), indent=1))
    write_text(given.output / "times.md", page)
    print(page)
    return 0


COMMANDS = {"score": score, "targets": targets, "ablation": ablate, "times": times}


def sets_of(given: argparse.Namespace) -> List[ScoredSet]:
    """The sets that were asked for."""
    return make_sets(given.sets, given.seeds, given.cache)


def score_sets(
    setting: Setting, sets: Sequence[ScoredSet], store: Store, half_side: Optional[float] = None
) -> Dict[str, Any]:
    """Figures of one setting by set."""
    return {scored.name: store.get(scored, setting.for_set(scored, half_side)) for scored in sets}


def score_rows(rows: Sequence[Setting], given: argparse.Namespace) -> Any:
    """Yields settings and their figures with means, one after the other."""
    sets, store = sets_of(given), Store(given.output / "rows", given.any_code)
    for number, setting in enumerate(rows, 1):
        start = time.monotonic()
        figures = with_means(score_sets(setting, sets, store))
        print(f"{number}/{len(rows)} {setting.name}: {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
        yield setting, figures


def finish(given: argparse.Namespace, scores: Dict[str, Any], rows: Sequence[Setting], name: str, page: str) -> None:
    """Write a page and the figures behind it to results.json, beside those of the other commands."""
    file = given.output / "results.json"
    results = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    configs = {setting.name: changed(setting.config()) for setting in rows}
    results[given.command] = {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "versions": {"cflow_torch": __version__, "torch": torch.__version__, "code": code_key()},
        "settings": {
            setting: {
                "config": configs[setting],
                "figures": {s: {k: v for k, v in f.items() if k != "sums"} for s, f in figures.items()},
            }
            for setting, figures in scores.items()
        },
    }
    write_text(file, json.dumps(strict(results), indent=1))
    write_text(given.output / name, page)
    if len(scores) == len(rows):
        print(page)


def command(given: argparse.Namespace) -> str:
    """The command that made a page, as Markdown."""
    seeds = " ".join(f"{first}-{last}" for first, last in given.seeds)
    line = f"python scripts/beyond.py {given.command} --sets {' '.join(given.sets)} --seeds {seeds}"
    return f"```bash\n{line}\n```\n"


def parse(arguments: Optional[Sequence[str]]) -> argparse.Namespace:
    """Arguments of a command."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--sets", nargs="+", choices=GROUPS, default=list(GROUPS[:3]))
    shared.add_argument("--seeds", nargs="+", type=_seeds, default=[(100, 103)], metavar="FIRST-LAST")
    shared.add_argument("--output", type=Path, default=Path("outputs/beyond"))
    cache = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")
    shared.add_argument("--cache", type=Path, default=cache, help="folder for simulated drives; default $CFLOW_CACHE")
    shared.add_argument("--threads", type=int, help="default: what torch takes; times: all cores")
    shared.add_argument("--any-code", action="store_true", help="also take kept figures that other code made")
    about = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=about)
    commands = parser.add_subparsers(dest="command", required=True)
    parts = {name: commands.add_parser(name, parents=[shared], help=run.__doc__) for name, run in COMMANDS.items()}
    parts["score"].add_argument("--preset", default="default")
    parts["score"].add_argument("--set", nargs="+", type=_setting, default=[], metavar="NAME=VALUE")
    parts["score"].add_argument("--box", type=float, help="half side of the region, metres; default: the set's")
    parts["times"].add_argument("--rounds", type=int, default=7)
    return parser.parse_args(arguments)


def _seeds(text: str) -> Tuple[int, int]:
    match = re.fullmatch(r"(\d+)-(\d+)", text)
    if match is None or int(match[1]) > int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}: give a first and a last seed, for example 100-103")
    return int(match[1]), int(match[2])


def _setting(text: str) -> Tuple[str, Any]:
    name, found, value = text.partition("=")
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME=VALUE, for example children=false")
    return name, yaml.safe_load(value)


if __name__ == "__main__":
    sys.exit(main())
