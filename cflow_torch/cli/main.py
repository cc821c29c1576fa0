"""The `cflow` command: the name of a sub-command, then settings as Hydra overrides."""

from __future__ import annotations

import sys
from importlib import import_module

from cflow_torch import __version__
from cflow_torch.cli.commands import COMMANDS, WITH_SETTINGS
from cflow_torch.cli.failures import UnfinishedJob, exit_if_refused, exit_wrong
from cflow_torch.cli.settings import help_of
from cflow_torch.cli.words import read_call
from cflow_torch.errors import CFlowError, near

HELP = f"""cflow: training-free LiDAR scene flow

usage: cflow COMMAND [SETTING=VALUE ...]

first steps:
  cflow demo                    simulate a street and show its flow: outputs/demo/flow.html
  cflow check /data/my_drive    check your data: frames, poses, times, ground
  cflow flow /data/av2/val      estimate the flow of your data, one file per pair of sweeps
  cflow eval /data/av2/val      score the flow, if the data has labels

commands:
{chr(10).join(f"  {name:10}  {kind.SUMMARY}" for name, kind in COMMANDS.items())}

more examples:
  cflow flow data=arrays data.root=/data/drive data.find_ground=grid    choose a format and its settings
  cflow flow /data/drive_1 /data/drive_2                                several paths
  cflow eval model=paper model.pixel_sizes=[0.4,0.2,0.1]                change a setting of the method
  cflow eval -m model.num_history=0,2,4                                 run a sweep over values
  cflow plot picture=correlation pair=2                                 draw the correlation of one object
  cflow submit data=hdf5 data.root=/data/test version=3                 write a leaderboard submission

`cflow COMMAND --help` explains a command. `cflow COMMAND --cfg job` prints all its settings.
"""


def main(argv: list[str] | None = None) -> None:
    """Run one command. Exit with status 1 if something failed, 2 if the call was wrong, 130 after Ctrl-C."""
    command, *words = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if command == "help":  # cflow help eval
        command, *words = [*words, "--help"]
    try:
        if command in ("-h", "--help"):
            print(HELP)
        elif command in ("-V", "--version"):
            print(f"cflow_torch {__version__}")
        elif command not in COMMANDS:
            raise CFlowError(f"unknown command {command!r}{near(command, COMMANDS)}: give one of {', '.join(COMMANDS)}")
        elif "-h" in words or "--help" in words:
            print(help_of(command), end="")
        elif command in WITH_SETTINGS:
            overrides, options = read_call(words, command)
            from cflow_torch.cli.compose import run_with_hydra  # imports Hydra, which takes half a second

            run_with_hydra(command, overrides, options)
        else:
            import_module(f"cflow_torch.cli.{command}").task(words)
        sys.stdout.flush()
    except CFlowError as error:
        exit_wrong(error)
    except UnfinishedJob as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except OSError as error:
        exit_if_refused(error)
        raise
    except KeyboardInterrupt:
        print("stopped by Ctrl-C", file=sys.stderr)
        raise SystemExit(128 + 2) from None  # as if SIGINT had ended it


if __name__ == "__main__":
    main()
