"""Engine `ray`: Ray Data hands units to actors, on this machine or on a cluster, and brings back what happened."""

from __future__ import annotations

import pickle
import queue
import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any, Callable, Iterator, List, Optional, Sequence, Set

import pyarrow as pa

from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.deaths import Deaths
from cflow_torch.fleet.job import Begun, Done, Event, Failed, Job, Opened, Unit
from cflow_torch.fleet.machine import AUTO, Layout
from cflow_torch.fleet.ray_cluster import Cluster
from cflow_torch.fleet.ray_worker import ASK_S, News, RayWorker
from cflow_torch.fleet.work import describe, source_name
from cflow_torch.types import CFlowError

_POLL_S = 0.2  # how soon a signal is noticed


def run_ray(
    job: Job,
    units: Sequence[Unit],
    layout: Layout,
    stop: Callable[[], bool],
    *,
    address: Optional[str] = None,
    num_cpus: Any = AUTO,
    num_gpus: Any = AUTO,
    retries: int = 1,
) -> Iterator[Event]:
    """Do all units.

    Names go in and outcomes come out, a few kB each: workers read and write for themselves. On a cluster of several
    machines all of them must reach data and output under the same names (a shared file system, an object store) and
    have the same versions of this package, torch and numpy; a node that does not is refused.

    Args:
        job: the run.
        units: numbered as in `split`.
        layout: one worker per device, on a cluster at most as many as it has room for. Which GPU is Ray's choice.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        address: None = start a cluster in this process, and end it; "auto" or "HOST:PORT" = join the one that this
            machine is part of. A caller that is connected already stays so.
        num_cpus: what a worker takes from the cluster; "auto": its threads, nothing with a GPU.
        num_gpus: likewise, fractions allowed; "auto": 1 if the device is a GPU.
        retries: how often a frame is done again after a worker died on it.

    Yields:
        What happens, as it happens. A worker that dies is replaced; what it had in hand is done again, one by one, when
        all else is done. A frame that kills `retries` + 1 workers is `Failed`.

    Raises:
        CFlowError: no Ray, no cluster, no room for one worker, a worker that cannot begin; a setting out of range.
    """
    if isinstance(retries, bool) or not isinstance(retries, int) or retries < 0:
        raise CFlowError(f"engine.retries={retries!r}: give a whole number of at least 0")
    if not units:
        return
    output = as_path(job.output)
    if not is_remote(output):  # a worker may be in another folder
        job = replace(job, output=str(output.absolute()))
    with Cluster(address, min(len(layout.devices), len(units)), layout, num_cpus, num_gpus) as cluster:
        yield from _Rounds(job, units, layout, stop, cluster, retries).run()


@dataclass
class _State:
    """A unit as the driver sees it."""

    unit: Unit
    is_begun: bool = False
    log_id: Optional[str] = None
    in_hand: List[int] = field(default_factory=list)  # frames begun and not settled
    settled: Set[int] = field(default_factory=set)  # frames on disk or failed


class _Rounds:
    """Passes over the units; what is lost with a worker goes into the next pass."""

    def __init__(
        self, job: Job, units: Sequence[Unit], layout: Layout, stop: Callable[[], bool], cluster: Cluster, retries: int
    ) -> None:
        self._job, self._threads, self._stop, self._cluster = job, layout.threads, stop, cluster
        self._most_deaths = retries + 1
        self._deaths = Deaths(self._most_deaths)
        self._states = {unit.number: _State(unit) for unit in units}
        self._idle_rounds = 0  # in a row, in which no unit was begun

    def run(self) -> Iterator[Event]:
        """See `run_ray`."""
        while self._states and not self._stop():
            yield from self._round()
            if self._stop():
                return
            any_begun = any(state.is_begun for state in self._states.values())
            self._idle_rounds = 0 if any_begun or self._ended else self._idle_rounds + 1
            states, self._states = list(self._states.values()), {}
            for state in states:
                yield from self._mourn(state)

    def _round(self) -> Iterator[Event]:
        """All units of now. Those that come to their end leave `_states`."""
        self._ended, told = 0, 0.0
        with self._cluster.flag() as flag:
            actor = RayWorker(self._job, self._cluster.device, self._threads, flag, self._cluster.is_joined)
            rows = _Rows(self._cluster.map(actor, [pickle.dumps(state.unit) for state in self._states.values()]))
            try:
                while True:
                    if self._stop() and not told:
                        told = time.monotonic()
                        flag.set()
                    if (
                        told
                        and time.monotonic() - told > 2 * ASK_S
                        and not any(state.is_begun for state in self._states.values())
                    ):
                        return
                    try:
                        news = rows.get(timeout=_POLL_S)
                    except queue.Empty:
                        continue
                    if news is None:
                        return
                    yield from self._hear(news)
            finally:
                flag.set()
                rows.close()

    def _hear(self, news: News) -> Iterator[Event]:
        if news.refusal is not None:
            raise CFlowError(f"a worker cannot begin: {news.refusal}")
        state = self._states[news.unit]
        state.is_begun = True
        for event in news.events:
            if isinstance(event, Opened):
                state.log_id = event.log_id
            elif isinstance(event, Begun):
                state.in_hand += event.timestamps
            elif isinstance(event, (Done, Failed)) and event.timestamp in state.in_hand:
                state.in_hand.remove(event.timestamp)
                state.settled.add(event.timestamp)
                self._deaths.settle(event.unit)
            yield event
        if news.ended:
            self._ended += 1
            del self._states[news.unit]

    def _mourn(self, state: _State) -> Iterator[Event]:
        """A unit has no end: its worker died. Blame what it had in hand, and do the rest again."""
        unit, name = state.unit, state.log_id or source_name(state.unit.source)
        if not state.is_begun:
            if self._idle_rounds >= self._most_deaths:
                yield Failed(unit.number, name, f"{self._idle_rounds} times all workers died before they began")
            else:
                self._states[unit.number] = _State(unit)
            return
        failed, again = self._deaths.blame(unit, name, state.in_hand, state.settled, "out of memory?")
        yield from failed
        if again is not None:
            self._states[unit.number] = _State(again)


class _Rows:
    """Rows of a data set, read by a thread, so that the main one can look for signals."""

    def __init__(self, batches: Iterator[pa.Table]) -> None:
        self._queue: queue.Queue = queue.Queue()
        self._closed = False
        threading.Thread(target=self._read, args=(batches,), daemon=True).start()

    def get(self, timeout: float) -> Optional[News]:
        """The next row; None at the end.

        Raises:
            queue.Empty: none came in time.
            CFlowError: Ray gave up.
        """
        row = self._queue.get(timeout=timeout)
        if isinstance(row, BaseException):
            raise CFlowError(f"Ray gave up: {describe(row)}") from row
        return row  # type: ignore[no-any-return]

    def close(self) -> None:
        """Nobody reads any more: the thread ends with the next row."""
        self._closed = True

    def _read(self, batches: Iterator[pa.Table]) -> None:
        try:
            for batch in batches:
                for row in batch["news"].to_pylist():
                    self._queue.put(pickle.loads(row))
                if self._closed:
                    return
            self._queue.put(None)
        except BaseException as error:  # whatever it is, the main thread must hear of it
            self._queue.put(error)
