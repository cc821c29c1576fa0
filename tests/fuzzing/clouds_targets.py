"""Point clouds, poses, masks and rasters in files of their own: pcd, ply, bin, npy, npz, text."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

import numpy as np

from cflow_torch import CFlowError
from cflow_torch.data.arrays.cloud_file import read_cloud, write_cloud
from cflow_torch.data.arrays.pcd import read_pcd, write_pcd
from cflow_torch.data.arrays.ply import read_ply, write_ply
from cflow_torch.data.arrays.poses_text import (
    poses_at,
    read_calibration,
    read_poses,
    read_times,
    write_kitti_poses,
    write_tum_poses,
)
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.ground import GROUND_RULES, read_ground_raster
from fuzzing.crafted_clouds import BODY, crafted_npy, crafted_npz, crafted_pcd, crafted_ply, crafted_text, npy_of
from fuzzing.target import Target

_XYZ = {name: np.arange(4, dtype=np.float32) for name in "xyz"}
_MANY = {**_XYZ, "t": np.arange(4, dtype=np.uint64), "n": np.zeros((4, 3), np.int8), "d": np.arange(4.0)}
_STAMPS = tuple(1_700_000_000_000_000_000 + i * 100_000_000 for i in range(3))
_RASTER = "l_ground_height_surface____PIT.npy"
_ALIGNMENT = '{"R": [1.0, 0.0, 0.0, 1.0], "t": [5.0, 5.0], "s": 2.0}'


def written(name: str, *writes: Callable[[Path], Any]) -> List[bytes]:
    """What each of the functions writes to a file of that name."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        return [(write(file), file.read_bytes())[1] for write in writes]


def _pcd_seeds() -> List[bytes]:
    kinds = ("ascii", "binary", "binary_compressed")
    many = {**_MANY, "w": np.zeros(4, np.uint16)}
    return [
        *written("a.pcd", *(lambda file, d=data: write_pcd(file, many, d) for data in kinds)),
        *written("a.pcd", *(lambda file, d=data: write_pcd(file, _XYZ, d) for data in kinds)),
    ]


def _ply_seeds() -> List[bytes]:
    fields = {**_XYZ, "d": np.arange(4.0), "i": np.arange(4, dtype=np.int32), "red": np.zeros(4, np.uint8)}
    kinds = ("ascii", "binary_little_endian", "binary_big_endian")
    seeds = written("a.ply", *(lambda file, d=data: write_ply(file, fields, d) for data in kinds))
    faces = b"comment faces\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    return [*seeds, seeds[0].replace(b"end_header\n", faces) + b"3 0 1 2\n"]


def _versions(table: np.ndarray) -> List[bytes]:
    """With the headers that NumPy writes for long and for foreign field names."""
    files = [io.BytesIO(), io.BytesIO()]
    for file, version in zip(files, ((2, 0), (3, 0))):
        np.lib.format.write_array(file, table, version)
    return [file.getvalue() for file in files]


def _npy_seeds() -> List[bytes]:
    table = np.arange(12.0).reshape(4, 3)
    named = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", ">f8"), ("more", "<f4", (2,))])
    kinds = [npy_of(table.astype(kind)) for kind in ("<f2", "<f4", ">f4", "<f8")]
    return [*kinds, *_versions(table), npy_of(np.asfortranarray(table)), npy_of(named)]


def _npz_seeds() -> List[bytes]:
    table = np.arange(12, dtype=np.float32).reshape(4, 3)
    found = []
    for save in (np.savez, np.savez_compressed):
        for arrays in ({"points": table, "more": table}, _XYZ, {"anything": table}):
            file = io.BytesIO()
            save(file, **arrays)  # type: ignore[arg-type]
            found.append(file.getvalue())
    return found


def _text_seeds() -> List[bytes]:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.arange(3)
    matrices = b"".join(" ".join(map(str, pose.ravel())).encode() + b"\n" for pose in poses)
    tum, kitti = written("a", lambda f: write_tum_poses(f, _STAMPS, poses), lambda f: write_kitti_poses(f, poses))
    calibration = b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0.5 0 1 0 0 0 0 1 0\n"
    return [tum, kitti, matrices, calibration, b"# seconds\n1700000000.1\n1700000000.2\n\n1700000000.3\n"]


def any_of(*reads: Callable[[], Any]) -> List[Any]:
    """All that can be read; the last refusal if nothing can."""
    found, refusal = [], CFlowError("nothing to read")
    for read in reads:
        try:
            found.append(read())
        except CFlowError as error:  # noqa: PERF203
            refusal = error
    if not found:
        raise refusal
    return found


