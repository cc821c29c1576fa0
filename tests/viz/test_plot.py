"""Pictures of the stages: what is drawn is what the method computes, and `cflow plot` draws it."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import List

import numpy as np
import pytest
import torch
from oracle import compensate, in_range, match_keypoints, ncc_map, occupancy, project_bev
from oracle.keypoints import gate
from scenes import config, scene

from cflow_torch import CFlowError, Sweep, Window, make_config, make_model
from cflow_torch.cli.main import main
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.viz import plot_clusters, plot_correlation, plot_keypoints, plot_scales, stages
from cflow_torch.viz.coloring import color_numbers
from cflow_torch.viz.film import Frame, flow_figures
from cflow_torch.viz.keypoints import busiest, match_lines
from cflow_torch.viz.occupancy import crop, occupancy_rgb

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
SCALES = {"pixel_sizes": (0.5, 0.25)}
EMPTY = Window(Sweep(np.zeros((0, 3))), Sweep(np.zeros((0, 3))))


def keypoint_config(**overrides: object):  # type: ignore[no-untyped-def]
    return config(method="keypoints", patch_size=7, ratio_threshold=1.02, gate_radius=2.0, **overrides)


def pictures_of(axes: object) -> List[np.ndarray]:
    return [np.asarray(image.get_array()) for image in axes.images]  # type: ignore[attr-defined]


# --- what is drawn


@pytest.mark.parametrize("overrides", [{}, SCALES, {**SCALES, "num_history": 2}])
@pytest.mark.parametrize("method", ["dense", "keypoints"])
def test_scales_are_those_of_the_run(overrides: dict, method: str) -> None:
    if method == "keypoints" and "num_history" in overrides:
        pytest.skip("key points know no history")
    settings = config(**overrides) if method == "dense" else keypoint_config(**overrides)
    sweeps = scene(4, num_history=settings.num_history)
    found, result = stages.scales(sweeps, settings)
    (expected,) = make_model(settings)([sweeps])
    assert torch.equal(result.residual_flow, expected.residual_flow) and result.residual_flow.any()
    assert len(found) == len(settings.pixel_sizes)
    assert (found[-1].flow_after.astype(np.float32) == expected.residual_flow.numpy()).all()
    assert (found[-1].cluster_id == expected.cluster_id.numpy()).all()
    assert not found[0].flow_before.any()
    for coarse, fine in zip(found, found[1:]):
        assert (coarse.flow_after == fine.flow_before).all()

    clouds, cloud1 = compensate(sweeps, settings)
    for scale, size in zip(found, settings.pixel_sizes):
        for images, flow in ((scale.before, scale.flow_before), (scale.after, scale.flow_after)):
            expected0 = clouds[0].points + flow
            for image, points, takes_part in (
                (images.t, expected0, clouds[0].takes_part),
                (images.t1, cloud1.points, cloud1.takes_part),
            ):
                kept = points[takes_part & in_range(points, settings)]
                assert (image == occupancy(project_bev(kept, settings, size), (0, 0, *image.shape))).all()


@pytest.mark.parametrize("overrides", [{}, {"max_speed": 5.0}, {"zero_test": 2.0}, {"subpixel": "parabola"}, SCALES])
def test_the_map_s_peak_is_the_cluster_s_flow(overrides: dict) -> None:
    settings = config(**overrides)
    sweeps = scene(7)
    found, result = stages.scales(sweeps, settings)
    residual, of_point = result.residual_flow.numpy(), result.cluster_id.numpy()
    moving = 0
    for number in range(of_point.max() + 1):
        if not (of_point == number).any():
            continue
        one = stages.cluster_correlation(sweeps, settings, number)
        size = one.images.pixel_size
        full = ncc_map(one.images.t, one.images.t1)
        searched = np.isfinite(one.ncc)
        assert np.allclose(one.ncc[searched], full[searched], atol=1e-15, rtol=0)
        height, width = full.shape
        down, right = np.arange(height)[:, None] - height // 2, np.arange(width) - width // 2
        reach = settings.max_speed * 0.1 / size + 1 if settings.max_speed is not None else np.inf
        assert (searched == (np.hypot(down, right) <= reach)).all()
        dy, dx = np.rint(one.shift).astype(int)
        at_peak = one.ncc[dy + height // 2, dx + width // 2]
        assert abs(at_peak - one.score) < 1e-6
        if "zero_test" not in overrides:
            assert at_peak == np.nanmax(one.ncc)
        rows = of_point == number
        assert one.score == pytest.approx(float(result.score[rows][0]), abs=1e-7)
        step = found[-1].flow_after[rows] - found[-1].flow_before[rows]
        assert np.allclose(step[:, :2], one.shift[::-1] * size, atol=1e-9)
        if len(settings.pixel_sizes) == 1:
            assert (residual[rows, :2] == (one.shift[::-1] * size).astype(np.float32)).all()
        moving += bool(one.shift.any())
    assert moving >= 2


def test_the_map_of_height_slices_adds_up() -> None:
    settings = config(height_slices=4)
    sweeps = scene(7)
    one = stages.cluster_correlation(sweeps, settings)
    dy, dx = one.shift.astype(int)
    height, width = one.ncc.shape
    assert one.ncc[dy + height // 2, dx + width // 2] == np.nanmax(one.ncc) == pytest.approx(one.score, abs=1e-6)
    assert not np.allclose(one.ncc, ncc_map(one.images.t, one.images.t1)), "slices are counted apart"


def test_the_default_cluster_moves_and_another_one_can_be_chosen() -> None:
    sweeps = scene(7)
    chosen = stages.cluster_correlation(sweeps, config())
    (result,) = make_model(config())([sweeps])
    weights = []
    for number in range(int(result.cluster_id.max()) + 1):
        rows = result.cluster_id == number
        if rows.any():
            one = stages.cluster_correlation(sweeps, config(), number)
            assert one.cluster_id == number
            weights.append((one.images.t.sum() * np.linalg.norm(one.flow), number))
    assert chosen.cluster_id == max(weights)[1]
    # Its pixels are where its points are: all in the frame of t+1.
    place = scene(7).pc0.points.astype(float) + result.pose_flow.numpy()
    inside = place[(result.cluster_id == chosen.cluster_id).numpy(), :2]
    pixel = np.floor((inside - chosen.images.lower) / chosen.images.pixel_size + 1e-6).astype(int)
    assert chosen.images.t[pixel[:, 1].clip(0), pixel[:, 0].clip(0)].mean() > 0.99


def test_what_moves_most_is_counted_over_all_scales() -> None:
    settings, sweeps = config(**SCALES), scene(8)
    (result,) = make_model(settings)([sweeps])
    chosen = stages.cluster_correlation(sweeps, settings)
    in_all, last_scale = [], []
    for number in range(int(result.cluster_id.max()) + 1):
        rows = result.cluster_id == number
        if rows.any():
            one = stages.cluster_correlation(sweeps, settings, number)
            flow = np.sort(result.residual_flow[rows].numpy().astype(float), axis=0)
            assert np.allclose(one.total, flow[len(flow) // 2], atol=1e-6)
            in_all.append((one.images.t.sum() * np.linalg.norm(one.total), number))
            last_scale.append((one.images.t.sum() * np.linalg.norm(one.flow), number))
    assert chosen.cluster_id == max(in_all)[1] != max(last_scale)[1]
    assert np.linalg.norm(chosen.total - chosen.flow) > 0.3, "coarser scales have found most of it"
    heading = plot_correlation(sweeps, settings).texts[0].get_text()
    assert "= (+0.25, 0) m beyond the coarser scales" in heading and heading.endswith("in all (+0.75, 0) m")
    alone = plot_correlation(sweeps, config()).texts[0].get_text()
    assert "coarser" not in alone and "in all" not in alone


@pytest.mark.parametrize("overrides", [{}, {"mutual_check": True}, {"densify": "nearest"}])
def test_matches_are_the_matcher_s(overrides: dict) -> None:
    settings = keypoint_config(**overrides)
    sweeps = scene(5)
    found = stages.keypoint_matches(sweeps, settings)
    (cloud,), _ = compensate(sweeps, settings)
    reach = gate(settings, cloud.elapsed, 0.25)
    expected = match_keypoints(found.images.t, found.images.t1, reach, settings)
    assert len(expected) > 20
    assert found.key_points[found.source].tolist() == [[match.row, match.column] for match in expected]
    assert found.shift.tolist() == [[match.dy, match.dx] for match in expected]
    assert np.allclose(found.score, [match.score for match in expected], atol=1e-12)


# --- the pictures


def test_the_lines_drawn_are_the_matches() -> None:
    sweeps, settings = scene(5), keypoint_config()
    found = stages.keypoint_matches(sweeps, settings)
    figure = plot_keypoints(sweeps, settings)
    axes = figure.axes[1]
    lines = [item for item in axes.collections if type(item).__name__ == "LineCollection"][-1].get_segments()
    start, end = match_lines(found)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    shown = (start > (left, bottom)).all(axis=1) & (start < (right, top)).all(axis=1) & found.shift.any(axis=1)
    assert shown.any() and np.allclose(np.array(lines), np.stack([start, end], axis=1)[shown])
    assert np.allclose((start - found.images.lower) / 0.25 - 0.5, found.key_points[found.source][:, ::-1])


def test_the_place_shown_is_where_matches_agree() -> None:
    rng = np.random.default_rng(1)
    agree, cross = np.full((40, 2), 10.0), np.full((60, 2), -20.0)
    start = np.concatenate([agree, cross]) + rng.uniform(0, 1.5, (100, 2))
    flow = np.concatenate([np.full((40, 2), 0.5), rng.uniform(-2, 2, (60, 2))])
    low, high = busiest(start, start + flow)
    assert (low < (10, 10)).all() and (high > (12, 12)).all()
    low, high = busiest(start, start)
    assert np.allclose(low + high, 0), "nothing moves: the ego vehicle"


def test_the_images_drawn_are_the_stages() -> None:
    sweeps, settings = scene(4), config(**SCALES)
    found, _ = stages.scales(sweeps, settings)
    figure = plot_scales(sweeps, settings)
    first, second, last = figure.axes[:3]
    for axes, images in ((first, found[0].before), (second, found[1].before), (last, found[1].after)):
        low, high = (np.array(ends) for ends in zip(axes.get_xlim(), axes.get_ylim()))
        near = crop(images, low, high)
        (image,) = pictures_of(axes)
        assert np.allclose(image, occupancy_rgb(near.t, near.t1)) and near.t.any()
        assert (near.lower <= low).all() or (near.lower == images.lower).any()
    one = stages.cluster_correlation(sweeps, settings)
    figure = plot_correlation(sweeps, settings)
    (image,) = pictures_of(figure.axes[3])
    assert np.array_equal(image, one.ncc)
    assert f"cluster {one.cluster_id}" in figure.texts[0].get_text()


@pytest.mark.parametrize("sizes", [(0.4, 0.2), (0.8, 0.4, 0.2, 0.1), (1.6, 1.2, 0.8, 0.6, 0.4, 0.2, 0.15, 0.1)])
def test_names_of_scales_do_not_overlap(sizes: tuple) -> None:
    figure = plot_scales(scene(4), config(pixel_sizes=sizes))
    figure.canvas.draw()
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert len(panels) == 2 * (len(sizes) + 1)
    boxes = [axes.title.get_window_extent() for axes in panels] + [figure.texts[0].get_window_extent()]
    boxes += [axes.xaxis.label.get_window_extent() for axes in panels if axes.get_xlabel()]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])


@pytest.mark.parametrize("plot", [plot_correlation, plot_keypoints, plot_scales])
def test_a_heading_is_no_formula(plot: object) -> None:
    settings = keypoint_config() if plot is plot_keypoints else config()
    plot(scene(4), settings, title="log $_$ 1").canvas.draw()  # type: ignore[operator]


def test_the_wheel_hides_no_end_of_a_match(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(
        "cflow_torch.viz.keypoints.draw_wheel", lambda axes, position, is_mover, most: seen.append((position, is_mover))
    )
    sweeps, settings = scene(5), keypoint_config()
    figure = plot_keypoints(sweeps, settings)
    lines = [item for item in figure.axes[1].collections if type(item).__name__ == "LineCollection"][-1].get_segments()
    ((position, is_mover),) = seen
    moving = position[is_mover]
    for end in np.concatenate(lines):
        assert np.hypot(*(moving - end).T).min() < 1e-9


def test_every_text_is_inside_its_picture() -> None:
    sweeps = scene(4)
    (result,) = make_model(config())([sweeps])
    box = config().point_cloud_range
    figures = [
        plot_clusters(
            sweeps.pc0.points, result, is_ground=sweeps.pc0.is_ground, point_cloud_range=box, title="A title"
        ),
        plot_correlation(sweeps, config()),
        plot_keypoints(sweeps, keypoint_config()),
        plot_scales(sweeps, config(**SCALES)),
    ]
    for figure in figures:
        figure.canvas.draw()
        width, height = figure.get_size_inches()
        assert width * figure.dpi in (1000, 1600)
        tight = figure.get_tightbbox()  # of everything that is seen, inches
        assert min(tight.x0, tight.y0) >= 0 and tight.x1 <= width and tight.y1 <= height, tight


def test_clusters_next_to_each_other_differ_in_colour() -> None:
    rng = np.random.default_rng(2)
    corner = rng.uniform(-40, 40, (120, 2))
    group = np.repeat(np.arange(120), 30)
    position = corner[group] + rng.uniform(0, 2.5, (len(group), 2))
    color = color_numbers(position, group)
    assert len(color) == 120 and len(set(color.tolist())) == 10
    away = np.abs(corner[:, None] - corner).max(axis=2)
    rows, others = np.nonzero((away < 3.0) & (away > 0))
    assert len(rows) > 50 and (color[rows] != color[others]).all()
    alone = np.where(group == 7, -1, group)
    assert len(color_numbers(position, alone)) == 120 and not len(color_numbers(position[:0], group[:0]))


def test_colours_of_clusters_lie_where_their_points_are() -> None:
    axis = np.arange(0, 4, 0.1)
    block = np.stack(np.meshgrid(axis, axis, [1.0]), axis=-1).reshape(-1, 3)
    points = np.concatenate([block + (10, 10, 0), block + (10, -10, 0), block + (-15, 0, 0)])
    cluster = np.repeat([5, 2, -1], len(block))
    figure = plot_clusters(points, cluster)
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    colors = []
    for x, y in ((12, 12), (12, -8), (-13, 2)):
        column, row = figure.axes[0].transData.transform((x, y))
        colors.append(image[image.shape[0] - 1 - int(round(row)), int(round(column))].astype(int))
    assert np.ptp(colors[0]) > 60 and np.ptp(colors[1]) > 60 and np.ptp(colors[2]) < 20, "two colours and grey"
    assert np.abs(colors[0] - colors[1]).max() > 60


@pytest.mark.parametrize(
    "cluster", [np.zeros(4, int), np.zeros((5, 1), int), np.zeros(5)], ids=["too few", "a column", "no integers"]
)
def test_clusters_refuse(cluster: np.ndarray) -> None:
    with pytest.raises(CFlowError, match="cluster_id"):
        plot_clusters(np.zeros((5, 3)), cluster)


def test_nothing_to_draw() -> None:
    plot_clusters(np.zeros((0, 3)), np.zeros(0, int)).canvas.draw()
    plot_keypoints(EMPTY, keypoint_config()).canvas.draw()
    plot_scales(EMPTY, config(**SCALES)).canvas.draw()
    with pytest.raises(CFlowError, match="no cluster"):
        plot_correlation(EMPTY, config())


@pytest.mark.parametrize("plot", [plot_correlation, plot_scales])
@pytest.mark.parametrize("preset", ["default", "fast"])
def test_the_proof_has_no_such_picture(plot: object, preset: str) -> None:
    with pytest.raises(CFlowError, match="paper"):
        plot(scene(4), make_config(preset))  # type: ignore[operator]


def test_presets_of_their_own_leave_older_sweeps_out() -> None:
    for draw in (plot_correlation, plot_keypoints, plot_scales):
        draw(scene(4, num_history=2))
        with pytest.raises(CFlowError, match="num_history"):
            draw(scene(4, num_history=2), keypoint_config() if draw is plot_keypoints else config())


def test_the_wrong_method_is_named() -> None:
    with pytest.raises(CFlowError, match="keypoints"):
        plot_keypoints(scene(4), config())
    with pytest.raises(CFlowError, match="paper"):
        plot_correlation(scene(4), keypoint_config())
    for absent in (-1, 999):
        with pytest.raises(CFlowError, match=f"cluster_id={absent}"):
            plot_correlation(scene(4), config(), cluster_id=absent)


def test_frames_of_a_film_share_view_and_colours() -> None:
    frames = []
    for seed in (4, 5):
        sweeps = scene(seed)
        (result,) = make_model(config())([sweeps])
        frames.append(Frame(sweeps.pc0.points, result, sweeps.pc0.is_ground, f"scene {seed}"))
    open_box = (-np.inf,) * 3 + (np.inf,) * 3
    for box in (config().point_cloud_range, open_box):
        figures = list(flow_figures(frames, point_cloud_range=box, width=400))
        views, rims = [], []
        for figure in figures:
            figure.canvas.draw()
            assert figure.canvas.get_width_height()[0] == 400
            views.append((figure.axes[0].get_xlim(), figure.axes[0].get_ylim(), figure.canvas.get_width_height()))
            texts = [text.get_text() for text in figure.findobj(lambda item: hasattr(item, "get_text"))]
            rims.append([text for text in texts if text.startswith("rim")])
        assert views[0] == views[1] and rims[0] == rims[1] and len(rims[0]) == 1
    with pytest.raises(CFlowError, match="no frame"):
        list(flow_figures([]))
    with pytest.raises(CFlowError, match="width=10"):
        list(flow_figures(frames, width=10))


# --- the command


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one small simulated log: three pairs."""
    folder = tmp_path_factory.mktemp("drives")
    write_av2_log(make_drive(seed=3, num_sweeps=4), folder)
    return folder


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


