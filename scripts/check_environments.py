#!/usr/bin/env python3
"""Does the wheel work in the oldest and in the newest environment?

  python scripts/check_environments.py old new
  PYTHON_OLD=/path/to/python3.8 python scripts/check_environments.py old --folder ~/environments

old: Python 3.8 with the versions of constraints_old.txt (torch 2.0.1, numpy 1.24, kornia 0.7.3: OpenSceneFlow's time).
new: Python 3.13 with the newest of everything that pip finds.

For each: make a virtual environment, build the wheel from a clean copy of the commit, install that wheel with its
[test] extra, and run the tests in a temporary folder where nothing but the wheel can be imported as cflow_torch. "core"
is all that is not slow, "harness" the miniature OpenSceneFlow, slow ones too. The real data are taken from $CFLOW_DATA,
else from ../shared/data beside the checkout. Needs about 6 GB for each: pip may find torch with CUDA only.

Prints a table, writes it with every failure and the reasons of skipped tests to FOLDER/environments.json, and each
environment's exact versions to FOLDER/NAME/freeze.txt. Exit status: 0 if nothing failed, 1 if something did, 2 if it
could not start.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("torch", "numpy", "kornia", "h5py", "hydra-core")  # the columns of the table
COPIED = ("tests", "scripts", "pyproject.toml")  # beside the tests: what they start, and pytest's settings
HARNESS = "test_opensceneflow*.py"
# Tests that need more of the checkout than COPIED, and why: left out here.
NEED_CHECKOUT: Dict[str, str] = {
    "tests/test_docs_links.py": "reads the documents",
    "tests/test_docs_names.py": "reads the documents",
    "tests/test_docs_trust.py": "reads the documents",
    "tests/test_faq.py": "reads the documents",
    "tests/test_failure_cases.py::test_every_case_and_picture_is_on_the_page": "reads the documents",
    "tests/test_config_reference.py": "reads the documents and the folder configs",
    "tests/test_notebooks.py": "runs the notebooks",
    "tests/test_hubconf.py": "loads the checkout",
    "tests/test_conventions.py::test_every_line_names_tests_that_exist": "reads the documents",
    "tests/test_conventions.py::test_every_test_here_is_named_by_a_line": "reads the documents",
}

VERSIONS_CODE = """
import importlib.metadata, json, platform, sys
print(json.dumps({"python": platform.python_version(), **{p: importlib.metadata.version(p) for p in sys.argv[1:]}}))
"""
INSTALLED_CODE = """
import pathlib, sysconfig, cflow_torch, cflow_torch.configs
site = pathlib.Path(sysconfig.get_paths()["purelib"]).resolve()
for module in (cflow_torch, cflow_torch.configs):
    assert site in pathlib.Path(module.__file__).resolve().parents, f"{module.__file__} is not in {site}"
"""


class Environment(NamedTuple):
    """Which Python, and what pip is told beside the wheel itself."""

    version: str
    pip: Tuple[str, ...]

    def variable(self, name: str) -> str:
        return f"PYTHON_{name.upper()}"


ENVIRONMENTS = {
    "old": Environment("3.8", ("--constraint", str(ROOT / "scripts" / "constraints_old.txt"))),
    "new": Environment("3.13", ("--upgrade", "--upgrade-strategy", "eager")),
}


class CheckError(Exception):
    """A step before the tests went wrong; the message says which."""


def find_python(name: str) -> str:
    """The interpreter named by PYTHON_OLD or PYTHON_NEW, else pythonX.Y on PATH, else one of pyenv's."""
    version, variable = ENVIRONMENTS[name].version, ENVIRONMENTS[name].variable(name)
    if variable in os.environ:
        candidates = [os.environ[variable]]
    else:
        pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
        candidates = [f"python{version}", *map(str, sorted(pyenv.glob(f"versions/{version}.*/bin/python")))]
    for candidate in candidates:
        # Asked, not only looked up: pyenv's shims are on PATH for versions that they then refuse to start.
        command = [candidate, "-c", "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"]
        try:
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        except OSError:
            continue
        if done.returncode == 0 and done.stdout.strip() == version:
            return candidate
    raise CheckError(
        f"no Python {version} with venv among {candidates}: install it (pyenv install {version}, uv python install "
        f"{version}, or the system's package python{version}-venv) and set {variable} to the executable"
    )


