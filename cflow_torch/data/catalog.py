"""Recognise a data set, find its logs and open them, also with your own reader."""

from __future__ import annotations

import inspect
import logging
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from glob import glob
from importlib import import_module
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple, Sequence, overload

from cflow_torch.data.deskewing import DeskewedLog, check_deskew
from cflow_torch.data.file_errors import shortened
from cflow_torch.data.finding import FOUND, Finding
from cflow_torch.data.folders import find_folders, levels
from cflow_torch.data.log import CachedLog, Log, LogWrapper, add_gaps_in_time, typical_sweeps
from cflow_torch.data.log_check import check_log
from cflow_torch.data.own_vehicle import OwnVehicleLog
from cflow_torch.data.paths import as_path, exist, is_path_like, remote_errors, safe_name, suffix_of
from cflow_torch.data.read_as import read_as as read_log_as
from cflow_torch.diagnosis.inspection import mask_problem
from cflow_torch.diagnosis.point_frame import frame_problem
from cflow_torch.errors import warn
from cflow_torch.ground.segmentation import GROUND_METHODS, has_ground
from cflow_torch.ground.segmentation import find_ground as ground_of
from cflow_torch.setting import AUTO
from cflow_torch.types import CFlowError, Sweep, Window
from cflow_torch.windows.deskewing import SCANS

_OF_ALL = ("find_ground", "odometry", "read_as", "own_vehicle", "deskew", "check")  # settings of every data set
_KEPT = 12  # sweeps that several checks read while a log is opened
_log = logging.getLogger(__name__)


class DataSet(NamedTuple):
    """One format."""

    log: str  # name of the reader's class, which opens a source as a `Log`
    what: str  # what one log is, for messages
    marks: tuple[str, ...] = ()  # patterns of the ends of paths by which we recognise the format
    # Function of the reader's module that finds the sources below a root. "" = the sources are the folders that hold
    # the first mark, at most `depth` levels below the root. Without marks, the root is the only source.
    find: str = ""
    depth: int = 0


_NUSCENES = ("v1.*/scene.json",)
# The key is also the module of the reader, which we import when it is needed.
DATA_SETS: dict[str, DataSet] = {
    # <root>/<data set>/sensor/<split>/<log> is the deepest layout in use.
    "av2": DataSet("AV2Log", "Argoverse 2 log", ("sensors/lidar",), depth=4),
    "hdf5": DataSet("HDF5Log", "scene", ("*.h5",), "find_hdf5_scenes"),
    "nuscenes": DataSet("NuScenesLog", "nuScenes scene", _NUSCENES, "find_nuscenes_scenes"),
    "truckscenes": DataSet("TruckScenesLog", "TruckScenes scene", _NUSCENES, "find_truckscenes_scenes"),
    "waymo": DataSet("WaymoLog", "Waymo segment", ("lidar/*.parquet",), "find_waymo_segments"),
    "pandaset": DataSet("PandaSetLog", "PandaSet sequence", ("lidar/poses.json",), depth=2),
    "aevascenes": DataSet("AevaScenesLog", "AevaScenes sequence", ("sequence.json",), depth=3),
    "kitti": DataSet(
        "KITTILog", "drive of KITTI", ("velodyne_points", "velodyne", "velodyne_points/data"), "find_kitti_drives"
    ),
    "bags": DataSet("BagLog", "bag", ("*.bag", "*.mcap", "*.db3", "*.bag.active"), "find_bags"),
    "kiss_icp": DataSet("KissICPLog", "data for a loader of KISS-ICP"),
    "arrays": DataSet("ArraysLog", "folder of point clouds", (), "find_array_logs"),  # tried if no mark is found
}
_NAMED_BY_PATH = ("arrays", "bags", "kitti", "pandaset")  # logs that have the names of their files or folders
_OF_LAYOUTS = ("dataset", "sequences", "velodyne")  # folders whose names tell no log from another
_DEEPEST = 4  # levels of folders below the root whose contents we search for a mark


class UserSource(NamedTuple):
    """One of the logs that your own reader returns."""

    name: str  # "package.module.name[number]"
    number: int  # index among these logs


class RenamedSource(NamedTuple):
    """A source of a log whose name others have, too."""

    source: Any
    name: str

    def __str__(self) -> str:
        return str(self.source)