def plot(*arguments: object) -> int:
    """Exit status of `cflow plot`."""
    try:
        main(["plot", *map(str, arguments)])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


SMALL = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"


def test_without_any_setting_it_draws_the_simulated_street(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLOW_CACHE", raising=False)
    assert plot("data.num_sweeps=2", "pair=0") == 0
    assert (tmp_path / "outputs/plot/flow.png").read_bytes().startswith(PNG_SIGNATURE)
    printed = capsys.readouterr().out
    assert "outputs/plot/flow.png" in printed and "synthetic-av2-0000" in printed


@pytest.mark.parametrize("picture", ["flow", "clusters", "keypoints", "correlation", "scales"])
def test_every_picture(picture: str, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    extra = [] if picture == "scales" else [SMALL]
    assert plot(f"picture={picture}", "data=av2", f"data.root={drive}", f"output={tmp_path}", "pair=1", *extra) == 0
    assert [file.name for file in tmp_path.iterdir()] == [f"{picture}.png"]
    assert (tmp_path / f"{picture}.png").read_bytes().startswith(PNG_SIGNATURE)
    assert f"picture: {tmp_path / picture}.png" in capsys.readouterr().out


def test_truth_is_residual_and_only_where_it_is_known(drive: Path, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    from cflow_torch.cli import plot as command

    seen = []

    def spy(*arguments: object, **settings: object):  # type: ignore[no-untyped-def]
        seen.append(settings["truth"])
        raise CFlowError("seen")

    monkeypatch.setattr(command, "plot_flow", spy)
    call = ["data=av2", f"data.root={drive}", f"output={tmp_path}", "pair=1", "model=paper"]
    for truth in ("auto", "true", "false"):
        assert plot(*call, f"truth={truth}") == 2
    assert seen[2] is None and np.array_equal(seen[0], seen[1], equal_nan=True)
    log = AV2Log(next(drive.iterdir()))
    labels, sweeps = log.labels(1), window(log, 1)
    transform = np.linalg.inv(sweeps.pc1.pose) @ sweeps.pc0.pose
    points = sweeps.pc0.points.astype(float)
    pose_flow = points @ transform[:3, :3].T + transform[:3, 3] - points
    expected = np.where(labels.is_valid[:, None], labels.flow - pose_flow, np.nan)
    assert np.allclose(seen[0], expected, atol=1e-4, equal_nan=True) and np.nanmax(np.abs(expected)) > 0.3


def test_truth_that_is_not_there(drive: Path, tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(AV2Log, "labels", lambda self, index: None)
    call = ["data=av2", f"data.root={drive}", f"output={tmp_path}", "model=paper", "pair=0", SMALL]
    assert plot(*call, "truth=true") == 2
    assert "truth=true" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert plot(*call) == 0


def test_animation_has_a_picture_for_every_pair(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from PIL import Image

    call = [
        "picture=animation",
        "data=av2",
        f"data.root={drive}",
        f"output={tmp_path}",
        "model=paper",
        "width=300",
        SMALL,
    ]
    assert plot(*call, "first=1") == 0
    assert "2 pairs from 1 to 2" in capsys.readouterr().out
    with Image.open(tmp_path / "animation.gif") as film:
        assert film.n_frames == 2 and film.size[0] == 300
    assert plot(*call, "step=2", "count=1") == 0
    with Image.open(tmp_path / "animation.gif") as film:
        assert getattr(film, "n_frames", 1) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pair=3"], "pair=3"),
        (["pair=-1"], "pair=-1"),
        (["pair=[1,2]"], "pair="),
        (["log=elsewhere"], "log=elsewhere"),
        (["truth=perhaps"], "truth=perhaps"),
        (["max_flow=-1"], "max_flow"),
        (["picture=correlation", "model=default"], "model=paper"),
        (["picture=scales", "model=fast"], "model=paper"),
        (["picture=keypoints", "model=paper"], "model=keypoints"),
        (["picture=correlation", "cluster=100000"], "cluster_id=100000"),
        (["picture=animation", "format=avi"], "format=avi"),
        (["picture=animation", "first=9"], "first=9"),
        (["picture=animation", "step=0"], "step=0"),
        (["picture=animation", "legend=middle", "count=1", "model=paper"], "legend"),
    ],
)
def test_a_wrong_call_says_how_to_mend_it(
    arguments: list, message: str, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert plot("data=av2", f"data.root={drive}", f"output={tmp_path / 'out'}", "pair=0", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


def test_no_folder_can_be_made_there(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    call = ["data=av2", f"data.root={drive}", "model=paper", "pair=0", SMALL]
    assert plot(*call, f"output={tmp_path / 'file' / 'below'}") == 2
    assert "output=FOLDER" in capsys.readouterr().err


def test_a_log_is_found_by_its_name(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (log,) = (folder.name for folder in drive.iterdir())
    call = ["data=av2", f"data.root={drive}", f"output={tmp_path}", "model=paper", "pair=0", "truth=false", SMALL]
    assert plot(*call, f"log={log}") == 0
    assert f"log {log}" in capsys.readouterr().out


def test_a_log_whose_name_is_a_number_to_hydra(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    name = "10203656353524179475_7625_000_7645_000"
    shutil.copytree(next(drive.iterdir()), tmp_path / "root" / name)
    call = ["data=av2", f"data.root={tmp_path / 'root'}", f"output={tmp_path}", "model=paper", "truth=false", SMALL]
    assert plot(*call, f"log={name}", "pair=0") == 0
    assert plot(*call, f"log={name}", "-m", "pair=0,1") == 0
    printed = capsys.readouterr().out
    assert printed.count(f"log {name}, pair 0") == 2 and f"log {name}, pair 1" in printed


def test_a_log_that_is_named_is_checked_like_the_first_one(drive: Path, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    from cflow_torch.cli import plot as command

    checked = []
    monkeypatch.setattr(command, "check_log", lambda log: checked.append(log.log_id))
    (log,) = (folder.name for folder in drive.iterdir())
    call = ["data=av2", f"data.root={drive}", f"output={tmp_path}", "model=paper", "pair=0", f"log={log}", SMALL]
    assert plot(*call, "data.check=false") == 0 and not checked
    assert plot(*call) == 0 and checked == [log]


def test_missing_matplotlib_is_explained(drive: Path, tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    assert plot("data=av2", f"data.root={drive}", f"output={tmp_path}") == 2
    assert "pip install matplotlib" in capsys.readouterr().err
    with pytest.raises(CFlowError, match="pip install matplotlib"):
        plot_scales(scene(4), config())
