"""Speed-ups of Triton's interpreter, which takes three times as long without them, and new memory full of NaN."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
import triton.language as tl
from triton.backends.compiler import BaseBackend
from triton.language.semantic import TritonSemantic
from triton.runtime import interpreter, jit

native_specialize_impl = getattr(jit, "native_specialize_impl", None)


def speed_up_interpreter() -> None:
    """Patch the Triton language once a launch instead of at every call of a device function.

    Half of the interpreter's time goes into that patching.
    """
    patch, launch = interpreter._patch_lang, interpreter.GridExecutor.__call__
    # What this launch has patched; None outside a launch.
    done: set[tuple[bool, bool]] | None = None

    @cache
    def patched_for(fn: Any) -> tuple[bool, bool]:
        values = list(fn.__globals__.values())
        return any(value is tl for value in values), any(value is tl.core for value in values)

    def patch_new(fn: Any) -> Any:
        what = patched_for(fn)
        if done is None or what not in done:
            if done is not None:
                done.add(what)
            return patch(fn)
        return interpreter._LangPatchScope()

    def launch_once(self: Any, *args: Any, **kwargs: Any) -> Any:
        nonlocal done
        done = set()
        _specialize_arguments(self, args, kwargs)
        try:
            return launch(self, *args, **kwargs)
        finally:
            done = None

    interpreter._patch_lang, interpreter.GridExecutor.__call__ = patch_new, launch_once
    _cache_types()


def _specialize_arguments(executor: Any, args: tuple, kwargs: dict[str, Any]) -> None:
    """Raise TypeError for arguments that a real launch refuses and the interpreter takes, such as numpy's numbers."""
    if native_specialize_impl is None:  # Other versions of Triton have another function.
        return
    given = dict(zip(executor.arg_names, args, strict=False)) | kwargs
    for name in executor.arg_names:
        if name in given and name not in executor.constexprs:
            native_specialize_impl(BaseBackend, given[name], False, True, True)


def _cache_types() -> None:
    """Derive what follows from a type once a type, instead of once a value.

    This takes a third of the remaining time. A version of Triton with other constructors stays unpatched.
    """
    if hasattr(interpreter, "_get_np_dtype"):
        whole, found = interpreter._get_np_dtype, {}

        def numpy_type(of: Any) -> Any:
            if of.name not in found:
                found[of.name] = whole(of)
            return found[of.name]

        interpreter._get_np_dtype = numpy_type
    if _has_parameters(tl.tensor.__init__, "self", "handle", "type"):
        _cache_init(tl.tensor, lambda handle, type: type.name, "handle")
    if _has_parameters(tl.block_type.__init__, "self", "element_ty", "shape"):
        _cache_init(tl.block_type, _block_name)
    if _has_parameters(TritonSemantic.broadcast_impl_value, "self", "lhs", "rhs"):
        broadcast = TritonSemantic.broadcast_impl_value

        def broadcast_unlike(self: Any, lhs: Any, rhs: Any) -> Any:
            return (lhs, rhs) if lhs.type.name == rhs.type.name else broadcast(self, lhs, rhs)

        TritonSemantic.broadcast_impl_value = broadcast_unlike


def _has_parameters(function: Callable, *names: str) -> bool:
    return list(inspect.signature(function).parameters) == list(names)


def _block_name(element_ty: Any, shape: Any) -> tuple:
    return element_ty.name, *[getattr(size, "value", size) for size in shape]


def _cache_init(kind: type, name: Callable[[Any, Any], Any], own: str | None = None) -> None:
    """Cache the attributes that a class's constructor derives, by the name that `name` returns.

    The cached attributes are never modified. `own` names the attribute that holds the first argument.
    """
    whole, made = kind.__init__, {}

    def init(self: Any, first: Any, second: Any) -> None:
        called = name(first, second)
        known = made.get(called)
        if known is None:
            whole(self, first, second)
            made[called] = {key: value for key, value in vars(self).items() if key != own}
            return
        vars(self).update(known)
        if own is not None:
            vars(self)[own] = first

    kind.__init__ = init


# Modules that allocate memory for GPU kernels: those of the operations, and the fake GPU on their behalf.
_GPU_MODULE = re.compile(r"hyrfpack\.ops\..*\bgpu\w*|fake_gpu")
# The bits of NaN: as float32, or two of them in an int64, in which kernels pack pairs of numbers.
_NAN_BITS = {torch.int32: 0x7FC00000, torch.int64: 0x7FC000007FC00000}


def fill_new_memory_with_nan() -> None:
    """Fill the uninitialised memory that GPU operations allocate with NaN, so that reads of it show in results.

    On a GPU such memory holds what was there before, often zeros.
    """
    torch.empty, torch.empty_like = _filled(torch.empty), _filled(torch.empty_like)
    torch.Tensor.new_empty = _filled(torch.Tensor.new_empty)


def _filled(allocate: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    def make(*args: Any, **kwargs: Any) -> torch.Tensor:
        memory = allocate(*args, **kwargs)
        if _GPU_MODULE.fullmatch(sys._getframe(1).f_globals.get("__name__", "")):
            # The fake GPU counts what is done to its own tensors.
            memory_on_cpu = getattr(memory, "cpu_tensor", memory)
            if memory.is_floating_point():
                memory_on_cpu.fill_(torch.nan)
            elif memory.dtype in _NAN_BITS:
                memory_on_cpu.fill_(_NAN_BITS[memory.dtype])
            elif memory.dtype in (torch.bool, torch.uint8):
                memory_on_cpu.fill_(1)
        return memory

    make.__name__ = allocate.__name__
    return make
