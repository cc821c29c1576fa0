"""Every data set by name: how its logs are found and opened."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Dict, Sequence

from cflow_torch.data.log import Log
from cflow_torch.data.log_check import check_log
from cflow_torch.data.names import safe_name
from cflow_torch.data.paths import as_path, is_place, remote_errors
from cflow_torch.types import CFlowError

GROUND_METHODS = ("grid", "patchwork")


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


DATA_SETS: Dict[str, DataSet] = {
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
        name: a key of `DATA_SETS`.
        source: from `find_sources`.
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
    data_set = _data_set(name)
    reader = getattr(import_module(f"cflow_torch.data.{data_set.module}"), data_set.log)
    known = list(inspect.signature(reader).parameters)[1:]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise CFlowError(f"data set {name} has no setting {', '.join(unknown)}; it has {', '.join(known) or 'none'}")
    if find_ground is not None and find_ground not in GROUND_METHODS:
        raise CFlowError(f"find_ground={find_ground!r}: give null or one of {', '.join(GROUND_METHODS)}")
    try:
        with remote_errors(source if is_place(source) else source.root):
            log: Log = reader(source, **settings)
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, CFlowError) or not settings:
            raise
        given = ", ".join(f"{key}={value!r:.80}" for key, value in settings.items())
        raise CFlowError(f"data set {name} cannot be opened with {given}: {error}") from error
    safe_name(log.log_id, f"{source}: the log")  # results get that name
    if odometry:
        from cflow_torch.data.odometry import with_poses

        log = with_poses(log)
    if find_ground is not None:
        from cflow_torch.data.found_ground import GroundFoundLog

        log = GroundFoundLog(log, find_ground)
    if check:
        check_log(log)
    return log


def _data_set(name: str) -> DataSet:
    if name not in DATA_SETS:
        raise CFlowError(f"data set {name!r}: give one of {', '.join(DATA_SETS)}")
    return DATA_SETS[name]
