"""A pretend accelerator: the CPU computes, but the tensors report another device. Needs torch 2.9.

As on a GPU, an operation on tensors of two devices raises. We count the launched kernels and the waits of the host.
"""

from __future__ import annotations

import inspect
from typing import Any, Callable

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode

IS_THERE = hasattr(backend_registration, "_setup_privateuseone_for_python_backend")
# Operations for whose result the host has to wait.
_WAITING = {"_local_scalar_dense", "nonzero", "equal", "masked_select", "bincount"}
_WAITING |= {"_unique2", "unique_dim", "unique_consecutive"}
_IDLE = {"_unsafe_view", "lift_fresh", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"}
_MOVES = {"_to_copy", "copy_"}  # between devices

if IS_THERE:

    class _Backend(backend_registration._DummyBackendModule):
        def is_available(self) -> bool:
            return True

        def current_device(self) -> int:
            return 0

        def device_count(self) -> int:
            return 1

        def get_amp_supported_dtype(self) -> Any:
            return [torch.float16]

    backend_registration._setup_privateuseone_for_python_backend("pretend", backend_module=_Backend())
    DEVICE = torch.device("pretend", 0)


class _Remote(Tensor):
    """A tensor of the pretend device. `host` holds its values."""

    host: Tensor

    @staticmethod
    def __new__(cls, host: Tensor) -> _Remote:
        layout = {"strides": host.stride(), "storage_offset": host.storage_offset(), "dtype": host.dtype}
        remote = Tensor._make_wrapper_subclass(cls, host.shape, device=DEVICE, **layout)  # type: ignore[attr-defined]
        remote.host = host
        return remote  # type: ignore[no-any-return]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError("tensors of the pretend device can only be used inside of `PretendDevice`")


class PretendDevice(TorchDispatchMode):
    """A context in which the device `DEVICE` exists."""

    def __init__(self) -> None:
        super().__init__()
        self._launches = self._waits = 0
        self._constructors = _Constructors(self)
        self._inference_mode = torch.inference_mode

    def count(self, run: Callable[[], Any]) -> tuple[int, int]:
        """Count the kernels that a call launches, and how often the host waits for the device or sends it values."""
        self._launches = self._waits = 0
        run()
        return self._launches, self._waits

    def __enter__(self) -> PretendDevice:
        torch.inference_mode = lambda *_: torch.no_grad()  # type: ignore  # tensor wrappers do not work in inference mode
        self._constructors.__enter__()
        return super().__enter__()  # type: ignore[no-any-return]

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._constructors.__exit__(*error)
        torch.inference_mode = self._inference_mode  # type: ignore[misc]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func._schema.name.split("::")[1]
        tensors: list[Tensor] = []
        _each(lambda x: tensors.append(x) if isinstance(x, Tensor) else None, [args, list(kwargs.values())])
        remote = [x for x in tensors if isinstance(x, _Remote)]
        local = [x for x in tensors if not isinstance(x, _Remote)]
        target = torch.device(kwargs["device"]) if kwargs.get("device") is not None else None
        if name == "copy_":
            target = args[0].device
        if remote and name not in _MOVES and any(x.dim() for x in local):
            raise RuntimeError(f"{name}: tensors of two devices, {DEVICE} and {local[0].device}")
        is_here = target == DEVICE if target is not None else bool(remote)
        if remote or is_here:
            crosses = name in _MOVES and (not is_here or bool(local))
            self._waits += crosses or bool(remote) and _must_wait(name, args, kwargs)
            self._launches += not _is_free(func, name)
        if kwargs.get("device") is not None and is_here:
            kwargs["device"] = torch.device("cpu")
        out = func(*_each(_host, args), **{key: _each(_host, value) for key, value in kwargs.items()})
        if not is_here:
            return out
        known = {id(x.host): x for x in remote}  # written in place

        def wrapped(x: Any) -> Any:
            return x if not isinstance(x, Tensor) else known[id(x)] if id(x) in known else _Remote(_plain(x))

        return _each(wrapped, out)


# torch wraps the method, and the wrapper imports its compiler, which takes seconds.
PretendDevice.__torch_dispatch__ = inspect.unwrap(PretendDevice.__torch_dispatch__)  # type: ignore[method-assign]


class _Constructors(TorchFunctionMode):
    """Constructors and `tolist`, which do not reach `__torch_dispatch__`."""

    def __init__(self, device: PretendDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            device = kwargs.pop("device")
            return func(*args, **kwargs).to(device)
        if func is Tensor.tolist and isinstance(args[0], _Remote):
            self._device._waits += 1
            return args[0].host.tolist()
        return func(*args, **kwargs)


def _each(use: Callable[[Any], Any], value: Any) -> Any:
    """Call a function with each member of nested lists and tuples; torch's `tree_map` takes longer than the kernels."""
    return type(value)([_each(use, x) for x in value]) if isinstance(value, (list, tuple)) else use(value)


def _host(x: Any) -> Any:
    return x.host if isinstance(x, _Remote) else x


def _plain(x: Tensor) -> Tensor:
    """Resolve conjugate and negative views, which a wrapper cannot represent."""
    return x.resolve_conj().resolve_neg()


def _is_free(func: Any, name: str) -> bool:
    """Whether the operation computes nothing: a view of its input, or an allocation."""
    aliases = [value.alias_info for value in func._schema.returns]
    return name in _IDLE or any(alias is not None and not alias.is_write for alias in aliases)


def _must_wait(name: str, args: Any, kwargs: Any) -> bool:
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    if name in ("index", "index_put", "index_put_"):
        by_mask = any(isinstance(i, Tensor) and i.dtype == torch.bool for i in args[1])
        return by_mask and (name == "index" or args[2].numel() != 1)  # one value: `masked_fill`
    return name in _WAITING
