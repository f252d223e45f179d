"""The errors that a user can cause and correct.

Each message is one sentence that says what is wrong, where, and what to do. The command line prints it and exits with
code 2. Any other exception is a bug in hyrfpack and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


def printable(text: str) -> str:
    """Return text from a file as one line that any terminal can show; unprintable characters become escapes ("\\n")."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class HyrfError(Exception):
    """The input or the request is wrong, and the user can correct it.

    Messages quote hostile files, so every message is made `printable`.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence))


class HyrfDataError(HyrfError):
    """Photos, poses or points on disk cannot be used."""


class HyrfNoPosesError(HyrfDataError):
    """There are photos or a video but no poses, which have to be estimated first."""


class HyrfFormatError(HyrfError):
    """A `.hyrf` file is damaged, hostile, or written by a newer version."""


class HyrfSizeError(HyrfError):
    """A model does not fit into the target size.

    Attributes:
        min_bytes: approximate size of the smallest file that holds the model; 0 where that is not known.
    """

    def __init__(self, sentence: str, min_bytes: int = 0) -> None:
        super().__init__(sentence)
        self.min_bytes = min_bytes


class HyrfTrainingError(HyrfError):
    """Training cannot start or continue: the loss is not finite, or a checkpoint does not fit."""


def strip_path(error: HyrfError, path: object) -> str:
    """Return an error's message without the path at its start, for a sentence that names the file itself."""
    return str(error).removeprefix(f"{printable(str(path))}: ")


def short_reason(error: Exception, max_length: int = 120) -> str:
    """Return the first line of another library's error message, to be quoted in one of ours; else the error's type."""
    return str(error).splitlines()[0][:max_length] if str(error) else type(error).__name__


@contextmanager
def needs_package(package: str, task: str) -> Iterator[None]:
    """Turn a failed import inside the block into a HyrfError that says which package to install.

    Args:
        package: name of the package for pip.
        task: what needs the package, as the start of the message: "model.hyrf: drawing figures".

    Raises:
        HyrfError: a module that is imported in the block is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise HyrfError(f"{task} needs {package}; run 'pip install {package}'") from error
