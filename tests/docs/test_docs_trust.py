"""The page of trust names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).resolve().parent
PAGE = TESTS.parent / "docs" / "trust.md"


def test_every_test_that_is_named_exists() -> None:
    """`test_beginning...` and `test_beginning_*` stand for all that begin so."""
    defined = set()
    for file in TESTS.glob("test_*.py"):
        defined |= {file.name, *re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.M)}
    named = re.findall(r"\btest_\w+(?:\.py|\.\.\.|\*)?", PAGE.read_text(encoding="utf-8"))
    assert len(named) > 100
    missing = []
    for name in named:
        beginning = name.rstrip(".*") if name.endswith(("...", "*")) else None
        if name not in defined and not (beginning and any(each.startswith(beginning) for each in defined)):
            missing.append(name)
    assert missing == []
