"""The fixed synthetic benchmark: simulated drives from fixed seeds, made once and kept as logs in Argoverse 2's format.

Seeds 300 and above are for scores. 100 ... 103 and 200 ... 209 were used to choose settings and must not be scored.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import List, Sequence, Union

from tqdm import tqdm

from cflow_torch.data import synthetic, writers
from cflow_torch.data.synthetic import make_drive
from cflow_torch.data.writers import write_av2_log


def generator_key() -> str:
    """Digest of the code that makes the drives. Any change of it makes cached drives unusable."""
    digest = hashlib.sha256()
    files = sorted(Path(synthetic.__file__).parent.glob("*.py"))
    for file in (*files, Path(writers.__file__)):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def benchmark_logs(
    cache: Union[str, Path], profiles: Sequence[str], seeds: Sequence[int], num_sweeps: int
) -> List[Path]:
    """Folders of the benchmark's drives, sensor by sensor; those that are not in the cache are made.

    Args:
        cache: folder for the drives: `cache/<generator key>-<sweeps>/<log id>`.
        profiles: sensors, names in `synthetic.profiles.PROFILES`.
        seeds: one drive each, for every sensor.
        num_sweeps: sweeps per drive.

    Returns:
        Argoverse 2 log folders.

    Convention: a drive appears in the cache whole or not at all, also when several processes make it at once.

    Raises:
        CFlowError: no such profile, seed or number of sweeps out of range.

    Cost: about 2 s and 40 MB per drive of 20 sweeps, once.
    """
    folder = Path(cache) / f"{generator_key()}-{num_sweeps}"
    found = []
    drives = [(profile, seed) for profile in profiles for seed in seeds]
    for profile, seed in tqdm(drives, unit="drive", desc="benchmark", disable=None, file=sys.stderr):
        drive = make_drive(seed=seed, num_sweeps=num_sweeps, profile=profile)  # cheap: sweeps are scanned when written
        target = folder / drive.log_id
        if not target.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            scratch = Path(tempfile.mkdtemp(prefix=".making-", dir=folder))
            try:
                os.rename(write_av2_log(drive, scratch), target)
            except OSError:
                if not target.is_dir():  # else another process was faster; its drive is the same
                    raise
            finally:
                shutil.rmtree(scratch, ignore_errors=True)
        found.append(target)
    return found