def recognise(root: Any) -> str:
    """Return the name of the data set whose logs lie at a path. We open files only if their names do not decide.

    Args:
        root: file or folder. If formats fit at several levels of folders, the level closest to the root decides. If
            there is a folder of point clouds, too, the first log of a format must be readable.

    Raises:
        CFlowError: the path does not exist, or no format fits, or several do.

    Cost: next to folders of point clouds, the first log of each format that fits is opened.
    """
    from cflow_torch.data.arrays.folder import is_array_log

    top = as_path(root)
    with remote_errors(top):
        if not top.exists():
            raise CFlowError(f"{root}: there is no such file or folder")
        found, marked = [], []
        for paths in _paths_below(top):
            marks = [
                (name, path) for name, one in DATA_SETS.items() for path in paths if any(map(path.match, one.marks))
            ]
            found, marked = list(dict.fromkeys(name for name, _ in marks)), [path for _, path in marks]
            if found:
                break
    # nuScenes and TruckScenes have the same file names.
    found = [name for name in found if not _error_of(name, root, is_opened=False)]
    # Each path with a mark, and the folders between it and the top, may be a folder of clouds that is called so.
    around = dict.fromkeys(folder for path in marked for folder in (path, *path.parents))
    if found and any(is_array_log(folder) for folder in around if folder == top or top in folder.parents):
        errors = {name: _error_of(name, root) for name in found}
        opened = [name for name in found if not errors[name]]
        if not opened and not _error_of("arrays", root):
            warn(f"{root}: we read its folders of clouds, because no log of another format opens: {errors[found[0]]}")
            opened = ["arrays"]
        found = opened or found
    if not found and not _error_of("arrays", root, is_opened=False):
        found = ["arrays"]
    if len(found) != 1:
        choose = f"choose one with data={'|'.join(DATA_SETS)}"
        fits = f"several formats fit, {' and '.join(found)}; {choose}"
        raise CFlowError(f"{root}: {fits if found else _why_nothing_fits(top) or f'no format fits; {choose}'}")
    return found[0]


def _paths_below(top: Path) -> Iterator[list[Path]]:
    """Yield a file or folder, then what is in it, and so on, level by level."""
    yield [top]
    for level in levels(top, _DEEPEST):
        yield [path for _, inside in level for path in inside]


def matching_paths(path: Any) -> list[Any]:
    """Return the paths that are given, one or several, with patterns replaced by what they match."""
    paths = list(path) if isinstance(path, (list, tuple)) else [path]
    found = [
        sorted(glob(str(each))) if set(str(each)) & set("*?[") and not exist(as_path(each)) else [each]
        for each in paths
    ]
    for each, matches in zip(paths, found):
        if not matches:
            raise CFlowError(f"{each}: no file or folder matches this pattern")
    return [each for matches in found for each in matches]


def the_format(paths: Sequence[Any]) -> str:
    """Return the format of paths. If they have several, that is a `CFlowError`."""
    names = sorted({recognise(path) for path in paths})
    if len(names) != 1:
        raise CFlowError(f"the paths have several formats, {' and '.join(names)}: open those of each format alone")
    return names[0]


def find_all_sources(name: str, paths: Sequence[Any]) -> list[Any]:
    """Return the sources of logs under several paths, which may overlap, see `find_sources`."""
    found: dict[str, Any] = {}
    for path in paths:
        found.update({str(source): source for source in find_sources(name, path)})
    return _with_distinct_names(list(found.values())) if name in _NAMED_BY_PATH else list(found.values())


def _with_distinct_names(sources: Sequence[Any]) -> list[Any]:
    """Put names of parent folders in front of equal names of logs, as results of both would be in one folder."""
    places = [getattr(source, "folder", source) for source in sources]
    names = [place.name if place.is_dir() else place.stem for place in places]
    above = [[part for part in place.absolute().parts[-2:0:-1] if part not in _OF_LAYOUTS] for place in places]
    distinct = list(names)
    for depth in range(1, 1 + max(map(len, above), default=0)):
        counts = Counter(distinct)
        for k, parents in enumerate(above):
            if counts[distinct[k]] > 1:
                distinct[k] = "-".join([*parents[:depth][::-1], names[k]])
    renamed = zip(sources, names, distinct)
    return [source if name == other else RenamedSource(source, other) for source, name, other in renamed]


