"""A Ray cluster, started or joined, as far as engine `ray` needs it: room for workers, a data set over them, a flag."""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
import threading
import warnings
from contextlib import suppress
from types import ModuleType
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence

import pyarrow as pa

from cflow_torch.fleet.machine import AUTO, Layout
from cflow_torch.fleet.work import describe
from cflow_torch.types import CFlowError

# Only names and outcomes are kept there; Ray takes 30 % of the memory if it is not told.
_OBJECT_STORE_BYTES = 200 * 2**20
_MOST_BLOCKS = 10_000  # tasks of a data set; with more units, a task has several
# Settings of Ray Data. A row is sent as soon as it is there; a task that died is the engine's business.
_CONTEXT = {
    "enable_progress_bars": False,
    "enable_operator_progress_bars": False,
    "print_on_execution_start": False,
    "target_max_block_size": 1,
    "max_errored_blocks": -1,
}


class Cluster:
    """Open while a run lasts.

    Args:
        address: None = a new one in this process, "auto" or "HOST:PORT" = join one.
        workers: wanted.
        layout: of the run.
        num_cpus: see `run_ray`.
        num_gpus: see `run_ray`.

    Raises:
        CFlowError: no Ray, no cluster, no room for one worker; a setting out of range.
    """

    def __init__(self, address: Optional[str], workers: int, layout: Layout, num_cpus: Any, num_gpus: Any) -> None:
        if address is not None and address.startswith("ray://"):
            raise CFlowError(
                f"engine.address={address}: Ray Data needs a driver inside the cluster; run this command there "
                "(ray job submit ...) with engine.address=auto"
            )
        self._ray = import_ray()
        is_gpu = layout.devices[0].startswith("cuda")
        self.device = "cuda" if is_gpu else layout.devices[0]  # Ray shows a worker its own GPUs only
        self._needs = {
            "CPU": (0.0 if is_gpu else float(layout.threads)) if num_cpus == AUTO else _number("num_cpus", num_cpus),
            "GPU": float(is_gpu) if num_gpus == AUTO else _number("num_gpus", num_gpus),
        }
        if is_gpu and not self._needs["GPU"]:
            raise CFlowError("engine.num_gpus=0: with a GPU as device, give each worker at least a share of one")
        self._address, self._wanted, self._devices = address, workers, layout.devices
        self.is_joined = address is not None or self._ray.is_initialized()
        if is_gpu and not self.is_joined:
            _check_first_gpus(layout.devices)

    def __enter__(self) -> Cluster:
        self._was_connected = self._ray.is_initialized()
        if not self._was_connected:
            self._connect()
        try:
            self._workers = self._room()
            context = self._ray.data.DataContext.get_current()
            self._before = {name: getattr(context, name) for name in _CONTEXT if hasattr(context, name)}
            self._quiet = {handler: handler.level for handler in logging.getLogger("ray.data").handlers}
            _assign(context, {name: _CONTEXT[name] for name in self._before})
            for handler in self._quiet:
                if isinstance(handler, logging.StreamHandler):  # the file of the session keeps everything
                    handler.setLevel(logging.CRITICAL)
        except BaseException:
            self._disconnect()
            raise
        return self

    def __exit__(self, *_: Any) -> None:
        _assign(self._ray.data.DataContext.get_current(), self._before)
        for handler, level in self._quiet.items():
            handler.setLevel(level)
        self._disconnect()

    def map(self, function: Any, units: Sequence[bytes]) -> Iterator[pa.Table]:
        """Tables of what a callable makes of `units`, in no order, as they come. Each worker has a copy of it.

        A unit whose worker dies has no more rows; it is not tried again.
        """
        data = self._ray.data
        rows = data.from_items([{"unit": unit} for unit in units], override_num_blocks=min(len(units), _MOST_BLOCKS))
        needs: Dict[str, Any] = {"num_cpus": self._needs["CPU"], "num_gpus": self._needs["GPU"]}
        if self._needs["GPU"]:
            needs = {name: need for name, need in needs.items() if need}  # old versions want one of the two
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the two settings of retries
            result = rows.map_batches(
                _Call,
                fn_constructor_args=(function,),
                batch_size=1,
                batch_format="pyarrow",
                compute=data.ActorPoolStrategy(size=min(self._workers, len(units)), max_tasks_in_flight_per_actor=1),
                max_restarts=-1,
                max_task_retries=0,
                **needs,
            )
        return iter(result.iter_batches(batch_size=None, batch_format="pyarrow", prefetch_batches=0))

    def flag(self) -> Flag:
        """A new flag that workers can see."""
        return Flag(self._ray.remote(num_cpus=0)(_FlagActor).remote())

    def _connect(self) -> None:
        """`ray.init` puts its own handler in place of SIGTERM's; ours comes back."""
        in_main = threading.current_thread() is threading.main_thread()
        before = signal.getsignal(signal.SIGTERM)
        try:
            if self.is_joined:
                self._ray.init(address=self._address, logging_level=logging.ERROR)
            else:
                os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody is told
                self._ray.init(
                    address="local",
                    num_cpus=max(1, math.ceil(self._wanted * self._needs["CPU"])),
                    num_gpus=len(set(self._devices)) if self._needs["GPU"] else 0,
                    object_store_memory=_OBJECT_STORE_BYTES,
                    include_dashboard=False,
                    logging_level=logging.ERROR,
                )
        except Exception as error:
            where = f"engine.address={self._address}" if self.is_joined else "a Ray cluster of this process"
            raise CFlowError(f"{where} cannot be had: {describe(error)}") from error
        finally:
            if in_main:
                signal.signal(signal.SIGTERM, before)

    def _disconnect(self) -> None:
        """Also ends a cluster of this process."""
        if not self._was_connected:
            self._ray.shutdown()

    def _room(self) -> int:
        """Workers that the cluster can have at once, at most as many as wanted."""
        needs = {name: need for name, need in self._needs.items() if need}
        nodes: List[Dict[str, float]] = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        room = 0
        for node in nodes:
            room += min([self._wanted] + [int(node.get(name, 0) / need + 1e-6) for name, need in needs.items()])
        if room == 0:
            need = " and ".join(f"{need:g} {name}" for name, need in needs.items())
            have = "; ".join(", ".join(f"{node.get(name, 0):g} {name}" for name in needs) for node in nodes)
            raise CFlowError(
                f"no node of the Ray cluster has room for a worker of {need} (they have {have}): "
                "give fewer engine.threads, engine.num_cpus or engine.num_gpus, or start such a node first"
            )
        if room < self._wanted:
            print(f"the Ray cluster has room for {room} of {self._wanted} workers", file=sys.stderr)
        return min(room, self._wanted)


