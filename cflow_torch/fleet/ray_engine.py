"""Engine `ray`: the worker processes are Ray actors, on this machine or on a cluster."""

from __future__ import annotations

import logging
import math
import os
import signal
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.fleet.executors import Executor, InlineExecutor, describe_error
from cflow_torch.fleet.job import Job
from cflow_torch.fleet.work import Worker, make_worker
from cflow_torch.setting import AUTO

_OBJECT_STORE_BYTES = 200 * 2**20  # it holds names and events only; Ray's default is 30 % of the memory


@contextmanager
def ray_executors(
    job: Job, devices: Sequence[str], address: str | None = None, num_cpus: Any = AUTO, num_gpus: Any = AUTO
) -> Iterator[list[Executor]]:
    """Engine `ray`: an actor per device, see `local_executors`.

    The driver and the workers exchange parts and events, a few kB each; workers read and write files themselves. On a
    cluster, all machines must reach data and output under the same names (a shared file system, an object store) and
    have the same versions of cflow_torch, torch and numpy. A node that differs is refused. Workers that do not fit into
    the cluster start when there is room. Ray chooses the GPUs. `cli.commands.Ray` explains the settings.
    """
    ray = import_optional("ray", "engine=ray needs Ray (extra ray): pip install ray")
    is_gpu = devices[0].startswith("cuda")
    needs = {
        "CPU": int(not is_gpu) if num_cpus == AUTO else num_cpus,
        "GPU": int(is_gpu) if num_gpus == AUTO else num_gpus,
    }
    if not is_remote(as_path(job.output)):  # workers may run in another folder
        job = replace(job, output=str(as_path(job.output).absolute()))
    used = sorted(set(devices)) if is_gpu else []
    if address is None and used != [f"cuda:{k}" for k in range(len(used))]:
        # Ray hands out the GPUs of a machine in order, from the first one.
        raise CFlowError(f"engine=ray cannot choose {', '.join(used)}: set CUDA_VISIBLE_DEVICES, and give device=cuda")
    settings: dict[str, Any] = {"address": address}
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no reports to Ray's authors
        settings = {
            "address": "local",
            "num_cpus": max(1, math.ceil(len(devices) * needs["CPU"])),
            "num_gpus": len(used),
            "object_store_memory": _OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    _connect(ray, settings)
    try:
        _check_room(ray, needs)
        actor = ray.remote(InlineExecutor).options(num_cpus=needs["CPU"], num_gpus=needs["GPU"])
        # A worker sees only the GPUs that Ray gives it.
        make = partial(make_worker_on_node, os.getcwd(), job, "cuda" if is_gpu else "cpu")
        yield [RayExecutor(ray, actor, make) for _ in devices]
    finally:
        ray.shutdown()  # this also ends a cluster that `ray.init` has started


def make_worker_on_node(folder: str, job: Job, device: str) -> Worker:
    """Make the worker of an actor, perhaps on another machine; `folder` is the driver's working folder."""
    import ray

    node = ray.util.get_node_ip_address()
    if replace(job).identity != job.identity:  # a copy has the versions of this node
        raise CFlowError(f"node {node} has other versions of cflow_torch, torch or numpy than the driver")
    if not as_path(job.output).is_dir():
        raise CFlowError(f"node {node} does not see {job.output}: all nodes must reach the output")
    with suppress(OSError):  # relative paths of data must mean the same as in the driver
        os.chdir(folder)
    return make_worker(job, device)


class RayExecutor(Executor):
    """An actor of Ray. `make` returns its object."""

    def __init__(self, ray: ModuleType, actor: Any, make: Callable[[], Any]) -> None:
        self._ray, self._class, self._make = ray, actor, make
        self._actor: Any = None
        self._is_closed = False

    def call(self, method: str, *arguments: Any) -> Any:
        if self._is_closed:
            raise BrokenExecutor("closed")
        if self._actor is None:
            self._actor = self._class.remote(self._make)
        try:
            return self._ray.get(self._actor.call.remote(method, *arguments))
        except self._ray.exceptions.RayTaskError as error:
            reason = error.cause or error
            if isinstance(reason, BrokenExecutor):
                self._end()
            raise reason from error
        except self._ray.exceptions.RayError as error:
            self._end()
            raise BrokenExecutor(f"Ray's {type(error).__name__}") from error

    def close(self) -> None:
        self._is_closed = True
        self._end()

    def _end(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None:
            with suppress(Exception):  # the actor may have ended with its cluster
                self._ray.kill(actor)


def _connect(ray: ModuleType, settings: dict[str, Any]) -> None:
    """Connect to a cluster. `ray.init` replaces the handler of SIGTERM; we restore it."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(logging_level=logging.ERROR, **settings)
    except Exception as error:
        where = f"engine.address={settings['address']}"
        raise CFlowError(f"{where}: cannot connect to a Ray cluster: {describe_error(error)}") from error
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
