"""JSON documents: what is wrong is told with the name of the file; values for messages are short."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from cflow_torch import CFlowError
from cflow_torch.data.json_file import is_whole, read_json, shown
from cflow_torch.data.paths import read_bytes


@pytest.mark.parametrize("content", [b"[" * 200_000, '{"a": 1}'.encode("utf-16"), b'{"a": "\xff"}', b"", b"{'a': 1}"])
def test_what_is_no_json_is_refused_by_the_name_of_the_file(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(CFlowError, match="cannot read .*a.json as JSON") as error:
        read_json(file)
    assert len(str(error.value)) < 700


def test_large_files_and_pipes_are_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "large.json", "wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(CFlowError, match="68157440 bytes, up to 67108864"):
        read_json(tmp_path / "large.json")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.json")
        with pytest.raises(OSError, match="device or a pipe"):
            read_bytes(tmp_path / "pipe.json")


def test_values_for_checks_and_messages() -> None:
    assert is_whole(2**63 - 1) and not is_whole(2**63) and not is_whole(True) and not is_whole(1.0)
    deep: Any = []
    for _ in range(5000):
        deep = [deep]
    assert all(len(shown(value)) <= 200 for value in (deep, "x" * 10**6, [0] * 10**6, 10**4000))
