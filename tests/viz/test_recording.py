"""Recordings for rerun: every value is read back."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest
from toy_street import CAR, CAR_FLOW, FLOOR, STEP, WALL, Street, result_of

from cflow_torch.viz import flow_to_rgb, record_log
from cflow_torch.viz.clusters import PALETTE

pytestmark = pytest.mark.skipif(find_spec("rerun") is None, reason="needs the extra rerun")
Rows = Dict[str, Dict[int, Dict[str, Any]]]

LIDAR = "world/ego_vehicle/lidar"


def read(path: Path) -> tuple[Rows, list[str]]:
    """({entity: {sweep, -1 = static: {component: values}}}, names of the timelines)."""
    chunks = pytest.importorskip("rerun.chunk", reason="needs a rerun-sdk that reads recordings")
    rows: Rows = {}
    timelines: list[str] = []
    for chunk in chunks.RrdReader(path).stream().to_chunks():
        timelines += chunk.timeline_names
        batch = chunk.to_record_batch()
        columns = [name for name in batch.schema.names if ":" in name or name == "sweep"]  # not the clock's
        for row in batch.select(columns).to_pylist():
            kept = {name.rpartition(":")[2]: value for name, value in row.items() if ":" in name}
            rows.setdefault(chunk.entity_path.lstrip("/"), {})[row.get("sweep", -1)] = kept
    return rows, timelines


def rgb(colors: list[int]) -> np.ndarray:
    """(N, 3) of packed RGBA."""
    return (np.array(colors, np.int64)[:, None] >> [24, 16, 8]) & 255


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rows, list[str]]:
    path = tmp_path_factory.mktemp("rrd") / "street.rrd"
    assert record_log(Street(), [(0, result_of()), (1, result_of(0.0))], path) == 2
    return read(path)


def test_points_move_with_the_ego_vehicle_and_have_the_colours_of_flow_and_clusters(recorded: Any) -> None:
    rows = recorded[0][f"{LIDAR}/cflow"]
    assert sorted(rows) == [0, 1]
    points = Street().sweep(0).points[:40] - np.array([STEP, 0, 0], np.float32)  # no ground, no NaN
    np.testing.assert_allclose(rows[0]["positions"], points, atol=1e-6)
    colors = rgb(rows[0]["colors"])
    assert (colors[CAR] == flow_to_rgb(CAR_FLOW, 1.5)).all(), "colours of the wheel, at 1.5 m per sweep"
    assert len(np.unique(colors[WALL], axis=0)) == 1 and np.ptp(colors[WALL]) < 20, "static points are grey"
    assert np.ptp(rgb(rows[1]["colors"])) < 20
    colors = rgb(recorded[0][f"{LIDAR}/clusters"][0]["colors"])
    assert (colors[CAR] == PALETTE[0]).all() and (colors[WALL] == PALETTE[1]).all()


def test_ground_and_the_next_sweep_are_entities(recorded: Any) -> None:
    floor = recorded[0][f"{LIDAR}/ground"][0]["positions"]
    np.testing.assert_allclose(floor, Street().sweep(0).points[FLOOR] - np.array([STEP, 0, 0], np.float32), atol=1e-6)
    after = recorded[0][f"{LIDAR}/next_sweep"][0]["positions"]
    np.testing.assert_allclose(after, Street().sweep(1).points[:50], atol=1e-6)


def test_a_moving_cluster_has_an_arrow_until_it_stops(recorded: Any) -> None:
    rows = recorded[0]["world/ego_vehicle/arrows"]
    np.testing.assert_allclose(rows[0]["vectors"], [5 * CAR_FLOW], rtol=1e-6)
    assert rows[0]["labels"] == ["cluster 3: 0.67 m per sweep"]
    assert not rows[1].get("vectors"), "an empty row takes the arrow away"
    assert 1 in rows


def test_truth_is_shown_only_where_it_is_known(recorded: Any) -> None:
    rows = recorded[0][f"{LIDAR}/ground_truth"]
    assert len(rows[0]["positions"]) == 20, "not the wall, whose truth is unknown"
    assert (rgb(rows[0]["colors"]) == flow_to_rgb(CAR_FLOW, 1.5)).all()
    assert 1 in rows and not rows[1].get("positions")


def test_the_ego_vehicle_moves_from_the_origin_of_the_world(recorded: Any) -> None:
    assert {"sweep", "time"} <= set(recorded[1]), "both timelines"
    rows = recorded[0]["world/ego_vehicle"]
    np.testing.assert_allclose(np.ravel(rows[0]["translation"]), [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.ravel(rows[1]["translation"]), [STEP, 0, 0], atol=1e-6)
    (path,) = recorded[0]["world/trajectory"][-1]["strips"]
    np.testing.assert_allclose(path, [[0, 0, 0], [STEP, 0, 0]], atol=1e-6)


def test_a_log_without_labels_poses_and_times(tmp_path: Path) -> None:
    record_log(Street(has_labels=False, has_poses=False, start=None), [(1, result_of())], tmp_path / "a.rrd")
    rows, timelines = read(tmp_path / "a.rrd")
    assert f"{LIDAR}/ground_truth" not in rows and "world/trajectory" not in rows
    assert "time" not in timelines and "sweep" in timelines
    assert sorted(rows[f"{LIDAR}/cflow"]) == [1]
