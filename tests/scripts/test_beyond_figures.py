"""The figures of docs/beyond.md: sets made of a real one, means, kept figures, rows, tables. Truth is constructed."""

from __future__ import annotations

import csv
import importlib
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest
from scenes import pose

from cflow_torch.config import Config
from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.types import CFlowError, Sweep, Window

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
CAR, PEDESTRIAN, NUM_GROUND = 19, 17, 200
SPEED = np.array([0.5, 0.1, 0.0])  # metres per sweep, of the mover below


@pytest.fixture()
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of scripts/ by name."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module


def at(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def block(rng: np.random.Generator, centre: Any, side: float, num_points: int) -> np.ndarray:
    return rng.uniform(-side / 2, side / 2, (num_points, 3)) + centre


def make_pair(seed: int = 0, with_mover: bool = True) -> Any:
    """A driving, turning sensor; a mover, two static blocks large enough to be pasted, one that is too small, one that
    is too long, one that touches a parked object, ground. Returns window, labels, instance."""
    rng = np.random.default_rng(seed)
    T_world_ego = [pose(100.0, 50.0, 0.3), pose(101.0, 50.4, 0.32)]
    T_world_map = pose(100.0, 50.0, 0.3)  # the scene stands here
    long_wall = rng.uniform([-10, -20, 0], [-2, -19.8, 1], (600, 3))
    parts = [
        (block(rng, [10, 3, 0.5], 1.0, 90), 1, CAR, SPEED if with_mover else 0 * SPEED),
        (block(rng, [-8, 6, 0.5], 1.2, 150), 0, 0, 0 * SPEED),
        (block(rng, [-6, -9, 0.5], 2.0, 500), 0, 0, 0 * SPEED),
        (block(rng, [4, 14, 0.5], 0.3, 100), 0, 0, 0 * SPEED),
        (long_wall, 0, 0, 0 * SPEED),
        (block(rng, [12, -6, 0.5], 1.5, 200), 2, CAR, 0 * SPEED),
        (block(rng, [12, -7, 0.5], 1.0, 120), 0, 0, 0 * SPEED),  # touches it
        (rng.uniform([-30, -30, -0.1], [30, 30, 0.0], (NUM_GROUND, 3)), 0, 0, 0 * SPEED),
    ]
    instance = np.concatenate([np.full(len(p), number) for p, number, _, _ in parts])
    category = np.concatenate([np.full(len(p), kind, np.uint8) for p, _, kind, _ in parts])
    is_ground = np.arange(len(instance)) >= len(instance) - NUM_GROUND
    start = np.concatenate([p for p, *_ in parts])
    end = np.concatenate([p + v for p, _, _, v in parts])
    ego = [at(np.linalg.inv(T) @ T_world_map, p) for T, p in zip(T_world_ego, (start, end))]
    sweeps = [Sweep(p.astype(np.float32), is_ground, T, None) for p, T in zip(ego, T_world_ego)]
    labels = FlowLabels((ego[1] - ego[0]).astype(np.float32), category, np.ones(len(start), bool))
    return Window(*sweeps), labels, instance


# ------------------------------------------------------------------------------------------------ longer steps


def test_chained_labels_are_the_motion_over_all_sweeps(script: Any) -> None:
    chain_flow = script("beyond_made").chain_flow
    rng = np.random.default_rng(3)
    T_world_ego = [pose(k * 1.1, k * k * 0.05, 0.04 * k) for k in range(4)]
    shape = {1: block(rng, 0, 3.0, 60), 2: block(rng, 0, 1.0, 30), 3: block(rng, 0, 2.0, 40)}
    T_world_object = {
        1: [pose(10 + 0.7 * k, 5.0, 0.1 * k) for k in range(4)],  # turns
        2: [pose(-6, 8 - 0.2 * k, -0.3 * k) for k in range(4)],
        3: [pose(4, -9 + 0.5 * k, 0.0) for k in range(4)],
    }
    background = rng.uniform(-30, 30, (50, 3))

    def seen(k: int, of: np.ndarray, number: int, by: int) -> np.ndarray:
        T = T_world_object[number][by] if number else np.eye(4)
        return at(np.linalg.inv(T_world_ego[k]) @ T, of)

    pairs: List[Any] = []
    for k in range(3):
        parts, instance, flow, usable = [], [], [], []
        for number, points in {0: background, **shape}.items():
            points = points[rng.permutation(len(points))[: len(points) - k]]  # every sweep sees other points
            if number == 3 and k == 1:
                points = points[:5]  # too few
            good = rng.random(len(points)) < 0.7
            truth = seen(k + 1, points, number, k + 1) - seen(k, points, number, k)
            parts.append(seen(k, points, number, k))
            flow.append(np.where(good[:, None], truth, 9.0))  # what is not usable must not be looked at
            instance.append(np.full(len(points), number))
            usable.append(good)
        pairs.append(tuple(np.concatenate(p) for p in (parts, instance, flow, usable)))
    points, instance = pairs[0][:2]
    pose_flow = at(np.linalg.inv(T_world_ego[3]) @ T_world_ego[0], points) - points
    flow, is_known = chain_flow(pairs, pose_flow)
    assert is_known.tolist() == (instance != 3).tolist()
    truth = pose_flow.copy()
    for number in (1, 2):
        rows = instance == number
        T_world = T_world_object[number]
        own = at(np.linalg.inv(T_world[0]) @ T_world_ego[0], points[rows])
        truth[rows] = seen(3, own, number, 3) - points[rows]
    np.testing.assert_allclose(flow[is_known], truth[is_known], atol=1e-6)
    assert np.abs(truth - pose_flow)[instance == 1].max() > 1.5  # the objects do move


def test_chaining_one_pair_gives_its_stored_labels(script: Any, kitti_file: Path) -> None:
    sets = script("beyond_sets")
    moving = 0
    for one, stored in list(zip(sets.kitti_steps(1), sets.kitti()))[::7]:
        valid = stored.labels.is_valid
        assert (one.labels.is_valid <= valid).all() and one.labels.is_valid.sum() > 0.98 * valid.sum()
        valid = one.labels.is_valid & stored.eval_mask
        np.testing.assert_allclose(one.labels.flow[valid], stored.labels.flow[valid], atol=5e-4)
        moving += (np.linalg.norm(one.labels.flow - one.pose_flow, axis=1)[valid] > 0.05).sum()
    assert moving > 1000


# ------------------------------------------------------------------------------------------------ merge set


def pasted(script: Any, number: int = 0) -> Any:
    pair, labels, instance = make_pair()
    made = script("beyond_made").paste_static(pair, labels, instance, labels.is_valid, number)
    return pair, labels, instance, *made


@pytest.mark.parametrize("number", (0, 1))
def test_what_is_pasted_stands_beside_the_lane_of_the_mover_and_does_not_move(script: Any, number: int) -> None:
    pair, labels, instance, made, made_labels = pasted(script, number)
    n0, n1 = len(pair.pc0.points), len(pair.pc1.points)
    T_ego1_ego0 = np.linalg.inv(made.pc1.pose) @ made.pc0.pose
    mover0 = at(T_ego1_ego0, pair.pc0.points[instance == 1].astype(np.float64))
    mover1 = pair.pc1.points[instance == 1]
    static0, static1 = at(T_ego1_ego0, made.pc0.points[n0:].astype(np.float64)), made.pc1.points[n1:]
    np.testing.assert_allclose(static0, static1, atol=1e-5)  # this scene has the same points in both sweeps
    along = (mover1 - mover0)[:, :2].mean(0)
    along /= np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    across *= np.sign(across @ mover0[:, :2].mean(0))  # away from the sensor
    lane = np.concatenate([mover0, mover1])[:, :2]
    assert (static0[:, :2] @ across).min() - (lane @ across).max() == pytest.approx(0.22, abs=1e-4)
    assert (static0[:, :2] @ along).mean() == pytest.approx((lane @ along).mean(), abs=1e-4)
    item = script("beyond_sets").make_item(made, made_labels)
    residual = item.labels.flow - item.pose_flow
    assert np.abs(residual[n0:]).max() < 1e-5
    assert np.linalg.norm(residual[instance.nonzero()[0][0]]) == pytest.approx(np.linalg.norm(SPEED), abs=1e-4)


def test_pasting_keeps_the_pair_and_adds_a_whole_component(script: Any) -> None:
    counts = set()
    for number in (0, 1, 2):
        pair, labels, _, made, made_labels = pasted(script, number)
        n0, n1 = len(pair.pc0.points), len(pair.pc1.points)
        np.testing.assert_array_equal(made.pc0.points[:n0], pair.pc0.points)
        np.testing.assert_array_equal(made.pc1.points[:n1], pair.pc1.points)
        np.testing.assert_array_equal(made_labels.flow[:n0], labels.flow)
        assert not made.pc0.is_ground[n0:].any() and not made.pc1.is_ground[n1:].any()
        assert len(made_labels.flow) == len(made_labels.category) == len(made_labels.is_valid) == len(made.pc0.points)
        assert made_labels.is_valid[n0:].all() and not made_labels.category[n0:].any()
        assert len(made.pc0.points) - n0 == len(made.pc1.points) - n1  # one mover: one component
        counts.add(len(made.pc0.points) - n0)
    assert counts == {150, 500}  # in turn; neither the small one, nor the long wall, nor the parked object


def test_nothing_is_pasted_where_nothing_moves(script: Any) -> None:
    pair, labels, instance = make_pair(with_mover=False)
    made, made_labels = script("beyond_made").paste_static(pair, labels, instance, labels.is_valid, 0)
    assert made is pair and made_labels is labels


# ------------------------------------------------------------------------------------------------ sets and figures


def make_sets(script: Any, name: str = "kitti h=0", group: str = "real") -> Any:
    """A set of two small windows."""
    sets = script("beyond_sets")
    items = [sets.make_item(*make_pair(seed)[:2]) for seed in (0, 1)]
    return sets.ScoredSet(name, group, 0, 35.0, lambda: items)


def test_sets_have_names_of_their_own_and_the_history_of_their_kind(script: Any, tmp_path: Path) -> None:
    sets = script("beyond_sets")
    made = sets.make_sets(("real", "odd", "sim", "sim0"), [(100, 103), (400, 403)], tmp_path)
    assert len({s.name for s in made}) == len(made) == 6 + 3 + 2 * 2 * 5
    assert all(f"h={s.history}" in s.name for s in made)
    assert {s.half_side for s in made if s.group in ("real", "odd")} == {35.0}
    window = make_sets(script).items()[0].window
    with_history = replace(window, pch=(window.pc0,) * 4)
    item = sets.make_item(with_history, make_pair()[1])
    assert len(sets.ScoredSet("x", "sim", 3, 70.0, lambda: [item]).items()[0].window.pch) == 3


def test_absent_data_is_told_with_a_way_out(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("CFLOW_DATA", str(tmp_path))
    with pytest.raises(CFlowError, match="CFLOW_DATA"):
        script("beyond_sets").data_root()
    script("beyond_sets").kitti.cache_clear()
    script("beyond_sets")._kitti.cache_clear()
    assert script("beyond").main(["score", "--preset", "paper", "--sets", "odd", "--output", str(tmp_path)]) == 2
    assert "CFLOW_DATA" in capsys.readouterr().err


def test_simulated_drives_are_read_with_their_history(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets = script("beyond_sets")
    monkeypatch.setattr(sets, "SIMULATED_SWEEPS", 7)
    monkeypatch.setattr(sets, "SIMULATED_WINDOWS", (4, 5))
    items = sets.simulated("av2", 100, 100, tmp_path)
    assert [len(item.window.pch) for item in items] == [4, 4]
    assert items[0].window.pc1 is items[1].window.pc0
    figures = script("beyond_score").simulated_figures([i.frame(0 * i.pose_flow) for i in items])
    assert figures["near"] == pytest.approx(1) and figures["static"] < 1e-3  # nothing moves: error = speed


def test_means_are_those_of_the_errors_put_in(script: Any) -> None:
    score, item = script("beyond_score"), make_sets(script).items()[0]
    truth = item.labels.flow - item.pose_flow
    walks = item.labels.category.copy()
    walks[:10] = PEDESTRIAN
    walks[80:90] = 0  # moves, but is no object
    item = replace(item, labels=replace(item.labels, category=walks))
    speed = np.linalg.norm(SPEED)
    wrong = truth.copy()
    wrong[:10] *= 0.4  # ten of the 80 points of the mover that count
    static = (walks == 0) & ~item.window.pc0.is_ground
    static[80:90] = False
    wrong[static.nonzero()[0][0], 2] += 0.7
    figures = score.pooled_figures([item.frame(wrong)])
    assert figures["num_dynamic"] == 80 and figures["num_pedestrian"] == 10
    assert figures["pedestrian"] == pytest.approx(0.6, abs=1e-5)
    assert figures["relative"] == pytest.approx(0.6 / 8, abs=1e-5)
    assert figures["dynamic"] == pytest.approx(0.6 * speed / 8, abs=1e-5)
    assert figures["static"] == pytest.approx(0.7 / static.sum(), rel=1e-3)
    assert score.pooled_figures([item.frame(wrong)], step=11)["num_dynamic"] == 0  # slower than 0.55 m in 11 sweeps
    far_points = replace(item.window.pc0, points=item.window.pc0.points + np.float32([50, 0, 0]))
    far = score.pooled_figures([replace(item, window=replace(item.window, pc0=far_points)).frame(wrong)])
    assert far["num_dynamic"] == 0 and np.isnan(far["dynamic"])


def test_classes_of_several_sets_are_those_of_all_their_points(script: Any) -> None:
    score, items = script("beyond_score"), make_sets(script).items()
    frames = [items[0].frame(0.5 * (items[0].labels.flow - items[0].pose_flow)), items[1].frame(0 * items[1].pose_flow)]
    together = score.merge_classes([score.simulated_figures([frame]) for frame in frames])
    metrics = SceneFlowMetrics("challenge_2026_box")
    for frame in frames:
        metrics.update(frame)
    near = metrics.compute()["bucketed_by_range"]["ranges"]["0-35"]["classes"]
    assert together["near"]["CAR"] == near["CAR"]["dynamic_error"] == pytest.approx(0.75, abs=1e-5)


def test_figures_are_kept_and_made_anew_for_other_code(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score, scored = script("beyond_score"), make_sets(script)
    calls: List[Config] = []
    estimate = score.estimate
    monkeypatch.setattr(score, "estimate", lambda s, c: calls.append(c) or estimate(s, c))
    config = script("beyond_rows").PAPER.for_set(scored)
    first = score.Store(tmp_path).get(scored, config)
    again = score.Store(tmp_path).get(scored, config)
    assert len(calls) == 1
    np.testing.assert_equal(again, first)  # also where a figure is NaN: nobody walks here
    assert np.isnan(again["pedestrian"])
    score.Store(tmp_path).get(scored, config.replace(max_speed=40.0))
    score.Store(tmp_path).get(replace(scored, name="other"), config)
    assert len(calls) == 3
    monkeypatch.setattr(score, "code_key", lambda: "other")
    score.Store(tmp_path, any_code=True).get(scored, config)
    assert len(calls) == 3
    score.Store(tmp_path).get(scored, config)
    assert len(calls) == 4


# ------------------------------------------------------------------------------------------------ rows and tables


def differing(one: Config, other: Config) -> Dict[str, Any]:
    return {f.name: getattr(one, f.name) for f in fields(Config) if getattr(one, f.name) != getattr(other, f.name)}


def test_every_row_of_the_ablation_changes_what_its_name_says(script: Any) -> None:
    rows_page = script("beyond_rows")
    rows = {setting.name: setting.config(4, 70.0) for setting in rows_page.ablation()}
    assert len(rows) == len(rows_page.ablation()) and len(set(rows.values())) == len(rows)
    assert {c.num_history for c in rows.values()} == {4}
    assert {c.point_cloud_range[3] for c in rows.values()} == {70.0}
    off, default = Config(), rows["default"]
    for part in differing(default, rows["paper"]):
        if part not in ("proof", "pixel_sizes"):
            assert differing(rows[f"default - {part}"], default) == {part: getattr(off, part)}
            alone = [c for name, c in rows.items() if name.startswith(f"paper + proof + {part}")]
            assert [differing(c, rows["paper + proof"]) for c in alone] == [{part: getattr(default, part)}]
    for part in rows_page.ALONE:
        (alone,) = [c for name, c in rows.items() if name.startswith(f"paper + {part}")]
        assert differing(alone, rows["paper"]) == {part: rows_page.ALONE[part]}


def test_the_target_table_says_what_is_met(script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = script("beyond_tables")
    sums = script("beyond_score").simulated_figures([i.frame(0 * i.pose_flow) for i in make_sets(script).items()])

    def scores(dynamic: float, near: float) -> Any:
        real = {"dynamic": dynamic, "static": 0.001, "pedestrian": 0.2}
        parts = {f"sim {p} 100-103 h=4": {**sums, "near": near, "far": 1.0, "static": 0.1} for p in ("av2", "waymo")}
        return tables.with_means({"kitti h=0": real, **parts})

    cells = tables.target_cells(
        {"paper": scores(0.06, 0.5), "scales": scores(0.06, 0.4), "default": scores(0.035, 0.25), "fast": scores(0, 0)}
    )
    met = {row[0]: row[-2] for row in cells[1:]}
    assert met["KITTI, h = 0: dynamic, m"] == "**no**"  # 0.034 is wanted
    assert met["KITTI, h = 0: static, m"] == "yes"
    assert met["sim 100-103 h=4: dynamic, 0-35 m"] == "**no**"  # half of one paper row, 62 % of the other
    assert met["sim 100-103 h=4: CAR, 0-35 m"] == "yes"
    assert all(len(row) == len(cells[0]) for row in cells)
    assert len(tables.sensor_cells({"paper": scores(0.06, 0.5)})) == 1 + 2


def test_targets_are_written_and_an_interrupted_ablation_goes_on(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    beyond, score, rows = (script(name) for name in ("beyond", "beyond_score", "beyond_rows"))
    monkeypatch.setattr(beyond, "make_sets", lambda *_: [make_sets(script)])
    monkeypatch.setattr(beyond, "ablation", lambda: rows.ablation()[:5])
    calls: List[Config] = []

    def estimate(scored: Any, config: Config) -> Any:
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(config)
        return [item.frame(0 * item.pose_flow) for item in scored.items()]

    monkeypatch.setattr(score, "estimate", estimate)
    command = ["ablation", "--output", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        beyond.main(command)
    assert "| paper, scales .4 .2 .1 |" in (tmp_path / "ablation.md").read_text()
    before = calls.copy()
    calls.clear()
    calls.insert(0, before[0])  # two more may be made
    with pytest.raises(KeyboardInterrupt):
        beyond.main(command)
    monkeypatch.setattr(score, "estimate", lambda s, c: [i.frame(0 * i.pose_flow) for i in s.items()])
    assert beyond.main(command) == beyond.main(["targets", "--output", str(tmp_path)]) == 0
    table = list(csv.DictReader((tmp_path / "ablation.csv").open(encoding="utf-8")))
    assert [row["setting"] for row in table][:2] == ["paper", "paper, scales .4 .2 .1"] and len(table) == 5
    assert table[0]["kitti h=0: dynamic"] == f"{np.linalg.norm(SPEED):.4f}"
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results) == {"ablation", "targets"}
    figures = results["targets"]["settings"]["default"]["figures"]["kitti h=0"]
    assert figures["dynamic"] == pytest.approx(np.linalg.norm(SPEED), abs=1e-5)
    assert "**no**" in (tmp_path / "targets.md").read_text()


def test_times_are_compared_at_equal_scales(script: Any) -> None:
    times, rows = script("beyond_times"), script("beyond_rows")
    scored = make_sets(script)
    timed = times.measure([scored], [rows.PAPER_SCALES, rows.FAST], rounds=2, num_threads=1)
    assert [t.setting for t in timed] == [rows.PAPER_SCALES.name, "fast"]
    assert timed[0].paper_s == timed[0].seconds and timed[0].median() == timed[0].least() == 1
    assert len(timed[1].seconds) == 2 and timed[1].paper_s != timed[1].seconds
    made = times.Timed("x", "y", [1.0, 4.0, 2.0], [3.0, 8.0, 6.0])
    assert made.median() == made.least() == 3
    assert times.time_cells(timed)[1][:3] == [scored.name, "1.00", "1.00"]
