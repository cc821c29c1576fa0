"""Scenes of HDF5 that are well formed outside and hostile inside."""

from __future__ import annotations

import io
import random
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Dict, Sequence, Tuple

import numpy as np

POINTS = 5
STAMPS = (10**18, 10**18 + 10**8)
KEYS = ("lidar", "pose", "ground_mask", "flow", "flow_is_valid", "flow_category_indices", "eval_mask", "mine")
FOREIGN = np.float32(12345)  # value of everything outside the scene
_HUGE = (10**12, 2**31, 2**32 - 1, 2**40)


def sweep_values(index: int) -> Dict[str, np.ndarray]:
    """Key -> value of one whole sweep."""
    rng = np.random.default_rng(index)
    values = {
        "lidar": rng.uniform(-5, 5, (POINTS, 4)).astype(np.float32),
        "pose": np.eye(4, dtype=np.float64 if index else np.float32),
        "ground_mask": rng.random(POINTS) < 0.3,
    }
    labels = {
        "flow": rng.normal(size=(POINTS, 3)).astype(np.float32),
        "flow_is_valid": rng.random(POINTS) < 0.9,
        "flow_category_indices": rng.integers(-1, 30, POINTS).astype(np.int8),
        "eval_mask": rng.random((POINTS, 1)) < 0.5,
    }
    return values if index else {**values, **labels}


def scene_image(
    chance: random.Random,
    libver: str,
    wounds: Sequence[Callable[..., None]] = (),
    results: int = 0,
    **storage: Any,
) -> bytes:
    """A scene of two sweeps, as bytes.

    Args:
        chance: of the wounds.
        libver: "earliest" or "latest" version of the format.
        wounds: what is made hostile in it, in this order.
        results: how many keys `mine`, as a method leaves them, its sweeps have.
        storage: settings of h5py for the larger datasets; maxshape=True is without limit.
    """
    import h5py

    written = io.BytesIO()  # an image in memory, h5py's other way, has a wrong checksum in newer formats (HDF5 1.14)
    with h5py.File(written, "w", libver=libver) as scene:
        scene.attrs["ego_T_lidar"] = np.eye(4)
        for index, stamp in enumerate(STAMPS):
            group = scene.create_group(str(stamp))
            for key, value in sweep_values(index).items():
                how = dict(storage)
                if how.pop("maxshape", False):
                    how["maxshape"] = (None,) * value.ndim
                group.create_dataset(key, data=value, **(how if key != "pose" else {}))
            if results:
                group.create_dataset("mine", data=np.zeros((POINTS, 3), np.float32))
        for wound in wounds:
            with suppress(KeyError, ValueError, RuntimeError, OSError, TypeError):  # it does not go with those before
                wound(scene, chance)
    return written.getvalue()


def write_outside(folder: Path) -> None:
    """What no scene may reach: a whole scene beside it, and a file of raw numbers."""
    import h5py

    with h5py.File(folder / "outside.h5", "w") as scene:
        for index, stamp in enumerate(STAMPS):
            for key, value in sweep_values(index).items():
                scene[f"{stamp}/{key}"] = np.full_like(value, FOREIGN) if key in ("lidar", "flow") else value
            scene[f"{stamp}/mine"] = np.full((POINTS, 3), FOREIGN)
    np.full(1000, FOREIGN).tofile(folder / "outside.raw")


def _place(scene: Any, chance: random.Random) -> Tuple[Any, str]:
    """A sweep and a key of it, which is taken out."""
    group, key = scene[str(chance.choice(STAMPS))], chance.choice(KEYS)
    if key in group:
        del group[key]
    return group, key


def _shape(key: str) -> Tuple[int, ...]:
    return sweep_values(0)[key].shape if key != "mine" else (POINTS, 3)


def _type(scene: Any, chance: random.Random) -> None:
    import h5py

    group, key = _place(scene, chance)
    types = (
        *(
            "f2",
            ">f4",
            ">f8",
            "f8",
            "u8",
            "i8",
            ">i2",
            "?",
            "c8",
            "c16",
            "S4",
            "V7",
            np.longdouble,
            h5py.string_dtype(),
        ),
        *(h5py.ref_dtype, h5py.regionref_dtype, h5py.vlen_dtype(np.float32), h5py.enum_dtype({"a": 1, "b": 2})),
        *(
            [("a", "f4"), ("b", "S2")],
            [("a", [("b", [("c", "f4")])])],
            ("f4", (3,)),
            h5py.opaque_dtype(np.dtype("M8[s]")),
        ),
    )
    group.create_dataset(key, _shape(key), chance.choice(types))


