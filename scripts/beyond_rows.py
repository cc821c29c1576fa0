"""The settings that are scored: presets beside each other, and the rows of the ablation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Dict, List, Optional

from beyond_sets import ScoredSet

from cflow_torch.config import Config, make_config

SCALES = (0.4, 0.2, 0.1)
# What each option of the dense method is set to alone on top of `paper`, where it can stand alone.
ALONE: Dict[str, Any] = {
    "max_object": 25.0,
    "zero_test": 1.5,
    "subpixel": "parabola",
    "height_slices": 4,
    "max_speed": 40.0,
}
# The set gives these.
_OF_SET = ("num_history", "point_cloud_range")


@dataclass(frozen=True)
class Setting:
    """A preset with some fields replaced. History and region are the set's, so that presets compare at equal ones.

    Args:
        name: of the row.
        preset: see `make_config`.
        overrides: fields of `Config`.
    """

    name: str
    preset: str
    overrides: Dict[str, Any] = field(default_factory=dict)

    def but(self, name: str, **overrides: Any) -> Setting:
        """This setting with more fields replaced, under another name."""
        return Setting(name, self.preset, {**self.overrides, **overrides})

    def config(self, history: int = 0, half_side: float = 35.0) -> Config:
        """The settings for windows with so many older sweeps and a square region of this half side, metres."""
        region = (-half_side, -half_side, -math.inf, half_side, half_side, math.inf)
        of_set = {"num_history": history, "point_cloud_range": region}
        return make_config(self.preset, **{**of_set, **self.overrides})

    def for_set(self, scored: ScoredSet, half_side: Optional[float] = None) -> Config:
        """The settings for a set; `half_side` wins over that of the set."""
        return self.config(scored.history, half_side or scored.half_side)


PAPER = Setting("paper", "paper")
PAPER_SCALES = Setting("paper, scales .4 .2 .1", "paper", {"pixel_sizes": SCALES})
DEFAULT = Setting("default", "default")
FAST = Setting("fast", "fast")
PRESETS = (PAPER, PAPER_SCALES, DEFAULT, FAST)


def ablation() -> List[Setting]:
    """Each option alone on top of `paper`, parts of the proof on top of `paper` with proof, each taken from `default`.

    Which options `default` has is read from it: one that is added there gets its rows here.
    """
    default, off = DEFAULT.config(), Config()
    used = {
        f.name: getattr(default, f.name)
        for f in fields(Config)
        if f.name not in (*_OF_SET, "proof", "pixel_sizes") and getattr(default, f.name) != getattr(off, f.name)
    }
    rows = [*PRESETS]
    rows += [PAPER.but(f"paper + {_text(name, value)}", **{name: value}) for name, value in ALONE.items()]
    rows.append(PAPER.but("paper + all of these", **ALONE))
    proof = PAPER.but("paper + proof", proof=True)
    rows.append(proof)
    rows += [proof.but(f"{proof.name} + {_text(name, value)}", **{name: value}) for name, value in used.items()]
    rows.append(proof.but(f"{proof.name} + scales .4 .2 .1", pixel_sizes=SCALES))
    for name in used:
        rows.append(DEFAULT.but(f"default - {name}", **{name: getattr(off, name)}))
    rows += [
        DEFAULT.but("default - relocate - yaw", relocate=False, yaw=False),
        DEFAULT.but("default, proof_z=0", proof_z=0.0),
        DEFAULT.but("default, proof_z=1", proof_z=1.0),
        DEFAULT.but("default, proof_z=2", proof_z=2.0),
        DEFAULT.but("default + height_slices=4", height_slices=4),
        DEFAULT.but("default + nudge", nudge=True),
        DEFAULT.but("default, scale .1", pixel_sizes=(0.1,)),
        DEFAULT.but("default, scales .2 .1", pixel_sizes=(0.2, 0.1)),
        DEFAULT.but("default, scales .4 .1", pixel_sizes=(0.4, 0.1)),
        DEFAULT.but("default - proof", proof=False),
        FAST.but("fast + children", children=True),
        FAST.but("fast + height_slices=4", height_slices=4),
    ]
    return rows


def _text(name: str, value: Any) -> str:
    return name if value is True else f"{name}={value}"