def clean_environ() -> Dict[str, str]:
    """This process's variables without those by which another cflow_torch could be imported."""
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    environ["PYTHONNOUSERSITE"] = "1"
    environ.setdefault("OMP_NUM_THREADS", "1")
    data = Path(os.environ.get("CFLOW_DATA") or ROOT.parent / "shared" / "data").resolve()
    if data.is_dir():
        environ["CFLOW_DATA"] = str(data)
    return environ


def run(*command: object, cwd: Path) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run(
        [str(c) for c in command], cwd=str(cwd), env=clean_environ(), stdout=subprocess.PIPE, text=True
    )
    if done.returncode != 0:
        raise CheckError(f"exit status {done.returncode}: {' '.join(map(str, command))}\n{done.stdout}")
    return done.stdout


def copy_checkout(commit: str, folder: Path) -> None:
    """The files of a commit, or ("" for commit) all files of the working tree that git does not ignore."""
    if commit:
        archive = folder.with_suffix(".tar")
        run("git", "archive", "--output", archive, commit, cwd=ROOT)
        shutil.unpack_archive(str(archive), str(folder))
        return
    listed = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():  # else deleted, and the deletion not committed
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(str(ROOT / name), str(folder / name))


def install(name: str, home: Path, source: Path) -> Path:
    """Make the virtual environment if it is not there, build the wheel and install it; returns the interpreter."""
    python = home / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.is_file():
        run(find_python(name), "-m", "venv", home / "venv", cwd=home)
    pip = (python, "-m", "pip", "--disable-pip-version-check", "-qq")
    wheels = source.parent / f"wheel-{name}"
    built = source.parent / f"source-{name}"  # its own copy: the build leaves a folder build/ behind
    shutil.copytree(str(source), str(built))
    run(*pip, "wheel", "--no-deps", "--wheel-dir", wheels, built, cwd=home)
    (wheel,) = wheels.glob("*.whl")
    run(*pip, "uninstall", "--yes", "cflow_torch", cwd=home)  # pip keeps an installed one of the same version
    run(*pip, "install", *ENVIRONMENTS[name].pip, f"{wheel}[test]", cwd=home)
    run(*pip, "check", cwd=home)
    (home / "freeze.txt").write_text(run(*pip, "freeze", "--all", cwd=home), encoding="utf-8")
    return python


def read_report(file: Path) -> Dict[str, Any]:
    """Counts, failed tests with the first line of their message, and skip reasons of a JUnit report."""
    counts = {"passed": 0, "failed": 0, "skipped": 0}
    failures: List[str] = []
    reasons: Counter[str] = Counter()
    for case in ElementTree.parse(str(file)).iter("testcase"):
        wrong = [child for child in case if child.tag in ("failure", "error")]
        skipped = case.find("skipped")
        if wrong:
            message = (wrong[0].get("message") or "").strip().split("\n")[0]
            test = "::".join(filter(None, (case.get("classname"), case.get("name"))))  # a module has no class name
            failures.append(f"{test}: {message}")
        elif skipped is not None:
            reasons[skipped.get("message") or ""] += 1
        counts["failed" if wrong else "passed" if skipped is None else "skipped"] += 1
    return {**counts, "failures": failures, "skip_reasons": dict(reasons.most_common())}