def _claim(scene: Any, chance: random.Random) -> None:
    group, key = _place(scene, chance)
    size = chance.choice(_HUGE)
    shape = chance.choice(((size, 4), (size,), (POINTS, size), (size // 8, 3), (2**20, 4), (0, 4), (0,), (1,) * 32, ()))
    chunks = chance.choice((None, True, tuple(min(side, 1 << 20) or 1 for side in shape)))
    group.create_dataset(key, shape, chance.choice(("f4", "u1", "f8")), chunks=chunks, fillvalue=chance.choice((0, 1)))


def _chunks(scene: Any, chance: random.Random) -> None:
    group, key = _place(scene, chance)
    shape = tuple(chance.choice((side, 1, 100)) for side in _shape(key))
    packed = chance.choice(
        (
            *({}, {"compression": "gzip"}, {"compression": "gzip", "shuffle": True}, {"compression": "lzf"}),
            *({"fletcher32": True}, {"scaleoffset": 2}, {"compression": "gzip", "fletcher32": True}),
        )
    )
    chunks = tuple(chance.choice((side, 1, max(side // 2, 1))) for side in shape)
    how = {"maxshape": chance.choice((None, (None,) * len(shape)))}
    group.create_dataset(key, data=np.ones(shape, chance.choice(("f4", "f8", "u1"))), chunks=chunks, **packed, **how)


def _bomb(scene: Any, chance: random.Random) -> None:
    group, key = _place(scene, chance)
    shape, size = _shape(key), chance.choice((0, 3, 10**6))
    made = group.create_dataset(key, shape, "f4", chunks=shape, compression="gzip")
    data = chance.choice((zlib.compress(bytes(size)), zlib.compress(bytes(size))[:-3], bytes(size // 100), b""))
    made.id.write_direct_chunk((0,) * len(shape), data, filter_mask=chance.choice((0, 0, 1, 2**31)))


def _link(scene: Any, chance: random.Random) -> None:
    import h5py

    group, key = _place(scene, chance)
    stamp = str(STAMPS[0])
    to = chance.choice(
        (
            *(
                h5py.ExternalLink("outside.h5", f"{stamp}/{key}"),
                h5py.ExternalLink("/dev/null", "/"),
                h5py.SoftLink("/"),
            ),
            *(h5py.SoftLink(f"/{STAMPS[1]}/{key}"), h5py.SoftLink(f"{group.name}/{key}"), h5py.SoftLink("nowhere")),
        )
    )
    if chance.random() < 0.3:
        del scene[stamp]
        scene[stamp] = chance.choice(
            (h5py.ExternalLink("outside.h5", stamp), h5py.SoftLink(str(STAMPS[1])), scene["/"])
        )
    else:
        group[key] = chance.choice((to, to, scene["/"], group, np.dtype("f4")))


def _elsewhere(scene: Any, chance: random.Random) -> None:
    import h5py

    group, key = _place(scene, chance)
    shape = _shape(key)
    if chance.random() < 0.5:
        group.create_dataset(key, shape, "f4", external=[("outside.raw", 0, 4000)])
        return
    layout = h5py.VirtualLayout(shape, "f4")
    layout[...] = h5py.VirtualSource(chance.choice(("outside.h5", ".")), f"{STAMPS[0]}/{key}", shape)
    group.create_virtual_dataset(key, layout, fillvalue=-1)


def _name(scene: Any, chance: random.Random) -> None:
    raw = (
        b"7",
        b"007",
        b"9" * 20,
        b"9" * 5000,
        b"\xc2\xb2",
        b"\xd9\xa1\xd9\xa2",
        b"\xff\xfe",
        b"..",
        b" ",
        b"-1",
        b"1" * 60000,
    )
    where = chance.choice((scene, scene[str(STAMPS[0])]))
    where.id.links.create_soft(chance.choice(raw), b"/") if chance.random() < 0.3 else _group(where, chance.choice(raw))


def _group(where: Any, name: bytes) -> None:
    import h5py

    h5py.h5g.create(where.id, name)


def _many(scene: Any, chance: random.Random) -> None:
    where = chance.choice((scene, scene[str(STAMPS[0])]))
    for number in range(chance.choice((10, 100))):
        _group(where, b"%d" % (number + chance.choice((0, 10**18))))


def _attribute(scene: Any, chance: random.Random) -> None:
    import h5py

    values = (np.ones((4, 4)), np.eye(4)[:3], np.full((4, 4), np.nan), "text", b"\xff", np.zeros(0), h5py.Empty("f8"))
    more = (
        np.eye(4, dtype=complex),
        np.eye(4, dtype=">f4"),
        np.eye(4, dtype="?"),
        np.zeros((4, 4), "S3"),
        scene.ref,
        1,
    )
    scene.attrs["ego_T_lidar"] = chance.choice(values + more)


def _values(scene: Any, chance: random.Random) -> None:
    group, key = _place(scene, chance)
    number = chance.choice((np.nan, np.inf, 1e300, -1e300, 2**63, 300, -5, 0))
    group[key] = np.full(_shape(key), number, chance.choice(("f4", "f8")))


def _alias(scene: Any, chance: random.Random) -> None:
    group, key = _place(scene, chance)
    group[key] = group[chance.choice([name for name in KEYS if name in group])]


WOUNDS = (
    _type,
    _claim,
    _chunks,
    _bomb,
    _link,
    _link,
    _elsewhere,
    _elsewhere,
    _name,
    _many,
    _attribute,
    _values,
    _alias,
)
