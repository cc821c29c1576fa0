"""JSON of the data sets and of our own records."""

from __future__ import annotations

import json
import tempfile
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable, Dict, List, Tuple

import numpy as np
from tiny_recording import TinyRecording

from cflow_torch.cli.eval import objective_of
from cflow_torch.cli.record import finished_results
from cflow_torch.config import Config, make_config
from cflow_torch.data.aevascenes.reader import AevaScenesLog, find_aevascenes_sequences
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.log import Log
from cflow_torch.data.nuscenes.json_tables import FIELDS
from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes
from cflow_torch.data.truckscenes.reader import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.evaluation.submission.check import check_submission
from cflow_torch.evaluation.submission.plan import read_frame_list
from cflow_torch.evaluation.submission.versions import get_version
from cflow_torch.evaluation.submission.write import write_metadata
from cflow_torch.fleet.manifest import claim_log, describe_log, find_conflict, make_identity
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.simulator.writers.truckscenes import write_truckscenes
from cflow_torch.types import CFlowError
from fuzzing.json_damage import hostile_json
from fuzzing.target import Target

Write = Callable[[Path], Any]
RUN = "0" * 64
WORDS = (
    *(b"token", b"name", b"timestamp", b'"', b"[", b"{", b"}", b",", b":"),
    *(b"\\u0000", b"../", b"\xef\xbb\xbf", b"1e999"),
)


@lru_cache(maxsize=None)
def _files(write: Write, pattern: str) -> Tuple[Tuple[str, bytes], ...]:
    """(name, content) of the files that something writes."""
    with tempfile.TemporaryDirectory() as name:
        write(Path(name))
        return tuple((str(file.relative_to(name)), file.read_bytes()) for file in sorted(Path(name).rglob(pattern)))


def _all_of(log: Log) -> None:
    for index in range(len(log.timestamps)):
        log.sweep(index)
        log.labels(index)


# ------------------------------------------------------------------------- tables: the first line says which one it is


def _nuscenes(root: Path) -> None:
    names = ("LIDAR_TOP",)
    write_nuscenes(TinyRecording(names, num_sweeps=2, interval_ns=250_000_000), root, version="v1.0-mini")


def _truckscenes(root: Path) -> None:
    write_truckscenes(TinyRecording(("LIDAR_LEFT",), num_sweeps=2), root, version="v1.2-mini")


def _table_seeds(write: Write) -> List[bytes]:
    tables = {Path(name).stem: content for name, content in _files(write, "*.json")}
    small = {name: json.dumps(json.loads(tables[name])[:40]).encode() for name in FIELDS}
    return [name.encode() + b"\n" + content for name, content in small.items()]


def _read_tables(write: Write, find: Callable[[Path], List[Any]], log: Any, folder: Path) -> None:
    name, _, content = (folder / "table").read_bytes().partition(b"\n")
    table = name.decode("latin-1") if name.decode("latin-1") in FIELDS else sorted(FIELDS)[len(name) % len(FIELDS)]
    (file,) = folder.glob(f"*/*/*/{table}.json")
    whole = file.read_bytes()
    file.write_bytes(content)
    try:
        for source in find(folder):
            _all_of(log(source))
    finally:
        file.write_bytes(whole)


# ------------------------------------------------------------------------------------------------- single documents


def _aevascenes(root: Path) -> None:
    write_aevascenes_sequence(TinyRecording(("front",), num_sweeps=2), root)


def _put_aevascenes(folder: Path) -> None:
    for name, content in _files(_aevascenes, "*.*"):
        file = folder.joinpath(*Path(name).parts[1:])
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content)


def _read_aevascenes(folder: Path) -> None:
    for sequence in find_aevascenes_sequences(folder):
        log = AevaScenesLog(sequence)
        _all_of(log)
        log.radial_velocity(0)


SIM2 = [b'{"R": [1.0, 0.0, 0.0, 1.0], "t": [-3.0, 4.0], "s": 3.3}', b'{"R": [[1, 0], [0, 1]], "t": [0, 0], "s": 1}']


def _read_ground(folder: Path) -> None:
    raster = read_ground_raster(folder)
    assert raster is not None
    raster.is_ground(np.array([[0.0, 0, 0], [1e7, -1e7, 1], [np.nan, 0, 0]]))


class _FewSweeps:
    log_id, timestamps = "log", [315_966_000_000_000_000, 315_966_000_100_000_000]

    def sweep(self, index: int) -> Any:
        return SimpleNamespace(points=np.zeros((4, 3), np.float32), is_ground=None, pose=np.eye(4))

    def labels(self, index: int) -> None:
        return None


