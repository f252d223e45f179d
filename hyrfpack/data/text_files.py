"""Read text files of other programs, which may have the encoding of older Windows programs."""

from __future__ import annotations

import codecs
from pathlib import Path

from hyrfpack.errors import HyrfDataError


def read_text(file: Path) -> str:
    """Read a text file as UTF-8 without its byte-order mark, or as cp1252 if it is not valid UTF-8.

    Raises:
        HyrfDataError: the file cannot be read.
    """
    try:
        content = file.read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise HyrfDataError(
            f"{file}: cannot be read ({error.strerror})",
            fix="check its permissions, or restore the file",
        ) from error
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")  # the encoding of older Windows programs
