"""The fixed simulated benchmark: drives from fixed seeds, written once.

Seeds 300 ... 319 and 750 ... 751 are held out for scores. docs/benchmarks.md lists the seeds on which we chose
settings. Do not score on those.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

from tqdm import tqdm

from cflow_torch.data.catalog import find_sources
from cflow_torch.data.hdf5.writer import write_hdf5_log
from cflow_torch.simulator.drive import drive_name, make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Format:
    """The writer and reader of drives.

    Args:
        data_set: name of the reader in `catalog.DATA_SETS`.
        write: function (drive, root) that writes the drive below an existing folder. Drives are made again if its
            module, or one next to it, changes.
        settings: options of the reader, for every drive.
    """

    data_set: str
    write: Callable[[Any, Path], Any]
    settings: Mapping[str, Any] = field(default_factory=dict)


AV2, HDF5 = Format("av2", write_av2_log), Format("hdf5", write_hdf5_log)
_OTHERS = ("nuscenes", "truckscenes", "waymo", "aevascenes")  # these data sets store more digits than Argoverse 2


def format_of(profile: str) -> Format:
    """Format of a sensor profile: HDF5 scenes for the sensors of other data sets, Argoverse 2 for the rest."""
    return HDF5 if profile in _OTHERS else AV2


def generator_key(chosen: Format = AV2) -> str:
    """Digest of the code of simulator and writer. We never reuse cached drives that other code made."""
    folder = Path(inspect.getfile(chosen.write)).parent
    files = sorted(_HERE.rglob("*.py"))
    if Path(__file__).parent not in (folder, *folder.parents):
        files += sorted(folder.glob("*.py"))
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def benchmark_logs(
    cache: str | Path,
    profile: str,
    seeds: Sequence[int],
    num_sweeps: int,
    scenes: Sequence[str] = ("street",),
    chosen: Format | None = None,
) -> list[Any]:
    """Return the benchmark's drives of one sensor as sources for `catalog.open_log`. Simulate those not yet cached.

    Args:
        cache: folder for the drives: `cache/<generator key>-<sweeps>/<log id>`.
        profile: a sensor, a name in `profiles.PROFILES`.
        seeds: of the drives, one seed per drive.
        num_sweeps: sweeps per drive that the reader returns; we simulate more if it skips some (`sweep_step`).
        scenes: kinds of scene, assigned to the seeds in rotation.
        chosen: format of the files; None = `format_of(profile)`.

    Returns:
        One source per drive.

    Convention: the cache holds complete drives only, even if several processes write the same drive at once.

    Raises:
        CFlowError: no profile or scene has that name, a seed is negative, or `num_sweeps` is less than 1.

    Cost: about 2 s and 40 MB for a new drive of 20 sweeps of 100,000 points.
    """
    chosen = chosen or format_of(profile)
    folder = Path(cache) / f"{generator_key(chosen)}-{num_sweeps}"
    num_simulated = num_sweeps * int(chosen.settings.get("sweep_step", 1))
    found: list[Any] = []
    for number, seed in enumerate(tqdm(seeds, unit="drive", desc=profile, disable=None, file=sys.stderr)):
        scene = scenes[number % len(scenes)]
        target = folder / drive_name(seed, profile, scene)
        if not target.is_dir():
            drive = make_drive(seed, num_simulated, profile, scene)
            folder.mkdir(parents=True, exist_ok=True)
            scratch = Path(tempfile.mkdtemp(prefix=".making-", dir=folder))
            try:
                chosen.write(drive, scratch)
                os.rename(scratch, target)
            except OSError:
                if not target.is_dir():  # else another process has just written the same drive
                    raise
            finally:
                shutil.rmtree(scratch, ignore_errors=True)
        found += find_sources(chosen.data_set, target)
    return found
