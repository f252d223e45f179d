"""Rendering of views to image files."""

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
from hyrfpack.render.renderer import RenderSettings, render_view
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
    """Render named cameras to `folder/<name>.png`, keeping sub-folders; yield each path once it is written.

    The folder is locked until the last image is written or the iterator is closed.

    Args:
        model: the model to render.
        cameras: pairs of a name (of a photo, or any other) and a camera.
        folder: output folder; it is created if missing.
        depth: whether to write also `<name>.depth.tiff`: one float32 channel, depth along the view axis in world units,
            0 where no Gaussian is hit.
        settings: render settings.
        overwrite: replace existing files. Without it, an image whose file exists is written under a free file name in
            the same folder, and an existing depth file is an error.
        ranks: processes that share the cameras; each yields the paths that it has written.

    Raises:
        HyrfError: an image cannot be written, or another call is writing into the folder.
    """
    with exclusive_folder(folder, ranks=ranks):
        draw = make_renderer(model, depth=depth, settings=settings)
        yield from write_pictures(draw, cameras, folder, overwrite=overwrite, ranks=ranks)


class ColorAndDepth(Protocol):
    """A rendered image of colours (H, W, 3) and, if requested, of depth (H, W) in world units."""

    @property
    def rgb(self) -> Tensor: ...

    @property
    def depth(self) -> Tensor | None: ...


def make_renderer(
    model: HybridModel,
    *,
    depth: bool = False,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> Callable[[Camera], ColorAndDepth]:
    """Decode a model once, and return a function that renders it. The arguments are those of `render_files`."""
    with torch.no_grad():
        decoded = model.decode()
    return partial(render_view, model, settings=settings, decoded=decoded, depth=depth)


def write_pictures(
    draw: Callable[[Camera], ColorAndDepth],
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = True,
    ranks: Ranks = SINGLE_PROCESS,
) -> Iterator[Path]:
    """Write the renders of named cameras by `draw` into a folder that the caller has locked; see `render_files`."""
    named = list(zip(unique_stems([name for name, _ in cameras]), cameras, strict=True))
    for name, (_, camera) in ranks.share(named):
        with torch.no_grad():
            rendering = draw(camera)
        path = Path(folder) / f"{name}.png"
        written = save_picture(path, to_image(rendering.rgb), overwrite=overwrite)
        if rendering.depth is not None:
            depths = Image.fromarray(rendering.depth.float().cpu().numpy())
            save_picture(path.with_suffix(".depth.tiff"), depths, overwrite=overwrite, rename=False)
        yield written


def render_file_names(names: Sequence[str], depth: bool = False) -> list[str]:
    """Return the names of the files that `render_files` writes for cameras of these names, relative to its folder."""
    kinds = (".png", ".depth.tiff") if depth else (".png",)
    return [f"{name}{kind}" for name in unique_stems(names) for kind in kinds]


def to_image(rgb: Tensor) -> Image.Image:
    """Convert colours (H, W, 3) to an image: clamp them to [0, 1] and round them to 8 bits."""
    return Image.fromarray((rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())


def unique_stems(names: Sequence[str]) -> list[str]:
    """Convert names of photos to distinct relative paths for renders, inside the folder and without an extension.

    "left/0001.JPG" becomes "left/0001". If two photos differ only in their extensions, all names keep theirs.
    """
    full = [_safe_relative_path(name) for name in names]
    bare = [
        str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).suffix.lower() in PICTURE_SUFFIXES else name
        for name in full
    ]
    chosen = bare if len(set(bare)) == len(bare) else full
    if len(set(chosen)) < len(chosen):
        chosen = [f"{number:04d}_{name}" for number, name in enumerate(chosen)]
    return chosen


def _safe_relative_path(name: str) -> str:
    """Return a name without characters and path parts that could lead out of a folder or that a system forbids."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in {"/", ".", ".."}]
    kept = "/".join(parts)
    return "".join(c if c.isprintable() and c not in ':*?"<>|' else "_" for c in kept) or "view"


def save_picture(
    path: str | os.PathLike[str], image: Image.Image, *, overwrite: bool = True, rename: bool = True
) -> Path:
    """Write an image, completely or not at all, in the format of its extension; return the path that was written.

    The folder is created if missing. `overwrite` and `rename` are those of `hyrfpack.atomic.pending_file`.

    Raises:
        HyrfError: the folder or the file cannot be written.
    """
    data = io.BytesIO()
    image.save(data, format=Image.registered_extensions()[Path(path).suffix.lower()])
    return write_atomic(path, data.getbuffer(), overwrite=overwrite, rename=rename)
