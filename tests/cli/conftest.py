"""A small log, `cflow` in this process, and settings as Hydra composes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Callable

import command_line
import hydra
import pytest
from hydra.core.hydra_config import HydraConfig
from small_logs import make_small_drive

from cflow_torch.cli import compose as _compose  # noqa: F401 (registers the settings)
from cflow_torch.simulator.writers.av2 import write_av2_log


@pytest.fixture(scope="session")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated log in Argoverse 2's format: three pairs."""
    return write_av2_log(make_small_drive(num_sweeps=4), tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where simulated drives are kept."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def cflow(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """A call of `cflow`, which gives its exit status."""
    monkeypatch.setenv("CFLOW_CACHE", str(cache))
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return command_line.cflow


@pytest.fixture(scope="session")
def compose() -> Callable[..., Any]:
    """The settings of a command, `hydra` among them."""

    def settings(command: str, *overrides: str) -> Any:
        with hydra.initialize_config_module("cflow_torch.configs", version_base="1.3"):
            cfg = hydra.compose(command, list(overrides), return_hydra_config=True)
        HydraConfig.instance().set_config(cfg)
        return cfg

    return settings
