"""`cflow` in this process."""

from __future__ import annotations

import sys

import pytest

from cflow_torch.cli.main import main


def cflow(*arguments: object) -> int:
    """Exit status of a call; `sys.argv` stays as it was.

    Hydra composes all settings twice. The first time it only reads `hydra.mode`, which nothing but an experiment sets.
    Calls without one skip that: a short call then takes half of the time.
    """
    words = [str(argument) for argument in arguments]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", list(sys.argv))
        if "hydra" in sys.modules and not any(word.startswith(("experiment=", "hydra")) for word in words):
            patch.setattr("hydra._internal.hydra.Hydra.get_mode", lambda *_, **__: None)
        try:
            main(words)
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0
