"""Every preset, computed in every way that must not matter: the same bits.

What is identical is identical to the last bit, floats too: no tolerance stands in this file. The table as text, and
the largest difference of each row:

  python tests/test_exactness_matrix.py
  python tests/test_exactness_matrix.py digests     of all bytes, to compare machines and versions
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Sequence, Tuple

import numpy as np
import pytest
import torch
from preset_windows import PRESETS, changed, num_moving, small, windows_for
from scenes import assert_same, has_kornia_labelling, needs_gpu, needs_kornia_labelling

from cflow_torch import Config, FlowResult, Sweep, Window, make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of
from cflow_torch.simulator import make_drive

Results = List[FlowResult]
Way = Callable[[Config, List[Window]], Results]
EMPTY = Sweep(np.zeros((0, 3), dtype=np.float32))


def plainly(config: Config, windows: Sequence[Window]) -> Results:
    """Window by window, on the CPU: what all others are held to."""
    model = make_model(config, "cpu")
    return [model([window])[0] for window in windows]


def on_threads(number: int) -> Way:
    def run(config: Config, windows: List[Window]) -> Results:
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(number)
            return plainly(config, windows)
        finally:
            torch.set_num_threads(before)

    return run


def together(config: Config, windows: List[Window]) -> Results:
    return make_model(config, "cpu")(windows)


def together_backwards(config: Config, windows: List[Window]) -> Results:
    return make_model(config, "cpu")(windows[::-1])[::-1]


def among_others(config: Config, windows: List[Window]) -> Results:
    """Between windows without points, without one sweep, of a few points."""
    bare = [replace(sweep, pose=None, timestamp_ns=None) for sweep in (windows[0].pc0, windows[0].pc1)]
    few = replace(bare[0], points=bare[0].points[:9], is_ground=bare[0].is_ground[:9])
    others = [Window(EMPTY, EMPTY), Window(few, EMPTY), Window(few, bare[1]), Window(EMPTY, bare[1])]
    batch = [window for pair in zip(others, windows) for window in pair] + others[len(windows) :]
    return make_model(config, "cpu")(batch)[1 : 2 * len(windows) : 2]


def many(config: Config, windows: List[Window]) -> Results:
    """Each of them three times, as one batch."""
    return make_model(config, "cpu")(windows * 3)[-len(windows) :]


def with_settings(**overrides: Any) -> Way:
    return lambda config, windows: together(config.replace(**overrides), windows)


@contextmanager
def constants(**values: int) -> Iterator[None]:
    """Other values of constants of modules: `module__NAME`."""
    patch = pytest.MonkeyPatch()
    try:
        for name, value in values.items():
            patch.setattr("cflow_torch." + name.replace("__", "."), value)
        yield
    finally:
        patch.undo()


def with_constants(**values: int) -> Way:
    def run(config: Config, windows: List[Window]) -> Results:
        with constants(**values):
            return together(config, windows)

    return run


def as_given(change: Callable[[Sweep], Sweep]) -> Way:
    return lambda config, windows: together(config, [changed(window, change) for window in windows])


def with_points(change: Callable[[np.ndarray], Any]) -> Way:
    return as_given(lambda sweep: replace(sweep, points=change(np.asarray(sweep.points))))


def shuffled(config: Config, windows: List[Window]) -> Results:
    """Points of every sweep in another order; results put back into the old one."""
    rng, mixed, orders = np.random.default_rng(0), [], []
    for window in windows:
        mine = [rng.permutation(len(sweep.points)) for sweep in (window.pc0, window.pc1, *window.pch)]
        orders.append(mine[0])
        sweeps = [
            replace(sweep, points=sweep.points[order], is_ground=sweep.is_ground[order])
            for sweep, order in zip((window.pc0, window.pc1, *window.pch), mine)
        ]
        mixed.append(Window(sweeps[0], sweeps[1], tuple(sweeps[2:])))
    return [rows(result, np.argsort(order)) for result, order in zip(together(config, mixed), orders)]


def rows(result: FlowResult, order: np.ndarray) -> FlowResult:
    taken = {f.name: getattr(result, f.name) for f in fields(FlowResult)}
    return FlowResult(**{k: None if v is None else v[torch.from_numpy(order)] for k, v in taken.items()})


def again(config: Config, windows: List[Window]) -> Results:
    """The same model a third time, after other windows."""
    model = make_model(config, "cpu")
    for _ in range(2):
        model(windows[::-1])
    return model(windows)


def in_python_threads(config: Config, windows: List[Window]) -> Results:
    """One model, four callers at once."""
    model = make_model(config, "cpu")
    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(lambda window: model([window])[0], windows * 2))[-len(windows) :]


def with_other_kernels(config: Config, windows: List[Window]) -> Results:
    """Without oneDNN, matrix products in bfloat16 where torch may."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch says which GPUs this machine has not
            with torch.backends.mkldnn.flags(enabled=False):
                return together(config, windows)
    finally:
        torch.set_float32_matmul_precision(before)


