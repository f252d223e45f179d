"""Options of the commands that draw a model: `hyrfpack render` and `evaluate`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from hyrfpack.choices import AS_PHOTOGRAPHED, RENDER_EXPOSURES
from hyrfpack.cli.common import choose_command_device, device_options, json_option, overwrite_option
from hyrfpack.cli.processes import processes_option
from hyrfpack.errors import HyrfError

if TYPE_CHECKING:
    from hyrfpack.cli.render_source import RenderSource
    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.render import RenderSettings
    from hyrfpack.scene import Camera, Scene, View

Command = TypeVar("Command", bound=Callable)

SPLITS = ("test", "train", "all")


@dataclass(frozen=True)
class Drawing:
    """How a command draws a model: the values of the options of `drawing_options`."""

    allow_partial: bool
    exposure: str
    device: str
    precision: str
    ranks: Ranks

    @property
    def settings(self) -> RenderSettings:
        """The settings of all renders."""
        from hyrfpack.render import RenderSettings

        return RenderSettings(exposure=self.exposure)

    def open(self, path: Path) -> RenderSource:
        """Open a model or splats on the chosen device, on all ranks.

        Raises:
            HyrfError: the file or the device cannot be used.
        """
        from hyrfpack.cli.render_source import RenderSource

        device = choose_command_device(self.device, self.ranks)
        return self.ranks.run_on_all(lambda: RenderSource.open(path, device, self.precision, self.allow_partial))


def drawing_options(command: Command) -> Command:
    """Add the options that `render` and `evaluate` share.

    The command gets --allow-partial, --exposure, --device, --precision and --processes as one argument, `drawing`, and
    --overwrite and --json as `overwrite` and `as_json`.
    """

    @functools.wraps(command)
    def with_drawing(
        *args: Any, allow_partial: bool, exposure: str, device: str, precision: str, ranks: Ranks, **others: Any
    ) -> Any:
        return command(*args, drawing=Drawing(allow_partial, exposure, device, precision, ranks), **others)

    allow_partial_option = click.option(
        "--allow-partial",
        is_flag=True,
        help="Accept a file that is cut short, if enough of it is there for a coarser model.",
    )
    exposure_option = click.option(
        "--exposure",
        type=click.Choice(RENDER_EXPOSURES),
        default=AS_PHOTOGRAPHED,
        show_default=True,
        help="Exposure of renders: each view like the photos taken near it, or one consistent exposure for all views. "
        "A model without an exposure map looks the same with both.",
    )
    with_options: Any = with_drawing
    for add in (json_option, device_options, processes_option, overwrite_option, exposure_option, allow_partial_option):
        with_options = add(with_options)
    return with_options


def split_option(help: str) -> Callable[[Command], Command]:
    """Return the option --split, which chooses the views of --data."""
    return click.option("--split", type=click.Choice(SPLITS), default="test", show_default=True, help=help)


def select_views(scene: Scene, split: str) -> list[View]:
    """Return the views of a split: "test", "train" or "all".

    Raises:
        HyrfError: the split has no views.
    """
    views = {"test": scene.test, "train": scene.train, "all": scene.views}[split]
    if not views:
        raise HyrfError(f"{scene.path}: no photo is in the split '{split}'", fix="name another --split or --test-every")
    return views


def largest_picture_size(cameras: Iterable[Camera]) -> tuple[int, int]:
    """Return (width, height) in pixels of the largest picture that any of the cameras makes."""
    return max(((camera.width, camera.height) for camera in cameras), key=lambda size: size[0] * size[1])