_CONVERSIONS = {
    **dict.fromkeys((".las", ".laz"), "convert them with pdal translate IN.las OUT.ply"),
    **dict.fromkeys(
        (".xyz", ".txt", ".asc", ".pts", ".csv"), "clouds have lines of three numbers or more, x, y, z first"
    ),
    **dict.fromkeys(
        (".pcap", ".pcapng", ".osf"), "convert the packets with the tool of the sensor's maker to .pcd or a bag"
    ),
    **dict.fromkeys((".e57", ".drc", ".rcp"), "convert them to .ply"),
    ".zstd": "unpack them (zstd -d); they are bags of ros2 bag record --compression-mode file",
    **dict.fromkeys((".gz", ".zip", ".tar", ".tgz", ".7z", ".zst", ".bz2"), "unpack them"),
    **dict.fromkeys((".pt", ".pth", ".pkl", ".mat"), "convert the cloud of each sweep with numpy.save"),
    **dict.fromkeys((".hdf5", ".hdf", ".he5"), "if they are scenes of OpenSceneFlow, rename them to .h5"),
    ".tfrecord": "Waymo's version 1 is not read; download version 2",
}


def _why_nothing_fits(top: Path) -> str:
    """Say what a file or folder without a log has instead; "" = we do not know."""
    from cflow_torch.data.arrays.cloud_file import SUFFIXES
    from cflow_torch.data.arrays.cloud_text import SUFFIXES as TEXTS

    levels = list(_paths_below(top))
    files = [path for paths in levels for path in paths if path.is_file()]
    suffixes = Counter(suffix_of(path) or path.suffix for path in files)
    if not suffixes:
        return f"it has no files that you may read, down to {len(levels) - 1} folders below" if top.is_dir() else ""
    # Files next to clouds may be more: .json beside .pcap, .txt beside .las.
    known = [kind for kind, _ in suffixes.most_common() if kind in (*_CONVERSIONS, *SUFFIXES)]
    suffix = min(known, key=lambda kind: kind in TEXTS, default="")
    count = suffixes[suffix]
    if count == 1 and suffix in (*SUFFIXES, *TEXTS):
        return f"it has one file of points ({suffix}); scene flow needs a file for each of two sweeps or more"
    if suffix in SUFFIXES:
        return f"its {count} {suffix} files lie alone in their folders: put those of a log into one"
    return f"its {count} {suffix} files are not read: {_CONVERSIONS[suffix]}" if suffix else ""


def _error_of(name: str, root: Any, is_opened: bool = True) -> str:
    """Return the error if a path has no log of a format, or if the first one does not open; "" = there is none."""
    try:
        first = find_sources(name, root)[0]
        if is_opened:
            _open(name, first, {}).close()
        return ""
    except CFlowError as error:
        return str(error)


def find_user_sources(target: str, settings: Mapping[str, Any]) -> list[UserSource]:
    """Return one source for `open_log` per log of your own reader. If it returns none, that is a `CFlowError`.

    `target` is the "package.module.name" of the reader, a class or function. It returns a log (`data.log.Log`) or a
    sequence of logs, which may open them lazily. `settings` are its keyword arguments; those of `open_log` are ignored.
    """
    logs = _user_logs(target, {key: value for key, value in settings.items() if key not in _OF_ALL})
    if len(logs) == 0:
        raise CFlowError(f"{target} returned no log")
    return [UserSource(f"{target}[{number}]", number) for number in range(len(logs))]


def _user_logs(target: str, settings: Mapping[str, Any]) -> Sequence[Log]:
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    try:
        made = instantiate({"_target_": target, **settings}, _convert_="all")
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, CFlowError):
            raise cause from None
        hint = "; put its module next to the configuration, or install it"
        if not isinstance(cause, ImportError):
            _log.error("the reader %s fails", target, exc_info=cause)  # shows the line to the reader's author
            hint = ""
        raise CFlowError(f"the reader {target} fails: {type(cause).__name__}: {shortened(cause)}{hint}") from error
    if hasattr(made, "sweep"):
        return [made]
    return made if hasattr(made, "__getitem__") else list(made)


def source_name(source: Any) -> str:
    """Return the name of a log that is not open."""
    names = (getattr(source, key, None) for key in ("scene", "stem", "name"))
    return str(next(filter(None, names), source))


def find_sources(name: str, root: Any) -> Sequence[Any]:
    """Return one source for `open_log` per log under a path. If there is no log, that is a `CFlowError`."""
    top, (module, _), form = as_path(root), _reader(name), DATA_SETS[name]
    with remote_errors(top):
        if form.find:
            sources = getattr(module, form.find)(top)
        elif form.marks:
            what = f"a folder that holds {form.marks[0]}, or a folder of such folders"
            sources = find_folders(top, lambda folder: (folder / form.marks[0]).exists(), form.depth, what)
        else:
            sources = [top]
    if not sources:
        marks = " or ".join(form.marks)
        raise CFlowError(f"no {form.what} in {root}" + (f": there is no {marks}" if marks else ""))
    return list(sources)


