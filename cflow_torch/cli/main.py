"""The `cflow` command: `cflow demo | flow | eval | submit | bench | info`, settings as Hydra overrides."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import List, Optional

from cflow_torch.types import CFlowError

COMMANDS = {
    "demo": "simulate a drive, estimate its flow, score it and draw it",
    "flow": "estimate the flow of every pair of sweeps of one log or a fleet; shards, resumes, Ray",
    "eval": "estimate and score every labelled pair of a data set",
    "submit": "write and check an archive for a public leaderboard",
    "plot": "pictures of the flow and of every stage, ground truth beside it, animations",
    "view": "a recording of a drive for the viewer rerun: flow, clusters, truth, on a timeline",
    "bench": "time every stage against the reference and a plain OpenCV loop",
    "info": "versions and devices, to paste into a bug report",
}

HELP = f"""cflow: training-free LiDAR scene flow

usage: cflow COMMAND [SETTING=VALUE ...]

commands:
{chr(10).join(f"  {name:6} {text}" for name, text in COMMANDS.items())}

examples:
  cflow demo                                          a picture in outputs/demo, no data needed
  cflow flow data=av2 data.root=/data/av2/val         one flow file per pair of sweeps
  cflow eval data=av2 data.root=/data/av2/val model=paper
  cflow eval model.pixel_sizes=[0.4,0.2,0.1]          any field of the method, see `cflow eval --cfg job`
  cflow eval -m model.connectivity=4,8                a sweep
  cflow plot picture=correlation pair=2               how one object was found, outputs/plot/correlation.png
  cflow submit data=hdf5 data.root=/data/test version=3

`cflow COMMAND --help` says more; `cflow COMMAND --cfg job` prints every setting and its value.
"""


def main(argv: Optional[List[str]] = None) -> None:
    """Run one command. Ends the process with status 1 if anything failed, 2 if the call was wrong."""
    try:
        _run(argv)
        sys.stdout.flush()
    except BrokenPipeError:
        _end_unread()


def _run(argv: Optional[List[str]]) -> None:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(HELP)
        return
    command, *rest = arguments
    if command not in COMMANDS:
        print(f"error: unknown command {command!r}: give one of {', '.join(COMMANDS)}", file=sys.stderr)
        raise SystemExit(2)
    module = import_module(f"cflow_torch.cli.{command}")
    if "-h" in rest or "--help" in rest:
        print(f"cflow {command}: {COMMANDS[command]}\n\n{module.__doc__}")
        return
    if command == "info":
        module.task()
        return
    import hydra

    def task(cfg):  # type: ignore[no-untyped-def]
        try:
            return module.task(cfg)
        except CFlowError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except BrokenPipeError:
            _end_unread()

    sys.argv = [f"cflow {command}", *rest]
    hydra.main(version_base="1.3", config_path="pkg://cflow_torch.configs", config_name=command)(task)()


def _end_unread() -> None:
    """Nobody reads what is printed any more (`cflow info | head`): end as other commands do, without a word."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left is flushed at the end
    raise SystemExit(128 + 13)  # as if SIGPIPE had ended it


if __name__ == "__main__":
    main()
