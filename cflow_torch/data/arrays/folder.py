"""What a folder of point clouds holds: the clouds of logs, and the files of poses, times and masks next to them."""

from __future__ import annotations

import re
from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Any, Callable, Container, Sequence

import numpy as np

from cflow_torch.data.arrays import cloud_text
from cflow_torch.data.arrays.cloud_file import SUFFIXES
from cflow_torch.data.arrays.poses_text import STRUCTURED, files_of_poses, parse_poses, parse_times, read_poses
from cflow_torch.data.arrays.stamps import times_of_names
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import find_folders, natural_key, visible
from cflow_torch.data.paths import PathLike, as_path, is_remote, read_start, stem_of, suffix_of
from cflow_torch.data.trajectory import Trajectory
from cflow_torch.types import CFlowError

POINT_FOLDERS = ("points", "lidar", "velodyne", "clouds", "pcd")  # where the clouds may lie below the log's folder
POSE_FILES = (
    *("poses.txt", "poses.npy", "poses.npz", "poses.csv", "trajectory.txt", "trajectory.csv", "trajectory.npz"),
    "odometry.csv",
)
GROUND_FOLDER = "ground"
SEARCH_DEPTH = 4
_OTHER_STEMS = {"poses", "trajectory", "times", "timestamps", "calib"}
# Suffixes of files that we test for poses and times.
_TABLES = (".txt", ".csv", ".tum", ".log", ".g2o", ".json", ".jsonl", ".yaml", ".yml", ".npy")
_NEAR_TABLES = (".txt", ".csv", ".tum")  # suffixes of files that we test in other folders
_FIRST_UNIX, _MOST = 10**17, 50  # nanoseconds in 1973; files or folders
_TESTED = 8192  # bytes of a file that tell what it holds
_FEWEST_POINTS = 20  # lines at the start of a text that may be a cloud
_LARGEST = 1 << 24  # bytes; structured files must be whole to be read, and poses take less


def find_array_logs(root: PathLike) -> list[Path]:
    """Find the folders of all logs, at most four levels below a folder, sorted.

    A log has two or more clouds of one suffix: in its folder, in a subfolder of `POINT_FOLDERS`, or in one of any name
    next to poses or times.
    """
    what = "a folder with one point cloud per file, or a folder of such"
    is_log, is_passed = (lambda folder: bool(_clouds(folder)[1])), (lambda child: child.name != GROUND_FOLDER)
    return find_folders(as_path(root), is_log, SEARCH_DEPTH, what, is_passed=is_passed)


def _clouds(folder: Path) -> tuple[Path, dict[str, list[Path]]]:
    """Return the folder that holds a log's clouds, and the clouds of each suffix that has two or more."""
    for parent in _usual_places(folder):
        kinds = _kinds(parent)
        if kinds:
            return parent, kinds
    below = _below(folder)
    has_tables = any((folder / name).exists() for name in (*POSE_FILES, "times.txt"))
    if has_tables or (len(below) == 1 and any(find_tables(folder))):
        return next(iter(below.items()), (folder, {}))
    return folder, {}


def _usual_places(folder: Path) -> list[Path]:
    return [folder, *(folder / name for name in POINT_FOLDERS)]


def _below(folder: Path) -> dict[Path, dict[str, list[Path]]]:
    """Return the folders below a log's that hold clouds, and these of each suffix."""
    kinds = {path: _kinds(path) for path in sorted(visible(folder))}
    return {path: kinds for path, kinds in kinds.items() if kinds and path.name != GROUND_FOLDER}


def other_folders(folder: Path, parent: Path) -> list[str]:
    """Return the names of folders that hold clouds as the one that is read, if it has not one of the usual names."""
    return [] if parent in _usual_places(folder) else [path.name for path in _below(folder) if path != parent]


