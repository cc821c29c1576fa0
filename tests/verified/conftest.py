"""A confidence that says which bin of the table it is from."""

from __future__ import annotations

import pytest
from oracle import confidence as oracle

from cflow_torch.verified import confidence


@pytest.fixture
def numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The table with the number of each bin instead of its probability: no two bins are alike."""
    places = [i / 128 for i in range(len(confidence.TABLE["probabilities"]))]
    for module in (confidence, oracle):
        monkeypatch.setitem(module.TABLE, "probabilities", places)
