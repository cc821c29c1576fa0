"""Engine `ray`: worker processes are Ray actors, on this machine or on a cluster."""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import ModuleType
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.dispatch import WorkerDied, dispatch
from cflow_torch.fleet.job import Event, Job, Unit
from cflow_torch.fleet.machine import AUTO, Layout
from cflow_torch.fleet.manifest import MANIFEST, make_identity
from cflow_torch.fleet.work import describe
from cflow_torch.fleet.worker_process import Step, WorkerProcess
from cflow_torch.types import CFlowError

# Only names and outcomes are kept there; Ray takes 30 % of the memory if it is not told.
_OBJECT_STORE_BYTES = 200 * 2**20


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
    """Do all units.

    Names go in and outcomes come out, a few kB each: workers read and write for themselves. On a cluster of several
    machines all of them must reach data and output under the same names (a shared file system, an object store) and
    have the same versions of this package, torch and numpy; a node that does not is refused.

    Args:
        job: the run; its folder is claimed already (`manifest.claim_folder`).
        units: numbered as in `split`.
        layout: one worker per device; those that the cluster has no room for begin when it has. Which GPU is Ray's
            choice.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        address: None = start a cluster in this process, and end it; "auto" or "HOST:PORT" = join the one that this
            machine is part of. A caller that is connected already stays so.
        num_cpus: what a worker takes from the cluster; "auto": 1, nothing with a GPU.
        num_gpus: likewise, fractions allowed; "auto": 1 if the device is a GPU.
        retries: how often a unit, then each of its frames by itself, is done again after a worker died on it.

    Yields:
        What happens, as it happens. A worker that dies is replaced, and its unit done again, see `dispatch`.

    Raises:
        CFlowError: no Ray, no cluster, no room for one worker, a worker that cannot begin; a setting out of range.
    """
    if isinstance(retries, bool) or not isinstance(retries, int) or retries < 0:
        raise CFlowError(f"engine.retries={retries!r}: give a whole number of at least 0")
    if not units:
        return
    try:
        import ray
    except ImportError as error:
        raise CFlowError(f"engine=ray needs Ray ({error}): pip install ray") from None
    is_gpu = layout.devices[0].startswith("cuda")
    needs = {
        "CPU": _number("num_cpus", num_cpus, int(not is_gpu)),
        "GPU": _number("num_gpus", num_gpus, int(is_gpu)),
    }
    output = as_path(job.output)
    if not is_remote(output):  # a worker may be in another folder
        job = replace(job, output=str(output.absolute()))
    count = min(len(layout.devices), len(units))
    used = sorted(set(layout.devices)) if is_gpu else []
    if address is None and used not in ([], ["cuda"], [f"cuda:{k}" for k in range(len(used))]):
        # Ray gives out the GPUs of a machine from the first on.
        raise CFlowError(f"engine=ray cannot choose {', '.join(used)}: set CUDA_VISIBLE_DEVICES, and give device=cuda")
    with _cluster(ray, address, count, needs, len(used)):
        _check_room(ray, needs)
        actor = ray.remote(_Actor).options(num_cpus=needs["CPU"], num_gpus=needs["GPU"])
        device = "cuda" if is_gpu else layout.devices[0]  # Ray shows a worker its own GPUs only
        arguments = (os.getcwd(), job, device)
        yield from dispatch([_Handle(ray, actor, arguments) for _ in range(count)], units, stop, retries)


class _Actor:
    """Lives in a process of Ray, maybe on another machine.

    Args:
        folder: what the driver works in.
        job: the run.
        more: of `WorkerProcess`.
    """

    def __init__(self, folder: str, job: Job, *more: Any) -> None:
        self._folder, self._job, self._more = folder, job, more

    def begin(self) -> None:
        import ray

        job, node = self._job, ray.util.get_node_ip_address()
        if make_identity(job.config, job.reader, job.settings, job.contents)["hash"] != job.identity:
            raise CFlowError(f"node {node} has other versions of cflow_torch, torch or numpy than this run began with")
        if not (as_path(job.output) / MANIFEST).exists():
            raise CFlowError(f"node {node} does not see {job.output}: the output must be reachable everywhere")
        with suppress(OSError):  # relative names of data mean the same as in the driver
            os.chdir(self._folder)
        self._process = WorkerProcess(job, *self._more)

    def step(self, unit: Unit, stop: bool) -> Step:
        return self._process.step(unit, stop)


class _Handle:
    """See `dispatch.Handle`."""

    def __init__(self, ray: ModuleType, actor: Any, arguments: Sequence[Any]) -> None:
        self._ray, self._class, self._arguments = ray, actor, arguments
        self._actor: Any = None

    def begin(self) -> Future:
        if self._actor is None:
            self._actor = self._class.remote(*self._arguments)
        return self._actor.begin.remote().future()  # type: ignore[no-any-return]

    def step(self, unit: Unit, stop: bool) -> Future:
        return self._actor.step.remote(unit, stop).future()  # type: ignore[no-any-return]

    def result(self, call: Future) -> Any:
        try:
            return call.result()
        except self._ray.exceptions.RayTaskError as error:
            raise (error.cause or error) from None
        except self._ray.exceptions.RayError as error:
            self.close()
            raise WorkerDied(f"with Ray's {type(error).__name__}") from error

    def close(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None:
            with suppress(Exception):  # the cluster is gone: so is the worker
                self._ray.kill(actor)


@contextmanager
def _cluster(
    ray: ModuleType, address: str | None, workers: int, needs: dict[str, float], num_gpus: int
) -> Iterator[None]:
    """Connected to a cluster. `ray.init` takes SIGTERM for itself; it is given back."""
    if ray.is_initialized():
        yield
        return
    settings: dict[str, Any] = {"address": address}
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody is told
        settings = {
            "address": "local",
            "num_cpus": max(1, math.ceil(workers * needs["CPU"])),
            "num_gpus": num_gpus,
            "object_store_memory": _OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(logging_level=logging.ERROR, **settings)
    except Exception as error:
        where = "a Ray cluster of this process" if address is None else f"engine.address={address}"
        raise CFlowError(f"{where}: no connection ({describe(error)})") from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)
    try:
        yield
    finally:
        ray.shutdown()  # also ends a cluster of this process


def _check_room(ray: ModuleType, needs: dict[str, float]) -> None:
    """Some node could have a worker, once others leave it room."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in nodes):
        has = "; ".join(", ".join(f"{node.get(name, 0.0):g} {name}" for name in needs) for node in nodes)
        need = ", ".join(f"{need:g} {name}" for name, need in needs.items())
        raise CFlowError(
            f"no node of the Ray cluster has room for a worker of {need} (they have {has}): "
            "give fewer engine.num_cpus or engine.num_gpus, or start such a node first"
        )


def _number(name: str, value: Any, default: float) -> float:
    if value == AUTO:
        return default
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < math.inf:
        raise CFlowError(f"engine.{name}={value!r}: give a number of at least 0, or {AUTO}")
    return value
