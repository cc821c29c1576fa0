"""The pages: commands and Python blocks run, links have targets, and the site has every public name.

Python that reads /data/my_drive or /data/drive.bag gets a simulated one. We skip commands that need data, the network
or another repository. Of `cflow` commands with data we compose the settings.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import runpy
import shlex
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from bag_writer import BagWriter
from command_line import cflow

import cflow_torch
from cflow_torch import evaluation, viz
from cflow_torch.applications.track_table import read_tracks
from cflow_torch.config import METHODS
from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.arrays.cloud_file import read_cloud, read_columns, write_cloud
from cflow_torch.data.catalog import DATA_SETS
from cflow_torch.simulator import make_drive

SETTINGS = {"pixel_size", *(f.name for kind in METHODS.values() for f in fields(kind))}
ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "docs/quick_start.md", "docs/harness.md")
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```", re.M | re.S)
DATA = re.compile(r"/data|/path|experiment=")
FOREIGN = re.compile(r"# \w+\.py\n|from bucketed_scene_flow_eval")  # Python for other repositories begins with this


def parts(page: str) -> list[tuple[str, Any]]:
    """Return the parts of a page in order: ("python", text), ("cflow", words), or ("module", words) of python -m."""
    found: list[tuple[str, Any]] = []
    for language, text in BLOCK.findall((ROOT / page).read_text(encoding="utf-8")):
        if language == "python":
            found.append((language, text))
            continue
        for line in text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            found += [("cflow", words[1:])] if words[:1] == ["cflow"] else []
            found += [("module", words[2:])] if words[:2] == ["python", "-m"] else []
    return found


COMMANDS = {" ".join(words) for page in PAGES for kind, words in parts(page) if kind == "cflow"}


def run(kind: str, part: Any, names: dict[str, Any]) -> None:
    """Run one part of a page in this process, unless it is skipped."""
    if kind == "python":
        if not FOREIGN.match(part):
            exec(compile(part.replace('"/data/', '"data/'), "page", "exec"), names)
    elif kind == "module":
        sys.argv = part
        runpy.run_module(part[0], run_name="__main__")
    elif not DATA.search(" ".join(part)):
        assert cflow(*part) == 0, part


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    return tmp_path


@pytest.fixture
def names(folder: Path) -> dict[str, Any]:
    """Return the arrays that README uses, and write the data that the quick start reads."""
    drive = make_drive(seed=1, num_sweeps=5, profile="demo")
    write_array_log(drive, "data").rename("data/my_drive")
    writer = BagWriter(folder / "data", "ros1")
    for sweep in drive:
        stamp, cloud = sweep.timestamp_ns, writer.cloud(sweep.timestamp_ns, sweep.points, None)
        writer.write("/tf", stamp, "tf2_msgs/msg/TFMessage", [writer.transform(stamp, "odom", "velodyne", sweep.pose)])
        writer.write("/points", stamp, "sensor_msgs/msg/PointCloud2", *cloud)
    writer.bag.close()
    motion = np.linalg.inv(drive.poses[1]) @ drive.poses[0]
    return {"pc0": drive.sweep(0).points, "pc1": drive.sweep(1).points, "T_ego1_ego0": motion}


@pytest.mark.parametrize("command", sorted(filter(DATA.search, COMMANDS)))
def test_commands_with_data_have_valid_settings(command: str, folder: Path) -> None:
    assert cflow(*command.replace(" -m ", " ").split(), "--cfg", "job") == 0


def test_python_of_the_readme_runs(names: dict[str, Any]) -> None:
    for part in (part for part in parts(PAGES[0]) if part[0] == "python"):
        run(*part, names)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands_and_python_run_in_the_order_of_the_page(page: str, names: dict[str, Any], capfd: Any) -> None:
    for part in parts(page):
        run(*part, names)
    if page == PAGES[1]:
        printed = capfd.readouterr().out
        assert re.search(r"object \d+ at \[.*\] m: \d+\.\d m/s", printed) and re.search(r"object \d+: .* m/s", printed)
        assert Path("flow.png").is_file() and 0 < len(read_cloud("clean_map.ply")) < len(read_cloud("map.ply"))
    if page == PAGES[2]:
        scores = json.loads(Path("outputs/eval/results.json").read_text())["results"]["three_way"]
        names_of = {"EPE_FD": "epe_fd", "EPE_BS": "epe_bs", "EPE_FS": "epe_fs", "IoU": "dynamic_iou"}
        stated = re.findall(r"(EPE_\w\w|IoU) (\d\.\d+)", (ROOT / page).read_text(encoding="utf-8"))
        assert {name: float(value) for name, value in stated} == {
            name: pytest.approx(scores[key], abs=1e-3) for name, key in names_of.items()
        }


def test_three_commands_of_the_readme_make_actors_and_a_clean_map(folder: Path, capfd: Any) -> None:
    """They run one after the other on a folder of .pcd files with poses, with a third of the points of a drive."""
    pytest.importorskip("pypcd4", reason="needs the extra clouds: pip install pypcd4")
    drive = make_drive(seed=4, num_sweeps=5, profile="demo")
    clouds = [sweep.points[::3] for sweep in drive]
    (folder / "data" / "my_drive").mkdir(parents=True)
    for index, points in enumerate(clouds):
        write_cloud(folder / "data" / "my_drive" / f"scan_{index}.pcd", points, {"intensity": points[:, 2]})
    np.savetxt(folder / "data" / "my_drive" / "poses.txt", drive.poses[:, :3].reshape(-1, 12))
    commands = [words for kind, words in parts("README.md") if kind == "cflow" and "/data/my_drive" in words]
    assert [words[0] for words in commands] == ["check", "flow", "clean"]
    for words in commands:
        assert cflow(*(word.replace("/data/", "data/") for word in words)) == 0, words
    printed = capfd.readouterr().out
    frames = json.loads(Path("outputs/flow/my_drive/frame_instances.json").read_text())
    actors = json.loads(Path("outputs/flow/my_drive/instances_info.json").read_text())
    assert list(frames) == [str(index) for index in range(5)] and max(map(len, frames.values())) > 2
    assert f"{len(actors)} tracks in tracks.parquet, instances_info.json, frame_instances.json" in printed
    table = read_tracks(Path("outputs/flow/my_drive/tracks.parquet"))
    kinds = {str(number): str(kind) for number, kind in zip(table["id"], table["class"])}
    is_soft = {actor["id"]: actor["class_name"] == "Cyclist" for actor in actors.values()}
    assert is_soft == {number: kind in ("pedestrian", "cyclist") for number, kind in kinds.items()}
    points = read_columns("outputs/clean/my_drive/map.ply")["intensity"]
    kept = [read_cloud(f"outputs/clean/my_drive/points/scan_{index}.pcd") for index in range(5)]
    assert 1000 < len(points) < sum(map(len, kept)) < 0.95 * sum(map(len, clouds))


EVERY_PAGE = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "notebooks").glob("*.[im][pd]*")]
CODE = re.compile(r"^ *(```+|~~~+).*?^ *\1|(`+)(?!`).*?(?<!`)\2(?!`)", re.M | re.S)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)|<(?:img|a)\b[^>]*?\b(?:src|href)=\"([^\"]+)|^\[[^\]]+\]:\s+(\S+)", re.M)


def text_of(page: Path) -> str:
    """Return the Markdown of a page, or of the text cells of a notebook."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return text


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    titles = re.findall(r"^#{1,6} +(.+?) *$", re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", EVERY_PAGE, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_have_targets_in_this_repository(page: Path) -> None:
    wrong = []
    for parts in LINK.findall(CODE.sub("", text_of(page))):
        target = unquote("".join(parts))
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if re.match(r"https?:|mailto:", target):
            continue
        if not file.exists() or ROOT not in (file, *file.parents) or (anchor and anchor not in anchors(file)):
            wrong.append(target)
    assert not wrong


PROSE = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
PACKAGE = Path(cflow_torch.__file__).parent  # in an environment of check_environments.py, outside of the checkout
FOLDERS = (PACKAGE, *(ROOT / name for name in ("configs", "scripts", "tests")))
SOURCES = [path for folder in FOLDERS for path in folder.rglob("*.*")]
# Words of other programs and placeholders that our files do not contain.
OF_OTHERS = {
    *("TOPIC", "NEW", "aws", "gcloud", "anon", "FSSPEC_S3", "analytics", "load_frame_list", "relative_to_idx"),
    *("res_name", "run_cflow", "test_pl", "_calib", "counterclockwise_", "submitit_slurm", "export"),
}


@pytest.fixture(scope="module")
def known_words() -> set[str]:
    """Return the words of all sources but this file, and their names."""
    files = [file for file in SOURCES if file.suffix in (".py", ".yaml", ".sh", ".html") and file != Path(__file__)]
    words = {file.stem for file in files}
    for file in [*files, ROOT / "pyproject.toml", ROOT / "mkdocs.yml"]:
        words.update(re.findall(r"\w+", file.read_text(encoding="utf-8")))
    return words


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.name)
def test_names_in_sentences_exist(page: Path, known_words: set[str]) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    codes = re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text)
    names = {name for code in codes for name in re.findall(r"(?<![\w./-])[A-Za-z_][\w.]*\w", code)}
    assert {word for name in names for word in name.split(".")} <= known_words | OF_OTHERS


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.name)
def test_python_of_the_pages_imports_and_passes_what_exists(page: Path) -> None:
    """Also in blocks that are not run: imports from this package, and keywords of calls of what is imported."""
    objects: dict[str, Any] = {}
    for language, block in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("cflow_torch"):
                module = importlib.import_module(str(node.module))
                objects.update((name.asname or name.name, getattr(module, name.name)) for name in node.names)
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in objects:
                parameters = inspect.signature(objects[node.func.id]).parameters
                takes_settings = any(one.kind is one.VAR_KEYWORD for one in parameters.values())
                allowed = {*parameters, *(SETTINGS if takes_settings else ())}
                assert {word.arg for word in node.keywords if word.arg} <= allowed, ast.dump(node)