def open_log(
    name: str,
    source: Any,
    find_ground: Any = "auto",
    odometry: bool | str = False,
    check: bool = True,
    deskew: Any = "auto",
    read_as: str | None | Sequence[str] = "auto",
    own_vehicle: str | None = "auto",
    **settings: Any,
) -> Log:
    """Open one log.

    Args:
        name: a key of `DATA_SETS`, or the `target` that you gave `find_user_sources`.
        source: from `find_sources` or `find_user_sources`.
        find_ground: method of `cflow_torch.ground.find_ground` for sweeps without a ground mask, "grid" or
            "patchwork", which also replaces masks that are surely wrong; "auto" = "grid" for those without, and `check`
            warns if it found ground; None = they stay without a mask.
        odometry: True = estimate poses from the points, and replace those that the log has (a reader that de-skews,
            such as that of nuScenes, still uses these); "refine" = start from those.
        check: warn of likely mistakes, see `check_log`.
        read_as: how to read poses and points that have another convention, see `cflow_torch.data.read_as.read_as`; or a
            value of `deskew`: "times", "clockwise", ...
        own_vehicle: "auto" = leave out returns that ride along with the vehicle, see `OwnVehicleLog`; None = keep them.
        deskew: how to move points to the instant of their sweep, see `cflow_torch.data.deskewing.DeskewedLog`; False
            (what `off` means in YAML) = "off", True = "auto".
        **settings: keyword arguments of the reader.

    Raises:
        CFlowError: the log cannot be read; its `log_id` cannot be the name of a folder; the reader does not know a
            setting (the message lists the known ones), or cannot use its value.
    """
    if isinstance(deskew, bool):
        deskew = "auto" if deskew else "off"
    if read_as in ("times", *SCANS) and deskew == "auto":  # how sweeps are scanned is a reading of the log, too
        deskew, read_as = read_as, "auto"
    check_deskew(deskew)
    given = {
        "find_ground": (find_ground, GROUND_METHODS),
        "odometry": (odometry, (False, True, "refine")),
        "own_vehicle": (own_vehicle, ("auto", None)),
    }
    for setting, (value, choices) in given.items():
        if value not in choices:
            words = ("null" if each is None else str(each).lower() for each in choices)
            raise CFlowError(f"{setting}={value!r}: choose one of {', '.join(words)}")
    if odometry and name == "hdf5":
        settings = {"needs_poses": False, **settings}
    new_name = source.name if isinstance(source, RenamedSource) else ""
    source = source.source if isinstance(source, RenamedSource) else source
    if isinstance(source, UserSource):
        log = _user_logs(name, settings)[source.number]
    else:
        _, reader = _reader(name)
        moves = "deskew" in inspect.signature(reader.__init__).parameters  # by more poses than one per sweep
        log = _open(name, source, {**settings, "deskew": deskew in ("auto", "times")} if moves else settings)
        deskew = "off" if moves and deskew == "times" and log.is_compensated else deskew  # the reader did it
    log.log_id = new_name or log.log_id
    safe_name(log.log_id, f"{source}: the log")  # names the folder of its results
    add_gaps_in_time(log)
    if odometry:
        from cflow_torch.data.odometry import with_poses

        log = with_poses(log, refine=odometry == "refine")
    log = stored = CachedLog(log, _KEPT)
    log = read_log_as(log, read_as)
    if own_vehicle is not None:
        log = OwnVehicleLog(log)
    log = DeskewedLog(log, deskew)
    if find_ground is not None:
        log = GroundSegmentedLog(log, find_ground)
    if check:
        check_log(log)
    stored.stop()
    return log


def _open(name: str, source: Any, settings: Mapping[str, Any]) -> Log:
    _, reader = _reader(name)
    known = list(inspect.signature(reader.__init__).parameters)[2:]  # without self and the source
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise CFlowError(f"data set {name} has no setting {', '.join(unknown)}; it has {', '.join(known) or 'none'}")
    try:
        with remote_errors(source if is_path_like(source) else source.root):
            return reader(source, **settings)  # type: ignore[no-any-return]
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, CFlowError) or not settings:
            raise
        given = ", ".join(f"{key}={value!r:.80}" for key, value in settings.items())
        raise CFlowError(f"data set {name} cannot be opened with {given}: {error}") from error


