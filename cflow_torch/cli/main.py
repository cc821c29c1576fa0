"""The `cflow` command: the name of a sub-command, then settings as Hydra overrides."""

from __future__ import annotations

import ast
import os
import re
import sys
import traceback
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from cflow_torch import __version__

COMMANDS = {
    "demo": "simulate a drive, estimate its flow, score it and draw it",
    "check": "say what is right and what is wrong in your data, and how to fix it",
    "flow": "estimate the flow of every pair of sweeps: resumable, parallel, on many machines",
    "label": "write pseudo-labels for self-supervised training into OpenSceneFlow's scenes",
    "eval": "estimate and score all labelled pairs of a data set",
    "submit": "write and check an archive for a public leaderboard",
    "plot": "draw flow, clusters, key points, correlation, scales or an animation",
    "view": "write a 3-D page for the browser, or a recording for the viewer rerun",
    "stream": "replay a log in real time and measure the latency",
    "clean": "remove dynamic objects from logs, and build static maps",
    "bench": "measure run time and memory on your data",
    "settings": "list all settings with defaults and explanations",
    "info": "print the versions and the environment for a bug report",
}

_WITHOUT_SETTINGS = ("settings", "info")

# Settings that name a file, a folder or a log. Their values are text, even if they look like a number.
_NAMES = ("output", "log", "flow", "archive", "frames", "masks", "result_name", "data.root", "data.cache")
# Hydra reads these values as numbers or booleans: 1e5, 2024_11_22, true.
_NOT_TEXT = re.compile(r"[+-]?[._]*\d[\d._]*(e[+-]?[\d_]+)?|true|false", re.IGNORECASE)
_READABLE = re.compile(r"[\w./\\:+%@?|*$ -]*", re.ASCII)  # values that need no quotes
_WITH_VALUE = ("-c", "--cfg", "-p", "--package", "-i", "--info", "-cd", "--config-dir", "-cn", "--config-name", "-cp")
_GRAMMAR = re.compile(r"['\"\[{]|(choice|glob|range|shuffle|sort|str|tag)\(|.*\$\{")  # Hydra's own syntax

HELP = f"""cflow: training-free LiDAR scene flow

usage: cflow COMMAND [SETTING=VALUE ...]

first steps:
  cflow demo                    simulate a street and show its flow: outputs/demo/flow.html
  cflow check /data/my_drive    check your data: frames, poses, times, ground
  cflow flow /data/av2/val      estimate the flow of your data, one file per pair of sweeps
  cflow eval /data/av2/val      score the flow, if the data has labels

commands:
{chr(10).join(f"  {name:10}  {text}" for name, text in COMMANDS.items())}

more examples:
  cflow flow data=arrays data.root=/data/drive data.find_ground=grid    choose a format and its settings
  cflow eval model=paper model.pixel_sizes=[0.4,0.2,0.1]                change a setting of the method
  cflow eval -m model.num_history=0,2,4                                 run a sweep over values
  cflow plot picture=correlation pair=2                                 draw the correlation of one object
  cflow submit data=hdf5 data.root=/data/test version=3                 write a leaderboard submission

`cflow COMMAND --help` explains a command. `cflow COMMAND --cfg job` prints all its settings.
"""


def main(argv: list[str] | None = None) -> None:
    """Run one command. Exit with status 1 if something failed, 2 if the call was wrong, 130 after Ctrl-C."""
    try:
        _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except OSError as error:
        _exit_if_refused(error)
        raise
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
    from cflow_torch.cli.choices import near
    from cflow_torch.errors import CFlowError

    if command not in COMMANDS:
        _exit_wrong(f"unknown command {command!r}{near(command, COMMANDS)}: give one of {', '.join(COMMANDS)}")
    has_settings = command not in _WITHOUT_SETTINGS
    if "-h" in rest or "--help" in rest:
        return print(_help(command, has_settings), end="")
    if command == "check":
        return _run_for_each_path(command, rest)
    if has_settings:
        return _run_with_settings(command, rest)
    try:
        import_module(f"cflow_torch.cli.{command}").task(rest)
    except CFlowError as error:
        _exit_wrong(error)


def _help(command: str, has_settings: bool) -> str:
    """Return the help of a command: its settings and the docstring of its module, which is not imported."""
    from cflow_torch.cli.choices import settings_help

    spec: Any = find_spec(f"cflow_torch.cli.{command}")
    text = ast.get_docstring(ast.parse(spec.loader.get_source(spec.name)))
    return f"cflow {command}: {COMMANDS[command]}\n\n{text}\n{settings_help(command) if has_settings else ''}"


def _run_for_each_path(command: str, rest: list[str]) -> None:
    """Run a command once for each path among its arguments; exit with the largest status."""
    overrides, options = split(rest)
    paths = [word for word in overrides if word.startswith("data.root=")] or [""]
    others = [word for word in overrides if word not in paths]
    status = 0
    for path in paths:
        try:
            _run_with_settings(command, [*filter(None, [path]), *others, *options])
        except SystemExit as end:
            if len(paths) == 1:
                raise
            status = max(status, int(end.code or 0))
    if status:
        raise SystemExit(status)


