#!/usr/bin/env python3
"""Run the experiments of the paper, then write a page with every table and figure.

  python scripts/paper/tables.py                                   the whole simulated benchmark
  python scripts/paper/tables.py data=benchmark_small              20 windows, a few minutes
  python scripts/paper/tables.py data=av2 data.root=/data/av2/val output=outputs/av2val
  python scripts/paper/tables.py --only history scales             some experiments
  python scripts/paper/tables.py --only --page docs/paper          no experiments, only the page of outputs/paper

Arguments with "=" are Hydra overrides and go to every `cflow eval -m experiment=...`. Completed runs are skipped, so
call the script again after an interruption. Results are written to output=FOLDER (default outputs/paper), tables and
figures to --page (default FOLDER/paper), and the page next to them (FOLDER/paper.md).

Each table or figure is written to NAME.md and NAME.csv, figures also to NAME.png (needs matplotlib), with the paper's
numbers next to ours. For figures, the page has the means over the classes and NAME.md has the classes. Across data
sets, the page has CorrelationFlow and NAME.md has all methods. Missing runs are "-" in the tables, and are listed on
the page and on the screen.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, List, Sequence

from results import CLASSES, METHODS, RANGES, Ours, Runs, load_paper, load_runs, protocol, range_errors

from cflow_torch.data.atomic import atomic_name, write_text

# Experiments that take most time, or need an extra, are last.
EXPERIMENTS = ("pixel_size", "views", "history", "scales", "keypoints", "datasets", "range_split", "clustering")
PER_SET = ("datasets", "range_split")  # experiments whose columns are data sets, not classes
INTRODUCTION = """# The paper's tables next to ours

The score is the dynamic bucket-normalised EPE, averaged over classes; lower is better. Rows "paper" are of Argoverse 2
val, or of the set that they name. Rows "benchmark (av2)" are ours, on simulated drives: compare whether a change helps,
not the numbers. The line "benchmark (av2): ..." below a table describes our run. A table without it has the run of the
table above. The CSV files next to the pictures have the score of each class. docs/settings.md has the commands.
"""
ABOUT_OTHERS = "the next two pictures also show the paper's other methods; scripts/paper/figures.yaml has their numbers"
Cells = List[List[str]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiments; returns 1 if any of them failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="SETTING=VALUE")
    parser.add_argument("--only", nargs="*", choices=EXPERIMENTS, default=EXPERIMENTS)
    parser.add_argument("--page", type=Path, help="folder of the tables and figures")
    given = parser.parse_intermixed_args(arguments)
    wrong = [text for text in given.overrides if "=" not in text]
    if wrong:
        print(f"error: {wrong} are not settings: give NAME=VALUE", file=sys.stderr)
        return 2
    outputs = [text.partition("=")[2] for text in given.overrides if text.startswith("output=")]
    output = Path(outputs[-1] if outputs else "outputs/paper")
    overrides = [text for text in given.overrides if not text.startswith("output=")]
    failed = []
    for name in given.only:
        start = time.monotonic()
        call = [sys.executable, "-m", "cflow_torch.cli.main", "eval", "-m", f"experiment={name}", f"output={output}"]
        status = subprocess.run([*call, *overrides]).returncode
        print(f"{name}: {time.monotonic() - start:.0f} s, exit status {status}", flush=True)
        if status:
            failed.append(name)
    if not output.is_dir():
        return 1
    write_pages(output, given.page or output / "paper")
    if failed:
        print(f"failed: {', '.join(failed)}; call again to resume", file=sys.stderr)
    return 1 if failed else 0


def class_cells(paper: dict[str, Any], ours: Ours) -> Cells:
    """Header and rows of a table with a column per class: for each row the paper's numbers, then ours of each set.

    Rows that the paper does not have are last.
    """
    base = paper.get("difference_to")
    cells = [[paper["row"], "from", *CLASSES, "mean", paper.get("time", "time [s]")]]
    for row in dict.fromkeys([*paper["rows"], *(row for runs in ours.values() for row in runs)]):
        is_difference = base is not None and row != base
        if row in paper["rows"]:
            padded = [*paper["rows"][row], math.nan][:6]
            cells.append([row, "paper", *(number(value, is_difference) for value in padded)])
        for data_set, runs in ours.items():
            values = [*runs[row].values(), runs[row].seconds()] if row in runs else [math.nan] * 6
            if is_difference:
                first = [*runs[base].values(), runs[base].seconds()] if base in runs else [math.nan] * 6
                values = [value - start for value, start in zip(values, first)]
            cells.append([row, data_set, *(number(value, is_difference) for value in values)])
    return cells


def set_cells(paper: dict[str, Any], ours: Ours) -> Cells:
    """Header and rows of a table with a column per method: a row per data set (and range), the paper's first."""
    rows: list[tuple[str, str, dict[str, float]]] = []
    if "bars" in paper:
        methods, scores = list(paper["bars"]), protocol(ours)
        for index, name in enumerate(paper["at"]):
            rows.append((name, "paper", {method: paper["bars"][method][index] for method in methods}))
        if scores:
            rows.append(("Overall", "ours", {method: score.overall for method, score in scores.items()}))
        rows += [(name, "ours", {method: score.data_sets[name] for method, score in scores.items()}) for name in ours]
    else:
        methods = list(next(iter(paper["panels"].values())))
        for name, origin, of_range in (
            *((name, "paper", panel) for name, panel in paper["panels"].items()),
            *((name, "ours", {m: range_errors(run) for m, run in runs.items()}) for name, runs in ours.items()),
        ):
            for index, reach in enumerate(RANGES):
                rows.append((f"{name} {reach} m", origin, {m: values[index] for m, values in of_range.items()}))
    cells = [[name, origin, *(number(values.get(m, math.nan)) for m in methods)] for name, origin, values in rows]
    return [["data set", "from", *methods], *cells]


