"""Rows of the table of targets that are aimed at a GPU; without one, batches are measured but not judged."""

from __future__ import annotations

from typing import Iterator, Sequence

from cflow_torch.bench.agreement import same_bits
from cflow_torch.bench.measure import trim_history
from cflow_torch.bench.target_row import FULL, NAMES, PAIR, Bench, Row
from cflow_torch.bench.throughput import measure_throughput
from cflow_torch.config import make_config
from cflow_torch.estimate import make_model

_LATENCY_MS = {FULL: 15.0}  # one window
_BATCH = 32
_WINDOWS_PER_S = {FULL: 300.0, PAIR: 2000.0}  # in batches of that size
_NO_GPU = "no GPU here"


def batch_rows(bench: Bench, batches: Sequence[int]) -> Iterator[Row]:
    """Milliseconds of one window, windows per second of batches.

    Args:
        bench: what the rows share.
        batches: numbers of windows in a batch.
    """
    for config, per_s in _WINDOWS_PER_S.items():
        name, why = NAMES[config], bench.missing(config)
        measured = {}
        if not why:
            window = trim_history(bench.window, config)
            measured = measure_throughput([window], config, batches, bench.repeats, bench.device)
        targets = {"ms": (1, _LATENCY_MS.get(config)), "windows/s": (_BATCH, per_s)}
        for size, figures in measured.items():
            values = {"ms": 1000 * figures["median_s"], "windows/s": figures["windows_per_s"]}
            for unit, value in values.items():
                if unit == "ms" and size != 1:
                    continue
                at, target = targets[unit]
                row = Row(f"{name}, batch {size}", unit, value)
                yield _judged(row, target) if bench.on_gpu and at == size and target else row
        for unit, (size, target) in targets.items():
            if target and (size not in measured or not bench.on_gpu):
                missing = why or ("not asked for" if bench.on_gpu else _NO_GPU)
                yield Row(f"{name}, batch {size}, one GPU", unit, target=_text(unit, target), why=missing)


def device_rows(bench: Bench) -> Iterator[Row]:
    """The same results on the GPU as on the CPU.

    Args:
        bench: what the rows share.
    """
    configs = {NAMES[config]: config for config in (PAIR, FULL)}
    configs["key points, preset paper"] = make_config("paper", method="keypoints")
    for name, config in configs.items():
        why = bench.missing(config) if bench.on_gpu else _NO_GPU
        row = Row(f"GPU = CPU, {name}", target="same bits", why=why)
        if not why:
            window = trim_history(bench.window, config)
            same = same_bits(*(make_model(config, device)([window]) for device in (bench.device, "cpu")))
            differs = ", ".join(field for field, equal in same.items() if not equal and field != "bit_equal")
            row = Row(row.what, target=row.target, met=same["bit_equal"], why=differs and f"differ: {differs}")
        yield row


def _judged(row: Row, target: float) -> Row:
    ours = row.ours or 0.0
    met = ours <= target if row.unit == "ms" else ours >= target
    return Row(row.what, row.unit, ours, target=_text(row.unit, target), met=met)


def _text(unit: str, target: float) -> str:
    return f"{'<=' if unit == 'ms' else '>='} {target:g} {unit}"
