"""Pictures of the stages show what the method computes."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from oracle import compensate, in_range, ncc_map, occupancy, project_bev
from preset_windows import small
from scenes import ell, scene

from cflow_torch import CFlowError, Config, Sweep, Window, make_config, make_model
from cflow_torch.viz import plot_correlation, plot_keypoints, plot_scales, stages

SIZE = 0.25
TWO_SIZES = {"pixel_sizes": (0.5, 0.25)}
paper, keypoints = partial(small, "paper", num_history=0), partial(small, "keypoints", patch_size=7)
EMPTY = Window(Sweep(np.zeros((0, 3))), Sweep(np.zeros((0, 3))))


def one_object() -> Window:
    """An angle of points that moves by (1, -0.5) m."""
    points = ell(np.random.default_rng(0), 4.0, 1.8, 1.5, 600) - (3.06, 1.06, 0.0)
    return Window(Sweep(points), Sweep(points + (1.0, -0.5, 0.0)))


@pytest.mark.parametrize(
    "settings", [paper(), paper(**TWO_SIZES, num_history=2), keypoints(**TWO_SIZES)], ids=["one", "history", "keys"]
)
def test_scales_are_those_of_the_run(settings: Config) -> None:
    sweeps = scene(4, num_history=settings.num_history)
    found, result = stages.scales(sweeps, settings)
    (expected,) = make_model(settings)([sweeps])
    assert torch.equal(result.residual_flow, expected.residual_flow) and result.residual_flow.any()
    assert len(found) == len(settings.pixel_sizes)
    assert (found[-1].flow.astype(np.float32) == expected.residual_flow.numpy()).all()

    clouds, cloud1 = compensate(sweeps, settings)
    before = np.zeros_like(clouds[0].points)
    for scale, size in zip(found, settings.pixel_sizes):
        for images, flow in ((scale.seen(), before), (scale.result(), scale.flow)):
            moved = clouds[0].points + flow
            for image, points, cloud in ((images.t, moved, clouds[0]), (images.t1, cloud1.points, cloud1)):
                kept = points[cloud.is_active & in_range(points, settings)]
                assert (image == occupancy(project_bev(kept, settings, size), (0, 0, *image.shape))).all()
        before = scale.flow


@pytest.mark.parametrize("overrides", [{}, {"max_speed": 5.0}, {"correlation": "conv", **TWO_SIZES}])
def test_the_peak_of_the_map_is_the_flow_of_the_cluster(overrides: dict) -> None:
    settings, sweeps = paper(**overrides), scene(7)
    found, result = stages.scales(sweeps, settings)
    of_point, moving = result.cluster_id.numpy(), 0
    before = found[-2].flow if len(found) > 1 else np.zeros((len(of_point), 3))
    for number in np.unique(of_point[of_point >= 0]):
        one, rows = stages.cluster_correlation(sweeps, settings, int(number)), of_point == number
        full, searched = ncc_map(one.images.t, one.images.t1), np.isfinite(one.ncc)
        assert np.allclose(one.ncc[searched], full[searched], atol=1e-12, rtol=0)
        height, width = full.shape
        down, right = np.arange(height)[:, None] - height // 2, np.arange(width) - width // 2
        reach = np.inf if settings.max_speed is None else settings.max_speed * 0.1 / SIZE + 1
        assert (searched == (np.hypot(down, right) <= reach)).all()
        dy, dx = one.shift
        assert one.ncc[dy + height // 2, dx + width // 2] == np.nanmax(one.ncc) == pytest.approx(one.score, abs=1e-6)
        assert one.score == pytest.approx(float(result.score[rows][0]), abs=1e-6)
        assert np.allclose((found[-1].flow - before)[rows][:, :2], np.array((dx, dy)) * SIZE, atol=1e-6)
        assert np.allclose(one.flow, np.median(found[-1].flow[rows], axis=0), atol=SIZE)
        moving += bool(one.shift.any())
    assert moving >= 2


def test_matches_of_one_object_are_its_motion() -> None:
    found = stages.keypoint_matches(one_object(), keypoints())
    assert np.allclose(found.end - found.start, (1.0, -0.5)) and len(found.start) > 10
    col, row = np.floor((found.key_points - found.images.lower) / SIZE).astype(int).T
    assert found.images.t[row, col].all() and len(row) > len(found.start)


def test_scales_and_correlation_draw_the_stages() -> None:
    sweeps, settings = scene(8), paper(**TWO_SIZES)
    (coarse, fine), _ = stages.scales(sweeps, settings)
    panels = plot_scales(sweeps, settings).axes
    for axes, images in zip(panels, (coarse.seen(), fine.seen(), fine.result())):
        assert np.array_equal(axes.images[0].get_array(), images.rgb())
        assert np.allclose(axes.images[0].get_extent()[::2], images.lower)
    one = stages.cluster_correlation(sweeps, settings)
    figure = plot_correlation(sweeps, settings)
    t, t1, both, ncc = (np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images)
    assert np.array_equal(ncc, one.ncc)
    assert ((t != 255).any(axis=2) == one.images.t).all() and ((t1 != 255).any(axis=2) == one.images.t1).all()
    row, col = np.argwhere(one.images.t).T + one.shift[:, None]
    inside = (row >= 0) & (col >= 0) & (row < len(t)) & (col < t.shape[1])
    expected = one.images.t1.copy()
    expected[row[inside], col[inside]] = True
    assert ((both != 255).any(axis=2) == expected).all(), "moved by the shift, and nothing wraps around"
    heading = figure.texts[0].get_text()
    dx, total = one.shift[1], one.flow[0]
    assert heading.startswith(f"cluster {one.cluster_id}: moves by ({dx:+d}, ") and one.shift.any()
    assert f"with coarser scales ({total:+.3g}, " in heading and abs(total - dx * SIZE) > 0.3
    assert "with" not in plot_correlation(sweeps, paper()).texts[0].get_text()


def test_scales_show_the_longest_mover_or_the_chosen_cluster() -> None:
    """The close-up shows the cluster that the correlation shows, whatever coarse to fine changes."""
    sweeps, settings = scene(8), paper(**TWO_SIZES)
    found, result = stages.scales(sweeps, settings)
    of_point, speed = result.cluster_id.numpy(), result.residual_flow.numpy()
    lengths = {n: np.linalg.norm(np.median(speed[of_point == n], 0)) for n in set(of_point) - {-1}}
    longest = max(lengths, key=lambda n: lengths[n] * (of_point == n).sum())
    assert stages.cluster_correlation(sweeps, settings).cluster_id == longest
    start = np.asarray(sweeps.pc0.points) + result.pose_flow.numpy()
    for chosen, number in ((None, longest), (int(min(lengths)), min(lengths))):
        figure = plot_scales(sweeps, settings, cluster_id=chosen)
        assert f"cluster {number}" in figure.texts[0].get_text()
        ends = np.concatenate([start, start + found[-1].flow])[np.tile(of_point == number, 2), :2]
        limits = np.array([figure.axes[0].get_xlim(), figure.axes[0].get_ylim()])
        assert np.allclose(limits.mean(axis=1), (ends.min(axis=0) + ends.max(axis=0)) / 2)
    with pytest.raises(CFlowError, match="cluster=100000 is not a cluster"):
        plot_scales(sweeps, settings, cluster_id=100000)


def test_the_cluster_with_the_largest_product_of_points_and_flow_is_chosen() -> None:
    of_point = np.repeat([-1, 0, 1, 2], [200, 10, 3, 100])
    flow = np.array([9.0, 1.0, 2.0, 0.05])[of_point + 1, None] * [0.6, -0.8, 0.0]
    assert stages.choose_cluster(of_point, flow) == 0 and stages.choose_cluster(of_point[:200], flow[:200]) is None


def test_matches_are_drawn_and_the_wheel_covers_none(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("cflow_torch.viz.style.draw_wheel", lambda axes, *given: seen.append(given))
    sweeps, settings = scene(5), keypoints()
    found = stages.keypoint_matches(sweeps, settings)
    axes = plot_keypoints(sweeps, settings).axes[1]
    lines = [item for item in axes.collections if type(item).__name__ == "LineCollection"][-1].get_segments()
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    shown = ((found.start > low) & (found.start < high) & (found.start != found.end).any(axis=1)[:, None]).all(axis=1)
    assert shown.any() and np.allclose(np.array(lines), np.stack([found.start, found.end], axis=1)[shown])
    ((position, moves, _),) = seen
    for end in np.concatenate(lines):
        assert np.hypot(*(position[moves] - end).T).min() < 1e-9


def test_every_text_is_inside_its_picture() -> None:
    sweeps = scene(4)
    figures = [
        plot_correlation(sweeps, paper()),
        plot_keypoints(sweeps, keypoints()),
        plot_scales(sweeps, paper(**TWO_SIZES)),
        plot_scales(sweeps, paper(pixel_sizes=(1.6, 0.8, 0.6, 0.4, 0.2, 0.15))),
    ]
    for figure in figures:
        figure.canvas.draw()
        width, height = figure.get_size_inches()
        seen = figure.get_tightbbox()  # of everything, inches
        assert width * figure.dpi == 1600
        assert min(seen.x0, seen.y0) >= 0 and seen.x1 <= width and seen.y1 <= height, seen
    panels = [axes for axes in figures[-1].axes if axes.get_title()]
    boxes = [axes.title.get_window_extent() for axes in panels] + [figures[-1].texts[0].get_window_extent()]
    boxes += [axes.xaxis.label.get_window_extent() for axes in panels if axes.get_xlabel()]
    assert len(panels) == 14
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])


def test_empty_windows_are_drawn_or_refused() -> None:
    plot_keypoints(EMPTY, keypoints()).canvas.draw()
    plot_scales(EMPTY, paper(**TWO_SIZES)).canvas.draw()
    with pytest.raises(CFlowError, match="no cluster"):
        plot_correlation(EMPTY, paper())


@pytest.mark.parametrize(
    ("plot", "settings", "message"),
    [
        (plot_correlation, make_config("default"), r"method=verified.*model=paper"),
        (plot_scales, make_config("default"), r"method=verified.*model=paper"),
        (plot_keypoints, make_config("default"), r"method=verified.*model=keypoints"),
        (plot_keypoints, paper(), "method=dense has no key points.*model=keypoints"),
        (plot_correlation, keypoints(), "method=keypoints has no correlation map.*model=paper"),
        (plot_correlation, paper(clustering="hdbscan"), "model=paper"),
    ],
)
def test_a_method_without_such_a_picture_is_refused(plot: Any, settings: Config, message: str) -> None:
    with pytest.raises(CFlowError, match=message):
        plot(scene(4), settings)