def while_training(config: Config, windows: List[Window]) -> Results:
    """Gradients on, another default dtype, autocast, deterministic algorithms only."""
    torch.set_default_dtype(torch.float64)
    torch.use_deterministic_algorithms(True)
    try:
        with torch.enable_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
            return together(config, windows)
    finally:
        torch.use_deterministic_algorithms(False)
        torch.set_default_dtype(torch.float32)


VARIANTS: Dict[str, Way] = {
    "2 threads": on_threads(2),
    "a batch": together,
    "a batch, the other way round": together_backwards,
    "a batch of three times as many": many,
    "among empty and small windows": among_others,
    "max_memory of a byte": with_settings(max_memory=1),
    "max_memory of 2 MB": with_settings(max_memory=2_000_000),
    "points in pieces of 997": with_constants(ops_chunks__CHUNK_ON_CPU=997),
    "images in pieces": with_constants(correlate___AT_ONCE_CPU=600, correlate___IN_PART_CPU=900),
    "key points in pieces": with_constants(gate___PAIRS_AT_ONCE_CPU=50, match___STRIP_NUMBERS=11),
    "tiles of key points": with_constants(gate___TILE_ROWS=3, gate___TILE_COLS=5, gate___BAND=4, gate___GROUP=3),
    "correlation=conv": with_settings(correlation="conv"),
    "labeling=kornia": with_settings(labeling="kornia"),
    "conv and kornia": with_settings(correlation="conv", labeling="kornia"),
    "points in another order": shuffled,
    "float64 points": with_points(lambda p: p.astype(np.float64)),
    "tensors": with_points(lambda p: torch.from_numpy(p.copy())),
    "columns first": with_points(np.asfortranarray),
    "more columns": with_points(lambda p: np.pad(p, [(0, 0), (0, 3)], constant_values=np.nan)),
    "the third run": again,
    "four Python threads at once": in_python_threads,
    "without oneDNN, matmul precision medium": with_other_kernels,
    "while training": while_training,
}
NEED_KORNIA = ("labeling=kornia", "conv and kornia")


@lru_cache(maxsize=None)
def expected(preset: str) -> Tuple[Config, List[Window], Results]:
    config = small(preset)
    windows = windows_for(config, 3)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        return config, windows, plainly(config, windows)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    "variant",
    [pytest.param(v, marks=needs_kornia_labelling) if v in NEED_KORNIA else v for v in VARIANTS],
)
@pytest.mark.parametrize("preset", PRESETS)
def test_no_variant_changes_a_bit(preset: str, variant: str) -> None:
    config, windows, results = expected(preset)
    assert min(map(num_moving, results)) > 100  # there is something to change
    found = VARIANTS[variant](config, windows)
    assert len(found) == len(results)
    for one, other in zip(found, results):
        assert_same(one, other)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("preset", PRESETS)
def test_a_gpu_changes_no_bit(preset: str) -> None:
    config, windows, results = expected(preset)
    for labeling in ("sparse", "kornia"):
        if labeling == "kornia" and not has_kornia_labelling():
            continue
        for correlation in ("fft", "conv"):
            there = make_model(config.replace(labeling=labeling, correlation=correlation), "cuda")(windows)
            for one, other in zip(there, results):
                assert_same(one, other)


# --------------------------------------------------------------------------------------------------- new processes


