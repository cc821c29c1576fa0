"""Estimate free memory, refuse work that does not fit, and split windows into groups that do."""

from __future__ import annotations

import ctypes
import math
import sys
from contextlib import suppress
from pathlib import Path
from typing import Mapping, Sequence

import torch

from cflow_torch.types import CFlowError, Window
from cflow_torch.windows.bev_grid import Grid

_MUCH = 1 << 30  # bytes; we check only larger requests
# Options of `mallopt` in the GNU C library.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_CGROUP = Path("/sys/fs/cgroup")
# Working memory of one pixel of one sweep (occupancy and cluster) before the clusters are known.
_BYTES_PER_PIXEL = 10
# Memory of a group on a CPU if `max_memory` is None: some pairs, or one window of six sweeps. Larger groups save
# operations, but fresh pages of memory cost more.
_BYTES_ON_CPU = 1 << 29
_SHARE_OF_GPU = 0.5  # of its free memory, for a group on a GPU if `max_memory` is None


def require_memory(num_bytes: int, device: torch.device, what: str, remedy: str) -> None:
    """Raise a `CFlowError` if so much memory is not free, because a system that runs out of memory kills the process.

    The message begins with `what`, for example "a window of ...", and ends with `remedy`, which says what to do.
    """
    if num_bytes <= _MUCH:
        return
    free = _free_memory(device)
    if free is not None and num_bytes > free:
        raise CFlowError(
            f"{what} needs about {num_bytes / 1e9:.1f} GB of memory ({num_bytes} bytes), {device} has "
            f"{free / 1e9:.1f} GB left: {remedy}"
        )


def _free_memory(device: torch.device) -> int | None:
    """Return the bytes that are free on a device; None if the system does not report it."""
    if device.type != "cuda":
        return available_memory({})
    cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(torch.cuda.mem_get_info(device)[0]) + cached


def available_memory(environ: Mapping[str, str]) -> int | None:
    """Return the bytes that this process may still allocate: free memory within the limits of its control groups. In a
    torchrun job, this is divided by LOCAL_WORLD_SIZE of `environ`. None if the system does not report it."""
    free = []
    with suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free.append(1024 * int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]))
    for group in control_groups():
        with suppress(OSError, ValueError):  # a limit of "max" is not a number
            limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
            free.append(limit - used)
    return min(free) // int(environ.get("LOCAL_WORLD_SIZE", 1)) if free else None


def peak_memory() -> int | None:
    """Return the largest resident memory of this process so far, bytes; None if the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def keep_freed_memory() -> bool:
    """Let this process keep the memory that it frees, for the next window, and return whether the system can do that.

    A window on a CPU uses some hundred megabytes of tensors. By default, the GNU C library gives large ones back to the
    system, which must clear each page before it is used again. The setting holds until the process ends. The process
    then stays as large as its largest window. The commands do this in their own processes. Nothing changes on a GPU.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # not the GNU C library
        return False
    accepted = [mallopt(option, value) for option, value in ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, -1))]
    return all(accepted)


def control_groups() -> list[Path]:
    """Return the folders of the control groups (version 2) of this process, innermost first."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        group = _CGROUP / next(line[3:] for line in lines if line.startswith("0::")).lstrip("/")
        return [folder for folder in (group, *group.parents) if _CGROUP in (folder, *folder.parents)]
    return []


def split_windows(
    windows: Sequence[Window], grid: Grid, device: torch.device, bytes_per_point: int, max_memory: float | None
) -> list[list[Window]]:
    """Split checked windows, in order, into groups that fit into memory. Results do not depend on the grouping.

    The grid is that of the finest scale, whose images are the largest. `max_memory` is in bytes per group; None = half
    of the free memory of a GPU, 512 MiB on a CPU, where large groups are slower. A window that needs more is a group of
    its own. One that exceeds free memory is a `CFlowError`."""
    groups: list[list[Window]] = []
    if max_memory is None and device.type == "cpu":
        max_memory = _BYTES_ON_CPU
    elif max_memory is None:
        free = _free_memory(device)
        max_memory = math.inf if free is None else _SHARE_OF_GPU * free
    used = 0
    for window in windows:
        sweeps = window.sweeps
        points = sum(sweep.points.shape[0] for sweep in sweeps)
        needed = bytes_per_point * points + (_BYTES_PER_PIXEL * len(sweeps) + 30) * grid.height * grid.width
        require_memory(
            needed,
            device,
            f"a window of {points} points in {len(sweeps)} sweeps, on {grid.width} x {grid.height} pixels of "
            f"{grid.pixel_size} m,",
            "give a smaller point_cloud_range, larger pixel_sizes or fewer points",
        )
        if not groups or used + needed > max_memory:
            groups.append([])
            used = 0
        groups[-1].append(window)
        used += needed
    return groups
