"""Motion candidates of a component: of each sweep, of all sweeps together, of the coarser level, of key points."""

from __future__ import annotations

from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import KeypointsConfig, VerifiedConfig
from oracle.component_tree import Level
from oracle.dense import scene_flow_in_1view
from oracle.height_slices import Pixel, SlicedSweeps, Vector, coarsen, shared, vertex
from oracle.history import median, pool
from oracle.keypoints import match_radius
from oracle.matching import match_keypoints
from oracle.pixels import bounding_box, occupancy, search_radius

KEYPOINTS = KeypointsConfig(patch_size=21, ratio_threshold=1.02, gate_radius=3.0)
KEYPOINT_BLOCK = 2  # finest pixels a side of a pixel that can be a key point


def list_motions(
    estimates: Sequence[Optional[Vector]], intervals: Sequence[float], others: Sequence[Vector] = ()
) -> List[Vector]:
    """Motions per sweep interval that one component may have, in the order in which ties are decided.

    Args:
        estimates: (y, x) displacement m -> t+1 for every sweep m = t, t-1, ..., nearest first; None = not known.
        intervals: k, sweep intervals from m to t+1.
        others: motions from elsewhere: what the coarser level gave to the component, what key points say.

    Returns:
        The pool of all estimates (Sec. leverage_past_pcs), if there is more than one sweep; each sweep's estimate by
        its k; the others. (0, 0), which never wins, stands for what is not known.
    """
    per_interval = [None if f is None else (f[0] / k, f[1] / k) for f, k in zip(estimates, intervals)]
    found = [(0.0, 0.0) if f is None else f for f in per_interval]
    if len(estimates) > 1:
        known = [np.array([*f, 0.0]) for f in per_interval if f is not None]
        y, x, _ = pool(known).tolist() if known else (0.0, 0.0, 0.0)
        found.insert(0, (y, x))
    return [*found, *others]


def find_peak(
    sweeps: SlicedSweeps, level: Level, members: Sequence[Pixel], m: int, config: VerifiedConfig
) -> Optional[Tuple[Vector, float]]:
    """Displacement (y, x) of a component from sweep m to t+1, finest pixels, and its NCC; None without pixels at m.

    Convention: a parabola through the counts of slices that the template shares with t+1, whatever component they are
        of there, gives the part of a pixel; a peak at no shift stays there.
    """
    block = level.block
    own = [sorted({(r // block, c // block) for n, r, c in members if n == i}) for i in range(len(sweeps.images))]
    if not own[m]:
        return None
    box = bounding_box([np.array(pixels) for pixels in own if pixels])
    template, target = (occupancy(np.array(own[i]), box) for i in (m, 0))
    radius = search_radius(config, sweeps.seconds[m], sweeps.pixel_size * block)
    (dx, dy), score = scene_flow_in_1view(template, target, 1.0, radius)
    if dx == 0 and dy == 0:
        return (0.0, 0.0), score
    coarse = sweeps._replace(images=level.images)
    beside = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
    middle, above, below, left, right = (
        shared(coarse, [(m, r, c) for r, c in own[m]], 0, int(dy) + down, int(dx) + aside) for down, aside in beside
    )
    return ((dy + vertex(above, middle, below)) * block, (dx + vertex(left, middle, right)) * block), score


def keypoint_shifts(sweeps: SlicedSweeps, config: VerifiedConfig) -> Dict[Pixel, Vector]:
    """Displacement t -> t+1, (y, x) finest pixels, of the occupied pixels of t that lie in a matched key point."""
    settings = KEYPOINTS.replace(max_speed=config.max_speed)
    newest, at_t = (coarsen(image, KEYPOINT_BLOCK) > 0 for image in sweeps.images[:2])
    reach = match_radius(settings, sweeps.seconds[1], sweeps.pixel_size * KEYPOINT_BLOCK)
    matches = {(found.row, found.column): found for found in match_keypoints(at_t, newest, reach, settings)}
    shifts = {}
    for r, c in np.argwhere(sweeps.images[1]).tolist():
        found = matches.get((r // KEYPOINT_BLOCK, c // KEYPOINT_BLOCK))
        if found is not None:
            shifts[1, r, c] = (float(found.dy * KEYPOINT_BLOCK), float(found.dx * KEYPOINT_BLOCK))
    return shifts


def keypoint_motion(members: Sequence[Pixel], shifts: Dict[Pixel, Vector]) -> Vector:
    """The median of each axis over the pixels of a component that were matched; (0, 0) if none was."""
    matched = [shifts[pixel] for pixel in members if pixel in shifts]
    return (median([y for y, _ in matched]), median([x for _, x in matched])) if matched else (0.0, 0.0)
