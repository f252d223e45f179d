"""How all commands speak: --quiet, --verbose, and what is done where there is nobody to speak to."""

from __future__ import annotations

import errno
import os
import platform
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, suppress
from typing import Any, TextIO, TypeVar, cast

import click

from hyrfpack.cli.wording import with_options
from hyrfpack.version import __version__

T = TypeVar("T")
# In click's context, where all commands see them.
_MANNER, _STARTED, _ARGUMENTS = "hyrfpack.manner", "hyrfpack.started", "hyrfpack.arguments"
_PACKAGES = ("torch", "numpy", "numba", "triton", "pycolmap")


def add_manners(command: click.Command) -> None:
    """Give a command, or all of a group, --quiet and --verbose."""
    for flag, help in (
        ("--quiet", "Say nothing on standard error but errors."),
        ("--verbose", "Say what a bug report needs: versions, device, times, tracebacks."),
    ):
        command.params.append(click.Option([flag], is_flag=True, expose_value=False, callback=_choose, help=help))


def _choose(ctx: click.Context, option: click.Parameter, given: bool) -> None:
    if not given or ctx.resilient_parsing or ctx.meta.get(_MANNER) == option.name:
        return
    root = ctx.find_root()
    if _MANNER in ctx.meta:
        root.close()  # standard error is needed
        raise click.UsageError("--quiet and --verbose contradict each other; give one of them", ctx)
    ctx.meta[_MANNER] = option.name
    if option.name == "quiet":  # of progress and libraries too; errors are printed once the root is closed
        root.with_resource(redirect_stderr(root.with_resource(open(os.devnull, "w", encoding="utf-8"))))
        return
    ctx.meta[_STARTED] = time.perf_counter()
    note(f"{_versions()}; on {platform.platform()} with {os.cpu_count()} cores")
    root.call_on_close(lambda: note(f"the end, after {time.process_time():.1f} s of processors"))


def _versions() -> str:
    from importlib.metadata import PackageNotFoundError, version

    known = [f"hyrfpack {__version__}", f"Python {platform.python_version()}"]
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            known.append(f"{package} {version(package)}")
    return ", ".join(known)


def keep_arguments(ctx: click.Context, arguments: Iterable[str]) -> None:
    """Remember what follows `hyrfpack` on the command line."""
    ctx.meta[_ARGUMENTS] = list(arguments)


def arguments_of(ctx: click.Context) -> list[str]:
    """What follows `hyrfpack` on the command line."""
    return ctx.meta[_ARGUMENTS]


def is_verbose() -> bool:
    """Whether the command that runs was given --verbose."""
    ctx = click.get_current_context(silent=True)
    return ctx is not None and ctx.meta.get(_MANNER) == "verbose"


def note(sentence: str) -> None:
    """Tell the person something on standard error; with --verbose, with the seconds since the start before it.

    Python arguments that the sentence names become options, see `with_options`.
    """
    sentence = with_options(sentence)
    if is_verbose():
        sentence = f"[{time.perf_counter() - click.get_current_context().meta[_STARTED]:7.2f} s] {sentence}"
    with suppress(OSError):  # a full disk or a terminal that is gone does not end the work
        click.echo(sentence, err=True)


def counted(items: Iterable[T], length: int, label: str) -> Iterator[T]:
    """The items, with a bar on standard error; where that cannot be drawn, the work goes on without."""
    with click.progressbar(items, length, label, file=cast(TextIO, _LenientError())) as bar:
        yield from bar


class _LenientError:
    """Standard error that drops what cannot be written."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)

    def write(self, text: str) -> int:
        with suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            sys.stderr.flush()


def detail(sentence: str) -> None:
    """`note` what only --verbose wants to know."""
    if is_verbose():
        note(sentence)


def mend_streams() -> None:
    """Make standard streams that can be written to.

    The null device stands in for a closed one (`2>&-`): the next file to be opened would get its number, and what a
    library prints there. File names that the terminal's encoding lacks are printed with escapes.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if _is_closed(getattr(sys, name), mode):
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def _is_closed(stream: TextIO | None, mode: str) -> bool:
    if stream is None or mode == "r":
        return stream is None
    try:
        os.write(stream.fileno(), b"")
    except OSError as error:  # a stream of a test or a notebook has no number, and no EBADF
        return error.errno == errno.EBADF
    return False
