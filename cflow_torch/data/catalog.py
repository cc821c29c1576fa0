"""Every data set by name: how it is recognised, how its logs are found and opened; and logs of a user's own reader."""

from __future__ import annotations

import inspect
import logging
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Mapping, Sequence

from cflow_torch.data.log import Log, LogWrapper
from cflow_torch.data.log_check import check_log
from cflow_torch.data.names import safe_name
from cflow_torch.data.paths import as_path, is_path_like, remote_errors
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ground import find_ground as ground_of

GROUND_METHODS = ("grid", "patchwork")
_OF_ALL = ("find_ground", "odometry", "check")  # settings that every data set has
AUTO = "auto"  # the name of the data set that is to be recognised
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DataSet:
    """One format.

    Args:
        module: where its reader is; imported when it is needed.
        find: name of the function root -> sources.
        log: name of the class source -> `Log`.
        what: what one log is, for error messages.
    """

    module: str
    find: str
    log: str
    what: str


DATA_SETS: dict[str, DataSet] = {
    "av2": DataSet("av2", "find_av2_logs", "AV2Log", "Argoverse 2 log (a folder with sensors/lidar)"),
    "hdf5": DataSet("hdf5", "find_hdf5_scenes", "HDF5Log", "scene (a file *.h5)"),
    "nuscenes": DataSet("nuscenes", "find_nuscenes_scenes", "NuScenesLog", "nuScenes scene (a folder with v1.0-*)"),
    "truckscenes": DataSet(
        "truckscenes", "find_truckscenes_scenes", "TruckScenesLog", "TruckScenes scene (a folder with v1.*)"
    ),
    "waymo": DataSet("waymo", "find_waymo_segments", "WaymoLog", "Waymo segment (a file lidar/*.parquet)"),
    "pandaset": DataSet(
        "pandaset", "find_pandaset_sequences", "PandaSetLog", "PandaSet sequence (a folder with lidar/poses.json)"
    ),
    "aevascenes": DataSet(
        "aevascenes", "find_aevascenes_sequences", "AevaScenesLog", "AevaScenes sequence (a folder with sequence.json)"
    ),
    "bags": DataSet("bags", "find_bags", "BagLog", "bag (.bag, .mcap, or the folder of a ROS 2 bag)"),
    "kiss_icp": DataSet("kiss_icp", "find_kiss_icp", "KissICPLog", "data for a loader of KISS-ICP"),
    "arrays": DataSet("arrays", "find_array_logs", "ArraysLog", "folder of point clouds"),
}


# The ends of paths that tell a format. Folders of point clouds are what is left.
_MARKS = {
    "av2": ("sensors/lidar",),
    "hdf5": ("*.h5",),
    "nuscenes": ("v1.*/scene.json",),
    "truckscenes": ("v1.*/scene.json",),
    "waymo": ("lidar/*.parquet",),
    "pandaset": ("lidar/poses.json",),
    "aevascenes": ("sequence.json",),
    "bags": ("*.bag", "*.mcap", "*.db3"),
}
_DEEPEST = 6  # levels below a place at which a mark is looked for


@dataclass(frozen=True)
class UserSource:
    """A log of a user's own reader: which one of those that it returns."""

    name: str
    number: int


def recognise(root: Any) -> str:
    """The name of the data set whose logs lie at a place, by what is there; nothing is opened.

    Args:
        root: as for `find_sources`. What lies nearest to it counts.

    Raises:
        CFlowError: nothing is there, or no format fits, or several do.
        OSError: a remote place cannot be reached.
    """
    place = as_path(root)
    with remote_errors(place):
        if not place.exists():
            raise CFlowError(f"{root}: no file and no folder of this name; settings are NAME=VALUE")
        level, fitting = [place], set()
        for _ in range(_DEEPEST):
            fitting = {name for name, marks in _MARKS.items() for path in level if any(map(path.match, marks))}
            if fitting:
                break
            level = [path for folder in level if folder.is_dir() for path in folder.iterdir() if path.name[0] != "."]
    found = [name for name in DATA_SETS if name in fitting] or ["arrays"]
    if len(found) > 1 or not fitting:  # nuScenes and TruckScenes look alike from outside
        found = [name for name in found if _has_logs(name, root)]
    if len(found) != 1:
        why = f"several formats fit, {' and '.join(found)}" if found else "no format fits what lies there"
        raise CFlowError(f"{root}: {why}; give one of data={'|'.join(DATA_SETS)}")
    return found[0]


