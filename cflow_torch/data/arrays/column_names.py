"""Names of the columns of a cloud."""

from __future__ import annotations

from typing import Sequence


def distinct_names(names: Sequence[str], padding: str = "") -> list[str]:
    """Number the repetitions of a name: intensity, intensity_2. The name of `padding` stays."""
    counts = [list(names[:k]).count(name) for k, name in enumerate(names, 1)]
    return [name if count == 1 or name == padding else f"{name}_{count}" for name, count in zip(names, counts)]
