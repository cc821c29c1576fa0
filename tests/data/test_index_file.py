"""Index files are pickles: lists of text are read, everything else is refused before it can do anything."""

from __future__ import annotations

import collections
import io
import os
import pickle
import struct
import tracemalloc
from pathlib import Path

import pytest

from cflow_torch import CFlowError
from cflow_torch.data.hdf5 import index_file
from cflow_torch.data.hdf5.index_file import MAX_BYTES, _NoNames, read_index, write_index

ENTRIES = [("scene-a", 315966265259836000), ("scene-a", 315966265360032000), ("b", 1)]


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize("kind", [list, tuple])
def test_every_protocol_is_read(tmp_path, protocol, kind):
    file = tmp_path / "index_total.pkl"
    file.write_bytes(pickle.dumps([kind((scene, str(stamp))) for scene, stamp in ENTRIES], protocol=protocol))
    assert read_index(file) == ENTRIES


def test_what_is_written_is_what_the_harness_reads(tmp_path):
    file = tmp_path / "index_eval.pkl"
    write_index(file, ENTRIES)
    assert pickle.loads(file.read_bytes()) == [[scene, str(stamp)] for scene, stamp in ENTRIES]
    assert read_index(file) == ENTRIES
    write_index(file, ENTRIES[:1])
    assert read_index(file) == ENTRIES[:1], "a changed file is read again"


class Bomb:
    """Unpickling this makes a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


@pytest.mark.parametrize("protocol", range(5))
def test_a_malicious_pickle_does_nothing(tmp_path, protocol):
    target = tmp_path / "proof"
    for k, content in enumerate(([["a", "1"], Bomb(target)], [["a", Bomb(target)]], Bomb(target))):
        file = tmp_path / f"{k}.pkl"
        file.write_bytes(pickle.dumps(content, protocol=protocol))
        with pytest.raises(CFlowError, match="instruction"):
            read_index(file)
        with pytest.raises(pickle.UnpicklingError, match="mkdir"):  # the second lock holds alone
            _NoNames(io.BytesIO(file.read_bytes())).load()
        assert not target.exists()
    pickle.loads((tmp_path / "0.pkl").read_bytes())
    assert target.exists(), "the bomb is a real one"


def test_bombs_by_hand(tmp_path):
    target = tmp_path / "proof"
    name = str(target).encode()
    streams = {
        "inst": b"(S'" + name + b"'\nios\nmkdir\n.",
        "global": b"cos\nmkdir\n(S'" + name + b"'\ntR.",
        "build": b"]}b.",
        "persistent": b"Pany\n.",
        "extension": b"\x82\x01.",
        "memory": b"\x80\x02]r\xff\xff\xff\xff.",
        "long": b"\x80\x02\x8b" + struct.pack("<i", -1) + b".",
    }
    for what, stream in streams.items():
        (tmp_path / "a.pkl").write_bytes(stream)
        with pytest.raises(CFlowError, match=r"a\.pkl") as raised:
            read_index(tmp_path / "a.pkl")
        assert "delete it" in str(raised.value), what
        assert not target.exists()


@pytest.mark.parametrize(
    "content",
    [
        {"scene": "1"},
        ("a", "1"),
        [["a", 1]],
        [["a", "1", "2"]],
        [["a"]],
        ["ab"],
        [["a", "1.5"]],
        [["a", "-1"]],
        [["a", "1" * 25]],
        [["a", ["1"]]],
        "text",
        [["a", b"1"]],
        [["a", None]],
        collections.OrderedDict(),
    ],
)
def test_other_contents_are_refused(tmp_path, content):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(CFlowError, match=r"a\.pkl"):
        read_index(tmp_path / "a.pkl")


def test_broken_files(tmp_path):
    file = tmp_path / "a.pkl"
    whole = pickle.dumps([["scene", "123"]] * 20)
    for size in range(len(whole)):
        file.write_bytes(whole[:size])
        with pytest.raises(CFlowError, match=r"a\.pkl"):
            read_index(file)
    loop: list = []
    loop.append(loop)
    for content in (b"\x89PNG\r\n\x1a\n", bytes(50), pickle.dumps(loop), b"\x80\x04" * 30 + b"."):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=r"a\.pkl"):
            read_index(file)
    with pytest.raises(CFlowError, match="missing"):
        read_index(tmp_path / "missing.pkl")


def test_bombs_of_size_and_reference(tmp_path, monkeypatch):
    """Doubled references, deep nesting, claims of sizes: nothing is made of them that is larger than the file."""
    monkeypatch.setattr(index_file, "MAX_INSTRUCTIONS", 100_000)
    text, claim = b"\x8c\x01a", (1 << 31) - 1
    doubled = b"".join(b"h%ch%c\x86q%c" % (k, k, k + 1) for k in range(200))
    streams = {
        "doubled tuples": b"\x80\x02](" + text + b"q\0" + doubled + b"e.",
        "list of itself": b"]q\0(h\0h\0e.",
        "deep": b"]" * 40_000 + b"a" * 39_999 + b".",
        "text": b"](X" + struct.pack("<I", claim) + b"ae.",
        "long text": b"](\x8d" + struct.pack("<Q", 1 << 62) + b"ae.",
        "integer": b"](\x8b" + struct.pack("<i", claim) + b"\x01e.",
        "frame": b"\x80\x04\x95" + struct.pack("<Q", (1 << 63) - 1) + b"].",
        "many instructions": b"](" + b"]0" * 50_000 + b"e.",
        "large": b"](" + b"0" * MAX_BYTES,
    }
    for what, stream in streams.items():
        (tmp_path / "a.pkl").write_bytes(stream)
        tracemalloc.start()
        with pytest.raises(CFlowError, match=r"a\.pkl"):
            read_index(tmp_path / "a.pkl")
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < 2 * len(stream) + (60 << 20), what


def test_entries_that_share_their_parts_are_read(tmp_path):
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02](\x8c\x01a\x8c\x017\x86q\0" + b"h\0" * 1000 + b"e.")
    assert read_index(tmp_path / "a.pkl") == [("a", 7)] * 1001
