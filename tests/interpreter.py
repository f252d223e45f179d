"""Makes Triton's interpreter quicker, which otherwise takes three times as long."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from typing import Any

import triton.language as tl
from triton.language.semantic import TritonSemantic
from triton.runtime import interpreter


def patch_once() -> None:
    """Patch the language once a launch, and not again at each call of a device function.

    That is what half of the interpreter's time goes to.
    """
    patch, launch = interpreter._patch_lang, interpreter.GridExecutor.__call__
    done: set[tuple[bool, bool]] | None = None  # what this launch has patched; None outside of launches

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
        try:
            return launch(self, *args, **kwargs)
        finally:
            done = None

    interpreter._patch_lang, interpreter.GridExecutor.__call__ = patch_new, launch_once
    _make_types_once()


def _make_types_once() -> None:
    """Work out once what follows from a type alone, and not again for each value of that type.

    That is a third of what is left. A Triton that makes its values of other things is left as it is.
    """
    if hasattr(interpreter, "_get_np_dtype"):
        whole, found = interpreter._get_np_dtype, {}

        def numpy_type(of: Any) -> Any:
            if of.name not in found:
                found[of.name] = whole(of)
            return found[of.name]

        interpreter._get_np_dtype = numpy_type
    if _takes(tl.tensor.__init__, "self", "handle", "type"):
        _init_once(tl.tensor, lambda handle, type: type.name, "handle")
    if _takes(tl.block_type.__init__, "self", "element_ty", "shape"):
        _init_once(tl.block_type, _name_of_block)
    if _takes(TritonSemantic.broadcast_impl_value, "self", "lhs", "rhs"):
        broadcast = TritonSemantic.broadcast_impl_value

        def broadcast_unlike(self: Any, lhs: Any, rhs: Any) -> Any:
            return (lhs, rhs) if lhs.type.name == rhs.type.name else broadcast(self, lhs, rhs)

        TritonSemantic.broadcast_impl_value = broadcast_unlike


def _takes(function: Callable, *names: str) -> bool:
    return list(inspect.signature(function).parameters) == list(names)


def _name_of_block(element_ty: Any, shape: Any) -> tuple:
    return element_ty.name, *[getattr(size, "value", size) for size in shape]


def _init_once(kind: type, name: Callable[[Any, Any], Any], own: str | None = None) -> None:
    """Keep by name what objects of a class, which nobody changes, are made of; `own` is the first argument's place."""
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
