"""A fake GPU for machines without one: tensors that claim to be on CUDA and compute on the CPU.

A mistake in devices fails here as on a GPU ("expected all tensors to be on the same device", numpy on a CUDA tensor).
Triton's kernels run in its interpreter. `listen_to_gpu` reports the work that a GPU would be given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest import mock

import pytest
import torch
from torch.utils._pytree import tree_leaves, tree_map

from hyrfpack import device as devices
from hyrfpack.self_test import SelfTest
from hyrfpack.train import step_graphs
from hyrfpack.train.gradients import ViewGradients
from hyrfpack.train.step_checks import StepChecks

aten = torch.ops.aten
CUDA_DEVICE = torch.device("cuda", 0)

Listener = Callable[[str, str], None]
_listeners: list[Listener] = []


@contextmanager
def listen_to_gpu(listener: Listener) -> Iterator[None]:
    """Call the listener with the kind and name of each operation that a GPU is given inside this context.

    A "launch" starts a kernel, torch's or Triton's. In a "wait" the host waits for the device. A "copy" from the host
    is also a wait, unless it is non-blocking and from pinned memory or of at most 64 KiB, which CUDA sends with the
    command. Views and uninitialised memory give the GPU no work.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


MAX_INLINE_COPY_BYTES = 1 << 16


def _may_wait(source: torch.Tensor, non_blocking: bool) -> bool:
    """Return whether CUDA may wait for its queued work when it copies a tensor of the host."""
    small = source.numel() * source.element_size() <= MAX_INLINE_COPY_BYTES
    return not (non_blocking and (small or getattr(source, "is_in_pinned_memory", False)))


def _pin(tensor: torch.Tensor) -> torch.Tensor:
    """Replace `Tensor.pin_memory`."""
    pinned = tensor.clone()
    pinned.is_in_pinned_memory = True
    return pinned


TransferListener = Callable[[str, int], None]
_transfer_listeners: list[TransferListener] = []


@contextmanager
def listen_to_transfers(listener: TransferListener) -> Iterator[None]:
    """Call the listener with the direction, "to host" or "to device", and the number of elements of each transfer."""
    _transfer_listeners.append(listener)
    try:
        yield
    finally:
        _transfer_listeners.remove(listener)


def _report_transfer(direction: str, elements: int) -> None:
    for listener in _transfer_listeners:
        listener(direction, elements)


def _report_work(name: str, *kinds: str) -> None:
    for listener in _listeners:
        for kind in kinds:
            listener(kind, name)


class FakeGpuTensor(torch.Tensor):
    """A tensor that claims to be on CUDA; `cpu_tensor` is the CPU tensor that holds its values."""

    cpu_tensor: torch.Tensor

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> FakeGpuTensor:
        pretended = torch.Tensor._make_wrapper_subclass(
            cls, here.size(), here.stride(), here.storage_offset(), dtype=here.dtype, requires_grad=here.requires_grad
        )
        pretended.cpu_tensor = here.detach()
        return pretended

    device = property(lambda self: CUDA_DEVICE)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def __repr__(self) -> str:
        return f"FakeGpuTensor({self.cpu_tensor})"

    def new_tensor(self, *args: Any, **kwargs: Any) -> FakeGpuTensor:
        _report_work("new_tensor", "copy", "wait")
        made = FakeGpuTensor(self.cpu_tensor.new_tensor(*args, **kwargs))
        _report_transfer("to device", made.numel())
        return made

    def numpy(self, *_: Any, **__: Any) -> None:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    __array__ = numpy

    def __deepcopy__(self, memo: dict) -> torch.Tensor:
        copied = FakeGpuTensor(self.cpu_tensor.clone()).requires_grad_(self.requires_grad)
        return torch.nn.Parameter(copied, self.requires_grad) if isinstance(self, torch.nn.Parameter) else copied

    def data_ptr(self) -> int:
        return self.cpu_tensor.data_ptr()

    def tolist(self) -> Any:
        _report_work("tolist", "wait")
        _report_transfer("to host", self.numel())
        return self.cpu_tensor.tolist()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        # Indices may be on the CPU, as those of a list are; torch copies them.
        copies = func in (aten.copy_.default, aten._to_copy.default, aten.index.Tensor)
        for leaf in tree_leaves((args, kwargs)):
            if isinstance(leaf, torch.Tensor) and not isinstance(leaf, FakeGpuTensor) and leaf.ndim and not copies:
                raise RuntimeError(f"{func}: expected all tensors to be on the same device, found cuda:0 and cpu")
        if _listeners:
            _report_work(func.overloadpacket.__name__, *_work_kinds(func, args, kwargs))
        if func is aten._local_scalar_dense.default:
            _report_transfer("to host", 1)
        if func is aten.copy_.default and isinstance(args[0], FakeGpuTensor) != isinstance(args[1], FakeGpuTensor):
            _report_transfer("to device" if isinstance(args[0], FakeGpuTensor) else "to host", args[1].numel())
        if func is aten.copy_.default and not isinstance(args[0], FakeGpuTensor):
            if len(args) > 2 and args[2]:
                FakeEvent.copies.append((args[0], args[1].cpu_tensor.clone()))
            else:
                args[0].copy_(args[1].cpu_tensor)
            return args[0]
        result = func(*tree_map(_unwrap, args), **{**tree_map(_unwrap, kwargs)})
        for name, value in zip(func._schema.arguments, args, strict=False):
            if name.alias_info is not None and name.alias_info.is_write:
                return value if isinstance(result, torch.Tensor) else tree_map(_wrap, result)
        return tree_map(_wrap, result)


