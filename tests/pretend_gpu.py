"""A GPU that is not there: tensors that say they live on CUDA, compute on the CPU, and refuse to mix with others.

What a mistake in devices does on a GPU ("expected all tensors to be on the same device", numpy on a CUDA tensor), it
does here too. Triton's kernels run in its interpreter. What a GPU would be asked to do, `listening` tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import torch
from torch.utils._pytree import tree_leaves, tree_map

aten = torch.ops.aten
CUDA = torch.device("cuda", 0)

Listener = Callable[[str, str], None]
_listeners: list[Listener] = []


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within it, the listener is told of what a GPU is asked to do, by kind and name.

    Kinds: a "launch" of a kernel, torch's or Triton's; a "wait" of the host for the device; a "copy" from the host,
    which is a wait, too, unless it is asked not to block. Views and memory that is not written yet ask for nothing.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def _tell(name: str, *kinds: str) -> None:
    for listener in _listeners:
        for kind in kinds:
            listener(kind, name)


class OnGpu(torch.Tensor):
    """A tensor that says it is on CUDA; `here` is the CPU tensor behind it."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> OnGpu:
        pretended = torch.Tensor._make_wrapper_subclass(
            cls, here.size(), here.stride(), here.storage_offset(), dtype=here.dtype, requires_grad=here.requires_grad
        )
        pretended.here = here.detach()
        return pretended

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def __repr__(self) -> str:
        return f"OnGpu({self.here})"

    def new_tensor(self, *args: Any, **kwargs: Any) -> OnGpu:
        _tell("new_tensor", "copy", "wait")
        return OnGpu(self.here.new_tensor(*args, **kwargs))

    def numpy(self, *_: Any, **__: Any) -> None:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    __array__ = numpy

    def __deepcopy__(self, memo: dict) -> torch.Tensor:
        copied = OnGpu(self.here.clone()).requires_grad_(self.requires_grad)
        return torch.nn.Parameter(copied, self.requires_grad) if isinstance(self, torch.nn.Parameter) else copied

    def data_ptr(self) -> int:
        return self.here.data_ptr()

    def tolist(self) -> Any:
        _tell("tolist", "wait")
        return self.here.tolist()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        # Indices may lie on the CPU, as those of a list do; they are copied.
        copies = func in (aten.copy_.default, aten._to_copy.default, aten.index.Tensor)
        for leaf in tree_leaves((args, kwargs)):
            if isinstance(leaf, torch.Tensor) and not isinstance(leaf, OnGpu) and leaf.ndim and not copies:
                raise RuntimeError(f"{func}: expected all tensors to be on the same device, found cuda:0 and cpu")
        if _listeners:
            _tell(func.overloadpacket.__name__, *_kinds(func, args, kwargs))
        if func is aten.copy_.default and not isinstance(args[0], OnGpu):
            args[0].copy_(args[1].here)
            return args[0]
        result = func(*tree_map(_behind, args), **{**tree_map(_behind, kwargs)})
        for name, value in zip(func._schema.arguments, args, strict=False):
            if name.alias_info is not None and name.alias_info.is_write:
                return value if isinstance(result, torch.Tensor) else tree_map(_pretend, result)
        return tree_map(_pretend, result)


# They give memory, or an answer that needs no look at the numbers.
NO_LAUNCH = ("_unsafe_view", "empty_like", "empty_strided", "is_same_size", "new_empty", "new_empty_strided")


def _kinds(func: Any, args: tuple, kwargs: dict) -> Iterator[str]:
    """What one of torch's operations asks of a GPU."""
    name, second = func.overloadpacket.__name__, args[1] if len(args) > 1 else None
    if name == "_local_scalar_dense" or (name == "copy_" and not isinstance(args[0], OnGpu)):
        yield "wait"
        return
    if name == "copy_" and not isinstance(second, OnGpu):
        yield from ("copy",) if len(args) > 2 and args[2] else ("copy", "wait")
        return
    leaves = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor) and leaf.ndim]
    if not all(isinstance(leaf, OnGpu) for leaf in leaves):
        yield from ("copy", "wait")
    elif name.startswith("index") and isinstance(second, list | tuple):
        if any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in second):
            yield "wait"  # how many a mask holds, the device knows
    elif {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags):
        yield "wait"
    if not (func.is_view or name in NO_LAUNCH):
        yield "launch"


def _behind(value: Any) -> Any:
    return value.here if isinstance(value, OnGpu) else value


