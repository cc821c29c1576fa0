"""Pictures: the colours of the wheel, what a bird's-eye view shows and where, and how it is saved."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from cflow_torch import CFlowError, FlowResult
from cflow_torch.data import atomic
from cflow_torch.viz import flow_to_rgb, panel, plot_flow, save_picture, wheel_image

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
CAR_FLOW = np.array([-0.6, 0.0, 0.0])
VAN_FLOW = np.array([0.0, -0.3, 0.0])


def block(x: float, y: float, size: float = 3.0) -> np.ndarray:
    """Square of points, 10 a metre, centred at (x, y)."""
    axis = np.arange(-size / 2, size / 2, 0.1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + (x, y)
    return np.column_stack([grid, np.ones(len(grid))])


@pytest.fixture(scope="module")
def scene():
    """(points, residual flow, cluster): a car at (15, 20), a van at (-20, -8), a wall at (10, -12)."""
    parts = [block(15, 20), block(-20, -8), block(10, -12)]
    which = np.repeat([0, 1, 2], [len(part) for part in parts])
    flow = np.array([CAR_FLOW, VAN_FLOW, np.zeros(3)])[which]
    return np.concatenate(parts), flow.astype(np.float32), which


def result_of(flow: np.ndarray, cluster: np.ndarray) -> FlowResult:
    residual = torch.from_numpy(flow)
    rows = len(residual)
    return FlowResult(
        residual_flow=residual,
        pose_flow=torch.zeros_like(residual),
        flow=residual,
        cluster_id=torch.from_numpy(cluster),
        score=torch.ones(rows),
        is_valid=torch.ones(rows, dtype=torch.bool),
    )


def pixels(figure) -> np.ndarray:
    """(H, W, 3) uint8, row 0 at the top."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def color_at(figure, x: float, y: float, axes: int = 0) -> np.ndarray:
    """RGB of the picture at a position in metres."""
    image = pixels(figure)
    column, row = figure.axes[axes].transData.transform((x, y))
    return image[image.shape[0] - 1 - int(round(row)), int(round(column))]


def quiver_of(axes):
    (arrows,) = [item for item in axes.collections if type(item).__name__ == "Quiver"]
    return arrows


# --- the wheel


@pytest.mark.parametrize(
    ("step", "color"),
    [
        (0, (255, 0, 0)),
        (15, (255, 255, 0)),
        (21, (0, 255, 0)),
        (25, (0, 255, 255)),
        (36, (0, 0, 255)),
        (49, (255, 0, 255)),
    ],
)
def test_primary_hues(step, color):
    angle = 2 * np.pi * step / 54
    assert tuple(flow_to_rgb(np.array([np.cos(angle), np.sin(angle)]))) == color


def test_axes_of_the_ego_frame():
    # By hand: steps 0, 13.5, 27, 40.5 of 54. 13.5 / 15 of green is 229.5, a tie, hence one level either way.
    expected = [(255, 0, 0), (255, 229.5, 0), (0, 255 - 255 * 2 / 11, 255), (255 * 4.5 / 13, 0, 255)]
    rgb = flow_to_rgb(np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]))
    assert np.abs(rgb - np.array(expected)).max() <= 0.5 + 1e-9


def test_zero_flow_is_the_background():
    assert (flow_to_rgb(np.zeros((4, 5, 3))) == 255).all()
    assert (flow_to_rgb(np.zeros((7, 2)), 1.0, (80, 90, 110)) == (80, 90, 110)).all()
    assert (flow_to_rgb(np.array([[np.nan, 0.0], [np.inf, 1.0]])) == 255).all()


def test_saturation_follows_length():
    red = flow_to_rgb(np.array([[0.0, 0], [0.25, 0], [0.5, 0], [1, 0], [2, 0]]), max_flow=1.0)
    assert red.tolist() == [[255, 255, 255], [255, 191, 191], [255, 128, 128], [255, 0, 0], [128, 0, 0]]
    dark = flow_to_rgb(np.array([[0.0, 0], [0.5, 0], [1, 0], [2, 0]]), 1.0, (0, 0, 0))
    assert dark.tolist() == [[0, 0, 0], [128, 0, 0], [255, 0, 0], [255, 128, 128]]


def test_longest_flow_sets_the_scale_and_z_is_ignored():
    flow = np.array([[0.0, 0.2, 9.0], [0.4, 0.0, 0.0]])
    assert (flow_to_rgb(flow) == flow_to_rgb(flow, 0.4)).all()
    assert (flow_to_rgb(torch.from_numpy(flow)) == flow_to_rgb(flow[:, :2])).all()
    assert flow_to_rgb(np.zeros((0, 3))).shape == (0, 3)