class FakeEvent:
    """A CUDA event. Non-blocking copies to the host arrive when the host waits for the next one."""

    copies: ClassVar[list[tuple[torch.Tensor, torch.Tensor]]] = []

    def record(self) -> None:
        self.copies_before = list(FakeEvent.copies)
        FakeEvent.copies.clear()

    def synchronize(self) -> None:
        _report_work("synchronize", "wait")
        for target, source in self.copies_before:
            target.copy_(source)


class FakeGenerator(torch.Generator):
    """A generator of random numbers that gives those of the CPU on every device."""

    def __new__(cls, device: str | torch.device = "cpu") -> FakeGenerator:
        return super().__new__(cls, "cpu")

    def __init__(self, device: str | torch.device = "cpu") -> None:
        super().__init__()


# These operations only allocate memory, or answer without looking at the values.
OPERATIONS_WITHOUT_LAUNCH = (
    "_unsafe_view",
    "empty_like",
    "empty_strided",
    "is_same_size",
    "new_empty",
    "new_empty_strided",
)


def _work_kinds(func: Any, args: tuple, kwargs: dict) -> Iterator[str]:
    """Yield what kinds of work one of torch's operations gives a GPU."""
    name, second = func.overloadpacket.__name__, args[1] if len(args) > 1 else None
    if name == "_local_scalar_dense":
        yield "wait"
        return
    if name == "copy_" and not isinstance(args[0], FakeGpuTensor) and not (len(args) > 2 and args[2]):
        yield "wait"
        return
    if name == "copy_" and not (isinstance(args[0], FakeGpuTensor) and isinstance(second, FakeGpuTensor)):
        yield from ("copy", "wait") if _may_wait(second, len(args) > 2 and args[2]) else ("copy",)
        return
    leaves = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor) and leaf.ndim]
    if not all(isinstance(leaf, FakeGpuTensor) for leaf in leaves):
        yield from ("copy", "wait")
    elif name.startswith("index") and isinstance(second, list | tuple):
        if any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in second):
            yield "wait"  # only the device knows how many elements a mask selects
    elif {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags):
        yield "wait"
    if not (func.is_view or name in OPERATIONS_WITHOUT_LAUNCH):
        yield "launch"


def _unwrap(value: Any) -> Any:
    return value.cpu_tensor if isinstance(value, FakeGpuTensor) else value


def _wrap(value: Any) -> Any:
    return FakeGpuTensor(value) if isinstance(value, torch.Tensor) and not isinstance(value, FakeGpuTensor) else value


def _is_cuda(value: Any) -> bool:
    if isinstance(value, torch.device):
        return value.type == "cuda"
    return isinstance(value, str) and value.partition(":")[0] == "cuda"


TENSOR_FACTORIES = (
    "arange",
    "as_tensor",
    "empty",
    "eye",
    "full",
    "linspace",
    "ones",
    "rand",
    "randint",
    "randn",
    "tensor",
)
TENSOR_FACTORIES += ("zeros", "empty_like", "full_like", "ones_like", "zeros_like")
_original_to = torch.Tensor.to


def _wrap_factory(factory: Callable) -> Callable:
    """Wrap a factory function of torch so that it can create tensors on the fake GPU."""

    def make(*args: Any, **kwargs: Any) -> torch.Tensor:
        is_pinned = kwargs.pop("pin_memory", False)
        if not _is_cuda(kwargs.get("device")):
            return _pin(factory(*args, **kwargs)) if is_pinned else factory(*args, **kwargs)
        if factory.__name__ in ("as_tensor", "tensor"):
            _report_work(factory.__name__, "copy", "wait")
            _report_transfer("to device", factory(*tree_map(_unwrap, args)).numel())
        elif not factory.__name__.startswith("empty"):
            _report_work(factory.__name__, "launch")
        return FakeGpuTensor(factory(*tree_map(_unwrap, args), **{**kwargs, "device": "cpu"}))

    return make


