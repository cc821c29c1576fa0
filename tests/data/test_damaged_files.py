"""Damaged, empty and missing files: one `CFlowError` that names the file, whichever library reads it."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import pytest
from small_logs import SMALL_LOGS, write_small_log

from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.json_file import read_json
from cflow_torch.types import CFlowError

# Parts of file names that no reader opens.
# A clone without git-lfs has these instead of large files. They are as long as ten points of a `.bin`.
POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '0'}\nsize 1234\n".ljust(160).encode()
UNREAD = r"calibration/|log_map|index_|\.png|visibility|attribute|/log\.|/map\.|_motion_|weather|stats"


def read_all(name: str, root: Path) -> None:
    for source in find_sources(name, root):
        with open_log(name, source, check=False) as log:
            for index in range(len(log)):
                log.sweep(index), log.labels(index)


@pytest.mark.parametrize("name", [name for name in SMALL_LOGS if name != "bags"])
def test_a_damaged_file_is_one_error_with_its_name(name: str, tmp_path: Path) -> None:
    root = write_small_log(name, tmp_path / name)
    found = [path for path in root.rglob("*.*") if path.is_file()]
    kinds = {(file.parent, file.stem if file.suffix == ".json" else file.suffix): file for file in found}
    for file in kinds.values():
        if re.search(UNREAD, str(file)):
            continue
        whole = file.read_bytes()
        for content in (whole[: len(whole) // 2 + 1], b"", b"a poem\n" * 99, POINTER):
            file.write_bytes(content)
            with pytest.raises(CFlowError, match=file.name + (".* is a git-lfs pointer" if content == POINTER else "")):
                read_all(name, root)
        file.unlink()
        with suppress(CFlowError):  # some files are optional
            read_all(name, root)
        file.write_bytes(whole)
    read_all(name, root)


@pytest.mark.parametrize("content", [b"[" * 200_000, '{"a": 1}'.encode("utf-16"), b'{"a": "\xff"}', b"", b"{'a': 1}"])
def test_what_is_not_json_is_refused_by_the_name_of_the_file(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(CFlowError, match="cannot read .*a.json as JSON") as error:
        read_json(file)
    assert len(str(error.value)) < 700
