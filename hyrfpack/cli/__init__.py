"""The command line: parses, calls the library, prints. No numerics.

Exit codes: 0 done, 1 a bug of ours or interrupted, 2 something the user can correct (one sentence on standard error).
Nothing here imports torch or numpy before a command needs it, so that `hyrfpack info` answers at once.
"""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import click

from hyrfpack.cli.bench import bench
from hyrfpack.cli.common import print_json
from hyrfpack.cli.compare import compare
from hyrfpack.cli.convert import convert
from hyrfpack.cli.demo import demo
from hyrfpack.cli.export import export
from hyrfpack.cli.files import compress, decompress, info
from hyrfpack.cli.imports import import_
from hyrfpack.cli.make import make
from hyrfpack.cli.manners import add_manners, arguments_of, is_verbose, keep_arguments, mend_streams, note
from hyrfpack.cli.poses import poses
from hyrfpack.cli.train import train
from hyrfpack.cli.view import view
from hyrfpack.cli.views import evaluate, render
from hyrfpack.cli.wording import with_options
from hyrfpack.errors import HyrfError, printable
from hyrfpack.version import __version__


class _Commands(click.Group):
    """A group of commands that turns errors of the user's into one sentence and exit code 2."""

    def main(self, *args: Any, **options: Any) -> Any:
        mend_streams()
        return super().main(*args, **options)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        keep_arguments(ctx, args)
        return super().parse_args(ctx, args)

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        with _errors_as_json(args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        with _errors_as_json(arguments_of(ctx)):
            return self._invoke(ctx)

    def _invoke(self, ctx: click.Context) -> Any:
        try:
            result = super().invoke(ctx)
        except HyrfError as error:
            if is_verbose():
                traceback.print_exc()
            raise _Refusal(with_options(str(error))) from error
        except OSError as error:
            # Files are written by functions that raise HyrfError: what is left is printing onto a full disk.
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise _Refusal(f"the output cannot be printed ({error.strerror}); send it elsewhere") from error
        _tell_of_kernels()
        return result

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)  # in the order of use, not of the alphabet


def _tell_of_kernels() -> None:
    """Say it where the kernels that a command has compiled are lost with it."""
    kernels = sys.modules.get("hyrfpack.parallel.compiled")
    if kernels is not None and not kernels.can_cache_kernels():
        note(
            "compiled kernels cannot be kept, so that each run compiles them anew; name a folder for them in "
            "NUMBA_CACHE_DIR, and one for matplotlib's fonts in MPLCONFIGDIR"
        )


@contextmanager
def _errors_as_json(arguments: Sequence[str]) -> Iterator[None]:
    """Print an error that the user can correct on standard output, too, where --json is among the arguments."""
    as_json = "--json" in arguments
    try:
        yield
    except click.ClickException as error:
        if as_json:
            with suppress(OSError):  # standard output may be what the error is about
                print_json({"error": printable(error.format_message())})
        raise


class _Refusal(click.ClickException):
    exit_code = 2


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="hyrfpack")
def main() -> None:
    """Make small .hyrf files of photos or a video: find poses, train hybrid radiance fields, compress, render, export.

    \b
    A first round:
      hyrfpack demo -o demo
      hyrfpack info photos/
      hyrfpack make photos/ -o scene.html

    \b
    The same step by step:
      hyrfpack poses photos/ -o scenes/bonsai
      hyrfpack train scenes/bonsai -o runs/bonsai
      hyrfpack compress runs/bonsai -o bonsai.hyrf
      hyrfpack evaluate bonsai.hyrf --data scenes/bonsai
    """


_COMMANDS = (
    *(
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
        bench,
        info,
        demo,
    ),
)
for _command in _COMMANDS:
    main.add_command(_command)
    add_manners(_command)
add_manners(main)
