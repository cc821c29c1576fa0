"""A few small logs, the commands on them in this process, and what they leave."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Dict

from cflow_torch.cli.main import main
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

SWEEPS = (3, 4)  # of the logs; 5 pairs
PAIRS = sum(SWEEPS) - len(SWEEPS)


def write_fleet(root: Path) -> Path:
    """Two logs, of 2 and 3 pairs."""
    for seed, sweeps in enumerate(SWEEPS):
        write_av2_log(make_drive(seed=seed, num_sweeps=sweeps, profile="demo"), root)
    return root


def run(*arguments: Any) -> int:
    """Exit status of `cflow`."""
    argv = list(sys.argv)
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = argv
    return 0


def flow(root: Path, output: Path, *more: str) -> int:
    """`cflow flow` of a folder of logs by one process, if not told otherwise."""
    settings = ["data=av2", f'data.root="{root}"', f'output="{output}"', "model=paper", "model.pixel_sizes=[0.4]"]
    return run("flow", *settings, "data.check=false", "engine.workers=1", "engine.threads=1", *more)


def tree(output: Path) -> Dict[str, bytes]:
    """Every file, hidden ones too, but reports, which tell times, and config.yaml, which tells where the data lies."""
    files = [f for f in output.rglob("*") if f.is_file() and "reports" not in f.parts and f.name != "config.yaml"]
    return {str(file.relative_to(output)): file.read_bytes() for file in files}


def report(output: Path) -> Dict[str, Any]:
    """Of the only shard."""
    told: Dict[str, Any] = json.loads((output / "reports" / "shard-0-of-1.json").read_text())
    return told