def _kinds(folder: Path) -> dict[str, list[Path]]:
    """Return the clouds in a folder, of each suffix that has two or more, or of each pattern of names.

    Texts count if there are no other clouds, if several have names of one pattern, and if the first one is a cloud.
    """
    files = [path for path in visible(folder) if stem_of(path).lower() not in _OTHER_STEMS]
    kinds = _alike([path for path in files if suffix_of(path) in SUFFIXES])
    texts = [path for path in files if suffix_of(path) in cloud_text.SUFFIXES]
    counts = Counter(map(_pattern, texts))
    texts = [] if kinds else [path for path in texts if counts[_pattern(path)] > 1]
    return kinds or {kind: same for kind, same in _alike(texts).items() if _is_text_cloud(min(same))}


def _alike(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the files of each suffix that has two or more, or of each pattern of names.

    They have several patterns if mostly the same numbers are in names that differ otherwise: front_001.pcd,
    rear_001.pcd.
    """
    suffixes: dict[str, list[Path]] = {}
    for path in files:
        suffixes.setdefault(path.name[len(stem_of(path)) :].lower(), []).append(path)
    kinds: dict[str, list[Path]] = {}
    for suffix, same in suffixes.items():
        patterns: dict[str, list[Path]] = {}
        for path in same:
            patterns.setdefault(_pattern(path), []).append(path)
        numbers = [{"-".join(re.findall(r"\d+", stem_of(path))) for path in each} for each in patterns.values()]
        fewest = min(map(len, numbers))
        are_sensors = fewest > 1 < len(patterns) and 2 * len(set.intersection(*numbers)) > fewest
        kinds.update(patterns if are_sensors else {suffix: same})
    return {kind: same for kind, same in kinds.items() if len(same) > 1}


def _pattern(path: Path) -> str:
    stem = stem_of(path)
    return re.sub(r"\d+", "*", stem) + path.name[len(stem) :].lower()


def _is_text_cloud(path: Path) -> bool:
    """Test whether a text holds many points, and no poses. Lines of 3 or 6 numbers may be either: they are points."""
    try:
        with file_errors(path):
            start = read_start(path, _TESTED)
            columns = cloud_text.text_columns(start[: start.rfind(b"\n") + 1])
    except CFlowError:
        return False
    numbers = np.column_stack(list(columns.values()))
    are_poses = _start_of(path, parse_poses) is not None and numbers.shape[1] not in (3, 6)
    if numbers.shape[1] == 7:
        are_poses &= bool(np.abs(np.linalg.norm(numbers[:, 3:], axis=1) - 1).max() < 0.1)
    return len(numbers) >= _FEWEST_POINTS and not are_poses


def find_clouds(folder: Path, suffix: str | None) -> list[Path]:
    """Return the clouds of a log in order, by the times in their names, else by their numbers.

    Fewer than two clouds, and several kinds of clouds without a `suffix`, are a `CFlowError`.
    """
    parent, kinds = _clouds(folder)
    if suffix is not None:
        kinds = {kind: files for kind, files in kinds.items() if kind in (suffix, "." + suffix.lower().lstrip("."))}
    if not kinds:
        raise CFlowError(
            f"{folder} and its subfolders {', '.join(POINT_FOLDERS)} have fewer than two point clouds "
            f"({suffix or ', '.join((*SUFFIXES, *cloud_text.SUFFIXES))}); scene flow needs two or more"
        )
    if len(kinds) > 1:
        raise CFlowError(f"{parent} has several kinds of clouds, {', '.join(sorted(kinds))}: choose one by suffix=...")
    files = sorted(next(iter(kinds.values())), key=lambda path: natural_key(stem_of(path)))
    stamps = times_of_names([stem_of(path) for path in files])
    return files if stamps is None else [files[k] for k in np.argsort(stamps, kind="stable")]


def resolve(folder: Path, setting: PathLike | None, names: Sequence[str], what: str, *elsewhere: Path) -> Path | None:
    """Return the file or folder that a setting names, or that "auto" finds; None = none."""
    if setting is None:
        return None
    if setting == "auto":
        found = [parent for parent in (*(folder / name for name in names), *elsewhere) if parent.exists()]
        return only_one(found, folder, what)
    path = as_path(setting)
    path = path if is_remote(path) or path.is_absolute() or path.exists() else folder / path
    if not path.exists():
        raise CFlowError(f"{what}={str(setting)!r} does not exist, neither here nor in {folder}")
    return path


def only_one(found: Sequence[Path], folder: Path, what: str) -> Path | None:
    """Return the only file that was found; None = none. Several are a `CFlowError`."""
    if len(found) > 1:
        several = ", ".join(path.name for path in found)
        raise CFlowError(f"{folder} has several files for {what}: {several}; choose one with {what}=...")
    return found[0] if found else None


def find_tables(folder: Path, clouds: Container[Path] = ()) -> tuple[list[Path], list[Path]]:
    """Find what holds poses in a folder, files or folders with a file per pose, and files of times, by their contents.

    Files of times also say so in their name, because a column of numbers may be anything. We read the start of each,
    without the `clouds`.
    """
    tables = sorted(path for path in visible(folder) if suffix_of(path) in _TABLES and path not in clouds)
    folders = sorted(path for path in visible(folder) if path.is_dir())
    starts = {path: _start_of(path, parse_poses) for path in tables}
    poses = [path for path, start in starts.items() if start is not None and len(start.poses) > 1]
    times = [path for path in tables if re.search("time|stamp", path.stem.lower())]
    times = [path for path in times if _start_of(path, parse_times) is not None]
    for path in folders:
        files = files_of_poses(path)
        poses += [path] if len(files) > 1 and _has_one_pose(files[0]) else []
    return poses, times


def find_poses_near(folder: Path, times_ns: Sequence[int], tell: Callable[[str], None]) -> Trajectory | None:
    """Find the file of text that has poses at the unix times of most sweeps: below a folder, and two levels above it.

    Of folders next to the log or below it, we look only into those that hold nothing but tables, as others are logs. We
    read the start of at most 50 files in each of at most 50 folders. None = no file has them, or several do. `tell` is
    called with what the user should know of it.
    """
    if is_remote(folder) or times_ns[0] < _FIRST_UNIX:
        return None
    top = folder.resolve()
    levels = [top, *islice(top.parents, 2)]
    children = {child: sorted(visible(child))[:_MOST] for level in levels for child in sorted(visible(level))[:_MOST]}
    plain = [files for files in children.values() if all(suffix_of(file) in _TABLES for file in files)]
    files = [file for files in (*map(visible, levels), *plain) for file in files if suffix_of(file) in _NEAR_TABLES]
    starts = {file: _start_of(file, parse_poses) for file in files}
    timed = [file for file, start in starts.items() if start is not None and start.times_ns is not None]
    found = [each for each in read_all(timed, read_poses, tell).values() if each.covers(times_ns)]
    names = " and ".join(each.source for each in found)
    if len(found) > 1:
        tell(f"there are poses at the times of its sweeps in {names}: choose one with data.poses=FILE")
    elif found:
        tell(f"its poses are those of {names}, which has them at the times of its sweeps")
    return found[0] if len(found) == 1 else None


def read_all(files: Sequence[Path], read: Callable[[Path], Any], tell: Callable[[str], None]) -> dict[Path, Any]:
    """Read files that nobody named. We leave out those that fail, and tell it."""
    found = {}
    for file in files:
        try:
            found[file] = read(file)
        except CFlowError as error:
            tell(f"we do not use {file.name}: {error}")
    return found


def _has_one_pose(path: Path) -> bool:
    try:
        with file_errors(path):
            return len(read_start(path, _TESTED)) < _TESTED and len(read_poses(path).poses) == 1
    except CFlowError:
        return False


def _start_of(path: Path, parse: Callable[[bytes, Path], Any]) -> Any:
    """Parse the first lines of a file; None = this is not possible."""
    try:
        with file_errors(path):
            is_whole = suffix_of(path) in STRUCTURED
            start = read_start(path, _LARGEST if is_whole else _TESTED)
            if not is_whole and len(start) == _TESTED:  # whole lines, and whole matrices of four or five
                lines = start.splitlines(keepends=True)[:-1]
                start = b"".join(lines[: len(lines) // 20 * 20] or lines[: len(lines) // 4 * 4])
            return parse(start, path)
    except CFlowError:
        return None
