"""The number of workers, their devices, and the batch size on this machine."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, Mapping

import torch

from cflow_torch.config import Config
from cflow_torch.setting import AUTO
from cflow_torch.types import CFlowError
from cflow_torch.windows.memory import available_memory, control_groups

# Bytes of one worker: nearly twice the most that we measured with `default`, see docs/fleet.md.
WORKER_MEMORY = 1_500_000_000
# Windows that are computed together. On a CPU, up to 4 are faster, because there are fewer small operations; more are
# slower, because they exceed the caches. We have not measured the number for a GPU.
CPU_BATCH, GPU_BATCH = 4, 32


def frames_per_worker(config: Config) -> int:
    """Return the least number of frames for which another worker on a CPU saves time.

    A process takes as long to start as about 10 windows of the verified method, or 30 to 100 windows of the others.
    """
    return 20 if config.method == "verified" else 100


def choose_devices(device: str, workers: Any, environ: Mapping[str, str]) -> tuple[str, ...]:
    """Return the device of each worker.

    Args:
        device: "auto", "cpu", "cuda" or "cuda:2".
        workers: processes; "auto" = on a CPU one per core, as far as memory allows, on GPUs one per GPU.
        environ: environment variables. LOCAL_RANK or SLURM_LOCALID choose the GPU where several processes share a
            machine; LOCAL_WORLD_SIZE and SLURM_CPUS_PER_TASK limit the cores.
    """
    gpus = _gpus(device, environ)
    if workers != AUTO:
        count = workers
    elif gpus:
        count = len(gpus)
    else:
        count, memory = usable_cores(environ), available_memory(environ)
        if memory is not None:
            count = max(1, min(count, memory // WORKER_MEMORY))
    return tuple(gpus[k % len(gpus)] for k in range(count)) if gpus else ("cpu",) * count


def choose_batch(batch: Any, device: str) -> int:
    """Return the number of windows that a worker on this device computes together."""
    return (CPU_BATCH if device == "cpu" else GPU_BATCH) if batch == AUTO else int(batch)


def _gpus(device: str, environ: Mapping[str, str]) -> list[str]:
    """Return the GPUs of this process; none on a CPU."""
    name = str(device)
    if name == "cpu" or (name == AUTO and not torch.cuda.is_available()):
        return []
    if name not in (AUTO, "cuda"):
        return [name]
    found = torch.cuda.device_count()
    if found == 0:
        raise CFlowError(f"device={name}: torch finds no GPU on this machine; give device=cpu or device=auto")
    rank = environ.get("LOCAL_RANK", environ.get("SLURM_LOCALID"))
    return [f"cuda:{k}" for k in range(found)] if rank is None else [f"cuda:{int(rank) % found}"]


def usable_cores(environ: Mapping[str, str]) -> int:
    """Count the cores of this process: its affinity, its container's quota and its SLURM or torchrun job limit them."""
    counts = [os.cpu_count() or 1]
    with suppress(AttributeError):  # not on every system
        counts.append(len(os.sched_getaffinity(0)))
    for group in control_groups():
        with suppress(OSError, ValueError):  # "max" is not a number
            quota, period = (group / "cpu.max").read_text().split()
            counts.append(int(quota) // int(period))
    with suppress(KeyError, ValueError):
        counts.append(int(environ["SLURM_CPUS_PER_TASK"]))
    with suppress(KeyError, ValueError, ZeroDivisionError):
        counts.append(min(counts) // int(environ["LOCAL_WORLD_SIZE"]))
    return max(1, min(counts))
