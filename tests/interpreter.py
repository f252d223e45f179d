"""Speed-ups of Triton's interpreter, which takes many times as long without them, and new memory full of NaN."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
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
    _cache_operands()
    _skip_unused_overflow_checks()
    _call_builtins_directly()
    _add_floats_directly()


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
        _cache_tensor_init()
    if _has_parameters(tl.block_type.__init__, "self", "element_ty", "shape"):
        _cache_block_type_init()
    if _has_parameters(TritonSemantic.broadcast_impl_value, "self", "lhs", "rhs"):
        broadcast = TritonSemantic.broadcast_impl_value

        def broadcast_unlike(self: Any, lhs: Any, rhs: Any) -> Any:
            return (lhs, rhs) if lhs.type.name == rhs.type.name else broadcast(self, lhs, rhs)

        TritonSemantic.broadcast_impl_value = broadcast_unlike


def _has_parameters(function: Callable, *names: str) -> bool:
    return list(inspect.signature(function).parameters) == list(names)


def _cache_tensor_init() -> None:
    """Cache the attributes that the constructor of tensors derives from the type. They are never modified."""
    derive, found = tl.tensor.__init__, {}

    def init(self: Any, handle: Any, type: Any) -> None:
        known = found.get(type.name)
        if known is None:
            derive(self, handle, type)
            found[type.name] = {key: value for key, value in vars(self).items() if key != "handle"}
        else:
            self.__dict__.update(known)
            self.handle = handle

    tl.tensor.__init__ = init


def _cache_block_type_init() -> None:
    """Cache the attributes of block types. They are never modified."""
    derive, found = tl.block_type.__init__, {}

    def init(self: Any, element_ty: Any, shape: Any) -> None:
        key = element_ty.name, *[getattr(size, "value", size) for size in shape]
        known = found.get(key)
        if known is None:
            derive(self, element_ty, shape)
            found[key] = dict(vars(self))
        else:
            self.__dict__.update(known)

    tl.block_type.__init__ = init


def _cache_operands() -> None:
    """Cache how the types of two operands are made equal, which takes longer than the operation itself.

    Two tensors of types that need no conversion are returned as they are. A number beside a tensor that is not
    converted becomes the same constant each time; constants are never modified.
    """
    if not hasattr(TritonSemantic, "binary_op_type_checking_impl"):
        return
    convert, equal, constants = TritonSemantic.binary_op_type_checking_impl, set(), {}

    def converted(self: Any, lhs: Any, rhs: Any, *rules: Any, **named_rules: Any) -> Any:
        if named_rules:
            return convert(self, lhs, rhs, *rules, **named_rules)
        if type(lhs) is tl.tensor and type(rhs) is tl.tensor:
            key = lhs.type.name, rhs.type.name, rules
            if key in equal:
                return lhs, rhs
            left, right = convert(self, lhs, rhs, *rules)
            if left is lhs and right is rhs:
                equal.add(key)
            return left, right
        if type(lhs) is tl.tensor and type(rhs) in (int, float):
            key = lhs.type.name, type(rhs), rhs, True, rules
            if key in constants:
                return lhs, constants[key]
            left, right = convert(self, lhs, rhs, *rules)
            if left is lhs:
                constants[key] = right
            return left, right
        if type(lhs) in (int, float) and type(rhs) is tl.tensor:
            key = rhs.type.name, type(lhs), lhs, False, rules
            if key in constants:
                return constants[key], rhs
            left, right = convert(self, lhs, rhs, *rules)
            if right is rhs:
                constants[key] = left
            return left, right
        return convert(self, lhs, rhs, *rules)

    TritonSemantic.binary_op_type_checking_impl = converted


def _skip_unused_overflow_checks() -> None:
    """Skip the repetition of each operation on integers in int64, the result of which only debug mode reads."""
    check = getattr(TritonSemantic, "binary_op_sanitize_overflow_impl", None)
    if check is None:
        return

    def check_in_debug_mode(self: Any, lhs: Any, rhs: Any, binary_op: Any) -> None:
        if self.builder.options.debug:
            check(self, lhs, rhs, binary_op)

    TritonSemantic.binary_op_sanitize_overflow_impl = check_in_debug_mode


def _call_builtins_directly() -> None:
    """Pass the interpreter's semantics to functions of the language without copying their keywords first.

    This also leaves out the wrapper that checks that it was passed. Each kernel calls thousands of these functions.
    """
    if not _has_parameters(interpreter._patch_attr, "obj", "name", "member", "builder", "scope"):
        return

    def patch_attr(obj: Any, name: str, member: Any, builder: Any, scope: Any) -> None:
        function, semantic = getattr(member, "__wrapped__", member), interpreter.interpreter_semantic

        def call(*args: Any, **kwargs: Any) -> Any:
            kwargs["_semantic"] = semantic
            return function(*args, **kwargs)

        scope.set_attr(obj, name, call)

    interpreter._patch_attr = patch_attr


def _add_floats_directly() -> None:
    """Add, subtract and multiply two tensors of one type of float32 by numpy, as the interpreter does in the end."""
    for name, operation in (("__add__", np.add), ("__sub__", np.subtract), ("__mul__", np.multiply)):
        if _has_parameters(getattr(tl.tensor, name), "self", "other", "_semantic"):
            setattr(tl.tensor, name, _direct(getattr(tl.tensor, name), operation))


def _direct(method: Callable, operation: np.ufunc) -> Callable:
    convert = getattr(method, "__wrapped__", method)

    def operate(self: Any, other: Any, _semantic: Any = None) -> Any:
        kind = self.type
        if type(other) is tl.tensor and other.type.name == kind.name and kind.scalar.name == "fp32":
            handle = self.handle
            return tl.tensor(interpreter.TensorHandle(operation(handle.data, other.handle.data), handle.dtype), kind)
        return convert(self, other, _semantic=_semantic)

    setattr(operate, tl.core.TRITON_BUILTIN, True)
    return operate


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


@cache
def _is_gpu_module(name: str) -> bool:
    return _GPU_MODULE.fullmatch(name) is not None


def _filled(allocate: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    def make(*args: Any, **kwargs: Any) -> torch.Tensor:
        memory = allocate(*args, **kwargs)
        if _is_gpu_module(sys._getframe(1).f_globals.get("__name__", "")):
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