def _move(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
    """Replace `Tensor.to`."""
    other = next((v for v in args if isinstance(v, torch.Tensor)), None)
    places = [v for v in (*args, kwargs.get("device"), getattr(other, "device", None)) if v is not None]
    place = next((torch.device(v) for v in places if isinstance(v, torch.device | str)), tensor.device)
    dtypes = [v for v in (*args, kwargs.get("dtype"), getattr(other, "dtype", None)) if isinstance(v, torch.dtype)]
    if isinstance(tensor, FakeGpuTensor) != (place.type == "cuda"):
        blocks = isinstance(tensor, FakeGpuTensor) or _may_wait(tensor, bool(kwargs.get("non_blocking")))
        kinds = [] if isinstance(tensor, FakeGpuTensor) else ["copy"]
        _report_work(f"to {place.type}", *kinds, *["wait"] * blocks)
        _report_transfer("to host" if isinstance(tensor, FakeGpuTensor) else "to device", tensor.numel())
        tensor = (_ToCpu if isinstance(tensor, FakeGpuTensor) else _ToGpu).apply(tensor)
    return _original_to(tensor, dtypes[0]) if dtypes else tensor


class _ToGpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return FakeGpuTensor(tensor.detach().clone())

    @staticmethod
    def backward(ctx, grad):
        _report_work("to cpu", "wait")
        _report_transfer("to host", grad.numel())
        return grad.cpu_tensor


class _ToCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return tensor.cpu_tensor.clone()

    @staticmethod
    def backward(ctx, grad):
        _report_work("to cuda", "copy", "wait")
        _report_transfer("to device", grad.numel())
        return FakeGpuTensor(grad)


class FakeGraphCapturer:
    """Captures steps as `GraphCapturer` does. A replay repeats what was launched, with all that the host knew then."""

    def has_room(self) -> bool:
        return True

    def is_memory_short(self) -> bool:
        return False

    def capture(self, launch: Callable[[], ViewGradients]) -> tuple[ViewGradients, Callable[[], None]]:
        with _unheard():
            kept = _undefined_copies(launch())

        def replay() -> None:
            _report_work("replay of a graph", "launch")
            with _unheard():
                repeat()

        def repeat() -> None:
            for target, source in zip(_result_tensors(kept), _result_tensors(launch()), strict=True):
                target.copy_(source)

        return kept, replay


@contextmanager
def _unheard() -> Iterator[None]:
    """Report no work inside this context, because the host does not ask for it."""
    listeners, _listeners[:] = list(_listeners), []
    try:
        yield
    finally:
        _listeners[:] = listeners


def _result_tensors(found: ViewGradients) -> list[torch.Tensor]:
    values = [found.loss, found.error, *found.gradients, *vars(found.rendering).values(), *(found.checks or ())]
    return [value for value in values if isinstance(value, torch.Tensor)]


def _undefined_copies(found: ViewGradients) -> ViewGradients:
    """Return the result with other tensors, whose numbers are wrong until they are written."""

    def copy(value: Any) -> Any:
        return torch.ones_like(value) if isinstance(value, torch.Tensor) else value

    rendering = type(found.rendering)(**{name: copy(value) for name, value in vars(found.rendering).items()})
    gradients = [copy(gradient) for gradient in found.gradients]
    checks = None if found.checks is None else StepChecks(*map(copy, found.checks))
    return ViewGradients(gradients, copy(found.loss), copy(found.error), rendering, checks, {})


@contextmanager
def use_fake_gpu() -> Iterator[torch.device]:
    """Make torch see one CUDA device inside this context, and yield that device.

    The kernels count as tested, because a child process has no such device.
    """
    interpreter = pytest.importorskip("triton.runtime.interpreter", reason="Triton is not installed")
    launch = interpreter.GridExecutor.__call__

    def on_the_cpu(self, *args, **kwargs):
        _report_work(self.fn.__name__, "launch")
        return launch(self, *tree_map(_unwrap, args), **tree_map(_unwrap, kwargs))

    properties = SimpleNamespace(multi_processor_count=2, total_memory=1 << 33, name="a GPU that is not there")
    with (
        # A module gets new parameters when it moves, because the old ones are of another type.
        mock.patch.object(torch.__future__, "get_overwrite_module_params_on_conversion", lambda: True),
        mock.patch.object(torch.cuda, "is_available", lambda: True),
        mock.patch.object(torch.cuda, "device_count", lambda: 1),
        mock.patch.object(torch.cuda, "current_device", lambda: 0),
        mock.patch.object(torch.cuda, "set_device", lambda _: None),
        mock.patch.object(torch.cuda, "Event", FakeEvent),
        mock.patch.object(torch.cuda, "synchronize", lambda *_: None),
        mock.patch.object(torch.cuda, "get_device_properties", lambda *_: properties),
        mock.patch.object(torch.cuda, "get_device_capability", lambda *_: (9, 0)),
        mock.patch.object(torch.cuda, "is_bf16_supported", lambda *_: True),
        mock.patch.object(interpreter.GridExecutor, "__call__", on_the_cpu),
        mock.patch.object(step_graphs, "GraphCapturer", FakeGraphCapturer),
        mock.patch.object(devices, "load_or_run_self_test", lambda device: SelfTest("gpu", str(device), ())),
        mock.patch.object(torch, "Generator", FakeGenerator),
        mock.patch.object(torch.Tensor, "to", _move),
        mock.patch.object(torch.Tensor, "pin_memory", _pin),
        mock.patch.object(torch.Tensor, "cpu", lambda tensor: _move(tensor, "cpu")),
        mock.patch.multiple(torch, **{name: _wrap_factory(getattr(torch, name)) for name in TENSOR_FACTORIES}),
    ):
        yield CUDA_DEVICE
