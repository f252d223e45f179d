"""Types of arguments and options."""

from __future__ import annotations

import math
import re
from pathlib import Path

import click

PATH = click.Path(path_type=Path)
_SIZE_PATTERN = re.compile(r"([0-9.]+)\s*([kmg]?)b?", re.IGNORECASE)


class _OutputPath(click.ParamType):
    """Path of an output. Unlike the path of an input it may not be empty or "-"."""

    name = "path"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        if str(value) in ("", "-"):
            self.fail(f"'{value}' is not a file name; results are written to files, so give a path", param, ctx)
        return Path(str(value))


OUTPUT = _OutputPath()


class _Size(click.ParamType):
    """Number of bytes, such as 2MB, 350k or 1500000; k, M and G are powers of 1000."""

    name = "size"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        match = _SIZE_PATTERN.fullmatch(str(value).strip())
        try:
            size = int(float(match[1]) * 1000 ** " kmg".index(match[2].lower() or " ")) if match else 0
        except (ValueError, OverflowError):
            size = 0
        if size < 1:
            self.fail(f"'{value}' is not a size; write it as 2MB, 350kB or 1500000", param, ctx)
        return size


SIZE = _Size()


def reject_nan(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """Reject NaN, which click's ranges accept, as the callback of an option."""
    if value is not None and math.isnan(value):
        raise click.BadParameter("NaN is not allowed; give a number", ctx, param)
    return value
