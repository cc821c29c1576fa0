"""What a run asks of the machine: no network, no program but those that tell facts, no file but in its own folders."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

WATCHED = """
import json, os, sys
seen = []
def hook(event, args):
    if event.startswith("socket.") and event not in ("socket.__new__", "socket.gethostname"):
        if not (event == "socket.bind" and args[1][0] == "::1"):  # a library that asks whether there is IPv6
            seen.append([event, repr(args[1:])])
    elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.startfile"):
        seen.append([event, repr(args)])
    elif event == "open" and isinstance(args[0], (str, bytes, os.PathLike)):
        if (args[2] or 0) & (os.O_WRONLY | os.O_RDWR):
            seen.append(["write", os.path.abspath(os.fsdecode(args[0]))])
    elif event in ("os.remove", "os.rename", "os.rmdir", "shutil.rmtree", "os.mkdir", "os.link", "os.symlink"):
        seen.extend(["write", os.path.abspath(os.fsdecode(each))] for each in args if isinstance(each, (str, bytes)))
    elif event == "pickle.find_class":
        seen.append([event, repr(args)])
sys.addaudithook(hook)
sys.argv = ["cflow", *sys.argv[2:]]
try:
    from cflow_torch.cli.main import main
    code = main()
finally:
    with open(os.environ["SEEN"], "w") as file:
        json.dump(seen, file)
sys.exit(code)
"""
STREET = ("data.num_sweeps=2", "model=fast")
COMMANDS: dict[str, list[str]] = {
    "demo": ["demo", "data.num_sweeps=5", "output=made/out", "data.cache=made/cache"],
    "flow": ["flow", *STREET, "engine.workers=1", "output=made/out", "data.cache=made/cache"],
    "eval": ["eval", *STREET, "output=made/out", "data.cache=made/cache"],
    "info": ["info"],
}


@pytest.mark.parametrize("name", ["eval", *(pytest.param(n, marks=pytest.mark.slow) for n in ("demo", "flow", "info"))])
def test_a_command_stays_in_its_folders(name: str, tmp_path: Path) -> None:
    for folder in ("home", "work", "temporary"):
        (tmp_path / folder).mkdir()
    environment: dict[str, Any] = {
        **os.environ,
        "HOME": str(tmp_path / "home"),
        "TMPDIR": str(tmp_path / "temporary"),
        "SEEN": str(tmp_path / "seen.json"),
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    ran = subprocess.run(
        [sys.executable, "-c", WATCHED, "--", *COMMANDS[name]],
        cwd=tmp_path / "work",
        env=environment,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    seen = json.loads((tmp_path / "seen.json").read_text())
    own = [str(tmp_path / "work" / "made"), str(tmp_path / "temporary"), str(tmp_path / "home"), os.devnull]
    folders = tuple(folder + os.sep for folder in own)
    own += [str(tmp_path / "seen.json"), str(tmp_path / "work")]  # the folder itself: "made, unless it is there"
    strange = [each for each in seen if each[0] != "write" or not (each[1] in own or each[1].startswith(folders))]
    assert [each for each in strange if each[0] not in ("subprocess.Popen", "os.posix_spawn")] == []
    programs = {Path(each[1].split("'")[1]).name for each in strange}
    # Our version in a checkout; Python's platform; matplotlib's fonts; libraries that torch 2.15 looks for.
    allowed = {"git", "uname", "fc-list", "ldconfig"}
    if name == "info":  # torch's report of the machine asks compilers, drivers and pip
        allowed |= {"sh", Path(sys.executable).name, "python"}
    assert programs <= allowed
    assert [path.name for path in (tmp_path / "work").iterdir()] == ([] if name == "info" else ["made"])
    assert list((tmp_path / "temporary").iterdir()) == []
