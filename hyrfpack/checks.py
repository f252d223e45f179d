"""Check settings and arguments, so that errors are raised at the call instead of in the middle of the work.

Settings are written as JSON beside results. JSON cannot represent NumPy's numbers, so only Python's own are accepted.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection
from typing import Any

MAX_FLOAT = sys.float_info.max
_CONTROL_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def check_int(name: str, value: Any, minimum: int, maximum: int | None = None) -> None:
    """Check that a value is an int, not a bool, in [minimum, maximum].

    Raises:
        ValueError: the check fails.
    """
    is_int = isinstance(value, int) and not isinstance(value, bool)
    if is_int and value >= minimum and (maximum is None or value <= maximum):
        return
    allowed = f"of at least {minimum}" if maximum is None else f"in [{minimum}, {maximum}]"
    raise ValueError(f"{name} is {value!r}; it must be a whole number {allowed}")


def check_float(name: str, value: Any, minimum: float = 0.0, maximum: float = MAX_FLOAT) -> None:
    """Check that a value is a float or an int, not a bool and not NaN, in [minimum, maximum].

    Raises:
        ValueError: the check fails.
    """
    if isinstance(value, float | int) and not isinstance(value, bool) and minimum <= value <= maximum:
        return
    allowed = f"of at least {minimum:g}, and finite" if maximum == MAX_FLOAT else f"in [{minimum:g}, {maximum:g}]"
    raise ValueError(f"{name} is {value!r}; it must be a number {allowed}")


def check_finite(name: str, value: Any) -> None:
    """Check that a value is a float or an int, not a bool, and finite.

    Raises:
        ValueError: the check fails.
    """
    if isinstance(value, float | int) and not isinstance(value, bool) and abs(value) <= MAX_FLOAT:
        return
    raise ValueError(f"{name} is {value!r}; it must be a finite number")


def check_positive(name: str, value: Any) -> None:
    """Check that a value is a float or an int, not a bool, finite and above 0.

    Raises:
        ValueError: the check fails.
    """
    if isinstance(value, float | int) and not isinstance(value, bool) and 0 < value <= MAX_FLOAT:
        return
    raise ValueError(f"{name} is {value!r}; it must be a number above 0, and finite")


def check_bool(name: str, value: Any) -> None:
    """Check that a value is True or False.

    Raises:
        ValueError: the check fails.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {value!r}; it must be True or False")


def check_text(name: str, value: Any, max_length: int) -> None:
    """Check that a value is a text of one line, of at most `max_length` characters, none of them a control character.

    Raises:
        ValueError: the check fails.
    """
    if isinstance(value, str) and len(value) <= max_length and not has_control_characters(value):
        return
    raise ValueError(
        f"{name} is {value!r:.80}; it must be a text of at most {max_length:,} characters without control characters"
    )


def has_control_characters(text: str) -> bool:
    """Return whether a text holds a control character, a line or paragraph separator, or half of a surrogate pair.

    Example:
        >>> has_control_characters("two\\nlines"), has_control_characters("12\\u00a0m, caf\\u00e9")
        (True, False)
    """
    return _CONTROL_CHARACTERS.search(text) is not None


def remove_control_characters(text: str) -> str:
    """Return a text without the characters that `has_control_characters` finds."""
    return _CONTROL_CHARACTERS.sub("", text)


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Check that a value is one of the choices.

    Raises:
        ValueError: the check fails.
    """
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(choices)}")


def check_pair(name: str, value: Any) -> None:
    """Check that a value is a tuple of two.

    Raises:
        ValueError: the check fails.
    """
    if not (isinstance(value, tuple) and len(value) == 2):
        raise ValueError(f"{name} is {value!r}; it must be a tuple of two numbers")


# How to get an argument of types that are not made directly, by their names.
_REMEDIES_BY_TYPE_NAME = {
    "Camera": "a View has one: view.camera",
    "Manifest": "a SceneFolder has one: scene.manifest",
    "HybridModel": "hyrfpack.load_model reads it from a file",
    "Scene": "hyrfpack.load_scene reads it from a folder",
    "View": "a Scene has lists of them: scene.test",
}


def check_several(argument: str, paths: object) -> None:
    """Check that an argument of a call is not one path where several are expected.

    Raises:
        TypeError: it is one path, whose characters would be taken for paths.
    """
    if isinstance(paths, str | os.PathLike):
        raise TypeError(f"{argument} must be several paths, not {os.fspath(paths)!r} alone; give a list of them")


def check_type(argument: str, value: object, expected: type) -> None:
    """Check that an argument of a call has the expected type.

    Raises:
        TypeError: it has another type; the message says how to get the right one.
    """
    if not isinstance(value, expected):
        name = expected.__name__
        remedy = _REMEDIES_BY_TYPE_NAME.get(name, f"make one: hyrfpack.{name}(...)")
        raise TypeError(f"{argument} must be a {name}, not a {type(value).__name__}; {remedy}")
