"""How much memory a process may still take, and the refusal of what needs more."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import List, Mapping, Optional

import torch

from cflow_torch.types import CFlowError

# Less than this is not worth a look at the machine.
_MUCH = 1 << 30
_CGROUP = Path("/sys/fs/cgroup")


def require_memory(num_bytes: int, device: torch.device, what: str, mend: str) -> None:
    """Refuse what does not fit, before any of it is asked for: a system that runs out of memory kills the process.

    Args:
        num_bytes: that are planned with.
        device: whose memory.
        what: "a window of ..., " to begin the message with.
        mend: what to do about it.

    Raises:
        CFlowError: more is needed than there is.
    """
    if num_bytes <= _MUCH:
        return
    free = _free_on_gpu(device) if device.type == "cuda" else available_memory({})
    if free is not None and num_bytes > free:
        raise CFlowError(
            f"{what} needs about {num_bytes / 1e9:.1f} GB of memory ({num_bytes} bytes), {device} has "
            f"{free / 1e9:.1f} GB left: {mend}"
        )


def _free_on_gpu(device: torch.device) -> int:
    """Bytes that nobody uses, and what this process keeps in stock."""
    in_stock = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + in_stock


def available_memory(environ: Mapping[str, str]) -> Optional[int]:
    """Bytes that this process may still take: what is free, its groups' limits, its share of a SLURM or torchrun job;
    None where nobody tells."""
    free = []
    with suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free.append(1024 * int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]))
    for group in control_groups():
        with suppress(OSError, ValueError):
            limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
            free.append(limit - used)
    if environ.get("SLURM_MEM_PER_NODE", "").isdigit():
        free.append(int(environ["SLURM_MEM_PER_NODE"]) << 20)
    neighbours = re.match(r"\d+", environ.get("LOCAL_WORLD_SIZE") or environ.get("SLURM_STEP_TASKS_PER_NODE") or "1")
    share = min(free) // max(1, int(neighbours[0])) if free and neighbours else None
    if environ.get("SLURM_MEM_PER_CPU", "").isdigit():
        per_task = int(environ["SLURM_MEM_PER_CPU"]) * int(environ.get("SLURM_CPUS_PER_TASK", "1")) << 20
        share = per_task if share is None else min(share, per_task)
    return share


def control_groups() -> List[Path]:
    """Control groups (version 2) that bound this process, the innermost first; none where there are no such."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        group = _CGROUP / next(line[3:] for line in lines if line.startswith("0::")).lstrip("/")
        return [folder for folder in (group, *group.parents) if _CGROUP in (folder, *folder.parents)]
    return []
