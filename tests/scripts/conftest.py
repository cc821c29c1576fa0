"""Import modules from the folders below scripts/."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Callable

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture()
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], ModuleType]:
    """`script(folder, name)`: a module, as `python scripts/<folder>/<name>.py` finds it."""

    def load(folder: str, name: str) -> ModuleType:
        monkeypatch.syspath_prepend(str(SCRIPTS / folder))
        return importlib.import_module(name)

    return load
