#!/usr/bin/env python3
"""Draw the steps of the verified method (docs/verified.md) on two small simulated drives (drives.py).

python scripts/figures/verified_steps.py                        docs/pictures/verified_steps.png
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drives
import numpy as np
import torch
from matplotlib.patches import Rectangle

from cflow_torch import VerifiedFlow
from cflow_torch.data.log import window
from cflow_torch.types import MOVING
from cflow_torch.verified.candidates import propose
from cflow_torch.verified.changed_pixels import find_changed
from cflow_torch.verified.columns import count_slices
from cflow_torch.verified.component_tree import NodeKind, find_components, movable_nodes
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.overhangs import add_overhung
from cflow_torch.verified.paired_test import add_unchanged, verify
from cflow_torch.verified.selection import select_objects
from cflow_torch.viz import save_picture, style
from cflow_torch.viz.clusters import PALETTE, cluster_colors
from cflow_torch.viz.panel import ARROW_STEPS, group_medians
from cflow_torch.viz.wheel import flow_to_rgb, wheel_image
from cflow_torch.windows.collation import make_batch

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
# Title of each row, its drive, and the lower left corner and the width of its view, metres, frame of t+1.
ROWS = (
    ("a car under a tree crown", drives.tree(4), (0.6, 0.3), 13.6),
    ("walkers 0.3 m from a wall", drives.walkers(2, gap=0.3), (2.3, 3.1), 8.7),
)
COLUMNS = (
    ("1  pixels", "Sweep t from above. A darker\npixel has more height slices."),
    ("2  changed pixels", "All sweeps. Red pixels are missing\nin a sweep that saw their cell."),
    ("3  components", "A colour is a finest component that\nmay move. Boxes: solid = coarser,\n"
     "dotted = group of changed pixels,\ndashed = lies under an overhang."),
    ("4  selection", "A colour is an object selected to\nmove. Grey stays static. A striped\n"
     "object lies under an overhang."),
    ("5  flow", f"Sweep t, after refinement. Grey\nmoves less than {MOVING:g} m per sweep.\n"
     f"Arrows: displacement in {ARROW_STEPS} sweeps."),
)  # fmt: skip
STATIC, PALE, SHADES = (172, 179, 187), (214, 219, 224), np.array([[225], [190], [145], [95], [25]]).repeat(3, 1)
WIDE, HIGH, GAP, LEFT, FOOT, HEAD = 2.6, 1.8, 0.11, 0.4, 1.0, 0.4  # inches


def take_steps(drive: Any) -> tuple[Any, ...]:
    """Sweeps, changed pixels, components, nodes, objects, which of them move, and the flow, of the pair of a drive."""
    model = VerifiedFlow.from_preset("default", num_history=4)
    config, given = model.config, [window(drive, drives.PAIR, 4)]
    grid = model.grid(config.pixel_sizes[-1])
    batch = make_batch(given, config, grid, torch.device("cpu"), 3, model.needs_ground, model.needs_times)
    sweeps = HeightSlicedSweeps.of(batch, grid, config.min_height)
    change = find_changed(sweeps)
    blocks = [round(size / config.pixel_sizes[-1]) for size in config.pixel_sizes]
    components = find_components(sweeps, change, blocks)
    sweeps, tree = add_overhung(sweeps, components, movable_nodes(sweeps, components, config.max_object_length))
    candidates = propose(sweeps, tree, blocks, config)
    verdict = verify(sweeps, tree, candidates.motion, config.significance)
    tree = add_unchanged(sweeps, tree, verdict.motion)
    objects = select_objects(sweeps, components, tree, verdict, config.significance)
    return sweeps, change, components, tree, objects, objects.by_node.spread(verdict.motion).any(1), model(given)[0]


def draw_row(panels: list[Any], drive: Any, low: tuple[float, float], width: float) -> None:
    """Draw one drive, a step in each panel. The view is `width` metres wide and begins at the corner `low`."""
    sweeps, change, components, nodes, objects, moves, result = take_steps(drive)
    pixels, size, levels = sweeps.pixels, sweeps.grid.pixel_size, nodes.num_levels
    own, node_of_member = len(components.plain.of_item), nodes.members.of_item
    high = np.array(low) + (width, width * HIGH / WIDE)
    corners = pixels.row_col.flip(0).T.numpy() * size + sweeps.grid.lower[:2]  # lower left ones

    def paint(axes: Any, *layers: tuple[torch.Tensor, Any]) -> None:
        image = np.full((sweeps.grid.height, sweeps.grid.width, 3), 255, np.uint8)
        for pixel, rgb in layers:
            image[tuple(pixels.row_col[:, pixel])] = rgb
        left, bottom = sweeps.grid.lower[:2]
        extent = (left, left + image.shape[1] * size, bottom, bottom + image.shape[0] * size)
        axes.imshow(image, extent=extent, origin="lower", interpolation="nearest")
        style.set_view(axes, np.array(low), high)

    def colours(pixel: torch.Tensor, group: torch.Tensor) -> tuple[torch.Tensor, np.ndarray]:
        return pixel, cluster_colors(corners[pixel], group.numpy(), STATIC)

    every, now = torch.arange(own), torch.where(pixels.step[:own] == 1)[0]
    paint(panels[0], (now, SHADES[count_slices(pixels.slices[now])]))
    paint(panels[1], (every, PALE), (torch.where(change.has_changed)[0], PALETTE[0]))
    scales = torch.tensor((levels - 2, levels - 1))  # the finest, dilated and plain
    fine = torch.where(torch.isin(nodes.kind[node_of_member], scales))[0].flip(
        0
    )  # dilated ones are drawn over plain ones
    paint(panels[2], (every, PALE), colours(nodes.pixel[fine], node_of_member[fine]))
    for number, level in enumerate(nodes.kind.tolist()):
        if level not in (levels - 2, levels - 1):
            inside = corners[nodes.pixel[node_of_member == number]]
            corner, far = inside.min(0) - 0.5 * size, inside.max(0) + 1.5 * size
            line = {NodeKind.CHANGED: (":", 1.3), NodeKind.OVERHUNG: ("--", 1.6)}.get(level, ("-", 1.0))
            panels[2].add_patch(Rectangle(corner, *(far - corner), fill=False, linestyle=line[0], linewidth=line[1]))
    chosen = torch.where(objects.by_object.spread(moves))[0]
    chosen, rgb = colours(chosen, objects.by_object.of_item[chosen])
    rgb[(chosen >= own) & (pixels.row_col[:, chosen].sum(0) % 6 < 2)] = 255
    paint(panels[3], (every, PALE), (chosen, rgb))

    flow, rows = result.residual_flow.numpy(), sweeps.batch.rows[0]
    pixel, points = sweeps.points.of_item[rows], sweeps.batch.positions[:2, rows].T.numpy()
    fast = result.is_moving.numpy()
    fast &= ((points >= low) & (points <= high)).all(1)
    longest = np.ceil(20 * np.linalg.norm(flow[fast], axis=1).max()) / 20
    paint(panels[4], (now, STATIC), (pixel[fast], flow_to_rgb(flow[fast], longest)))
    _, arrows, count = group_medians(result.cluster_id.numpy()[fast], np.hstack((points, flow[:, :2]))[fast])
    arrow: Any = {"angles": "xy", "scale_units": "xy", "scale": 1 / ARROW_STEPS, "width": 0.012, "edgecolor": "white"}
    panels[4].quiver(*arrows[count > 8].T, color=style.INK, linewidth=0.6, zorder=6, **arrow)
    wheel = panels[4].inset_axes((0.8, 0.05, 0.18, 0.26))
    wheel.imshow(wheel_image(128))
    wheel.set_axis_off()
    panels[4].text(0.79, 0.06, f"rim: {longest:.2f} m per sweep", transform=panels[4].transAxes, fontsize=8, ha="right")
    style.draw_scale(panels[0])


def main() -> None:
    torch.set_num_threads(1)
    figure = style.blank_figure((LEFT + 5 * (WIDE + GAP), FOOT + HEAD + 2 * (HIGH + GAP)), 100)
    for row, (name, staged, low, width) in enumerate(ROWS):
        bottom = FOOT + (1 - row) * (HIGH + GAP)
        panels = [style.add_panel(figure, LEFT + i * (WIDE + GAP), bottom, WIDE, HIGH) for i in range(5)]
        draw_row(panels, staged.drive, low, width)
        panels[0].set_ylabel(name, fontsize=10, color=style.INK)
        for axes, (title, caption) in zip(panels, COLUMNS):
            if row == 0:
                axes.set_title(title, fontsize=14, color=style.INK, pad=6)
            else:
                font = {"fontsize": 10.5, "color": style.FAINT, "linespacing": 1.3, "va": "top"}
                axes.text(0, -0.05, caption, transform=axes.transAxes, **font)
    save_picture(figure, FOLDER / "verified_steps.png")


if __name__ == "__main__":
    main()