def _pretend(value: Any) -> Any:
    return OnGpu(value) if isinstance(value, torch.Tensor) and not isinstance(value, OnGpu) else value


def _is_cuda(value: Any) -> bool:
    if isinstance(value, torch.device):
        return value.type == "cuda"
    return isinstance(value, str) and value.partition(":")[0] == "cuda"


FACTORIES = ("arange", "as_tensor", "empty", "eye", "full", "linspace", "ones", "rand", "randint", "randn", "tensor")
FACTORIES += ("zeros", "empty_like", "full_like", "ones_like", "zeros_like")
_to = torch.Tensor.to


def _makes(factory: Callable) -> Callable:
    """A factory function that knows the device."""

    def make(*args: Any, **kwargs: Any) -> torch.Tensor:
        kwargs.pop("pin_memory", None)
        if not _is_cuda(kwargs.get("device")):
            return factory(*args, **kwargs)
        if factory.__name__ in ("as_tensor", "tensor"):
            _tell(factory.__name__, "copy", "wait")
        elif not factory.__name__.startswith("empty"):
            _tell(factory.__name__, "launch")
        return OnGpu(factory(*tree_map(_behind, args), **{**kwargs, "device": "cpu"}))

    return make


def _move(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
    """`Tensor.to`."""
    other = next((v for v in args if isinstance(v, torch.Tensor)), None)
    places = [v for v in (*args, kwargs.get("device"), getattr(other, "device", None)) if v is not None]
    place = next((torch.device(v) for v in places if isinstance(v, torch.device | str)), tensor.device)
    dtypes = [v for v in (*args, kwargs.get("dtype"), getattr(other, "dtype", None)) if isinstance(v, torch.dtype)]
    if isinstance(tensor, OnGpu) != (place.type == "cuda"):
        blocks = isinstance(tensor, OnGpu) or not kwargs.get("non_blocking")
        kinds = [] if isinstance(tensor, OnGpu) else ["copy"]
        _tell(f"to {place.type}", *kinds, *["wait"] * blocks)
        tensor = (_ToCpu if isinstance(tensor, OnGpu) else _ToGpu).apply(tensor)
    return _to(tensor, dtypes[0]) if dtypes else tensor


class _ToGpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return OnGpu(tensor.detach().clone())

    @staticmethod
    def backward(ctx, grad):
        _tell("to cpu", "wait")
        return grad.here


class _ToCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return tensor.here.clone()

    @staticmethod
    def backward(ctx, grad):
        _tell("to cuda", "copy", "wait")
        return OnGpu(grad)


@contextmanager
def pretended_gpu() -> Iterator[torch.device]:
    """Within it, torch seems to have one CUDA device, which is what is yielded."""
    interpreter = pytest.importorskip("triton.runtime.interpreter", reason="Triton is not installed")
    launch = interpreter.GridExecutor.__call__

    def on_the_cpu(self, *args, **kwargs):
        _tell(self.fn.__name__, "launch")
        return launch(self, *tree_map(_behind, args), **tree_map(_behind, kwargs))

    properties = SimpleNamespace(multi_processor_count=2, total_memory=1 << 33, name="a GPU that is not there")
    with (
        # Modules get new parameters when they move, for old ones are of another type.
        mock.patch.object(torch.__future__, "get_overwrite_module_params_on_conversion", lambda: True),
        mock.patch.object(torch.cuda, "is_available", lambda: True),
        mock.patch.object(torch.cuda, "device_count", lambda: 1),
        mock.patch.object(torch.cuda, "current_device", lambda: 0),
        mock.patch.object(torch.cuda, "set_device", lambda _: None),
        mock.patch.object(torch.cuda, "synchronize", lambda *_: None),
        mock.patch.object(torch.cuda, "get_device_properties", lambda *_: properties),
        mock.patch.object(torch.cuda, "get_device_capability", lambda *_: (9, 0)),
        mock.patch.object(torch.cuda, "is_bf16_supported", lambda *_: True),
        mock.patch.object(interpreter.GridExecutor, "__call__", on_the_cpu),
        mock.patch.object(torch.Tensor, "to", _move),
        mock.patch.object(torch.Tensor, "cpu", lambda tensor: _move(tensor, "cpu")),
        mock.patch.multiple(torch, **{name: _makes(getattr(torch, name)) for name in FACTORIES}),
    ):
        yield CUDA
