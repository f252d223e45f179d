"""Output of all commands to the terminal: --quiet, --verbose, notes, and streams that are closed."""

from __future__ import annotations

import errno
import logging
import os
import platform
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from typing import TextIO

import click

from hyrfpack.cli.wording import use_option_names
from hyrfpack.errors import printable
from hyrfpack.version import __version__

# Keys of values in click's context, which all commands share.
_VERBOSITY_KEY = "hyrfpack.verbosity"
_START_TIME_KEY = "hyrfpack.start_time"
_ARGUMENTS_KEY = "hyrfpack.arguments"
_REPORTED_PACKAGES = ("torch", "numpy", "numba", "triton", "pycolmap")


def add_verbosity_options(command: click.Command) -> None:
    """Add the options --quiet and --verbose to a command or a group."""
    for flag, help in (
        ("--quiet", "Print nothing but errors on standard error."),
        ("--verbose", "Print details for a bug report: versions, device, times, tracebacks."),
    ):
        command.params.append(
            click.Option([flag], is_flag=True, expose_value=False, callback=_set_verbosity, help=help)
        )


def _set_verbosity(ctx: click.Context, option: click.Parameter, is_given: bool) -> None:
    """Apply --quiet or --verbose, as the callback of these options."""
    if not is_given or ctx.resilient_parsing or ctx.meta.get(_VERBOSITY_KEY) == option.name:
        return
    root = ctx.find_root()
    if _VERBOSITY_KEY in ctx.meta:
        root.close()  # this restores standard error, where the message goes
        raise click.UsageError("--quiet and --verbose contradict each other; give one of them", ctx)
    ctx.meta[_VERBOSITY_KEY] = option.name
    if option.name == "quiet":  # silences progress and libraries, too; errors are printed after the root is closed
        root.with_resource(redirect_stderr(root.with_resource(open(os.devnull, "w", encoding="utf-8"))))
        return
    ctx.meta[_START_TIME_KEY] = time.perf_counter()
    note(f"{_versions()}; on {platform.platform()} with {os.cpu_count()} cores")
    root.call_on_close(lambda: note(f"done (CPU time {time.process_time():.1f} s)"))


def _versions() -> str:
    """Return the versions of hyrfpack, Python and the packages that matter in a bug report."""
    from importlib.metadata import PackageNotFoundError, version

    versions = [f"hyrfpack {__version__}", f"Python {platform.python_version()}"]
    for package in _REPORTED_PACKAGES:
        with suppress(PackageNotFoundError):
            versions.append(f"{package} {version(package)}")
    return ", ".join(versions)


def store_arguments(ctx: click.Context, arguments: Iterable[str]) -> None:
    """Store the arguments that follow `hyrfpack` on the command line."""
    ctx.meta[_ARGUMENTS_KEY] = list(arguments)


def stored_arguments(ctx: click.Context) -> list[str]:
    """Return the arguments that follow `hyrfpack` on the command line."""
    return ctx.meta[_ARGUMENTS_KEY]


def is_verbose() -> bool:
    """Return whether the running command was given --verbose."""
    ctx = click.get_current_context(silent=True)
    return ctx is not None and ctx.meta.get(_VERBOSITY_KEY) == "verbose"


def note(sentence: str) -> None:
    """Print a sentence on standard error; with --verbose, the seconds since the start precede it.

    Python arguments that the sentence names become options, see `use_option_names`. Unprintable characters become
    escapes.
    """
    sentence = use_option_names(sentence)
    if is_verbose():
        sentence = f"[{time.perf_counter() - click.get_current_context().meta[_START_TIME_KEY]:7.2f} s] {sentence}"
    with suppress(OSError, ValueError):  # a full disk or a closed stream must not end the work
        click.echo(printable(sentence), err=True)


def print_line(line: str) -> None:
    """Print a line on standard output; unprintable characters, as of quoted file names, become escapes."""
    click.echo(printable(line))


def note_if_verbose(sentence: str) -> None:
    """Print a note that only --verbose shows."""
    if is_verbose():
        note(sentence)


class _NoteHandler(logging.Handler):
    """Prints the messages that the library logs as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


_NOTE_HANDLER = _NoteHandler()


@contextmanager
def log_as_notes() -> Iterator[None]:
    """Print the messages that the library logs in the block as notes."""
    logger = logging.getLogger("hyrfpack")
    level, propagate = logger.level, logger.propagate
    logger.addHandler(_NOTE_HANDLER)
    logger.setLevel(logging.INFO)
    logger.propagate = False  # a handler of another library would print the messages again
    try:
        yield
    finally:
        logger.removeHandler(_NOTE_HANDLER)
        logger.setLevel(level)
        logger.propagate = propagate


@contextmanager
def notes_only_of(*packages: str, silent: tuple[str, ...] = ()) -> Iterator[None]:
    """Print only warnings of other packages in the block, because these show their work as progress or not at all.

    Args:
        packages: their messages are printed.
        silent: packages of which not even warnings are printed, because they name options that the command lacks.
    """

    def is_shown(record: logging.LogRecord) -> bool:
        is_warning = record.levelno >= logging.WARNING and not record.name.startswith(silent)
        return is_warning or record.name.startswith(packages)

    _NOTE_HANDLER.addFilter(is_shown)
    try:
        yield
    finally:
        _NOTE_HANDLER.removeFilter(is_shown)


def repair_std_streams() -> None:
    """Replace closed standard streams by the null device, and make standard output accept all characters.

    If a stream stayed closed (`2>&-`), the next file to be opened would get its number, and whatever a library prints
    to the stream. Characters that the terminal's encoding lacks are printed as escapes.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if _is_closed(getattr(sys, name), mode):
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def _is_closed(stream: TextIO | None, mode: str) -> bool:
    """Return whether a standard stream is closed; `mode` is "r" for standard input and "w" for the others."""
    if stream is None or mode == "r":
        return stream is None
    try:
        os.write(stream.fileno(), b"")
    except OSError as error:  # a stream of a test or a notebook has no number, which is another error than EBADF
        return error.errno == errno.EBADF
    return False