def run_tests(python: Path, source: Path, folder: Path, chosen: str) -> Dict[str, Optional[Dict[str, Any]]]:
    """Run both suites in a folder that holds the tests and no package; None for a suite without a file."""
    folder.mkdir()
    for name in COPIED:
        (shutil.copytree if (source / name).is_dir() else shutil.copy)(str(source / name), str(folder / name))
    run(python, "-c", INSTALLED_CODE, cwd=folder)
    harness = sorted(f"tests/{file.name}" for file in (folder / "tests").glob(HARNESS))
    apart = [f"--ignore={file}" for file in harness] + [
        f"--deselect={test}" if "::" in test else f"--ignore={test}" for test in NEED_CHECKOUT
    ]
    suites = {"core": ["tests", "-m", "not slow", *apart], "harness": harness}
    results: Dict[str, Optional[Dict[str, Any]]] = {}
    for suite, arguments in suites.items():
        if not arguments:
            print(f"{suite}: no tests/{HARNESS}", flush=True)
            results[suite] = None
            continue
        report, began = folder / f"{suite}.xml", time.perf_counter()
        command = [python, "-m", "pytest", *arguments, "--continue-on-collection-errors", f"--junitxml={report}"]
        command += ["-k", chosen] if chosen else []
        status = subprocess.run([str(c) for c in command], cwd=str(folder), env=clean_environ()).returncode
        if not report.is_file() or (status == 5 and not chosen):  # 5: no test at all
            raise CheckError(f"pytest ended with status {status} in suite {suite}: {command}")
        seconds = round(time.perf_counter() - began, 1)
        results[suite] = {"exit_status": status, "seconds": seconds, **read_report(report)}
    return results


def check(name: str, home: Path, source: Path, chosen: str) -> Dict[str, Any]:
    """One environment: its row of the table."""
    home.mkdir(parents=True, exist_ok=True)
    row: Dict[str, Any] = {"environment": name, "versions": {}, "suites": {}, "error": None}
    try:
        print(f"--- {name}: installing into {home} (the first time several minutes)", flush=True)
        python = install(name, home, source)
        row["versions"] = json.loads(run(python, "-c", VERSIONS_CODE, *PACKAGES, cwd=home))
        print(f"--- {name}: testing with {row['versions']}", flush=True)
        row["suites"] = run_tests(python, source, source.parent / f"run-{name}", chosen)
    except CheckError as error:
        row["error"] = str(error)
    return row


def failed(row: Dict[str, Any]) -> bool:
    return bool(row["error"]) or any(suite and suite["exit_status"] not in (0, 5) for suite in row["suites"].values())


def table(rows: Sequence[Dict[str, Any]]) -> str:
    """The rows as a Markdown table; a suite's three numbers are passed / failed / skipped."""
    head = ["environment", "python", *PACKAGES, "core: passed/failed/skipped", "harness: passed/failed/skipped"]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        cells = [row["environment"], *(row["versions"].get(key, "-") for key in head[1 : 2 + len(PACKAGES)])]
        for suite in ("core", "harness"):
            counts = row["suites"].get(suite)
            cells.append("/".join(str(counts[key]) for key in ("passed", "failed", "skipped")) if counts else "not run")
        lines.append(cells)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Check the environments that are named; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=sorted(ENVIRONMENTS), metavar="old|new")
    parser.add_argument("--folder", type=Path, default=ROOT / "outputs" / "environments", help="for what is installed")
    parser.add_argument("--commit", default="HEAD", help="what is built and tested (default: HEAD)")
    parser.add_argument("--working-tree", action="store_true", help="instead of a commit: the files as they are now")
    parser.add_argument("-k", dest="chosen", default="", metavar="EXPRESSION", help="only these tests, as in pytest -k")
    given = parser.parse_args(arguments)
    folder, commit = given.folder.resolve(), "" if given.working_tree else given.commit
    try:
        for name in given.names:
            find_python(name)  # both before the first long installation
        tested = run("git", "rev-parse", "--short", commit or "HEAD", cwd=ROOT).strip()
    except CheckError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    tested += "" if commit else ", with what the working tree changes"
    tested += f", only the tests {given.chosen!r}" if given.chosen else ""
    with tempfile.TemporaryDirectory(prefix="cflow-check-") as temporary:
        source = Path(temporary) / "source"
        copy_checkout(commit, source)
        rows = [check(name, folder / name, source, given.chosen) for name in given.names]
    file = folder / "environments.json"
    file.write_text(json.dumps({"tested": tested, "rows": rows}, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    print(f"\n{table(rows)}\n\ntested: {tested}; written to {file}")
    for row in rows:
        if row["error"]:
            print(f"{row['environment']}: {row['error']}")
        for failure in [text for suite in row["suites"].values() if suite for text in suite["failures"]]:
            print(f"{row['environment']}: failed: {failure}")
    return int(any(failed(row) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
