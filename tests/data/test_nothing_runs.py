"""Nothing that a file says is ever run: no call in the package could, and files that try are refused or are data."""

from __future__ import annotations

import ast
import os
import pickle
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Set, Tuple

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet
from tiny_recording import TinyRecording

import cflow_torch
from cflow_torch import CFlowError
from cflow_torch.cli.main import main
from cflow_torch.cli.settings_file import read_settings
from cflow_torch.data.aevascenes import AevaScenesLog
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.hdf5.index_file import read_index
from cflow_torch.evaluation.submission.plan import read_frame_list
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence

PACKAGE = Path(cflow_torch.__file__).parent
ROOT = PACKAGE.parent
# Who may: each of these has its own lock, which the tests below try.
PICKLES = {
    "data/aevascenes/npz_strings.py": "an Unpickler of strings only",
    "data/aevascenes/pickled_strings.py": "the same",
    "data/hdf5/index_file.py": "an Unpickler of lists of strings only; and the writer of such files",
    "fleet/ray_engine.py": "messages of a run's own processes, from Ray, never from a file",
    "fleet/ray_worker.py": "the same",
}
PROCESSES = {"cli/view.py": "the viewer", "cli/info.py": "nvidia-smi, git and the like"}
IMPORTS_BY_NAME = {
    *("cli/main.py", "cli/info.py", "data/benchmark.py", "data/catalog.py"),
    *("integrations/bucketed_scene_flow_eval.py", "integrations/scene_flow_zoo.py"),
}
YAML = {"cli/settings_file.py"}
NEVER = {
    *(
        "eval",
        "exec",
        "compile",
        "__import__",
        "os.system",
        "os.popen",
        "os.startfile",
        "runpy.run_path",
        "marshal.loads",
    ),
    *("runpy.run_module", "shelve.open", "pickle.load", "np.fromfile", "shutil.unpack_archive", "tarfile.open"),
    *(
        "torch.jit.load",
        "torch.hub.load",
        "torch.package",
        "yaml.load",
        "yaml.load_all",
        "yaml.full_load",
        "yaml.unsafe_load",
    ),
    *(
        "OmegaConf.load",
        "hydra.utils.instantiate",
        "instantiate",
        "hydra.utils.call",
        "hydra.utils.get_class",
        "get_class",
    ),
    *("pd.read_pickle", "joblib.load", "ctypes.CDLL", "logging.config.dictConfig", "logging.config.fileConfig"),
}
MODULES = {
    "marshal",
    "shelve",
    "dill",
    "cloudpickle",
    "joblib",
    "runpy",
    "code",
    "tarfile",
    "ctypes",
    "xmlrpc",
    "hydra.utils",
}


def sources() -> Iterator[Tuple[str, ast.Module]]:
    for file in sorted([*PACKAGE.rglob("*.py"), ROOT / "hubconf.py"]):
        if file.is_file():
            yield (
                file.relative_to(PACKAGE if PACKAGE in file.parents else ROOT).as_posix(),
                ast.parse(file.read_text("utf-8")),
            )


SOURCES: Dict[str, ast.Module] = dict(sources())


