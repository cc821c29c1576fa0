"""Invalid input: one error names it and says what to give."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import pose

from cflow_torch import CFlowError, CorrelationFlow, Sweep, Window, estimate_flow

RNG = np.random.default_rng(0)
P0, P1 = RNG.uniform(-5, 5, (50, 3)).astype(np.float32), RNG.uniform(-5, 5, (40, 3)).astype(np.float32)
EYE, MIRROR = np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])
MODEL = CorrelationFlow.from_preset("paper", num_history=1, pixel_size=0.25)


def refused(*sweeps: Sweep, match: str) -> None:
    """Pass pc0, pc1 and maybe one older sweep."""
    with pytest.raises(CFlowError, match=match):
        MODEL([Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))])


@pytest.mark.parametrize(
    "column, values, complaint",
    [
        ("points", P0[:, :2], r"shape \(50, 2\).*\(N, 3\+\)"),
        ("points", np.zeros((3, 1001)), "give its transpose"),
        ("points", P0.astype(np.int64), "dtype int64.*float"),
        ("points", P0.astype(complex), "dtype complex128"),
        ("points", torch.from_numpy(P0).int(), "dtype torch.int32"),
        ("points", np.ma.masked_greater(P0, 0.5), "masked array"),
        ("points", torch.from_numpy(P0).to_sparse(), "layout"),
        ("points", P0.tolist(), "is list"),
        ("is_ground", np.zeros(3, dtype=bool), r"shape \(3,\)"),
        ("is_ground", np.zeros(50, dtype=np.uint8), "dtype uint8.*bool"),
        ("is_ground", torch.zeros(50), "dtype torch.float32.*bool"),
        ("is_ground", [False] * 50, "is list"),
        ("point_times", np.zeros(3), r"shape \(3,\)"),
        ("point_times", np.zeros(50, np.int64), "dtype int64.*seconds"),
    ],
)
def test_invalid_columns_are_named(column, values, complaint):
    with pytest.raises(CFlowError, match=f"Sweep.{column} .*{complaint}"):
        Sweep(**{"points": P0, column: values})
    prefix = {"points": "pc", "is_ground": "gm", "point_times": "dt"}[column]
    for name in ("0", "1", "h1", "f2"):
        with pytest.raises(CFlowError, match=f"{prefix}{name} .*{complaint}"):
            Window.from_dict({"pc0": P0, "pc1": P0, "pch1": P0, "pcf1": P0, "pcf2": P0, f"{prefix}{name}": values})
    if prefix != "dt":
        with pytest.raises(CFlowError, match=f"{prefix}0 .*{complaint}"):
            estimate_flow(**{"pc0": P0, "pc1": P1, f"{prefix}0": values})


def test_invalid_windows_are_refused():
    for windows in (None, Window(Sweep(P0), Sweep(P1)), [Sweep(P0)], [P0, P1]):
        with pytest.raises(CFlowError, match="Window"):
            MODEL(windows)
    for sweeps in ((P0, P1), (Sweep(P0), Sweep(P1), None), (Sweep(P0), Sweep(P1), (P0,))):
        with pytest.raises(CFlowError, match="give .*cflow_torch.Sweep"):
            Window(*sweeps)


@pytest.mark.parametrize("given", [(0,), (1,), (0, 1), (1, 2)])
def test_poses_of_some_sweeps_only_are_refused(given):
    refused(*(Sweep(p, pose=EYE if i in given else None) for i, p in enumerate((P0, P1, P0 + 1))), match="pose")


@pytest.mark.parametrize("which, name", [(0, "pc0"), (1, "pose1"), (2, "pch1")])
def test_bad_poses_are_named(which, name):
    for bad in (np.eye(3), "pose"):
        with pytest.raises(CFlowError, match=r"Sweep.pose has shape .*\(4, 4\)"):
            Sweep(P0, pose=bad)
    for bad in (EYE * np.nan, MIRROR):
        refused(*(Sweep(p, pose=bad if i == which else EYE) for i, p in enumerate((P0, P1, P0 + 1))), match=name)


def test_poses_too_far_apart_are_refused():
    refused(Sweep(P0, pose=pose(5000.0, 100.0, 0.0)), Sweep(P1, pose=EYE), match="moves 5001 m between pc0 and pc1")


@pytest.mark.parametrize("stamps", [(0, 0, -1), (0, 1, -1), (0, -1, 1), (0, -1, -1)])
def test_time_stamps_out_of_order_are_refused(stamps):
    pc1, pc0, older = (Sweep(p, timestamp_ns=10**9 + 10**8 * s) for p, s in zip((P1, P0, P0 + 1), stamps))
    refused(pc0, pc1, older, match="time stamps.*out of order.*newest to oldest")


@pytest.mark.parametrize("stamp", [float("nan"), "now", 2**63, [1, 2]], ids=str)
def test_invalid_time_stamps_are_named(stamp):
    for stamps, name in (((10**9, stamp), "pc1"), ((stamp, 10**9), "pc0")):
        pc0, pc1 = (Sweep(p, timestamp_ns=s) for p, s in zip((P0, P1), stamps))
        refused(pc0, pc1, match=f"timestamp_ns of {name} is .*whole nanoseconds")


def test_a_longer_history_is_cut_to_the_nearest_sweeps(caplog):
    model = CorrelationFlow.from_preset("paper", num_history=1)
    pc0, pc1, *older = map(Sweep, (P0, P1, P0 + 1, P0 + 2))
    with caplog.at_level("INFO", "cflow_torch"):
        more, fewer = model([Window(pc0, pc1, tuple(older)), Window(pc0, pc1, tuple(older[:1]))])
    assert all(np.array_equal(values, fewer.numpy()[name]) for name, values in more.numpy().items())
    assert "of 2 history sweeps the nearest 1 are used" in caplog.text and len(caplog.records) == 1


@pytest.mark.parametrize(
    "points, far, is_refused",
    [
        (lambda p: p, 1e7, False),
        (lambda p: p.astype(np.float32), 1e7, True),  # whole metres
        (lambda p: p.astype(np.float32), 1e6, False),  # 1/16 m: a quarter of a pixel
        (lambda p: p.astype(">f4"), 1e7, True),
        (lambda p: torch.from_numpy(p).half(), 0.0, False),
        (lambda p: torch.from_numpy(p).bfloat16(), 60.0, True),
    ],
)
def test_too_coarse_types_of_points_are_refused(points, far, is_refused):
    region = (far - 8, far - 8, -8, far + 8, far + 8, 8)
    model = CorrelationFlow.from_preset("paper", pixel_size=0.25, point_cloud_range=region)
    window = Window(Sweep(points(RNG.uniform(-1, 1, (50, 3)) + [far, far, 0.0])), Sweep(np.zeros((4, 3)) + far))
    if not is_refused:
        assert model([window])[0].is_valid.all()
        return
    with pytest.raises(CFlowError, match=r"pc0 is .*only holds multiples of .* m.*pixels of 0.25 m"):
        model([window])


@pytest.mark.parametrize(
    "points, advice",
    [
        (np.zeros((4, 3), np.float16), r"give points.astype\(np.float32\)"),
        (torch.zeros(4, 3, dtype=torch.float16), r"give points.float\(\)"),
        (torch.full((4, 3), 1e7, dtype=torch.float32), r"give points.double\(\)"),
    ],
)
def test_the_error_says_how_to_write_wider_points(points, advice):
    far = 1e7 if points.dtype == torch.float32 else 0.0
    region = (far - 90, far - 90, -8, far + 90, far + 90, 8)
    with pytest.raises(CFlowError, match=advice):
        estimate_flow(points, np.zeros((4, 3)), preset="paper", point_cloud_range=region)


def test_the_error_says_how_to_complete_a_transform():
    matrix = np.eye(4)[:3]
    for call in (lambda m: Sweep(P0, pose=m), lambda m: estimate_flow(P0, P1, T_ego1_ego0=m)):
        with pytest.raises(CFlowError, match=r"shape \(3, 4\).*np.vstack\(\[matrix, \[0, 0, 0, 1\]\]\)"):
            call(matrix)
        call(np.vstack([matrix, [0, 0, 0, 1]]))


def test_unusable_and_mixed_devices_are_refused():
    cpu, other = torch.from_numpy(P0), torch.from_numpy(P1).to("meta")
    for pc0, pc1 in ((cpu, other), (other, cpu)):
        with pytest.raises(CFlowError, match=r"different devices \(cpu, meta\)"):
            estimate_flow(pc0, pc1)
    with pytest.raises(CFlowError, match="holds no numbers"):
        estimate_flow(other, other)
    for device in ("abacus", None, *(() if torch.cuda.is_available() else ("cuda",))):
        with pytest.raises(CFlowError, match=f"device={device!r} cannot be used"):
            estimate_flow(P0, P1, device=device)