def digest(results: Sequence[FlowResult]) -> str:
    """Of all bytes of some results."""
    whole = hashlib.sha256()
    for result in results:
        for name, value in sorted(result.numpy().items()):
            whole.update(f"{name} {value.dtype} {value.shape}".encode())
            whole.update(value.tobytes())
    return whole.hexdigest()


def print_digests() -> None:
    for preset in PRESETS:
        config = small(preset)
        print(preset, digest(plainly(config, windows_for(config, 3))))


@pytest.mark.parametrize("seed", ["0", "4294967295"])
@pytest.mark.slow
def test_a_new_process_gives_the_same_bytes_whatever_its_hashes(seed: str) -> None:
    here = Path(__file__).resolve().parent
    search = os.pathsep.join([str(here.parent), str(here), os.environ.get("PYTHONPATH", "")])
    environment = {
        **os.environ,
        "PYTHONHASHSEED": seed,
        "PYTHONPATH": search,
        "OMP_NUM_THREADS": str(1 + int(seed) % 2),
    }
    command = [sys.executable, "-c", "import test_exactness_matrix as matrix; matrix.print_digests()"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [word for p in PRESETS for word in (p, digest(expected(p)[2]))]


# ------------------------------------------------------------------------------------------------- at full size


@lru_cache(maxsize=None)
def street(preset: str) -> Tuple[Config, List[Window], Results]:
    """Two windows of a simulated drive of some 100,000 points a sweep, with the preset's own region and history."""
    config = make_config(preset)
    drive = make_drive(seed=7, num_sweeps=config.num_history + 3)
    windows = [
        window_of(drive, index, config.num_history) for index in range(config.num_history, config.num_history + 2)
    ]
    return config, windows, plainly(config, windows)


# conv counts in (H W)^2 steps: hours for the walls of a street.
AT_FULL_SIZE = [name for name in VARIANTS if "conv" not in name and name != "key points in pieces"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", [pytest.param(v, marks=needs_kornia_labelling) if v in NEED_KORNIA else v for v in AT_FULL_SIZE]
)
@pytest.mark.parametrize("preset", PRESETS)
def test_no_variant_changes_a_bit_of_a_street(preset: str, variant: str) -> None:
    config, windows, results = street(preset)
    assert min(map(num_moving, results)) > 100
    pieces = {"points in pieces of 997": with_constants(ops_chunks__CHUNK_ON_CPU=9973)}
    for one, other in zip(pieces.get(variant, VARIANTS[variant])(config, windows), results):
        assert_same(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("variant", AT_FULL_SIZE)
@pytest.mark.parametrize("preset", PRESETS)
def test_no_variant_changes_a_bit_of_the_real_pair(av2_folder: Path, preset: str, variant: str) -> None:
    if variant in NEED_KORNIA and not has_kornia_labelling():
        pytest.skip("kornia < 0.9 has no exact union-find labelling")
    window = window_of(AV2Log(av2_folder), 0)
    config = make_config(preset)
    pieces = {"points in pieces of 997": with_constants(ops_chunks__CHUNK_ON_CPU=9973)}
    assert_same(pieces.get(variant, VARIANTS[variant])(config, [window])[0], plainly(config, [window])[0])


def main() -> None:
    """Markdown: variant, and of each preset the integers that differ and the largest difference of floats."""
    print("| variant | " + " | ".join(PRESETS) + " |\n|---" + "|---" * len(PRESETS) + "|")
    for variant, way in VARIANTS.items():
        if variant in NEED_KORNIA and not has_kornia_labelling():
            print(f"| {variant} | not run: kornia < 0.9 |")
            continue
        cells = []
        for preset in PRESETS:
            config, windows, results = expected(preset)
            pairs = [
                (getattr(a, f.name), getattr(b, f.name))
                for a, b in zip(way(config, windows), results)
                for f in fields(FlowResult)
                if getattr(b, f.name) is not None
            ]
            different = sum(int((a != b).sum()) for a, b in pairs if not a.is_floating_point())
            largest = max(float((a - b).abs().max()) for a, b in pairs if a.is_floating_point())
            cells.append("identical" if different == 0 and largest == 0 else f"{different}; {largest:.2g}")
        print(f"| {variant} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    print_digests() if sys.argv[1:] == ["digests"] else main()
