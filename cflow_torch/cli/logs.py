"""The logs that the settings `data` choose."""

from __future__ import annotations

import os
from typing import Any, Mapping, TextIO

from cflow_torch.cli.choices import FOLDER, read_settings
from cflow_torch.cli.commands import NOT_GIVEN
from cflow_torch.cli.failures import Failures, collect_failures
from cflow_torch.data.catalog import Logs, find_all_sources, find_user_sources, source_name, the_format
from cflow_torch.data.log import Log
from cflow_torch.setting import AUTO
from cflow_torch.simulator.benchmark import benchmark_logs, format_of
from cflow_torch.types import CFlowError


def complete_data(data: dict[str, Any], out: TextIO | None = None) -> dict[str, Any]:
    """Replace data=auto by the settings of the recognised format, and print it to `out`; None = standard output.

    Without a path, it is a simulated drive.
    """
    if data.get("name") != AUTO:
        return data
    paths = paths_of(data)
    name = the_format(paths) if paths else "synthetic"
    for path in paths or ["no path is given, so we simulate a drive"]:
        print(f"{path}: data={name}", file=out)
    settings = dict(read_settings(FOLDER / "data" / f"{name}.yaml"))
    if "cache" in settings:
        settings["cache"] = os.environ.get("CFLOW_CACHE", "outputs/cache")
    defaults = read_settings(FOLDER / "data" / f"{AUTO}.yaml")
    for key, value in data.items():
        if key in settings and value != NOT_GIVEN:
            settings[key] = value
        elif key not in settings and value not in (NOT_GIVEN, defaults.get(key, NOT_GIVEN)):
            raise CFlowError(f"data.{key}={value}: data={name} has no such setting; it has {', '.join(settings)}")
    return {**settings, "name": name, "label": data["label"] or name}


def paths_of(data: dict[str, Any]) -> list[Any]:
    """Return the paths that were given as `data.root`."""
    root = data.get("root")
    if root is None:
        return []
    return list(root) if isinstance(root, (list, tuple)) else [root]


def chosen_pairs(log: Log, data: Mapping[str, Any], count: int | None = None) -> list[int]:
    """Return the indices of at most `count` pairs of a log, every `data.step`-th from `data.first` on.

    If there is none, that is a `CFlowError`.
    """
    chosen = range(data["first"], len(log.timestamps) - 1, data["step"])
    pairs = [index for index in log.pairs if index in chosen][:count]
    if not pairs:
        raise CFlowError(f"data.first={data['first']}: {_pairs_of(log)}")
    return pairs


def check_pair(pair: int, log: Log) -> None:
    """Reject the index of a pair that the log does not have, or that reaches over a gap."""
    if pair not in log.pairs:
        raise CFlowError(f"pair={pair}: {_pairs_of(log)}")


def _pairs_of(log: Log) -> str:
    gaps = f", without {', '.join(map(str, sorted(log.gaps)))} (gaps)" if log.gaps else ""
    return f"log {log.log_id} has pairs 0 to {len(log.timestamps) - 2}{gaps}"


def find_logs(data: dict[str, Any]) -> Logs:
    """Find the logs of a data set; make simulated ones that are not cached. If there is none, raise a `CFlowError`."""
    settings = {key: value for key, value in data.items() if key not in ("label", "first", "step")}
    if "_target_" in settings:
        target = settings.pop("_target_")
        return Logs(target, find_user_sources(target, settings), settings)
    if data["name"] == "synthetic":
        drives = benchmark_logs(data["cache"], "av2", [data["seed"]], data["num_sweeps"])
        return Logs("av2", drives, {"check": False})
    if data["name"] == "benchmark":
        seeds = range(data["first_seed"], data["first_seed"] + data["num_drives"])
        chosen = format_of(data["profile"])
        drives = benchmark_logs(data["cache"], data["profile"], seeds, data["num_sweeps"], data["scenes"])
        return Logs(chosen.data_set, drives, {"check": False, **chosen.settings})
    name = settings.pop("name")
    del settings["root"]
    return Logs(name, find_all_sources(name, paths_of(data)), settings)


def open_first_log(data: dict[str, Any]) -> Log:
    """Open the log of a command that uses only the first one. Several paths are a `CFlowError`."""
    paths = paths_of(data)
    if len(paths) > 1:
        raise CFlowError(f"this command uses one log, but {len(paths)} paths were given: give one of them")
    return find_logs(data)[0]


def open_logs(data: dict[str, Any]) -> tuple[list[Log], Failures]:
    """Open the logs of a data set. Those that cannot be opened are reported and skipped."""
    logs = find_logs(data)
    opened: list[Log] = []
    failures: Failures = []
    for source in logs.sources:
        with collect_failures(failures, source_name(source)):
            opened.append(logs.open(source))
    return opened, failures
