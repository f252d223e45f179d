"""Types of arguments and options."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import click

from hyrfpack.outputs.names import ARCHIVE_SUFFIXES, READABLE_PICTURE_SUFFIXES, VIDEO_SUFFIXES
from hyrfpack.splats.names import SPLATS_SUFFIXES

_SIZE_PATTERN = re.compile(r"([0-9.]+|[0-9]{1,3}(?:,[0-9]{3})+)\s*([kmg]?)b?", re.IGNORECASE)


class _InputPath(click.Path):
    """Path of an input, which may not be empty: Python would take that for the current folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if str(value) == "":
            self.fail("'' is not a path; give the path of a file or a folder", param, ctx)
        return super().convert(value, param, ctx)


INPUT_PATH = _InputPath(path_type=Path)


class _OutputPath(click.ParamType):
    """Path of an output. Unlike the path of an input it may not be empty or "-"."""

    name = "path"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        if str(value) in ("", "-"):
            self.fail(f"'{value}' is not a file name; results are written to files, so give a path", param, ctx)
        return Path(str(value))


OUTPUT = _OutputPath()

# Suffixes of names that are meant for a file. A new folder of such a name would be taken for the file.
_FILE_SUFFIXES = (
    *(".hyrf", ".html", ".json"),
    *SPLATS_SUFFIXES,
    *READABLE_PICTURE_SUFFIXES,
    *VIDEO_SUFFIXES,
    *ARCHIVE_SUFFIXES,
)


class _OutputFolder(_OutputPath):
    """Path of a folder of results. A new folder may not have the suffix of a file."""

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = super().convert(value, param, ctx)
        if path.suffix.lower() in _FILE_SUFFIXES and not path.exists():
            self.fail(
                f"'{path}' is the name of a {path.suffix} file, but a folder is written; "
                f"give the name of a folder, such as '{path.with_suffix('')}'",
                param,
                ctx,
            )
        return path


OUTPUT_FOLDER = _OutputFolder()


class _Size(click.ParamType):
    """Number of bytes, such as 2MB, 350k, 1500000 or 1,500,000; k, M and G are powers of 1000."""

    name = "size"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        match = _SIZE_PATTERN.fullmatch(str(value).strip())
        try:
            number = float(match[1].replace(",", "")) if match else 0
            size = int(number * 1000 ** " kmg".index(match[2].lower() or " ")) if match else 0
        except (ValueError, OverflowError):
            size = 0
        if size < 1:
            self.fail(f"'{value}' is not a size; write it as 2MB, 350kB or 1500000", param, ctx)
        return size


SIZE = _Size()


class _Box(click.ParamType):
    """A box as numbers with commas between: minimum x, y, z, maximum x, y, z; with `may_turn`, degrees may follow."""

    name = "box"

    def __init__(self, *, may_turn: bool = False) -> None:
        self._form = "MINX,MINY,MINZ,MAXX,MAXY,MAXZ" + ("[,DEGREES]" if may_turn else "")
        self._counts = (6, 7) if may_turn else (6,)

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in self._counts or any(map(math.isnan, numbers)):
            self.fail(f"'{value}' is not a box; write it as {self._form} in world units", param, ctx)
        if any(low > high for low, high in zip(numbers[:3], numbers[3:6], strict=True)):
            self.fail(f"'{value}' has a minimum above its maximum; give the minimum x, y and z first", param, ctx)
        return numbers


class Numbers(click.ParamType):
    """A fixed number of finite numbers with commas between. `form` shows their meaning in help and messages."""

    name = "numbers"

    def __init__(self, count: int, form: str) -> None:
        self._count, self._form = count, form

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self._form

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(map(math.isfinite, numbers)):
            self.fail(f"'{value}' is not {self._count} numbers; write it as {self._form}", param, ctx)
        return numbers


class NumbersOrWord(Numbers):
    """Numbers as in `Numbers`, or one word, which is returned as it is."""

    def __init__(self, count: int, form: str, word: str) -> None:
        super().__init__(count, f"{form}|{word}")
        self._word = word

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if value == self._word else super().convert(value, param, ctx)


class NamedNumbers(Numbers):
    """A name and a fixed number of finite numbers: NAME=0,1.5,2."""

    name = "named numbers"

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"NAME={self._form}"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, tuple):  # click converts again what it has converted
            return value
        name, _, numbers = str(value).rpartition("=")
        if not name:
            self.fail(f"'{value}' names no model; write it as NAME={self._form}", param, ctx)
        return name, super().convert(numbers, param, ctx)


class _HarmonicsDegree(click.ParamType):
    """A degree of spherical harmonics, or "auto", which becomes None."""

    name = "degree"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        if value == "auto":
            return None
        if str(value) not in ("0", "1", "2", "3"):
            self.fail(f"'{value}' is neither 0, 1, 2 or 3 nor auto", param, ctx)
        return int(str(value))


BOX, TURNED_BOX = _Box(), _Box(may_turn=True)
HARMONICS_DEGREE = _HarmonicsDegree()


def reject_non_finite(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """Reject NaN and infinity, which click's ranges accept, as the callback of an option."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value} is not allowed; give a finite number", ctx, param)
    return value
