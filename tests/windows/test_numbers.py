"""Numbers at their limits: far from the origin, tiny, very many, of any type; and what is refused because of them."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scenes import SLICE, moving_scene
from oracle import reference_flow
from preset_windows import PRESETS, changed, num_moving, on_a_raster, small, windows_for
from scenes import RANGE, assert_same, pose

from cflow_torch import CFlowError, Config, FlowResult, Sweep, Window, estimate_flow, make_model
from cflow_torch.verified.height_slices import slice_of
from cflow_torch.windows import memory as free_memory
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ground import find_ground
from cflow_torch.windows.resolution import resolution

FAR = 1e7  # metres
HUGE = 10**400  # no float holds it


def cflow(window: Window, config: Config) -> FlowResult:
    (result,) = make_model(config, "cpu")([window])
    return result


def assert_same_but_confidence(a: FlowResult, b: FlowResult) -> None:
    """Confidence asks how far the vehicle is, the rest does not."""
    assert (a.confidence is None) == (b.confidence is None)
    assert_same(replace(a, confidence=None), replace(b, confidence=None))


# ---------------------------------------------------------------------------------------------- far from the origin


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("shift", [(FAR, -FAR, 0.0), (-FAR, FAR, FAR)])
def test_points_ten_thousand_kilometres_away(preset, shift):
    config = small(preset)
    window = changed(windows_for(config)[0], on_a_raster)
    away = changed(window, lambda sweep: replace(sweep, points=sweep.points + shift))
    settings = config.replace(point_cloud_range=tuple(np.array(RANGE) + np.tile(shift, 2)))
    expected, result = cflow(window, config), cflow(away, settings)
    assert num_moving(result) > 100
    assert_same_but_confidence(result, expected)
    assert_same(result, reference_flow(away, settings))


@pytest.mark.parametrize("preset", PRESETS)
def test_poses_ten_thousand_kilometres_away(preset):
    config = small(preset)
    (window,) = windows_for(config)
    city = changed(window, lambda sweep: replace(sweep, pose=pose(FAR, -FAR, 0.0) @ sweep.pose))
    expected, result = cflow(window, config), cflow(city, config)
    assert num_moving(result) > 100
    assert_same(result, reference_flow(city, config))
    # A pose is rounded to 2e-9 m there; no point of this window lies that near to the edge of a pixel.
    for name in ("cluster_id", "is_valid", "score"):
        assert torch.equal(getattr(result, name), getattr(expected, name)), name
    for name in ("pose_flow", "residual_flow"):  # the default turns points where they lie
        assert (getattr(result, name) - getattr(expected, name)).abs().max() < 1e-6, name


def test_numbers_of_every_type_are_as_far_apart_as_its_neighbours():
    for dtype in (np.float16, np.float32, np.float64, np.dtype(">f4")):
        for distance in (1e-3, 0.75, 1.0, 35.0, 51.2, 64.0, 5e4):
            native = np.dtype(dtype).newbyteorder("=")
            assert resolution(dtype, distance) == np.spacing(native.type(distance)), (dtype, distance)
    assert resolution(torch.bfloat16, 51.2) == 0.25 and resolution(torch.float32, FAR) == 1.0
    assert resolution(np.int64, FAR) == resolution(torch.float64, 0.0) == 0.0


@pytest.mark.parametrize(
    "points, far, refused",
    [
        (lambda p: p, 0.0, False),
        (lambda p: p, FAR, False),
        (lambda p: p.astype(np.float32), FAR, True),  # whole metres
        (lambda p: p.astype(np.float32), 1e6, False),  # 1/16 m: a quarter of a pixel
        (lambda p: p.astype(">f4"), FAR, True),
        (lambda p: torch.from_numpy(p).float(), FAR, True),
        (lambda p: torch.from_numpy(p).half(), 0.0, False),
        (lambda p: torch.from_numpy(p).bfloat16(), 0.0, False),  # 1/32 m at 8 m
        (lambda p: torch.from_numpy(p).bfloat16(), 60.0, True),
        (lambda p: p, 1e16, True),
    ],
)
def test_types_too_coarse_for_pixels_are_refused(points, far, refused):
    config = small("paper", num_history=0, point_cloud_range=tuple(np.array(RANGE) + np.tile((far, far, 0.0), 2)))
    given = points(np.random.default_rng(0).uniform(-1, 1, (50, 3)) + [far, far, 0.0])
    other = np.zeros((4, 3)) + [far, far, 0.0]
    for window, name in ((Window(Sweep(given), Sweep(other)), "pc0"), (Window(Sweep(other), Sweep(given)), "pc1")):
        if not refused:
            assert cflow(window, config).is_valid.all()
            continue
        with pytest.raises(CFlowError, match=r"pc[01] is .*f.*only holds multiples of .* m.*pixels of 0.25 m") as seen:
            cflow(window, config)
        assert str(seen.value).startswith(name) or far == 1e16


@pytest.mark.parametrize(
    "dtype, x, yaw, refused",
    [
        (np.float64, FAR, 0.1, False),
        (np.float32, FAR, 0.1, True),
        (np.float32, 1e5, 0.1, False),  # 8 mm
        (np.float32, 2e5, 0.1, True),  # 16 mm
        (np.float16, 0.0, 0.0, False),  # 8 mm at the end of the region of 8 m
        (np.float16, 20.0, 0.0, True),
        (torch.bfloat16, 0.0, 0.0, True),
        (torch.float32, FAR, 0.0, True),
        (torch.float64, FAR, 0.1, False),
    ],
)
def test_poses_that_their_type_does_not_hold_are_refused(dtype, x, yaw, refused):
    T_world_ego = pose(x, 1.0, yaw)
    given = torch.from_numpy(T_world_ego).to(dtype) if isinstance(dtype, torch.dtype) else T_world_ego.astype(dtype)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    window = Window(Sweep(points, pose=given), Sweep(points, pose=given))
    if not refused:
        result = cflow(window, small("paper"))
        assert result.is_valid.all() and result.flow.abs().max() < 1e-8
        return
    with pytest.raises(CFlowError, match=r"pose.*only holds multiples of .*float64"):
        cflow(window, small("paper"))


def test_ground_far_from_the_origin_is_not_looked_for_in_silence():
    street = np.random.default_rng(0).uniform(-30, 30, (5000, 3)) * [1, 1, 0]
    assert find_ground(street).all()
    with pytest.warns(UserWarning, match="no point of sweep 0 lies within 131 m of the origin"):
        assert not find_ground(street + [FAR, 0, 0]).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for quiet in (street[:0], street * np.nan, street[:3], np.concatenate([street[:3], street + [FAR, 0, 0]])):
            assert not find_ground(quiet).any()


def test_a_turn_about_an_origin_far_away_is_refused():
    # A frame that turns about its origin moves what lies 1e7 m away by more than any vehicle.
    points = np.random.default_rng(0).uniform(-5, 5, (50, 3)) + [FAR, 0.0, 0.0]
    turn = pose(0.0, 0.0, 1e-3)
    turn[:3, 3] = (np.eye(3) - turn[:3, :3]) @ [FAR, 0.0, 0.0]
    settings = {"point_cloud_range": (FAR - 8, -8.0, -8.0, FAR + 8, 8.0, 8.0), "preset": "paper"}
    with pytest.raises(CFlowError, match="the ego vehicle moves 10000 m"):
        estimate_flow(points, points, T_ego1_ego0=turn, **settings)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("value", [1e300, -1e20])
def test_finite_points_beyond_all_bounds_change_nothing(preset, value):
    """Squares of them are infinite, their slices and pixels no integers."""
    config = small(preset, point_cloud_range=(*RANGE[:2], -math.inf, *RANGE[3:5], math.inf))
    (window,) = windows_for(config)

    def with_wild(sweep: Sweep) -> Sweep:
        wild = np.array([[value, 0, 0], [0, value, 0], [1.0, 2.0, value], [value, value, value]])
        points = np.concatenate([sweep.points.astype(np.float64), wild])
        return replace(sweep, points=points, is_ground=np.concatenate([sweep.is_ground, [False] * 4]))

    wild = changed(window, with_wild)
    result = cflow(wild, config)
    assert_same(result, reference_flow(wild, config))
    assert all(torch.isfinite(values.double()).all() for values in vars(result).values() if values is not None)


def test_moving_points_have_the_slices_of_cells():
    """Of heights without end, too: a quotient that no int64 holds is cut off, not left to the processor."""
    heights = [0.3, -0.3, 7.9, 1e17, 1e18, -1e18, 1e30, -1e30]
    flat = moving_scene(0, num_points=8)
    z = torch.tensor(heights, dtype=torch.float64).repeat(flat.batch.positions.shape[1] // len(heights) + 1)
    positions = torch.cat((flat.batch.positions[:2], z[None, : flat.batch.positions.shape[1]]))
    points = flat._replace(batch=replace(flat.batch, positions=positions)).moving()
    assert len(points.part) > 20
    kept = positions[2][[int((positions[:2].t() == xy).all(1).nonzero()[0]) for xy in points.position.t()]]
    assert points.part.tolist() == [int(z // SLICE) % 4 for z in kept.tolist()]
    assert slice_of(torch.tensor([1e30, -1e30, 2.0**63], dtype=torch.float64), 1.0, 16).tolist() == [0, 0, 0]


# ------------------------------------------------------------------------------------------------- tiny and many


@pytest.mark.parametrize("preset", PRESETS)
def test_objects_of_centimetres(preset):
    """A 128th of everything. What is measured in pixels scales to the bit; the default refines in 1/1024 m."""
    config = small(preset, clearance=None)
    scaled = {
        name: getattr(config, name) / 128
        for name in ("max_extent", "slice_height", "gate_radius", "max_speed", "max_object")
        if getattr(config, name) is not None
    }
    tiny = config.replace(
        pixel_sizes=tuple(size / 128 for size in config.pixel_sizes),
        point_cloud_range=tuple(bound / 128 for bound in RANGE),
        **scaled,
    )
    window = changed(windows_for(config)[0], on_a_raster)
    small_window = changed(window, lambda sweep: replace(sweep, points=sweep.points / 128))
    expected, result = cflow(window, config), cflow(small_window, tiny)
    assert num_moving(result) > 100
    assert_same(result, reference_flow(small_window, tiny))
    if preset != "default":
        assert torch.equal(result.residual_flow * 128, expected.residual_flow)
        assert torch.equal(result.cluster_id, expected.cluster_id) and torch.equal(result.score, expected.score)


def with_many(window: Window, points: np.ndarray) -> Window:
    """More points in every sweep, at the front."""
    return changed(
        window,
        lambda sweep: Sweep(
            np.concatenate([points, sweep.points]),
            None if sweep.is_ground is None else np.concatenate([np.zeros(len(points), bool), sweep.is_ground]),
        ),
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_a_million_points_in_one_pixel_are_one_point(preset):
    """Every count is of pixels, every mean of equal points the point itself; here they have a pixel of their own."""
    config = small(preset, num_history=0)
    window = changed(windows_for(config)[0], on_a_raster)
    window = changed(window, lambda sweep: replace(sweep, points=np.nan_to_num(sweep.points, nan=99.0)))
    point = window.pc0.points[np.argmax(cflow(window, config).residual_flow.any(1).numpy())][None]

    def elsewhere(sweep: Sweep) -> Sweep:
        keep = (np.abs(sweep.points[:, :2] - point[:, :2]) > 0.5).any(1)
        return Sweep(sweep.points[keep], sweep.is_ground[keep])

    window = changed(window, elsewhere)
    once = cflow(with_many(window, point), config)
    often = cflow(with_many(window, point.repeat(1_000_000, 0)), config)
    assert num_moving(once) > 100
    for name, value in vars(often).items():
        if value is None:
            continue
        assert (value[:1_000_000] == value[0]).all(), name
        assert torch.equal(value[999_999:], getattr(once, name)), name


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_million_points_in_one_pixel_equal_the_reference(preset):
    config = small(preset)
    rng = np.random.default_rng(0)
    window = changed(windows_for(config)[0], on_a_raster)
    many = changed(window, lambda sweep: sweep)
    many = with_many(many, np.array([2.0, 1.0, 0.5]) + rng.uniform(0, 0.25, (1_000_000, 3)))
    assert_same(cflow(many, config), reference_flow(many, config))


def lattice(step: int, size: float, side: float) -> np.ndarray:
    """A point in every `step`-th pixel, rows and columns."""
    places = np.arange(-side + size / 2, side, size * step)
    x, y = np.meshgrid(places, places)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("step", [1, 4])
def test_a_point_in_every_pixel(preset, step):
    """All of them one cluster, or each its own: no more clusters fit."""
    config = small(preset, point_cloud_range=(-4.0, -4.0, -1.0, 4.0, 4.0, 1.0), num_history=0)
    points = lattice(step, 0.25, 4.0)
    window = Window(Sweep(points), Sweep(points))
    result = cflow(window, config)
    assert_same(result, reference_flow(window, config))
    if preset in ("paper", "fast"):
        assert int(result.cluster_id.max()) + 1 == (1 if step == 1 else len(points))


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("step", [1, 4])
def test_a_point_in_every_pixel_of_the_whole_region(preset, step):
    config = small(preset, pixel_sizes=(0.1,), point_cloud_range=(-20, -20, -1, 20, 20, 1), max_extent=20.0)
    points = lattice(step, 0.1, 20.0)
    result = cflow(Window(Sweep(points), Sweep(points)), config)
    assert result.is_valid.all() and not result.residual_flow.any()
    if preset in ("paper", "fast"):
        assert result.cluster_id.tolist() == ([0] * len(points) if step == 1 else list(range(len(points))))


def test_pixel_numbers_of_many_images_do_not_overflow():
    grid = Grid(0.5, (0.0, 0.0, -1.0), (1000.0, 1000.0, 1.0))
    num_images = 2**11
    positions = torch.tensor([[0.25, 999.9], [0.25, 999.9]], dtype=torch.float64)
    image = torch.tensor([0, num_images - 1], dtype=torch.int32)
    area = grid.height * grid.width
    assert num_images * area > 2**32
    pixel = grid.pixel_of_image(positions, image, num_images, torch.tensor([True, True]))
    assert pixel.tolist() == [0, (num_images - 1) * area + 1999 * grid.width + 1999]
    left_out = grid.pixel_of_image(positions, image, num_images, torch.tensor([False, False]))
    assert left_out.tolist() == [num_images * area] * 2


# ------------------------------------------------------------------------------------------- what does not fit


def highest_resident_kb() -> int:
    """Most memory that this process ever held."""
    status = Path("/proc/self/status")
    if not status.exists():
        pytest.skip("no /proc/self/status: resident memory cannot be read")
    return int(re.search(r"VmHWM:\s+(\d+)", status.read_text()).group(1))  # type: ignore[union-attr]


CAR = 0.1 * np.stack(np.meshgrid(range(45), range(18), range(5)), -1).reshape(-1, 3) + 5.05


@pytest.mark.parametrize("preset", PRESETS)
def test_regions_larger_than_the_memory_are_refused_before_they_are_made(preset, monkeypatch):
    monkeypatch.setattr(free_memory, "available_memory", lambda environ: 4_000_000_000)
    region = (-1000.0, -1000.0, -3.0, 1000.0, 1000.0, 3.0)
    before = highest_resident_kb()
    with pytest.raises(
        CFlowError, match=r"20001 x 20001 pixels of 0.1 m.*GB.*\(2\d{10} bytes\).*4.0 GB.*range"
    ) as seen:
        estimate_flow(CAR, CAR, preset=preset, point_cloud_range=region)
    assert "give a smaller point_cloud_range, larger pixel_sizes" in str(seen.value)
    assert highest_resident_kb() - before < 50_000


@pytest.mark.parametrize("preset", PRESETS)
def test_more_points_than_the_memory_holds_are_refused_before_they_are_copied(preset, monkeypatch):
    monkeypatch.setattr(free_memory, "available_memory", lambda environ: 4_000_000_000)
    points = np.broadcast_to(np.float32([1.0, 2.0, 0.5]), (10**8, 3))  # takes no memory itself
    before = highest_resident_kb()
    with pytest.raises(CFlowError, match=r"200000000 points in 2 sweeps.*bytes\).*fewer points"):
        make_model(small(preset), "cpu")([Window(Sweep(points), Sweep(points))])
    assert highest_resident_kb() - before < 50_000


def test_regions_of_more_pixels_than_any_are_refused():
    for size, region in ((0.1, 1e5), (1e-300, 1.0), (5e-324, 1.0), (0.1, 1e308), (1e-310, 1e308)):
        with pytest.raises(CFlowError, match="pixels of .* too large.*smaller point_cloud_range or larger pixel_sizes"):
            estimate_flow(
                CAR, CAR, preset="paper", pixel_size=size, point_cloud_range=(-region, -region, -1, region, region, 1)
            )


def test_a_cluster_larger_than_the_memory_is_refused_before_it_is_drawn(monkeypatch):
    monkeypatch.setattr(free_memory, "_MUCH", 0)
    side = np.arange(-15.0, 15.0, 0.1) + 0.05
    ends = np.full_like(side, 14.95)
    frame = np.concatenate([np.stack(xy, 1) for xy in ((side, ends), (side, -ends), (ends, side), (-ends, side))])
    window = Window(*[Sweep(np.pad(frame, ((0, 0), (0, 1))))] * 2)
    model = make_model(Config(), "cpu")
    expected = model([window])[0]
    assert expected.cluster_id.max() == 0
    monkeypatch.setattr(
        "cflow_torch.windows.collation.require_memory", lambda *parts: None
    )  # the window itself has room
    monkeypatch.setattr(free_memory, "available_memory", lambda environ: 10**8)
    assert_same(model([window])[0], expected)
    monkeypatch.setattr(free_memory, "available_memory", lambda environ: 10**7)
    with pytest.raises(CFlowError, match=r"a cluster that is 300 pixels long needs about .* bytes\).*max_speed"):
        model([window])


def test_memory_is_that_of_the_machine():
    free = free_memory.available_memory({})
    if free is None:
        pytest.skip("no /proc/meminfo: nobody says how much memory is free")
    cpu = torch.device("cpu")
    free_memory.require_memory(free // 2, cpu, "half of it", "")
    with pytest.raises(CFlowError, match="all of it.*GB.*cpu has .* left: mend"):
        free_memory.require_memory(4 * free + 2**40, cpu, "all of it", "mend")


WRONG = (0, -1, math.nan, math.inf, -math.inf, HUGE, 1e308, 5e-324, True, "x", None, torch.tensor(0.1))


@pytest.mark.parametrize("preset", ["default", "keypoints"])  # between them all settings count
@pytest.mark.parametrize("value", WRONG, ids=lambda v: str(v)[:8])
def test_settings_are_taken_or_refused_and_nothing_else(preset, value):
    """Every number of the settings, every value that is none or hardly one: a result, or the one error."""
    names = (
        "max_extent max_speed max_object zero_test slice_height proof_z clearance sweep_interval gate_radius "
        "max_memory second_best_distance ratio_threshold num_history patch_size min_cluster_size keypoint_block "
        "height_slices connectivity"
    )
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    box = (-2.0, -2.0, -2.0, 2.0, 2.0, 2.0)
    base = {"num_history": 0, "point_cloud_range": box}
    tries = [{name: value} for name in names.split()]
    tries += [{"pixel_sizes": (value,)}, {"pixel_size": value}, {"ego_box": (-1, -1, value, 1)}]
    tries += [{"point_cloud_range": (*box[:k], value, *box[k + 1 :])} for k in range(6)]
    taken = 0
    for settings in tries:
        try:
            config = small(preset, **{**base, **settings})
            cflow(Window(Sweep(points), Sweep(points)), config)
            taken += 1
        except CFlowError as error:
            assert "give" in str(error)
    assert taken < len(tries)


def test_sizes_and_ranges_that_are_none_are_refused():
    for size in (0, -0.1, math.nan, math.inf, -math.inf, HUGE):
        for name in ("pixel_size", "slice_height", "gate_radius", "sweep_interval", "second_best_distance"):
            if (name, size) == ("second_best_distance", 0):
                continue
            with pytest.raises(CFlowError, match="give"):
                small("paper", **{"pixel_sizes": None, name: size} if name == "pixel_size" else {name: size})
    for bounds in ((0, 0, 0, 0, 0, 0), (1, 1, 1, -1, -1, -1), (-1, -1, -1, math.nan, 1, 1), (-1, -1, -1, HUGE, 1, 1)):
        with pytest.raises(CFlowError, match="point_cloud_range"):
            small("paper", point_cloud_range=bounds)


def test_the_proof_bounds_its_region():
    """Its sums of squares in 1/1024 m fit an int64 up to here."""
    wide = (-1500.0, -1500.0, -1.0, 1500.0, 1500.0, 1.0)
    small("default", point_cloud_range=wide)
    for bounds in ((-1500.0, -1500.0, -1.0, 1500.1, 1500.0, 1.0), (-1500.0, -1501.0, -1.0, 1500.0, 1500.0, 1.0)):
        with pytest.raises(CFlowError, match="proof=True.*a side is at most 3000 m"):
            small("default", point_cloud_range=bounds)
        small("paper", point_cloud_range=bounds)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, "now", 2**63, HUGE, 1j, [1, 2]], ids=str)
def test_time_stamps_that_are_none_are_named(stamp):
    points = np.zeros((3, 3))
    for stamps, name in (((stamp, 10**9), "pc1"), ((10**9, stamp), "pc0")):
        window = Window(Sweep(points, timestamp_ns=stamps[1]), Sweep(points, timestamp_ns=stamps[0]))
        with pytest.raises(CFlowError, match=f"timestamp_ns of {name} is .*whole nanoseconds"):
            cflow(window, small("paper"))
