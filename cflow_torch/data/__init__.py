"""Readers, writers, simulated drives: everything that touches files."""

from __future__ import annotations
