"""What a run takes from its surroundings: its share of the work, the workers of the machine, signals, a terminal."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cflow_torch import CFlowError, make_config
from cflow_torch.fleet import machine, progress
from cflow_torch.fleet.job import Shard, find_shard
from cflow_torch.fleet.machine import choose_batch, choose_devices, usable_cores
from cflow_torch.fleet.progress import Progress, log_line
from cflow_torch.fleet.stop_signal import StopSignal


@settings(deadline=None)  # the first call imports
@given(
    lengths=st.lists(st.integers(0, 40), min_size=1, max_size=12),
    count=st.integers(1, 20),
    workers=st.integers(1, 5),
)
def test_shards_and_parts_cover_every_frame_once(lengths: list[int], count: int, workers: int) -> None:
    seen: list[tuple[int, int]] = []
    for index in range(count):
        parts = Shard(index, count).parts(list(range(len(lengths))), workers)
        seen += [(part.source, frame) for part in parts for frame in part.frames(lengths[part.source])]
    assert sorted(seen) == [(log, frame) for log, length in enumerate(lengths) for frame in range(length)]


def test_a_shard_opens_only_its_own_logs() -> None:
    parts = Shard(1, 3).parts(list("abcdef"))
    assert [(part.source, part.frames(7)) for part in parts] == [("c", range(7)), ("d", range(7))]
    assert Shard().parts([], 2) == []
    parts = Shard(1, 4).parts(list("ab"))
    assert [(part.source, part.frames(8)) for part in parts] == [("a", range(4, 8))]


STEP = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3"}
ARRAY = {"SLURM_ARRAY_TASK_ID": "15", "SLURM_ARRAY_TASK_MIN": "11", "SLURM_ARRAY_TASK_STEP": "2"}
ARRAY_OF_3 = {**ARRAY, "SLURM_ARRAY_TASK_COUNT": "3"}
TORCHRUN = {"RANK": "5", "WORLD_SIZE": "8"}


@pytest.mark.parametrize(
    ("given_", "environ", "expected"),
    [
        (("auto", "auto"), {}, Shard(0, 1)),
        ((2, 5), {}, Shard(2, 5)),
        (("auto", "auto"), STEP, Shard(3, 4)),
        (("auto", "auto"), ARRAY_OF_3, Shard(2, 3)),
        (("auto", "auto"), {**ARRAY_OF_3, **STEP}, Shard(11, 12)),
        (("auto", "auto"), {**ARRAY_OF_3, **TORCHRUN, **STEP}, Shard(21, 24)),
        (("auto", "auto"), {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "1"}, Shard(0, 1)),
        (("auto", 1), {}, Shard(0, 1)),
        # A batch script without srun is the only process of its job.
        (("auto", "auto"), {"SLURM_NTASKS": "8", "SLURM_PROCID": "0", "SLURM_JOB_ID": "1"}, Shard(0, 1)),
    ],
)
def test_the_shard_comes_from_settings_or_environment(given_: Any, environ: dict[str, str], expected: Shard) -> None:
    assert find_shard(*given_, environ) == expected


@pytest.mark.parametrize(
    ("given_", "environ", "message"),
    [
        ((3, 3), {}, "0 ... count - 1"),
        ((1, "auto"), {}, "without shard.count"),
        (("auto", 3), {}, "shard.index"),
        (("auto", 3), STEP, "sets 4"),
        (("auto", "auto"), {**ARRAY, "SLURM_ARRAY_TASK_COUNT": "2"}, "gaps"),
        (("auto", "auto"), {**ARRAY, "SLURM_ARRAY_TASK_COUNT": "1"}, "give shard.index"),  # one task is repeated
    ],
)
def test_a_contradictory_shard_is_an_error(given_: Any, environ: dict[str, str], message: str) -> None:
    with pytest.raises(CFlowError, match=message):
        find_shard(*given_, environ)


def test_devices_and_batch_are_chosen_from_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "usable_cores", lambda environ: 16)
    monkeypatch.setattr(machine, "available_memory", lambda environ: 10 * machine.WORKER_MEMORY + 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_devices("auto", "auto", {}) == ("cpu",) * 10
    assert choose_devices("cpu", 3, {}) == ("cpu",) * 3
    assert [choose_batch(*given) for given in ((7, "cpu"), ("auto", "cpu"), ("auto", "cuda:0"))] == [7, 4, 32]
    assert machine.frames_per_worker(make_config("paper")) > machine.frames_per_worker(make_config("default"))
    monkeypatch.setattr(machine, "available_memory", lambda environ: 1)
    assert choose_devices("cpu", "auto", {}) == ("cpu",)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert choose_devices("auto", "auto", {}) == ("cuda:0", "cuda:1")
    assert choose_devices("cuda", 3, {}) == ("cuda:0", "cuda:1", "cuda:0")
    assert choose_devices("auto", "auto", {"LOCAL_RANK": "3"}) == ("cuda:1",)
    assert choose_devices("auto", "auto", {"SLURM_LOCALID": "0"}) == ("cuda:0",)
    assert choose_devices("cuda:1", "auto", {"LOCAL_RANK": "0"}) == ("cuda:1",)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(CFlowError, match="finds no GPU"):
        choose_devices("cuda", "auto", {})


def test_the_job_limits_the_cores() -> None:
    cores = usable_cores({})
    assert 1 <= cores <= (os.cpu_count() or 1)
    assert usable_cores({"SLURM_CPUS_PER_TASK": "1"}) == 1
    assert usable_cores({"LOCAL_WORLD_SIZE": str(cores)}) == 1
    assert usable_cores({"SLURM_CPUS_PER_TASK": "many", "LOCAL_WORLD_SIZE": "0"}) == cores


def test_the_first_signal_finishes_and_the_second_interrupts() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopSignal() as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() and stop.received == signal.SIGTERM
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP on this system")
def test_a_run_ignores_sighup_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """Return what is seen: after a carriage return, text replaces the text of its line."""
        seen = []
        for line in self.getvalue().split("\n"):
            shown = ""
            for text in line.split("\r"):
                shown = text + shown[len(text) :]
            seen.append(shown.rstrip())
        return seen


def test_a_line_replaces_the_bar_which_is_drawn_again_below(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress(total=3) as bar:
        bar.update(1)
        log_line("a frame failed")
        first, second = terminal.lines()
        assert first == "a frame failed" and "/3" in second


class Closed:
    """A terminal that was closed."""

    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")

    def isatty(self) -> bool:
        return True

    fileno = flush = write


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # tqdm's, of a bar without a terminal
@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_survives_a_closed_terminal(monkeypatch: pytest.MonkeyPatch, is_terminal: bool) -> None:
    monkeypatch.setattr(progress, "EVERY", 0.0)
    monkeypatch.setattr(Closed, "isatty", lambda self: is_terminal)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", Closed())
        log_line("a frame failed")
        with Progress(total=3) as bar:
            bar.update(2)
            bar.update(1)
    assert bar.n == 3
