"""The speed that is aimed at, row by row: ours, the competitor's, their ratio, and whether the target is met."""

from __future__ import annotations

from typing import Any, Iterator, List, Optional, Sequence

from cflow_torch.bench.agreement import same_bits
from cflow_torch.bench.clustering import measure_hdbscan
from cflow_torch.bench.measure import Report, trim_history
from cflow_torch.bench.memory import count_allocations
from cflow_torch.bench.target_row import FULL, NAMES, PAIR, WIDE, Bench, Row, against
from cflow_torch.bench.targets_gpu import batch_rows, device_rows
from cflow_torch.bench.timing import alternate, median_ratio, summary, synchronise, threads
from cflow_torch.config import make_config
from cflow_torch.estimate import make_model
from cflow_torch.types import FlowResult, Window

_FASTER_THAN_LOOP = {PAIR: 2.0, WIDE: 2.0, FULL: 5.0}
_FASTER_THAN_HDBSCAN = 20.0
_CLUSTERING_AGAINST_OPENCV = 1 / 3  # within three times
_MOST_MB = 400.0
# The row that holds `max_memory` to its word.
_LIMITED_BATCH = 4
_LIMIT_MB = 100.0


def measure_targets(
    window: Window,
    report: Report,
    *,
    repeats: int = 20,
    batches: Sequence[int] = (1, 8, 32),
    with_opencv: bool = True,
    with_hdbscan: bool = True,
    num_threads: Optional[int] = None,
    device: Any = "auto",
) -> List[Row]:
    """Every row of the table; those that cannot be measured here say why.

    Args:
        window: sweeps; rows with history need four older ones.
        report: of `run_bench` on the same window; what it holds is not measured again.
        repeats: timed runs of each, in turn with the competitor's.
        batches: sizes of batches whose windows per second are measured.
        with_opencv, num_threads, device: as for `run_bench`.
        with_hdbscan: also run HDBSCAN, if it is installed; once, because it takes seconds.

    Returns:
        Rows in the order of the targets.

    Convention:
        Targets for the CPU are judged on the CPU only, those for a GPU on a GPU only.

    Cost: about a minute on two cores, most of it for batches of 32 windows.
    """
    bench = Bench(window, report, repeats=repeats, with_opencv=with_opencv, num_threads=num_threads, device=device)
    with threads(num_threads):
        return [
            *_speed(bench),
            *_clustering(bench, with_hdbscan),
            *_key_points(bench),
            *batch_rows(bench, batches),
            *device_rows(bench),
            *_memory(bench),
            Row("growth: flat in points, linear in area and in windows", why="drawn by scripts/bench_growth.py"),
        ]


def _speed(bench: Bench) -> Iterator[Row]:
    """The whole method against the OpenCV loop."""
    for config, at_least in _FASTER_THAN_LOOP.items():
        what, why = f"{NAMES[config]}, one window", bench.missing(config)
        if why:
            yield Row(what, "ms", competitor="OpenCV loop", target=f">= {at_least:g}", why=why)
            continue
        entry = bench.entry(config)
        row = against(what, entry["fast"], "OpenCV loop", entry["opencv"], entry["opencv_over_fast"], at_least)
        yield bench.for_cpu(row)


def _clustering(bench: Bench, with_hdbscan: bool) -> Iterator[Row]:
    """The stage alone."""
    stage = bench.entry(PAIR)["clustering"]
    ours, theirs = stage["fast"], stage["dilate_and_label"]
    ratio = stage.get("dilate_and_label_over_fast")
    what = "clustering stage, +-35 m"
    yield bench.for_cpu(against(what, ours, "OpenCV dilate + label", theirs, ratio, _CLUSTERING_AGAINST_OPENCV))
    seconds: Any = measure_hdbscan(trim_history(bench.window, PAIR), PAIR) if with_hdbscan else "not run"
    ratio = None if isinstance(seconds, str) else seconds / ours["median_s"]
    yield bench.for_cpu(against(what, ours, "HDBSCAN, one run", seconds, ratio, _FASTER_THAN_HDBSCAN))


def _key_points(bench: Bench) -> Iterator[Row]:
    """Key points against the dense method, both on one pair."""
    near = {"point_cloud_range": PAIR.point_cloud_range}
    presets = {name: make_config(name, method="keypoints", **near) for name in ("paper", "keypoints")}
    pair = trim_history(bench.window, PAIR)
    models = [make_model(config, bench.device) for config in (PAIR, *presets.values())]
    runs = [lambda model=model: synchronise(model([pair])[0].flow) for model in models]  # type: ignore[misc]
    dense, *others = alternate(runs, bench.repeats)
    for name, times in zip(presets, others):
        what = f"key points, preset {name}, +-35 m, one pair"
        yield against(what, summary(times), "dense, h = 0", summary(dense), median_ratio(times, dense), 1.0)


def _memory(bench: Bench) -> Iterator[Row]:
    """Most memory held at once, counted from allocations."""
    for config, name in NAMES.items():
        what, target, why = f"memory above the input, {name}", f"<= {_MOST_MB:g} MB", bench.missing(config)
        if why:
            yield Row(what, "MB", target=target, why=why)
            continue
        peak_mb = bench.entry(config)["work"]["peak_bytes"] / 1e6
        yield bench.for_cpu(Row(what, "MB", peak_mb, target=target, met=peak_mb <= _MOST_MB))

    config = PAIR if bench.missing(FULL) else FULL
    batch = [trim_history(bench.window, config)] * _LIMITED_BATCH
    limited = make_model(config.replace(max_memory=int(_LIMIT_MB * 1e6)), bench.device)
    results = limited(batch)
    same = same_bits(results, make_model(config, bench.device)(batch))["bit_equal"]
    _, peak = count_allocations(lambda: limited(batch))
    peak_mb = (peak - _bytes_of(results)) / 1e6
    yield Row(
        f"memory besides the results, batch {_LIMITED_BATCH}, max_memory = {_LIMIT_MB:g} MB, {NAMES[config]}",
        "MB",
        peak_mb,
        target=f"<= {_LIMIT_MB:g} MB, same bits",
        met=same and peak_mb <= _LIMIT_MB,
        why="" if same else "other bits than without a limit",
    )


def _bytes_of(results: Sequence[FlowResult]) -> int:
    return sum(value.nbytes for result in results for value in result.numpy().values())