class Flag:
    """Set by the driver, seen by all workers."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __enter__(self) -> Flag:
        return self

    def __exit__(self, *_: Any) -> None:
        self.set()

    def set(self) -> None:
        """Does not wait."""
        with suppress(Exception):  # the cluster is gone: so are the workers
            self._actor.set.remote()

    def is_set(self) -> bool:
        """False if nobody knows any more."""
        import ray

        try:
            return bool(ray.get(self._actor.is_set.remote(), timeout=10))
        except Exception:
            return False


class _FlagActor:
    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


class _Call:
    """The class that Ray Data wants of a function with a state."""

    def __init__(self, function: Callable[[pa.Table], Iterator[pa.Table]]) -> None:
        self._function = function

    def __call__(self, batch: pa.Table) -> Iterator[pa.Table]:
        yield from self._function(batch)


def import_ray() -> ModuleType:
    """`ray` with `ray.data`.

    Raises:
        CFlowError: it is not installed.
    """
    try:
        import ray
        import ray.data
    except ImportError as error:
        raise CFlowError(f"engine=ray needs Ray ({error}): pip install 'ray[data]>=2.10,<2.64'") from None
    return ray  # type: ignore[no-any-return]


def _assign(target: Any, values: Dict[str, Any]) -> None:
    for name, value in values.items():
        setattr(target, name, value)


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 <= number < math.inf:
        raise CFlowError(f"engine.{name}={value!r}: give a number of at least 0, or {AUTO}")
    return number


def _check_first_gpus(devices: Sequence[str]) -> None:
    """Ray gives out the GPUs of a machine from the first on."""
    used = sorted(set(devices))
    if used not in (["cuda"], [f"cuda:{k}" for k in range(len(used))]):
        raise CFlowError(f"Ray cannot be told to use {', '.join(used)}: set CUDA_VISIBLE_DEVICES, and give device=cuda")
