"""The fixed simulated benchmark: drives from fixed seeds, written once in the format of each sensor's data set.

Seeds 300 ... 319 and 750 ... 751 are held out for scores. docs/benchmarks.md lists the seeds on which we chose
settings. Do not score on those.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

from tqdm import tqdm

from cflow_torch.data.catalog import find_sources
from cflow_torch.simulator.drive import Drive, make_drive

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Format:
    """The writer and reader of a sensor's drives.

    Args:
        data_set: name of the reader in `catalog.DATA_SETS`, and of the writer's module in `writers`.
        function: name of the writer in that module, a function (drive, root) -> path.
        settings: options of the reader, for every drive.
    """

    data_set: str
    function: str
    settings: Mapping[str, Any] = field(default_factory=dict)


# Sets without a ground mask get one. nuScenes is read at 10 Hz, as in the challenge.
_NO_MASK = {"find_ground": "grid"}
FORMATS: dict[str, Format] = {
    "av2": Format("av2", "write_av2_log"),
    "nuscenes": Format("nuscenes", "write_nuscenes", {**_NO_MASK, "sweep_step": 2}),
    "truckscenes": Format("truckscenes", "write_truckscenes", _NO_MASK),
    "waymo": Format("waymo", "write_waymo_segment", _NO_MASK),
    "aevascenes": Format("aevascenes", "write_aevascenes_sequence"),
}


def format_of(profile: str) -> Format:
    """Format of a sensor profile. Profiles without a data set of their own use the format of Argoverse 2."""
    return FORMATS.get(profile, FORMATS["av2"])


def generator_key() -> str:
    """Digest of the simulator's source code. We never reuse cached drives that other code made."""
    digest = hashlib.sha256()
    for file in sorted(_HERE.rglob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def benchmark_logs(
    cache: str | Path, profile: str, seeds: Sequence[int], num_sweeps: int, scenes: Sequence[str] = ("street",)
) -> list[Any]:
    """Return the benchmark's drives of one sensor as sources for `catalog.open_log`. Simulate those not yet cached.

    Args:
        cache: folder for the drives: `cache/<generator key>-<sweeps>/<log id>`.
        profile: a sensor, a name in `profiles.PROFILES`.
        seeds: of the drives, one seed per drive.
        num_sweeps: sweeps per drive that the reader returns; we simulate more if it skips some (`sweep_step`).
        scenes: kinds of scene, assigned to the seeds in rotation.

    Returns:
        One source per drive.

    Convention: the cache holds complete drives only, even if several processes write the same drive at once.

    Raises:
        CFlowError: no profile or scene has that name, a seed is negative, or `num_sweeps` is less than 1.

    Cost: about 2 s and 40 MB for a new drive of 20 sweeps of 100,000 points.
    """
    folder = Path(cache) / f"{generator_key()}-{num_sweeps}"
    chosen = format_of(profile)
    num_simulated = num_sweeps * int(chosen.settings.get("sweep_step", 1))
    write: Callable[[Drive, Path], Path] = getattr(
        import_module(f"cflow_torch.simulator.writers.{chosen.data_set}"), chosen.function
    )
    found: list[Any] = []
    for number, seed in enumerate(tqdm(seeds, unit="drive", desc=profile, disable=None, file=sys.stderr)):
        # This is cheap: the writer simulates the sweeps.
        drive = make_drive(seed, num_simulated, profile, scenes[number % len(scenes)])
        target = folder / drive.log_id
        if not target.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            scratch = Path(tempfile.mkdtemp(prefix=".making-", dir=folder))
            try:
                write(drive, scratch)
                os.rename(scratch, target)
            except OSError:
                if not target.is_dir():  # else another process has just written the same drive
                    raise
            finally:
                shutil.rmtree(scratch, ignore_errors=True)
        found += find_sources(chosen.data_set, target)
    return found
