"""How much memory a process may still take, and the refusal of what needs more."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import List, Mapping, Optional

import torch

from cflow_torch.types import CFlowError

_MUCH = 1 << 30  # less than this is not worth a look at the machine
_CGROUP = Path("/sys/fs/cgroup")


def require_memory(num_bytes: int, device: torch.device, what: str, remedy: str) -> None:
    """Refuse what does not fit before it is allocated: a system that runs out of memory kills the process.

    Args:
        num_bytes: that are planned with.
        device: whose memory.
        what: "a window of ..., " to begin the message with.
        remedy: what to do about it.

    Raises:
        CFlowError: more is needed than there is.
    """
    if num_bytes <= _MUCH:
        return
    if device.type == "cuda":
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        free: Optional[int] = torch.cuda.mem_get_info(device)[0] + cached
    else:
        free = available_memory({})
    if free is not None and num_bytes > free:
        raise CFlowError(
            f"{what} needs about {num_bytes / 1e9:.1f} GB of memory ({num_bytes} bytes), {device} has "
            f"{free / 1e9:.1f} GB left: {remedy}"
        )


def available_memory(environ: Mapping[str, str]) -> Optional[int]:
    """Bytes that this process may still take: what is free, limits of its control groups, its share of a torchrun job.
    None where the system does not tell."""
    free = []
    with suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free.append(1024 * int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]))
    for group in control_groups():
        with suppress(OSError, ValueError):  # "max" is no number
            limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
            free.append(limit - used)
    return min(free) // int(environ.get("LOCAL_WORLD_SIZE", 1)) if free else None


def peak_memory() -> Optional[int]:
    """Bytes that this process held at most since it began; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def control_groups() -> List[Path]:
    """Control groups (version 2) of this process, the innermost first; empty where there are none."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        group = _CGROUP / next(line[3:] for line in lines if line.startswith("0::")).lstrip("/")
        return [folder for folder in (group, *group.parents) if _CGROUP in (folder, *folder.parents)]
    return []