def mean_cells(cells: Cells) -> Cells:
    """Means over the classes from a figure's `class_cells`, with a column per point of the figure.

    Points such as "h=0, 2 scales" give a column per number of scales, and rows for each h. Otherwise, the rows are the
    paper and each data set.
    """
    lines: dict[str, dict[str, str]] = {}
    for point, origin, *_, mean, _seconds in cells[1:]:
        line, _, column = point.rpartition(", ")
        lines.setdefault(f"{line}, {origin}" if line else origin, {})[column] = mean
    columns = list(dict.fromkeys(column for values in lines.values() for column in values))
    rows = [[line, *(values.get(column, "-") for column in columns)] for line, values in lines.items()]
    return [["mean of the classes", *columns], *rows]


def number(value: float, signed: bool = False) -> str:
    """Four decimals, "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:+.4f}" if signed else f"{value:.4f}"


def missing_runs(paper: dict[str, Any], runs: Runs) -> list[str]:
    """A line for each table or figure whose runs are not complete."""
    lines = []
    for name, about in paper.items():
        wanted = list(METHODS.values()) if name in PER_SET else list(about["rows"])
        for data_set, rows in (runs.get(name) or {"any data": {}}).items():
            absent = [row for row in wanted if row not in rows]
            if absent:
                lines.append(f"{name}, {data_set}: {'; '.join(absent)} (cflow eval -m experiment={name} data=...)")
    return lines


def about_runs(ours: Ours) -> list[str]:
    """A line per data set with the data, versions and dates of our numbers."""
    lines = []
    for data_set, rows in ours.items():
        about = []
        for r in (run.record for run in rows.values()):
            logs, versions = r["data"]["logs"], r["versions"]
            about.append(
                f"{data_set}: {r['num_pairs']} windows of {len(logs)} logs (digest {r['data']['digest']}), definition "
                f"{r['definition']['name']}, cflow_torch {versions['cflow_torch']}, torch {versions['torch']}, "
                f"{r['date'][:10]}; {r['machine']['threads']} thread(s)"
                + (f"; {len(r['failures'])} pairs failed" if r["failures"] else "")
            )
        lines += dict.fromkeys(about)
    return lines


def markdown(cells: Cells) -> str:
    """A Markdown table."""
    words = 1 + (cells[0][1] == "from")
    rule = ["---"] * words + ["---:"] * (len(cells[0]) - words)
    return "".join("| " + " | ".join(row) + " |\n" for row in (cells[0], rule, *cells[1:]))


def write_pages(results: Path, output: Path) -> None:
    """Write OUTPUT.md, and its tables and figures to the folder OUTPUT, from results.json files at any depth."""
    paper = load_paper()
    runs, remarks = load_runs(results)
    try:
        from plots import draw
    except ImportError as error:
        draw = None
        remarks.append(f"no pictures: {error}")
    page, last_described = [INTRODUCTION], []
    for name, about in paper.items():
        ours = runs.get(name, {})
        cells = (set_cells if name in PER_SET else class_cells)(about, ours)
        write_text(output / f"{name}.md", markdown(cells))
        with atomic_name(output / f"{name}.csv") as temporary, temporary.open(
            "w", encoding="utf-8", newline=""
        ) as file:
            csv.writer(file, lineterminator="\n").writerows(cells)
        is_figure = "at" in about
        described = about_runs(ours)
        notes = [] if described == last_described else list(described)
        notes += [about["note"]] if "note" in about else []
        last_described = described or last_described
        if name in PER_SET:
            kept = [column for column, name in enumerate(cells[0]) if column < 2 or name in METHODS.values()]
            shown = [[row[column] for column in kept] for row in cells]
            notes += [ABOUT_OTHERS] if name == PER_SET[0] else []
            notes += [f"{method}: {reason}" for method, score in protocol(ours).items() for reason in score.missing]
        else:
            shown = mean_cells(cells) if is_figure else [[*row[:2], *row[-2:]] for row in cells]
        page += [f"## {about['title']} ({about['label']})", "", markdown(shown)]
        page += [*(f"- {line}" for line in notes), ""] if notes else []
        if draw is not None and is_figure:
            with atomic_name(output / f"{name}.png") as temporary:
                draw(name, about, ours).savefig(temporary, format="png", dpi=130)
            page += [f"![{about['title']}]({output.name}/{name}.png)", ""]
    missing = missing_runs(paper, runs)
    for title, lines in (("Missing runs", missing), ("Remarks", remarks)):
        if lines:
            page += [f"## {title}", "", *(f"- {line}" for line in lines), ""]
            print(f"{title}:", *lines, sep="\n  ", file=sys.stderr)
    file = output.with_name(f"{output.name}.md")
    write_text(file, "\n".join(page))
    print(f"tables and figures: {file}")


if __name__ == "__main__":
    sys.exit(main())
