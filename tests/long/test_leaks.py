"""Nothing piles up over many windows: files, threads, objects, caches. The long runs are those of docs/trust.md."""

from __future__ import annotations

import gc
import os
import runpy
import sys
import warnings
from pathlib import Path
from typing import Any, Dict, List

import pytest

from cflow_torch.data.catalog import DATA_SETS, find_sources, open_log
from cflow_torch.data.log import window
from cflow_torch.types import CFlowError

SCRIPT = Path(__file__).parents[2] / "scripts" / "leaks.py"
COUNTED = ("files", "threads", "objects", "tensors", "cached")  # memory moves by itself in so few windows

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs Linux's /proc")


@pytest.fixture(scope="module")
def leaks() -> Dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


@pytest.mark.parametrize("what", ["door", "files", "worker"])
def test_nothing_piles_up(leaks: Dict[str, Any], tmp_path: Path, what: str) -> None:
    windows = {
        "door": lambda: leaks["door"]("paper"),
        "files": lambda: leaks["files"]("paper", tmp_path),
        "worker": lambda: leaks["worker"]("paper", tmp_path, 60),
    }[what]()
    for number in range(1, 58):  # both looks come when a log is done
        next(windows)
        if number == 9:
            early = leaks["look"]()
    late = leaks["look"]()
    grown = {name: late[name] - early[name] for name in COUNTED}
    assert grown["files"] <= 1 and grown["threads"] <= 0 and grown["tensors"] <= 2 and grown["cached"] <= 8, grown
    assert grown["objects"] < 45, f"less than one for a window: {grown}"


def test_growth_is_found(leaks: Dict[str, Any]) -> None:
    """The script would notice a file that stays open, and a list that grows."""
    kept: List[Any] = []

    def leaking() -> Any:
        while True:
            kept.append(open(os.devnull))  # noqa: SIM115
            kept.append([len(kept)])
            yield

    found = leaks["growth"](leaks["watch"](leaking(), 8, 60))
    assert found["files"]["per_window"] == pytest.approx(1) and found["objects"]["per_window"] > 0.9
    for file in kept[::2]:
        file.close()


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["av2", "nuscenes", "truckscenes", "waymo", "aevascenes"])
def test_every_reader_closes_its_files(tmp_path: Path, profile: str, leaks: Dict[str, Any]) -> None:
    """Also those that turn out to be broken, one file after the other."""
    from cflow_torch.simulator.benchmark import benchmark_logs, format_of

    try:
        benchmark_logs(tmp_path, profile, [0], 3)
    except CFlowError as error:
        pytest.skip(str(error))
    chosen = format_of(profile)
    (root,) = [folder for folder in tmp_path.iterdir() if folder.is_dir()]
    settings = {"check": False, **chosen.settings}
    files = sorted(file for file in root.rglob("*") if file.is_file())
    unclosed: List[str] = []

    def look_at_all() -> None:
        try:
            for source in find_sources(chosen.data_set, root):
                log = open_log(chosen.data_set, source, **settings)
                window(log, 0)
                log.labels(0)
                if hasattr(log, "__exit__"):
                    log.__exit__(None, None, None)
        except (CFlowError, OSError):
            pass

    hook, sys.unraisablehook = sys.unraisablehook, lambda found: unclosed.append(str(found.exc_value))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", ResourceWarning)
            look_at_all()
            gc.collect()
            before = len(os.listdir("/proc/self/fd"))
            for file in files[:40]:
                whole = file.read_bytes()
                file.write_bytes(whole[: len(whole) // 2])
                look_at_all()
                file.write_bytes(whole)
            look_at_all()
            gc.collect()
            after = len(os.listdir("/proc/self/fd"))
    finally:
        sys.unraisablehook = hook
    assert not unclosed, unclosed
    assert after <= before + 4, "Waymo keeps its last four"
    assert chosen.data_set in DATA_SETS
