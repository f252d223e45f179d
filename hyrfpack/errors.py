"""The errors that a user can cause and correct.

Each error has a problem (what happened, and where) and a fix (what to do next). The command line prints both as one
line and exits with code 2. Any other exception is a bug in hyrfpack and keeps its traceback.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from typing import TypeVar

ErrorT = TypeVar("ErrorT", bound="HyrfError")

# pip's names of packages that differ from the names of their modules.
_PACKAGE_BY_MODULE = {
    "PIL": "pillow",
    "pillow_heif": "pillow-heif",
    "pxr": "usd-core",
    "fast_simplification": "fast-simplification",
    "skimage": "scikit-image",
}
# The extra of pyproject.toml that stands for the use of a package, if that is its only use.
_EXTRA_BY_PACKAGE = {
    "OpenEXR": "exr",
    "av": "video",
    "fast-simplification": "mesh",
    "pillow-heif": "heic",
    "pycolmap": "poses",
    "scikit-image": "mesh",
    "usd-core": "usd",
}


def printable(text: str) -> str:
    """Return text from a file as one line that any terminal can show; unprintable characters become escapes ("\\n")."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class HyrfError(Exception):
    """The input or the request is wrong, and the user can correct it.

    `str(error)` is one line, "problem; fix". Both parts are made `printable`, because they quote hostile files.

    Attributes:
        problem: what happened, and where: the path, the setting, the value. Only this part quotes contents of files.
        fix: what to do next, as an instruction to a user of the library. Settings are Python arguments in backticks:
            "replace it with `overwrite=True`". The command line replaces them by its options, in the fix only.

    Example:
        >>> from hyrfpack.errors import HyrfError
        >>> error = HyrfError("out.hyrf: there is a file of this name", fix="replace it with `overwrite=True`")
        >>> print(error)
        out.hyrf: there is a file of this name; replace it with `overwrite=True`
    """

    def __init__(self, problem: str, fix: str) -> None:
        self.problem, self.fix = printable(problem), printable(fix)
        super().__init__(self.problem, self.fix)  # Copying and unpickling call the class with these arguments.

    def __str__(self) -> str:
        return f"{self.problem}; {self.fix}"

    def with_text(self: ErrorT, problem: str | None = None, fix: str | None = None) -> ErrorT:
        """Return a copy of the error, of the same type and with the same attributes, with another problem or fix."""
        error = copy(self)
        HyrfError.__init__(error, self.problem if problem is None else problem, self.fix if fix is None else fix)
        return error


class HyrfDataError(HyrfError):
    """Photos, poses or points on disk cannot be used."""


class HyrfNoPosesError(HyrfDataError):
    """There are photos or a video but no poses, which have to be estimated first."""


class HyrfFormatError(HyrfError):
    """A `.hyrf` file is damaged, hostile, or written by a newer version."""


class HyrfSizeError(HyrfError):
    """A model does not fit into the target size.

    Attributes:
        min_bytes: approximate size of the smallest file that holds the model; 0 if it is not known.
    """

    def __init__(self, problem: str, fix: str, min_bytes: int = 0) -> None:
        super().__init__(problem, fix)
        self.min_bytes = min_bytes


class HyrfTrainingError(HyrfError):
    """Training cannot start or continue: the loss is not finite, or a checkpoint does not fit."""


def strip_path(error: HyrfError, path: object) -> str:
    """Return an error's problem without the path at its start, for a sentence that names the file itself."""
    return error.problem.removeprefix(f"{printable(str(path))}: ")


@contextmanager
def named_in_errors(path: object, name: str) -> Iterator[None]:
    """Call a file by `name` in the errors of a block, because its path is that of a temporary copy."""
    try:
        yield
    except HyrfError as error:
        raise error.with_text(error.problem.replace(printable(str(path)), name)) from error


def short_reason(error: Exception, max_length: int = 120) -> str:
    """Return the first line with text of another library's error message, or the error's type, to be quoted in ours."""
    lines = str(error).strip().splitlines()
    return lines[0][:max_length] if lines else type(error).__name__


def missing_package(error: ModuleNotFoundError) -> str | None:
    """Return pip's name of the package that an import did not find; None for a module of hyrfpack itself."""
    module = (error.name or "").partition(".")[0]
    return None if module in ("", "hyrfpack") else _PACKAGE_BY_MODULE.get(module, module)


@contextmanager
def needs_package(task: str) -> Iterator[None]:
    """Turn a failed import of another package inside the block into a HyrfError that says how to install it.

    Args:
        task: what needs the package, as the start of the message: "model.hyrf: drawing figures".

    Raises:
        HyrfError: a module that is imported in the block is not installed. Its fix names the extra of hyrfpack that
            installs the package if there is one.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = missing_package(error)
        if package is None:
            raise
        raise HyrfError(f"{task} needs {package}", fix=f"run '{install_command(package)}'") from error


def suggest_command(*words: object) -> str:
    """Return a hyrfpack command for a message, in quotes; words with spaces are quoted as in a POSIX shell.

    Example:
        >>> suggest_command("view", "my ball.hyrf")
        "'hyrfpack view 'my ball.hyrf''"
    """
    return f"'{shlex.join(('hyrfpack', *map(str, words)))}'"


def install_command(package: str) -> str:
    """Return the command that installs a package, through the extra of hyrfpack if it has one."""
    extra = _EXTRA_BY_PACKAGE.get(package)
    return f'pip install "hyrfpack[{extra}]"' if extra else f"pip install {package}"
