"""Bird's-eye pictures of flow and clusters: positions, colours, legends, and the saved file; the colour wheel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Tuple

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.image import imread

from cflow_torch import CFlowError, FlowResult
from cflow_torch.viz import flow_to_rgb, panel, plot_clusters, plot_flow, plot_map, save_picture, wheel_image
from cflow_torch.viz.animation import AnimatedPair, flow_figures
from cflow_torch.viz.clusters import PALETTE, cluster_colors

CAR_FLOW = np.array([-0.6, 0.0, 0.0])
VAN_FLOW = np.array([0.0, -0.3, 0.0])
OPEN = (-np.inf,) * 3 + (np.inf,) * 3
Scene = Tuple[np.ndarray, np.ndarray, np.ndarray]


def block(x: float, y: float, size: float = 3.0, step: float = 0.1) -> np.ndarray:
    """Square of points every `step` metres, centred at (x, y)."""
    axis = np.arange(-size / 2, size / 2, step)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + (x, y)
    return np.column_stack([grid, np.ones(len(grid))])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """(points, residual flow, cluster): a car at (15, 20), a van at (-20, -8), a wall at (10, -12)."""
    parts = [block(15, 20), block(-20, -8), block(10, -12)]
    which = np.repeat([0, 1, 2], [len(part) for part in parts])
    flow = np.array([CAR_FLOW, VAN_FLOW, np.zeros(3)])[which]
    return np.concatenate(parts), flow.astype(np.float32), which


def result_of(flow: np.ndarray, cluster: np.ndarray) -> FlowResult:
    residual = torch.from_numpy(flow)
    ones = torch.ones(len(flow))
    return FlowResult(residual, 0 * residual, residual, torch.from_numpy(cluster), ones, ones > 0)


def pixels(figure: Figure) -> np.ndarray:
    """(H, W, 3) uint8, row 0 at the top."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def colors_at(figure: Figure, *positions: tuple[float, float], axes: int = 0) -> np.ndarray:
    """(K, 3) int, RGB of the picture at positions in metres."""
    image = pixels(figure)
    column, row = np.rint(figure.axes[axes].transData.transform(positions)).astype(int).T
    return image[len(image) - 1 - row, column].astype(int)


def test_colours_lie_where_the_points_are(scene: Scene) -> None:
    points, flow, cluster = scene
    figure = plot_flow(points, result_of(flow, cluster), max_flow=0.6)
    # A metre off the middle, where the arrow starts.
    car, van, wall, nothing = colors_at(figure, (16.0, 21.0), (-19.0, -9.0), (11.0, -11.0), (15.0, -25.0))
    assert car.tolist() == [0, 209, 255]
    assert np.abs(van - flow_to_rgb(VAN_FLOW, 0.6)).max() <= 1  # matplotlib cuts 128 / 255 * 255 to 127
    assert np.ptp(wall) < 20 and 150 < wall.mean() < 210
    assert nothing.tolist() == [255, 255, 255]


def test_what_is_probably_static_is_grey_and_has_no_arrow(scene: Scene) -> None:
    points, flow, cluster = scene
    result = result_of(flow, cluster)
    unlikely = replace(result, moving=torch.from_numpy(np.where(cluster == 0, 0.4, 0.6)))
    for each, is_grey, num_arrows in ((result, False, 2), (unlikely, True, 1)):
        figure = plot_flow(points, each, max_flow=0.6)
        (car,) = colors_at(figure, (14.0, 21.0))
        assert (np.ptp(car) < 30) == is_grey
        assert sum(len(each.get_offsets()) for each in figure.axes[0].collections if hasattr(each, "U")) == num_arrows


def test_one_arrow_per_moving_cluster(scene: Scene) -> None:
    points, flow, cluster = scene
    expected = [[-20, -8, *VAN_FLOW[:2]], [15, 20, *CAR_FLOW[:2]]]
    for given in (result_of(flow, cluster), flow):  # with clusters, and with groups found from the points
        (arrows,) = [each for each in plot_flow(points, given).axes[0].collections if type(each).__name__ == "Quiver"]
        found = np.column_stack([arrows.X, arrows.Y, arrows.U, arrows.V])
        assert np.allclose(found[np.argsort(found[:, 0])], expected, atol=0.1)
        assert arrows.scale == 1 / panel.ARROW_STEPS