class Logs(Sequence[Log]):
    """The logs of a data set. Each is opened when you ask for it, as `open_log` does with the same arguments."""

    def __init__(self, name: str, sources: Sequence[Any], settings: Mapping[str, Any]) -> None:
        self.name, self.sources, self.settings = name, sources, settings

    def open(self, source: Any) -> Log:
        """Open one of the `sources`."""
        return open_log(self.name, source, **self.settings)

    def __len__(self) -> int:
        return len(self.sources)

    @overload
    def __getitem__(self, index: int) -> Log: ...
    @overload
    def __getitem__(self, index: slice) -> Logs: ...
    def __getitem__(self, index: int | slice) -> Log | Logs:
        if isinstance(index, slice):
            return Logs(self.name, self.sources[index], self.settings)
        return self.open(self.sources[index])

    def __repr__(self) -> str:
        return f"Logs(data={self.name}, {len(self)} logs)"

    def windows(self, num_history: int = 0, num_future: int = 0) -> Iterator[Window]:
        """Iterate over the windows of each log in turn, see `Log.windows`."""
        for log in self:
            with log:
                yield from log.windows(num_history, num_future)


def open(path: Any, data: str = AUTO, **settings: Any) -> Log | Logs:
    """Open the log at a path, or the logs of a folder. `cflow_torch.open` is this function.

    Args:
        path: file or folder, a pattern such as "/data/drive_*", or a sequence of these, which have one format.
        data: name of the format, a key of `DATA_SETS`; "auto" = recognise it.
        **settings: as for `open_log`: `find_ground`, `odometry`, `read_as`, `deskew`, ..., and those of the reader.

    Returns:
        The log if there is one, else a sequence of logs, each of which is opened when you ask for it. Both have
        `windows(num_history=..., num_future=...)`. Errors as in `recognise` and `open_log`.

    Examples:
        >>> for window in cflow_torch.open("/data/my_drive").windows(num_history=4):
        ...     (result,) = model([window])
    """
    paths = matching_paths(path)
    name = the_format(paths) if data == AUTO else data
    logs = Logs(name, find_all_sources(name, paths), settings)
    return logs[0] if len(logs) == 1 else logs


class GroundSegmentedLog(LogWrapper):
    """A log with a ground mask for every sweep: the mask of the log if it has one, otherwise found from the points.

    `method` is the `find_ground` of `open_log`. A method that you choose also replaces masks that are surely wrong.
    """

    def __init__(self, log: Log, method: str = "grid") -> None:
        super().__init__(log)
        self.method = method

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        if sweep.is_ground is not None and not self.wrong_masks:
            return sweep
        is_ground: Any = ground_of(sweep.points, self.method)
        return replace(sweep, is_ground=is_ground)

    def finds_ground(self, index: int) -> bool:
        return self.log.sweep(index).is_ground is None or bool(self.wrong_masks)

    @cached_property
    def wrong_masks(self) -> str:
        """What is wrong with the masks of the log, by its typical sweeps, if a method is chosen; "" = nothing."""
        if self.method == "auto":
            return ""
        with suppress(CFlowError, OSError):  # `sweep` raises the error
            if self.log.sweep(0).is_ground is None:
                return ""
            sweeps = [self.log.sweep(index) for index in typical_sweeps(self.log)]
            masked = (sweep for sweep in sweeps if sweep.is_ground is not None and not frame_problem(sweep.points)[1])
            return next(filter(None, map(mask_problem, masked)), "")
        return ""

    def findings(self) -> list[Finding]:
        findings = self.log.findings()
        if self.wrong_masks:
            text = f"find_ground={self.method} replaces all masks, because one is {self.wrong_masks}"
            return [*findings, Finding("ground", FOUND, text, True)]
        first = self.log.sweep(0)
        if self.method != "auto" or first.is_ground is not None or not has_ground(first.points):
            return findings
        text = (
            "it has no ground masks, so we find the ground (find_ground=auto). data.find_ground=grid does the same "
            "without this line, data.find_ground=null leaves all points in"
        )
        return [*findings, Finding("ground", FOUND, text, True)]


def _reader(name: str) -> tuple[Any, Any]:
    """Import the module and the class of a data set's reader."""
    if name not in DATA_SETS:
        raise CFlowError(f"data set {name!r}: choose one of {', '.join(DATA_SETS)}")
    module = import_module(f"cflow_torch.data.{name}")
    return module, getattr(module, DATA_SETS[name].log)
