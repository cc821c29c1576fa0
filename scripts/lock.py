"""Write scripts/locked/*.txt: what the two commands install, each file by its hash. python scripts/lock.py

From the pins of constraints.txt and the requirements of pyproject.toml; asks PyPI which files a version has and what it
requires. Lists: build (what builds a package), demo, test (all that ./scripts/test.sh needs), cpu (CPU builds of torch,
which PyPI does not have for Linux) and cuda (what torch from PyPI needs besides on Linux). Needs Python 3.11.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import sys
import urllib.error
import urllib.request
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any, Dict, Iterable, List, Set, Tuple

import tomllib
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import (
    InvalidSdistFilename,
    InvalidWheelFilename,
    canonicalize_name,
    parse_sdist_filename,
    parse_wheel_filename,
)
from packaging.version import InvalidVersion, Version

SCRIPTS = Path(__file__).resolve().parent
CONSTRAINTS, PROJECT, LOCKED = SCRIPTS / "constraints.txt", SCRIPTS.parent / "pyproject.toml", SCRIPTS / "locked"
BUILD = ("setuptools", "wheel")
EXTRAS = {"demo": ("viz",), "test": ("dev", "ray", "viz", "rerun", "video")}  # of demo.sh and test.sh
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PLATFORMS = (
    {"platform_system": "Linux", "sys_platform": "linux", "os_name": "posix", "platform_machine": "x86_64"},
    {"platform_system": "Darwin", "sys_platform": "darwin", "os_name": "posix", "platform_machine": "arm64"},
)
# PyTorch's own CPU builds: name of the file -> hash.
CPU_BUILDS = {
    "torch-2.13.0+cpu-cp311-cp311-manylinux_2_28_x86_64.whl": (
        "6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b"
    ),
}
_FITTING = re.compile(r"py3\d*-none|cp3\d+-(none|abi3)|cp31[0-3]-cp31[0-3]$")
Environment = Dict[str, str]


def source_digest() -> str:
    """Of what the lists are made from: they name it, and a test compares."""
    text = CONSTRAINTS.read_bytes() + PROJECT.read_bytes()
    return hashlib.sha256(text).hexdigest()


def pins(environment: Environment) -> Dict[str, str]:
    """Name -> version of constraints.txt."""
    lines = (line.split("#")[0].strip() for line in CONSTRAINTS.read_text(encoding="utf-8").splitlines())
    found = [Requirement(line) for line in lines if line]
    return {canonicalize_name(each.name): str(each.specifier)[2:] for each in found if _applies(each, environment)}


def closure(roots: Iterable[str], environment: Environment, cuda: bool) -> Set[Tuple[str, str]]:
    """(name, version) of all that the roots need; with `cuda`, also of what torch asks for on Linux alone."""
    versions, own = pins(environment), tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    reached: Set[Tuple[str, str]] = set()
    seen: Set[Tuple[str, str]] = set()
    waiting = [(Requirement(root), "pyproject.toml") for root in roots]
    while waiting:
        requirement, parent = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (str(requirement), parent) in seen or (
            parent == "torch" and "Linux" in str(requirement.marker) and not cuda
        ):
            continue
        seen.add((str(requirement), parent))
        if name == canonicalize_name(own["name"]):
            children = [*own["dependencies"], *(c for e in requirement.extras for c in own["optional-dependencies"][e])]
        elif name not in versions or not requirement.specifier.contains(versions[name], prereleases=True):
            sys.exit(
                f"{parent} requires {requirement}, constraints.txt has {versions.get(name, 'no pin')}: {environment}"
            )
        else:
            reached.add((name, versions[name]))
            if not _has_file(name, versions[name], environment["python_version"]):
                sys.exit(f"PyPI has no file of {name} {versions[name]} for Python {environment['python_version']}")
            children = required(name, versions[name])
        extras = [{**environment, "extra": extra} for extra in ("", *requirement.extras)]
        waiting += [
            (child, name) for child in map(Requirement, children) if any(_applies(child, each) for each in extras)
        ]
    return reached


def _applies(requirement: Requirement, environment: Environment) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": "", **environment})


@lru_cache(maxsize=None)
def files(name: str) -> List[Dict[str, Any]]:
    """What PyPI's simple index says of all files of a project."""
    asked = urllib.request.Request(
        f"https://pypi.org/simple/{name}/", headers={"Accept": "application/vnd.pypi.simple.v1+json"}
    )
    with urllib.request.urlopen(asked) as answer:
        found: List[Dict[str, Any]] = json.load(answer)["files"]
    return found


