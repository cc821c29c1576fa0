"""Engine `ray`: it writes the bytes of engine `local` and repeats or reports the frames of a dead worker."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Sequence

import pytest
from small_fleet import PAIRS, TWO, make_job, run, tree

from cflow_torch import CFlowError
from cflow_torch.fleet import manifest, ray_engine
from cflow_torch.fleet.job import Job, Part
from cflow_torch.fleet.parallel import run_parallel
from cflow_torch.fleet.ray_engine import make_worker_on_node, ray_executors
from cflow_torch.fleet.work import Worker

pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install ray")


@pytest.mark.slow
def test_equals_the_local_engine_byte_for_byte(fleet, single, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    report = run(fleet, tmp_path, TWO, engine="ray")
    assert (report["exit_status"], report["frames"]["computed"]) == (0, PAIRS)
    assert {"read", "compute", "write"} <= set(report["stages"])
    assert tree(tmp_path) == single
    assert signal.getsignal(signal.SIGTERM) is before


class LethalWorker(Worker):
    """A worker whose process is killed at each part that still has a file next to the output."""

    def run(self, part: Part) -> Any:
        file = Path(self._job.output).parent / f"kills-{Path(part.source).name}-{part.begin}"
        count = int(file.read_text()) if file.exists() else 0
        if count > 0:
            file.write_text(str(count - 1))
            os.kill(os.getpid(), signal.SIGKILL)
        yield from super().run(part)


def make_lethal_worker(folder: str, job: Job, device: str) -> Worker:
    return LethalWorker(job, device)


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_a_part_that_always_kills_is_reported(fleet, single, tmp_path, monkeypatch):
    from ray import cloudpickle

    monkeypatch.setattr(ray_engine, "make_worker_on_node", make_lethal_worker)
    this = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(this)  # Ray's processes cannot import a test
    first, second, _ = (tmp_path / f"kills-{folder.name}-0" for folder in sorted(fleet.iterdir()))
    first.write_text("1")
    second.write_text("1000")
    try:
        report = run(fleet, tmp_path / "out", TWO, engine="ray")
    finally:
        cloudpickle.unregister_pickle_by_value(this)
    assert first.read_text() == "0" and second.read_text() == "998"
    ((_, message),) = report["failures"]
    assert "its worker died again" in message and 0 < report["frames"]["computed"] < PAIRS
    assert tree(tmp_path / "out").items() <= single.items()


def start(devices: Sequence[str], **settings: Any) -> None:
    with ray_executors(make_job(Path("nowhere")), devices, **settings) as executors:
        next(run_parallel(executors, [Part("nothing")], lambda: False))


def test_ray_does_not_choose_a_gpu():
    with pytest.raises(CFlowError, match="CUDA_VISIBLE_DEVICES"):
        start(["cuda:1"])


def test_a_node_with_other_versions_is_refused(tmp_path, monkeypatch):
    from ray import util

    monkeypatch.setattr(util, "get_node_ip_address", lambda: "10.0.0.7")
    job = make_job(tmp_path)
    sent = pickle.loads(pickle.dumps(job))  # to the node
    make_worker_on_node(os.getcwd(), sent, "cpu").close()
    monkeypatch.setattr(manifest, "__version__", "0.0.1")  # of the node
    with pytest.raises(CFlowError, match="node 10.0.0.7 has other versions of cflow_torch"):
        make_worker_on_node(os.getcwd(), sent, "cpu")


@pytest.mark.slow
def test_a_cluster_without_room_and_a_node_that_does_not_see_the_output():
    with pytest.raises(CFlowError, match="no node of the Ray cluster has room for a worker of 0 CPU, 3 GPU"):
        start(["cuda:0"], num_gpus=3)
    with pytest.raises(CFlowError, match="does not see .*nowhere: all nodes must reach the output"):
        start(TWO)
