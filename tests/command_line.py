"""`cflow` in this process.

Hydra composes the settings twice, first only for hydra.mode, and copies the schemas of all commands each time. We leave
that out here, because it is a tenth of the time of the tests. The processes that tests start do it.
"""

from __future__ import annotations

import sys
from typing import Any, Callable

from hydra._internal.hydra import Hydra
from hydra.core.config_store import ConfigStore

from cflow_torch.cli.main import main


def _mode(hydra: Hydra, config_name: str, overrides: list[str], get_mode: Callable[..., Any] = Hydra.get_mode) -> Any:
    """Return hydra.mode, which of our settings only experiments change."""
    is_set = any(override.startswith(("experiment=", "hydra.mode=")) for override in overrides)
    return get_mode(hydra, config_name, overrides) if is_set else None


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
