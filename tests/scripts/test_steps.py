"""The ablation can leave out every step: what it replaces exists under the name that the script uses."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("scipy")


def test_every_step_can_be_left_out(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    script("figures", "drives")
    steps = script("ablation", "steps")
    monkeypatch.setattr(steps, "score_preset", lambda scored, preset, changes: changes)
    for name in (*steps.STEPS, *steps.SETTINGS):
        assert steps.score_without(None, name) == steps.SETTINGS.get(name, {})
