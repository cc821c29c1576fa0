"""Shared by the commands: settings, output folders, logs, failures."""

from __future__ import annotations

import os
import platform
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Callable, Iterator, List, NamedTuple, Sequence, TextIO, Tuple

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from cflow_torch import __version__, estimate
from cflow_torch.cli.checks import UnfinishedJob as UnfinishedJob
from cflow_torch.cli.choices import CONFIGS, own_settings
from cflow_torch.cli.info import processor
from cflow_torch.config import config_from
from cflow_torch.data.atomic import ensure_writable, write_text
from cflow_torch.data.catalog import AUTO, find_sources, find_user_sources, open_log, recognise
from cflow_torch.data.files import describe_changes
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.log import Log
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.manifest import frame_file
from cflow_torch.fleet.progress import log_line
from cflow_torch.model import SceneFlowModel
from cflow_torch.simulator.benchmark import benchmark_logs, format_of
from cflow_torch.types import CFlowError, FlowResult

Failures = List[Tuple[str, str]]


def versions() -> dict[str, str]:
    return {
        "cflow_torch": __version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def machine() -> dict[str, Any]:
    """Describe the machine, on which times depend: "platform", "cpu", "cores", "threads" (of torch)."""
    return {
        "platform": platform.platform(),
        "cpu": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }


def make_model(cfg: DictConfig) -> SceneFlowModel:
    """Make the method that `cfg.model` and `cfg.device` describe."""
    settings: dict[str, Any] = OmegaConf.to_container(cfg.model, resolve=True)  # type: ignore[assignment]
    model = estimate.make_model(config_from(settings), cfg.device)
    model.inspect = None  # the logs are checked when they are opened
    return model


def is_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def preset() -> str:
    return str(HydraConfig.get().runtime.choices["model"])


def output_folder(cfg: DictConfig) -> Path:
    """The output folder of a run: `cfg.output`, or for a job of a sweep the folder below it that Hydra names.

    The jobs of a sweep over shards are parts of one run, so they share `cfg.output`.
    """
    folder = as_path(cfg.output)
    if not is_sweep() or any(override.startswith("shard.index=") for override in HydraConfig.get().overrides.task):
        return folder
    return folder / HydraConfig.get().sweep.subdir


def local_folder(cfg: DictConfig) -> Path:
    """Return the output folder of a command that writes to this machine only. A remote one raises a `CFlowError`."""
    output = output_folder(cfg)
    if is_remote(output):
        raise CFlowError(f"output={output}: give a folder of this machine, and copy the files from there")
    return output


def complete_data(data: DictConfig, out: TextIO | None = None) -> DictConfig:
    """Replace data=auto by the settings of the recognised format, and print it to `out` (stdout); add defaults for
    your own reader."""
    if "_target_" in data:
        defaults = {"label": HydraConfig.get().runtime.choices["data"], "first": 0, "step": 1}
        return OmegaConf.merge(defaults, data)  # type: ignore[return-value]
    if data.get("name") != AUTO:
        return data
    name = "synthetic"
    if data.root is not None:
        name = recognise(data.root)
        print(f"{data.root}: data={name}", file=out or sys.stdout)
    settings = OmegaConf.load(CONFIGS / "data" / f"{name}.yaml")
    others = own_settings(CONFIGS / "data" / f"{AUTO}.yaml").keys() - set(settings)
    given = {key: value for key, value in data.items() if key not in others}
    given.update(name=name, label=data.label or settings.label)
    return OmegaConf.merge(settings, given)  # type: ignore[return-value]


def chosen_pairs(cfg: DictConfig, group: str = "") -> Callable[[Log], list[int]]:
    """Return a function from a log to the indices of its pairs, by the settings `first`, `step` and `count`.

    Pairs over a gap of the log are left out.

    `group`, "" or "data.", is the prefix of `first` and `step`. `count` has no prefix and may be missing.
    """
    first, step = (OmegaConf.select(cfg, f"{group}{name}") for name in ("first", "step"))

    def pairs(log: Log) -> list[int]:
        gaps = getattr(log, "gaps", ())
        return [index for index in range(first, len(log.timestamps) - 1, step) if index not in gaps][: cfg.get("count")]

    return pairs


def check_pair(pair: int, log: Log) -> None:
    """Reject the index of a pair that the log does not have."""
    last = len(log.timestamps) - 2
    if not 0 <= pair <= last:
        raise CFlowError(f"pair={pair}: log {log.log_id} has pairs 0 to {last}")


class Sources(NamedTuple):
    """Logs that are not open yet: name of their data set, settings of its reader, one source per log."""

    reader: str
    settings: dict[str, Any]
    logs: list[Any]

    def open(self, source: Any) -> Log:
        return open_log(self.reader, source, **self.settings)


def find_logs(cfg: DictConfig) -> Sources:
    """Find the logs of `cfg.data`; make simulated ones that are not cached. If there is none, raise a `CFlowError`."""
    data = cfg.data
    given: dict[str, Any] = OmegaConf.to_container(data, resolve=True)  # type: ignore[assignment]
    settings = {str(key): value for key, value in given.items() if key not in ("label", "first", "step")}
    if "_target_" in data:
        target = settings.pop("_target_")
        return Sources(target, settings, find_user_sources(target, settings))
    if data.name == "synthetic":
        return Sources("av2", {"check": False}, benchmark_logs(data.cache, "av2", [data.seed], data.num_sweeps))
    if data.name == "benchmark":
        seeds = range(data.first_seed, data.first_seed + data.num_drives)
        chosen = format_of(data.profile)
        logs = benchmark_logs(data.cache, data.profile, seeds, data.num_sweeps, data.scenes)
        return Sources(chosen.data_set, {"check": False, **chosen.settings}, logs)
    name, root = settings.pop("name"), settings.pop("root")
    return Sources(name, settings, list(find_sources(name, root)))


def open_logs(cfg: DictConfig) -> tuple[list[Log], Failures]:
    """Open the logs of `cfg.data`. Those that cannot be opened are reported and skipped."""
    sources = find_logs(cfg)
    logs: list[Log] = []
    failures: Failures = []
    for source in sources.logs:
        with collect_failures(failures, source.name):
            logs.append(sources.open(source))
    return logs, failures


def stored_flow(folder: Any, needed: Sequence[str]) -> Callable[[Log, int], FlowResult]:
    """Return a function that reads the flow of a pair from the output of `cflow flow` and rejects incomplete files."""
    output = as_path(folder)
    if not output.is_dir():
        raise CFlowError(f"flow={folder} is not a folder: give the output of `cflow flow`")

    def read(log: Log, index: int) -> FlowResult:
        file = frame_file(output / log.log_id, log.timestamps[index])
        result = read_flow(file)
        missing = [name for name in needed if getattr(result, name) is None]
        if missing:
            raise CFlowError(f"{file} lacks {', '.join(missing)}: run `cflow flow` with all contents")
        return result

    return read


@contextmanager
def collect_failures(failures: Failures, name: str) -> Iterator[None]:
    """Run a step for one frame or log. If it fails, print the error, append it to `failures`, and continue."""
    try:
        yield
    except (CFlowError, OSError) as error:
        failures.append((name, str(error)))
        log_line(f"failed: {name}: {error}")


def finish(failures: Failures) -> None:
    """Print the failures, and exit with status 1 if there are any.

    A job of a parameter sweep raises `UnfinishedJob`, so that Hydra runs the other jobs before it exits with status 1.
    """
    if failures:
        print(f"{len(failures)} failed:", file=sys.stderr)
        for frame, message in failures:
            print(f"  {frame}: {message}", file=sys.stderr)
        if is_sweep():
            raise UnfinishedJob(f"{len(failures)} failed in a job, listed above")
        raise SystemExit(1)


def write_config(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved settings and versions to `folder/config.yaml`."""
    write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(_record(cfg))))


def claim_output(cfg: DictConfig, folder: Path, ignored: Sequence[str]) -> None:
    """Reject a folder whose config.yaml has other settings or versions, unless `cfg.overwrite`; write config.yaml.

    The settings `ignored` may differ, because files do not depend on them.
    """
    file = ensure_writable(folder) / "config.yaml"
    if file.exists() and not cfg.get("overwrite"):
        before = OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
        changed = describe_changes(before, _record(cfg), ("output", "overwrite", *ignored))
        if changed:
            remedy = "give overwrite=true" if "overwrite" in cfg else "remove it"
            raise CFlowError(f"{folder} has files of another run ({changed}): {remedy}, or give output=FOLDER")
    write_config(cfg, folder)


def _record(cfg: DictConfig) -> dict[str, Any]:
    settings: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {**settings, "versions": versions()}
