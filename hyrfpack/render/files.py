"""Rendered views as picture files."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Protocol

import torch
from PIL import Image
from torch import Tensor

from hyrfpack.atomic import write_atomic
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.outputs import PICTURE_SUFFIXES
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.render.renderer import RenderSettings, render
from hyrfpack.scene import Camera


def render_files(
    model: HybridModel,
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    *,
    depth: bool = False,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    overwrite: bool = True,
    ranks: Ranks = SINGLE_PROCESS,
) -> Iterator[Path]:
    """Render named cameras to `folder/<name>.png`, sub-folders kept; yields each path once it is written.

    The folder is locked until the last picture is written or the iterator is closed.

    Args:
        model: what to render.
        cameras: names (of photos, or any) and cameras.
        folder: made if missing.
        depth: also write `<name>.depth.tiff`: one float32 channel, depth along the view axis in world units, 0 where
            no Gaussian is hit.
        settings: how to render.
        overwrite: replace files that are there; without it, a picture gets a free name beside one that is there, and
            depth that is there is an error.
        ranks: processes that share the cameras; each yields what it has written.

    Raises:
        HyrfError: a picture cannot be written, or another call is at work in the folder.
    """
    with exclusive_folder(folder, ranks=ranks):
        draw = drawing_function(model, depth=depth, settings=settings)
        yield from write_pictures(draw, cameras, folder, overwrite=overwrite, ranks=ranks)


class Drawn(Protocol):
    """A picture of colours (H, W, 3) and, where it was asked for, of depth (H, W) in world units."""

    @property
    def rgb(self) -> Tensor: ...

    @property
    def depth(self) -> Tensor | None: ...


def drawing_function(
    model: HybridModel,
    *,
    depth: bool = False,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> Callable[[Camera], Drawn]:
    """Return a function that renders a model, decoded once, from a camera. Arguments as of `render_files`."""
    with torch.no_grad():
        decoded = model.decode()
    return partial(render, model, settings=settings, decoded=decoded, depth=depth)


def write_pictures(
    draw: Callable[[Camera], Drawn],
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = True,
    ranks: Ranks = SINGLE_PROCESS,
) -> Iterator[Path]:
    """Write what `draw` shows of named cameras into a folder that the caller has locked; see `render_files`."""
    named = list(zip(file_names([name for name, _ in cameras]), cameras, strict=True))
    for name, (_, camera) in ranks.share(named):
        with torch.no_grad():
            rendering = draw(camera)
        path = Path(folder) / f"{name}.png"
        written = save_picture(path, to_image(rendering.rgb), overwrite=overwrite)
        if rendering.depth is not None:
            depths = Image.fromarray(rendering.depth.float().cpu().numpy())
            save_picture(path.with_suffix(".depth.tiff"), depths, overwrite=overwrite, rename=False)
        yield written


def rendered_names(names: Sequence[str], depth: bool = False) -> list[str]:
    """What `render_files` writes for cameras of these names, relative to its folder."""
    kinds = (".png", ".depth.tiff") if depth else (".png",)
    return [f"{name}{kind}" for name in file_names(names) for kind in kinds]


def to_image(rgb: Tensor) -> Image.Image:
    """(H, W, 3) colours, clamped to [0, 1] and rounded to 8 bits."""
    return Image.fromarray((rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())


def file_names(names: Sequence[str]) -> list[str]:
    """Names of photos to paths for renders, without an extension: relative, inside the folder, no two alike.

    "left/0001.JPG" becomes "left/0001"; where two photos differ in their extension only, all keep it.
    """
    full = [_safe(name) for name in names]
    bare = [
        str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).suffix.lower() in PICTURE_SUFFIXES else name
        for name in full
    ]
    chosen = bare if len(set(bare)) == len(bare) else full
    if len(set(chosen)) < len(chosen):
        chosen = [f"{number:04d}_{name}" for number, name in enumerate(chosen)]
    return chosen


def _safe(name: str) -> str:
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in {"/", ".", ".."}]
    kept = "/".join(parts)
    return "".join(c if c.isprintable() and c not in ':*?"<>|' else "_" for c in kept) or "view"


def save_picture(
    path: str | os.PathLike[str], image: Image.Image, *, overwrite: bool = True, rename: bool = True
) -> Path:
    """Write a picture in one step, in the format of its extension, making its folder; returns the path written.

    `overwrite` and `rename` are those of `hyrfpack.atomic.pending_file`.

    Raises:
        HyrfError: the folder or the file cannot be written.
    """
    data = io.BytesIO()
    image.save(data, format=Image.registered_extensions()[Path(path).suffix.lower()])
    return write_atomic(path, data.getbuffer(), overwrite=overwrite, rename=rename)
