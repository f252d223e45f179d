"""The command line, which parses arguments, calls the library and prints results, and computes nothing itself.

Exit codes: 0 for success, 1 for a bug in hyrfpack or an interruption, 2 for an error that the user can correct (one
sentence on standard error). No module here imports torch or numpy before a command needs them, so that commands such as
`hyrfpack info` answer at once.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import click

from hyrfpack.cli.bench import bench
from hyrfpack.cli.common import print_json
from hyrfpack.cli.compare import compare
from hyrfpack.cli.compress import compress, decompress
from hyrfpack.cli.console import (
    add_verbosity_options,
    is_verbose,
    log_as_notes,
    note,
    repair_std_streams,
    store_arguments,
    stored_arguments,
)
from hyrfpack.cli.convert import convert
from hyrfpack.cli.demo import demo
from hyrfpack.cli.doctor import doctor
from hyrfpack.cli.edit import edit
from hyrfpack.cli.evaluate import evaluate
from hyrfpack.cli.export import export
from hyrfpack.cli.imports import import_
from hyrfpack.cli.info import info
from hyrfpack.cli.make import make
from hyrfpack.cli.merge import merge
from hyrfpack.cli.poses import poses
from hyrfpack.cli.render import render
from hyrfpack.cli.split import split
from hyrfpack.cli.train import train
from hyrfpack.cli.view import view
from hyrfpack.cli.wording import use_option_names
from hyrfpack.errors import HyrfError, needs_package, printable
from hyrfpack.kernel_errors import KERNEL_ERROR_FIX, describe_kernel_error
from hyrfpack.out_of_memory import GPU_PROBLEM, describe_out_of_memory
from hyrfpack.version import __version__

# Errors of the system at any path of a user, such as one in a folder without access.
_PATH_ERRORS = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.EIO)


class _CommandGroup(click.Group):
    """A group of commands that reports errors of the user as one sentence, with exit code 2."""

    def main(self, *args: Any, **options: Any) -> Any:
        repair_std_streams()
        return super().main(*args, **options)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        store_arguments(ctx, args)
        return super().parse_args(ctx, args)

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        with _errors_as_json(args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        with _errors_as_json(stored_arguments(ctx)), log_as_notes():
            return self._invoke(ctx)

    def _invoke(self, ctx: click.Context) -> Any:
        try:
            with needs_package("this command"):
                result = super().invoke(ctx)
        except HyrfError as error:
            if is_verbose():
                traceback.print_exc()
            raise _UserError(f"{error.problem}; {use_option_names(error.fix)}") from error
        except Exception as error:
            message = _explain_error(error)
            if message is None:
                raise
            if is_verbose():
                traceback.print_exc()
            raise _UserError(message) from error
        _note_uncached_kernels()
        return result

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)  # help lists commands in the order of their use, not in alphabetical order


def _explain_error(error: Exception) -> str | None:
    """Return the message for an error that is not a HyrfError but that a user can correct; None for a bug."""
    if (problem := describe_out_of_memory(error)) is not None:
        remedy = ", or --device cpu" if problem.startswith(GPU_PROBLEM) else ""
        return f"{problem}; use smaller photos, pictures or models{remedy}"
    if (problem := describe_kernel_error(error)) is not None:
        return f"{problem}; {KERNEL_ERROR_FIX}"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        # Functions that write files raise HyrfError, so that this error comes from printing onto a full disk.
        return f"the output cannot be printed ({error.strerror}); send it elsewhere"
    if isinstance(error, OSError) and error.filename is not None and error.errno in _PATH_ERRORS:
        return f"{printable(os.fsdecode(error.filename))}: cannot be used ({error.strerror}); check the path"
    return None


def _note_uncached_kernels() -> None:
    """Print a note if the command has loaded compiled kernels and they cannot be cached on disk."""
    kernels = sys.modules.get("hyrfpack.parallel.compiled")
    if kernels is not None and not kernels.can_cache_kernels():
        note(
            "compiled kernels cannot be cached, so each run compiles them again; set a folder for them in "
            "NUMBA_CACHE_DIR, and one for matplotlib's fonts in MPLCONFIGDIR"
        )


@contextmanager
def _errors_as_json(arguments: Sequence[str]) -> Iterator[None]:
    """If the arguments contain --json, print an error that the user can correct also as JSON on standard output."""
    as_json = "--json" in arguments
    try:
        yield
    except click.ClickException as error:
        if as_json:
            with suppress(OSError):  # the error may be that standard output cannot be written
                print_json({"error": printable(error.format_message())})
        raise


class _UserError(click.ClickException):
    """An error that the user can correct."""

    exit_code = 2


@click.group(cls=_CommandGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="hyrfpack")
def main() -> None:
    """Turn photos or a video into a small .hyrf file: estimate poses, train a radiance field, compress, render, export.

    \b
    First steps:
      hyrfpack demo -o demo
      hyrfpack info photos/
      hyrfpack make photos/ -o scene.html

    \b
    The same, one stage at a time:
      hyrfpack poses photos/ -o scenes/bonsai
      hyrfpack train scenes/bonsai -o runs/bonsai
      hyrfpack compress runs/bonsai -o bonsai.hyrf
      hyrfpack evaluate bonsai.hyrf --data scenes/bonsai
    """


for _command in (
    make,
    poses,
    train,
    compare,
    compress,
    decompress,
    render,
    evaluate,
    export,
    view,
    import_,
    convert,
    edit,
    merge,
    split,
    bench,
    info,
    doctor,
    demo,
):
    main.add_command(_command)
    add_verbosity_options(_command)
add_verbosity_options(main)
