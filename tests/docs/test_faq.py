"""docs/faq.md: its lines of Python run one after the other and give what the answers say."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, Dict

import numpy as np

DOCS = Path(__file__).resolve().parents[2] / "docs"


def code_of(page: str) -> str:
    """All Python of a page."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text(encoding="utf-8"), re.S))


def test_the_python_of_the_faq_runs_in_order():
    names: Dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(code_of("faq"), "docs/faq.md", "exec"), names)
    assert names["nothing"].flow.shape == (0, 3)
    truth = names["drive"].labels(4)
    chosen = truth.is_valid & ~names["drive"].sweep(4).is_ground
    error = np.linalg.norm(names["result"].flow.numpy() - truth.flow, axis=1)[chosen]
    assert np.median(error) < 0.01
    took_part = names["result"].is_valid
    assert 0.5 < float(names["trusted"][took_part].float().mean()) <= 1 and not names["trusted"][~took_part].any()


def test_the_settings_of_the_limits_are_valid():
    exec(compile(code_of("limits"), "docs/limits.md", "exec"), {})
