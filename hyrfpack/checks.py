"""Refusing settings and arguments that make no sense where they are given, not in the middle of the work.

Settings are written as JSON beside results, so only Python's own numbers are taken: NumPy's have no place there.
"""

from __future__ import annotations

import sys
from collections.abc import Collection
from typing import Any

LARGEST = sys.float_info.max


def check_int(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Raises ValueError: the value is no int (a bool is none) or lies outside of [least, most]."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= least and (most is None or value <= most):
        return
    allowed = f"of at least {least}" if most is None else f"in [{least}, {most}]"
    raise ValueError(f"{name} is {value!r}; it must be an int {allowed}")


def check_float(name: str, value: Any, least: float = 0.0, most: float = LARGEST) -> None:
    """Raises ValueError: the value is no float or int, not finite, or lies outside of [least, most]."""
    if isinstance(value, float | int) and not isinstance(value, bool) and least <= value <= most:
        return
    allowed = f"finite and at least {least:g}" if most == LARGEST else f"in [{least:g}, {most:g}]"
    raise ValueError(f"{name} is {value!r}; it must be a float, {allowed}")


def check_bool(name: str, value: Any) -> None:
    """Raises ValueError: the value is neither True nor False."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {value!r}; it must be True or False")


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Raises ValueError: the value is none of the choices."""
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(choices)}")


def check_pair(name: str, value: Any) -> None:
    """Raises ValueError: the value is no tuple of two."""
    if not (isinstance(value, tuple) and len(value) == 2):
        raise ValueError(f"{name} is {value!r}; it must be a tuple of two numbers")


# Where what a call was given instead of can be had, by the type that it wants.
_REMEDIES = {
    "Camera": "a View has one: view.camera",
    "HybridModel": "hyrfpack.load reads it from a file",
    "Scene": "hyrfpack.load_scene reads it from a folder",
    "View": "a Scene has lists of them: scene.test",
    **{name: f"make one: hyrfpack.{name}(...)" for name in ("DistillConfig", "RenderSettings", "TrainConfig")},
}


def check_type(argument: str, value: object, kind: type) -> None:
    """Refuse what a call from a program cannot be about: TypeError, with what to do, unless `value` is of a kind."""
    if not isinstance(value, kind):
        raise TypeError(
            f"{argument} must be a {kind.__name__}, not a {type(value).__name__}; {_REMEDIES[kind.__name__]}"
        )
