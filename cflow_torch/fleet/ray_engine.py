"""Engine `ray`: the worker processes are Ray actors, on this machine or on a cluster."""

from __future__ import annotations

import logging
import math
import os
import signal
from contextlib import suppress
from dataclasses import replace
from types import ModuleType
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.fleet.dispatch import dispatch
from cflow_torch.fleet.job import Event, Job, Unit
from cflow_torch.fleet.machine import AUTO, Layout
from cflow_torch.fleet.manifest import make_identity, run_file
from cflow_torch.fleet.processes import ChildProcess, WorkerDied
from cflow_torch.fleet.work import describe, make_worker

_OBJECT_STORE_BYTES = 200 * 2**20  # it holds names and events only; Ray's default is 30 % of the memory


def run_ray(
    job: Job,
    units: Sequence[Unit],
    layout: Layout,
    stop: Callable[[], bool],
    *,
    address: str | None = None,
    num_cpus: Any = AUTO,
    num_gpus: Any = AUTO,
    retries: int = 1,
) -> Iterator[Event]:
    """Do all units with Ray actors, see `run_local`.

    The driver and the workers exchange units and events, a few kB each; workers read and write files themselves. On a
    cluster, all machines must reach data and output under the same names (a shared file system, an object store) and
    have the same versions of cflow_torch, torch and numpy. A node that differs is refused. Workers that do not fit into
    the cluster start when there is room. Ray chooses the GPUs. configs/engine/ray.yaml explains the settings.
    """
    ray = import_optional("ray", "engine=ray needs Ray: pip install ray")
    is_gpu = layout.devices[0].startswith("cuda")
    needs = {
        "CPU": int(not is_gpu) if num_cpus == AUTO else num_cpus,
        "GPU": int(is_gpu) if num_gpus == AUTO else num_gpus,
    }
    if not is_remote(as_path(job.output)):  # workers may run in another folder
        job = replace(job, output=str(as_path(job.output).absolute()))
    used = sorted(set(layout.devices)) if is_gpu else []
    if address is None and used != [f"cuda:{k}" for k in range(len(used))]:
        # Ray hands out the GPUs of a machine in order, from the first one.
        raise CFlowError(f"engine=ray cannot choose {', '.join(used)}: set CUDA_VISIBLE_DEVICES, and give device=cuda")
    settings: dict[str, Any] = {"address": address}
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no reports to Ray's authors
        settings = {
            "address": "local",
            "num_cpus": max(1, math.ceil(len(layout.devices) * needs["CPU"])),
            "num_gpus": len(used),
            "object_store_memory": _OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    _connect(ray, settings)
    try:
        _check_room(ray, needs)
        options = {"num_cpus": needs["CPU"], "num_gpus": needs["GPU"], "max_concurrency": 2}  # `stop` during `run`
        actor = ray.remote(_Actor).options(**options)
        device = "cuda" if is_gpu else "cpu"  # a worker sees only the GPUs that Ray gives it
        processes = [_Process(ray, actor, os.getcwd(), job, device) for _ in layout.devices]
        yield from dispatch(processes, units, stop, retries)
    finally:
        ray.shutdown()  # this also ends a cluster that `ray.init` has started


class _Actor:
    """A worker of the job in a process of Ray, perhaps on another machine; `folder` is the driver's working folder."""

    _stops = False

    def start(self, folder: str, job: Job, device: str) -> None:
        import ray

        node = ray.util.get_node_ip_address()
        if make_identity(job.config, job.reader, job.settings, job.contents)["hash"] != job.identity:
            raise CFlowError(f"node {node} has other versions of cflow_torch, torch or numpy than the driver")
        if not run_file(as_path(job.output), job.identity).exists():
            raise CFlowError(f"node {node} does not see {job.output}: all nodes must reach the output")
        with suppress(OSError):  # relative paths of data must mean the same as in the driver
            os.chdir(folder)
        self._run = make_worker(job, device)

    def run(self, unit: Unit) -> Iterator[Event]:
        yield from self._run(unit, lambda: self._stops)

    def stop(self) -> None:
        self._stops = True


class _Process(ChildProcess):
    """A Ray actor with the interface of a child process."""

    def __init__(self, ray: ModuleType, actor: Any, *arguments: Any) -> None:
        super().__init__(actor.remote, *arguments)
        self._ray = ray
        self._actor: Any = None

    def start(self) -> None:
        self.close()
        self._actor = self._make()
        self._get(self._actor.start.remote(*self._arguments))

    def call(self, *arguments: Any) -> Iterator[Event]:
        for event in self._actor.run.options(num_returns="streaming").remote(*arguments):
            yield self._get(event)

    def stop(self) -> None:
        if self._actor is not None:
            self._actor.stop.remote()

    def close(self) -> None:
        if self._actor is not None:
            with suppress(Exception):  # the actor may have ended with its cluster
                self._ray.kill(self._actor)

    def _get(self, answer: Any) -> Any:
        try:
            return self._ray.get(answer)
        except self._ray.exceptions.RayTaskError as error:
            raise (error.cause or error) from None
        except self._ray.exceptions.RayError as error:
            self.close()
            raise WorkerDied(f"with Ray's {type(error).__name__}") from error


def _connect(ray: ModuleType, settings: dict[str, Any]) -> None:
    """Connect to a cluster. `ray.init` replaces the handler of SIGTERM; we restore it."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(logging_level=logging.ERROR, **settings)
    except Exception as error:
        where = f"engine.address={settings['address']}"
        raise CFlowError(f"{where}: cannot connect to a Ray cluster: {describe(error)}") from error
    finally:
        with suppress(ValueError):  # in another thread
            signal.signal(signal.SIGTERM, before)


def _check_room(ray: ModuleType, needs: dict[str, float]) -> None:
    """Refuse workers that are too large for every node, however idle it is."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in nodes):
        has = "; ".join(", ".join(f"{node.get(name, 0.0):g} {name}" for name in needs) for node in nodes)
        need = ", ".join(f"{need:g} {name}" for name, need in needs.items())
        raise CFlowError(
            f"no node of the Ray cluster has room for a worker of {need} (they have {has}): "
            "give fewer engine.num_cpus or engine.num_gpus, or start such a node first"
        )
