"""`cflow` in this process.

Hydra composes the settings of a call twice, first only for hydra.mode, and each time it copies the schemas of all
commands. That would be a tenth of the time of the tests, so we leave it out here. Processes that tests start do it.
"""

from __future__ import annotations

import sys
from typing import Any

from hydra._internal.hydra import Hydra
from hydra.core.config_store import ConfigStore

from cflow_torch.cli.main import main

_get_mode = Hydra.get_mode


def _mode(hydra: Hydra, config_name: str, overrides: list[str]) -> Any:
    """Return hydra.mode, which of our settings only experiments change."""
    is_set = any(override.startswith(("experiment=", "hydra.mode=")) for override in overrides)
    return _get_mode(hydra, config_name, overrides) if is_set else None


Hydra.get_mode = _mode  # type: ignore[method-assign]
ConfigStore.__deepcopy__ = lambda store, _: store  # type: ignore[attr-defined]


def cflow(*arguments: object) -> int:
    """Exit status of a call; `sys.argv` stays as it was."""
    before = list(sys.argv)
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = before
    return 0
