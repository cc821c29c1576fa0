#!/usr/bin/env python3
"""Build the wheel of the last commit, install it in an environment, run its commands, and run the tests there.

  python scripts/check_environments.py old --python /path/to/python3.8
  python scripts/check_environments.py new --python /path/to/python3.13
  python scripts/check_environments.py wheel --python /path/to/python3.11

old: the versions of constraints_old.txt (torch 2.0.1, numpy 1.24, kornia 0.7.3), for Python 3.8.
new: the newest versions that pip finds, for Python 3.13.
wheel: an empty environment in which pip installs the wheel and what it needs. Only the commands run, no tests.

Commands and tests run in folders without the package, so that only the wheel can be imported. Real data is read from
$CFLOW_DATA, else from the folder ../shared/data next to the checkout. An environment needs about 6 GB, because pip may
find torch with CUDA only; PIP_CONSTRAINT names a file of versions. The exit status is that of pytest.
outputs/environments/NAME/freeze.txt lists the installed versions.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
INSTALL = {
    "old": ["--constraint", ROOT / "scripts" / "constraints_old.txt"],
    "new": ["--upgrade", "--upgrade-strategy", "eager"],
    "wheel": [],
}
EXTRAS = {"old": "test", "new": "test", "wheel": "viz,html"}
# What a first visitor runs, and the files that it leaves in outputs.
COMMANDS = {
    "--help": (),
    "info": (),
    "demo": ("demo/flow.png", "demo/*/*.feather"),
    "flow data.num_sweeps=3 engine.workers=1": ("flow/*/*.feather",),
    "plot": ("plot/flow.png",),
    "view count=1": ("view/*.html",),
}


def main() -> int:
    """Check one environment; returns the exit status of the tests."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=sorted(INSTALL))
    parser.add_argument("--python", required=True, help="interpreter of the environment")
    given = parser.parse_args()
    home = ROOT / "outputs" / "environments" / given.name
    home.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="cflow-check-") as temporary:
        source = Path(temporary) / "source"
        run("git", "clone", "--quiet", "--depth", "1", ROOT.as_uri(), source)
        run(sys.executable, "-m", "build", "--outdir", Path(temporary) / "dist", source)
        (wheel,) = (Path(temporary) / "dist").glob("*.whl")
        python = install(given.name, given.python, home, wheel)
        run_commands(python, Path(temporary))
        if given.name == "wheel":
            return 0
        for name in ("cflow_torch", "configs"):  # so that the tests can only import the wheel
            shutil.rmtree(source / name)
        of_checkout = ("tests/test_distribution.py", "tests/scripts/test_harness_models.py")
        tests = ["tests", "-m", "not slow", *(f"--ignore={file}" for file in of_checkout)]
        return subprocess.run([python, "-m", "pytest", *tests], cwd=source, env=environment()).returncode


def install(name: str, base: str, home: Path, wheel: Path) -> Path:
    """Make the virtual environment if it does not exist, and install the wheel; returns the interpreter."""
    python = home / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.is_file():
        run(base, "-m", "venv", home / "venv")
    pip = (python, "-m", "pip", "--disable-pip-version-check", "-qq")
    run(*pip, "uninstall", "--yes", "cflow_torch")  # pip keeps an installed one of the same version
    run(*pip, "install", *INSTALL[name], f"{wheel}[{EXTRAS[name]}]")
    run(*pip, "check")
    versions = subprocess.check_output([*pip, "freeze", "--all"], text=True, env=environment())
    (home / "freeze.txt").write_text(versions, encoding="utf-8")
    return python


def run_commands(python: Path, folder: Path) -> None:
    """Run the commands of a first visit in an empty folder, and check that each writes its file."""
    home = folder / "home"
    home.mkdir()
    for command, files in COMMANDS.items():
        if command.startswith("view") and subprocess.run([python, "-c", "import k3d"], env=environment()).returncode:
            print("skipped: cflow view, because k3d needs Python 3.9")
            continue
        run(shutil.which("cflow", path=str(python.parent)), *command.split(), cwd=home)
        missing = [name for name in files if not list(home.glob(f"outputs/{name}"))]
        if missing:
            sys.exit(f"error: cflow {command} did not write {', '.join(missing)}")


def environment() -> dict[str, str]:
    """The variables of this process without those that could import another cflow_torch."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    data = Path(os.environ.get("CFLOW_DATA") or ROOT.parent / "shared" / "data").resolve()
    return {"OMP_NUM_THREADS": "1", **kept, "PYTHONNOUSERSITE": "1", "CFLOW_DATA": str(data)}


def run(*command: object, cwd: Path | None = None) -> None:
    """Run a command that must succeed, and show its output."""
    print("$", *command, flush=True)
    subprocess.run([str(part) for part in command], check=True, cwd=cwd, env=environment())


if __name__ == "__main__":
    sys.exit(main())
