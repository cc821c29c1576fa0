"""The site: its reference has every public name, and its pages are built from the pages of the repository."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import pytest

import cflow_torch
from cflow_torch import evaluation, viz
from cflow_torch.data.catalog import DATA_SETS

ROOT = Path(__file__).resolve().parents[2]


def test_the_reference_has_every_public_name() -> None:
    named = set(re.findall(r"- (cflow_torch\.[\w.]+)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    public = {f"cflow_torch.{name}" for name in cflow_torch.__all__ if name != "__version__"}
    readers = {f"cflow_torch.data.{name}.{one.log}" for name, one in DATA_SETS.items()}
    scores = {f"cflow_torch.evaluation.{name}" for name in evaluation.__all__ if name != "DEFINITIONS"}
    pictures = {
        f"cflow_torch.viz.{name}" for name in viz.__all__ if name.startswith(("plot", "save", "record", "show"))
    }
    assert not (public | readers | scores | pictures) - named


def test_a_notebook_becomes_a_page_with_its_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    notebook_page = importlib.import_module("site_pages").notebook_page
    outputs = [
        {"output_type": "stream", "text": ["1 car\n"]},
        {"output_type": "display_data", "data": {"image/png": "iVBO\n", "text/plain": "<Figure>"}},
    ]
    cells = [
        {"cell_type": "markdown", "source": ["# A title"]},
        {"cell_type": "code", "source": ["print(cars)"], "outputs": outputs},
    ]
    file = tmp_path / "a.ipynb"
    file.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert notebook_page(file) == (
        "# A title\n\n```python\nprint(cars)\n```\n\n```text\n1 car\n```\n\n![output](data:image/png;base64,iVBO)"
    )
