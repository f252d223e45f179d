"""The export of a model: load, bake, select Gaussians, write the file, read it back and measure the loss."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import place_photos
from hyrfpack.checks import check_type
from hyrfpack.config.export import ExportConfig
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.export.baked_scene import BakedScene, SplatsWithBackground, bake_scene
from hyrfpack.export.cameras import encode_transforms, fit_to_file, locate_photo, write_colmap
from hyrfpack.export.folder import export_player
from hyrfpack.export.kinds import (
    COLLISION_FILES,
    COLMAP_FOLDER,
    HTML_PAGE,
    LEVEL_FOLDERS,
    MESH_FILES,
    PLAYER_FOLDER,
    POSITION_KINDS,
    STREAMED_SOG_FOLDER,
    TRANSFORMS_JSON,
    check_export_target,
    check_model,
    check_request,
    find_file_kind,
)
from hyrfpack.export.levels import bake_levels, open_levels
from hyrfpack.export.pages import encode_baked_page, suggest_compression, write_native_page
from hyrfpack.export.points import encode_points
from hyrfpack.export.report import ExportReport
from hyrfpack.export.scores import measure_export
from hyrfpack.export.source import Source
from hyrfpack.export.streamed_sog import write_streamed_sog
from hyrfpack.export.tiles import write_tiles
from hyrfpack.format import describe_file, find_model
from hyrfpack.format.input_folder import find_input_folder
from hyrfpack.format.scene_folder import SceneFolder, as_single_file
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.parallel import has_numba
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.scene import Scene
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.table import FileKind, SplatFormat
from hyrfpack.web.html import decode_splats_page

_LOG = logging.getLogger(__name__)


def export_model(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: ExportConfig | None = None,
    *,
    data: Scene | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> ExportReport:
    """Write a `.hyrf` model in a format of other programs, in its own axes and units, and measure the loss.

    The ending of `target` names the format:

    - .ply, .splat, .spz, .glb, .usda, .usdc, .usdz, .sog: 3D Gaussians with spherical harmonics;
    - .html: a self-contained page that shows the scene in any browser, with the `.hyrf` file inside;
    - no ending: a folder with a player and the file, for a web server (see `hyrfpack.export_player`);
    - .points.ply, .points.glb: the Gaussians' centres as coloured points, and the cameras as frusta;
    - .mesh.glb, .mesh.ply, .obj, .stl: the surface as a triangle mesh with vertex colours (needs scikit-image);
    - .collision.glb, .collision.obj, .collision.stl: a closed mesh of few triangles, without colours, for physics
      engines (needs scikit-image and fast-simplification);
    - .json: the cameras as a transforms.json.

    With `streamed_sog` in `config`, the levels of detail of a scene folder become a folder of PlayCanvas' Streamed SOG,
    and with `tiles_3d` one of 3D Tiles.

    The loss is not measured for a cropped scene, nor for an output of only points, only cameras, a mesh or the model
    itself.

    Args:
        source: the model: a `.hyrf` file, the folder of a run, or a scene folder, whose finest level is exported.
        target: the file or the folder to write.
        config: what to export, and how; None for the defaults.
        data: photos of the scene. Colours are fitted at the training cameras, and the held-out photos score the result.
            Without photos, the cameras that the file keeps are used, or else rings of cameras around the scene.
        overwrite: replace existing files. If False, an existing file is an error. A file that appears during the export
            is kept: a single file gets a free name in its folder, which the report contains; in a folder it is an
            error.
        context: how progress is shown and the call is stopped.

    Raises:
        HyrfError: a file cannot be read or written, the options contradict each other, the photos do not belong to the
            model, or another call is writing into the folder.
        TypeError: `data` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> config = hyrfpack.ExportConfig(degree=1, background=False)
        >>> report = hyrfpack.export_model("bonsai.hyrf", "bonsai.spz", config)
        >>> report.degree, report.bytes > 0, report.psnr > 10
        (1, True, True)
    """
    config = ExportConfig() if config is None else config
    check_type("config", config, ExportConfig)
    if data is not None:
        check_type("data", data, Scene)
    kind = find_file_kind(target, config)
    check_request(kind, target, config)
    if kind is PLAYER_FOLDER:
        return export_player(
            source,
            target,
            data=data,
            overwrite=overwrite,
            title=config.title,
            credit=config.credit,
            editable=config.editable,
        )
    if kind is HTML_PAGE and not config.baked:
        suggest_compression(source)
    scene = open_levels(source) if kind in LEVEL_FOLDERS else None
    model = find_model(source)
    with as_single_file(model) as file:
        return _export_file(model, file, scene, target, kind, config, data, overwrite, context)


def _export_file(
    model: Path,
    source: Path,
    scene: SceneFolder | None,
    target: str | os.PathLike[str],
    kind: FileKind,
    config: ExportConfig,
    data: Scene | None,
    overwrite: bool,
    context: RunContext,
) -> ExportReport:
    """Export a `.hyrf` file, or the levels of `scene`, if it is given.

    Args:
        model: path of the model, whose files are not replaced.
        source: the single file of the model; that of a scene folder is temporary.
        scene: the scene folder whose levels are exported, or None.
        target, kind, config, data, overwrite, context: arguments of `export_model`, and the kind of the target.
    """
    folder = find_input_folder(model)
    is_folder = kind is COLMAP_FOLDER or kind in LEVEL_FOLDERS
    if is_folder:
        check_export_target(target, Outputs(model, folders=[folder], scene=data, overwrite=True), config)
    with exclusive_folder(target) if is_folder else nullcontext():
        check_export_target(target, Outputs(model, folders=[folder], scene=data, overwrite=overwrite), config)
        data = place_photos(describe_file(source), data)
        loaded = Source.read(source, data)
        if kind is HTML_PAGE and not config.baked:
            return write_native_page(loaded, source, target, config, overwrite)
        if kind in (TRANSFORMS_JSON, COLMAP_FOLDER):
            _check_cameras(loaded, model, data)
        if kind is TRANSFORMS_JSON:
            return _write_cameras(loaded, target, data, overwrite)
        if kind is COLMAP_FOLDER and data is not None and data.train:
            loaded = replace(loaded, cameras=[(view.name, fit_to_file(view)) for view in data.train])
        with context.open_progress("export") as progress:
            if kind in (*MESH_FILES, *COLLISION_FILES):
                return _choose_mesh_writer(kind, target)(loaded, target, kind, config, overwrite, progress)
            if scene is not None:
                return _export_levels(loaded, scene, Path(target), kind, config, overwrite, progress)
            return _export_gaussians(loaded, Path(target), kind, config, overwrite, progress)


def _choose_mesh_writer(kind: FileKind, target: StrPath) -> Callable[..., ExportReport]:
    """Return `write_mesh` or `write_collision_mesh`. Only meshes need Numba, so other exports do not import it."""
    if not has_numba():
        raise HyrfError(
            f"{target}: meshes are extracted by Numba, which is missing or does not work here",
            fix="install it ('hyrfpack doctor' shows what is wrong), or export Gaussians",
        )
    from hyrfpack.export.meshes import write_collision_mesh, write_mesh

    return write_mesh if kind in MESH_FILES else write_collision_mesh


def _export_gaussians(
    loaded: Source, target: Path, kind: FileKind, config: ExportConfig, overwrite: bool, progress: Progress
) -> ExportReport:
    """Export Gaussians: bake, write and measure."""
    check_model(loaded, kind, config)
    baked = bake_scene(loaded, kind, config, part_of_progress(progress, 0.0, 0.5))
    if kind in POSITION_KINDS:
        return _write_points(baked, target, kind, overwrite)
    count = len(baked.splats) - baked.background_count
    _LOG.info(f"writing {format_count(count, 'Gaussian')}{' and the background' if baked.sphere else ''}")
    progress(TaskEvent(f"writing {format_count(count, 'Gaussian')}", 0.5))
    result, decoded = _write_splats(baked, target, kind, config, overwrite)
    if config.crop is not None:
        _LOG.info("quality is not measured, because a part of the scene was cropped")
        return result
    return measure_export(result, loaded, baked, decoded, kind, part_of_progress(progress, 0.65, 1.0))


def _export_levels(
    loaded: Source,
    scene: SceneFolder,
    target: Path,
    kind: FileKind,
    config: ExportConfig,
    overwrite: bool,
    progress: Progress,
) -> ExportReport:
    """Export all levels of a scene folder, and measure the finest one."""
    check_model(loaded, kind, config)
    baked = bake_levels(loaded, scene, kind, config, part_of_progress(progress, 0.0, 0.6))
    _LOG.info(f"writing {format_count(len(baked.chunks), 'chunk')}")
    write = write_streamed_sog if kind is STREAMED_SOG_FOLDER else partial(write_tiles, kind)
    size, decoded = write(baked, target, overwrite, part_of_progress(progress, 0.6, 0.8))
    report = replace(
        _describe_splats(baked.finest, target, size), chunks=len(baked.chunks), level_gaussians=baked.level_gaussians
    )
    return measure_export(report, loaded, baked.finest, decoded, kind, part_of_progress(progress, 0.8, 1.0))


def _check_cameras(loaded: Source, source: str | os.PathLike[str], data: Scene | None) -> None:
    """Raise HyrfError if no cameras are precise enough, or if they would not fit the photos on disk.

    It warns if nobody knows which photo a camera belongs to, and says how many photos are left out as held out.
    """
    if not loaded.cameras or loaded.has_coarse_cameras:
        stored_cameras = "only coarse cameras" if loaded.has_coarse_cameras else "no cameras"
        raise HyrfError(
            f"{source}: it keeps {stored_cameras}",
            fix="export the cameras from the file that training wrote, or give the photos with `data`",
        )
    if data is None or not data.train:
        name, camera = loaded.cameras[0]
        _LOG.warning(
            f"{source} does not keep the names of its photos, so the cameras are named {name} and so on, and are those "
            f"of undistorted photos of the size that training used (such as {camera.width} x {camera.height}); give "
            "the photos with `data`"
        )
        return
    resampled = [view.name for view in data.train if view.is_resampled]
    if resampled:
        raise HyrfError(
            f"{data.path}: {len(resampled):,} of {len(data.train):,} photos (such as {resampled[0]}) are undistorted "
            "or turned upright as they are loaded, or cut from panoramas, so the model's cameras do not fit the files",
            fix="undistort the photos (COLMAP's image_undistorter) or save them upright (exiftran -a), and give that "
            "folder with `data`",
        )
    if data.test:
        _LOG.info(
            f"the cameras of {format_count(len(data.test), 'held-out photo')} are not written, only those of "
            f"{format_count(len(data.train), 'training photo')}; `test_every=0` holds out none, unless the set itself "
            "does"
        )


def _write_cameras(loaded: Source, target: str | os.PathLike[str], data: Scene | None, overwrite: bool) -> ExportReport:
    """Write the cameras as a transforms.json, for the photo files if they are known."""
    folder, views = Path(target).parent, [] if data is None else data.train
    named_cameras = [(locate_photo(view, folder), fit_to_file(view)) for view in views]
    encoded = encode_transforms(named_cameras or [(f"images/{name}", camera) for name, camera in loaded.cameras])
    written_path = write_atomic(target, encoded, overwrite=overwrite)
    return ExportReport(str(written_path), len(encoded), cameras=len(loaded.cameras))


def _write_points(baked: BakedScene, target: Path, kind: FileKind, overwrite: bool) -> ExportReport:
    """Write the centres of splats as points, and the cameras."""
    named_cameras, up = baked.source.cameras, baked.source.up
    if kind is COLMAP_FOLDER:
        size = write_colmap(named_cameras, target, baked.splats, overwrite=overwrite)
        return ExportReport(str(target), size, cameras=len(named_cameras))
    cameras = [camera for _, camera in named_cameras]
    data = encode_points(baked.splats, cameras, "glb" if kind.ending.endswith("glb") else "ply", up)
    written_path = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written_path), len(data), len(baked.splats), cameras=len(named_cameras))


def _write_splats(
    baked: BakedScene, target: Path, kind: FileKind, config: ExportConfig, overwrite: bool
) -> tuple[ExportReport, SplatsWithBackground]:
    """Write splats to a file or a page; return the report without scores, and the splats as read back."""
    loaded = baked.source
    decoded: SplatsWithBackground
    if isinstance(kind, SplatFormat):
        camera = loaded.cameras[0][1] if loaded.cameras else None
        data = kind.encode(baked.splats, Hints(loaded.up, camera, config.spz_version))
        decoded = kind.decode(data, str(target)), None
    else:
        title = target.stem if config.title is None else config.title
        data = encode_baked_page(loaded, baked.splats, baked.picture, title, config.credit)
        decoded = decode_splats_page(data, str(target))
    written_path = write_atomic(target, data, overwrite=overwrite)
    return _describe_splats(baked, written_path, len(data)), decoded


def _describe_splats(baked: BakedScene, written_path: Path, size: int) -> ExportReport:
    """Return the report on a file or folder of splats without scores."""
    return ExportReport(
        str(written_path),
        size,
        len(baked.splats),
        background=baked.background_count,
        degree=baked.degree,
        chosen_by=baked.chosen_by,
        exposure=baked.exposure,
    )
