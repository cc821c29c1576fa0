"""Colours of the points of a page: each colouring is a palette, and a point has one byte, the entry of its colour."""

from __future__ import annotations

from typing import Any

import numpy as np

from cflow_torch.viz.clusters import PALETTE, cluster_colors
from cflow_torch.viz.panel import MAX_ERROR, MIN_ERROR
from cflow_torch.viz.wheel import flow_to_rgb

STATIC, GROUND, UNKNOWN, FIRST = 0, 1, 2, 3  # greys, which the page chooses; the colours of a palette begin at FIRST
HUES, LEVELS = 36, 6  # the wheel in the page; one more level is for flow longer than max_flow
_PALEST = 0.35  # saturation of slow motion, which would be white on a light page
_FADED, _GREY = 0.15, 140  # static objects: share of their colour, the rest is this grey, which both themes show
_STEPS = 64  # colours of a ramp
_RAMP = np.array([(66, 125, 245), (38, 190, 205), (112, 205, 80), (250, 200, 40), (235, 60, 45)], float)


def make_colorings(max_flow: float, interval: float) -> list[dict[str, Any]]:
    """All colourings of the page, with palettes and legends; the rim of the wheel is `max_flow`, metres per sweep."""
    speed = max_flow / interval
    rim = f"right: ahead of the vehicle; rim: {max_flow:.4g} m per sweep, {speed:.3g}\u00a0m/s"
    faded = np.rint(_FADED * PALETTE + (1 - _FADED) * _GREY).astype(np.uint8)
    wheel, ramp, objects = _wheel().tolist(), _ramp().tolist(), np.concatenate([PALETTE, faded]).tolist()
    likely = "probability of an error below 0.1 m"
    rows = (
        # name, text, palette, scale, note, meaning of the greys
        ("flow", "residual flow", wheel, None, rim, ("static", "ground", "")),
        ("speed", "speed over ground", ramp, (0, speed, "m/s"), "", ("static", "ground", "")),
        ("object", "object", objects, None, "bright: moving or tracked; pale: static", ("no object", "ground", "")),
        ("confidence", "confidence", ramp, (1, 0, ""), likely, ("", "ground", "unknown")),
        ("truth", "true flow", wheel, None, rim, ("static", "ground", "unknown")),
        ("error", "end-point error", ramp, (0, MAX_ERROR, "m"), "", (f"below {MIN_ERROR:g} m", "ground", "unknown")),
    )
    return [dict(zip(("name", "text", "palette", "scale", "note", "keys"), row)) for row in rows]


def _wheel() -> np.ndarray:
    """(HUES * (LEVELS + 1), 3) uint8 colours of the wheel: direction by direction, each from slow to too fast."""
    angle = (np.arange(HUES) + 0.5) * (2 * np.pi / HUES)
    length = np.append(np.maximum(np.arange(1, LEVELS + 1) / LEVELS, _PALEST), 1.3)
    flow = np.stack([np.cos(angle)[:, None] * length, np.sin(angle)[:, None] * length], axis=-1)
    return flow_to_rgb(flow, 1.0).reshape(-1, 3)


def wheel_entry(flow: np.ndarray, max_flow: float) -> np.ndarray:
    """(N,) int64 entries of `_wheel`."""
    flow = np.nan_to_num(flow)
    hue = np.floor(np.arctan2(flow[:, 1], flow[:, 0]) % (2 * np.pi) * (HUES / (2 * np.pi))).astype(np.int64)
    level = np.ceil(np.hypot(flow[:, 0], flow[:, 1]) / max_flow * LEVELS).astype(np.int64)
    return FIRST + hue.clip(0, HUES - 1) * (LEVELS + 1) + (level - 1).clip(0, LEVELS)


def _ramp() -> np.ndarray:
    """(_STEPS, 3) uint8, from low to high."""
    at = np.linspace(0, len(_RAMP) - 1, _STEPS)
    return np.stack([np.interp(at, np.arange(len(_RAMP)), c) for c in _RAMP.T], axis=1).astype(np.uint8)


def ramp_entry(value: np.ndarray, most: float) -> np.ndarray:
    """(N,) int64 entries of `_ramp`."""
    return FIRST + (np.nan_to_num(value) / most * _STEPS).clip(0, _STEPS - 1).astype(np.int64)


def object_entry(position: np.ndarray, cluster: np.ndarray, moving: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return palette entries, (N,) uint8. Neighbours differ. Clusters of which less than half moves are pale."""
    entry = np.where(ground, GROUND, STATIC).astype(np.uint8)
    has_one = cluster >= 0
    colors = cluster_colors(position[has_one], cluster[has_one], (0, 0, 0))
    _, number, size = np.unique(cluster[has_one], return_inverse=True, return_counts=True)
    moves = 2 * np.bincount(number, moving[has_one]) >= size
    pale = np.where(moves, 0, len(PALETTE))[number]
    entry[has_one] = FIRST + (colors[:, None] == PALETTE).all(axis=2).argmax(axis=1) + pale
    return entry