@lru_cache(maxsize=None)
def calls() -> List[Tuple[str, str, ast.Call]]:
    """(file, name as it is written, call)."""
    found = [(file, node) for file, tree in SOURCES.items() for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return [(file, dotted(node.func), node) for file, node in found]


def dotted(node: ast.AST) -> str:
    """a.b.c; what is called on something else than a name: ?.c."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def imported() -> Iterator[Tuple[str, str]]:
    for file, tree in SOURCES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from ((file, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield file, str(node.module)
                yield from ((file, f"{node.module}.{alias.name}") for alias in node.names)


def users(of: Callable[[str], bool]) -> Set[str]:
    return {file for file, name, _ in calls() if of(name)}


def test_no_call_that_runs_what_it_is_given() -> None:
    assert [
        f"{file}: {name}" for file, name, _ in calls() if name in NEVER or name.endswith((".extract", ".extractall"))
    ] == []
    assert [f"{file}: {name}" for file, name in imported() if name.split(".")[0] in MODULES or name in MODULES] == []
    assert len(SOURCES) > 200


def test_pickles_are_read_in_named_places_only() -> None:
    found = {file for file, name in imported() if name.split(".")[0] in ("pickle", "_pickle", "pickletools")}
    assert found <= set(PICKLES) and "data/hdf5/index_file.py" in found
    assert users(lambda name: name in ("pickle.loads", "loads")) <= {"fleet/ray_engine.py", "fleet/ray_worker.py"}
    for file in ("fleet/ray_engine.py", "fleet/ray_worker.py"):
        opened = [name for where, name, _ in calls() if where == file]
        assert not [name for name in opened if name.endswith(("open", "read_bytes", "read_text", "read_table"))], file
    for file in (file for file in found if file.startswith("data/")):
        classes = [
            n
            for n in ast.walk(SOURCES[file])
            if isinstance(n, ast.ClassDef) and any("Unpickler" in dotted(b) for b in n.bases)
        ]
        assert len(classes) == 1
        locks = [n for n in classes[0].body if isinstance(n, ast.FunctionDef) and n.name == "find_class"]
        assert len(locks) == 1 and isinstance(locks[0].body[-1], ast.Raise), "what is not named is refused"


def test_arrays_and_checkpoints_are_loaded_without_objects() -> None:
    def said(call: ast.Call, key: str) -> List[Any]:
        return [ast.literal_eval(word.value) for word in call.keywords if word.arg == key]

    loads = [
        (file, name, call) for file, name, call in calls() if name.endswith(("np.load", "numpy.load", ".read_array"))
    ]
    assert all(said(call, "allow_pickle") == [False] for _, _, call in loads)
    torch_loads = [call for _, name, call in calls() if name == "torch.load"]
    assert all(said(call, "weights_only") == [True] for call in torch_loads)


def test_processes_and_imports_by_name_in_named_places_only() -> None:
    assert {file for file, name in imported() if name.split(".")[0] == "subprocess"} == set(PROCESSES)
    started = [(file, call) for file, name, call in calls() if name.startswith("subprocess.")]
    assert started and not [file for file, call in started if any(word.arg == "shell" for word in call.keywords)]
    assert users(lambda name: name.endswith("import_module")) == IMPORTS_BY_NAME
    for file, name, call in calls():
        if name.endswith("import_module") and isinstance(call.args[0], ast.JoinedStr):
            assert str(ast.literal_eval(call.args[0].values[0])).startswith("cflow_torch."), file


def test_yaml_makes_plain_values() -> None:
    assert {file for file, name in imported() if name.split(".")[0] in ("yaml", "ruamel")} == YAML
    used = {name for _, name, _ in calls() if name.startswith("yaml.")}
    assert used == {"yaml.parse", "yaml.safe_load"}
    for file in sorted((ROOT / "configs").rglob("*.yaml")):
        for line in file.read_text(encoding="utf-8").splitlines():
            assert not line.strip().startswith(("!!", "&", "*")), file
            key, _, value = line.partition(":")
            if key.strip() == "_target_":
                assert value.strip().startswith("cflow_torch."), f"{file}: {line}"
    assert [
        file
        for file, tree in SOURCES.items()
        if any(isinstance(n, ast.Constant) and n.value == "_target_" for n in ast.walk(tree))
    ] == []


# ------------------------------------------------------------------------------------------------ files that try


class Payload:
    """Unpickled, it makes a folder."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> Any:
        return os.mkdir, (self.marker,)


@pytest.fixture
def marker(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "marker"
    assert not (tmp_path / "marker").exists(), "something ran"


def test_the_payload_works(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Payload(tmp_path / "marker")))
    assert (tmp_path / "marker").is_dir()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_index_files(protocol: int, marker: Path, tmp_path: Path) -> None:
    for value in (Payload(marker), [[Payload(marker), "1"]], [["scene", Payload(marker)]]):
        (tmp_path / "index_eval.pkl").write_bytes(pickle.dumps(value, protocol))
        with pytest.raises(CFlowError, match="index_eval.pkl"):
            read_index(tmp_path / "index_eval.pkl")


def test_lists_of_frames(marker: Path, tmp_path: Path) -> None:
    for name in ("frames.pkl", "frames.txt"):
        (tmp_path / name).write_bytes(pickle.dumps(Payload(marker)))
        with pytest.raises(CFlowError, match=name):
            read_frame_list(tmp_path / name)


def objects(marker: Path, shape: Tuple[int, ...] = (1,)) -> np.ndarray:
    values = np.empty(shape, dtype=object)
    values.fill(Payload(marker))
    return values


def test_arrays_of_objects(marker: Path, tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    for index in range(2):
        np.save(folder / f"{index}.npy", np.zeros((4, 3), np.float32))
    np.save(tmp_path / "poses.npy", objects(marker, (2, 4, 4)))
    with pytest.raises(CFlowError, match=r"poses.npy"):
        ArraysLog(folder, poses=tmp_path / "poses.npy")
    (folder / "ground").mkdir()
    np.save(folder / "ground" / "0.npy", objects(marker, (4,)))
    with pytest.raises(CFlowError, match=r"ground"):
        ArraysLog(folder).sweep(0)
    np.save(folder / "0.npy", objects(marker, (4, 3)))
    np.savez(folder / "0.npz", points=objects(marker, (4, 3)))
    np.savez(folder / "1.npz", points=objects(marker, (4, 3)))
    for suffix in (".npy", ".npz"):
        with pytest.raises(CFlowError, match=suffix):
            ArraysLog(folder, suffix=suffix, ground=None).sweep(0)
    np.save(tmp_path / "log_ground_height_surface____SYN.npy", objects(marker, (4, 3)))
    (tmp_path / "log___img_Sim2_city.json").write_text('{"R": [1, 0, 0, 1], "t": [0, 0], "s": 1}')
    with pytest.raises(CFlowError, match="ground_height_surface|ground raster"):
        read_ground_raster(tmp_path)


@pytest.mark.parametrize("key", ["semantic_labels", "xyz", "velocity"])
def test_clouds_with_strings(key: str, marker: Path, tmp_path: Path) -> None:
    """The one array that may hold pickled text."""
    folder = write_aevascenes_sequence(TinyRecording(("front",), num_sweeps=2), tmp_path / "data")
    for file in folder.rglob("*.npz"):
        with np.load(file, allow_pickle=True) as stored:  # our own
            arrays = {name: stored[name] for name in stored.files}
        np.savez(file, **{**arrays, key: objects(marker, arrays[key].shape)})
        assert zipfile.is_zipfile(file)
    with pytest.raises(CFlowError, match=key):
        log = AevaScenesLog(folder)
        log.sweep(0), log.radial_velocity(0)


@pytest.mark.parametrize("kind", ["feather", "parquet"])
def test_types_of_columns(kind: str, marker: Path, tmp_path: Path) -> None:
    """pyarrow before 14.0.1 unpickles what a column says its type is: run with such a version, too."""
    about = {
        b"ARROW:extension:name": b"arrow.py_extension_type",
        b"ARROW:extension:metadata": pickle.dumps(Payload(marker)),
    }
    schema = pa.schema([pa.field("flow_tx_m", pa.float32(), metadata=about)])
    table = pa.Table.from_arrays([pa.array([1.0], pa.float32())], schema=schema)
    file = tmp_path / f"a.{kind}"
    (feather.write_feather if kind == "feather" else parquet.write_table)(table, str(file))
    with pytest.raises(CFlowError, match="no flow file"):
        read_flow(file)
    if kind == "parquet":
        parquet.read_table(str(file))


@pytest.mark.parametrize(
    "text",
    [
        "version: !!python/object/apply:os.mkdir [{marker}]",
        "version: !!python/object/new:os.mkdir [{marker}]",
        "!!python/object/apply:os.mkdir [{marker}]: 1",
        "_target_: os.mkdir\npath: {marker}\nversion: {{_target_: os.mkdir, path: {marker}}}",
    ],
)
def test_settings_that_a_run_left(text: str, marker: Path, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text.format(marker=marker))
    try:
        assert read_settings(file)["_target_"] == "os.mkdir", "a word like any other"
    except CFlowError as error:
        assert "tag" in str(error)


@pytest.mark.parametrize(
    "override",
    [
        "~engine.threads",
        "+model._target_=os.mkdir +model.path={marker}",
        "+data._target_=os.mkdir +data.path={marker}",
        "model.method={{_target_:os.mkdir,path:{marker}}}",
        "+_target_=os.mkdir +path={marker} model.method=x",
        "'model.method=!!python/object/apply:os.mkdir'",
        "'model.method=${{oc.decode:\"__import__\"}}'",
        "'model.method=${{eval:1}}'",
    ],
)
def test_settings_of_a_call(override: str, marker: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import shlex

    words = shlex.split(override.format(marker=marker))
    with pytest.raises(SystemExit) as stop:
        main(["flow", "dry_run=true", f"output={tmp_path / 'output'}", "data=arrays", f"data.root={tmp_path}", *words])
    assert stop.value.code == 2 and "error: " in capsys.readouterr().err


def test_metadata_of_an_archive_is_never_unpacked(tmp_path: Path) -> None:
    from cflow_torch.evaluation.submission import check_submission, get_version

    file = tmp_path / "v2.zip"
    names = ("../escaped.feather", "/tmp/escaped.feather", "log/../../escaped.feather", "C:\\escaped.feather", "con")
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, b"x")
    problems = check_submission(file, get_version(3), [])
    assert len([line for line in problems if "unsafe name" in line]) == 4 and os.listdir(tmp_path) == ["v2.zip"]
