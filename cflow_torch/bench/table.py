"""The report of `run_bench` as text."""

from __future__ import annotations

from typing import Any, Dict, List, Mapping, Sequence

from cflow_torch.bench.target_row import Row

Report = Dict[str, Any]


def format_bench(report: Report) -> str:
    """The report as Markdown: the machine, a table of medians and ratios, one of the stages, one of counts.

    Args:
        report: as made by `run_bench`.

    Returns:
        Text without a line break at its end.

    Convention: "OpenCV / fast" above 1 means that the fast path is faster.
    """
    machine, results = report["machine"], report["results"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads, device {machine['device']}; "
        f"{machine['platform']}, Python {machine['python']}; {versions}",
        f"{report['num_windows']} window(s) of about {report['points']} points a sweep; "
        f"medians of {report['repeats']} runs, per window",
        "",
    ]
    lines += _table(
        ["", "fast ms", "min-max", "OpenCV loop ms", "OpenCV / fast", "reference s", "bits = reference"]
        + ["same flow as OpenCV", "within a pixel", "clustering ms", "OpenCV", "extra MB, at least"],
        [[name, *_row(result)] for name, result in results.items()],
    )
    stages = list(dict.fromkeys(stage for result in results.values() for stage in result["stages_s"]))
    lines += ["", "Stages, ms (under the profiler):", ""]
    lines += _table(
        ["", *stages],
        [[name, *(_ms(result["stages_s"].get(stage, "")) for stage in stages)] for name, result in results.items()],
    )
    lines += ["", "Work, counted without a clock, first window:", ""]
    lines += _work(results)
    return "\n".join(lines)


def format_targets(rows: Sequence[Row]) -> str:
    """The table of targets.

    Args:
        rows: as made by `measure_targets`.

    Returns:
        Markdown without a line break at its end; "?" = not measured.

    Convention: a ratio is the competitor's figure over ours.
    """
    cells = [
        [row.what, _figure(row.ours, row.unit), row.competitor]
        + [_figure(row.theirs, row.unit) if row.competitor else "", "" if row.ratio is None else f"{row.ratio:.2f}"]
        + [row.target, "" if not row.target else "?" if row.met is None else "yes" if row.met else "NO", row.why]
        for row in rows
    ]
    header = ["targets", "ours", "competitor", "its", "ratio", "target", "met", "why not"]
    return "\n".join(_table(header, cells))


def _figure(value: Any, unit: str) -> str:
    return "" if value is None else f"{value:.1f} {unit}"


def _work(results: Mapping[str, Report]) -> List[str]:
    """Counts of every config, see `Work`."""
    header = [
        "",
        "operations",
        "waits",
        "uploads",
        "FFT samples, 10^6",
        "multiply-adds, 10^6",
        "MB allocated",
        "MB held",
    ]
    rows = []
    for name, result in results.items():
        work = result["work"]
        millions = (work[key] / 1e6 for key in ("fft_samples", "multiply_adds", "allocated_bytes", "peak_bytes"))
        counts = (str(work[key]) for key in ("operations", "waits", "uploads"))
        rows.append([name, *counts, *(f"{value:.1f}" for value in millions)])
    return _table(header, rows)


def _row(result: Report) -> List[str]:
    fast, agreement, clustering = result["fast"], result["agreement"], result["clustering"]
    ratio, peak = result["opencv_over_fast"], result["peak_extra_mb"]
    reference, agrees = result["reference"], agreement["opencv"]
    cells: List[Any] = [_ms(fast), f"{_ms(fast['min_s'])}-{_ms(fast['max_s'])}", _ms(result["opencv"])]
    cells.append(ratio if isinstance(ratio, str) else f"{ratio:.2f}")
    cells.append(reference if isinstance(reference, str) else f"{reference['median_s']:.2f}")
    same = agreement["reference"]
    cells.append(same if isinstance(same, str) else "yes" if same["bit_equal"] else "no")
    shares = ("same_flow", "within_one_pixel")
    cells += [agrees if isinstance(agrees, str) else f"{100 * agrees[share]:.2f} %" for share in shares]
    cells += [_ms(clustering["fast"]), _ms(clustering["opencv"])]
    return [*cells, peak if isinstance(peak, str) else f"{peak:.0f}"]


def _ms(seconds: Any) -> str:
    """Milliseconds of a number of seconds or of a summary's median; a text stays as it is."""
    if isinstance(seconds, str):
        return seconds
    return f"{1000 * (seconds['median_s'] if isinstance(seconds, dict) else seconds):.1f}"


def _table(header: List[str], rows: List[List[str]]) -> List[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows)]
