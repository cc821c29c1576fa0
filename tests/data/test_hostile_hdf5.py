"""Scenes that claim, link or pack what no scene has: refused before memory is asked for or another file is opened."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path
from typing import Any, Callable, Dict

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.bounds import MAX_ARRAY_BYTES
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.hdf5.results import write_hdf5_results

h5py = pytest.importorskip("h5py")
from fuzzing.hostile_hdf5 import POINTS, STAMPS, scene_image, sweep_values, write_outside  # noqa: E402

FIRST = str(STAMPS[0])
FLOW = np.full((POINTS, 3), 0.5, np.float32)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A whole scene, and beside it what it must not reach."""
    write_outside(tmp_path)
    (tmp_path / "scene.h5").write_bytes(scene_image(random.Random(0), "earliest"))
    return tmp_path / "scene.h5"


def replace(file: Path, key: str, make: Callable[[Any], object]) -> None:
    """Have `make` put something else under a key of the first sweep."""
    with h5py.File(file, "r+") as opened:
        group = opened[FIRST]
        if key in group:
            del group[key]
        make(group)


def virtual(group: Any, key: str, file: str) -> None:
    shape = sweep_values(0)[key].shape if key != "mine" else FLOW.shape
    layout = h5py.VirtualLayout(shape, "f4")
    layout[...] = h5py.VirtualSource(file, f"{FIRST}/{key}", shape)
    group.create_virtual_dataset(key, layout)


ELSEWHERE: Dict[str, Callable[[Any, str], object]] = {
    "external link": lambda group, key: group.__setitem__(key, h5py.ExternalLink("outside.h5", f"{FIRST}/{key}")),
    "soft link": lambda group, key: group.__setitem__(key, h5py.SoftLink(f"/{STAMPS[1]}/lidar")),
    "circle": lambda group, key: group.__setitem__(key, h5py.SoftLink(f"/{FIRST}/{key}")),
    "external data": lambda group, key: group.create_dataset(
        *(key, FLOW.shape, "f4"), external=[(str(Path(group.file.filename).with_name("outside.raw")), 0, 4000)]
    ),
    "virtual data": lambda group, key: virtual(group, key, "outside.h5"),
}


@pytest.mark.parametrize("kind", sorted(ELSEWHERE))
@pytest.mark.parametrize("key", ["lidar", "flow", "mine"])
def test_nothing_is_read_from_elsewhere(kind: str, key: str, scene: Path) -> None:
    replace(scene, key, lambda group: ELSEWHERE[kind](group, key))
    with HDF5Log(scene) as log:
        for call in [lambda: log.values(0, key), *([lambda: log.labels(0)] if key == "flow" else [])]:
            with pytest.raises(CFlowError, match=f"{key} (is a link|lies in other files)"):
                call()
        assert key in log.keys(0) and len(log.sweep(1).points) == POINTS


@pytest.mark.parametrize("target", ["outside.h5", "pipe"])
def test_a_sweep_elsewhere_is_not_opened(target: str, scene: Path) -> None:
    """A pipe would be waited for without an end."""
    os.mkfifo(scene.parent / "pipe")
    with h5py.File(scene, "r+") as opened:
        del opened[FIRST]
        opened[FIRST] = h5py.ExternalLink(target, FIRST)
    with HDF5Log(scene) as log:
        for call in (lambda: log.sweep(0), lambda: log.poses, log.eval_frames, lambda: log.keys(0)):
            with pytest.raises(CFlowError, match=f"{FIRST} is a link"):
                call()
    with pytest.raises(CFlowError, match="is a link"):
        write_hdf5_results(scene, "mine", [(STAMPS[0], FLOW)])


@pytest.mark.parametrize("kind", sorted(ELSEWHERE))
def test_nothing_is_written_elsewhere(kind: str, scene: Path) -> None:
    replace(scene, "mine", lambda group: ELSEWHERE[kind](group, "mine"))
    before = {file.name: file.read_bytes() for file in scene.parent.iterdir()}
    with pytest.raises(CFlowError, match="mine (is a link|lies in other files)"):
        write_hdf5_results(scene, "mine", [(STAMPS[0], FLOW)])
    assert {file.name: file.read_bytes() for file in scene.parent.iterdir()} == before


