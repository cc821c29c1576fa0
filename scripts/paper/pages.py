#!/usr/bin/env python3
"""The tables and figures of the paper from results files, the paper's numbers beside ours.

  python scripts/paper/pages.py RESULTS [--output FOLDER]

RESULTS: a folder that holds results.json files of `cflow eval -m experiment=...`, at any depth. Writes the page
FOLDER.md (default: RESULTS/paper.md), and to FOLDER per table or figure NAME.md, NAME.csv, NAME.tex, for figures
NAME.png and NAME.pdf too (needs matplotlib). Of figures the page has the means, NAME.md the classes; across data sets
the page has CorrelationFlow, NAME.md every method. Missing runs are listed on the page and on the screen, "-" in the
tables. `--output docs/paper` makes docs/paper.md.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

from results import CLASSES, METHODS, RANGES, Ours, Runs, load_paper, load_runs, protocol, range_errors

from cflow_torch.data.atomic import atomic_file

PER_SET = ("datasets", "range_split")  # experiments whose columns are data sets, not classes
INTRODUCTION = """# The paper's tables beside ours

Dynamic bucket-normalised EPE, lower is better. The paper's rows are of Argoverse 2 val, ours of other data: what can be
compared is which way a change goes, not the numbers. Commands, and what each experiment varies: docs/settings.md.
"""
Cells = List[List[str]]


def class_cells(paper: Dict[str, Any], ours: Ours) -> Cells:
    """Header and rows of a table with a column per class: for each row the paper's numbers, then those of each set.

    Rows that the paper does not have come last.
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


def set_cells(paper: Dict[str, Any], ours: Ours) -> Cells:
    """Header and rows of a table with a column per data set (and range): the paper's methods, then ours."""
    scores = protocol(ours)
    if "bars" in paper:
        cells = [["method", "from", *paper["at"], *ours]]
        for method, printed in paper["bars"].items():
            cells.append([method, "paper", *map(number, printed), *("-" for _ in ours)])
        for method, score in scores.items():
            mine = [number(score.overall), *("-" for _ in paper["at"][1:])]
            cells.append([method, "ours", *mine, *(number(score.data_sets[data_set]) for data_set in ours)])
        return cells
    panels = paper["panels"]
    cells = [["method", "from", *(f"{data_set} {name} m" for data_set in (*panels, *ours) for name in RANGES)]]
    for method in next(iter(panels.values())):
        printed = [value for panel in panels.values() for value in panel[method]]
        cells.append([method, "paper", *map(number, printed), *("-" for _ in ours for _ in RANGES)])
    for method in scores:
        mine = [range_errors(runs[method]) if method in runs else [math.nan] * 2 for runs in ours.values()]
        cells.append(
            [method, "ours", *("-" for _ in panels for _ in RANGES), *(number(v) for pair in mine for v in pair)]
        )
    return cells


def mean_cells(cells: Cells) -> Cells:
    """Of a figure's `class_cells` the means: a column per point, for "h=0, 2 scales" per number of scales.

    Rows: the paper and each data set, once for each h where points are named by h and scales.
    """
    lines: Dict[str, Dict[str, str]] = {}
    for point, origin, *_, mean, _seconds in cells[1:]:
        line, _, column = point.rpartition(", ")
        lines.setdefault(f"{line}, {origin}" if line else origin, {})[column] = mean
    columns = list(dict.fromkeys(column for values in lines.values() for column in values))
    rows = [[line, *(values.get(column, "-") for column in columns)] for line, values in lines.items()]
    return [["mean of the classes", *columns], *rows]


