"""Every preset has the same bits, however it is computed on one device."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from typing import Callable, List

import numpy as np
import pytest
import torch
from preset_windows import PRESETS, num_moving, small, windows_for
from scenes import assert_same, assert_same_bits, needs_gpu, reordered, rows_of

from cflow_torch import Config, FlowResult, Sweep, Window, make_model

Results = List[FlowResult]
Call = Callable[[Config, List[Window]], Results]
EMPTY = Sweep(np.zeros((0, 3), dtype=np.float32))


def together(config: Config, windows: list[Window]) -> Results:
    return make_model(config, "cpu")(windows)


def backwards_and_again(config: Config, windows: list[Window]) -> Results:
    """In reverse order, each three times, by a model that has run before."""
    model = make_model(config, "cpu")
    model(windows)
    return model((windows * 3)[::-1])[: len(windows)][::-1]


def among_others(config: Config, windows: list[Window]) -> Results:
    """Between windows without points, with one empty sweep, and with a few points."""
    bare = [replace(sweep, pose=None, timestamp_ns=None) for sweep in (windows[0].pc0, windows[0].pc1)]
    few = replace(bare[0], points=bare[0].points[:9], is_ground=bare[0].is_ground[:9])
    others = [Window(EMPTY, EMPTY), Window(few, EMPTY), Window(EMPTY, bare[1])]
    batch = [window for pair in zip(others, windows) for window in pair]
    return make_model(config, "cpu")(batch)[1::2]


def in_pieces(config: Config, windows: list[Window]) -> Results:
    """With little memory, and other chunk sizes for points, images, lookups and key points."""
    pieces = {
        "ops.chunks.CHUNK_ON_CPU": 997,
        "dense.correlation._PER_CALL_CPU": 600,
        "verified.comparisons._AT_ONCE_CPU": 500,
        "keypoints.match_candidates._BAND_ROWS": 5,
        "keypoints.matching._PAIRS_AT_ONCE_CPU": 5000,
        "keypoints.matching._ENERGY_STEP": 2,
        "keypoints.matching._MOST_ROWS": 11,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in pieces.items():
            patch.setattr(f"cflow_torch.{name}", value)
        return together(config.replace(max_memory=500_000), windows)


def shuffled(config: Config, windows: list[Window]) -> Results:
    """With the points of every sweep in another order; the results are put back into the old one."""
    mixed, orders = zip(*(reordered(window) for window in windows))
    results = together(config, list(mixed))
    return [rows_of(result, np.argsort(order)) for result, order in zip(results, orders)]


def while_training(config: Config, windows: list[Window]) -> Results:
    """With another default dtype, autocast, reduced precision of matrix products, and without oneDNN."""
    precision = torch.get_float32_matmul_precision()
    torch.set_default_dtype(torch.float64)
    torch.set_float32_matmul_precision("medium")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns about missing GPUs
            with torch.backends.mkldnn.flags(enabled=False), torch.autocast("cpu", dtype=torch.bfloat16):
                return together(config, windows)
    finally:
        torch.set_float32_matmul_precision(precision)
        torch.set_default_dtype(torch.float32)


CALLS: dict[str, Call] = {
    call.__name__: call for call in (backwards_and_again, among_others, in_pieces, shuffled, while_training)
}


@lru_cache(maxsize=None)
def expected(preset: str) -> tuple[Config, list[Window], Results]:
    config = small(preset)
    windows = windows_for(config, 2)
    return config, windows, [make_model(config, "cpu")([window])[0] for window in windows]


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("preset", PRESETS)
def test_results_have_the_same_bits_however_they_are_computed(preset: str, call: str) -> None:
    config, windows, results = expected(preset)
    assert min(map(num_moving, results)) > 100  # the test is not empty
    found = CALLS[call](config, windows)
    assert len(found) == len(results)
    for one, other in zip(found, results):
        assert_same_bits(one, other)


VARIANTS = [(preset, {}) for preset in PRESETS]
VARIANTS += [("paper", {"correlation": "conv", "sectional_view": True}), ("paper", {"labeling": "kornia"})]
VARIANTS += [("keypoints", {"densify": densify}) for densify in ("clusters", "nearest")]


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("preset, overrides", VARIANTS)
def test_a_gpu_gives_the_flow_of_the_cpu(preset: str, overrides: dict) -> None:
    config = small(preset, **overrides)
    windows = windows_for(config, 4)
    for on_gpu, on_cpu in zip(*(make_model(config, device)(windows) for device in ("cuda", "cpu"))):
        assert on_gpu.flow.is_cuda
        assert_same(on_gpu, on_cpu, atol=1e-4)