def test_truth_adds_truth_and_error(scene: Scene) -> None:
    points, flow, cluster = scene
    truth = flow.copy()
    truth[cluster == 0] = [-0.6, 0.5, 0.0]  # 0.5 m wrong: white
    truth[cluster == 1] = [0.0, -0.26, 0.0]  # 0.04 m wrong: none
    truth[cluster == 2] = np.nan
    figure = plot_flow(points, result_of(flow, cluster), truth=truth)
    assert [axes.get_title() for axes in figure.axes[:3]] == ["estimate", "ground truth", "error"]
    (car,) = colors_at(figure, (16.0, 21.0), axes=1)
    assert np.abs(car - flow_to_rgb(truth[0], 0.8)).max() <= 1  # longest is 0.78 m
    large, none, unknown = colors_at(figure, (16.0, 21.0), (-19.0, -9.0), (11.0, -11.0), axes=2)
    assert large.tolist() == [255, 255, 255] and none.max() < 15 and unknown.tolist() == [80, 90, 110]


def test_a_map_is_coloured_by_height_and_the_highest_points_are_on_top() -> None:
    far = np.array([5e5, 4e6, 300.0])  # metres, as in UTM
    low, high, above = block(0, 0, 30, 0.14), block(20, 20, 9) + (0, 0, 8), block(10, -10) + (0, 0, 8)
    figure = plot_map(np.concatenate([above, low, high, [[np.nan] * 3]]) + far, "hill")
    at = [tuple(far[:2] + xy) for xy in ((0.0, 0.0), (20.0, 20.0), (10.0, -10.0), (-12.0, 22.0))]
    yellow, dark, covering, nothing = colors_at(figure, *at)
    assert yellow[0] > 240 and dark.max() < 90 and covering.max() < 90 and nothing.tolist() == [255, 255, 255]
    pixels(plot_map(np.zeros((0, 3))))


@pytest.mark.parametrize("rows", [0, 40])
def test_few_or_unknown_points(rows: int) -> None:
    points, flow = np.full((rows, 3), 3.0), np.full((rows, 3), np.nan)
    assert pixels(plot_flow(points, flow, truth=flow, point_cloud_range=OPEN)).shape[1] == 1792
    pixels(plot_clusters(points, np.zeros(rows, int)))


@pytest.mark.parametrize(
    "box",
    [
        *(None, (0, 0, -5, 1e-3, 50, 5)),
        *(pytest.param(box, marks=pytest.mark.slow) for box in ((-2, -40, -5, 30, 40, 5), (-100, -1, -5, 100, 1, 5))),
    ],
)
def test_everything_is_inside_the_picture(scene: Scene, box: tuple) -> None:
    points, flow, cluster = scene
    title = "a log with a name that is longer than a picture is wide, " * 3
    figures = [plot_flow(points, flow, truth=truth, title=title, point_cloud_range=box) for truth in (None, flow)]
    figures.append(plot_clusters(points, cluster, title=title, point_cloud_range=box))
    for figure in figures:
        figure.canvas.draw()
        (width, height), seen = figure.get_size_inches(), figure.get_tightbbox()
        assert width / 3.5 < height < 2.2 * width
        assert min(seen.x0, seen.y0) >= 0 and seen.x1 <= width and seen.y1 <= height
        frame = figure.axes[0].get_window_extent()
        assert frame.width > 500 and frame.height > 300
        texts = [text.get_text() for text in figure.axes[0].texts]
        low, high = figure.axes[0].get_xlim()
        assert ("ego" in texts) == (low <= 0 <= high)


