"""`cflow flow tracks=true` writes a table once a log is complete, also in shards and after an interrupted run."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

import numpy as np
import pytest
from command_line import cflow

from cflow_torch import make_config, make_model, track
from cflow_torch.applications.track_table import read_tracks
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.log import windows
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

SMALL = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"
RANGE = (-20, -20, -float("inf"), 20, 20, float("inf"))


def calls_on_a_drive(folder: Path, num_sweeps: int = 4) -> Callable[..., int]:
    """Write a small simulated drive; returns (command, folder of its output, settings) -> exit status."""
    write_av2_log(make_drive(seed=3, num_sweeps=num_sweeps, profile="demo"), folder / "data")
    data = ("data=av2", f"data.root={folder / 'data'}", "data.check=false", SMALL)
    return lambda command, output, *settings: cflow(command, *data, f"output={folder / output}", *settings)


def test_resumed_and_sharded_runs_write_the_same_table(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    call = calls_on_a_drive(tmp_path, 5)
    run = ("model.num_history=0", "engine.workers=1", "tracks=true")
    assert call("flow", "whole", *run) == 0
    (file,) = (tmp_path / "whole").glob("*/tracks.parquet")
    whole = read_tracks(file)
    assert len(whole["id"]) > 5 and set(whole["sweep"]) <= set(range(4)) and not np.isnan(whole["confidence"]).any()
    model = make_model(make_config(num_history=0, point_cloud_range=RANGE))
    (source,) = find_sources("av2", tmp_path / "data")
    log = open_log("av2", source)
    flow = [model([sweeps])[0] for sweeps in windows(log, model.config.num_history)]
    expected = track(log, enumerate(flow))
    assert all(np.array_equal(whole[name], expected[name]) for name in expected)
    for index in (0, 1):
        assert not list((tmp_path / "shards").glob("*/tracks.parquet")), "half of the frames are not a whole log"
        assert call("flow", "shards", *run, f"shard.index={index}", "shard.count=2") == 0
    (other,) = (tmp_path / "shards").glob("*/tracks.parquet")
    assert other.read_bytes() == file.read_bytes()

    before = file.read_bytes()
    assert call("flow", "whole", *run[:2], "tracks=mot") == 0 and call("flow", "whole", *run[:2], "tracks=csv") == 2
    assert (file.parent / "mot.txt").read_text().count("\n") == len(whole["id"])
    file.unlink()
    sorted(file.parent.glob("*.feather"))[2].unlink()
    assert call("flow", "whole", *run) == 0 and file.read_bytes() == before
    assert call("flow", "whole", *run[:2], "overwrite=true") == 0 and not file.exists(), "tracks of another run"
    capsys.readouterr()
    assert call("flow", "small", *run, "contents=[residual,cluster_id,is_valid]") == 2
    assert "contents needs cluster_id, confidence" in capsys.readouterr().err


def test_the_viewer_shows_all_tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    from cflow_torch.viz import recording

    call, shown = calls_on_a_drive(tmp_path, 6), []
    assert call("flow", "flow", "model.num_history=0", "tracks=true", "engine.workers=1") == 0
    add = recording._Drive.add_tracks
    monkeypatch.setattr(recording._Drive, "add_tracks", lambda self, rows: (shown.append(rows), add(self, rows)))
    assert call("view", "view", "format=rerun", f"flow={tmp_path / 'flow'}") == 0
    (file,) = (tmp_path / "flow").glob("*/tracks.parquet")
    ids = np.concatenate([rows["id"] for rows in shown])
    assert len(shown) == 5 and np.array_equal(ids, read_tracks(file)["id"]) and len(ids) > 3
    assert len(list((tmp_path / "view").glob("*.rrd"))) == 1
