"""The lists of what the two commands install are whole and of today's pins; a file that is not listed is refused."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import Dict, List

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOCKED = ROOT / "scripts" / "locked"
LISTS = sorted(LOCKED.glob("*.txt"))


def _entries(file: Path) -> Dict[str, List[str]]:
    """Name and version of each package of a list -> its hashes."""
    whole = file.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in whole.splitlines() if not line.startswith("#")]
    return {line.split(" ")[0]: re.findall(r"--hash=sha256:([0-9a-f]{64})(?![0-9a-f])", line) for line in lines}


def _pins() -> List[str]:
    text = (ROOT / "scripts" / "constraints.txt").read_text(encoding="utf-8")
    lines = [line.split("#")[0].split(";")[0].strip() for line in text.splitlines()]
    return [re.sub(r"[-_.]+", "-", line.split("==")[0]).lower() + "==" + line.split("==")[1] for line in lines if line]


def test_all_lists_are_there() -> None:
    assert [file.stem for file in LISTS] == ["build", "cpu", "cuda", "demo", "test"]


@pytest.mark.parametrize("file", LISTS, ids=[file.stem for file in LISTS])
def test_a_list_is_of_today_s_pins(file: Path) -> None:
    """Else: python scripts/lock.py, where PyPI can be reached."""
    sources = (ROOT / "scripts" / "constraints.txt", ROOT / "pyproject.toml")
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    assert f"scripts/lock.py from {digest}" in file.read_text(encoding="utf-8")
    entries = _entries(file)
    assert entries and all(entries.values()), "a package without a hash"
    assert {entry.replace("+cpu", "") for entry in entries} <= set(_pins())


def test_every_package_of_this_environment_is_listed() -> None:
    """In the environment that ./scripts/test.sh made, nothing came from elsewhere."""
    if Path(sys.prefix) != ROOT / ".venv":
        pytest.skip("this is not the environment that ./scripts/test.sh makes")
    from importlib.metadata import distributions

    listed = {entry.split("==")[0] for file in LISTS for entry in _entries(file)}
    there = {
        re.sub(r"[-_.]+", "-", each.metadata["Name"]).lower()
        for each in distributions(path=[sysconfig.get_path("purelib")])
    }
    assert there - listed == {"cflow-torch", "pip"}


def _wheel(folder: Path, content: str) -> Path:
    wheel = folder / "pinned_thing-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("pinned_thing.py", content)
        about = "Metadata-Version: 2.1\nName: pinned-thing\nVersion: 1.0\n"
        archive.writestr("pinned_thing-1.0.dist-info/METADATA", about)
        kind = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        archive.writestr("pinned_thing-1.0.dist-info/WHEEL", kind)
        archive.writestr("pinned_thing-1.0.dist-info/RECORD", "")
    return wheel


@pytest.mark.parametrize("tampered", [False, True])
def test_a_file_with_another_hash_is_not_installed(tampered: bool, tmp_path: Path) -> None:
    """The options that install.sh gives pip."""
    options = re.search(r"^  install=\(.* -m pip install (.*)\)$", (ROOT / "scripts" / "install.sh").read_text(), re.M)
    assert options is not None
    wheel = _wheel(tmp_path, "x = 1")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    (tmp_path / "list.txt").write_text(f"pinned-thing==1.0 --hash=sha256:{digest}\n")
    if tampered:
        _wheel(tmp_path, "x = 2")
    ran = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options.group(1).split(), "--require-hashes", "--no-index"]
        + ["--find-links", str(tmp_path), "--target", str(tmp_path / "there"), "-r", str(tmp_path / "list.txt")],
        env={key: value for key, value in os.environ.items() if not key.startswith("PIP_")},
        capture_output=True,
        text=True,
    )
    assert (tmp_path / "there" / "pinned_thing.py").exists() is not tampered
    assert (ran.returncode != 0) is tampered, ran.stderr
    assert ("DO NOT MATCH THE HASHES" in ran.stderr) is tampered
