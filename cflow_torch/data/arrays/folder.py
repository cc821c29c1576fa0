"""What a folder of point clouds holds: the clouds of logs, and the files of poses, times and masks next to them."""

from __future__ import annotations

import io
import os
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Callable, Container, Dict, Iterator, List, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrays import cloud_text
from cflow_torch.data.arrays.cloud_file import SUFFIXES, TABLES, may_be_cloud, names_in_table
from cflow_torch.data.arrays.poses_text import STRUCTURED, files_of_poses, parse_poses, parse_times, read_poses
from cflow_torch.data.arrays.stamps import times_of_names
from cflow_torch.data.column_names import are_of_poses
from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.finding import CHOOSE, UNREAD
from cflow_torch.data.folders import find_folders, natural_key, record_in, visible
from cflow_torch.data.paths import PathLike, as_path, is_remote, read_start, stem_of, suffix_of
from cflow_torch.data.trajectory import Trajectory
from cflow_torch.types import CFlowError

POINT_FOLDERS = ("points", "lidar", "velodyne", "clouds", "pcd")  # where the clouds may lie below the log's folder
POSE_FILES = (
    *("poses.txt", "poses.npy", "poses.npz", "poses.csv", "trajectory.txt", "trajectory.csv", "trajectory.npz"),
    "odometry.csv",
)
"""Names of files of poses that we prefer to others."""
GROUND_FOLDER = "ground"
_LABELS = {"labels", "label", "annotations", "boxes", "bboxes", "predictions"}  # names of folders without clouds
SEARCH_DEPTH = 4
_OTHER_STEMS = {"poses", "trajectory", "times", "timestamps", "calib"}
# Words in names of files of poses near a log, or whole names of their folders.
_WORDS = {"poses", "pose", "trajectory", "trajectories", "odometry", "odom", "gt", "groundtruth"}
_LIKE_POSES = {*_WORDS, "ego", "novatel", "oxts", "ins"}  # words in names of what may hold poses in another form
# Suffixes of files that we test for poses and times.
_TABLES = (".txt", ".csv", ".tum", ".log", ".g2o", ".json", ".jsonl", ".yaml", ".yml", ".npy")
_NEAR_TABLES = (".txt", ".csv", ".tum")  # suffixes of files that we test in other folders
_FIRST_UNIX, _MOST = 10**17, 50  # nanoseconds in 1973; files or folders
_LONGEST = 150  # characters of a reason
_MOST_EXACT = 0.5  # a file with poses at exactly the times of more than this share of the sweeps is preferred
_TESTED = 8192  # bytes of a file that tell what it holds
_FEWEST_POINTS = 20  # lines at the start of a text that may be a cloud
_MOST_MAPS = 10  # clouds in a log's folder that may be maps, if a folder below has more
_LARGEST = 1 << 24  # bytes; structured files must be whole to be read, and poses take less
# Numbers in names of files that count: not one or two digits behind letters, as in lidar0_000001.
_COUNTERS = re.compile(r"(?<![A-Za-z\d])\d+|(?<=\d[A-Za-z])\d+|\d{3,}|\d+$")
_TOKEN = re.compile(r"[0-9a-f]{16,}|[0-9a-f]{8}(-[0-9a-f]{4,12}){4}", re.IGNORECASE)  # hashes and random identifiers

_Kinds = Dict[str, List[Path]]  # clouds of each suffix, or of each pattern of names


def find_array_logs(root: PathLike) -> list[Path]:
    """Find the folders of all logs, at most four levels below a folder, sorted.

    A log has two or more clouds of one suffix, see `_places`.
    """
    what = "a folder with one point cloud per file, or a folder of such"
    return find_folders(as_path(root), is_array_log, SEARCH_DEPTH, what, is_passed=_holds_no_labels)


def is_array_log(folder: Path) -> bool:
    return bool(_places(folder))


