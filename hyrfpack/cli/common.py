"""What several commands share: options of data sets, and how results are printed."""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from hyrfpack.atomic import describe_rename
from hyrfpack.choices import AS_PHOTOGRAPHED, LAYOUTS, PRECISIONS, RENDER_EXPOSURES
from hyrfpack.cli.manners import detail, note
from hyrfpack.errors import HyrfError

if TYPE_CHECKING:
    import torch

    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.scene import Camera, Scene, View

Command = TypeVar("Command", bound=Callable)

PATH = click.Path(path_type=Path)
SEED = click.IntRange(0, 2**64 - 1)  # hyrfpack.train.config.LARGEST_SEED, without loading torch
_SIZE = re.compile(r"([0-9.]+)\s*([kmg]?)b?", re.IGNORECASE)


class _OutputPath(click.ParamType):
    """Where to write. Unlike a path to read it has a name of its own."""

    name = "path"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        if str(value) in ("", "-"):
            self.fail(f"'{value}' names no file; results are written to files, so give one", param, ctx)
        return Path(str(value))


OUTPUT = _OutputPath()


class _Bytes(click.ParamType):
    """A size such as 2MB, 350k or 1500000; k, M and G are powers of 1000."""

    name = "size"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        match = _SIZE.fullmatch(str(value).strip())
        try:
            size = int(float(match[1]) * 1000 ** " kmg".index(match[2].lower() or " ")) if match else 0
        except (ValueError, OverflowError):
            size = 0
        if size < 1:
            self.fail(f"'{value}' is not a size; write it as 2MB, 350kB or 1500000", param, ctx)
        return size


SIZE = _Bytes()

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace files that are there; what the command reads is never replaced."
)