def test_wheel_image_has_the_axes_of_the_picture():
    image = wheel_image(101)
    red, yellow = image[50, -2, :3].astype(int), image[1, 50, :3].astype(int)
    assert red[0] == 255 and red[1:].max() < 15
    assert yellow[:2].min() > 220 and yellow[2] < 15
    assert (image[50, 50, :3] > 250).all()
    assert image[0, 0, 3] == 0 and image[50, 50, 3] == 255


@pytest.mark.parametrize(
    "arguments",
    [(np.zeros((3, 1)),), (np.zeros(()),), (np.zeros((3, 2)), 0.0), (np.zeros((3, 2)), float("nan")),
     (np.zeros((3, 2)), 1.0, (0, 0)), (np.zeros((3, 2)), 1.0, (0, 0, 256))],
)  # fmt: skip
def test_wheel_refuses(arguments):
    with pytest.raises(CFlowError):
        flow_to_rgb(*arguments)


# --- the bird's-eye view


def test_colours_lie_where_the_points_are(scene):
    points, flow, cluster = scene
    figure = plot_flow(points, result_of(flow, cluster), max_flow=0.6)
    # A metre off the middle, where the arrow starts.
    assert color_at(figure, 16.0, 21.0).tolist() == [0, 209, 255]
    van = color_at(figure, -19.0, -9.0).astype(int)
    assert np.abs(van - flow_to_rgb(VAN_FLOW, 0.6)).max() <= 1  # matplotlib cuts 128 / 255 * 255 to 127
    wall = color_at(figure, 11.0, -11.0)
    assert np.ptp(wall.astype(int)) < 20 and 150 < wall.mean() < 210
    assert color_at(figure, 15.0, -25.0).tolist() == [255, 255, 255]


def test_one_arrow_per_moving_cluster(scene):
    points, flow, cluster = scene
    for given in (result_of(flow, cluster), flow):  # with clusters, and with groups found from the points
        arrows = quiver_of(plot_flow(points, given).axes[0])
        order = np.argsort(arrows.X)
        assert np.allclose(arrows.X[order], [-20, 15], atol=0.1) and np.allclose(arrows.Y[order], [-8, 20], atol=0.1)
        assert np.allclose(np.stack([arrows.U, arrows.V], 1)[order], [VAN_FLOW[:2], CAR_FLOW[:2]], atol=1e-6)
        assert arrows.scale == 1 / panel.ARROW_STEPS


