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
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import Sequence

from pages import write_pages

# Experiments that take most time, or need an extra, are last.
EXPERIMENTS = ("pixel_size", "views", "history", "scales", "keypoints", "datasets", "range_split", "clustering")


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


if __name__ == "__main__":
    sys.exit(main())
