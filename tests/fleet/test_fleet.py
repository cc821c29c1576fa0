"""Many frames by many workers: the same files as one frame after the other, whatever happens on the way."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
from fractions import Fraction
from pathlib import Path
from typing import Any, Callable, Dict, List, Set, Tuple

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import feather

from cflow_torch import CFlowError, FlowResult, Window, make_config, make_model
from cflow_torch.cli.main import main
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.log import window
from cflow_torch.fleet import local, machine
from cflow_torch.fleet.job import Begun, Done, Failed, Job, Opened, Unit, split
from cflow_torch.fleet.local import run_local
from cflow_torch.fleet.machine import Layout, choose_layout, usable_cores
from cflow_torch.fleet.manifest import make_identity
from cflow_torch.fleet.report import format_missing, format_report, make_report
from cflow_torch.fleet.shard import Shard, find_shard
from cflow_torch.fleet.stop import StopSignal
from cflow_torch.fleet.tally import Tally
from cflow_torch.fleet.work import Worker
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

DEADLY = "CFLOW_TEST_DEADLY_FRAME"
SWEEPS = (4, 6, 3)  # of the logs of `fleet`


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three small logs with 3, 5 and 2 pairs."""
    root = tmp_path_factory.mktemp("fleet")
    for seed, sweeps in enumerate(SWEEPS):
        write_av2_log(make_drive(seed=seed, num_sweeps=sweeps, profile="demo"), root)
    return root


def run(*arguments: Any) -> int:
    """Exit status of `cflow`."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def flow(root: Path, output: Path, *more: str) -> int:
    """`cflow flow` of a folder of logs."""
    return run("flow", "data=av2", f"data.root={root}", f"output={output}", "model=paper", "data.check=false", *more)


def tree(folder: Path) -> Dict[str, bytes]:
    """All files but the reports, which tell times, and config.yaml, which tells where the data lies."""
    files = [f for f in folder.rglob("*") if f.is_file() and "reports" not in f.parts and f.name != "config.yaml"]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def report(output: Path, shard: str = "shard-0-of-1") -> Dict[str, Any]:
    return json.loads((output / "reports" / f"{shard}.json").read_text())


@pytest.fixture(scope="module")
def single(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flow of the fleet by one worker, one window at a time."""
    output = tmp_path_factory.mktemp("single")
    assert flow(fleet, output, "engine.workers=1", "engine.batch=1") == 0
    return output


# What the files hold


def test_files_hold_the_method_s_results_and_their_origin(fleet: Path, single: Path) -> None:
    model = make_model(make_config("paper"))
    for folder in sorted(fleet.iterdir()):
        log = AV2Log(folder)
        for index in range(len(log.timestamps) - 1):
            (expected,) = model([window(log, index)])
            stored = read_flow(single / log.log_id / f"{log.timestamps[index]}.feather")
            for name, values in expected.numpy().items():
                np.testing.assert_array_equal(stored.numpy()[name], values, err_msg=name)
        about = json.loads((single / log.log_id / "manifest.json").read_text())
        assert about["timestamps"] == list(log.timestamps) and about["log_id"] == log.log_id
    identity = json.loads((single / "manifest.json").read_text())
    assert identity["hash"] == make_identity(make_config("paper"), "av2", about_settings(single))["hash"]
    assert sum(name.endswith(".feather") for name in tree(single)) == sum(SWEEPS) - len(SWEEPS)


def about_settings(output: Path) -> Dict[str, Any]:
    data = json.loads((output / "manifest.json").read_text())["data"]
    return {key: value for key, value in data.items() if key != "reader"}


@pytest.mark.parametrize("more", [("engine.workers=1",), ("engine.workers=2", "engine.batch=3")], ids=["one", "two"])
def test_workers_and_batches_change_no_byte(fleet: Path, single: Path, tmp_path: Path, more: Tuple[str, ...]) -> None:
    assert flow(fleet, tmp_path, *more) == 0
    assert tree(tmp_path) == tree(single)


def test_shards_together_are_the_single_run(fleet: Path, single: Path, tmp_path: Path) -> None:
    for index in (2, 0, 3, 1):
        assert flow(fleet, tmp_path, f"shard.index={index}", "shard.count=4", "engine.workers=1") == 0
        assert report(tmp_path, f"shard-{index}-of-4")["status"] == "complete"
    assert tree(tmp_path) == tree(single)