def test_colours_of_clusters_lie_where_their_points_are() -> None:
    points = np.concatenate([block(12, 12), block(12, -8), block(-13, 2)])
    cluster = np.repeat([5, 2, -1], len(points) // 3)
    first, second, none = colors_at(plot_clusters(points, cluster), (12, 12), (12, -8), (-13, 2))
    assert {tuple(first), tuple(second)} == {tuple(color) for color in PALETTE[:2]}
    assert np.ptp(none) < 20


def test_clusters_next_to_each_other_differ_in_colour() -> None:
    rng = np.random.default_rng(2)
    corner = rng.uniform(-40, 40, (120, 2))
    cluster = np.repeat(np.arange(120), 30)
    colors = cluster_colors(corner[cluster] + rng.uniform(0, 2.5, (3600, 2)), cluster, (0, 0, 0))
    assert len(np.unique(colors, axis=0)) == len(PALETTE), "all colours are used"
    of_cluster = colors[::30].astype(int)
    away = np.abs(corner[:, None] - corner).max(axis=2)
    one, other = np.nonzero((away < 3.0) & (away > 0))
    assert len(one) > 50 and (of_cluster[one] != of_cluster[other]).any(axis=1).all()
    assert (colors.reshape(120, 30, 3) == colors[::30, None]).all(), "one colour per cluster"
    none = cluster_colors(np.zeros((2, 2)), np.array([-1, -1]), (1, 2, 3))
    assert none.tolist() == [[1, 2, 3]] * 2


def test_frames_of_an_animation_share_view_and_colours(scene: Scene) -> None:
    points, flow, cluster = scene
    frames = [
        AnimatedPair(points, result_of(flow, cluster)),
        AnimatedPair(1.2 * points, result_of(0.5 * flow, cluster), cluster < 1),
    ]
    for box in (None, OPEN):
        views, rims = [], []
        for figure in flow_figures(frames, point_cloud_range=box, width=400):
            figure.canvas.draw()
            assert figure.canvas.get_width_height()[0] == 400
            views.append((figure.axes[0].get_xlim(), figure.axes[0].get_ylim(), figure.canvas.get_width_height()))
            texts = [text.get_text() for text in figure.findobj(lambda item: hasattr(item, "get_text"))]
            rims.append([text for text in texts if text.startswith("rim")])
        assert views[0] == views[1] and rims[0] == rims[1] and rims[0][0].startswith("rim: 0.6 m")
    with pytest.raises(CFlowError, match="width=10"):
        list(flow_figures(frames, width=10))


def test_a_saved_picture_is_the_picture(scene: Scene, tmp_path: Path) -> None:
    points, flow, cluster = scene
    figure = plot_flow(points, result_of(flow, cluster), max_flow=0.6)
    path = save_picture(figure, tmp_path / "new" / "flow.png")
    assert (np.rint(imread(str(path))[..., :3] * 255) == pixels(figure)).all()
    assert [file.name for file in path.parent.iterdir()] == ["flow.png"]


def test_axes_of_the_ego_frame() -> None:
    # By hand: steps 0, 13.5, 27, 40.5 of 54. 13.5 / 15 of green is 229.5, a tie, hence one level either way.
    expected = [(255, 0, 0), (255, 229.5, 0), (0, 255 - 255 * 2 / 11, 255), (255 * 4.5 / 13, 0, 255)]
    rgb = flow_to_rgb(np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]))
    assert np.abs(rgb - np.array(expected)).max() <= 0.5 + 1e-9


def test_saturation_follows_length() -> None:
    red = flow_to_rgb(np.array([[0.0, 0], [0.25, 0], [0.5, 0], [1, 0], [2, 0]]), max_flow=1.0)
    assert red.tolist() == [[255, 255, 255], [255, 191, 191], [255, 128, 128], [255, 0, 0], [128, 0, 0]]
    assert (flow_to_rgb(np.array([[np.nan, 0.0], [np.inf, 1.0]])) == 255).all()


def test_wheel_image_has_the_axes_of_the_picture() -> None:
    image = wheel_image(101)
    red, yellow = image[50, -2, :3].astype(int), image[1, 50, :3].astype(int)
    assert red[0] == 255 and red[1:].max() < 15
    assert yellow[:2].min() > 220 and yellow[2] < 15
    assert (image[50, 50, :3] > 250).all()
    assert image[0, 0, 3] == 0 and image[50, 50, 3] == 255
