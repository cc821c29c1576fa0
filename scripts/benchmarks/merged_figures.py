"""What merged_motion.py measures: errors, times, and whether the confidence tells of movers that are missed."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, replace
from typing import Dict, List, Sequence

import numpy as np
from merged_rows import MOVES
from rows import Setting
from score import Figures, pooled_figures, simulated_figures, with_means
from sets import Item, ScoredSet

from cflow_torch import make_model
from cflow_torch.config import Config
from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.types import FlowResult, Window, as_numpy


@dataclass(frozen=True)
class Misses:
    """Moving points that are taken for static, and what the confidence says of them and of what stands.

    Args:
        moving: points that move.
        missed: of these, those whose flow is shorter than half of the true one.
        of_missed, of_standing: (missed,), (S,) confidence; empty where the method gives none.
        standing_error: (S,) metres, end-point error of the points that stand.
    """

    moving: int
    missed: int
    of_missed: np.ndarray
    of_standing: np.ndarray
    standing_error: np.ndarray

    def confidence_at(self, share: float) -> float:
        """The highest confidence that at most this share of what stands lies below; NaN if nothing stands."""
        if not len(self.of_standing):
            return math.nan
        return float(np.sort(self.of_standing)[int(share * len(self.of_standing))])

    def flagged_below(self, confidence: float) -> float:
        """Share of the missed points with less confidence; NaN if there are none."""
        return share_below(self.of_missed, confidence)

    def standing_below(self, confidence: float) -> float:
        """Share of the points that stand with less confidence."""
        return share_below(self.of_standing, confidence)


def share_below(values: np.ndarray, bound: float) -> float:
    """Share of some values that lie below a bound; NaN if there are none, or no bound."""
    return float(np.mean(values < bound)) if len(values) and not math.isnan(bound) else math.nan


@dataclass(frozen=True)
class Measured:
    """Figures of a setting on a row.

    Args:
        errors: "dynamic", "pedestrian", "static", "stands", "near", "far"; NaN = there is none.
        misses: see `Misses`.
        times: seconds of each window.
    """

    errors: Dict[str, float]
    misses: Misses
    times: List[float]

    @property
    def seconds(self) -> float:
        """Median time of a window."""
        return statistics.median(self.times)

    def ratio_to(self, other: Measured) -> float:
        """Median over the windows of the time divided by that of another setting."""
        return statistics.median(own / theirs for own, theirs in zip(self.times, other.times))


def measure(sets: Sequence[ScoredSet], settings: Sequence[Setting]) -> List[Measured]:
    """Figures of each setting on the windows of some sets.

    Convention: settings take turns window by window, so that a slow spell of the machine hits all of them.
    """
    scores: List[Dict[str, Figures]] = [{} for _ in settings]
    misses: List[List[Misses]] = [[] for _ in settings]
    times: List[List[float]] = [[] for _ in settings]
    for scored in sets:
        configs = [setting.for_set(scored) for setting in settings]
        models, items = [make_model(config) for config in configs], scored.items()
        frames: List[List[EvalFrame]] = [[] for _ in settings]
        for model, config in zip(models, configs):  # the first call of a kind is slower
            model([cut(items[0].window, config)])
        for item in items:
            for i, (model, config) in enumerate(zip(models, configs)):
                taken = cut(item.window, config)
                start = time.perf_counter()
                (result,) = model([taken])
                times[i].append(time.perf_counter() - start)
                frames[i].append(item.frame(result.residual_flow))
                misses[i].append(find_misses(item, result, scored))
        for of_setting, of_set in zip(scores, frames):
            of_setting[scored.name] = figures_of(scored, of_set)
    measured = []
    for of_setting, parts, seconds in zip(scores, misses, times):
        together = merged_misses(parts)
        *_, figures = with_means(of_setting).values()  # the mean over sensors comes last
        stands = float(together.standing_error.mean()) if len(together.standing_error) else math.nan
        keys = ("dynamic", "pedestrian", "static", "near", "far")
        errors = {**{key: figures.get(key, math.nan) for key in keys}, "stands": stands}
        measured.append(Measured(errors, together, seconds))
    return measured


def figures_of(scored: ScoredSet, frames: Sequence[EvalFrame]) -> Figures:
    """Errors of a set: as the ablation has them; of small drives the mean over the drives, as docs/limits.md has it."""
    if scored.group == "sim":
        return simulated_figures(frames)
    if scored.group != "scene":
        return pooled_figures(frames, scored.step, scored.reach)
    parts = [pooled_figures([frame], reach=scored.reach) for frame in frames]
    return {key: mean_of_present(np.array([part[key] for part in parts])) for key in parts[0]}


def cut(window: Window, config: Config) -> Window:
    """The window with as many sweeps as a setting looks at."""
    return replace(window, pch=window.pch[: config.num_history], pcf=window.pcf[: config.num_future])


def find_misses(item: Item, result: FlowResult, scored: ScoredSet) -> Misses:
    """Missed movers among the points of a window that are scored."""
    sweep, truth = item.window.pc0, item.labels.flow - item.pose_flow
    counts = item.labels.is_valid & (np.abs(as_numpy(sweep.points)[:, :2]) <= scored.reach).all(1)
    if sweep.is_ground is not None:
        counts &= ~as_numpy(sweep.is_ground)
    if item.eval_mask is not None:
        counts &= item.eval_mask
    speed, estimate = np.linalg.norm(truth, axis=1), as_numpy(result.residual_flow)
    moves = counts & (speed >= MOVES * scored.step) & (item.labels.category > 0)
    stands = counts & (speed < MOVES * scored.step)
    missed = moves & (np.linalg.norm(estimate, axis=1) < 0.5 * speed)
    confidence = np.zeros(0) if result.confidence is None else as_numpy(result.confidence)
    of_missed, of_standing = (confidence[rows] if len(confidence) else confidence for rows in (missed, stands))
    error = np.linalg.norm(estimate - truth, axis=1)[stands]
    return Misses(int(moves.sum()), int(missed.sum()), of_missed, of_standing, error)


def merged_misses(parts: Sequence[Misses]) -> Misses:
    """Those of several windows together."""
    arrays = zip(*((part.of_missed, part.of_standing, part.standing_error) for part in parts))
    moving, missed = sum(part.moving for part in parts), sum(part.missed for part in parts)
    return Misses(moving, missed, *map(np.concatenate, arrays))
