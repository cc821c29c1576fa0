"""Windows per second of batches."""

from __future__ import annotations

import statistics
import time
from typing import Any, Dict, Sequence

from cflow_torch.bench.timing import synchronise
from cflow_torch.config import Config
from cflow_torch.estimate import make_model
from cflow_torch.types import Window

# A batch is run again until so many seconds are over, at least this often.
_SECONDS = 2.0
_FEWEST_RUNS = 2


def measure_throughput(
    windows: Sequence[Window], config: Config, batches: Sequence[int], repeats: int, device: Any = "auto"
) -> Dict[int, Dict[str, float]]:
    """Seconds of a batch and windows per second, for several sizes.

    Args:
        windows: at least one; a larger batch takes them again from the first.
        config: settings.
        batches: numbers of windows in a batch.
        repeats: most timed runs per size.
        device: as for `make_model`.

    Returns:
        Size -> "median_s" of a batch, "windows_per_s", "runs". From arrays of the caller to results on the device, the
        device synchronised.
    """
    model = make_model(config, device)
    measured = {}
    for size in batches:
        batch = [windows[i % len(windows)] for i in range(size)]

        def run(batch: Sequence[Window] = batch) -> float:
            start = time.perf_counter()
            synchronise(model(batch)[-1].flow)
            return time.perf_counter() - start

        run()
        seconds = [run()]
        while len(seconds) < min(repeats, _FEWEST_RUNS) or (len(seconds) < repeats and sum(seconds) < _SECONDS):
            seconds.append(run())
        median = statistics.median(seconds)
        measured[size] = {"median_s": median, "windows_per_s": size / median, "runs": len(seconds)}
    return measured
