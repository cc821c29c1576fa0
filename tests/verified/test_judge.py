"""The proof: counts, worth and choice equal to the loop over pixels, to the bit; ties, borders, missing sweeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import judge as ref
from scenes import needs_gpu, same_bits

from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of_log
from cflow_torch.dense.clustering import cluster
from cflow_torch.verified import paired_test as fast
from cflow_torch.verified.height_slices import Cells, cells_of_image, make_cells
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

EVERY = slice(None)


class Scene:
    """Random images of B windows, S sweeps; random components; candidates on and between whole pixels."""

    def __init__(self, seed: int, num_windows: int = 2, num_steps: int = 3, density: float = 0.5) -> None:
        rng = np.random.default_rng(seed)
        self.height, self.width = rng.integers(3, 18, 2).tolist()
        shape = (num_windows, num_steps, self.height, self.width)
        self.images = (rng.integers(1, 16, shape) * (rng.random(shape) < density)).astype(np.uint8)
        self.num_nodes = 5
        self.nodes = rng.integers(0, self.num_nodes + 1, shape)  # the last: none
        # A component lies in one window.
        self.nodes = np.where(self.nodes % num_windows == np.arange(num_windows)[:, None, None, None], self.nodes, 5)
        self.candidates = rng.integers(-8, 9, (self.num_nodes, 4, 2)) / rng.choice([1.0, 2.0, 3.0])
        self.candidates[:, 1] = rng.normal(0, 2, (self.num_nodes, 2))
        self.candidates[0, 2], self.candidates[1, 3] = self.candidates[0, 0], 0.0
        self.judged = rng.random(self.num_nodes) < 0.8
        k = np.arange(num_steps) * rng.choice([1.0, 1.07])
        self.elapsed = np.stack([k] * num_windows)
        if num_steps > 2:  # the first window lacks the oldest sweep
            self.images[0, -1], self.elapsed[0, -1] = 0, 0.0

    def cells(self, windows: slice = EVERY) -> Cells:
        images = self.images[windows]
        image = torch.from_numpy(np.append(images.ravel(), np.uint8(0)))
        grid = Grid(1.0, (0.0, 0.0, -1.0), (self.width - 0.5, self.height - 0.5, 1.0))
        assert (grid.height, grid.width) == images.shape[2:]
        return cells_of_image(image, grid, *images.shape[:2])

    def judge(self, windows: slice = EVERY, device: str = "cpu"):
        cells = self.cells(windows)
        node = torch.from_numpy(self.nodes[windows].ravel())[cells.pixel]
        if device != "cpu":
            fields = {name: getattr(cells, name) for name in Cells.__dataclass_fields__}
            cells = Cells(**{n: v.to(device) if torch.is_tensor(v) else v for n, v in fields.items()})
        given = (node, *map(torch.from_numpy, (self.candidates, self.judged, self.elapsed[windows])))
        return fast.judge(cells, *(values.to(device) for values in given))

    def expected(self):
        counts = np.zeros((2, *self.candidates.shape[:2]), dtype=np.int64)
        for node in np.flatnonzero(self.judged).tolist():
            for window, images in enumerate(self.images):
                members = (self.nodes[window] == node) & (images != 0)
                if members.any():
                    for c, motion in enumerate(self.candidates[node].tolist()):
                        counts[:, node, c] += ref.paired_counts(images, members, motion, self.elapsed[window].tolist())
        return counts


@pytest.mark.parametrize("num_windows, num_steps", [(1, 2), (2, 2), (2, 3), (3, 5)])
@pytest.mark.parametrize("seed", range(6))
def test_counts_equal_the_loop_over_pixels(seed, num_windows, num_steps):
    scene = Scene(seed, num_windows, num_steps)
    won, lost = scene.judge()
    assert won.dtype == lost.dtype == torch.int64
    assert [won.tolist(), lost.tolist()] == scene.expected().tolist()


def test_the_scenes_have_something_to_count():
    counts = np.stack([Scene(seed, 2, 3).expected() for seed in range(6)])
    assert (counts > 0).mean() > 0.4 and counts.max() > 20


def test_pieces_do_not_matter(monkeypatch):
    whole = Scene(3).judge()
    for looks in (1, 7, 50):
        monkeypatch.setattr(fast, "_LOOKS_ON_CPU", looks)
        assert all(same_bits(a, b) for a, b in zip(Scene(3).judge(), whole))


def test_batch_equals_loop():
    scene = Scene(4, num_windows=3, num_steps=4)
    together = scene.judge()
    alone = [scene.judge(slice(window, window + 1)) for window in range(3)]
    for values, parts in zip(together, zip(*alone)):
        assert same_bits(values, sum(parts))  # a component has pixels in one window only
    # The first window lacks the oldest sweep: the same without the empty image.
    scene.images, scene.nodes, scene.elapsed = scene.images[:1, :-1], scene.nodes[:1, :-1], scene.elapsed[:1, :-1]
    assert all(same_bits(a, b) for a, b in zip(scene.judge(), alone[0]))


def test_a_column_by_hand():
    # Sweep t: two pixels with slices 1 and 3; t+1: both two pixels further on, and slice 1 where the first one was.
    images = np.zeros((1, 2, 1, 8), dtype=np.uint8)
    images[0, 1, 0, [1, 2]] = 0b01, 0b11
    images[0, 0, 0, [1, 3, 4]] = 0b01, 0b01, 0b11
    scene = Scene(0)
    scene.height, scene.width, scene.images = 1, 8, images
    scene.nodes = np.zeros(images.shape, dtype=np.int64)
    scene.candidates = np.array([[[0.0, 2.0], [0.0, 1.5], [0.0, 1.49], [0.0, 0.0], [5.0, 0.0]]])
    scene.judged, scene.elapsed = np.array([True]), np.array([[0.0, 1.0]])
    won, lost = scene.judge()
    # Forwards, by 2: pixel 1 meets slice 1 at 3 and at 1 (no news), pixel 2 wins its two. Backwards: pixel 1 goes to -1
    # and loses the slice at 1; pixel 3 wins one, pixel 4 two. By 1.5 the same forwards; backwards floor(-1) = -1: pixel
    # 1 loses, 3 and 4 win one and nothing. By 1.49: 1 forwards, where only pixel 2 wins one and 1 loses one; -1 back.
    assert won.tolist() == [[5, 3, 2, 0, 0]]
    assert lost.tolist() == [[1, 1, 2, 0, 2]]


def test_components_of_the_real_pair(av2_folder):
    settings = Config(sectional_view=True)
    grid = Grid(0.1, settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    batch = make_batch([window_of_log(AV2Log(av2_folder), 0)], settings, grid, "cpu")
    cells, _ = make_cells(batch, grid, 0.5)
    images = cells.image[:-1].view(1, 2, grid.height, grid.width)
    clusters, of_place = cluster(images != 0, 0.1, settings)
    node = of_place[cells.pixel].long()
    num_nodes = clusters.window.numel()
    rng = np.random.default_rng(0)
    candidates = rng.normal(0, 6, (num_nodes, 3, 2))
    judged = rng.random(num_nodes) < 0.1
    won, lost = fast.judge(cells, node, torch.from_numpy(candidates), torch.from_numpy(judged), batch.elapsed)
    assert judged.sum() > 15 and not won[~judged].any() and not lost[~judged].any()
    for i in np.flatnonzero(judged).tolist():
        members = torch.zeros_like(cells.image, dtype=torch.bool)
        members[cells.pixel[node == i]] = True
        members = members[:-1].view_as(images)[0].numpy()
        for c, motion in enumerate(candidates[i].tolist()):
            expected = ref.paired_counts(images[0].numpy(), members, motion, [0.0, 1.0])
            assert (int(won[i, c]), int(lost[i, c])) == expected
    assert (won + lost > 10).sum() > 15


def test_what_is_not_judged_counts_nothing():
    scene = Scene(2)
    scene.judged[:] = False
    assert not any(values.any() for values in scene.judge())


@pytest.mark.parametrize("z", [0.0, 1.0, 1.5, 2.0])
def test_worth_equals_the_scalar_formula(z):
    rng = np.random.default_rng(0)
    counts = np.concatenate(
        [np.stack(np.meshgrid(range(40), range(40))).reshape(2, -1), rng.integers(0, 2**31, (2, 500))], 1
    )
    found = fast.worth(*torch.from_numpy(counts), z)
    assert found.dtype == torch.int64
    assert found.tolist() == [ref.worth(won, lost, z) for won, lost in counts.T.tolist()]


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.integers(1, 6).flatmap(lambda c: st.lists(st.lists(st.integers(0, 3), min_size=c, max_size=c), min_size=1)))
def test_choice_equals_the_scalar_rule(worths):
    candidates = np.random.default_rng(1).normal(size=(len(worths), len(worths[0]), 2))
    motion, worth = fast.choose(torch.tensor(worths), torch.from_numpy(candidates))
    expected = [ref.choose(row, [tuple(f) for f in fs]) for row, fs in zip(worths, candidates.tolist())]
    assert [(tuple(f), w) for f, w in zip(motion.tolist(), worth.tolist())] == expected


def test_large_worths_are_told_apart():
    worths = torch.tensor([[2**36 - 2, 2**36 - 1, 2**36 - 1], [1, 0, 2**36 - 1]])
    motion, worth = fast.choose(worths, torch.arange(12, dtype=torch.float64).view(2, 3, 2))
    assert motion.tolist() == [[2.0, 3.0], [10.0, 11.0]] and worth.tolist() == [2**36 - 1] * 2


def test_no_components():
    cells = Scene(0).cells()
    node = torch.zeros_like(cells.pixel)
    none = torch.zeros((0, 3, 2), dtype=torch.float64)
    elapsed = torch.from_numpy(Scene(0).elapsed)
    won, lost = fast.judge(cells, node, none, torch.zeros(0, dtype=torch.bool), elapsed)
    assert won.shape == lost.shape == (0, 3)
    motion, worth = fast.choose(fast.worth(won, lost, 2.0), none)
    assert motion.shape == (0, 2) and worth.shape == (0,)


def test_no_pixels():
    scene = Scene(0, density=0.0)
    assert not any(values.any() for values in scene.judge())


@pytest.mark.cuda
@needs_gpu
def test_judge_on_cuda_equals_cpu():
    for seed in range(3):
        scene = Scene(seed, 3, 5)
        found, expected = scene.judge(device="cuda"), scene.judge()
        assert all(same_bits(a, b) for a, b in zip(found, expected))
        assert same_bits(fast.worth(*found, 2.0), fast.worth(*expected, 2.0))
