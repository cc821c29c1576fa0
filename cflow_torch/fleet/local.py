"""Engine `local`: worker processes of this machine, fed, watched and replaced by one parent."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, Callable, Deque, Iterator, List, Optional, Sequence, Set

import pyarrow
import torch

from cflow_torch.fleet.deaths import Deaths
from cflow_torch.fleet.job import Begun, Event, Failed, Job, Opened, Unit
from cflow_torch.fleet.local_worker import END, Ready, Refusal, serve, use_threads
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.progress import say
from cflow_torch.fleet.work import Worker, describe, source_name
from cflow_torch.types import CFlowError

# A frame that two workers died on is given up; so is a unit that two died on before its first frame.
_MOST_DEATHS = 2
_MOST_STILLBORN = 3  # workers that died one after the other before they could begin: so would all others
_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # that workers have for the frames in hand after a signal; schedulers kill after 30 s and more

# Silence is counted look by look, each for so many seconds at most: this process may itself have been stopped for an
# hour (Ctrl-Z, a lid that was shut).
_LONGEST_LOOK_S = 5 * _POLL_S
_LAST_BREATH_S = 10.0  # that a killed process may take to die


def run_local(
    job: Job, units: Sequence[Unit], layout: Layout, stop: Callable[[], bool], *, timeout: float = 600.0
) -> Iterator[Event]:
    """Do all units.

    Args:
        job: the run.
        units: numbered as in `split`.
        layout: one worker per device. A single worker is this very process.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        timeout: seconds after which a worker that has given no sign is killed. A single worker is not watched.

    Raises:
        CFlowError: no worker can begin; a timeout that is not above 0.

    Yields:
        What happens, as it happens. A worker that is killed is replaced and its frames done again, one by one; a frame
        that kills two workers is `Failed`.
    """
    if isinstance(timeout, bool) or not isinstance(timeout, (int, float)) or not timeout > 0:
        raise CFlowError(f"engine.timeout={timeout!r}: give seconds above 0")
    if not units:
        return
    if len(layout.devices) == 1:
        threads, cpus = torch.get_num_threads(), pyarrow.cpu_count()
        worker = Worker(job, layout.devices[0])
        use_threads(layout.threads, layout.threads)
        try:
            for unit in units:
                if stop():
                    break
                try:
                    yield from worker.run(unit, stop)
                except CFlowError:  # no frame can be computed any more
                    raise
                except Exception as error:  # no memory for a thread, say
                    yield Failed(unit.number, source_name(unit.source), describe(error))
        finally:
            worker.close()
            use_threads(threads, cpus)
    else:
        yield from _Crew(job, units, layout, stop, timeout).run()


@dataclass
class _Hand:
    """A worker as its parent sees it."""

    device: str
    process: Any
    pipe: Connection
    is_ready: bool = False
    unit: Optional[Unit] = None
    log_id: Optional[str] = None
    in_hand: List[int] = field(default_factory=list)  # frames begun and not settled
    settled: Set[int] = field(default_factory=set)  # frames of the unit that are on disk or failed
    silent: float = 0.0  # seconds since it gave its last sign, or was given its unit
    killed: Optional[float] = None  # when it was killed because it gave no sign


class _Crew:
    """Hands out units, gathers events, replaces the dead."""

    def __init__(
        self, job: Job, units: Sequence[Unit], layout: Layout, stop: Callable[[], bool], timeout: float
    ) -> None:
        self._job, self._layout, self._stop, self._timeout = job, layout, stop, timeout
        self._pending: Deque[Unit] = deque(units)
        self._deaths = Deaths(_MOST_DEATHS)
        self._stillborn = 0  # in a row
        self._hands: List[_Hand] = []

    def run(self) -> Iterator[Event]:
        """See `run_local`."""
        try:
            self._hands = [self._hire(device) for device in self._layout.devices[: len(self._pending)]]
            told, looked = 0.0, time.monotonic()
            while True:
                passed = min(time.monotonic() - looked, _LONGEST_LOOK_S)
                looked = time.monotonic()
                if self._stop() and not told:
                    told = time.monotonic()
                    self._pending.clear()
                    for hand in self._hands:
                        self._send(hand, END)
                for hand in self._hands:
                    if hand.unit is None and self._pending:
                        hand.unit, hand.log_id, hand.in_hand, hand.settled = self._pending.popleft(), None, [], set()
                        hand.silent = 0.0
                        self._send(hand, hand.unit)
                if all(hand.unit is None for hand in self._hands):
                    break
                ready = set(wait([hand.pipe for hand in self._hands], timeout=_POLL_S))
                for hand in list(self._hands):
                    hand.silent += passed
                    if hand.pipe in ready:
                        yield from self._hear(hand)
                    elif hand.unit is not None and self._is_lost(hand, told):
                        yield from self._mourn(hand)
        except BaseException:
            for hand in self._hands:
                hand.process.kill()
            raise
        finally:
            for hand in self._hands:
                self._send(hand, END)
                hand.process.join(None if hand.killed is None else _LAST_BREATH_S)
                hand.pipe.close()

    def _hire(self, device: str) -> _Hand:
        context = multiprocessing.get_context("spawn")  # fork and threads, or CUDA, do not go together
        here, there = context.Pipe()
        process = context.Process(target=serve, args=(self._job, device, self._layout.threads, there), daemon=True)
        try:
            process.start()
        except OSError as error:
            raise CFlowError(f"no worker process can be started ({error}): give fewer engine.workers") from error
        there.close()  # the worker's end closes with the worker
        return _Hand(device, process, here)

    @staticmethod
    def _send(hand: _Hand, message: Any) -> None:
        with suppress(OSError):  # it died: `_hear` will find out
            hand.pipe.send(message)

    def _is_lost(self, hand: _Hand, told: float) -> bool:
        """Kill a worker that gives no sign (a file system or a GPU that hangs), or that does not end when it is told.

        Returns:
            Whether it does not even die: what it waits for never comes.
        """
        now = time.monotonic()
        if hand.killed is not None:
            return now - hand.killed > _LAST_BREATH_S
        if hand.silent > self._timeout or (told and now - told > _GRACE_S):
            hand.killed = now
            hand.process.kill()
        return False

    def _hear(self, hand: _Hand) -> Iterator[Event]:
        """One message of a worker, or its end."""
        hand.silent = 0.0
        try:
            event = hand.pipe.recv()
        except (EOFError, OSError):
            yield from self._mourn(hand)
            return
        if event is None:  # the unit is at its end
            hand.unit = None
        elif isinstance(event, Ready):
            hand.is_ready, self._stillborn = True, 0
        elif isinstance(event, Refusal):
            self._dismiss(hand, event.message)
        else:
            if isinstance(event, Opened):
                hand.log_id = event.log_id
            elif isinstance(event, Begun):
                hand.in_hand += event.timestamps
            elif event.timestamp in hand.in_hand:
                hand.in_hand.remove(event.timestamp)
                hand.settled.add(event.timestamp)
                self._deaths.settle(event.unit)
            yield event

    def _dismiss(self, hand: _Hand, message: str) -> None:
        """A worker cannot begin (its GPU is gone): the others do its work. Raises if it was the last."""
        self._let_go(hand)
        self._go_on_without(message)
        if hand.unit is not None and not self._stop():
            self._pending.appendleft(hand.unit)

    def _go_on_without(self, message: str) -> None:
        if not self._hands:
            raise CFlowError(message)
        say(f"{message}; going on with {len(self._hands)} of {len(self._layout.devices)} workers")

    def _let_go(self, hand: _Hand) -> None:
        hand.process.join(_LAST_BREATH_S)
        hand.pipe.close()
        self._hands.remove(hand)

    def _mourn(self, hand: _Hand) -> Iterator[Event]:
        """A worker died, or ended when it was told to: another takes its place if there is work for it."""
        self._let_go(hand)
        yield from self._blame(hand)
        if not hand.is_ready:
            self._stillborn += 1
        if self._stillborn >= _MOST_STILLBORN and not self._stop():
            self._go_on_without(
                f"{self._stillborn} workers one after the other died before they could begin, the last one "
                f"{self._how(hand)} (give fewer engine.workers if it is the memory, else see above)"
            )
        elif self._pending and not self._stop():
            try:
                self._hands.append(self._hire(hand.device))
            except CFlowError as error:
                self._go_on_without(str(error))

    def _blame(self, hand: _Hand) -> Iterator[Event]:
        """Whatever a dead worker had in hand may be why; the rest of its unit is to be done again."""
        unit = hand.unit
        if unit is None:
            return
        again: Optional[Unit] = unit
        if hand.is_ready:
            how = f"the last one {self._how(hand)}"
            name = hand.log_id or source_name(unit.source)
            failed, again = self._deaths.blame(unit, name, hand.in_hand, hand.settled, how)
            yield from failed
        if again is not None and not self._stop():
            self._pending.appendleft(again)

    def _how(self, hand: _Hand) -> str:
        """A worker died."""
        if hand.killed is not None:
            return f"after {self._timeout:g} s without a sign"
        status = hand.process.exitcode
        if status is not None and status < 0:
            name = next((known.name for known in signal.Signals if known == -status), f"signal {-status}")
            return f"by {name}" + (" (out of memory?)" if -status == signal.SIGKILL else "")
        return f"with status {status}"
