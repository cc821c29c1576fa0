"""Engine `ray`: it writes the bytes of engine `local` and repeats or reports the frames of a dead worker."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any, Callable, Iterator

import pytest
from small_fleet import PAIRS, TWO, make_job, run, tree

from cflow_torch import CFlowError
from cflow_torch.data.av2 import AV2Log
from cflow_torch.fleet import ray_engine
from cflow_torch.fleet.job import Job, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.ray_engine import run_ray

pytest.importorskip("ray", reason="Ray is not installed: pip install ray")


@pytest.mark.slow
def test_equals_the_local_engine_byte_for_byte(fleet: Path, single: dict[str, bytes], tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    report = run(fleet, tmp_path, TWO, engine="ray")
    assert (report["exit_status"], report["frames"]["computed"]) == (0, PAIRS)
    assert {"read", "compute", "write"} <= set(report["stages"])
    assert tree(tmp_path) == single
    assert signal.getsignal(signal.SIGTERM) is before


class LethalActor:
    """A worker that is killed when it reads a frame with a file next to the output. The file contains how often."""

    def __init__(self, folder: str, job: Job, *more: Any) -> None:
        self._folder = Path(job.output).parent / "kills"
        self._actor = ray_engine._Actor(folder, job, *more)  # the real one, because this runs in the worker process

    def start(self) -> None:
        self._actor.start()
        read = self._actor._process._read_one

        def lethal_read(log: Any, index: int) -> Any:
            file = self._folder / f"{log.log_id}.{log.timestamps[index]}"
            count = int(file.read_text()) if file.exists() else 0
            if count > 0:
                file.write_text(str(count - 1))
                os.kill(os.getpid(), signal.SIGKILL)
            return read(log, index)

        self._actor._process._read_one = lethal_read  # type: ignore[method-assign]

    def step(self, unit: Unit, stop: bool) -> Any:
        return self._actor.step(unit, stop)


@pytest.fixture
def kills(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int, int], Path]]:
    """Function (index of a frame, count) that makes a frame of the longest log deadly; returns its file."""
    from ray import cloudpickle

    monkeypatch.setattr(ray_engine, "_Actor", LethalActor)
    (tmp_path / "kills").mkdir()
    this = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(this)  # Ray's processes cannot import a test

    def mark(index: int, count: int) -> Path:
        log = AV2Log(sorted(fleet.iterdir())[1])
        file = tmp_path / "kills" / f"{log.log_id}.{log.timestamps[index]}"
        file.write_text(str(count))
        return file

    yield mark
    cloudpickle.unregister_pickle_by_value(this)


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_a_frame_that_always_kills_is_reported(
    fleet: Path, single: dict[str, bytes], tmp_path: Path, kills: Any
) -> None:
    once, always = kills(1, 1), kills(3, 1000)
    report = run(fleet, tmp_path / "out", TWO, engine="ray", retries=1)
    assert once.read_text() == "0" and 1000 - int(always.read_text()) in (3, 4)
    ((name, message),) = report["failures"]
    assert name == always.name.replace(".", "/") and "2 workers died on it" in message
    assert report["frames"]["computed"] == PAIRS - 1
    assert tree(tmp_path / "out") == {file: c for file, c in single.items() if file != f"{name}.feather"}


def start(layout: Layout, **settings: Any) -> None:
    next(run_ray(make_job(Path("nowhere")), [Unit(0, "nothing")], layout, lambda: False, **settings))


@pytest.mark.parametrize(
    "layout, settings, message",
    [
        (TWO, {"retries": -1}, "engine.retries"),
        (Layout(("cuda:1",), 1), {}, "CUDA_VISIBLE_DEVICES"),
    ],
)
def test_bad_settings_are_errors(layout: Layout, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(CFlowError, match=message):
        start(layout, **settings)


@pytest.mark.slow
def test_a_cluster_without_room_and_a_node_that_does_not_see_the_output() -> None:
    with pytest.raises(CFlowError, match="no node of the Ray cluster has room for a worker of 0 CPU, 3 GPU"):
        start(Layout(("cuda:0",), 1), num_gpus=3)
    with pytest.raises(CFlowError, match="does not see .*nowhere: all nodes must reach the output"):
        start(TWO)