def _read_text(folder: Path) -> Any:
    """As each of the things that a text may be; poses at times near theirs, too."""
    file = folder / "poses.txt"

    def poses() -> Any:
        found = read_poses(file, folder / "calib.txt")
        return poses_at(found, found.times_ns, "a") if found.times_ns is not None else found

    return any_of(
        poses,
        lambda: read_times(file),
        lambda: read_calibration(file),
        lambda: ArraysLog(folder / "log", poses=file).sweep(1),
        lambda: ArraysLog(folder / "log", times=file, poses=None).sweep(1),
    )


def _prepare_log(folder: Path) -> None:
    (folder / "calib.txt").write_text("Tr: 1 0 0 0.5 0 1 0 0 0 0 1 0\n")
    (folder / "log" / "points").mkdir(parents=True)
    for name in "012":
        write_cloud(folder / "log" / "points" / f"{name}.npy", np.arange(12.0).reshape(4, 3))


def _raster(folder: Path) -> Any:
    raster = read_ground_raster(folder)
    assert raster is not None
    return [raster.is_ground(np.arange(-12.0, 12.0).reshape(8, 3), rule) for rule in GROUND_RULES]


def _all_fields(read: Callable[[Path], Dict[str, np.ndarray]], name: str) -> Callable[[Path], Any]:
    return lambda folder: any_of(lambda: read(folder / name), lambda: read_cloud(folder / name))


def _poses_npy(folder: Path) -> Any:
    return any_of(lambda: read_poses(folder / "p.npy"), lambda: ArraysLog(folder / "log", poses=folder / "p.npy"))


def _mask(folder: Path) -> Any:
    return ArraysLog(folder / "log", ground=folder).sweep(0)


_POSES = np.tile(np.eye(4), (3, 1, 1))
_MASKS = [npy_of(np.array([0, 1, 1, 0], kind)) for kind in ("?", "u1", "<i8")] + [npy_of(np.zeros((4, 1), bool))]
_HEIGHTS = [npy_of(np.linspace(-9, 9, 400).reshape(20, 20).astype(kind)) for kind in ("<f4", "<f8", "<f2")]
PCD_TOKENS = (
    *b"POINTS WIDTH HEIGHT COUNT SIZE TYPE FIELDS DATA ascii binary binary_compressed F U I 4 8".split(),
    b"\n",
)
_PLY_TOKENS = (*b"ply element vertex property list float uchar int double ascii face end_header".split(), b"\n")
_NPY_TOKENS = (b"'shape': (", b"'descr': ", b"'|O'", b"'<f4'", b"True", b"(-1, 3)", b"\x93NUMPY\x01\x00", b"[('x', ")

TARGETS: Tuple[Target, ...] = (
    Target("pcd", "a.pcd", _pcd_seeds, _all_fields(read_pcd, "a.pcd"), crafted=crafted_pcd(), tokens=PCD_TOKENS),
    Target("ply", "a.ply", _ply_seeds, _all_fields(read_ply, "a.ply"), crafted=crafted_ply(), tokens=_PLY_TOKENS),
    Target("bin", "a.bin", lambda: [bytes(96)], lambda f: [read_cloud(f / "a.bin", n) for n in (4, 3)], crafted=BODY),
    Target(
        *("npy", "a.npy", _npy_seeds, lambda folder: read_cloud(folder / "a.npy")),
        crafted=crafted_npy(),
        tokens=_NPY_TOKENS,
    ),
    Target(
        *("npz", "a.npz", _npz_seeds, lambda folder: read_cloud(folder / "a.npz")),
        crafted=crafted_npz(),
        tokens=(*_NPY_TOKENS, b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06", b"x.npy", b"points.npy"),
    ),
    Target(
        *("poses_text", "poses.txt", _text_seeds, _read_text, _prepare_log),
        crafted=crafted_text(),
        tokens=(b"Tr:", b"\n", b" ", b"1", b"0 0 0 1", b"#", b"\xff", b"\0", b"e", b"1e-999999999", b","),
    ),
    Target(
        *(
            "poses_npy",
            "p.npy",
            lambda: [npy_of(_POSES), npy_of(_POSES[:, :3].astype("<f4"))],
            _poses_npy,
            _prepare_log,
        ),
        crafted=crafted_npy((3, 4, 4)),
        tokens=_NPY_TOKENS,
    ),
    Target(
        *("ground_mask", "0.npy", lambda: _MASKS, _mask, _prepare_log),
        crafted=crafted_npy((4,)),
        tokens=_NPY_TOKENS,
    ),
    Target(
        *("ground_raster", _RASTER, lambda: _HEIGHTS, _raster),
        prepare=lambda folder: (folder / "l___img_Sim2_city.json").write_text(_ALIGNMENT),
        crafted=crafted_npy((20, 20)),
        tokens=_NPY_TOKENS,
    ),
)
