"""`cflow` in this process."""

from __future__ import annotations

import sys

from cflow_torch.cli.main import main


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