def _holds_no_labels(folder: Path) -> bool:
    return folder.name not in (GROUND_FOLDER, *_LABELS)


def _places(folder: Path) -> list[tuple[Path, _Kinds]]:
    """Return the folders that may hold the clouds of a log, the one that we read first; [] = this is not a log.

    It is the folder itself. But if a folder below has more clouds, the few of the folder itself may be maps, and come
    last. Then it is one of `POINT_FOLDERS` or, next to poses or times, that with the largest clouds: others are labels.
    """
    own = _kinds(folder)
    fewest = max(map(len, own.values()), default=0)
    if fewest > _MOST_MAPS:
        return [(folder, own)]
    passed_over = [(folder, own)] if own else []
    for parent in (folder / name for name in POINT_FOLDERS):
        kinds = _larger(parent, fewest)
        if kinds:
            return [(parent, kinds), *passed_over]
    below = {path: _larger(path, fewest) for path in sorted(filter(_holds_no_labels, visible(folder)))}
    below = {path: kinds for path, kinds in below.items() if kinds}
    if own and not below:
        return passed_over
    is_log = any(path.name in (*POSE_FILES, "times.txt") for path in _tables(folder))
    if is_log or (len(below) == 1 and (own or find_pose_files(folder) or find_times_files(folder))):
        clouds = {path: sorted(next(iter(kinds.values()))) for path, kinds in below.items()}
        size = {path: files[len(files) // 2].stat().st_size for path, files in clouds.items()}
        return [*sorted(below.items(), key=lambda place: -size[place[0]]), *passed_over]
    return passed_over


def _larger(folder: Path, fewest: int) -> _Kinds:
    """Return the kinds of clouds in a folder that have more files, and are no results of ours."""
    kinds = {kind: files for kind, files in _kinds(folder).items() if len(files) > fewest}
    return {} if kinds and record_in(visible(folder)) else kinds


def other_folders(folder: Path) -> list[str]:
    """Return the names of folders that hold clouds as the one that is read, if it has not one of the usual names."""
    return [path.name for path, _ in _places(folder)[1:]]


def _kinds(folder: Path) -> _Kinds:
    """Return the clouds in a folder, of each suffix that has two or more, or of each pattern of names.

    Texts count if there are no other clouds, if several have names of one pattern, and if the first one is a cloud.
    """
    files = [path for path in visible(folder) if stem_of(path).lower() not in _OTHER_STEMS]
    texts = _grouped([path for path in files if suffix_of(path) in cloud_text.SUFFIXES], _pattern)
    for candidates in (
        [path for path in files if suffix_of(path) in SUFFIXES],
        [path for same in texts.values() for path in same if len(same) > 1],
    ):
        kinds = {kind: same for kind, same in _alike(candidates).items() if _hold_points(same)}
        if kinds:
            return kinds
    return {}


def _alike(files: Sequence[Path]) -> _Kinds:
    """Return the files of each suffix that has two or more, or of each pattern of names.

    They have several patterns if mostly the same numbers are in names that differ otherwise: front_001.pcd,
    rear_001.pcd. Names that differ only by one or two digits behind letters, lidar0_1.pcd and lidar1_1.pcd, need
    numbers of one range.
    """
    kinds: _Kinds = {}
    for suffix, same in _grouped(files, suffix_of).items():
        patterns = _grouped(same, _pattern)
        numbers = [{tuple(_COUNTERS.findall(stem_of(path))) for path in each} for each in patterns.values()]
        fewest = min(map(len, numbers))
        are_same = 2 * len(set.intersection(*numbers)) > fewest
        if len({re.sub(r"\d", "", pattern) for pattern in patterns}) == 1:
            last = [[int(each[-1]) for each in found if each] or [0] for found in numbers]
            are_same = max(map(min, last)) < min(map(max, last))
        kinds.update(patterns if fewest > 1 < len(patterns) and are_same else {suffix: same})
    return {kind: same for kind, same in kinds.items() if len(same) > 1}


def _grouped(files: Sequence[Path], key: Callable[[Path], str]) -> _Kinds:
    groups: _Kinds = {}
    for path in files:
        groups.setdefault(key(path), []).append(path)
    return groups


def _pattern(path: Path) -> str:
    return _COUNTERS.sub("*", stem_of(path)) + suffix_of(path)


def _hold_points(files: Sequence[Path]) -> bool:
    """Test whether files may be clouds, by the first one that tells it."""
    answers = map(_holds_points, islice(sorted(files), _MOST))
    return next((answer for answer in answers if answer is not None), True)


def _holds_points(path: Path) -> bool | None:
    """Test whether a file may be a cloud, by the shape of an array, the names of a table, or the lines of a text.

    Others are labels, masks, images or poses. None = its array is empty, so it may be either.
    """
    if suffix_of(path) in cloud_text.SUFFIXES:
        return _is_text_cloud(path)
    if path.suffix.lower() in TABLES:
        return not are_of_poses(names_in_table(path))
    if path.suffix.lower() != ".npy":
        return True
    with suppress(CFlowError), file_errors(path):
        file = io.BytesIO(read_start(path, _TESTED))
        np.lib.format.read_magic(file)
        shape, _, kind = np.lib.format.read_array_header_1_0(file)
        return None if 0 in shape else kind.kind not in "biuf" or may_be_cloud(shape)
    return True


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
    parent, kinds = next(iter(_places(folder)), (folder, {}))
    if suffix is not None:
        names = (suffix, suffix_of(Path(f"cloud.{suffix.lstrip('.')}")))
        kinds = {kind: files for kind, files in kinds.items() if kind in names}
    if not kinds:
        raise CFlowError(
            f"{folder} and its subfolders {', '.join(POINT_FOLDERS)} have fewer than two point clouds "
            f"({suffix or ', '.join((*SUFFIXES, *cloud_text.SUFFIXES))}); scene flow needs two or more"
        )
    if len(kinds) > 1:
        choose = f"choose one, such as data.suffix='{min(kinds)}'"
        raise CFlowError(f"{parent} has several kinds of clouds, {', '.join(sorted(kinds))}: {choose}")
    files = sorted(next(iter(kinds.values())), key=lambda path: natural_key(stem_of(path)))
    twice = next((one for one, other in zip(files, files[1:]) if stem_of(one) == stem_of(other)), None)
    if twice is not None:
        raise CFlowError(f"{parent} has several files of one name, such as {twice.name}: leave one of each")
    stamps = times_of_names([stem_of(path) for path in files])
    are_tokens = all(_TOKEN.fullmatch(stem_of(path)) for path in files)
    if are_tokens and 2 * sum(stem_of(path).isdecimal() for path in files) < len(files):
        raise CFlowError(
            f"the names of the clouds in {parent}, such as {files[0].name}, have no order: number them by their times "
            "(in nuPlan, these are in its .db)"
        )
    return files if stamps is None else [files[k] for k in np.argsort(stamps, kind="stable")]


def resolve(folder: Path, setting: PathLike | None, names: Sequence[str], what: str) -> Path | None:
    """Return the file or folder that a setting names, or that "auto" finds; None = none."""
    if setting is None:
        return None
    if setting == "auto":
        found = [parent for parent in (folder / name for name in names) if parent.exists()]
        return only_one(found, folder, what)
    path = as_path(setting)
    if is_remote(path) or path.is_absolute() or path.exists():
        places = [path]
    else:  # the user gave the folder or one above
        places = [parent / path for parent in (folder, *islice(folder.resolve().parents, SEARCH_DEPTH))]
    existing = [place for place in places if place.exists()]
    if not existing:
        raise CFlowError(f"{what}={str(setting)!r} does not exist, neither here nor in {folder} or above it")
    return existing[0]


def only_one(found: Sequence[Path], folder: Path, what: str) -> Path | None:
    """Return the only file that was found; None = none. Several are a `CFlowError`."""
    if len(found) > 1:
        several = ", ".join(path.name for path in found)
        raise CFlowError(f"{folder} has several files for {what}: {several}; choose one with data.{what}=FILE")
    return found[0] if found else None


def _tables(folder: Path, clouds: Container[Path] = ()) -> list[Path]:
    """Return the files in a folder that may hold poses or times, without the `clouds`."""
    files = [path for path in sorted(visible(folder)) if path not in clouds]
    return [path for path in files if suffix_of(path) in _TABLES or path.name in POSE_FILES]


def find_times_files(folder: Path, clouds: Container[Path] = ()) -> list[Path]:
    """Find the files of times in a folder, by names that say so and by their start: a column may be anything."""
    named = [path for path in _tables(folder, clouds) if re.search("time|stamp", path.stem.lower())]
    return [path for path in named if _start_of(path, parse_times) is not None]


def find_pose_files(folder: Path, clouds: Container[Path] = ()) -> list[Path]:
    """Find what holds poses in a folder by the start: files, and folders with a file per pose.

    Files that are called as poses (`POSE_FILES`) need no test.
    """
    poses = [path for path in _tables(folder, clouds) if path.name in POSE_FILES or _num_poses(path) > 1]
    for path in sorted(path for path in visible(folder) if path.is_dir() and _holds_no_labels(path)):
        files = files_of_poses(path)
        poses += [path] if len(files) > 1 and _num_poses(files[0], _TESTED) == 1 else []
    return poses


def find_poses(
    folder: Path,
    clouds: Sequence[Path],
    times_ns: Sequence[int] | None,
    fits: Callable[[Trajectory], bool],
    tell: Callable[[str], None],
) -> Trajectory | None:
    """Find the poses of a log in its folder, else near it.

    Args:
        folder: its folder.
        clouds: files that hold no poses, whose folder may hold some, too.
        times_ns: of its sweeps; None = unknown.
        fits: tests whether poses belong to the sweeps.
        tell: is called with what the user should know.

    Convention: a file with one of `POSE_FILES`, else KITTI's `../../poses/NAME.txt`, is used without a test. Of several
        other files that fit, those with poses at exactly the times of the sweeps count, near a log first those with its
        name. If several are left in the folder, that is a `CFlowError`; near it, none is used. A text in the folder of
        a log is returned if nothing fits, because it should.
    """
    folders = list(dict.fromkeys([folder, *(path.parent for path in clouds[:1])]))
    top = folder.resolve()
    kitti = top.parent.parent / "poses" / f"{top.name}.txt"
    called = [each / name for each in folders for name in POSE_FILES if (each / name).exists()]
    named = only_one(called, folder, "poses")
    if named is not None or kitti.exists():
        return read_poses(named or kitti)
    files = [path for each in folders for path in find_pose_files(each, clouds)]
    read = read_all(files, read_poses, tell)
    found = {path: each for path, each in read.items() if fits(each)}
    # Files that were read here are not read again there, so what is wrong with them is told once.
    known = {*clouds, *(path.resolve() for path in files)}
    near = None if found else find_poses_near(folder, top.name, times_ns, fits, tell, known)
    if near is not None:
        return near
    found = found or {path: each for path, each in read.items() if suffix_of(path) in _NEAR_TABLES}
    file = only_one(_preferred(found, (), times_ns), folder, "poses")
    if file is None:
        return None
    tell(f"its poses are those of {file.name}")
    return found[file]


def find_poses_near(
    folder: Path,
    name: str,
    times_ns: Sequence[int] | None,
    fits: Callable[[Trajectory], bool],
    tell: Callable[[str], None],
    clouds: Container[Path] = (),
) -> Trajectory | None:
    """Find the file of text near a folder that has the poses of a log: below it, and two levels above it.

    `name` is that of the log. Files without unix times, or for sweeps without them, must have the name of the log or
    one of `_WORDS`, or be in a folder that is called so. Files with the name of a folder next to the log are of that
    log. See `find_poses`.
    """
    if is_remote(folder):
        return None
    top = folder.resolve()
    others = [path.name for path in visible(top.parent) if path.name not in (top.name, name, *_WORDS) and path.is_dir()]
    is_unix = times_ns is not None and times_ns[0] >= _FIRST_UNIX
    own, known = [], []
    for file, words in _words_near(top).items():
        is_own = _has_one(file, [name])
        is_called = is_own or not (_WORDS.isdisjoint(words) or _has_one(file, others))
        if file in clouds or not (is_unix or is_called):
            continue
        start = _start_of(file, parse_poses)
        if start is not None and (is_called or start.times_ns is not None):
            known.append(file)
            own += [file] if is_own else []
    found = {file: each for file, each in read_all(known, read_poses, tell).items() if fits(each)}
    files = _preferred(found, own, times_ns)
    if len(files) == 1:
        tell("" if files[0].stem == name else f"its poses are those of {found[files[0]].source}")
        return found[files[0]]
    tell(_choice([found[file].source for file in files]) if files else "")
    return None


def _choice(files: Sequence[Any]) -> str:
    return f"there are poses of its sweeps: {CHOOSE}{' or '.join(map(str, files))}"


def tell_unused_poses(
    folder: Path, clouds: Sequence[Path], fits: Callable[[Trajectory], bool], tell: Callable[[str], None]
) -> None:
    """Tell which files may hold the poses of a log without poses, by their names or contents, and why none is used."""
    if is_remote(folder):
        return
    fitting, unread = [], []
    for path in islice(_like_poses(folder, clouds), _MOST):
        name = os.path.relpath(path, folder.resolve())
        try:
            if suffix_of(path) == ".pkl":
                raise CFlowError("pickles are not read")
            poses = read_poses(path)
        except CFlowError as error:
            unread.append(f"{name} ({shortened(str(error).replace(str(path), 'it'), _LONGEST)})")
            continue
        is_calibration = len(poses.poses) > 1 and np.ptp(poses.poses, axis=0).max() == 0
        if fits(poses) and not is_calibration:
            fitting.append(name)
        elif not is_calibration:
            unread.append(f"{name} (its number of poses is {len(poses.poses)}, of sweeps {len(clouds)})")
    if fitting:
        tell(_choice(fitting))
    elif unread:
        tell(f"{UNREAD} {' or '.join(unread[:2])}")


def _like_poses(folder: Path, clouds: Sequence[Path]) -> Iterator[Path]:
    """Yield files and folders of a file per sweep that are called like poses, or are structured and contain such words.

    They lie in the folder of a log, two levels above or below it, or next to it in a folder that is called so.
    """
    stems = {stem_of(path) for path in clouds}
    top = folder.resolve()
    pending = [*zip((top, *top.parents), (0, 0, 2))]  # folders, and their depth
    seen = {path.resolve() for path in clouds}
    for place, depth in pending:
        inside = [path for path in sorted(visible(place)) if path.resolve() not in seen]
        files = [path for path in inside if suffix_of(path) in (*_TABLES, *STRUCTURED, ".pkl")]
        seen.update(path.resolve() for path in inside)
        of_sweeps = [path for path in files if stem_of(path) in stems]
        if 2 * len(of_sweeps) > len(stems):  # a file per sweep
            files = [path for path in files if path not in of_sweeps]
            if _is_like_poses(of_sweeps[0], f"{place.parent.name} {place.name}"):
                yield place if files_of_poses(place) else of_sweeps[0]
        yield from (path for path in files[:_MOST] if _is_like_poses(path))
        below = [path for path in inside if path.is_dir() and _holds_no_labels(path)][:_MOST]
        if top not in (place, *place.parents):  # folders next to the log may be other logs
            below = [path for path in below if _is_called_like_poses(f"{place.name} {path.name}")]
        pending += [(path, depth + 1) for path in below if depth < 2]


def _is_like_poses(file: Path, folder: str = "") -> bool:
    start = b""
    with suppress(CFlowError), file_errors(file):
        start = read_start(file, _TESTED).lower() if suffix_of(file) in (*STRUCTURED, ".pkl") else b""
    has_words = b"pose" in start or (b"rotation" in start and b"translation" in start)
    return has_words or _is_called_like_poses(f"{folder} {file.stem}")


def _is_called_like_poses(name: str) -> bool:
    return not _LIKE_POSES.isdisjoint(re.split("[^a-z]+", name.lower()))


def _has_one(file: Path, names: Sequence[str]) -> bool:
    """Test whether the name of a file contains one of some names, and not as a part of a longer word."""
    either = "|".join(map(re.escape, names))
    return bool(names) and re.search(rf"(?<![A-Za-z0-9])({either})(?![A-Za-z0-9])", file.stem) is not None


def _words_near(top: Path) -> dict[Path, list[str]]:
    """Return the texts near a folder, and the words of their names, or that of their folder.

    Of folders next to the log or below it, we look only into those that hold nothing but tables, as others are logs. We
    look at 50 files in each of 50 folders.
    """
    levels = [top, *islice(top.parents, 2)]
    words = {file: re.split("[^a-z]+", file.stem.lower()) for level in levels for file in visible(level)}
    for folder in (child for level in levels for child in sorted(visible(level))[:_MOST]):
        files = sorted(visible(folder))[:_MOST]
        if all(suffix_of(file) in _TABLES for file in files):
            words.update(dict.fromkeys(files, [re.sub("[^a-z]", "", folder.name.lower())]))
    return {file: each for file, each in words.items() if suffix_of(file) in _NEAR_TABLES}


def _preferred(found: Mapping[Path, Trajectory], named: Sequence[Path], times_ns: Sequence[int] | None) -> list[Path]:
    """Return the files of poses that are left by the rules of `find_poses`."""
    wanted: Any = [] if times_ns is None else times_ns
    timed = {path: each.times_ns for path, each in found.items() if each.times_ns is not None}
    exact = [path for path, known in timed.items() if np.isin(wanted, known).sum() > _MOST_EXACT * len(wanted)]
    files = list(found)
    for better in (named, exact):
        files = [path for path in files if path in better] or files
    return files


def read_all(files: Sequence[Path], read: Callable[[Path], Any], tell: Callable[[str], None]) -> dict[Path, Any]:
    """Read files that nobody named. We leave out those that fail, and tell it."""
    found = {}
    for file in files:
        try:
            found[file] = read(file)
        except CFlowError as error:
            tell(f"we do not use {file.name}: {error}")
    return found


def _num_poses(path: Path, largest: int = _LARGEST) -> int:
    """Return the number of poses at the start of a file, 0 = it holds none, or is structured and larger (bytes)."""
    start = _start_of(path, parse_poses, largest)
    return 0 if start is None else len(start.poses)


def _start_of(path: Path, parse: Callable[[bytes, Path], Any], largest: int = _LARGEST) -> Any:
    """Parse the first lines of a text, or a structured file of up to so many bytes; None = this is not possible."""
    try:
        with file_errors(path):
            is_whole = suffix_of(path) in STRUCTURED
            start = read_start(path, largest if is_whole else _TESTED)
            if not is_whole and len(start) == _TESTED:  # whole lines, and whole matrices of four or five
                lines = start.splitlines(keepends=True)[:-1]
                start = b"".join(lines[: len(lines) // 20 * 20] or lines[: len(lines) // 4 * 4])
            return parse(start, path)
    except CFlowError:
        return None
