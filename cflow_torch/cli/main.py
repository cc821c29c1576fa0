"""The `cflow` command: one of `COMMANDS`, then settings as Hydra overrides."""

from __future__ import annotations

import os
import sys
import traceback
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from cflow_torch import __version__

COMMANDS = {
    "demo": "simulate a drive, estimate its flow, score it and draw it",
    "flow": "estimate the flow of every pair of sweeps of one log or a fleet; shards, resumes, Ray",
    "label": "labels for self-supervised training, into OpenSceneFlow's scenes",
    "eval": "estimate and score every labelled pair of a data set",
    "submit": "write and check an archive for a public leaderboard",
    "plot": "pictures of the flow and of every stage, ground truth beside it, animations",
    "view": "a recording of a drive for the viewer rerun: flow, clusters, truth, on a timeline",
    "stream": "play a log as if it were live: flow as sweeps arrive, its latency",
    "clean": "logs without what moves, and maps of what stands",
    "bench": "time the method and its stages on your data; memory, windows per second",
    "settings": "every setting with its default and its meaning; model files for OpenSceneFlow",
    "info": "packages, machine, devices: to paste into a bug report",
    "completion": "a script that makes a shell complete commands and settings",
}

_WITHOUT_SETTINGS = ("settings", "info", "completion")

HELP = f"""cflow: training-free LiDAR scene flow

usage: cflow COMMAND [SETTING=VALUE ...]

what most people do:
  cflow demo                    a simulated street: a picture in outputs/demo, no data needed
  cflow flow /data/av2/val      the flow of your data, one file per pair of sweeps; the format is recognised
  cflow eval /data/av2/val      its scores, where the data has labels

commands:
{chr(10).join(f"  {name:10}  {text}" for name, text in COMMANDS.items())}

more examples:
  cflow flow data=arrays data.root=/data/drive data.find_ground=grid    a format and its settings by name
  cflow eval model=paper model.pixel_sizes=[0.4,0.2,0.1]                any field of the method, see `cflow settings`
  cflow eval -m model.num_history=0,2,4                                 a sweep
  cflow plot picture=correlation pair=2                                 how one object was found
  cflow submit data=hdf5 data.root=/data/test version=3

`cflow COMMAND --help` says more; `cflow COMMAND --cfg job` prints every setting and its value; `cflow --version`.
"""


def main(argv: list[str] | None = None) -> None:
    """Run one command. Ends the process with status 1 if anything failed, 2 if the call was wrong, 130 after Ctrl-C."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed: cflow ... >&-
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    try:
        try:
            _run(list(sys.argv[1:] if argv is None else argv))
        finally:
            sys.stdout.flush()
    except OSError as error:
        if error.errno is None:
            raise
        _end_refused(error)
    except KeyboardInterrupt:
        print("stopped by Ctrl-C", file=sys.stderr)
        raise SystemExit(128 + 2) from None  # as if SIGINT had ended it


def _run(arguments: list[str]) -> None:
    if arguments[:1] == ["help"]:  # cflow help eval
        arguments = [*arguments[1:], "--help"]
    command, *rest = arguments or ["--help"]
    if command in ("-h", "--help"):
        return print(HELP)
    if command in ("-V", "--version"):
        return print(f"cflow_torch {__version__}")
    if command not in COMMANDS:
        near = get_close_matches(command, COMMANDS, 1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        _end_wrong(f"unknown command {command!r}{hint}: give one of {', '.join(COMMANDS)}")
    module = import_module(f"cflow_torch.cli.{command}")
    if "-h" in rest or "--help" in rest:
        from cflow_torch.cli.choices import settings_help

        more = "" if command in _WITHOUT_SETTINGS else settings_help(command)
        return print(f"cflow {command}: {COMMANDS[command]}\n\n{module.__doc__}{more}", end="")
    if command not in _WITHOUT_SETTINGS:
        return _run_with_settings(command, module.task, rest)
    from cflow_torch.types import CFlowError

    try:
        return module.task(rest)  # type: ignore[no-any-return]
    except CFlowError as error:
        return _end_wrong(error)


def _run_with_settings(command: str, run: Any, rest: list[str]) -> None:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from cflow_torch.cli import schemas  # noqa: F401 (registers them)
    from cflow_torch.cli.arguments import for_hydra
    from cflow_torch.cli.refusals import explain
    from cflow_torch.cli.run import UnfinishedJob, complete_data
    from cflow_torch.types import CFlowError

    def task(cfg: Any) -> Any:
        try:
            OmegaConf.resolve(cfg)
            for source in HydraConfig.get().runtime.config_sources:
                if source.schema == "file" and source.path not in sys.path:  # where a user's own reader may lie
                    sys.path.append(source.path)
            cfg.data = complete_data(cfg.data)
            return run(cfg)
        except (CFlowError, OmegaConfBaseException) as error:
            _end_wrong(explain(error, command))
        except UnfinishedJob:
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno is not None:
                _end_refused(error)
            traceback.print_exc()
            report = "this is a fault of cflow, not of the call: report it with the lines above and `cflow info`"
            raise UnfinishedJob(report) from None

    sys.argv = [f"cflow {command}", *for_hydra(rest)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints errors itself, and a closed pipe as one
    try:
        hydra.main(version_base="1.3", config_path="pkg://cflow_torch.configs", config_name=command)(task)()
    except UnfinishedJob as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except BrokenPipeError:  # of Hydra's own printing
        raise
    except Exception as error:
        _end_wrong(explain(error, command))


def _end_wrong(message: object) -> None:
    """End after a wrong call."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2) from None


def _end_refused(error: OSError) -> None:
    """End after the system refused a file, or something that has no name: mostly to print, to a reader who left.

    What cannot be printed is given up: else it would be tried once more.
    """
    if error.filename is not None:
        reason = error.strerror or error
        _end_wrong(f"{error.filename}: {reason}; give places that can be read (data.root=) and written (output=)")
    is_unread = isinstance(error, BrokenPipeError)  # `cflow info | head`: commands end without a word
    if not is_unread:
        with suppress(OSError):
            print(f"error: {error}: no file is named, so it is mostly what this command prints to", file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    raise SystemExit(128 + 13 if is_unread else 1) from None  # as if SIGPIPE had ended it


if __name__ == "__main__":
    main()