def _run_with_settings(command: str, rest: list[str]) -> None:
    import hydra
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from cflow_torch.cli.checks import UnfinishedJob, explain

    overrides, options = split(rest)
    for option in unknown_options(options):
        _exit_wrong(f"unknown option {option!r}: give settings as NAME=VALUE; `cflow {command} --help` lists them")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    main_of = hydra.main(version_base="1.3", config_path="pkg://cflow_torch.configs", config_name=command)
    try:
        # A job's folder is named after the swept settings, and after experiment and data.label if they are given.
        parsed = OverridesParser.create().parse_overrides(overrides)
        fixed = {str(one.key_or_group) for one in parsed if not one.is_sweep_override()}
        unnamed = {"output", "overwrite", *fixed} - {"experiment", "data.label"}
        names = f"hydra.job.config.override_dirname.exclude_keys=[{','.join(sorted(unnamed))}]"
        sys.argv = [f"cflow {command}", *overrides, names, *options]
        main_of(lambda cfg: _run_job(command, cfg))()
    except UnfinishedJob as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except Exception as error:
        _exit_if_refused(error)
        _exit_wrong(explain(error, command))


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split the arguments of a command into settings, and options with their values.

    Hydra accepts no option, such as `-m`, between two settings. A word without "=" is data.root. We quote names of
    files, folders and logs. Without quotes, Hydra would read the Waymo segment
    log=10203656353524179475_7625_000_7645_000 as a whole number, and it would reject output=Ausgänge.
    """
    overrides, options = [], []
    for before, word in zip(["", *arguments], arguments):
        if word.startswith("-") or before in _WITH_VALUE:
            options.append(word)
        elif ("=" in word or word[0:1] in ("+", "~")) and not _is_path(word):
            overrides.append(_quoted(word))
        else:
            overrides.append(f"data.root={_text(word)}")
    return overrides, options


def _is_path(word: str) -> bool:
    """Test whether a word with "=" is a path, such as date=2024-01-05/drive, and not a setting."""
    return word.startswith(("/", "./", "../", "~/")) or os.path.exists(word)


def unknown_options(options: list[str]) -> list[str]:
    from hydra._internal.utils import get_args_parser

    return get_args_parser().parse_known_args(options)[1]


def _quoted(override: str) -> str:
    key, _, value = override.partition("=")
    if key.lstrip("+") not in _NAMES or _GRAMMAR.match(value):
        return override
    values = value.split(",")  # of a sweep
    is_quoted = [_NOT_TEXT.fullmatch(one.strip()) or not _READABLE.fullmatch(one) for one in values]
    return f"{key}={','.join(_text(one) if quoted else one for one, quoted in zip(values, is_quoted))}"


def _text(value: str) -> str:
    return '"' + value.replace('"', r"\"") + '"'


def _run_job(command: str, cfg: Any) -> Any:
    """Run a command with the settings that Hydra has composed, perhaps as a job of a sweep."""
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from cflow_torch.cli.checks import UnfinishedJob, check_settings, explain
    from cflow_torch.errors import CFlowError

    try:
        OmegaConf.resolve(cfg)
        runtime = HydraConfig.get().runtime
        check_settings(cfg, command, runtime.choices)
        for source in runtime.config_sources:
            if source.schema == "file" and source.path not in sys.path:  # the folder of a user's own reader
                sys.path.append(source.path)
        from cflow_torch.cli.run import complete_data  # imports torch, which takes seconds
        from cflow_torch.fleet.progress import show_warnings_as_lines

        show_warnings_as_lines()
        cfg.data = complete_data(cfg.data, sys.stderr if cfg.get("json") else sys.stdout)
        return import_module(f"cflow_torch.cli.{command}").task(cfg)
    except UnfinishedJob:
        raise
    except (CFlowError, OmegaConfBaseException) as error:
        _exit_wrong(explain(error, command))
    except Exception as error:
        _exit_if_refused(error)
        traceback.print_exc()
        message = "this is a bug of cflow: please report it with the lines above and the output of `cflow info`"
        raise UnfinishedJob(message) from None


def _exit_wrong(message: object) -> None:
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2) from None


def _exit_if_refused(error: Exception) -> None:
    """Exit after an error that is not a bug: a file that the system refused, or a pipe whose reader has ended."""
    if isinstance(error, BrokenPipeError):  # as in `cflow info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + 13) from None  # as if SIGPIPE had ended it
    if isinstance(error, OSError) and error.filename is not None:
        _exit_wrong(f"{error.filename}: {error.strerror or error}; check data.root= (read) and output= (written)")


if __name__ == "__main__":
    main()