def test_a_file_has_only_the_contents_asked_for(
    fleet: Path, single: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert flow(fleet, tmp_path, "contents=[is_valid,residual]", "engine.workers=1") == 0
    file = next(tmp_path.glob("*/*.feather"))
    small, whole = feather.read_table(file), feather.read_table(single / file.relative_to(tmp_path))
    assert small.column_names == ["residual_tx_m", "residual_ty_m", "residual_tz_m", "is_valid"]
    assert small.equals(whole.select(small.column_names)) and file.stat().st_size * 5 < whole.nbytes
    assert flow(fleet, tmp_path) == 2, "another content is another run"
    assert "contents was" in capsys.readouterr().err
    assert flow(fleet, tmp_path, "contents=[colour]") == 2
    assert "residual" in capsys.readouterr().err
    assert flow(fleet, tmp_path, "contents=[confidence]") == 2
    assert "model.proof=true" in capsys.readouterr().err
    assert flow(fleet, tmp_path / "more", "contents=[confidence,residual]", "engine.workers=1", "model.proof=true") == 0
    more = feather.read_table(next(tmp_path.glob("more/*/*.feather")))
    assert more.column_names == ["residual_tx_m", "residual_ty_m", "residual_tz_m", "confidence"]
    assert max(more["confidence"].to_pylist()) > 0.5


# Going on


def test_a_second_run_does_only_what_is_missing(fleet: Path, single: Path, tmp_path: Path) -> None:
    shutil.copytree(single, tmp_path / "out")
    before = tree(tmp_path / "out")
    gone = sorted(name for name in before if name.endswith(".feather"))[2::3]
    for name in gone:
        (tmp_path / "out" / name).unlink()
    times = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*.feather")}
    assert flow(fleet, tmp_path / "out", "engine.workers=1") == 0
    assert tree(tmp_path / "out") == before
    frames = report(tmp_path / "out")["frames"]
    assert (frames["computed"], frames["complete_before"]) == (len(gone), 10 - len(gone))
    assert all(file.stat().st_mtime_ns == time for file, time in times.items()), "complete files are left alone"


def test_other_settings_are_refused_with_their_names(
    fleet: Path, single: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    shutil.copytree(single, tmp_path / "out")
    before = tree(tmp_path / "out")
    for more, named in (
        (["model.connectivity=4"], "connectivity was 8, is 4"),
        (["data.find_ground=grid"], "find_ground was None, is grid"),
        (["resume=false"], "resume=true"),
    ):
        assert flow(fleet, tmp_path / "out", *more) == 2
        error = capsys.readouterr().err
        assert named in error and "overwrite=true" in error
    shards = ("shard.index=0", "shard.count=2")
    assert flow(fleet, tmp_path / "out", "model.connectivity=4", "overwrite=true", *shards) == 2
    assert "remove the folder yourself" in capsys.readouterr().err
    assert tree(tmp_path / "out") == before, "nothing was touched"


def test_overwrite_leaves_nothing_of_the_other_run(fleet: Path, single: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(single, out)
    shutil.copytree(out / next(out.glob("synthetic*")).name, out / "a-log-of-the-other-run")
    (out / "mine.txt").write_text("not of a run")
    assert flow(fleet, out, "model.pixel_sizes=[0.2]", "overwrite=true", "engine.workers=1") == 0
    fresh = tmp_path / "fresh"
    assert flow(fleet, fresh, "model.pixel_sizes=[0.2]", "engine.workers=1") == 0
    assert tree(out) == {**tree(fresh), "mine.txt": b"not of a run"}


def test_memory_limit_and_place_are_no_other_settings(fleet: Path, single: Path, tmp_path: Path) -> None:
    shutil.copytree(single, tmp_path / "out")
    shutil.copytree(fleet, tmp_path / "moved")
    assert flow(tmp_path / "moved", tmp_path / "out", "model.max_memory=50000000", "engine.workers=1") == 0
    assert report(tmp_path / "out")["frames"]["computed"] == 0


def test_a_log_that_has_changed_is_refused_and_the_others_go_on(
    fleet: Path, single: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out, root = tmp_path / "out", tmp_path / "root"
    shutil.copytree(single, out)
    shutil.copytree(fleet, root)
    first, second, _ = sorted(folder.name for folder in root.iterdir())
    shutil.rmtree(out / second)
    sweeps = sorted((root / first / "sensors" / "lidar").iterdir())
    shutil.copy(sweeps[1], sweeps[-1])  # same names, another content
    assert flow(root, out, "engine.workers=1") == 1
    error = capsys.readouterr().err
    assert f"{first}: " in error and "changed since" in error
    assert tree(out) == tree(single)


def test_results_may_lie_where_fsspec_reaches(fleet: Path, single: Path, tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec", reason="needs the extra remote")
    pytest.importorskip("upath", reason="needs the extra remote")
    memory = fsspec.filesystem("memory")
    memory.put(str(fleet), "/fleet-data", recursive=True)
    for computed in (10, 2):
        assert run(
            "flow", "data=av2", "data.root=memory://fleet-data", "output=memory://fleet-flow", "model=paper",
            "data.check=false", "engine.workers=1",
        ) == 0  # fmt: skip
        memory.get("/fleet-flow", str(tmp_path), recursive=True)
        (out,) = [folder.parent for folder in tmp_path.rglob("manifest.json") if (folder.parent / "reports").is_dir()]
        assert tree(out) == tree(single) and report(out)["frames"]["computed"] == computed
        for name in [name for name in memory.find("/fleet-flow") if name.endswith(".feather")][3:5]:
            memory.rm(name)
    memory.rm("/fleet-flow", recursive=True)
    memory.rm("/fleet-data", recursive=True)


# Trouble


def test_a_sweep_that_cannot_be_read_costs_its_frames_only(
    fleet: Path, single: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    shutil.copytree(fleet, root)
    log = sorted(root.iterdir())[1]
    sweeps = sorted((log / "sensors" / "lidar").iterdir())
    whole = sweeps[2].read_bytes()
    sweeps[2].write_bytes(whole[:1000])
    assert flow(root, out, "engine.workers=1") == 1
    expected = {f"{log.name}/{sweeps[i].stem}" for i in (1, 2)}
    told = report(out)
    assert {name for name, _ in told["failures"]} == expected and told["status"] == "incomplete"
    error = capsys.readouterr().err
    assert all(name in error for name in expected)
    present = set(tree(out))
    assert present == {name for name in tree(single) if name[: -len(".feather")] not in expected}
    sweeps[2].write_bytes(whole)
    assert flow(root, out, "engine.workers=1") == 0
    assert tree(out).keys() == tree(single).keys()


def test_a_full_disk_is_reported_per_frame(
    fleet: Path, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cflow_torch.fleet import work

    calls: List[Path] = []

    def write(path: Path, result: FlowResult, contents: Tuple[str, ...]) -> None:
        calls.append(path)
        if len(calls) in (3, 4):
            raise OSError(28, "No space left on device", str(path))
        real(path, result, contents)

    real = work.write_flow
    monkeypatch.setattr(work, "write_flow", write)
    assert flow(fleet, tmp_path, "engine.workers=1") == 1
    told = report(tmp_path)
    expected = [f"[Errno 28] No space left on device: '{path}'" for path in calls[2:4]]
    assert [message for _, message in told["failures"]] == expected
    assert told["frames"]["computed"] == 8
    monkeypatch.undo()
    assert flow(fleet, tmp_path, "engine.workers=1") == 0
    assert tree(tmp_path) == tree(single)


class Stumbling:
    """A method that cannot do some frames, and no batch with one of them.

    Args:
        bad: numbers of points of the sweeps that it cannot do.
        error: what it raises.
    """

    def __init__(self, bad: List[int], error: Callable[[], Exception]) -> None:
        self.model = make_model(make_config("paper"), "cpu")
        self.config, self._bad, self._error = self.model.config, bad, error

    def __call__(self, windows: List[Window]) -> List[FlowResult]:
        if any(len(w.pc0.points) in self._bad for w in windows):
            raise self._error()
        return self.model(windows)


def job_for(output: Path, **settings: Any) -> Job:
    return Job(make_config("paper"), "0" * 64, "av2", {}, str(output), **{"batch": 3, "check": False, **settings})


@pytest.mark.parametrize("error", [CFlowError("too odd"), MemoryError(), RuntimeError("CUDA: no memory"), KeyError(3)])
def test_a_bad_frame_spoils_no_other_of_its_batch(fleet: Path, single: Path, tmp_path: Path, error: Exception) -> None:
    source = sorted(fleet.iterdir())[1]
    log = AV2Log(source)
    model = Stumbling([len(log.sweep(i).points) for i in (1, 3)], lambda: error)
    events = list(Worker(job_for(tmp_path), "cpu", model=model).run(Unit(0, source)))
    failed = [event for event in events if isinstance(event, Failed)]
    assert [event.timestamp for event in failed] == [log.timestamps[1], log.timestamps[3]]
    assert all(type(error).__name__ in event.message or "too odd" in event.message for event in failed)
    done = [event.timestamp for event in events if isinstance(event, Done)]
    assert done == [log.timestamps[i] for i in (0, 2, 4)]
    for stamp in done:
        name = f"{log.log_id}/{stamp}.feather"
        assert (tmp_path / name).read_bytes() == (single / name).read_bytes()


def test_events_come_in_order_and_say_what_is_in_hand(fleet: Path, tmp_path: Path) -> None:
    source = sorted(fleet.iterdir())[1]
    stamps = [int(stamp) for stamp in AV2Log(source).timestamps]
    events = list(Worker(job_for(tmp_path, batch=2), "cpu").run(Unit(7, source)))
    assert events[0] == Opened(7, source.name, 5, tuple(stamps[:5]))
    assert [stamp for event in events if isinstance(event, Begun) for stamp in event.timestamps] == stamps[:5]
    assert [event.timestamp for event in events if isinstance(event, Done)] == stamps[:5]
    for event in (event for event in events if isinstance(event, Done)):
        assert {"read", "compute", "write", "compute/project"} <= set(event.seconds)
    careful = Unit(7, source, careful=frozenset(stamps[1:3]))
    shutil.rmtree(tmp_path / source.name)
    events = list(Worker(job_for(tmp_path, batch=2), "cpu").run(careful))
    begun = [event.timestamps for event in events if isinstance(event, Begun)]
    assert begun == [(stamps[0],), (stamps[1],), (stamps[2],), (stamps[3], stamps[4])]


def test_a_worker_that_is_to_stop_finishes_what_it_has_in_hand(fleet: Path, tmp_path: Path) -> None:
    source = sorted(fleet.iterdir())[1]
    written = tmp_path / source.name
    stop = lambda: any(written.glob("*.feather"))  # noqa: E731
    events = list(Worker(job_for(tmp_path, batch=1), "cpu").run(Unit(0, source), stop))
    done = [event.timestamp for event in events if isinstance(event, Done)]
    assert 1 <= len(done) < 5
    assert sorted(int(file.stem) for file in written.glob("*.feather")) == done


def test_a_worker_closes_the_file_it_read(kitti_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra hdf5")
    worker = Worker(Job(make_config("paper"), "0" * 64, "hdf5", {}, str(tmp_path)), "cpu")
    scene = worker._open(kitti_file).log
    assert scene._scene, "it is open"
    worker.close()
    assert not scene._scene


# Workers that die


def deadly_serve(*arguments: Any) -> None:
    """A worker process that kills itself when it reads a frame; $DEADLY is "<marker file, or nothing>:<time stamp>".

    If the marker file is called "hung", it stops instead, for ever.
    """
    read, (marker, stamp) = Worker._read_one, os.environ[DEADLY].rsplit(":", 1)

    def deadly_read(self: Worker, log: Any, index: int) -> Any:
        if int(log.timestamps[index]) == int(stamp) and not (marker and Path(marker).exists()):
            if marker:
                Path(marker).touch()
            time.sleep(0.5)  # so that frames before it are done
            os.kill(os.getpid(), signal.SIGSTOP if marker.endswith("hung") else signal.SIGKILL)
        return read(self, log, index)

    Worker._read_one = deadly_read  # type: ignore[method-assign]
    REAL_SERVE(*arguments)


REAL_SERVE = local.serve
LAYOUT = Layout(("cpu", "cpu"), 1, 2)


@pytest.mark.parametrize("once", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["once", "always"])
def test_a_killed_worker_is_replaced(
    fleet: Path, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, once: bool
) -> None:
    sources = sorted(fleet.iterdir())
    deadly = AV2Log(sources[1]).timestamps[4]  # the other logs end before
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setenv(DEADLY, f"{tmp_path / 'killed' if once else ''}:{deadly}")
    units = split([Unit(0, source) for source in sources], 1)
    tally = Tally(units)
    out = tmp_path / "out"
    for event in run_local(job_for(out, batch=2), units, LAYOUT, lambda: False):
        tally.add(event)
    frames = {name for name in tree(single) if re.search(r"\d+\.feather", name)}
    if once:
        assert tally.is_complete and tally.computed == tally.total == 10
    else:
        assert [name for name, _ in tally.failures] == [f"{sources[1].name}/{deadly}"]
        assert "SIGKILL" in tally.failures[0][1] and tally.computed == 9 and not tally.waiting
        frames -= {f"{sources[1].name}/{deadly}.feather"}
    written = tree(out)
    assert {name for name in written if name.endswith(".feather")} == frames
    assert all(written[name] == tree(single)[name] for name in frames)


@pytest.mark.slow
@pytest.mark.parametrize("stops", [False, True], ids=["timeout", "signal"])
def test_a_worker_that_hangs_is_replaced(
    fleet: Path, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops: bool
) -> None:
    sources = sorted(fleet.iterdir())
    deadly = AV2Log(sources[1]).timestamps[4]
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setattr(local, "_GRACE_S", 3.0)
    monkeypatch.setenv(DEADLY, f"{tmp_path / 'hung'}:{deadly}")
    units = split([Unit(0, source) for source in sources], 1)
    tally, out, hung = Tally(units), tmp_path / "out", (tmp_path / "hung").exists
    for event in run_local(job_for(out, batch=2), units, LAYOUT, lambda: stops and hung(), timeout=20):
        tally.add(event)
    if stops:
        assert f"{sources[1].name}/{deadly}" in tally.waiting  # and what was in hand with it
    else:
        assert tally.is_complete and tally.computed == tally.total == 10
    written = {name: content for name, content in tree(out).items() if name.endswith(".feather")}
    assert written.items() <= tree(single).items() and hung()


def test_a_gpu_that_is_lost_ends_its_worker(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Stumbling(
        [len(AV2Log(source).sweep(0).points) for source in fleet.iterdir()], lambda: RuntimeError("assert")
    )
    worker = Worker(job_for(tmp_path), "cpu", model=model)

    def refuse(*_: Any, **__: Any) -> Any:
        raise RuntimeError("device-side assert")

    monkeypatch.setattr("cflow_torch.fleet.work.torch.zeros", refuse)
    with pytest.raises(CFlowError, match="cannot be used any more: .*device-side assert"):
        list(worker.run(Unit(0, sorted(fleet.iterdir())[0])))


def test_workers_that_cannot_begin_end_the_run(fleet: Path, tmp_path: Path) -> None:
    units = [Unit(0, source) for source in fleet.iterdir()]
    with pytest.raises(CFlowError, match="nowhere"):
        list(run_local(job_for(tmp_path), units, Layout(("nowhere", "nowhere"), 1, 2), lambda: False))


# Shares of the work


@given(
    lengths=st.lists(st.integers(0, 40), min_size=1, max_size=12),
    count=st.integers(1, 20),
    workers=st.integers(1, 5),
)
def test_shards_and_units_cover_every_frame_once(lengths: List[int], count: int, workers: int) -> None:
    seen: List[Tuple[int, int]] = []
    for index in range(count):
        units = split(Shard(index, count).units(list(range(len(lengths)))), workers)
        assert [unit.number for unit in units] == list(range(len(units)))
        seen += [(unit.source, frame) for unit in units for frame in unit.frames(lengths[unit.source])]
    assert sorted(seen) == [(log, frame) for log, length in enumerate(lengths) for frame in range(length)]


def test_a_shard_opens_its_own_logs_only() -> None:
    units = Shard(1, 3).units(list("abcdef"))
    assert [(unit.source, unit.first, unit.last) for unit in units] == [("c", 0, 1), ("d", 0, 1)]
    units = Shard(1, 4).units(list("ab"))
    assert [(unit.source, unit.first, unit.last) for unit in units] == [("a", Fraction(1, 2), 1)]


SLURM_STEP = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3"}
SLURM_ARRAY = {"SLURM_ARRAY_TASK_ID": "15", "SLURM_ARRAY_TASK_MIN": "11", "SLURM_ARRAY_TASK_STEP": "2"}


@pytest.mark.parametrize(
    ("given_", "environ", "expected"),
    [
        (("auto", "auto"), {}, Shard(0, 1)),
        ((2, 5), {}, Shard(2, 5)),
        (("2", "5"), SLURM_STEP, Shard(2, 5)),
        (("auto", "auto"), SLURM_STEP, Shard(3, 4)),
        (("auto", "auto"), {**SLURM_ARRAY, "SLURM_ARRAY_TASK_COUNT": "3"}, Shard(2, 3)),
        (("auto", "auto"), {**SLURM_ARRAY, "SLURM_ARRAY_TASK_COUNT": "3", **SLURM_STEP}, Shard(11, 12)),
        (("auto", "auto"), {"RANK": "5", "WORLD_SIZE": "8", **SLURM_STEP}, Shard(5, 8)),
        (
            ("auto", "auto"),
            {**SLURM_ARRAY, "SLURM_ARRAY_TASK_COUNT": "3", "RANK": "1", "WORLD_SIZE": "2", **SLURM_STEP},
            Shard(5, 6),
        ),
        (("auto", "auto"), {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "1"}, Shard(0, 1)),
        (("auto", 4), SLURM_STEP, Shard(3, 4)),
        (("auto", 1), {}, Shard(0, 1)),
        # A batch script without srun is the only process of its job.
        (("auto", "auto"), {"SLURM_NTASKS": "8", "SLURM_PROCID": "0", "SLURM_JOB_ID": "1"}, Shard(0, 1)),
    ],
)
def test_the_shard_comes_from_settings_or_surroundings(given_: Any, environ: Dict[str, str], expected: Shard) -> None:
    assert find_shard(*given_, environ) == expected


@pytest.mark.parametrize(
    ("given_", "environ", "message"),
    [
        ((3, 3), {}, "0 ... count - 1"),
        ((-1, 3), {}, "0 ... count - 1"),
        ((0, 0), {}, "at least 1"),
        ((1, "auto"), {}, "shard.count"),
        (("auto", 3), {}, "shard.index"),
        (("auto", 3), SLURM_STEP, "4 tasks"),
        (("one", 3), {}, "whole number"),
        (("auto", "auto"), {**SLURM_ARRAY, "SLURM_ARRAY_TASK_COUNT": "2"}, "gaps"),
        (("auto", "auto"), {"RANK": "x", "WORLD_SIZE": "2"}, "RANK"),
        (("auto", "auto"), {**SLURM_ARRAY, "SLURM_ARRAY_TASK_COUNT": "1"}, "redo one shard"),
    ],
)
def test_a_shard_that_makes_no_sense_is_refused(given_: Any, environ: Dict[str, str], message: str) -> None:
    with pytest.raises(CFlowError, match=message):
        find_shard(*given_, environ)


def test_torchrun_s_variables_make_a_shard(
    fleet: Path, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "2")
        assert flow(fleet, tmp_path, "engine.workers=1") == 0
    assert tree(tmp_path) == tree(single) and report(tmp_path, "shard-1-of-2")["shard"] == {"index": 1, "count": 2}


def test_a_sweep_over_shards_shares_one_folder(fleet: Path, single: Path, tmp_path: Path) -> None:
    arguments = [f"data.root={fleet}", f"output={tmp_path}", "shard.count=3", "shard.index=0,1,2", "engine.workers=1"]
    assert run("flow", "-m", "data=av2", "model=paper", "data.check=false", *arguments) == 0
    (tmp_path / "multirun.yaml").unlink()  # Hydra's
    assert tree(tmp_path) == tree(single)


def test_a_shard_without_frames_is_complete(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log = next(fleet.iterdir())
    for index, count in ((0, 90), (45, 90)):
        assert flow(log, tmp_path, f"shard.index={index}", f"shard.count={count}", "engine.workers=1") == 0
        assert report(tmp_path, f"shard-{index}-of-{count}")["frames"]["total"] == 0
    assert list(run_local(job_for(tmp_path), [], LAYOUT, lambda: False)) == []


# The machine


def test_layout_is_chosen_from_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "usable_cores", lambda environ: 16)
    monkeypatch.setattr(machine, "available_memory", lambda environ: 10 * machine.WORKER_MEMORY + 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_layout("auto", "auto", "auto", "auto", {}) == Layout(("cpu",) * 10, 1, machine.CPU_BATCH)
    assert choose_layout("cpu", 3, "auto", 7, {}) == Layout(("cpu",) * 3, 5, 7)
    monkeypatch.setattr(machine, "available_memory", lambda environ: 1)
    assert choose_layout("cpu", "auto", "auto", "auto", {}).devices == ("cpu",)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert choose_layout("auto", "auto", "auto", "auto", {}) == Layout(("cuda:0", "cuda:1"), 8, machine.GPU_BATCH)
    assert choose_layout("cuda", 3, 2, 1, {}) == Layout(("cuda:0", "cuda:1", "cuda:0"), 2, 1)
    assert choose_layout("auto", "auto", 1, 1, {"LOCAL_RANK": "3"}).devices == ("cuda:1",)
    assert choose_layout("auto", "auto", 1, 1, {"SLURM_LOCALID": "0"}).devices == ("cuda:0",)
    assert choose_layout("cuda:1", "auto", 1, 1, {"LOCAL_RANK": "0"}).devices == ("cuda:1",)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(CFlowError, match="no GPU"):
        choose_layout("cuda", "auto", 1, 1, {})
    for workers in (0, "many", 1.5):
        with pytest.raises(CFlowError, match="workers=.*whole number"):
            choose_layout("cpu", workers, 1, 1, {})


def test_cores_are_those_of_the_job() -> None:
    cores = usable_cores({})
    assert 1 <= cores <= (os.cpu_count() or 1)
    assert usable_cores({"SLURM_CPUS_PER_TASK": "1"}) == 1
    assert usable_cores({"LOCAL_WORLD_SIZE": str(cores)}) == 1


# Words


def test_dry_run_lists_the_work_and_writes_nothing(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    assert flow(fleet, out, "dry_run=true") == 0
    printed = capsys.readouterr().out
    assert not out.exists()
    for folder, sweeps in zip(sorted(fleet.iterdir()), SWEEPS):
        stamps = AV2Log(folder).timestamps
        assert re.search(rf"{folder.name} +{sweeps - 1} +0 +{sweeps - 1} +{stamps[0]} \.\.\. {stamps[-2]}", printed)
    assert "10 frames, 0 complete, 10 to do" in printed and str(out) in printed
    for pattern in (r"read \d", r"compute \d", r"time: about", r"disk: \d", "memory: "):
        assert re.search(pattern, printed), pattern


def test_the_report_tells_all(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert flow(fleet, tmp_path, "engine.workers=1") == 0
    printed, told = capsys.readouterr().out, report(tmp_path)
    assert told["status"] == "complete" and told["exit_status"] == 0
    assert list(told["frames"].values()) == [10, 0, 10, 0, 0, 0, 0]
    assert told["frames_per_s"] == pytest.approx(10 / told["seconds"])
    assert {"read", "compute", "write", "compute/cluster", "compute/correlate"} <= set(told["stages"])
    assert told["config"]["model"]["pixel_sizes"] == [0.1] and told["versions"]["cflow_torch"]
    for word in ("complete", "computed", "frames/s", "correlate"):
        assert word in printed


def test_a_report_of_trouble_lists_what_is_missing() -> None:
    units = [Unit(0, "a"), Unit(1, "b"), Unit(2, "c")]
    tally = Tally(units)
    assert tally.add(Opened(0, "a", 40, tuple(range(10, 40)))) == 10
    assert tally.add(Done(0, 10, {"read": 2.0})) == 1
    assert tally.add(Failed(0, "a/11", "odd", 11)) == 1
    assert tally.add(Failed(1, "b", "no log")) == 0
    assert tally.add(Opened(0, "a", 40, tuple(range(13, 40)))) == 1, "frame 12 was written before its worker died"
    told = make_report(tally, 4.0, Layout(("cpu",), 2, 1), Shard(), "local", "SIGTERM", {})
    assert told["status"] == "interrupted" and told["stopped_by"] == "SIGTERM"
    assert list(told["frames"].values()) == [40, 10, 2, 1, 1, 27, 1]
    missing = format_missing(told).splitlines()
    assert missing[:3] == ["  a/11: odd", "  b: no log", "  a/13: not done"]
    assert missing[-2:] == ["  and 9 more, all of them in the report", "  1 logs or parts of logs: not begun"]
    assert "interrupted by SIGTERM" in format_report(told)


def test_the_first_signal_asks_and_the_second_insists() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopSignal() as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() and stop.exit_status == 143
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
    assert signal.getsignal(signal.SIGTERM) is before


def test_engines_are_named(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert flow(fleet, tmp_path, "engine.name=cloud") == 2
    assert "local, ray" in capsys.readouterr().err


# Found in review


def hard_serve(*arguments: Any) -> None:
    """A worker process that cannot begin on the device "gone" (a GPU that has fallen off)."""
    REAL_SERVE(*arguments[:1], {"gone": "nowhere"}.get(arguments[1], arguments[1]), *arguments[2:])


def test_one_worker_uses_the_threads_it_is_given(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = torch.get_num_threads(), []
    run_worker = Worker.run
    monkeypatch.setattr(Worker, "run", lambda *a: (seen.append(torch.get_num_threads()), run_worker(*a))[1])
    list(run_local(job_for(tmp_path), [Unit(0, next(fleet.iterdir()))], Layout(("cpu",), before + 1, 2), lambda: False))
    assert seen == [before + 1] and torch.get_num_threads() == before


@pytest.mark.slow
def test_a_killed_worker_of_an_overwriting_run_repeats_nothing(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = sorted(fleet.iterdir())[1]
    stamps = AV2Log(source).timestamps
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setenv(DEADLY, f"{tmp_path / 'killed'}:{stamps[4]}")
    units, done = split([Unit(0, source)], 1), []
    tally = Tally(units)
    for event in run_local(job_for(tmp_path / "out", batch=1, redo=True), units, LAYOUT, lambda: False):
        tally.add(event)
        done += [event.timestamp] if isinstance(event, Done) else []
    assert done == list(stamps[:5]) and tally.is_complete and tally.computed == tally.total == 5


def test_a_worker_that_cannot_begin_leaves_the_work_to_the_others(
    fleet: Path, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(local, "serve", hard_serve)
    units = split([Unit(0, source) for source in sorted(fleet.iterdir())], 1)
    tally = Tally(units)
    for event in run_local(job_for(tmp_path), units, Layout(("gone", "cpu"), 1, 2), lambda: False):
        tally.add(event)
    assert tally.is_complete and tally.computed == 10
    assert "nowhere" in capsys.readouterr().err


def test_nobody_is_hired_to_stop(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that end because they were told to are not replaced, however long the others take."""
    hired: List[str] = []
    hire = local._Crew._hire
    monkeypatch.setattr(local._Crew, "_hire", lambda self, device: (hired.append(device), hire(self, device))[1])
    monkeypatch.setattr(local, "serve", slow_serve)
    units = split([Unit(0, sorted(fleet.iterdir())[1]), Unit(1, sorted(fleet.iterdir())[2])], 1)
    done: Set[int] = set()
    for event in run_local(job_for(tmp_path, batch=1), units, LAYOUT, lambda: len(done) == 2):
        done.update([event.unit] if isinstance(event, Done) else [])
    assert len(hired) == 2


def slow_serve(*arguments: Any) -> None:
    """A worker process that takes its time for the log of 6 sweeps."""
    write = Worker._write

    def slow_write(self: Worker, folder: Path, frame: Any) -> Any:
        time.sleep(1 if folder.name.endswith("1") else 0)
        return write(self, folder, frame)

    Worker._write = slow_write  # type: ignore[method-assign]
    REAL_SERVE(*arguments)


def test_a_batch_that_failed_is_let_go_before_its_frames_are_tried_alone(fleet: Path, tmp_path: Path) -> None:
    """A traceback holds what the failed batch had taken from the GPU."""
    import weakref

    class Big:
        pass

    alive: List[bool] = []

    class Hungry(Stumbling):
        taken: Any = None

        def __call__(self, windows: List[Window]) -> List[FlowResult]:
            if len(windows) > 1:
                big = Big()
                self.taken = weakref.ref(big)
                raise RuntimeError("CUDA: out of memory")
            alive.append(self.taken() is not None)
            return self.model(windows)

    source = sorted(fleet.iterdir())[2]
    list(Worker(job_for(tmp_path), "cpu", model=Hungry([], MemoryError)).run(Unit(0, source)))
    assert alive == [False, False]


def test_an_overwrite_that_was_killed_half_way_can_be_given_again(
    fleet: Path, single: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    shutil.copytree(single, out)
    for name in ("manifest.json", "config.yaml"):
        (out / name).unlink()
    other = ("model.pixel_sizes=[0.2]", "engine.workers=1")
    assert flow(fleet, out, *other) == 2, "the frames of the other run must not stay unnoticed"
    assert "overwrite=true" in capsys.readouterr().err
    assert flow(fleet, out, "overwrite=true", *other) == 0
    fresh = tmp_path / "fresh"
    assert flow(fleet, fresh, *other) == 0
    assert tree(out) == tree(fresh)


def test_shards_that_begin_together_are_no_conflict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cflow_torch.fleet import manifest

    identity = make_identity(make_config("paper"), "av2", {})
    read = manifest._read

    def read_and_be_overtaken(file: Path) -> Any:
        content = read(file)
        manifest.write_text(tmp_path / "manifest.json", json.dumps(identity))
        manifest.write_text(tmp_path / "config.yaml", "")
        return content

    monkeypatch.setattr(manifest, "_read", read_and_be_overtaken)
    manifest.claim_folder(tmp_path, identity, resume=True, overwrite=False, alone=False)


def test_an_output_that_cannot_be_written_is_told_in_a_line(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    assert flow(fleet, tmp_path / "file" / "out") == 2
    assert "output=FOLDER" in capsys.readouterr().err


def test_a_signal_is_heard_where_nobody_reads_the_words(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> int:
        raise BrokenPipeError

    monkeypatch.setattr(os, "write", broken)
    with StopSignal() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
