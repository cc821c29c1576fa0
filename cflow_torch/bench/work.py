"""How much a model does, counted without a clock: the same figures on a busy machine, a fast one, another day."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Callable, Dict, List, Sequence, Tuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from cflow_torch.bench.memory import count_allocations
from cflow_torch.types import FlowResult, Window

Model = Callable[[Sequence[Window]], List[FlowResult]]

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
# Not views by their schema, but nothing is computed.
_IDLE = {"_unsafe_view", "lift_fresh", "detach_"}


@dataclass(frozen=True)
class Work:
    """What one call of a model did.

    Args:
        operations: tensor operations that torch dispatched, views left out. On a GPU each is about one kernel launch;
            on the CPU, with few points, each costs some microseconds, whatever its size.
        fft_samples: elements that went into Fourier transforms.
        multiply_adds: of matrix products and convolutions.
        allocated_bytes: all memory that was asked for, see `count_allocations`.
        peak_bytes: most memory held at once above the input, see there.
        waits: times that the host would wait for a GPU: `nonzero`, `item`, `equal`, `unique`, indices by a mask, ...
        uploads: times that values of the host would be sent to a GPU: `torch.tensor`, `as_tensor`, `to(device)`. Each
            waits too, unless the memory is pinned.
        operation_counts: the operations by name, most frequent first.
        wait_counts: the waits by name.
    """

    operations: int
    fft_samples: int
    multiply_adds: int
    allocated_bytes: int
    peak_bytes: int
    waits: int
    uploads: int
    operation_counts: Dict[str, int]
    wait_counts: Dict[str, int]

    def as_dict(self) -> Dict[str, Any]:
        """Plain dictionary, ready for JSON."""
        return asdict(self)


def count_work(model: Model, windows: Sequence[Window]) -> Work:
    """Count what a model does on windows, all in one batch.

    Args:
        model: windows in, results out, on any device.
        windows: at least one.

    Returns:
        The counts. They depend on the input and on the device, hardly on the version of torch, and not on threads.

    Convention:
        On the CPU `waits` and `uploads` stand in for a GPU: they count the calls that would wait or send there.
        NumPy's work is counted as one wait per tensor handed over, because only the CPU takes such a short cut. What a
        first call keeps for later ones (tables) is not counted.

    Cost: five calls of the model, some slower than usual.
    """
    model(windows)
    operations, calls = _Operations(), _Calls()
    with calls, operations:
        model(windows)
    allocated_bytes, peak_bytes = count_allocations(lambda: model(windows))
    waits = operations.waits + calls.waits
    return Work(
        operations=sum(operations.counts.values()),
        fft_samples=operations.fft_samples,
        multiply_adds=operations.multiply_adds,
        allocated_bytes=allocated_bytes,
        peak_bytes=peak_bytes,
        waits=sum(waits.values()),
        uploads=calls.uploads,
        operation_counts=dict(operations.counts.most_common()),
        wait_counts=dict(waits.most_common()),
    )


class _Operations(TorchDispatchMode):
    """Counts what reaches torch's kernels."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter = Counter()
        self.waits: Counter = Counter()
        self.fft_samples = 0
        self.multiply_adds = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        # In inference mode composite operations come undivided. One with a number is one operation with a tensor, which
        # torch 2.0 would hand the number all the same.
        if _is_composite(func) and func._overloadname != "Scalar":
            with self:
                return func.decompose(*args, **kwargs)
        result = func(*args, **kwargs)
        name = _name(func)
        if func.namespace != "aten" or _is_view(func):
            return result
        self.counts[name] += 1
        if name.startswith("_fft"):
            self.fft_samples += args[0].numel()
        self.multiply_adds += _multiply_adds(name, args, result)
        if _must_wait(name, args, kwargs, result):
            self.waits[name] += 1
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
        if name in ("numpy", "tolist", "cpu") and args[0].device.type == "cpu":  # else the copy is seen as an operation
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


def _multiply_adds(name: str, args: Tuple[Any, ...], result: Any) -> int:
    """Of matrix products and convolutions, else 0."""
    if name in ("mm", "bmm"):
        return result.numel() * args[0].shape[-1]
    if name in ("addmm", "baddbmm"):
        return result.numel() * args[1].shape[-1]
    if name == "convolution":
        return result.numel() * args[1][0].numel()
    return 0
