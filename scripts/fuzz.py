"""Fuzz readers for long: python scripts/fuzz.py [READER ...] [--cases N] [--engine hypothesis|atheris] [--seed N].

Each reader gets N hostile files in a process of its own that is watched for exceptions, crashes, hangs and memory.
OUTPUT/READER-ENGINE holds the report and one file of each fault. Exit code 1 if there was any. atheris (pip install
atheris) needs Linux.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from fuzzing.campaign import run  # noqa: E402
from fuzzing.targets import TARGETS  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "readers", nargs="*", metavar="READER", help=f"all if none is named: {' '.join(sorted(TARGETS))}"
    )
    parser.add_argument("--cases", type=int, default=100000, help="files for each reader and engine (100000)")
    parser.add_argument("--engine", choices=("hypothesis", "atheris"), action="append", help="both if none is named")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("outputs/fuzz"), help="outputs/fuzz")
    given = parser.parse_args()
    unknown = sorted(set(given.readers) - set(TARGETS))
    if unknown:
        parser.error(f"no reader {', '.join(unknown)}; there are {', '.join(sorted(TARGETS))}")
    print("| reader | engine | cases | read | refused | other exceptions | crashes | hangs | memory | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    faults = 0
    for name in given.readers or sorted(TARGETS):
        if TARGETS[name].needs and importlib.util.find_spec(TARGETS[name].needs) is None:
            print(f"{name}: left out, needs {TARGETS[name].needs}", file=sys.stderr)
            continue
        for engine in given.engine or ("hypothesis", "atheris"):
            folder = (given.output / f"{name}-{engine}").resolve()
            report = run(TARGETS[name], engine, given.cases, given.seed, folder)
            faults += len(report.findings)
            print(
                f"| {name} | {engine} | {report.cases:,} | {report.result:,} | {report.refused:,} | {report.wrong:,} | "
                f"{report.crashes} | {report.hangs} | {report.most_bytes >> 20} MiB | {report.seconds:.0f} |",
                flush=True,
            )
            for finding in report.findings:
                print(f"  {folder / 'findings' / finding}.txt", file=sys.stderr)
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