def test_a_second_name_of_another_key_is_not_written_over(scene: Path) -> None:
    replace(scene, "mine", lambda group: group.__setitem__("mine", group["flow"]))
    before = scene.read_bytes()
    with pytest.raises(CFlowError, match="mine .*is no flow result"):
        write_hdf5_results(scene, "mine", [(STAMPS[0], FLOW)])
    assert scene.read_bytes() == before


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("start", [0, 512])
def test_virtual_data_are_told_before_they_are_opened(
    libver: str, start: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """libhdf5 2.0.0 loops for ever over a damaged list of their sources, which it reads when it opens them."""
    with h5py.File(tmp_path / "scene.h5", "w", libver=libver, userblock_size=start) as opened:
        for stamp in STAMPS:
            for key, value in sweep_values(0).items():
                opened[f"{stamp}/{key}"] = value
        del opened[FIRST]["lidar"], opened[FIRST]["flow"]
        virtual(opened[FIRST], "lidar", "outside.h5")
        virtual(opened[FIRST], "flow", ".")
        for number in range(30):  # the header goes on elsewhere
            opened[FIRST]["lidar"].attrs[f"attribute {number}"] = np.zeros(9)
    opens = h5py.h5o.open

    def opened_once(parent: Any, name: bytes) -> Any:
        assert name not in (b"lidar", b"flow"), "it is opened"
        return opens(parent, name)

    with HDF5Log(tmp_path / "scene.h5", None) as log:
        assert len(log.sweep(1).points) == POINTS and log.labels(1) is not None
        monkeypatch.setattr(h5py.h5o, "open", opened_once)
        for key in ("lidar", "flow"):
            with pytest.raises(CFlowError, match=f"{key} lies in other files"):
                log.values(0, key)


@pytest.mark.parametrize("source", [b"pipe", b"pipe%b"])
def test_virtual_data_without_a_limit_open_nothing(source: bytes, scene: Path) -> None:
    """To ask HDF5 for their shape would open the source: here a pipe, which is waited for without an end."""
    for name in ("pipe", "pipe0"):
        os.mkfifo(scene.parent / name)
    shape, most = (POINTS, 4), (h5py.h5s.UNLIMITED, 4)
    blocks = h5py.h5s.create_simple(shape, most)
    blocks.select_hyperslab((0, 0), (h5py.h5s.UNLIMITED, 1), shape, shape)
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_virtual(blocks, source, b"a", h5py.h5s.create_simple(shape) if b"%" in source else blocks)
    space = h5py.h5s.create_simple(shape, most)
    replace(scene, "lidar", lambda group: h5py.h5d.create(group.id, b"lidar", h5py.h5t.IEEE_F32LE, space, plan))
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="lidar lies in other files"):
        log.sweep(0)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "scene.h5")
    with pytest.raises(CFlowError, match=r"scene\.h5.*pipe"):
        HDF5Log(tmp_path / "scene.h5")


TYPES = (
    *("c8", "S4", "V7", np.longdouble, ("f4", (3,)), [("a", "f4")], h5py.string_dtype(), h5py.ref_dtype),
    *(h5py.vlen_dtype(np.float32), h5py.enum_dtype({"a": 1}), h5py.opaque_dtype(np.dtype("M8[s]"))),
)


@pytest.mark.parametrize("dtype", TYPES, ids=str)
def test_only_plain_numbers_are_read(dtype: Any, scene: Path) -> None:
    replace(scene, "lidar", lambda group: group.create_dataset("lidar", (POINTS, 4), dtype))
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="lidar (is no array of|has shape)"):
        log.sweep(0)


@pytest.mark.parametrize("dtype", [">f4", "f2", ">f8", "u2", ">i8"])
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"compression": "gzip", "shuffle": True},
        {"compression": "lzf"},
        {"compression": "lzf", "shuffle": True},
        {"chunks": (2, 3)},
    ],
)
def test_numbers_of_every_kind_are_read(dtype: str, how: Dict[str, Any], scene: Path) -> None:
    values = np.arange(POINTS * 4).reshape(POINTS, 4).astype(dtype)
    replace(scene, "lidar", lambda group: group.create_dataset("lidar", data=values, **how))
    with HDF5Log(scene) as log:
        assert np.array_equal(log.sweep(0).points, values[:, :3].astype(np.float32))
        assert np.array_equal(log.values(0, "lidar"), values) and log.values(0, "lidar").dtype == values.dtype


def packed(group: Any, stored: bytes, mask: int = 0, **how: Any) -> None:
    """Points in one chunk that is stored as given."""
    made = group.create_dataset("lidar", (POINTS, 4), "f4", chunks=(POINTS, 4), **{"compression": "gzip", **how})
    made.id.write_direct_chunk((0, 0), stored, filter_mask=mask)