def number(value: float, signed: bool = False) -> str:
    """Four decimals, "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:+.4f}" if signed else f"{value:.4f}"


def missing_runs(paper: Dict[str, Any], runs: Runs) -> List[str]:
    """One line for each run that a table or figure still needs."""
    lines = []
    for name, about in paper.items():
        wanted = list(METHODS.values()) if name in PER_SET else list(about["rows"])
        for data_set, rows in (runs.get(name) or {"any data": {}}).items():
            absent = [row for row in wanted if row not in rows]
            if absent:
                lines.append(f"{name}, {data_set}: {'; '.join(absent)} (cflow eval -m experiment={name} data=...)")
    return lines


def about_runs(ours: Ours) -> List[str]:
    """Which data, versions and days our numbers are from, one line per data set."""
    lines = []
    for data_set, rows in ours.items():
        records = [run.record for run in rows.values()]

        def every(*values: Any) -> str:
            return " and ".join(sorted({str(value) for value in values}))

        lines.append(
            f"{data_set}: {every(*(r['num_pairs'] for r in records))} windows of "
            f"{every(*(len(r['data']['logs']) for r in records))} logs (digest "
            f"{every(*(r['data']['digest'] for r in records))}), definition "
            f"{every(*(r['definition']['name'] for r in records))}, cflow_torch "
            f"{every(*(r['versions']['cflow_torch'] for r in records))}, torch "
            f"{every(*(r['versions']['torch'] for r in records))}, {every(*(r['date'][:10] for r in records))}; "
            f"{every(*(r['machine']['threads'] for r in records))} thread(s)"
        )
        failed = sum(len(r["failures"]) for r in records)
        if failed:
            lines.append(f"{data_set}: {failed} pairs failed and are not scored")
    return lines


def markdown(cells: Cells) -> str:
    """A Markdown table."""
    words = 1 + (cells[0][1] == "from")
    rule = ["---"] * words + ["---:"] * (len(cells[0]) - words)
    return "".join("| " + " | ".join(row) + " |\n" for row in (cells[0], rule, *cells[1:]))


def latex(cells: Cells) -> str:
    """A LaTeX tabular in the style of booktabs."""
    special = {"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "+": "{+}"}
    text = [["".join(special.get(c, c) for c in cell) for cell in row] for row in cells]
    lines = [" & ".join(row) + r" \\" for row in text]
    columns = "ll" + "r" * (len(cells[0]) - 2)
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:],
                      r"\bottomrule", r"\end{tabular}", ""])  # fmt: skip


def comma_separated(cells: Cells) -> str:
    """The table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(cells)
    return text.getvalue()


def write(file: Path, text: str) -> None:
    """Write a text file that appears whole or not at all."""
    with atomic_file(file) as stream:
        stream.write(text.encode())


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Write everything; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder with results.json files")
    parser.add_argument("--output", type=Path, help="default: RESULTS/paper")
    given = parser.parse_args(arguments)
    if not given.results.is_dir():
        print(f"error: {given.results} is no folder; give the output folder of the experiments", file=sys.stderr)
        return 2
    output = given.output or given.results / "paper"
    paper = load_paper()
    runs, remarks = load_runs(given.results)
    try:
        from plots import draw
    except ImportError as error:
        draw = None
        remarks.append(f"no pictures: {error}")
    page: List[str] = [INTRODUCTION]
    told: List[str] = []
    for name, about in paper.items():
        ours = runs.get(name, {})
        cells = (set_cells if name in PER_SET else class_cells)(about, ours)
        for ending, text in (("md", markdown(cells)), ("csv", comma_separated(cells)), ("tex", latex(cells))):
            write(output / f"{name}.{ending}", text)
        is_figure = "at" in about
        shown = cells
        if name in PER_SET:
            shown = [row for row in cells if row is cells[0] or row[0] in METHODS.values()]
        elif is_figure:
            shown = mean_cells(cells)
        page += [f"## {about['title']} ({about['label']})", "", markdown(shown)]
        runs_told = about_runs(ours)
        notes = ["runs as above"] if runs_told and runs_told == told else list(runs_told)
        notes += [about["note"]] if "note" in about else []
        told = runs_told or told
        if name in PER_SET:
            notes.append("the paper's other methods: in the picture, numbers in scripts/paper/figures.yaml")
            notes += [f"{method}: {reason}" for method, score in protocol(ours).items() for reason in score.missing]
        page += [f"- {line}" for line in notes]
        if draw is not None and is_figure:
            for ending in ("png", "pdf"):
                with atomic_file(output / f"{name}.{ending}") as stream:
                    draw(name, about, ours).savefig(stream, format=ending, dpi=130)
            page += ["", f"![{about['title']}]({output.name}/{name}.png)"]
        page.append("")
    missing = missing_runs(paper, runs)
    for title, lines in (("Missing runs", missing), ("Remarks", remarks)):
        if lines:
            page += [f"## {title}", "", *(f"- {line}" for line in lines), ""]
            print(f"{title}:", *lines, sep="\n  ", file=sys.stderr)
    file = output.with_name(f"{output.name}.md")
    write(file, "\n".join(page))
    print(f"tables and figures: {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