def number(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, which no range does."""
    if value is not None and math.isnan(value):
        raise click.BadParameter("NaN is not a number", ctx, param)
    return value


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")


def scene_options(command: Command) -> Command:
    """Options that say how a data folder is read, which the command gets as one argument, `reading`, for `read_scene`.

    --test-every, --images, --max-size, --layout, --model.
    """

    @functools.wraps(command)
    def with_reading(
        *args: Any,
        test_every: int,
        images: str | None,
        max_size: int | None,
        layout: str | None,
        colmap_model: str | None,
        **others: Any,
    ) -> Any:
        reading = {"test_every": test_every, "images": images, "max_size": max_size, "layout": layout}
        return command(*args, reading={**reading, "model": colmap_model}, **others)

    with_options: Any = with_reading
    for option in (
        click.option(
            "--model",
            "colmap_model",
            metavar="NAME",
            help="COLMAP model to take, such as 1 for sparse/1.  [default: the largest]",
        ),
        click.option("--layout", type=click.Choice(LAYOUTS), help="How the folder is laid out.  [default: detected]"),
        click.option(
            "--max-size",
            type=click.IntRange(min=0),
            metavar="PIXELS",
            help="Shrink photos that are larger than this on the longer side; 0 keeps them.  "
            "[default: 1600, or what MODEL was trained at]",
        ),
        click.option("--images", metavar="NAME", help="Folder of pictures to use, such as images_4."),
        click.option(
            "--test-every",
            type=click.IntRange(min=0),
            default=8,
            show_default=True,
            metavar="N",
            help="Hold out every Nth photo by name for testing; 0 holds out none. Sets with a split of their own "
            "keep it.",
        ),
    ):
        with_options = option(with_options)
    return with_options


device_option = click.option(
    "--device",
    metavar="NAME",
    default="auto",
    show_default=True,
    help="cpu, cuda (NVIDIA and AMD), cuda:N or mps; auto takes cuda where it and Triton are.",
)


exposure_option = click.option(
    "--exposure",
    type=click.Choice(RENDER_EXPOSURES),
    default=AS_PHOTOGRAPHED,
    show_default=True,
    help="Expose each view like the photos taken near it, or all views alike. The same for a model without an "
    "exposure map.",
)


def device_options(command: Command) -> Command:
    """Options that say where the work is done, and how exactly there: --device, --precision."""
    precision = click.option(
        "--precision",
        type=click.Choice(PRECISIONS),
        default="mixed",
        show_default=True,
        help="What a GPU multiplies in: bfloat16 with float32 sums, or float32. The CPU knows float32 only.",
    )
    return device_option(precision(command))


def chosen_device(name: str, ranks: Ranks | None = None) -> torch.device:
    """The device of --device, with a word about it where it is slow; each of several processes has its own."""
    from hyrfpack.device import choose_own_device, describe_device
    from hyrfpack.parallel.ranks import SINGLE_PROCESS

    device = choose_own_device(name, ranks or SINGLE_PROCESS, note)
    detail(f"device: {describe_device(device)}")
    return device


def read_scene(path: Path, reading: dict[str, Any], model: dict | None = None) -> Scene:
    """Read a data folder and tell what the reader has to say about it, and whether a model is of other photos.

    Args:
        path: the folder.
        reading: from `scene_options`.
        model: facts of the model file (`hyrfpack.describe`) that the photos are of, if any: it says how large they
            are wanted where --max-size does not.
    """
    from hyrfpack.cameras.capture import Capture
    from hyrfpack.data import load_scene
    from hyrfpack.scene import DEFAULT_MAX_SIZE

    if reading["max_size"] is None:
        reading = {**reading, "max_size": DEFAULT_MAX_SIZE if model is None else Capture(model).max_size}
    scene = load_scene(path, **reading)
    for sentence in scene.notes:
        note(sentence)
    if model is not None and (mismatch := Capture(model, scene).mismatch):
        note(mismatch)
    return scene


def note_rename(asked: Path, written: Path | str) -> Path:
    """The path that was written, with a note where it is not the one that was asked for."""
    if Path(written) != asked:
        note(describe_rename(asked, written))
    return Path(written)


def named_model(path: Path) -> Path:
    """Return the `.hyrf` file that an argument names, see `hyrfpack.format.find_model`.

    Raises:
        HyrfError: it is a folder without a model, or names splats, which have to be imported first.
    """
    from hyrfpack.format import find_model
    from hyrfpack.splats.names import is_splats

    if is_splats(path):
        model = Path(path.stem).with_suffix(".hyrf")
        raise HyrfError(f"{path}: these are splats, not a model; import it first: 'hyrfpack import {path} -o {model}'")
    return find_model(path)


def split_views(scene: Scene, split: str) -> list[View]:
    """The views of a split.

    Raises:
        HyrfError: it has none.
    """
    views = {"test": scene.test, "train": scene.train, "all": scene.views}[split]
    if not views:
        raise HyrfError(f"{scene.path}: no photo is in the split '{split}'; name another --split or --test-every")
    return views


def largest_picture(cameras: Iterable[Camera]) -> tuple[int, int]:
    """(width, height) in pixels of the largest picture that cameras make."""
    return max(((camera.width, camera.height) for camera in cameras), key=lambda size: size[0] * size[1])


def at_one_exposure(psnr_consistent: float | None) -> str:
    """Return what is printed behind a PSNR: that of renders at one exposure, or "" for a model without a map."""
    return "" if psnr_consistent is None else f" ({psnr_consistent:.2f} dB at one exposure)"


def print_json(values: dict) -> None:
    """Print one JSON object, the only thing a command puts on standard output under --json."""
    click.echo(json.dumps(values, indent=1, allow_nan=False))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of words and numbers as aligned text: the first column to the left, the others to the right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(_columns(line[column]) for line in lines) for column in range(len(header))]

    def align(line: Sequence[str]) -> str:
        gaps = [" " * (width - _columns(cell)) for cell, width in zip(line, widths, strict=True)]
        cells = [line[0] + gaps[0], *(gap + cell for cell, gap in zip(line[1:], gaps[1:], strict=True))]
        return "  ".join(cells).rstrip()

    first, *others = map(align, lines)
    return "\n".join([first, "  ".join("-" * width for width in widths), *others])


def _columns(text: str) -> int:
    """How many columns of a terminal a text takes: wide characters (CJK) take two."""
    if text.isascii():
        return len(text)
    from rich.cells import cell_len

    return cell_len(text)
