"""How much a model does and holds, counted without a clock: the same figures on a busy machine and on a fast one."""

from __future__ import annotations

import sys
import tracemalloc
from collections import Counter
from functools import lru_cache
from typing import Any, Callable, Dict, List, Tuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from cflow_torch.types import FlowResult

Run = Callable[[], List[FlowResult]]

# Operations after which the host must wait for a GPU: the size or value of the result decides what comes next. Some
# wait twice (unique, bincount); they count once.
_WAITING = {
    "_local_scalar_dense",  # item, int, float, bool of a tensor
    "nonzero",
    "equal",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "masked_select",
    "bincount",
}
# Functions of ops/indices.py that NumPy does on a CPU and torch on a GPU, where the host need not wait for them.
_NUMPY_ON_CPU = {"divide", "largest_of_rows"}
# Not views by their schema, but nothing is computed.
_IDLE = {"_unsafe_view", "lift_fresh", "detach_"}


def count_work(run: Run) -> Dict[str, int]:
    """Count what one call of a model does.

    Args:
        run: calls the model; called twice.

    Returns:
        "operations": tensor operations that torch dispatched, views left out: on a GPU each is about one kernel launch,
        on a CPU each costs some microseconds, whatever its size. "waits": times that the host would wait for a GPU:
        `nonzero`, `item`, `equal`, `unique`, indices by a mask, ... "uploads": times that values of the host would be
        sent to a GPU: `torch.tensor`, `as_tensor`, `to(device)`.

    Convention:
        On the CPU waits and uploads stand in for a GPU: they count the calls that would wait or send there. The counts
        depend on the input and the device, hardly on the version of torch, and not on threads.
    """
    run()
    operations, calls = _Operations(), _Calls()
    with calls, operations:
        run()
    waits = operations.waits + calls.waits
    return {"operations": operations.count, "waits": sum(waits.values()), "uploads": calls.uploads}


def count_allocations(run: Run) -> Tuple[int, int]:
    """Bytes that a run asks for, in sum and at most at once; no clock and no operating system in it.

    Args:
        run: called up to three times.

    Returns:
        allocated: bytes of all allocations of tensors together, temporaries inside of operations included.
        peak: most bytes held at once above those before the run; results count, the input does not.

    Convention:
        On the CPU `peak` is the largest sum of living tensors plus the largest sum of what Python and NumPy held: an
        upper bound, because the two need not meet. On a GPU it is what torch's allocator handed out there.
    """
    device = run()[0].flow.device
    if device.type == "cuda":
        return _count_on_gpu(run, device)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        run()
    # Every allocation and every release of the CPU's allocator, in order; only the raw events have those inside of
    # operations.
    events: Any = profiler.profiler
    changes = [event for event in events.kineto_results.events() if event.name() == "[memory]"]
    changes.sort(key=_start)
    allocated = now = peak = 0
    for change in changes:
        allocated += max(change.nbytes(), 0)
        now += change.nbytes()
        peak = max(peak, now)
    return allocated, peak + _python_peak(run)


def _start(event: Any) -> int:
    # torch before 2.4 counts microseconds
    return event.start_ns() if hasattr(event, "start_ns") else event.start_us()


def _python_peak(run: Run) -> int:
    """Most bytes that Python and NumPy held at once during a run above those before it."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def _count_on_gpu(run: Run, device: torch.device) -> Tuple[int, int]:
    """As `count_allocations`, by torch's own statistics."""
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_stats(device)
    run()
    after = torch.cuda.memory_stats(device)
    total, most, now = "allocated_bytes.all.allocated", "allocated_bytes.all.peak", "allocated_bytes.all.current"
    return after[total] - before[total], after[most] - before[now]


class _Operations(TorchDispatchMode):
    """Counts what reaches torch's kernels."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.waits: Counter = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        # In inference mode composite operations come undivided. One with a number is one operation with a tensor, which
        # torch 2.0 would hand the number all the same.
        if _is_composite(func) and func._overloadname != "Scalar":
            with self:
                return func.decompose(*args, **kwargs)
        result = func(*args, **kwargs)
        if func.namespace == "aten" and not _is_view(func):
            self.count += 1
            self.waits[_name(func)] += _must_wait(_name(func), args, kwargs, result)
        return result


class _Calls(TorchFunctionMode):
    """Counts calls that leave torch or enter it, which no kernel sees."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter = Counter()
        self.uploads = 0

    def __torch_function__(self, func: Any, types: Any, args: Tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        # On another device the copy is seen as an operation.
        is_wait = name in ("numpy", "tolist") and args[0].device.type == "cpu"
        if is_wait and sys._getframe(1).f_code.co_name not in _NUMPY_ON_CPU:
            self.waits[name] += 1
        moves = name == "to" and any(isinstance(value, (torch.device, str)) for value in (*args, *kwargs.values()))
        self.uploads += moves or name in ("tensor", "as_tensor")
        return func(*args, **kwargs)


@lru_cache(maxsize=None)
def _name(func: Any) -> str:
    """`add` of aten::add.Tensor."""
    return func._schema.name.split("::")[-1]


@lru_cache(maxsize=None)
def _is_composite(func: Any) -> bool:
    """Made of other operations."""
    return torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), "CompositeImplicitAutograd")


@lru_cache(maxsize=None)
def _is_view(func: Any) -> bool:
    """The result is another look at the input: nothing is computed."""
    aliases = [value.alias_info for value in func._schema.returns]
    return _name(func) in _IDLE or any(alias is not None and not alias.is_write for alias in aliases)


def _must_wait(name: str, args: Tuple[Any, ...], kwargs: Dict[str, Any], result: Any) -> bool:
    """Whether the host would wait for a GPU."""
    if name in _WAITING:
        return True
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        by_mask = any(isinstance(i, Tensor) and i.dtype in (torch.bool, torch.uint8) for i in args[1])
        return by_mask and (name == "index" or args[2].numel() != 1)  # one value: `masked_fill`, which does not wait
    if name in ("_to_copy", "copy_"):
        source = args[1] if name == "copy_" else args[0]
        return source.is_cuda and not result.is_cuda
    return False