def filtered_by_nobody(group: Any) -> None:
    """HDF5 would look for a library that knows filter 32123, and run it."""
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((POINTS, 4))
    plan.set_filter(32123, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple((POINTS, 4))
    h5py.h5d.create(group.id, b"lidar", h5py.h5t.IEEE_F32LE, space, plan).write_direct_chunk((0, 0), WHOLE)


WHOLE = sweep_values(0)["lidar"].tobytes()
PACKED: Dict[str, Callable[[Any], object]] = {
    "too short": lambda group: packed(group, zlib.compress(WHOLE[:-1])),
    "too long": lambda group: packed(group, zlib.compress(WHOLE + b"x")),
    "a bomb": lambda group: packed(group, zlib.compress(bytes(10**6))),
    "without an end": lambda group: packed(group, zlib.compress(WHOLE)[:-4]),
    "nothing": lambda group: group.create_dataset("lidar", data=h5py.Empty("f4")),
    "unpacked, too short": lambda group: packed(group, WHOLE[:8], mask=1),
    "missing": lambda group: group.create_dataset("lidar", (POINTS, 4), "f4", chunks=(POINTS, 4), compression="gzip"),
    "partly missing": lambda group: group.create_dataset("lidar", (POINTS, 4), "f4", chunks=(2, 2)).__setitem__(
        (0, 0), 1
    ),
    "a filter of nobody": lambda group: filtered_by_nobody(group),
    "lzf that is none": lambda group: packed(group, b"\xff" * 8, compression="lzf"),
    "lzf, too long": lambda group: packed(group, bytes([31]) + bytes(32) + b"\xe0\xff\x00" * 9, compression="lzf"),
    "scale-offset": lambda group: group.create_dataset("lidar", data=np.ones((POINTS, 4), int), scaleoffset=2),
    "not stored": lambda group: group.create_dataset("lidar", (POINTS, 4), "f4"),
}


@pytest.mark.parametrize("kind", sorted(PACKED))
def test_chunks_that_are_not_what_they_claim(kind: str, scene: Path) -> None:
    replace(scene, "lidar", PACKED[kind])
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="(?s)lidar.*(chunk|filters|claims|Error|nothing)"):
        log.sweep(0)


def test_a_chunk_that_skipped_its_filter_is_read(scene: Path) -> None:
    replace(scene, "lidar", lambda group: packed(group, WHOLE, mask=1))
    with HDF5Log(scene) as log:
        assert log.sweep(0).points.tobytes() == sweep_values(0)["lidar"][:, :3].tobytes()


CLAIMS = {
    "10^12 points": ((10**12, 4), None),
    "10^12 points in chunks": ((10**12, 4), (1 << 20, 4)),
    "a gigabyte of nothing": ((60_000_000, 4), None),
    "a chunk of a gigabyte": ((POINTS, 1 << 28), (POINTS, 1 << 26)),
    "10^8 chunks": ((10**8, 1), (1, 1)),
    "10^12 columns": ((POINTS, 10**12), None),
}


