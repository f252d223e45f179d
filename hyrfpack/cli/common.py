"""Options, argument types and printing functions that several commands share."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from hyrfpack.atomic import describe_rename
from hyrfpack.choices import LAYOUTS
from hyrfpack.cli.console import note, note_if_verbose
from hyrfpack.cli.settings import settings_options
from hyrfpack.config.train import TrainConfig
from hyrfpack.errors import HyrfDataError, HyrfError, suggest_command

if TYPE_CHECKING:
    import torch

    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.scene import Scene

Command = TypeVar("Command", bound=Callable)

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace existing files. Files that the command reads are never replaced."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the results as one JSON object.")

# Names of the parameters that need --data: those that `scene_options` adds, and that of `split_option`.
_PHOTO_OPTIONS = ("test_every", "images", "max_size", "layout", "colmap_model", "split")


def scene_options(command: Command) -> Command:
    """Add the options that control how a folder of photos and poses is read.

    They are --test-every, --images, --max-size, --layout and --model. The command gets them as one argument,
    `reader_options`, for `read_scene`.
    """

    @functools.wraps(command)
    def with_reader_options(
        *args: Any,
        test_every: int | None,
        images: str | None,
        max_size: int | None,
        layout: str | None,
        colmap_model: str | None,
        **others: Any,
    ) -> Any:
        if not others["data"]:
            _refuse_photo_options(click.get_current_context())
        reader_options = {"test_every": test_every, "images": images, "max_size": max_size, "layout": layout}
        return command(*args, reader_options={**reader_options, "model": colmap_model}, **others)

    with_options: Any = with_reader_options
    for option in (
        click.option(
            "--model",
            "colmap_model",
            metavar="NAME",
            help="COLMAP model to read, such as 1 for sparse/1.  [default: the largest]",
        ),
        click.option("--layout", type=click.Choice(LAYOUTS), help="Layout of the data folder.  [default: detected]"),
        click.option(
            "--max-size",
            type=click.IntRange(min=0),
            metavar="PIXELS",
            help="Shrink photos whose longer side exceeds this; 0 keeps their size.  [default: 1600; with a MODEL, "
            "the size that it was trained at]",
        ),
        click.option("--images", metavar="NAME", help="Folder of the photos within the data folder, such as images_4."),
        click.option(
            "--test-every",
            type=click.IntRange(min=0),
            metavar="N",
            help="Hold out every Nth photo, in order of file names, for testing; 0 holds out none. A data set with a "
            "test split keeps that split.  [default: 8; with the folder of a run as MODEL, the "
            "photos that it held out]",
        ),
    ):
        with_options = option(with_options)
    return with_options


def is_given(context: click.Context, parameter: click.Parameter) -> bool:
    """Return whether the user gave a parameter on the command line, even with its default value."""
    return context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE


def _refuse_photo_options(context: click.Context) -> None:
    """Raise UsageError if an option that needs photos was given, for a command that reads none."""
    for option in context.command.params:
        if option.name in _PHOTO_OPTIONS and is_given(context, option):
            raise click.UsageError(f"{option.opts[0]} is for reading photos; name their folder with --data")


_SELF_TEST_KEY = "hyrfpack.self_test"  # key of --self-test in click's context


def _store_self_test(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    ctx.meta[_SELF_TEST_KEY] = value


def device_option(command: Command) -> Command:
    """Add the options --device and --no-self-test, whose values `choose_command_device` takes."""
    with_options = click.option(
        "--self-test/--no-self-test",
        default=True,
        expose_value=False,
        callback=_store_self_test,
        help="Test the GPU's kernels on its first use, and replace those that do not work by plain torch.  "
        "[default: self-test]",
    )(command)
    return click.option(
        "--device",
        metavar="NAME",
        default="auto",
        show_default=True,
        help="Device: cpu, cuda (NVIDIA and AMD GPUs), cuda:N or mps (Apple GPUs). auto uses cuda if there is a GPU "
        "and Triton is installed, otherwise cpu.",
    )(with_options)


def is_self_test_wanted() -> bool:
    """Return the value of --self-test, of a command with `device_option`."""
    return click.get_current_context().meta[_SELF_TEST_KEY]


def device_options(command: Command) -> Command:
    """Add the options --device and --precision, which choose the device and its precision."""
    return device_option(settings_options(TrainConfig, "precision")(command))


def choose_command_device(name: str, ranks: Ranks | None = None) -> torch.device:
    """Choose the device that --device names, with the self-test of its kernels unless --no-self-test is given.

    Args:
        name: value of the option.
        ranks: processes that work together, all of which call this; each gets a device of its own.

    Raises:
        HyrfError: as `hyrfpack.device.choose_own_device`.
    """
    from hyrfpack.device import choose_own_device, describe_device
    from hyrfpack.parallel.ranks import SINGLE_PROCESS

    device = choose_own_device(name, ranks or SINGLE_PROCESS, self_test=is_self_test_wanted())
    note_if_verbose(f"device: {describe_device(device)}")
    return device


def read_scene(
    path: Path,
    reader_options: dict[str, Any],
    model: Path | None = None,
    facts: dict | None = None,
    *,
    must_match: bool = False,
) -> Scene:
    """Read a folder of photos and poses, and print the reader's notes.

    The poses are moved as edits have moved the model. Further notes say whether it was trained on other photos, or on
    some that are held out.

    Args:
        path: the folder, or an archive of it.
        reader_options: values of the options of `scene_options`.
        model: the model file that belongs to the photos, if any. If it is that of a run on them, the run says which
            photos are held out if --test-every does not.
        facts: description (`hyrfpack.describe_file`) of the model; None for splats. It gives the size of the photos if
            --max-size does not.
        must_match: refuse photos that the model was not trained on, because what is written depends on them.

    Raises:
        HyrfError: as `hyrfpack.load_scene`, or the photos do not match the model.
    """
    from hyrfpack.cameras.capture import LEAK_REMEDY, MISMATCH_REMEDY, Capture, place_photos
    from hyrfpack.data import load_scene
    from hyrfpack.scene import DEFAULT_TEST_EVERY

    options = {name: value for name, value in reader_options.items() if value is not None}
    if facts is not None:
        options = {"max_size": Capture(facts).max_size, **options}
    if model is not None and "test_every" not in options:
        from hyrfpack.train.photos import read_recorded_split

        split = read_recorded_split(model, path, options)
        if split.get("test_every", DEFAULT_TEST_EVERY) != DEFAULT_TEST_EVERY or "held_out" in split:
            note(f"the same photos are held out as in the run {model.parent}")
        options |= split
    scene = load_scene(path, **options)
    for sentence in scene.notes:
        note(sentence)
    if facts is None:
        return scene
    scene = place_photos(facts, scene)
    capture = Capture(facts, scene)
    if mismatch := capture.mismatch:
        if must_match:
            raise HyrfDataError(mismatch, fix=MISMATCH_REMEDY)
        note(f"{mismatch}; {MISMATCH_REMEDY}")
    elif leak := capture.leak:
        note(f"{leak}; {LEAK_REMEDY}")
    return scene


def note_rename(requested: Path, written_path: Path | str) -> Path:
    """Return the path that was written, and print a note if another one was requested."""
    # Real paths are compared, because `make` gives the full path of an output such as "..".
    if os.path.realpath(written_path) != os.path.realpath(requested):
        note(describe_rename(requested, written_path))
    return Path(written_path)


def suggest_model_name(splats: Path) -> str:
    """Return a name for the model that is imported from splats: "room.hyrf" for room.ply or for a folder room/."""
    return f"{Path(os.path.abspath(splats)).stem or 'scene'}.hyrf"


def resolve_model_file(path: Path) -> Path:
    """Return the `.hyrf` file that an argument names by its path or by the folder of its run.

    Raises:
        HyrfError: the argument is a folder without a model, or splats, which have to be imported first.
    """
    from hyrfpack.format import find_model
    from hyrfpack.splats.names import is_splats

    if is_splats(path):
        model = suggest_model_name(path)
        raise HyrfError(
            f"{path}: these are splats, not a model",
            fix=f"import it first: {suggest_command('import', path, '-o', model)}",
        )
    return find_model(path)


def format_consistent_psnr(psnr_consistent: float | None) -> str:
    """Return text on the PSNR at the consistent exposure, to append to another PSNR; "" if there is none."""
    return "" if psnr_consistent is None else f" ({psnr_consistent:.2f} dB at one exposure)"


def print_json(values: dict) -> None:
    """Print one JSON object, which is all that a command prints on standard output with --json."""
    click.echo(json.dumps(values, indent=1, allow_nan=False))


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format rows as aligned text, the first column to the left and the others to the right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(_display_width(line[column]) for line in lines) for column in range(len(header))]

    def align(line: Sequence[str]) -> str:
        gaps = [" " * (width - _display_width(cell)) for cell, width in zip(line, widths, strict=True)]
        cells = [line[0] + gaps[0], *(gap + cell for cell, gap in zip(line[1:], gaps[1:], strict=True))]
        return "  ".join(cells).rstrip()

    aligned_header, *aligned_rows = map(align, lines)
    return "\n".join([aligned_header, "  ".join("-" * width for width in widths), *aligned_rows])


def _display_width(text: str) -> int:
    """Return the number of terminal columns that a text takes; wide characters (CJK) take two."""
    if text.isascii():
        return len(text)
    from rich.cells import cell_len

    return cell_len(text)