def fitting(name: str, version: str) -> List[Dict[str, Any]]:
    """Wheels of a version for the Pythons of the lists; its source archive if it has no wheel."""
    wheels, archives = [], []
    for file in files(name):
        try:
            if file["filename"].endswith(".whl"):
                of = parse_wheel_filename(file["filename"])[1]
                if of == Version(version) and _fits(file["filename"], _FITTING):
                    wheels.append(file)
            elif file["filename"].endswith(".tar.gz") and parse_sdist_filename(file["filename"])[1] == Version(version):
                archives.append(file)
        except (InvalidWheelFilename, InvalidSdistFilename, InvalidVersion):
            continue  # of long ago
    return wheels or archives


@lru_cache(maxsize=None)
def _has_file(name: str, version: str, python: str) -> bool:
    own = re.compile(rf"cp{python.replace('.', '')}-|py3\d*-none|cp3\d+-abi3")
    return any(
        SpecifierSet(file["requires-python"] or "").contains(python + ".9")
        and (not file["filename"].endswith(".whl") or _fits(file["filename"], own))
        for file in fitting(name, version)
    )


def _fits(wheel: str, pattern: re.Pattern[str]) -> bool:
    return any(pattern.match(f"{tag.interpreter}-{tag.abi}") for tag in parse_wheel_filename(wheel)[3])


@lru_cache(maxsize=None)
def required(name: str, version: str) -> List[str]:
    """Requirements of a version, out of the metadata of one of its wheels; a source archive alone is asked for none."""
    found = fitting(name, version)
    if not found:
        sys.exit(f"PyPI has no file of {name} {version} for Python {PYTHONS[0]} ... {PYTHONS[-1]}")
    if not found[-1]["filename"].endswith(".whl"):
        return []
    wheel = ([each for each in found if "manylinux" in each["filename"]] or found)[-1]
    try:
        with urllib.request.urlopen(wheel["url"] + ".metadata") as answer:
            text = answer.read()
    except urllib.error.HTTPError:  # old files have none beside them
        with urllib.request.urlopen(wheel["url"]) as answer, zipfile.ZipFile(io.BytesIO(answer.read())) as archive:
            text = archive.read(next(each for each in archive.namelist() if each.endswith(".dist-info/METADATA")))
    return re.findall(r"^Requires-Dist: (.*?)\r?$", re.split(r"\r?\n\r?\n", text.decode("utf-8"))[0], re.M)


def cpu_builds() -> str:
    """The list of CPU builds."""
    lines = [f"# CPU builds of torch.\n{_made()}"]
    for file, digest in CPU_BUILDS.items():
        name, version, _, tags = parse_wheel_filename(file)
        minor = next(iter(tags)).interpreter[3:]
        lines.append(f'{name}=={version} ; python_version == "3.{minor}" \\\n    --hash=sha256:{digest}')
    return "\n".join(lines) + "\n"


def _made() -> str:
    return f"# Made by scripts/lock.py from {source_digest()}: do not edit."


def written(needed: Dict[Tuple[str, str], Set[str]], about: str) -> str:
    """A list of (name, version) -> Pythons in pip's form."""
    lines = [f"# {about}", _made()]
    for (name, version), pythons in sorted(needed.items()):
        hashes = {each["hashes"]["sha256"] for each in fitting(name, version)}
        only = "" if len(pythons) == len(PYTHONS) else f' ; python_version in "{" ".join(sorted(pythons))}"'
        lines += [" \\\n".join([f"{name}=={version}{only}", *(f"    --hash=sha256:{each}" for each in sorted(hashes))])]
    return "\n".join(lines) + "\n"


def lists() -> Dict[str, Dict[Tuple[str, str], Set[str]]]:
    """Name of a list -> (name, version) -> Pythons that need it."""
    found: Dict[str, Dict[Tuple[str, str], Set[str]]] = {name: {} for name in ("build", *EXTRAS, "cuda")}
    for python in PYTHONS:
        for platform in PLATFORMS:
            environment = {**platform, "python_version": python, "python_full_version": python + ".9"}
            environment["implementation_name"], environment["platform_python_implementation"] = "cpython", "CPython"
            base = {
                name: closure([f"cflow_torch[{','.join(e)}]"], environment, cuda=False) for name, e in EXTRAS.items()
            }
            base["build"] = closure(BUILD, environment, cuda=False)
            if platform["platform_system"] == "Linux":
                base["cuda"] = closure(["torch"], environment, cuda=True) - base["demo"]
            for name, reached in base.items():
                for each in reached:
                    found[name].setdefault(each, set()).add(python)
    return found


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    abouts = {
        "build": "What builds the package and what has no wheel.",
        "demo": "What ./scripts/demo.sh installs.",
        "test": "What ./scripts/test.sh installs.",
        "cuda": "What torch from PyPI needs besides on Linux.",
    }
    LOCKED.mkdir(exist_ok=True)
    for name, needed in lists().items():
        (LOCKED / f"{name}.txt").write_text(written(needed, abouts[name]), encoding="utf-8")
        print(f"{name}: {len(needed)} packages")
    (LOCKED / "cpu.txt").write_text(cpu_builds(), encoding="utf-8")


if __name__ == "__main__":
    main()
