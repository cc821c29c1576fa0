"""JSON documents: what is wrong is told with the name of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from cflow_torch import CFlowError
from cflow_torch.data.json_file import read_json


@pytest.mark.parametrize("content", [b"[" * 200_000, '{"a": 1}'.encode("utf-16"), b'{"a": "\xff"}', b"", b"{'a': 1}"])
def test_what_is_no_json_is_refused_by_the_name_of_the_file(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(CFlowError, match="cannot read .*a.json as JSON") as error:
        read_json(file)
    assert len(str(error.value)) < 700
