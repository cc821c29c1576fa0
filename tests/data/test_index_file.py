"""Index files are pickles: lists of text are read, everything else is refused (see also test_nothing_runs)."""

from __future__ import annotations

import pickle

import pytest

from cflow_torch import CFlowError
from cflow_torch.data.hdf5.index_file import read_index, write_index

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


@pytest.mark.parametrize(
    "content", [{"scene": "1"}, ("a", "1"), [["a", 1]], [["a", "1", "2"]], ["ab"], [["a", "-1"]], [["a", "1" * 25]], 5]
)
def test_other_contents_are_refused(tmp_path, content):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(CFlowError, match=r"a\.pkl.*delete it"):
        read_index(tmp_path / "a.pkl")


def test_broken_files(tmp_path):
    file, whole = tmp_path / "a.pkl", pickle.dumps([["scene", "123"]] * 20)
    for content in (*(whole[:size] for size in range(len(whole))), b"\x89PNG\r\n\x1a\n", bytes(50)):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=r"a\.pkl.*delete it"):
            read_index(file)
    with pytest.raises(CFlowError, match="missing"):
        read_index(tmp_path / "missing.pkl")
