"""Find the drives of KITTI below a folder, in its layouts as unpacked."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Sequence

from cflow_torch.data.folders import search, visible
from cflow_torch.data.paths import PathLike, as_path

_DEEPEST = 6  # levels below the root; <root>/kitti/raw/<date>/<drive> has four


class KITTIDrive(NamedTuple):
    """One drive: a source for `KITTILog`."""

    root: Path  # raw: folder of the drive; sequence: its folder; tracking: the folder of velodyne, calib and label_02
    clouds: Path  # folder of the clouds
    layout: str  # "raw", "sequence" or "tracking"
    name: str  # log_id

    def __str__(self) -> str:
        return str(self.clouds)

    @property
    def folder(self) -> Path:
        """The folder after which the drive is named."""
        return self.clouds if self.layout == "tracking" else self.root


def find_kitti_drives(root: PathLike) -> list[KITTIDrive]:
    """Find all drives at most six levels below a folder, sorted by path.

    Convention:
        - raw: `<drive>/velodyne_points/data/0000000000.bin`, also without the folder `data`, or with texts (drives that
          are called `_extract`). It is named after the folder of the drive.
        - sequence (odometry, SemanticKITTI): `<NN>/velodyne/000000.bin`, if the folder has calib.txt or labels, or lies
          in a folder `sequences`. It is named NN.
        - tracking: `velodyne/<NNNN>/000000.bin`, named NNNN.
        You may also pass a folder inside a drive, down to its clouds.
    """
    top = as_path(root)
    found = search(top, _drives_of, _DEEPEST, "a drive of KITTI, or a folder of drives")
    if not found:
        resolved = top.resolve()
        found = [drive for parent in (resolved.parent, resolved.parent.parent) for drive in _drives_of(parent)]
        found = [drive for drive in found if resolved in (drive.clouds, drive.clouds.parent)]
    return sorted(found)


def _drives_of(folder: Path) -> list[KITTIDrive]:
    """Return the drive whose folder this is, or the drives of a tracking set."""
    for raw in (folder / "velodyne_points" / "data", folder / "velodyne_points"):
        if _has_clouds(raw, (".bin", ".txt"), digits=(10,)):
            return [KITTIDrive(folder, raw, "raw", folder.resolve().name)]
    clouds = folder / "velodyne"
    if not clouds.is_dir():
        return []
    if _has_clouds(clouds):
        is_kitti = (folder / "calib.txt").exists() or (folder / "labels").is_dir()
        is_kitti |= folder.resolve().parent.name == "sequences"
        return [KITTIDrive(folder, clouds, "sequence", folder.resolve().name)] if is_kitti else []
    drives = [child for child in clouds.iterdir() if child.name.isdigit() and _has_clouds(child)]
    return [KITTIDrive(folder, drive, "tracking", drive.name) for drive in drives]


def _has_clouds(folder: Path, suffixes: Sequence[str] = (".bin",), digits: Sequence[int] = (6, 10)) -> bool:
    stems = (path.stem for path in visible(folder) if path.suffix in suffixes)
    return any(stem.isdigit() and len(stem) in digits for stem in stems)
