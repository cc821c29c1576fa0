"""One self-contained .html of a drive (extra `html`): points and flow in 3-D with a time slider, drawn by k3d."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping, Sequence

import numpy as np

from cflow_torch import __version__
from cflow_torch.data.atomic import write_text
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.packing import PackedDrive, packed
from cflow_torch.viz.scene import MAX_FLOW, ViewedPair
from cflow_torch.viz.style import checked_path

STATIC_VOXEL = 0.1  # metres
_TEMPLATE = Path(__file__).parent / "page.html"

TrackTable = Mapping[str, np.ndarray]


@dataclass(frozen=True, repr=False)
class Page:
    """A page with a drive. A notebook shows it inline."""

    html: str  # text of the whole page
    num_pairs: int  # number of pairs in it

    def save(self, path: str | Path) -> Path:
        """Write the page to an .html file. It appears complete or not at all, and replaces an older one."""
        path = checked_path(path, ".html")
        write_text(path, self.html)
        return path

    def _repr_html_(self) -> str:
        frame = "width:100%;height:600px;border:0;border-radius:8px"
        return f'<iframe srcdoc="{escape(self.html)}" style="{frame}" allowfullscreen></iframe>'


def show(
    windows: Window | Sequence[Window],
    results: FlowResult | Sequence[FlowResult],
    *,
    labels: FlowLabels | None | Sequence[FlowLabels | None] = None,
    tracks: TrackTable | None = None,
    title: str = "CorrelationFlow",
    preset: str | None = None,
    max_flow: float = MAX_FLOW,
    voxel: float = STATIC_VOXEL,
) -> Page:
    """Show one pair or several consecutive ones in 3-D: in a notebook inline, elsewhere with `show(...).save(path)`.

    Args:
        windows: one window, or a list; only pc0 and pc1 are used.
        results: its flow, or a list of the same length.
        labels: its labels, or a list of the same length; None = no labels.
        tracks: table of `cflow_torch.track`, whose column `sweep` counts the windows from 0.
        title, preset: texts of the heading.
        max_flow: metres per sweep. Residual flow of this length has the full colour; longer flow is darker.
        voxel: side of a voxel, metres; on the ground, twice that. We keep one static point in each voxel.

    Raises:
        CFlowError: k3d is not installed, lists differ in length or are empty, or a value is not allowed.
    """
    sweeps = [windows] if isinstance(windows, Window) else list(windows)
    flows = [results] if isinstance(results, FlowResult) else list(results)
    given: list[Any] = [labels] * len(sweeps) if labels is None or isinstance(labels, FlowLabels) else list(labels)
    if not len(sweeps) == len(flows) == len(given):
        raise CFlowError(f"{len(sweeps)} windows, {len(flows)} results, {len(given)} labels: give one of each per pair")
    scenes = (ViewedPair.of(i, w.pc0, w.pc1, r, t) for i, (w, r, t) in enumerate(zip(sweeps, flows, given)))
    return _page(scenes, PackedDrive(max_flow, voxel), lambda: tracks, title, preset)


def save_page(
    log: Log,
    results: Iterable[tuple[int, FlowResult]],
    path: str | Path,
    *,
    tracks: Callable[[], TrackTable | None] = lambda: None,
    preset: str | None = None,
    max_flow: float = MAX_FLOW,
    voxel: float = STATIC_VOXEL,
) -> int:
    """Save a drive as one .html that any browser opens without a network.

    Args:
        log: the drive. We read its sweeps again, and its labels if it has any.
        results: (index, flow of sweep `index` to `index + 1`) in ascending order, taken one by one.
        path: ends in .html. Its folder is created if it does not exist; an older file is replaced.
        tracks: returns a table of `cflow_torch.track`, or None; called after the last result.
        preset, max_flow, voxel: as in `show`.

    Returns:
        Number of pairs in the page.

    Raises:
        CFlowError: as in `show`; the path does not end in .html; there is no result.
        OSError: the log cannot be read, or the file cannot be written. An error of `results` is passed on.

    Cost: on disk about 0.2 MB per sweep of 100,000 points, and 1.1 MB for k3d; 1 MB of memory per sweep. Chromium
        opened a page of 698 MiB in 9 s.
    """
    checked_path(path, ".html")
    scenes = (ViewedPair.of(i, log.sweep(i), log.sweep(i + 1), result, log.labels(i)) for i, result in results)
    page = _page(scenes, PackedDrive(max_flow, voxel), tracks, log.log_id, preset)
    page.save(path)
    return page.num_pairs


def load_k3d() -> str:
    """Read the JavaScript of k3d, packed for a page, without importing the package; a missing k3d is a `CFlowError`."""
    found = find_spec("k3d")
    script = Path(found.origin or "").parent / "static" / "standalone.js" if found else None
    if script is None or not script.is_file():
        raise CFlowError(
            "pages need k3d (extra html, Python 3.9 or newer): pip install 'k3d>=3.2', or give format=rerun"
        )
    return _packed_file(script)


@lru_cache(maxsize=1)
def _packed_file(path: Path) -> str:
    return packed(path.read_bytes())


def _page(
    scenes: Iterable[ViewedPair],
    drive: PackedDrive,
    tracks: Callable[[], TrackTable | None],
    title: str,
    preset: str | None,
) -> Page:
    """Pack the scenes into an empty drive, and fill in the template."""
    library = load_k3d()
    for scene in scenes:
        drive.add(scene)
    if not drive.frames:
        raise CFlowError("there is no pair to show")
    table = tracks()
    if table is not None:
        drive.add_tracks(table)
    about = {"title": title, "preset": preset, "version": __version__}
    text = _TEMPLATE.read_text(encoding="utf-8")
    # "<" is escaped, so a name in the data cannot end the script that holds it.
    data = json.dumps({**about, **drive.content()}, separators=(",", ":")).replace("<", "\\u003c")
    # A text per frame: browsers cannot read one of more than 512 MiB, which a drive of some minutes would have.
    clouds = [f'<script id="points-{k}" type="text/plain">{cloud}</script>' for k, cloud in enumerate(drive.clouds())]
    parts = {"TITLE": escape(title), "K3D": library, "DATA": data, "POINTS": "\n".join(clouds)}
    text = re.sub(rf"\[({'|'.join(parts)})\]", lambda mark: parts[mark[1]], text)
    return Page(text, len(drive.frames))
