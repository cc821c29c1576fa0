"""Targets."""

from __future__ import annotations

from typing import Tuple

from fuzzing.target import Target

TARGETS: Tuple[Target, ...] = ()
