"""Experimental: data sets that KISS-ICP's own loaders read (extra `kiss-icp`), such as HeLiPR, MulRan, NCLT, Boreas."""

from __future__ import annotations

import io
from contextlib import contextmanager, redirect_stdout
from typing import Any, Iterator

import numpy as np

from cflow_torch.data.file_errors import shortened
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import Sweep

_OTHERS = {"rosbag": "bags", "mcap": "bags"}  # loaders without random access -> our own reader


class KissICPLog(Log):
    """One sequence. Experimental: we tested the loaders on small made-up files only.

    Args:
        root: file or folder for the loader.
        loader: name of the loader: kitti, kitti_raw, helipr, mulran, ncd, nclt, boreas, apollo, ouster, generic, ...
        sequence: name of the sequence, such as "00", for loaders that need one.

    Attributes:
        log_id: name of the file or folder, and the sequence.
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep; None if the data set has none.
        timestamps: 0, 1, 2, ... Sweeps have no times, because the loaders have no common way to return them. Models
            assume `sweep_interval` (0.1 s) between them.

    Convention: points and poses are those of the loader, in the frame of the LiDAR. The poses are the data set's own
        (`gt_poses`); None if it has none.
    """

    def __init__(self, root: PathLike, loader: str, sequence: str | None = None) -> None:
        self.root = as_path(root)
        datasets = import_optional(
            "kiss_icp.datasets", "KISS-ICP's loaders need it (extra kiss-icp): pip install kiss-icp"
        )
        names = sorted(set(datasets.available_dataloaders()) - set(_OTHERS))
        if loader not in names:
            other = f", or use data={_OTHERS[loader]}" if loader in _OTHERS else ""
            raise CFlowError(f"loader={loader}: choose one of {', '.join(names)}{other}")
        self.log_id = "-".join([self.root.resolve().name, *([str(sequence)] if sequence is not None else [])])
        self._what = f"{self.root}, KISS-ICP's loader {loader}"
        with _loader_errors(self._what):
            settings = {} if sequence is None else {"sequence": str(sequence)}
            self._dataset = datasets.dataset_factory(loader, self.root, **settings)
            self.timestamps = range(len(self._dataset))
            poses = getattr(self._dataset, "gt_poses", None)
            self.poses = None if poses is None else np.asarray(poses, np.float64).reshape(-1, 4, 4)
        if self.poses is not None and len(self.poses) != len(self):
            raise CFlowError(f"{self._what} has {len(self.poses)} poses for {len(self)} sweeps; copy both again")
        self._check_count(self._what)

    def sweep(self, index: int) -> Sweep:
        self._timestamp(index)
        with _loader_errors(f"{self._what}, sweep {index}"):
            found = self._dataset[index]
            points = np.asarray(found[0] if isinstance(found, tuple) else found, np.float32)[:, :3]
        pose = None if self.poses is None else rigid_transform(self.poses[index], f"{self._what}: pose {index}")
        return Sweep(points, None, pose)


@contextmanager
def _loader_errors(what: str) -> Iterator[None]:
    """Turn a loader's exception or exit into a `CFlowError` with what it printed."""
    printed: Any = io.StringIO()
    try:
        with redirect_stdout(printed):
            yield
    except (Exception, SystemExit) as error:
        raise CFlowError(f"{what} fails: {shortened(printed.getvalue())} {type(error).__name__}: {error}") from error
