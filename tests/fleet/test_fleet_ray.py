"""Engine `ray`: the same bytes as engine `local`; what a dying worker had in hand is done again, or reported."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any, Dict, Iterator, List

import pytest

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.fleet import ray_engine
from cflow_torch.fleet.job import Done, Job, Unit, split
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.manifest import claim_folder, make_identity
from cflow_torch.fleet.ray_engine import run_ray
from cflow_torch.fleet.ray_worker import RayWorker
from cflow_torch.fleet.run import run_fleet
from cflow_torch.fleet.shard import Shard
from cflow_torch.fleet.work import Worker
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

pytest.importorskip("ray.data", reason="Ray is not installed: pip install 'ray[data]>=2.10,<2.64'")

CONFIG = make_config("paper", pixel_sizes=(0.4,), num_history=1)
SETTINGS: Dict[str, Any] = {"find_ground": None, "odometry": False}
TWO = Layout(("cpu", "cpu"), threads=1, batch=2)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs, of five and seven pairs. Their time stamps are the same."""
    root = tmp_path_factory.mktemp("logs")
    for seed, num_sweeps in ((1, 6), (2, 8)):
        write_av2_log(make_drive(seed=seed, num_sweeps=num_sweeps, profile="demo"), root)
    return root


def make_job(output: Path) -> Job:
    identity = make_identity(CONFIG, "av2", SETTINGS)
    claim_folder(output, identity, resume=True, overwrite=False, alone=True)
    return Job(CONFIG, identity["hash"], "av2", SETTINGS, str(output), batch=TWO.batch, check=False)


def run(logs: Path, output: Path, engine: str, layout: Layout = TWO, **settings: Any) -> Dict[str, Any]:
    return run_fleet(make_job(output), find_sources("av2", logs), layout, Shard(), engine, **settings)


def tree(output: Path) -> Dict[str, bytes]:
    """Name -> content of all files but the report."""
    files = (file for file in output.rglob("*") if file.is_file() and "reports" not in file.parts)
    return {str(file.relative_to(output)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def expected(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Dict[str, bytes]:
    """What engine `local` makes, in this process."""
    output = tmp_path_factory.mktemp("local") / "flow"
    assert run(logs, output, "local", Layout(("cpu",), 1, TWO.batch))["frames"]["computed"] == 12
    return tree(output)


def test_equals_the_local_engine_byte_for_byte(logs, expected, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    report = run(logs, tmp_path / "flow", "ray")
    assert (report["exit_status"], report["frames"]["computed"]) == (0, 12)
    assert {"read", "compute", "write"} <= set(report["stages"])
    assert tree(tmp_path / "flow") == expected
    assert signal.getsignal(signal.SIGTERM) is before


def stamp_of(logs: Path, index: int) -> int:
    """Time stamp of a sweep of the longer log."""
    opened = [open_log("av2", source, check=False) for source in find_sources("av2", logs)]
    return max((log.timestamps for log in opened), key=len)[index]


class _Lethal:
    """The method, but frames named in a folder kill the process, as often as is written there."""

    def __init__(self, job: Job) -> None:
        self._model = make_model(job.config, "cpu")
        self._folder = kills(Path(job.output))

    def __call__(self, windows: Any) -> Any:
        for sweeps in windows:
            file = self._folder / str(sweeps.pc0.timestamp_ns)
            if file.exists() and int(file.read_text()) > 0:
                file.write_text(str(int(file.read_text()) - 1))
                os.kill(os.getpid(), signal.SIGKILL)
        return self._model(windows)


class LethalWorker(RayWorker):
    def _new_worker(self) -> Worker:
        return Worker(self._job, self._device, model=_Lethal(self._job))


def kills(output: Path) -> Path:
    return output.parent / "kills"


@pytest.fixture
def lethal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Where to say which frames kill."""
    from ray import cloudpickle

    monkeypatch.setattr(ray_engine, "RayWorker", LethalWorker)
    kills(tmp_path / "flow").mkdir()
    this = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(this)  # Ray's processes cannot import a test
    yield kills(tmp_path / "flow")
    cloudpickle.unregister_pickle_by_value(this)


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_its_frames_done_again(logs, expected, tmp_path, lethal):
    (lethal / str(stamp_of(logs, 5))).write_text("1")
    report = run(logs, tmp_path / "flow", "ray")
    assert [file.read_text() for file in lethal.iterdir()] == ["0"]
    assert (report["exit_status"], report["frames"]["total"], report["failures"]) == (0, 12, [])
    assert tree(tmp_path / "flow") == expected


@pytest.mark.slow
def test_a_frame_that_always_kills_is_reported_and_stops_no_other(logs, expected, tmp_path, lethal):
    deadly = stamp_of(logs, 6)
    (lethal / str(deadly)).write_text("1000")
    report = run(logs, tmp_path / "flow", "ray", retries=1)
    # Among others it is a suspect, alone it is found guilty, with the second death at the latest.
    assert 1000 - int((lethal / str(deadly)).read_text()) in (2, 3)
    assert report["exit_status"] == 1
    ((name, message),) = report["failures"]
    assert name.endswith(f"/{deadly}") and "workers died on it" in message
    found = tree(tmp_path / "flow")
    missing = set(expected) - set(found)
    assert len(missing) == 1 and missing.pop().endswith(f"{deadly}.feather")
    assert all(expected[file] == content for file, content in found.items())


@pytest.mark.slow
def test_stop_lets_the_frames_in_hand_be_finished(logs, tmp_path, expected):
    job = make_job(tmp_path / "flow")
    seen: List[int] = []
    units = split(Shard().units(find_sources("av2", logs)), 2)
    for event in run_ray(job, units, TWO, lambda: bool(seen)):
        seen.extend([event.timestamp] if isinstance(event, Done) else [])
    written = {name for name in tree(tmp_path / "flow") if name.endswith(".feather")}
    assert 0 < len(seen) < 12 and {int(Path(name).stem) for name in written} == set(seen)
    assert run(logs, tmp_path / "flow", "ray")["frames"]["complete_before"] == len(seen)
    assert tree(tmp_path / "flow") == expected


def begin(layout: Layout, **settings: Any) -> None:
    job = Job(CONFIG, "", "av2", {}, "nowhere")
    next(run_ray(job, [Unit(0, "nothing")], layout, lambda: False, **settings))


@pytest.mark.parametrize(
    "layout, settings, message",
    [
        (TWO, {"retries": -1}, "engine.retries"),
        (TWO, {"num_cpus": "many"}, "engine.num_cpus"),
        (Layout(("cuda:0",), 1, 1), {"num_gpus": 0}, "a share"),
        (TWO, {"address": "ray://127.0.0.1:10001"}, "ray job submit"),
        (Layout(("cuda:1",), 1, 1), {}, "CUDA_VISIBLE_DEVICES"),
    ],
)
def test_bad_settings(layout, settings, message):
    with pytest.raises(CFlowError, match=message):
        begin(layout, **settings)


def test_no_cluster_at_the_address(monkeypatch):
    def refuse(**_: Any) -> None:
        raise ConnectionError("nobody there")

    monkeypatch.setattr("ray.init", refuse)
    with pytest.raises(CFlowError, match="engine.address=auto cannot be had: nobody there"):
        begin(TWO, address="auto")


@pytest.mark.slow
def test_a_cluster_without_room_for_a_worker():
    with pytest.raises(CFlowError, match="no node of the Ray cluster has room for a worker of 3 GPU"):
        begin(Layout(("cuda:0",), 1, 1), num_gpus=3)
