"""A line of the table of targets, and what its lines share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Dict, Optional

from cflow_torch.bench.measure import Report, plain_config, run_bench
from cflow_torch.config import Config
from cflow_torch.types import Window

# What the targets speak of: one pair at one scale, near and far, and the paper's full configuration (its figure
# benefit_multiscale).
PAIR = Config()
WIDE = PAIR.replace(point_cloud_range=[2 * bound for bound in PAIR.point_cloud_range])
FULL = PAIR.replace(num_history=4, pixel_sizes=(0.8, 0.4, 0.3, 0.2, 0.1))
NAMES = {
    PAIR: "h = 0, 1 scale, +-35 m",
    WIDE: "h = 0, 1 scale, +-70 m",
    FULL: "h = 4, 5 scales, +-35 m",
}


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Args:
        what: the work.
        unit: of `ours` and `theirs`.
        ours: None = not measured.
        competitor: its name, "" = none.
        theirs: the competitor's figure.
        ratio: theirs over ours, the median of neighbouring runs; above 1: ours is faster.
        target: as text, "" = none on this device.
        met: None = there is no target or no measurement.
        why: why something was not measured.
    """

    what: str
    unit: str = ""
    ours: Optional[float] = None
    competitor: str = ""
    theirs: Optional[float] = None
    ratio: Optional[float] = None
    target: str = ""
    met: Optional[bool] = None
    why: str = ""


def against(what: str, ours: Any, competitor: str, theirs: Any, ratio: Any, at_least: float) -> Row:
    """A row in milliseconds whose target is a ratio.

    Args:
        what: the work.
        ours, theirs: summaries or seconds; `theirs` may be a text that says why it was not measured.
        competitor: name.
        ratio: theirs over ours; means nothing where `theirs` is a text.
        at_least: smallest ratio that meets the target.
    """
    row = Row(what, "ms", _milliseconds(ours), competitor, target=f">= {at_least:.2g}")
    if isinstance(theirs, str):
        return replace(row, why=theirs)
    return replace(row, theirs=_milliseconds(theirs), ratio=ratio, met=ratio >= at_least)


def _milliseconds(seconds: Any) -> float:
    return 1000 * (seconds["median_s"] if isinstance(seconds, dict) else seconds)


class Bench:
    """The window, what was measured on it, and the means to measure more.

    Args:
        window: sweeps; may have more history than a row needs.
        report: of `run_bench` on the same window; what it holds is not measured again.
        **settings: `repeats`, `with_opencv`, `num_threads`, `device` of `run_bench`.
    """

    def __init__(self, window: Window, report: Report, **settings: Any) -> None:
        self.window = window
        self.repeats, self.device = settings["repeats"], settings["device"]
        self.on_gpu = report["machine"]["device"] != "cpu"
        self._settings = settings
        self._entries = list(report["results"].values())

    def entry(self, config: Config) -> Dict[str, Any]:
        """The report's entry of a config, measured now if it is not there."""
        wanted = plain_config(config)
        for entry in self._entries:
            if entry["config"] == wanted:
                return entry
        report = run_bench([self.window], {"": config}, with_reference=False, **self._settings)
        self._entries.append(report["results"][""])
        return self._entries[-1]

    def missing(self, config: Config) -> str:
        """Why a config cannot be measured; "" = it can."""
        has, needs = len(self.window.pch), config.num_history
        return f"{has + 2} sweeps, {needs + 2} are needed" if has < needs else ""

    def for_cpu(self, row: Row) -> Row:
        """A row whose target holds for the CPU: on a GPU it is not judged."""
        return replace(row, target="", met=None) if self.on_gpu else row
