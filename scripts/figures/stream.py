#!/usr/bin/env python3
"""The picture of docs/applications.md that shows how long a stream takes: latency of each sweep of a simulated drive.

python scripts/figures/stream.py            docs/pictures/stream.png, and the medians
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import List

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from cflow_torch import FlowStream  # noqa: E402
from cflow_torch.simulator import make_drive  # noqa: E402

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "stream.png"
SEED, NUM_SWEEPS, INTERVAL = 0, 40, 0.1


def main() -> int:
    """Draw it; returns the exit status."""
    sweeps = list(make_drive(seed=SEED, num_sweeps=NUM_SWEEPS, profile="av2"))
    figure, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
    for preset in ("fast", "paper", "default"):
        found = latencies(FlowStream(preset, device="cpu"), sweeps)
        print(
            f"{preset}: median {1000 * np.median(found):.0f} ms, 99 % within {1000 * np.percentile(found, 99):.0f} ms"
        )
        axes.plot(range(1, NUM_SWEEPS), 1000 * np.array(found), ".-", label=preset)
    axes.axhline(1000 * INTERVAL, color="0.6", linewidth=0.8)
    axes.text(0, 1000 * INTERVAL, "the next sweep", ha="left", va="top", color="0.4", fontsize=8)
    axes.set(xlabel="sweep", ylabel="latency (ms)", ylim=(0, None))
    axes.legend(frameon=False, ncols=3, loc="upper left", fontsize=8)
    figure.savefig(PICTURE, dpi=110)
    return 0


def latencies(stream: FlowStream, sweeps: list) -> List[float]:
    """Seconds from each sweep but the first to the flow of the one before it."""
    seconds = []
    for sweep in sweeps:
        begin = time.perf_counter()
        result = stream.push(sweep.points, sweep.pose, sweep.timestamp_ns, sweep.is_ground)
        if result is not None:
            seconds.append(time.perf_counter() - begin)
    return seconds


if __name__ == "__main__":
    sys.exit(main())
