"""The kinds of files that an export writes, the selection of Gaussians, and early checks of the request."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import torch

from hyrfpack.choices import DEFAULT_SPZ_VERSION, LOCAL_EXPOSURE, SPZ_TILE_CONTENT
from hyrfpack.config.export import ConvertConfig, ExportConfig
from hyrfpack.errors import HyrfError, needs_package, suggest_command
from hyrfpack.export.background import compute_background_reach
from hyrfpack.export.cameras import COLMAP_FILES
from hyrfpack.export.source import Source
from hyrfpack.model.merged import world_positions
from hyrfpack.outputs import Outputs
from hyrfpack.splats.formats import spz
from hyrfpack.splats.placement import choose_local_origin
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS, FileKind

# The kinds of output other than the formats of splats.
HTML_PAGE = FileKind(ending=".html", stores_antialiased=True)
TRANSFORMS_JSON = FileKind(ending=".json", max_degree=0)
POINT_FILES = (
    FileKind(ending=".points.ply", max_degree=0),
    FileKind(ending=".points.glb", max_degree=0),
)
MESH_FILES = tuple(
    FileKind(ending=ending, max_degree=0, module="skimage") for ending in (".mesh.glb", ".mesh.ply", ".obj", ".stl")
)
COLLISION_FILES = tuple(
    FileKind(ending=f".collision.{extension}", max_degree=0, module="skimage") for extension in ("glb", "obj", "stl")
)
COLMAP_FOLDER = FileKind(ending="", max_degree=0, module="pycolmap")
POSITION_KINDS = (COLMAP_FOLDER, *POINT_FILES)  # these hold the centres of Gaussians, and cameras
_KINDS_WITHOUT_HARMONICS = (TRANSFORMS_JSON, *POSITION_KINDS, *MESH_FILES, *COLLISION_FILES)
_KINDS_WITHOUT_COLORS = (TRANSFORMS_JSON, *COLLISION_FILES)
PLAYER_FOLDER = FileKind(ending="")
STREAMED_SOG_FOLDER = FileKind(ending="lod-meta.json", stores_antialiased=True)  # the folder's index
TILES_FOLDER = FileKind(ending="tileset.json")  # the folder's index
SPZ_TILES_FOLDER = replace(TILES_FOLDER, max_scale=spz.MAX_SCALE)  # positions are relative to an origin in the scene
LEVEL_FOLDERS = (STREAMED_SOG_FOLDER, TILES_FOLDER, SPZ_TILES_FOLDER)  # levels of detail, of a scene folder
_FILE_KINDS = (*POINT_FILES, *COLLISION_FILES, *MESH_FILES, *FORMATS.values(), HTML_PAGE, TRANSFORMS_JSON)
_KINDS_BY_ENDING = {kind.ending: kind for kind in _FILE_KINDS}
EXPORT_ENDINGS = tuple(_KINDS_BY_ENDING)
# Kinds of folders by the settings of `ExportConfig` that name them.
_FOLDERS_BY_SETTING = {"colmap": COLMAP_FOLDER, "streamed_sog": STREAMED_SOG_FOLDER, "tiles_3d": TILES_FOLDER}


def find_file_kind(
    target: str | os.PathLike[str],
    config: ExportConfig = ExportConfig(),  # noqa: B008 - frozen
    *,
    endings: tuple[str, ...] = EXPORT_ENDINGS,
) -> FileKind:
    """Find the kind of file that the ending of `target` names; a folder or a name without ending means a player.

    Args:
        target: path of the output.
        config: settings of the export, which can name a kind of folder.
        endings: the endings that the caller accepts, to be named in the error message.

    Raises:
        HyrfError: the ending is none of EXPORT_ENDINGS, contradicts the kind of folder that `config` names, or is
            ".collision" and another format; or `config` names two kinds of folders.
    """
    name = Path(target).name.lower()
    requested_kinds = [(setting, kind) for setting, kind in _FOLDERS_BY_SETTING.items() if getattr(config, setting)]
    if len(requested_kinds) > 1:
        raise HyrfError(
            f"{target}: one export writes one kind of folder",
            fix="give only one of " + " and ".join(f"`{setting}=True`" for setting, _ in requested_kinds),
        )
    for setting, kind in requested_kinds:
        if name.endswith(EXPORT_ENDINGS) and not os.path.isdir(target):
            raise HyrfError(
                f"{target}: this format is a folder of files, not one file",
                fix=f"use a path without a file extension with `{setting}=True`",
            )
        is_spz = kind is TILES_FOLDER and config.tile_content == SPZ_TILE_CONTENT
        return SPZ_TILES_FOLDER if is_spz else kind
    if (kind_of_ending := find_kind_by_ending(target)) is not None:
        return kind_of_ending
    if os.path.isdir(target) or not Path(name).suffix:
        return PLAYER_FOLDER
    raise HyrfError(
        f"{target}: the file extension does not name a known format",
        fix=f"use one of {', '.join(endings)}, or give a folder for a player",
    )


def find_kind_by_ending(target: str | os.PathLike[str]) -> FileKind | None:
    """Find the kind of file that the ending of `target` names; None if it is none of EXPORT_ENDINGS.

    Raises:
        HyrfError: the ending is that of compressed PLY, or ".collision" and a format without collision meshes.
    """
    name = Path(target).name.lower()
    if name.endswith(".compressed.ply"):
        raise HyrfError(
            f"{target}: compressed PLY is read, not written",
            fix="use .sog or .spz, which are small, or .ply, which is not compressed",
        )
    kind = next((kind for ending, kind in _KINDS_BY_ENDING.items() if name.endswith(ending)), None)
    if kind is not None and kind not in COLLISION_FILES and Path(name).stem.endswith(".collision"):
        raise HyrfError(
            f"{target}: a collision mesh is not written in this format",
            fix=f"use {', '.join(row.ending for row in COLLISION_FILES)}",
        )
    return kind


def check_request(kind: FileKind, target: str | os.PathLike[str], config: ExportConfig) -> None:
    """Check before any work that a kind of file can be written with these settings.

    Raises:
        HyrfError: the settings contradict the kind, or a package is missing.
    """
    _check_content_settings(kind, target, config)
    _check_mesh_settings(kind, target, config)
    _check_page_settings(kind, target, config)
    check_package(kind, target)
    if config.faces is not None or kind in COLLISION_FILES:
        with needs_package(f"{target}: reducing the triangles of a mesh"):
            import_module("fast_simplification")
            import_module("trimesh")


def _check_content_settings(kind: FileKind, target: str | os.PathLike[str], config: ExportConfig) -> None:
    """Raise HyrfError for settings of Gaussians, colours, SPZ or 3D Tiles that a kind of file cannot follow."""
    if kind is TRANSFORMS_JSON and (config.crop is not None or config.min_opacity > 0 or not config.background):
        raise HyrfError(
            f"{target}: this file holds only cameras, so that nothing can be left out",
            fix="leave out `crop`, `min_opacity` and `background=False`",
        )
    if kind in LEVEL_FOLDERS and (config.crop is not None or config.min_opacity > 0):
        raise HyrfError(
            f"{target}: levels of detail stand for all Gaussians, so that none can be left out",
            fix="leave out `crop` and `min_opacity`; select Gaussians with 'hyrfpack edit' and split its result",
        )
    if kind in _KINDS_WITHOUT_HARMONICS and config.degree is not None:
        raise HyrfError(f"{target}: this format has no spherical harmonics", fix="leave out `degree`")
    if kind in _KINDS_WITHOUT_COLORS and config.exposure != LOCAL_EXPOSURE:
        raise HyrfError(f"{target}: this format has no colours", fix=f"leave out `exposure={config.exposure!r}`")
    check_spz_version(kind, target, config)
    if config.tile_content != SPZ_TILE_CONTENT and not config.tiles_3d:
        raise HyrfError(
            f"{target}: only 3D Tiles have a choice of contents",
            fix="leave out `tile_content`, or write a folder with `tiles_3d=True`",
        )


def _check_mesh_settings(kind: FileKind, target: str | os.PathLike[str], config: ExportConfig) -> None:
    """Raise HyrfError for settings of meshes with a kind of file that holds none."""
    is_mesh = kind in (*MESH_FILES, *COLLISION_FILES)
    if not is_mesh and (config.voxel is not None or config.faces is not None):
        names = " and ".join(f"`{name}`" for name in ("voxel", "faces") if getattr(config, name) is not None)
        raise HyrfError(
            f"{target}: this is not a mesh, which has voxels and triangles",
            fix=f"leave out {names}, or use one of {', '.join(row.ending for row in (*MESH_FILES, *COLLISION_FILES))}",
        )


def _check_page_settings(kind: FileKind, target: str | os.PathLike[str], config: ExportConfig) -> None:
    """Raise HyrfError for settings of pages with other kinds, and for those of baked splats with the model itself."""
    if config.baked and kind is PLAYER_FOLDER:
        raise HyrfError(
            f"{target}: the folder of a player holds the model file itself and no baked splats",
            fix="with `baked=True`, use a path that ends in .html",
        )
    if config.baked and kind is not HTML_PAGE:
        raise HyrfError(
            f"{target}: only a page can hold the model itself or baked splats; this format always holds the latter",
            fix="leave out `baked`",
        )
    texts = {"`title`": config.title, "`credit`": config.credit}
    given_texts = " and ".join(name for name, text in texts.items() if text)
    if given_texts and kind not in (HTML_PAGE, PLAYER_FOLDER):
        raise HyrfError(
            f"{target}: only pages show a title and a credit",
            fix=f"leave out {given_texts}, or write a page (.html) or a player's folder",
        )
    if config.editable and (kind not in (HTML_PAGE, PLAYER_FOLDER) or config.baked):
        raise HyrfError(
            f"{target}: only pages of the model itself can edit it",
            fix="leave out `editable`, or write a page (.html) without `baked`, or a player's folder",
        )
    is_changed = {
        "`degree`": config.degree is not None,
        "`crop`": config.crop is not None,
        "`min_opacity`": config.min_opacity > 0,
        "`background=False`": not config.background,
        f"`exposure={config.exposure!r}`": config.exposure != LOCAL_EXPOSURE,
    }
    if any(is_changed.values()) and (kind is PLAYER_FOLDER or (kind is HTML_PAGE and not config.baked)):
        names = " and ".join(name for name, changed in is_changed.items() if changed)
        raise HyrfError(
            f"{target}: the output holds the whole model, which these settings cannot change",
            fix=f"leave out {names}, or write baked splats into a page with `baked=True`",
        )


def check_spz_version(kind: FileKind, target: str | os.PathLike[str], config: ConvertConfig) -> None:
    """Check that a version of SPZ is asked for with SPZ files only. Raises HyrfError otherwise."""
    if config.spz_version != DEFAULT_SPZ_VERSION and kind.ending != ".spz":
        raise HyrfError(f"{target}: only .spz files have a version", fix="leave out `spz_version`, or write an .spz")


def check_package(kind: FileKind, target: str | os.PathLike[str]) -> None:
    """Check that the package that a kind of file needs is installed. Raises HyrfError otherwise."""
    if kind.module:
        with needs_package(f"{target}: writing this format"):
            import_module(kind.module)


def check_export_target(
    target: str | os.PathLike[str],
    outputs: Outputs,
    config: ExportConfig = ExportConfig(),  # noqa: B008 - frozen
) -> None:
    """Check that a target other than a player's folder may be written.

    Raises:
        HyrfError: a file must not be replaced or cannot be written.
    """
    kind = find_file_kind(target, config)
    if kind is COLMAP_FOLDER:
        outputs.folder(target, COLMAP_FILES)
    elif kind in LEVEL_FOLDERS:
        outputs.folder(target, [kind.ending])  # names of further files follow from the bake
    else:
        outputs.file(target)


def includes_background(loaded: Source, kind: FileKind, config: ExportConfig) -> bool:
    """Return whether an export includes the background sphere of the model."""
    return config.background and config.crop is None and loaded.model.config.background and kind not in POSITION_KINDS


@torch.no_grad()
def check_model(loaded: Source, kind: FileKind, config: ExportConfig) -> None:
    """Check before the bake that Gaussians remain and that their positions fit into the kind of file.

    Raises:
        HyrfError: the settings leave no Gaussian, or the scene is too far from the origin.
    """
    model, frame = loaded.all_parts, loaded.model.config.frame
    positions = world_positions(model)
    crop, min_opacity = config.crop, config.min_opacity
    if crop is not None or min_opacity > 0:  # certain before the bake, because it raises no opacity
        opacities = model.decode_geometry().opacities.numpy()
        positions = positions[make_selection_mask(positions, opacities, crop, min_opacity)]
    if kind is SPZ_TILES_FOLDER:
        reach = float(np.abs(positions - choose_local_origin(positions)).max())
        if reach > spz.MAX_COORDINATE:
            raise HyrfError(
                f"the Gaussians reach {reach:,.0f} units from the origin of the tiles, but SPZ is limited to "
                f"{spz.MAX_COORDINATE:,}",
                fix="use `tile_content='gltf'`, or remove the far Gaussians with 'hyrfpack edit' and split its result",
            )
    reach, limit = float(np.abs(positions).max()), f"but {kind.ending} is limited to {kind.max_coordinate:,}"
    if reach > kind.max_coordinate:
        low, high = positions.min(axis=0), positions.max(axis=0)
        remedy = "leave out the far Gaussians with `crop`"
        if (high - low).max() < 2 * kind.max_coordinate:
            shift = ",".join(str(-round(middle)) for middle in ((low + high) / 2).tolist())
            remedy = f"first move the scene to the origin with {suggest_command('edit')} and `translate={shift}`"
        raise HyrfError(
            f"the Gaussians reach {reach:,.0f} units from the origin, {limit}",
            fix=f"choose another format, or {remedy}",
        )
    if includes_background(loaded, kind, config) and (reach := compute_background_reach(frame)) > kind.max_coordinate:
        raise HyrfError(
            f"the scene reaches {reach:,.0f} units from the origin with its background, {limit}",
            fix="choose another format, or leave out the background with `background=False`",
        )


def select_splats(splats: Splats, crop: Sequence[float] | None = None, min_opacity: float = 0.0) -> Splats:
    """Return the splats with centres in the box `crop` and opacities of at least `min_opacity`; see `ConvertConfig`.

    Raises:
        HyrfError: no splat is left.
    """
    keep = make_selection_mask(splats.positions, splats.opacities, crop, min_opacity)
    return splats if keep.all() else splats[keep]


def make_selection_mask(
    positions: np.ndarray, opacities: np.ndarray, crop: Sequence[float] | None, min_opacity: float
) -> np.ndarray:
    """Return a mask (N,) of the Gaussians that `select_splats` keeps, given positions (N, 3) and opacities (N,).

    Raises:
        HyrfError: no Gaussian is left.
    """
    keep = opacities >= min_opacity
    if crop is not None:
        keep &= ((positions >= crop[:3]) & (positions <= crop[3:])).all(axis=1)
    if not len(positions):
        raise HyrfError("no Gaussian is left: no camera sees any", fix="name the photos with `data`, or train again")
    if not keep.any():
        low, high = (corner.round(4).tolist() for corner in (positions.min(0), positions.max(0)))
        raise HyrfError(
            f"no Gaussian is left: centres lie between {low} and {high}, opacities reach {opacities.max():.3f}",
            fix="lower `min_opacity`" if crop is None else "move or widen `crop`, or lower `min_opacity`",
        )
    return keep