def test_group_medians_match_a_loop():
    rng = np.random.default_rng(3)
    group, values = rng.integers(-1, 6, 501), rng.normal(size=(501, 3))
    median, count = panel.group_medians(group, values)
    assert count.tolist() == [(group == g).sum() for g in range(6)]
    for g in range(6):
        ranked = np.sort(values[group == g], axis=0)
        assert (median[g] == ranked[len(ranked) // 2]).all()


def test_ground_is_faint_and_what_is_outside_is_gone(scene):
    points, flow, cluster = scene
    ground = cluster == 0
    figure = plot_flow(points, flow, is_ground=ground, point_cloud_range=(-15, -30, -5, 30, 30, 5))
    assert color_at(figure, 16.0, 21.0).min() > 230  # the car, declared ground
    assert len(quiver_of(figure.axes[0]).X) == 0  # the van is outside


def test_truth_adds_truth_and_error(scene):
    points, flow, cluster = scene
    truth = flow.copy()
    truth[cluster == 0] = [-0.6, 0.5, 0.0]  # 0.5 m wrong: white
    truth[cluster == 1] = [0.0, -0.26, 0.0]  # 0.04 m wrong: none
    truth[cluster == 2] = np.nan
    figure = plot_flow(points, result_of(flow, cluster), truth=truth)
    assert [axes.get_title() for axes in figure.axes[:3]] == ["estimate", "ground truth", "error"]
    expected = flow_to_rgb(truth[0], 0.8).astype(int)  # longest is 0.78 m
    assert np.abs(color_at(figure, 16.0, 21.0, axes=1) - expected).max() <= 1
    assert color_at(figure, 16.0, 21.0, axes=2).tolist() == [255, 255, 255]
    assert color_at(figure, -19.0, -9.0, axes=2).max() < 15
    assert color_at(figure, 11.0, -11.0, axes=2).tolist() == [80, 90, 110]


@pytest.mark.parametrize("rows", [0, 1, 40])
def test_few_or_unknown_points(rows):
    points = np.full((rows, 3), 3.0)
    flow = np.full((rows, 3), np.nan)
    for box in (None, (-np.inf,) * 3 + (np.inf,) * 3):
        image = pixels(plot_flow(points, flow, truth=flow, point_cloud_range=box))
        assert image.shape[1] == 1792


def test_texts_are_inside_the_picture(scene):
    points, flow, _ = scene
    for box in (None, (-2, -40, -5, 30, 40, 5), (-30, -5, -5, 40, 5, 5)):
        for truth in (None, flow):
            figure = plot_flow(points, flow, truth=truth, title="A title", point_cloud_range=box)
            figure.canvas.draw()
            width, height = figure.canvas.get_width_height()
            texts = [text for text in figure.findobj(lambda item: hasattr(item, "get_text")) if text.get_text()]
            assert any(text.get_text() == "ego" for text in texts)
            for text in texts:
                place = text.get_window_extent()
                assert min(place.x0, place.y0) >= 0 and place.x1 <= width and place.y1 <= height, text


@pytest.mark.parametrize(("reach", "step"), [(35, 10), (51.2, 10), (159, 10), (200, 20), (1e6, 1e5)])
def test_rings_are_few_however_wide_the_view_is(reach, step):
    from matplotlib.patches import Circle

    points = np.array([[reach, 0.0, 0.0], [-reach, 0, 0], [0, 1, 0]])
    figure = plot_flow(points, np.zeros((3, 3)), point_cloud_range=(-reach, -reach, -5, reach, reach, 5))
    radii = [item.get_radius() for item in figure.axes[0].patches if isinstance(item, Circle)]
    assert 3 <= len(radii) <= 20 and np.allclose(radii, step * np.arange(1, len(radii) + 1))
    assert f"rings: every {step:g} m" in figure.texts[-1].get_text()


def test_one_stray_return_costs_no_time():
    points = np.random.default_rng(0).uniform(-40, 40, (2000, 3))
    points[0] = (1e6, 0, 0)
    figure = plot_flow(points, np.zeros((2000, 3)), point_cloud_range=(-np.inf,) * 3 + (np.inf,) * 3)
    assert len(figure.axes[0].patches) < 30
    assert pixels(figure).shape[1] == 1000


@pytest.mark.parametrize("title", ["log $_$ 1", "cost: 3$ and 4$", "a_b^c"])
def test_a_log_s_name_is_no_formula(scene, title):
    points, flow, _ = scene
    figure = plot_flow(points, flow, title=title)
    pixels(figure)  # raised an error
    (heading,) = [text for text in figure.texts if text.get_text() == title]
    bare = plot_flow(points, flow, title=title.replace("$", ""))
    (other,) = [text for text in bare.texts if text.get_text() == title.replace("$", "")]
    dollars = title.count("$")
    assert (heading.get_window_extent().width > other.get_window_extent().width) == (dollars > 0), "a $ is a letter"


def test_a_long_heading_fits(scene):
    points, flow, _ = scene
    figure = plot_flow(points, flow, title="a log with a name that is longer than a picture is wide, " * 3)
    pixels(figure)
    place = figure.texts[0].get_window_extent()
    assert place.x0 >= 0 and place.x1 <= 1000


@pytest.mark.parametrize(
    ("box", "length"),
    [((-51.2, 51.2), 10), ((-35, 35), 10), ((-4, 4), 1), ((-15, 15), 5), ((-400, 400), 100), ((-0.05, 0.05), 0.01)],
)
def test_the_scale_bar_fits(scene, box, length):
    points, flow, _ = scene
    for truth in (None, flow):
        low, high = box
        figure = plot_flow(points, flow, truth=truth, point_cloud_range=(low, low, -5, high, high, 5))
        x, y = figure.axes[0].lines[0].get_data()
        assert np.diff(x) == pytest.approx(length) and low < x[0] < x[1] < high
        assert f"{length:g} m" in [text.get_text() for text in figure.axes[0].texts]


@pytest.mark.parametrize("box", [(-100, -1, -5, 100, 1, 5), (-1, -100, -5, 1, 100, 5), (0, 0, -5, 1e-3, 50, 5)])
def test_a_long_thin_view_is_a_picture_too(scene, box):
    points, flow, _ = scene
    for truth in (None, flow):
        figure = plot_flow(points, flow, truth=truth, point_cloud_range=box, title="thin")
        figure.canvas.draw()
        width, height = figure.canvas.get_width_height()
        assert width / 3.5 < height < 2.2 * width
        panel_box = figure.axes[0].get_window_extent()
        assert panel_box.width > 500 and panel_box.height > 300
        (legend,) = [child for child in figure.axes[0].child_axes if child.images]
        frame = legend.get_window_extent()
        assert panel_box.x0 < frame.x0 and frame.x1 < panel_box.x1 and panel_box.y0 < frame.y0
        rim = legend.texts[0].get_window_extent()
        assert frame.x0 < rim.x0 and rim.x1 < frame.x1 and rim.y0 > frame.y0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"points": np.zeros((5, 2))}, "points has shape"),
        ({"result_or_residual": np.zeros((4, 3))}, "residual flow has shape"),
        ({"truth": np.zeros((4, 3))}, "truth has shape"),
        ({"is_ground": np.zeros(4, bool)}, "is_ground has shape"),
        ({"max_flow": -1.0}, "max_flow"),
        ({"point_cloud_range": (0, 0, 1, 1)}, "point_cloud_range"),
        ({"point_cloud_range": (0, 0, 0, 1, 0, 1)}, "point_cloud_range"),
    ],
)
def test_plot_refuses(changed, message):
    arguments = {"points": np.zeros((5, 3)), "result_or_residual": np.zeros((5, 3)), **changed}
    points, flow = arguments.pop("points"), arguments.pop("result_or_residual")
    with pytest.raises(CFlowError, match=message):
        plot_flow(points, flow, **arguments)