@pytest.mark.parametrize("kind", sorted(CLAIMS))
@pytest.mark.parametrize("key", ["lidar", "flow", "ground_mask", "pose", "mine"])
def test_claims_cost_nothing(kind: str, key: str, scene: Path) -> None:
    shape, chunks = CLAIMS[kind]
    replace(scene, key, lambda group: group.create_dataset(key, shape, "f4", chunks=chunks))
    tracemalloc.start()
    try:
        with HDF5Log(scene) as log, pytest.raises(CFlowError, match=f"{key}.*(claims|chunks|has shape)"):
            log.values(0, key)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_memory_of_hostile_scenes(tmp_path: Path) -> None:
    """Real memory of a process that reads bombs and a claim of a gigabyte: below 100 MiB beyond the import."""
    with h5py.File(tmp_path / "scene.h5", "w") as opened:
        for index in range(4):
            group = opened.create_group(str(STAMPS[0] + index))
            group["pose"] = np.eye(4)
            shape = (1 << 16, 4) if index < 3 else (MAX_ARRAY_BYTES // 16, 4)
            made = group.create_dataset("lidar", shape, "f4", chunks=shape if index < 3 else True, compression="gzip")
            if index < 3:
                made.id.write_direct_chunk((0, 0), zlib.compress(bytes((1 << 20) + (index << 27)), 1))
    code = (
        "import resource, sys\n"
        "from cflow_torch import CFlowError\n"
        "from cflow_torch.data.hdf5.reader import HDF5Log\n"
        "log = HDF5Log(sys.argv[1], None)\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10\n"
        "log.sweep(0)\n"
        "before = peak()\n"
        "for index in (1, 2, 3):\n"
        "    try:\n"
        "        log.sweep(index)\n"
        "    except CFlowError:\n"
        "        print('refused', end=' ')\n"
        "print(peak() - before)\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "scene.h5")],
        cwd=str(root),
        capture_output=True,
        text=True,
        check=True,
    )
    *words, grown = done.stdout.split()
    assert words == ["refused"] * 3 and int(grown) < 100, done.stdout


@pytest.mark.parametrize("name", ["007", "9" * 20, str(2**63), "9" * 5000])
def test_names_that_are_no_time_stamps(name: str, scene: Path) -> None:
    with h5py.File(scene, "r+") as opened:
        opened.create_group(name)
    with pytest.raises(CFlowError, match=r"scene\.h5.*sweep"):
        HDF5Log(scene)


@pytest.mark.parametrize("name", ["\u00b2", "\u0661\u0662", "..", "-1", "1.5", "calibration"])
def test_names_that_are_no_numbers_are_no_sweeps(name: str, scene: Path) -> None:
    with h5py.File(scene, "r+") as opened:
        opened.create_group(name)
    with HDF5Log(scene) as log:
        assert list(log.timestamps) == list(STAMPS)


def test_names_that_are_no_text(scene: Path) -> None:
    with h5py.File(scene, "r+") as opened:
        h5py.h5g.create(opened[FIRST].id, b"\xff\xfe")
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="no UTF-8"):
        log.keys(0)
    with h5py.File(scene, "r+") as opened:
        h5py.h5g.create(opened.id, b"\xff\xfe")
    with pytest.raises(CFlowError, match="no UTF-8"):
        HDF5Log(scene)


@pytest.mark.parametrize("key", ["/", ".", "..", "", f"/{STAMPS[1]}/lidar", f"../{STAMPS[1]}/lidar", "lidar/", "a\0b"])
def test_keys_stay_in_their_sweep(key: str, scene: Path) -> None:
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="no |cannot open"):
        log.values(0, key)


def test_a_sweep_or_key_that_is_another_thing(scene: Path) -> None:
    replace(scene, "lidar", lambda group: group.create_group("lidar"))
    with h5py.File(scene, "r+") as opened:
        del opened[str(STAMPS[1])]
        opened[str(STAMPS[1])] = np.zeros(3)
        opened["5"] = np.dtype("f4")
    with HDF5Log(scene) as log:
        for index, complaint in ((0, "5 is no group"), (1, "lidar is no array"), (2, f"{STAMPS[1]} is no group")):
            with pytest.raises(CFlowError, match=complaint):
                log.sweep(index)
            with (
                pytest.raises(CFlowError, match=complaint.replace("lidar", "no"))
                if index != 1
                else pytest.raises(CFlowError, match="lidar")
            ):
                log.eval_mask(index)


@pytest.mark.parametrize(
    "value",
    [np.ones((4, 4)), np.eye(3), np.full((4, 4), np.nan), "text", np.eye(4, dtype=complex), np.zeros((4, 4), "S3")],
)
def test_extrinsics_that_are_none(value: Any, scene: Path) -> None:
    with h5py.File(scene, "r+") as opened:
        opened.attrs["ego_T_lidar"] = value
    with pytest.raises(CFlowError, match="ego_T_lidar"):
        HDF5Log(scene)


def test_categories_beyond_a_byte_do_not_wrap(scene: Path) -> None:
    replace(scene, "flow_category_indices", lambda group: group.__setitem__("flow_category_indices", [256, 1, 2, 3, 4]))
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="256"):
        log.labels(0)
    replace(scene, "flow_category_indices", lambda group: group.__setitem__("flow_category_indices", np.ones(5)))
    with HDF5Log(scene) as log, pytest.raises(CFlowError, match="float64"):
        log.labels(0)


def test_flow_of_another_shape(scene: Path) -> None:
    for shape in ((POINTS, 2), (POINTS + 1, 3), (3,), ()):
        replace(scene, "flow", lambda group, shape=shape: group.__setitem__("flow", np.zeros(shape, np.float32)))
        with HDF5Log(scene) as log, pytest.raises(CFlowError, match="flow of sweep .* has shape"):
            log.labels(0)
