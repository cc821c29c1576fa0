#!/usr/bin/env python3
"""Time and memory of CorrelationFlow-Keypoints against the number of key points and the gate.

  python scripts/benchmarks/keypoints.py

Random pixels, 4 % of the image occupied, so that nearly every one is a key point; the image grows with their number.
Prints Markdown: key points of t, candidates within the gate per key point (counted), median milliseconds of a window,
nanoseconds per pair, and the most memory held above that before the run, counted from allocations.
"""

from __future__ import annotations

import argparse
from typing import Any, List

import numpy as np
import torch
from counts import count_allocations
from table import markdown

from cflow_torch import Sweep, Window, make_config, make_model
from cflow_torch.fleet.machine import threads
from cflow_torch.stages import StopWatch

DENSITY = 0.04
PIXEL_SIZE = 0.1
# (key points, gate in metres): first more of them, then a wider gate.
ROWS = [(n, 2.0) for n in (1000, 2000, 5000, 10_000, 20_000, 50_000)] + [(10_000, gate) for gate in (1.0, 4.0, 8.0)]


def make_images(num_key_points: int) -> np.ndarray:
    """(2, side, side) bool, images of t and t+1."""
    side = round((num_key_points / DENSITY) ** 0.5)
    return np.random.default_rng(num_key_points).random((2, side, side)) < DENSITY


def make_window(images: np.ndarray) -> Window:
    """One point in the middle of every set pixel."""
    pc0, pc1 = (np.argwhere(image)[:, ::-1] * PIXEL_SIZE + PIXEL_SIZE / 2 for image in images)
    return Window(*(Sweep(np.pad(points, [(0, 0), (0, 1)])) for points in (pc0, pc1)))


def count_pairs(images: np.ndarray, reach: int) -> int:
    """Pairs of set pixels of t and t+1 that lie at most `reach` pixels apart."""
    image0, image1 = (torch.from_numpy(image) for image in images)
    padded = torch.nn.functional.pad(image1, (reach, reach, reach, reach))
    height, width = image0.shape
    total = 0
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dy * dy + dx * dx <= reach * reach:
                total += int((image0 & padded[reach + dy :, reach + dx :][:height, :width]).sum())
    return total


def measure(num_key_points: int, gate: float, repeats: int, device: str) -> List[Any]:
    """One row."""
    images = make_images(num_key_points)
    side = images.shape[1] * PIXEL_SIZE
    config = make_config(
        "keypoints", gate_radius=gate, pixel_size=PIXEL_SIZE, point_cloud_range=(0, 0, -1, side, side, 1)
    )
    model, windows = make_model(config, device), [make_window(images)]
    watch = StopWatch(model)
    for _ in range(1 + repeats):
        watch(windows)
    seconds = watch.report()["median"]
    _, peak = count_allocations(lambda: model(windows))
    points, pairs = int(images[0].sum()), count_pairs(images, round(gate / PIXEL_SIZE))
    return [points, gate, round(pairs / points), 1000 * seconds, 1e9 * seconds / pairs, peak / 1e6]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    print(f"{given.threads} thread(s), torch {torch.__version__}, preset `keypoints`\n")
    header = ["key points", "gate m", "candidates each", "ms", "ns per pair", "extra MB"]
    with threads(given.threads):
        print(markdown([header, *(measure(*row, given.repeats, given.device) for row in ROWS)]))


if __name__ == "__main__":
    main()
