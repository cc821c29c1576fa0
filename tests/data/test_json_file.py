"""The door for JSON, and what its readers did wrong before there was one."""

from __future__ import annotations

import json
import os
import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from cflow_torch import CFlowError
from cflow_torch.cli.settings_file import plain_yaml, read_settings
from cflow_torch.data.json_file import MAX_DEPTH, is_number, is_whole, parse_json, read_json, shown
from cflow_torch.data.nuscenes import json_tables
from cflow_torch.data.paths import read_bytes

SCENE = {"token": "t", "name": "scene-0001", "log_token": "x"}


@pytest.mark.parametrize(
    "content, why",
    [
        (b"[" * 200_000, "maximum recursion"),
        (b"[" * (MAX_DEPTH + 2) + b"]" * (MAX_DEPTH + 2), "deep"),
        (b'{"a":' * 200 + b"1" + b"}" * 200, "deep"),
        (b"9" * 5000, "4300"),
        (b'{"a": 1, "b": 2, "a": 3}', "'a' stands twice"),
        (b'{"a": "\\ud800"}', "surrogate"),
        (b'{"a": "\\udc00\\ud800"}', "surrogate"),
        ('{"a": 1}'.encode("utf-16"), "utf-8"),
        (b'{"a": "\xff"}', "utf-8"),
        (b"\0", "JSON"),
        (b"", "JSON"),
        (b'{"a": "\0"}', "JSON"),
        (b"{'a': 1}", "JSON"),
    ],
)
def test_what_is_no_json_is_refused_by_the_name_of_the_file(content: bytes, why: str, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(CFlowError, match=why) as error:
        read_json(file)
    assert str(file) in str(error.value) and len(str(error.value)) < 600


def test_good_documents_are_read_as_ever(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for value in ({"a": [1, 2.5, None, True, "é\U0001f600"]}, [], "x", 10**400, [[[]]] * 3):
        for content in (json.dumps(value).encode(), json.dumps(value, ensure_ascii=False).encode("utf-8-sig")):
            file.write_bytes(content)
            assert read_json(file) == value
    assert parse_json(rb'"C:\\udata"', file) == r"C:\udata", "a backslash that stands for itself begins no surrogate"


def test_large_files_pipes_and_devices_are_not_read(tmp_path: Path) -> None:
    large = tmp_path / "large.json"
    with open(large, "wb") as file:
        file.truncate(65 << 20)
    tracemalloc.start()
    with pytest.raises(CFlowError, match="68157440 bytes, up to 67108864"):
        read_json(large)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.json")
        with pytest.raises(OSError, match="device or a pipe"):
            read_bytes(tmp_path / "pipe.json")


@pytest.mark.parametrize("piece", ["[]", "{}", '{"":{}}', "[0]", '{"":0}', "999", '"\u00e9x"', '{"":[]}'])
def test_a_document_takes_at_most_50_times_its_size(piece: str, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text(f'[{",".join([piece] * 20_000)},"\U0001f600"]', encoding="utf-8")
    tracemalloc.start()
    try:
        read_json(file)
        assert tracemalloc.get_traced_memory()[1] < 50 * file.stat().st_size
    finally:
        tracemalloc.stop()


def test_numbers_that_float64_and_int64_hold() -> None:
    assert is_number(0) and is_number(-1.5) and is_number(10**300)
    for value in (True, None, "1", float("nan"), float("inf"), 10**400, [1], 1j):
        assert not is_number(value)
    assert is_whole(2**63 - 1) and not is_whole(2**63) and not is_whole(True) and not is_whole(1.0)


def test_values_in_messages_are_short() -> None:
    deep: Any = []
    for _ in range(5000):
        deep = [deep]
    for value in (deep, "x" * 10**6, [0] * 10**6, {str(i): i for i in range(1000)}, 10**4000):
        assert len(shown(value)) <= 200


def table(folder: Path, content: bytes) -> Path:
    (folder / "scene.json").write_bytes(content)
    return folder


def test_a_table_in_pieces_is_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{**SCENE, "name": f"scene-{i}", "note": "},{" if i % 7 == 0 else "é" * (i % 5)} for i in range(100)]
    wanted = [{"token": "t", "name": row["name"]} for row in rows]
    for indent in (None, 0, 2):
        folder = table(tmp_path, json.dumps(rows, indent=indent, ensure_ascii=False).encode())
        assert json_tables.read_table(folder, "scene") == wanted
        monkeypatch.setattr(json_tables, "_BLOCK", 400)
        assert json_tables.read_table(folder, "scene") == wanted
        assert json_tables.read_table(folder, "scene", "name", {"scene-99"}) == wanted[-1:]
        monkeypatch.undo()


def test_a_hostile_table_costs_no_more_than_a_piece_of_it(tmp_path: Path) -> None:
    """Parsed at once, 3 bytes of `[],` become 64 of lists."""
    for content in (b"[" + b"[]," * 4_000_000 + b"{}]", b"[" + b"{}," * 4_000_000 + b"{}]"):
        folder = table(tmp_path, content)
        tracemalloc.start()
        with pytest.raises(CFlowError, match="row"):
            json_tables.read_table(folder, "scene")
        assert tracemalloc.get_traced_memory()[1] < len(content) + (40 << 20)
        tracemalloc.stop()


@pytest.mark.parametrize(
    "table_name, change",
    [
        ("sample", {"timestamp": 10**30}),
        ("sample", {"timestamp": True}),
        ("sample", {"token": ["t"]}),
        ("sample", {"scene_token": 5}),
        ("ego_pose", {"translation": [1e400, 0, 0]}),
        ("ego_pose", {"token": []}),
        ("sample_annotation", {"size": [10**400, 1, 1]}),
    ],
)
def test_rows_of_wrong_types(table_name: str, change: Any, tmp_path: Path) -> None:
    good = {"token": "t", "timestamp": 1, "scene_token": "s", "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
    row = {**good, "size": [1, 1, 1], "sample_token": "s", "instance_token": "i", **change}
    (tmp_path / f"{table_name}.json").write_text(json.dumps([row]))
    with pytest.raises(CFlowError, match=f"{table_name}.json: the field {next(iter(change))} of a row is"):
        json_tables.read_table(tmp_path, table_name, *(("token", {"t"}) if table_name == "ego_pose" else ()))


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(12)
)


@pytest.mark.parametrize(
    "text, why",
    [
        (BOMB, "tag, an anchor or an alias"),
        ("a: !!python/object/apply:os.getcwd []", "tag"),
        ("a: !!set {x}", "tag"),
        ("a: " + "[" * 100 + "]" * 100, "deep"),
        ("- 1", "list"),
        ("a: [", "settings"),
        ("a: 2024-13-45", "month"),
        ("a: " + "9" * 5000, "limit|settings"),
        ("\0", "settings"),
        ("a: " + "x" * (1 << 17), "bytes"),
    ],
)
def test_settings_of_an_earlier_run_are_plain_values(text: str, why: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    if text.endswith("9" * 5000) and not hasattr(int, "bit_count"):  # old Pythons take such a number
        pytest.skip("this Python has no limit of digits")
    with pytest.raises(CFlowError, match=why):
        read_settings(file)


def test_settings_are_read_back(tmp_path: Path) -> None:
    from omegaconf import OmegaConf

    values = {"a": [1, 2.5, -float("inf"), None, True], "b": {"c": "1e5", "d": "${oc.env:HOME}"}, "e": ""}
    file = tmp_path / "config.yaml"
    file.write_text(OmegaConf.to_yaml(OmegaConf.create(values)))
    assert read_settings(file) == values
    assert plain_yaml("a: ${oc.env:HOME}") == {"a": "${oc.env:HOME}"}, "nothing is looked up"


def test_a_key_that_stands_twice_is_found_in_linear_time(tmp_path: Path) -> None:
    names = [*range(30_000), 29_999]
    (tmp_path / "a.json").write_text("{" + ", ".join(f'"{name}": 0' for name in names) + "}")
    begin = time.process_time()
    with pytest.raises(CFlowError, match="'29999' stands twice"):
        read_json(tmp_path / "a.json")
    assert time.process_time() - begin < 2  # one by one it took 8 s
