"""The one family of errors that a user can cause.

Each message is one sentence that says what is wrong, where, and what to do. The command line prints it and
exits with code 2; anything else that escapes is a bug of ours and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


def printable(text: str) -> str:
    """Text out of a file as one line that any terminal can show: what is not printable becomes an escape ("\\n")."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class HyrfError(Exception):
    """Something about the input or the request is wrong and the user can correct it.

    Sentences quote what hostile files say, so they are made `printable`.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence))


class HyrfDataError(HyrfError):
    """Photos, poses or points on disk cannot be used as they are."""


class HyrfNoPosesError(HyrfDataError):
    """There are photos, or a video, and no poses: these have to be estimated first."""


class HyrfFormatError(HyrfError):
    """A `.hyrf` file is damaged, hostile, or made by a newer version."""


class HyrfSizeError(HyrfError):
    """A model does not fit into the size that was asked for.

    Attributes:
        smallest: bytes that it takes at least, about; 0 where that is not known.
    """

    def __init__(self, sentence: str, smallest: int = 0) -> None:
        super().__init__(sentence)
        self.smallest = smallest


class HyrfTrainingError(HyrfError):
    """Training cannot start or cannot go on (a loss that is not finite, a checkpoint that does not fit)."""


def without_path(error: HyrfError, path: object) -> str:
    """The sentence of an error without the path that it starts with, for a sentence that names the file otherwise."""
    return str(error).removeprefix(f"{printable(str(path))}: ")


def reason_of(error: Exception, longest: int = 120) -> str:
    """What another library says of an error, for a place in a sentence of ours: its first line, or else its kind."""
    return str(error).splitlines()[0][:longest] if str(error) else type(error).__name__


@contextmanager
def needs_package(package: str, task: str) -> Iterator[None]:
    """Import what one task alone needs inside this block: where it is not installed, that is a HyrfError.

    Args:
        package: what pip calls it.
        task: what cannot be done without it, as the sentence starts ("model.hyrf: drawing figures").
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise HyrfError(f"{task} needs {package}; run 'pip install {package}'") from error