def test_missing_matplotlib_is_explained(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.patches", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(CFlowError, match="pip install matplotlib"):
        plot_flow(np.zeros((5, 3)), np.zeros((5, 3)))


def test_import_is_lazy_and_without_pyplot():
    code = (
        "import sys, numpy as np\n"
        "from cflow_torch.viz import plot_flow\n"
        "assert 'matplotlib' not in sys.modules\n"
        "plot_flow(np.zeros((5, 3)), np.zeros((5, 3)))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    root = Path(__file__).resolve().parents[2]
    subprocess.run([sys.executable, "-c", code], cwd=str(root), check=True)


# --- the file


def test_saved_picture(scene, tmp_path):
    from matplotlib.image import imread

    points, flow, cluster = scene
    figure = plot_flow(points, result_of(flow, cluster), max_flow=0.6)
    path = save_picture(figure, tmp_path / "flow.png")
    assert path.read_bytes()[:8] == PNG_SIGNATURE
    image = np.rint(imread(str(path))[..., :3] * 255).astype(np.uint8)
    assert image.shape[1] == 1000 and 960 <= image.shape[0] <= 1060
    assert (image == pixels(figure)).all()
    is_cyan = (image == (0, 209, 255)).all(axis=2)
    row, column = np.argwhere(is_cyan).mean(axis=0)
    x, y = figure.axes[0].transData.inverted().transform((column, image.shape[0] - row))
    assert is_cyan.sum() > 500 and np.hypot(x - 15, y - 20) < 1
    assert [file.name for file in tmp_path.iterdir()] == ["flow.png"]


@pytest.mark.parametrize("stage", ["savefig", "replace"])
def test_a_failed_save_leaves_the_old_file(scene, tmp_path, monkeypatch, stage):
    points, flow, _ = scene
    path = tmp_path / "flow.png"
    path.write_bytes(b"old")
    figure = plot_flow(points, flow)

    def half(target, **settings):
        target.write(b"half")
        raise OSError("disk full")

    def refuse(*paths):
        raise OSError("disk full")

    if stage == "savefig":
        monkeypatch.setattr(figure, "savefig", half)
    else:
        monkeypatch.setattr(atomic.os, "replace", refuse)
    with pytest.raises(CFlowError, match="disk full"):
        save_picture(figure, path)
    assert path.read_bytes() == b"old"
    assert os.listdir(str(tmp_path)) == ["flow.png"]


def test_save_refuses_other_endings_and_missing_folders(scene, tmp_path):
    points, flow, _ = scene
    figure = plot_flow(points, flow)
    with pytest.raises(CFlowError, match=r"\.png"):
        save_picture(figure, tmp_path / "flow.pdf")
    with pytest.raises(CFlowError, match="does not exist"):
        save_picture(figure, tmp_path / "absent" / "flow.png")
