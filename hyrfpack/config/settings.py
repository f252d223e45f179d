"""Settings: fields of a dataclass whose annotations hold their limits, and whose docstring describes them.

    @dataclass(frozen=True)
    class BlurConfig:
        '''Settings of a blur.

        Attributes:
            radius: radius of the filter.
            edge: treatment of pixels outside. Default: by the picture.
        '''

        radius: Annotated[int, Range(1, 99, unit="pixels")] = 3
        edge: Annotated[str | None, OneOf(("wrap", "mirror"))] = None

        def __post_init__(self) -> None:
            check_settings(self)

`list_settings` reads such a class. The command line makes options from the result (`cli/settings.py`).
"""

from __future__ import annotations

import inspect
import re
import types
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from hyrfpack.checks import MAX_FLOAT, check_bool, check_choice, check_float, check_int, check_text

LARGEST_SEED = 2**64 - 1  # torch's generators take seeds of 64 bits.
_ENTRY_PATTERN = re.compile(r"(?m)^    (\w+(?:, \w+)*):((?:.|\n {5,})+)")


@dataclass(frozen=True)
class Range:
    """The numbers from `minimum` to `maximum`, both included, or without limit; `unit` is theirs, "" for a count."""

    minimum: float
    maximum: float | None = None
    unit: str = ""

    def as_ints(self) -> tuple[int, int | None]:
        """Return minimum and maximum of a range of ints."""
        return int(self.minimum), None if self.maximum is None else int(self.maximum)


@dataclass(frozen=True)
class OneOf:
    """The words that a setting takes."""

    words: tuple[str, ...]


@dataclass(frozen=True)
class OneLine:
    """Texts of one line, of at most `max_length` characters, none of them a control character."""

    max_length: int


Seed = Annotated[int, Range(0, LARGEST_SEED)]


@dataclass(frozen=True)
class Setting:
    """One setting of a class of settings.

    Attributes:
        name: name of the field.
        kind: type of the values: int, float, bool or str.
        optional: whether the value may be None.
        default: value of the field if none is given.
        limits: the allowed numbers, words or texts; None for bool, and for str if any is allowed.
        description: description from the docstring of the class, beginning with a capital letter.
        default_description: what None means, after "Default:" in the docstring; "" if that is not described.
    """

    name: str
    kind: type
    optional: bool
    default: Any
    limits: Range | OneOf | OneLine | None
    description: str
    default_description: str

    def check(self, value: Any) -> None:
        """Check a value.

        Raises:
            ValueError: its type is wrong, or it is out of range or unknown; the message names the setting.
        """
        if value is None and self.optional:
            return
        if self.kind is bool:
            check_bool(self.name, value)
        elif self.kind is str and not isinstance(value, str):
            raise ValueError(f"{self.name} is {value!r}; it must be a string")
        elif isinstance(self.limits, OneOf):
            check_choice(self.name, value, self.limits.words)
        elif isinstance(self.limits, OneLine):
            check_text(self.name, value, self.limits.max_length)
        elif isinstance(self.limits, Range) and self.kind is int:
            check_int(self.name, value, *self.limits.as_ints())
        elif isinstance(self.limits, Range):
            check_float(
                self.name, value, self.limits.minimum, MAX_FLOAT if self.limits.maximum is None else self.limits.maximum
            )


@cache
def list_settings(config_class: type) -> dict[str, Setting]:
    """Return the settings of a dataclass by name; fields that are neither numbers, words nor bool are left out."""
    hints = get_type_hints(config_class, include_extras=True)
    entries: dict[str, str] = {}
    for base in reversed(config_class.__mro__):
        entries |= _read_entries(base)
    settings = {}
    for field in fields(config_class):
        hint = hints[field.name]
        kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        members = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
        optional, kinds = type(None) in members, [member for member in members if member is not type(None)]
        if len(kinds) != 1 or kinds[0] not in (int, float, bool, str):
            continue
        limits = next((extra for extra in extras if isinstance(extra, Range | OneOf | OneLine)), None)
        entry, _, default_description = entries.get(field.name, "").partition(" Default: ")
        settings[field.name] = Setting(
            field.name,
            kinds[0],
            optional,
            field.default,
            limits,
            entry[:1].upper() + entry[1:],
            default_description.removesuffix("."),
        )
    return settings


def check_settings(config: object) -> None:
    """Check the values of all settings of an instance.

    Raises:
        ValueError: one is wrong; the message names it.
    """
    config_class: type = type(config)
    for name, setting in list_settings(config_class).items():
        setting.check(getattr(config, name))


def _read_entries(config_class: type) -> dict[str, str]:
    """Return the entries of the section "Attributes" of a class's own docstring by name, each in one line."""
    _, _, section = inspect.cleandoc(config_class.__doc__ or "").partition("Attributes:\n")
    return {
        name: " ".join(text.split()) for names, text in _ENTRY_PATTERN.findall(section) for name in names.split(", ")
    }