def _has_logs(name: str, root: Any) -> bool:
    try:
        return len(find_sources(name, root)) > 0
    except CFlowError:
        return False


def find_user_sources(target: str, settings: Mapping[str, Any]) -> list[UserSource]:
    """What `open_log` takes, one source per log that a user's own reader returns.

    Args:
        target: name of a class or function, as "package.module.name". It returns a log (`cflow_torch.data.log.Log`), or
            a sequence of logs, which may open them when they are asked for.
        settings: its keyword arguments, and those of `open_log`.

    Raises:
        CFlowError: there is no such thing, it fails, or it returns no log.
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
        if not isinstance(cause, ImportError):  # its author wants to see where
            _log.error("the reader %s fails", target, exc_info=cause)
        place = "" if not isinstance(cause, ImportError) else "; put its module beside the configuration, or install it"
        raise CFlowError(
            f"the reader {target} fails: {type(cause).__name__}: {' '.join(str(cause).split())}{place}"
        ) from error
    if hasattr(made, "sweep"):
        return [made]
    return made if hasattr(made, "__getitem__") else list(made)


def find_sources(name: str, root: Any) -> Sequence[Any]:
    """What `open_log` takes, one source per log under a folder.

    Raises:
        CFlowError: no such data set; nothing of its format there.
        OSError: a remote place cannot be reached.
    """
    data_set = _data_set(name)
    find = getattr(import_module(f"cflow_torch.data.{data_set.module}"), data_set.find)
    place = as_path(root)
    with remote_errors(place):
        sources = find(place)
    if not sources:
        raise CFlowError(f"no {data_set.what} in {root}")
    return list(sources)


def open_log(
    name: str, source: Any, find_ground: Any = None, odometry: bool = False, check: bool = True, **settings: Any
) -> Log:
    """Open one log.

    Args:
        name: a key of `DATA_SETS`, or the target of `find_user_sources`.
        source: from `find_sources` or `find_user_sources`.
        find_ground: None, or a method of `cflow_torch.windows.ground.find_ground` for sweeps without a ground mask.
        odometry: find poses with kiss-icp if the log has none.
        check: warn if ground is left in, or if the static world does not stay put, see `check_log`.
        **settings: keyword arguments of the reader.

    Returns:
        The log.

    Raises:
        CFlowError: a log that cannot be read, or whose name cannot be a folder's; a setting that the reader does not
            have (the message lists its own) or cannot use.
    """
    if find_ground is not None and find_ground not in GROUND_METHODS:
        raise CFlowError(f"find_ground={find_ground!r}: give null or one of {', '.join(GROUND_METHODS)}")
    log = _user_logs(name, settings)[source.number] if isinstance(source, UserSource) else _open(name, source, settings)
    safe_name(log.log_id, f"{source}: the log")  # results get that name
    if odometry:
        from cflow_torch.data.odometry import with_poses

        log = with_poses(log)
    if find_ground is not None:
        log = GroundSegmentedLog(log, find_ground)
    if check:
        check_log(log)
    return log


def _open(name: str, source: Any, settings: Mapping[str, Any]) -> Log:
    data_set = _data_set(name)
    reader = getattr(import_module(f"cflow_torch.data.{data_set.module}"), data_set.log)
    known = list(inspect.signature(reader.__init__).parameters)[2:]  # of the class, Python 3.8 returns Protocol's
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


class GroundSegmentedLog(LogWrapper):
    """Another log, with the ground of sweeps without a mask found from their points.

    Args:
        log: any log.
        method: as for `cflow_torch.windows.ground.find_ground`.

    Convention: a mask that the log has is kept.

    Cost: one call of `find_ground` per sweep that is read.
    """

    def __init__(self, log: Log, method: str = "grid") -> None:
        super().__init__(log)
        self.method = method

    def sweep(self, index: int) -> Sweep:
        """The log's sweep with a ground mask."""
        sweep = self.log.sweep(index)
        if sweep.is_ground is not None:
            return sweep
        is_ground: Any = ground_of(sweep.points, self.method)
        return replace(sweep, is_ground=is_ground)


def _data_set(name: str) -> DataSet:
    if name not in DATA_SETS:
        raise CFlowError(f"data set {name!r}: give one of {', '.join(DATA_SETS)}")
    return DATA_SETS[name]
