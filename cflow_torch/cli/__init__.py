"""The `cflow` command, one module per sub-command."""

from __future__ import annotations
