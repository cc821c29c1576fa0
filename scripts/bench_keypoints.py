#!/usr/bin/env python3
"""Time and memory of CorrelationFlow-Keypoints against the number of key points and the gate.

  python scripts/bench_keypoints.py

Random pixels, 4 % of the image occupied, so that nearly every one is a key point; the image grows with their number.
Prints Markdown: key points of t, candidates within the gate per key point (counted), median milliseconds of a window,
nanoseconds per pair, and the most memory held above that before the run. Every row has a process of its own, because
memory that the C library kept from an earlier row would hide the next one's.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from typing import Dict, Tuple

import numpy as np
import torch

from cflow_torch import Sweep, Window, make_config, make_model
from cflow_torch.bench.measure import measure_peak

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


def measure(num_key_points: int, gate: float, repeats: int, device: str) -> Dict[str, float]:
    """One row."""
    images = make_images(num_key_points)
    side = images.shape[1] * PIXEL_SIZE
    config = make_config(
        "keypoints", gate_radius=gate, pixel_size=PIXEL_SIZE, point_cloud_range=(0, 0, -1, side, side, 1)
    )
    model, window = make_model(config, device), make_window(images)
    (result,) = model([window])
    peak, _ = measure_peak(lambda: model([window]))
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        (result,) = model([window])
        if result.flow.is_cuda:
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    pairs = count_pairs(images, round(gate / PIXEL_SIZE))
    return {"points": int(images[0].sum()), "pairs": pairs, "seconds": statistics.median(seconds), "peak": peak}


def cells(gate: float, row: Dict[str, float]) -> Tuple[str, ...]:
    """A row of the table."""
    per_pair = 1e9 * row["seconds"] / row["pairs"]
    peak = row["peak"] if isinstance(row["peak"], str) else f"{row['peak']:.0f}"
    candidates = f"{row['pairs'] / row['points']:.0f}"
    return (str(row["points"]), f"{gate}", candidates, f"{1000 * row['seconds']:.1f}", f"{per_pair:.0f}", peak)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--row", type=int, help="one row as JSON; for internal use")
    arguments = parser.parse_args()
    if arguments.row is not None:
        print(json.dumps(measure(*ROWS[arguments.row], arguments.repeats, arguments.device)))
        return
    header = ("key points", "gate m", "candidates each", "ms", "ns per pair", "extra MB")
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}, preset `keypoints`\n")
    print("| " + " | ".join(header) + " |\n" + "|---" * len(header) + "|")
    for index, (_, gate) in enumerate(ROWS):
        command = [sys.executable, __file__, "--row", str(index), "--repeats", str(arguments.repeats)]
        done = subprocess.run([*command, "--device", arguments.device], check=True, capture_output=True, text=True)
        print("| " + " | ".join(cells(gate, json.loads(done.stdout))) + " |", flush=True)


if __name__ == "__main__":
    main()
