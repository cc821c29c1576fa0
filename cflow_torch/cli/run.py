"""What `demo`, `flow` and `eval` share: settings, logs, the loop over pairs that survives bad frames."""

from __future__ import annotations

import platform
import sys
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence, Tuple

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from cflow_torch import __version__
from cflow_torch.config import Config
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.av2 import AV2Log, find_av2_logs
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes
from cflow_torch.data.log import Log, window
from cflow_torch.data.synthetic import make_drive
from cflow_torch.data.writers import write_av2_log
from cflow_torch.dense import CorrelationFlow
from cflow_torch.types import CFlowError, FlowResult, Window

Failures = List[Tuple[str, str]]
# data.name: how its logs are found, read, and called.
_READERS: Dict[str, Tuple[Callable[[Any], List[Path]], Callable[[Any], Any], str]] = {
    "av2": (find_av2_logs, AV2Log, "Argoverse 2 log (a folder with sensors/lidar)"),
    "hdf5": (find_hdf5_scenes, HDF5Log, "scene (a file *.h5)"),
}
UseResult = Callable[[Log, int, Window, FlowResult], None]


def versions() -> Dict[str, str]:
    """Versions that a result depends on."""
    return {
        "cflow_torch": __version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def make_model(cfg: DictConfig) -> CorrelationFlow:
    """The method that `cfg.model` and `cfg.device` describe.

    Raises:
        CFlowError: an unknown or invalid setting.
    """
    settings: Dict[str, Any] = OmegaConf.to_container(cfg.model, resolve=True)  # type: ignore[assignment]
    return CorrelationFlow(Config().replace(**settings), cfg.device)


def open_logs(cfg: DictConfig, folder: Path) -> Tuple[List[Log], Failures]:
    """The logs of `cfg.data`; those that cannot be opened are reported, not fatal.

    Args:
        cfg: resolved settings.
        folder: where a synthetic log is written before it is read back like any other.

    Raises:
        CFlowError: no log at all.
    """
    data = cfg.data
    if data.name == "synthetic":
        drive = make_drive(seed=data.seed, num_sweeps=data.num_sweeps)
        reader: Callable[[Any], Any] = AV2Log
        sources = [write_av2_log(drive, folder / "log", overwrite=True)]
    elif OmegaConf.is_missing(data, "root"):
        raise CFlowError("where is the data? give data.root=PATH, one log or a folder of logs")
    else:
        find, reader, what = _READERS[data.name]
        sources = find(data.root)
        if not sources:
            raise CFlowError(f"no {what} in {data.root}")
    logs: List[Log] = []
    failures: Failures = []
    for source in sources:
        try:
            logs.append(reader(source))
        except (CFlowError, OSError) as error:
            failures.append((source.name, str(error)))
            tqdm.write(f"failed: {source.name}: {error}", file=sys.stderr)
    return logs, failures


def for_each_pair(logs: Sequence[Log], model: CorrelationFlow, use: UseResult) -> Failures:
    """Estimate the flow of every pair of every log and hand it on; a bad frame is reported and the rest goes on.

    Args:
        logs: logs of at least two sweeps.
        model: the method.
        use: what to do with a result.

    Returns:
        (frame, message) of every pair that failed.
    """
    pairs = [(log, index) for log in logs for index in range(len(log.timestamps) - 1)]
    failures: Failures = []
    for log, index in tqdm(pairs, unit="pair", disable=None):
        try:
            sweeps = window(log, index, model.config.num_history)
            (result,) = model([sweeps])
            use(log, index, sweeps, result)
        except (CFlowError, OSError) as error:
            frame = f"{log.log_id}/{log.timestamps[index]}"
            failures.append((frame, str(error)))
            tqdm.write(f"failed: {frame}: {error}", file=sys.stderr)
    return failures


def finish(failures: Failures) -> None:
    """List what failed, and end the process with status 1 if anything did."""
    if failures:
        print(f"{len(failures)} failed:", file=sys.stderr)
        for frame, message in failures:
            print(f"  {frame}: {message}", file=sys.stderr)
        raise SystemExit(1)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_file(path) as file:
        file.write(text.encode())


def write_config(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved settings and versions to `folder/config.yaml`."""
    record = OmegaConf.create({**OmegaConf.to_container(cfg, resolve=True), "versions": versions()})  # type: ignore[dict-item]
    write_text(folder / "config.yaml", OmegaConf.to_yaml(record))