def test_the_reference_has_every_public_name() -> None:
    named = set(re.findall(r"- (cflow_torch\.[\w.]+)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    public = {f"cflow_torch.{name}" for name in cflow_torch.__all__ if name != "__version__"}
    readers = {f"cflow_torch.data.{name}.{one.log}" for name, one in DATA_SETS.items()}
    scores = {f"cflow_torch.evaluation.{name}" for name in evaluation.__all__ if name != "DEFINITIONS"}
    drawn = [name for name in viz.__all__ if name.startswith(("plot", "save", "record", "show"))]
    pictures = {f"cflow_torch.viz.{name}" for name in drawn}
    assert not (public | readers | scores | pictures) - named


def test_a_notebook_becomes_a_page_with_its_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    notebook_page = importlib.import_module("site_pages").notebook_page
    outputs = [
        {"output_type": "stream", "text": ["1 car\n"]},
        {"output_type": "display_data", "data": {"image/png": "iVBO\n", "text/plain": "<Figure>"}},
    ]
    cells = [
        {"cell_type": "markdown", "source": ["# A title"]},
        {"cell_type": "code", "source": ["print(cars)"], "outputs": outputs},
    ]
    file = tmp_path / "a.ipynb"
    file.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert notebook_page(file) == (
        "# A title\n\n```python\nprint(cars)\n```\n\n```text\n1 car\n```\n\n![output](data:image/png;base64,iVBO)"
    )
