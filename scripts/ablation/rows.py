"""The settings that are scored: presets beside each other, and `default` with one setting changed at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Dict, Tuple

from sets import ScoredSet

from cflow_torch.config import Config, make_config


@dataclass(frozen=True)
class Setting:
    """A preset with some fields replaced. History and region are the set's, so that presets compare at equal ones.

    Args:
        name: of the row.
        preset: see `make_config`.
        overrides: fields of the method's settings; they win over the set's.
    """

    name: str
    preset: str
    overrides: Dict[str, Any] = field(default_factory=dict)

    def for_set(self, scored: ScoredSet) -> Config:
        """The settings for a set."""
        of_set: Dict[str, Any] = {"num_history": scored.history}
        if scored.half_side is not None:
            half = scored.half_side
            of_set["point_cloud_range"] = (-half, -half, -math.inf, half, half, math.inf)
        return make_config(self.preset, **{**of_set, **self.overrides})


def _default(name: str, **overrides: Any) -> Setting:
    return Setting(f"default{name}", "default", overrides)


ROWS: Tuple[Setting, ...] = (
    Setting("paper", "paper"),
    Setting("paper, scales .4 .2 .1", "paper", {"pixel_sizes": (0.4, 0.2, 0.1)}),
    Setting("fast", "fast"),
    _default(""),
    Setting("offline", "offline"),
    _default(" - thorough", thorough=False),
    _default(", significance 0", significance=0.0),
    _default(", significance 1", significance=1.0),
    _default(", significance 2", significance=2.0),
    _default(" - min_height", min_height=None),
    _default(" - max_speed", max_speed=None),
    _default(", scale .1", pixel_sizes=(0.1,)),
    _default(", scales .2 .1", pixel_sizes=(0.2, 0.1)),
    _default(", scales .4 .1", pixel_sizes=(0.4, 0.1)),
    # On the sets with history; on those of pairs it is a copy of `default`.
    _default(", h = 0", num_history=0),
    _default(", h = 2", num_history=2),
)