IDENTITY = make_identity(Config(), "av2", {"root": "data", "check": True})


def _read_manifest(folder: Path) -> None:
    conflict = find_conflict(folder, IDENTITY, True)
    if conflict is not None:
        raise CFlowError(f"results of another run{conflict}")


def _read_log_manifest(folder: Path) -> None:
    content = (folder / "manifest.json").read_bytes()
    claim_log(folder, _FewSweeps(), RUN)  # type: ignore[arg-type]
    assert (folder / "manifest.json").read_bytes() == content, "what is there is never replaced"


RESULTS: Dict[str, Any] = {"three_way": {"epe_3way": 0.1}, "bucketed": {"mean": {"dynamic_error": 0.5}}}


@lru_cache(maxsize=None)
def _eval_settings() -> Tuple[Any, Dict[str, Any]]:
    from omegaconf import OmegaConf

    from cflow_torch.cli.run import versions

    cfg = OmegaConf.create({"overwrite": False, "output": "x", "data": {"name": "av2", "cache": None}})
    record = {"versions": versions(), "data": {"generator": None}, "results": RESULTS}
    return cfg, {**record, "config": OmegaConf.to_container(cfg)}


def _read_results(folder: Path) -> None:
    record = finished_results(_eval_settings()[0], folder)
    assert record is not None
    objective_of(record, folder)


def _read_metadata(folder: Path) -> None:
    problems = check_submission(folder, get_version(2), [])
    if problems:
        raise CFlowError("; ".join(problems))


def _metadata() -> List[bytes]:
    return [content for _, content in _files(lambda folder: write_metadata(folder, get_version(2)), "*.json")]


def _read_config(folder: Path) -> None:
    """Settings of the method as JSON, by the door that Python code uses."""
    from cflow_torch.data.json_file import read_json

    values = read_json(folder / "config.json")
    if not isinstance(values, dict):
        raise CFlowError("settings are a mapping")
    make_config(**{f"_{key}" if key == "preset" else key: value for key, value in values.items()})


def _config_seeds() -> List[bytes]:
    configs = (make_config(), make_config("paper"), make_config("keypoints"), make_config("fast", max_memory=10**9))
    return [json.dumps(config.as_dict()).encode() for config in configs]


LISTS = [b"log-1/315966000000000000\nlog-1/315966000100000000\n", b"# all\nlog-2, 7 # one\nlog-2 8\n"]


def _tables(name: str, write: Write, find: Any, log: Any) -> Target:
    def prepare(folder: Path) -> None:
        write(folder / "data")

    seeds = partial(_table_seeds, write)
    read = partial(_read_tables, write, find, log)
    return Target(name, "table", seeds, read, prepare, hostile_json(tuple(seeds()), 1), WORDS)


def _document(name: str, file: str, seeds: Callable[[], List[bytes]], read: Any, prepare: Any = None) -> Target:
    ready = prepare or (lambda folder: None)
    return Target(name, file, seeds, read, ready, hostile_json(tuple(seeds())), WORDS)


def _put_raster(folder: Path) -> None:
    np.save(folder / "log_ground_height_surface____SYN.npy", np.zeros((8, 9), np.float16))


TARGETS: Tuple[Target, ...] = (
    _tables("nuscenes", _nuscenes, find_nuscenes_scenes, NuScenesLog),
    _tables("truckscenes", _truckscenes, find_truckscenes_scenes, TruckScenesLog),
    _document(
        *("aevascenes", "sequence.json", lambda: [content for _, content in _files(_aevascenes, "*.json")]),
        *(_read_aevascenes, _put_aevascenes),
    ),
    _document("ground", "log___img_Sim2_city.json", lambda: SIM2, _read_ground, _put_raster),
    _document("manifest", "manifest.json", lambda: [json.dumps(IDENTITY).encode()], _read_manifest),
    _document(
        *("log_manifest", "manifest.json"),
        lambda: [json.dumps(describe_log(_FewSweeps(), RUN)).encode()],  # type: ignore[arg-type]
        _read_log_manifest,
    ),
    _document("results", "results.json", lambda: [json.dumps(_eval_settings()[1]).encode()], _read_results),
    _document("metadata", "metadata.json", _metadata, _read_metadata),
    _document("config", "config.json", _config_seeds, _read_config),
    Target("frame_list", "frames.txt", lambda: LISTS, lambda f: read_frame_list(f / "frames.txt"), tokens=WORDS),
)
