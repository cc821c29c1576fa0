"""Tables and figures have the paper's numbers next to ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cflow_torch.config import Config, make_config
from cflow_torch.data.json_file import json_ready

CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
SCALES = [(0.1,), (0.2, 0.1), (0.4, 0.2, 0.1), (0.8, 0.4, 0.2, 0.1), (0.8, 0.4, 0.3, 0.2, 0.1)]
PAPER = make_config("paper")
KEYS = make_config("paper_keypoints")
CLUSTERS = KEYS.replace(densify="clusters")
PRESET = make_config("keypoints", point_cloud_range=KEYS.point_cloud_range)
# Settings of the rows of each table, in the paper's order.
JOBS: dict[str, list[Config]] = {
    "pixel_size": [PAPER.replace(pixel_size=size) for size in (0.05, 0.1, 0.2, 0.4)],
    "views": [PAPER, PAPER.replace(sectional_view=True)],
    "clustering": [PAPER, PAPER.replace(clustering="hdbscan")],
    "keypoints": [KEYS, KEYS.replace(densify="nearest"), PAPER, PAPER.replace(num_history=4), CLUSTERS, PRESET],
    "history": [*(PAPER.replace(num_history=h) for h in range(10)), make_config("default", num_history=12)],
    "scales": [PAPER.replace(num_history=h, pixel_sizes=sizes) for h in (0, 2, 4) for sizes in SCALES],
    "datasets": [PAPER, KEYS],
    "range_split": [PAPER, KEYS],
}


def write_run(root: Path, experiment: str, number: int, config: Config) -> None:
    """Write a results file in which all errors are around (number + 1) / 10."""
    error = 0.1 * (number + 1)
    scores = {name: {"dynamic_error": error + 0.01 * k} for k, name in enumerate(CLASSES)}
    ranges = {name: {"mean": {"dynamic_error": error + 0.2 * k}} for k, name in enumerate(("0-35", "35-70"))}
    record = {
        "results": {
            "bucketed": {"classes": scores, "mean": {"dynamic_error": error + 0.015}},
            "bucketed_by_range": {"ranges": ranges, "mean": {"dynamic_error": error + 0.1}},
        },
        "definition": {"name": "opensceneflow"},
        "num_pairs": 20,
        "failures": [],
        "seconds_per_pair": {"median": 0.5, "stages": {"cluster": 0.125, "correlate": 0.25, "pool": 0.0625}},
        "data": {"logs": [1, 2], "digest": "abc"},
        "config": {
            "experiment_name": experiment,
            "data": {"name": "av2", "label": "small"},
            "model": json_ready(config.as_dict()),
        },
        "versions": {"cflow_torch": "0.1.0", "torch": "2"},
        "date": "2026-01-02T03:04:05+00:00",
        "machine": {"threads": 1},
    }
    folder = root / experiment / str(number)
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(record))


def table(root: Path, name: str) -> list[list[str]]:
    return [line.split(",") for line in (root / "paper" / f"{name}.csv").read_text().splitlines()]


def test_tables_have_the_papers_numbers_next_to_ours(tmp_path: Path, script: Any, capsys: Any) -> None:
    pytest.importorskip("matplotlib")
    for experiment, configs in JOBS.items():
        for number, config in enumerate(configs):
            write_run(tmp_path, experiment, number, config)
    script("paper", "tables").write_pages(tmp_path)
    assert "cflow eval" not in capsys.readouterr().out, "every row of the paper is known by its settings"
    assert table(tmp_path, "pixel_size")[3:5] == [
        ["0.1", "paper", "0.3093", "0.3458", "0.3746", "0.3799", "0.3524", "0.4674"],
        ["0.1", "small", "0.2000", "0.2100", "0.2200", "0.2300", "0.2150", "0.5000"],
    ]
    views = table(tmp_path, "views")
    assert views[2][1:] == ["small", "0.1000", "0.1100", "0.1200", "0.1300", "0.1150", "0.3125"]  # correlate + pool
    assert views[4][1:] == ["small", "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.0000"]
    added = ["Clusters (not in the paper)", "Preset keypoints (not in the paper)"]
    assert [row[0] for row in table(tmp_path, "keypoints")[-2:]] == added
    assert table(tmp_path, "history")[-1][:3] == ["h=12", "small", "1.1000"]
    assert table(tmp_path, "datasets")[-2][:5] == ["Overall", "ours", "0.2000", "-", "0.3000"]
    assert [row[4] for row in table(tmp_path, "range_split")[-2:]] == ["0.2000", "0.4000"]
    page = (tmp_path / "paper.md").read_text()
    assert "| h=2, small | 0.6150 | 0.7150 | 0.8150 | 0.9150 | 1.0150 |" in page, "means by number of scales"
    for name in ("history", "scales", "datasets", "range_split"):
        assert (tmp_path / "paper" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"](paper/{name}.png)" in page
