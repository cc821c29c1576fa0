#!/usr/bin/env python3
"""The picture of docs/applications.md that shows cars met by two rotating LiDARs, as measured and de-skewed.

python scripts/figures/deskewed.py            docs/pictures/deskewed.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import failure_drives
import matplotlib
import numpy as np
from failure_drives import PAIR

from cflow_torch import VerifiedFlow
from cflow_torch.applications.deskewing import deskew
from cflow_torch.data.log import window

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "deskewed.png"


def main() -> int:
    """Draw it; returns the exit status."""
    drive = failure_drives.rolling_shutter(0).drive
    model = VerifiedFlow.from_preset("default", device="cpu")
    sweeps = window(drive, PAIR, model.config.num_history)
    (result,) = model([sweeps])
    given, times = np.asarray(sweeps.pc0.points), np.asarray(sweeps.pc0.point_times)
    shown = result.is_valid.numpy() & (np.abs(given[:, 1]) < 7)
    figure, axes = plt.subplots(2, 1, figsize=(8, 4.6), sharex=True, layout="constrained")
    for panel, points, title in zip(axes, (given, deskew(sweeps, result).numpy()), ("as measured", "de-skewed")):
        dots = panel.scatter(*points[shown, :2].T, s=1.5, c=1000 * times[shown], cmap="viridis", linewidths=0)
        panel.set(title=title, aspect="equal", xlim=(-30, 26), ylim=(-7, 7))
    figure.colorbar(dots, ax=axes, label="measured, ms after the instant of the sweep", shrink=0.8)
    figure.savefig(PICTURE, dpi=110)
    return 0


if __name__ == "__main__":
    sys.exit(main())
