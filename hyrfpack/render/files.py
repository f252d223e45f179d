"""Rendering of views to image files."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath

import torch
from PIL import Image
from torch import Tensor

from hyrfpack.atomic import write_atomic
from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import HyrfError
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.outputs import PICTURE_SUFFIXES
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.render.geometry_files import GeometryWriter
from hyrfpack.render.renderer import RenderedPicture, RenderSettings, make_raster_settings, render_view
from hyrfpack.render.surface import drawn_gaussians, render_surface
from hyrfpack.scene import Camera


def render_files(
    model: HybridModel | MergedModel,
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    *,
    geometry: GeometryConfig = GeometryConfig(),  # noqa: B008 - frozen
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
        geometry: which files of depth and of normals to write beside the images: `<name>.depth.<extension>` and
            `<name>.normals.<extension>`, see `hyrfpack.render.geometry_files`.
        settings: render settings.
        overwrite: replace existing files. Without it, an image whose file exists is written under a free file name in
            the same folder, with its geometry beside it. An existing file of geometry is then an error.
        ranks: processes that share the cameras; each yields the paths that it has written.

    Raises:
        HyrfError: a file cannot be written, two of them would have the same name, a package is missing, or another call
            is writing into the folder.
    """
    render_file_names([name for name, _ in cameras], geometry)
    writer = GeometryWriter(geometry) if geometry.is_wanted else None
    with exclusive_folder(folder, ranks=ranks):
        draw = make_renderer(model, geometry=geometry, settings=settings)
        yield from write_pictures(draw, cameras, folder, geometry=writer, overwrite=overwrite, ranks=ranks)
    if writer is not None:
        writer.warn_of_losses()


def make_renderer(
    model: HybridModel | MergedModel,
    *,
    geometry: GeometryConfig = GeometryConfig(),  # noqa: B008 - frozen
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> Callable[[Camera], RenderedPicture]:
    """Decode a model once, and return a function that renders it with the geometry that is wanted."""
    with torch.no_grad():
        decoded = model.decode()
    raster_settings = make_raster_settings(model, settings)

    def draw(camera: Camera) -> RenderedPicture:
        rendering = render_view(model, camera, settings, decoded=decoded)
        if not geometry.is_wanted:
            return RenderedPicture(rendering.rgb)
        gaussians, frame = drawn_gaussians(model, camera, decoded, rendering.indices[rendering.visible])
        surface = render_surface(gaussians, frame, camera, raster_settings, normals=geometry.normals is not None)
        return RenderedPicture(rendering.rgb, *surface)

    return draw


def write_pictures(
    draw: Callable[[Camera], RenderedPicture],
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    *,
    geometry: GeometryWriter | None = None,
    overwrite: bool = True,
    ranks: Ranks = SINGLE_PROCESS,
) -> Iterator[Path]:
    """Write the renders of named cameras by `draw` into a folder that the caller has locked; see `render_files`.

    `draw` has to return the geometry that the writer of geometry writes.
    """
    named = list(zip(unique_stems([name for name, _ in cameras]), cameras, strict=True))
    for name, (_, camera) in ranks.share(named):
        with torch.no_grad():
            rendering = draw(camera)
        path = Path(folder) / f"{name}.png"
        written = save_picture(path, to_image(rendering.rgb), overwrite=overwrite)
        if geometry is not None:
            geometry.write(written, rendering, overwrite=overwrite)
        yield written


def render_file_names(
    names: Sequence[str],
    geometry: GeometryConfig = GeometryConfig(),  # noqa: B008 - frozen
) -> list[str]:
    """Return the names of the files that `render_files` writes for cameras of these names, relative to its folder.

    Raises:
        HyrfError: two files would have the same name, as the depth of "a" and the picture of "a.depth", or differ in
            case only; or a file would have the name of a folder.
    """
    files = [f"{name}{ending}" for name in unique_stems(names) for ending in (".png", *geometry.endings)]
    counts = Counter(name.casefold() for name in files)
    folders = {str(folder) for name in counts for folder in PurePosixPath(name).parents}
    for name in files:
        if counts[name.casefold()] > 1:
            raise HyrfError(f"{name}: two of the files to be written would have this name", fix="rename a camera")
        if name.casefold() in folders:
            raise HyrfError(f"{name}: a file and a folder to be written would have this name", fix="rename a camera")
    return files


def to_image(rgb: Tensor) -> Image.Image:
    """Convert colours (H, W, 3) to an image: clamp them to [0, 1] and round them to 8 bits."""
    return Image.fromarray((rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())


def unique_stems(names: Sequence[str]) -> list[str]:
    """Convert names of photos to distinct relative paths for renders, inside the folder and without an extension.

    "left/0001.JPG" becomes "left/0001". If two photos differ only in their extensions, all names keep theirs. If two
    names are still equal, all get a number in front.
    """
    paths = [_safe_relative_path(name) for name in names]
    without_extensions = [
        str(PurePosixPath(path).with_suffix("")) if PurePosixPath(path).suffix.lower() in PICTURE_SUFFIXES else path
        for path in paths
    ]
    if _are_distinct(without_extensions):
        return without_extensions
    if _are_distinct(paths):
        return paths
    return [f"{number:04d}_{path}" for number, path in enumerate(paths)]


def _are_distinct(names: Sequence[str]) -> bool:
    """Return whether all names differ, also on file systems that ignore case."""
    return len({name.casefold() for name in names}) == len(names)


def _safe_relative_path(name: str) -> str:
    """Return a name without characters and path parts that could lead out of a folder or that a system forbids."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in {"/", ".", ".."}]
    path = "/".join(parts)
    return "".join(c if c.isprintable() and c not in ':*?"<>|' else "_" for c in path) or "view"


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
