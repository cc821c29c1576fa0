#!/usr/bin/env python3
"""Where the time goes: a bar per configuration of `cflow bench`, split by stage.

  python scripts/bench_stages.py outputs/bench/bench.json [MORE.json ...] --picture docs/benchmarks/stages.png

A file may be given a label, LABEL=FILE; the configurations of several files are drawn one below the other.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Dict, List

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#b07aa1", "#9c755f", "#76b7b2", "#edc948", "#ff9da7")


def main() -> None:
    """Read the reports, draw, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reports", nargs="+", metavar="[LABEL=]bench.json")
    parser.add_argument("--picture", type=Path, default=Path("outputs/bench/stages.png"))
    arguments = parser.parse_args()
    bars: Dict[str, Dict[str, float]] = {}
    medians: Dict[str, float] = {}
    for text in arguments.reports:
        label, _, file = text.rpartition("=")
        for name, result in json.loads(Path(file).read_text(encoding="utf-8"))["results"].items():
            bar = f"{label}: {name}" if label else name
            bars[bar], medians[bar] = result["stages_s"], result["fast"]["median_s"]
    stages: List[str] = list(dict.fromkeys(stage for bar in bars.values() for stage in bar))
    figure, axes = plt.subplots(figsize=(9, 1.6 + 0.45 * len(bars)), layout="constrained")
    names = list(bars)[::-1]
    left = [0.0] * len(names)
    for stage, colour in zip(stages, COLOURS):
        width = [1000 * bars[name].get(stage, 0.0) for name in names]
        axes.barh(names, width, left=left, label=stage, color=colour, height=0.7)
        left = [a + b for a, b in zip(left, width)]
    for place, (name, end) in enumerate(zip(names, left)):
        axes.text(end, place, f"  {1000 * medians[name]:.1f} ms without the profiler", va="center", fontsize=8)
    axes.set_xlim(0, 1.45 * max(left))
    axes.set_xlabel("ms per window, stages under the profiler")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=len(stages), frameon=False, fontsize=8)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.picture, dpi=110)


if __name__ == "__main__":
    main()
