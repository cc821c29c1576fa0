#!/usr/bin/env python3
"""Run the experiments of the paper, then write a page with every table and figure.

  python scripts/paper/tables.py                                   the whole simulated benchmark
  python scripts/paper/tables.py data=benchmark_small              20 windows, a few minutes
  python scripts/paper/tables.py data=av2 data.root=/data/av2/val output=outputs/av2val
  python scripts/paper/tables.py --only history scales             some experiments; without a name, only the page

Arguments with "=" are Hydra overrides and go to every `cflow eval -m experiment=...`. Completed runs are skipped, so
call the script again after an interruption. Results are written to output=FOLDER (default outputs/paper), the page to
FOLDER/paper.md, and its files to FOLDER/paper: NAME.csv for each table or figure, and NAME.png for each figure (needs
matplotlib). They have the paper's numbers next to ours; "-" = unknown. For figures, the page has the means over the
classes, and NAME.csv has the classes. Across data sets, the page has our methods, and NAME.csv has all methods.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, List, Sequence

from plots import draw
from results import CLASS_COLUMNS, METHODS, Line, Numbers, Records, load_paper, load_runs, make_lines, protocol

from cflow_torch.data.atomic import atomic_name, write_text

# Experiments that take most time, or need an extra, are last.
EXPERIMENTS = ("pixel_size", "views", "history", "scales", "keypoints", "datasets", "range_split", "clustering")
INTRODUCTION = """# The paper's tables next to ours

The score is the dynamic bucket-normalised EPE, averaged over classes; lower is better. Rows "paper" are of Argoverse 2
val, or of the set that they name. Rows "benchmark (av2)" are ours, on simulated drives: compare whether a change helps,
not the numbers. The line "benchmark (av2): ..." below a table describes our run. A table without it is of the same run
as the table above. The CSV files next to the pictures have the score of each class. docs/settings.md has the commands.
"""
Cells = List[List[str]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="SETTING=VALUE")
    parser.add_argument("--only", nargs="*", choices=EXPERIMENTS, default=EXPERIMENTS)
    given = parser.parse_intermixed_args()
    overrides = ["output=outputs/paper", *given.overrides]
    failed = []
    for name in given.only:
        start = time.monotonic()
        call = [sys.executable, "-m", "cflow_torch.cli.main", "eval", "-m", f"experiment={name}", *overrides]
        status = subprocess.run(call).returncode
        print(f"{name}: {time.monotonic() - start:.0f} s, exit status {status}", flush=True)
        if status:
            failed.append(name)
    settings = dict(text.partition("=")[::2] for text in overrides)
    write_pages(Path(settings["output"]))
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; call again to resume")


def write_pages(output: Path) -> None:
    """Write the page, its tables and figures into a folder, from the results.json files below it."""
    runs, page = load_runs(output), [INTRODUCTION]
    last_described: list[str] = []
    for name, about in load_paper().items():
        ours = runs.get(name, {})
        lines = make_lines(name, about, ours)
        cells = table_cells(about, lines)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(cells)
        write_text(output / "paper" / f"{name}.csv", text.getvalue())
        described = about_runs(ours)
        notes = [] if described == last_described else list(described)
        notes += [about["note"]] if "note" in about else []
        last_described = described or last_described
        is_figure = about["label"].startswith("fig:")
        shown = cells
        if "columns" in about:
            kept = [0, 1, *(cells[0].index(method) for method in METHODS.values())]
            shown = [[row[column] for column in kept] for row in cells]
            notes += [f"{method}: {reason}" for method, score in protocol(ours).items() for reason in score.missing]
        else:
            shown = mean_cells(lines) if is_figure else [[*row[:2], *row[-2:]] for row in cells]
        page += [f"## {about['title']} ({about['label']})", "", markdown(shown)]
        page += [*(f"- {line}" for line in notes), ""] if notes else []
        if is_figure:
            with atomic_name(output / "paper" / f"{name}.png") as temporary:
                draw(name, about, lines).savefig(temporary, format="png", dpi=130)
            page += [f"![{about['title']}](paper/{name}.png)", ""]
    write_text(output / "paper.md", "\n".join(page))
    print(f"tables and figures: {output / 'paper.md'}")


def table_cells(about: dict[str, Any], lines: Sequence[Line]) -> Cells:
    """Header and rows of a table; rows that differ from `difference_to` are differences, with a sign."""
    columns, titles = about.get("columns", CLASS_COLUMNS), {"time": about.get("time", "time [s]")}
    cells = [[about["row"], "from", *(titles.get(column, column) for column in columns)]]
    for row, origin, numbers in lines:
        is_difference = row != about.get("difference_to", row)
        cells.append([row, origin, *(number(numbers, column, is_difference) for column in columns)])
    return cells


def mean_cells(lines: Sequence[Line]) -> Cells:
    """Means over the classes of a figure, with a column per point of the figure.

    Points such as "h=0, 2 scales" give a column per number of scales, and rows for each h. Otherwise, the rows are the
    paper and each data set.
    """
    means: dict[str, dict[str, str]] = {}
    for row, origin, numbers in lines:
        curve, _, column = row.rpartition(", ")
        means.setdefault(f"{curve}, {origin}" if curve else origin, {})[column] = number(numbers, "mean")
    columns = list(dict.fromkeys(column for values in means.values() for column in values))
    rows = [[curve, *(values.get(column, "-") for column in columns)] for curve, values in means.items()]
    return [["mean of the classes", *columns], *rows]


def number(numbers: Numbers, column: str, is_difference: bool = False) -> str:
    """Four decimals, "-" for NaN."""
    value = numbers.get(column, math.nan)
    return "-" if math.isnan(value) else f"{value:+.4f}" if is_difference else f"{value:.4f}"


def about_runs(ours: Records) -> list[str]:
    """A line per data set with the data, versions and dates of our numbers."""
    lines = []
    for data_set, rows in ours.items():
        for r in rows.values():
            logs, versions = r["data"]["logs"], r["versions"]
            lines.append(
                f"{data_set}: {r['num_pairs']} windows of {len(logs)} logs (digest {r['data']['digest']}), definition "
                f"{r['definition']['name']}, cflow_torch {versions['cflow_torch']}, torch {versions['torch']}, "
                f"{r['date'][:10]}; {r['machine']['threads']} thread(s)"
                + (f"; {len(r['failures'])} pairs failed" if r["failures"] else "")
            )
    return list(dict.fromkeys(lines))


def markdown(cells: Cells) -> str:
    words = 1 + (cells[0][1] == "from")
    rule = ["---"] * words + ["---:"] * (len(cells[0]) - words)
    return "".join("| " + " | ".join(row) + " |\n" for row in (cells[0], rule, *cells[1:]))


if __name__ == "__main__":
    main()
