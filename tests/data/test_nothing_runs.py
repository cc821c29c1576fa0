"""Nothing from a file is executed: files with pickled code are refused, and their code did not run."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import pytest
from tiny_recording import TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.aevascenes import AevaScenesLog
from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.files import read_npy
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence


class Payload:
    """Creates a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> Any:
        return os.mkdir, (self.marker,)


@pytest.fixture
def marker(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "marker"
    assert not (tmp_path / "marker").exists(), "something ran"


def objects(marker: Path, shape: tuple[int, ...] = (1,)) -> np.ndarray:
    values = np.empty(shape, dtype=object)
    values.fill(Payload(marker))
    return values


def test_the_payload_works(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Payload(tmp_path / "marker")))
    assert (tmp_path / "marker").is_dir()


def test_arrays_of_objects_are_refused(marker: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", objects(marker, (4, 3)))
    np.savez(tmp_path / "a.npz", points=objects(marker, (4, 3)))
    with pytest.raises(CFlowError, match="a.npy.*copy it"):
        read_npy(tmp_path / "a.npy", "copy it")
    with pytest.raises(CFlowError, match="a.npz.*pass plain arrays"):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("key", ["semantic_labels", "xyz", "velocity"])
def test_pickled_strings_run_nothing(key: str, marker: Path, tmp_path: Path) -> None:
    """The labels may be pickled text, but nothing else."""
    folder = write_aevascenes_sequence(TinyRecording(("front",), num_sweeps=2), tmp_path / "data")
    for file in folder.rglob("*.npz"):
        with np.load(file, allow_pickle=True) as stored:  # our own
            arrays = {name: stored[name] for name in stored.files}
        np.savez(file, **{**arrays, key: objects(marker, arrays[key].shape)})
    with pytest.raises(CFlowError, match=key):
        log = AevaScenesLog(folder)
        log.sweep(0), log.radial_velocity(0)
