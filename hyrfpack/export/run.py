"""Exporting a model: bake, choose, write, read back, measure."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path

import numpy as np
import torch

from hyrfpack.atomic import check_writable, write_atomic
from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.export.background import background_picture, background_splats
from hyrfpack.export.bake import bake
from hyrfpack.export.cameras import encode_transforms, write_colmap
from hyrfpack.export.files import USD, WRITTEN, decode_splats, encode_splats
from hyrfpack.export.harmonics import MAX_DEGREE
from hyrfpack.export.html import decode_page, encode_page
from hyrfpack.export.measure import likeness
from hyrfpack.export.points import encode_points
from hyrfpack.export.source import Source
from hyrfpack.export.splats import Splats, concatenate
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Scene, evenly_spaced

PAGE, TRANSFORMS, COLMAP = ".html", ".json", ""
POINTS = (".points.ply", ".points.glb")
ENDINGS = (*POINTS, *WRITTEN, PAGE, TRANSFORMS)
# What is imported for an ending alone, and what pip calls it.
PACKAGES = {**dict.fromkeys(USD, ("pxr", "usd-core")), ".points.glb": ("trimesh",) * 2, COLMAP: ("pycolmap",) * 2}
PAGE_CAMERAS = 12  # that a page can be stepped through
COARSE = 3.0  # dB that a format may cost before something is said about it
INVISIBLE = 50.0  # dB from which on no difference can be seen, and none is told


@dataclass(frozen=True)
class ExportReport:
    """What an export came to. PSNR in dB, means over views.

    Attributes:
        file: what was written.
        bytes: on disk.
        gaussians: in the file, those of the background included; 0 where it is one of cameras.
        background: how many of these make the background.
        degree: of the spherical harmonics in the file.
        views: how many views the loss was measured at; 0 where it was not.
        by_degree: PSNR of the baked model's pictures against the model's own, by degree, before anything is rounded
            to what the file holds.
        psnr: PSNR of the file's pictures, as read back from its bytes, against the model's own.
        photos_model, photos_file: PSNR of the model's and of the file's pictures against held-out photos, if given.
        cameras: in the file, where it is one of points or cameras.
    """

    file: str
    bytes: int
    gaussians: int = 0
    background: int = 0
    degree: int = 0
    views: int = 0
    by_degree: dict[int, float] = field(default_factory=dict)
    psnr: float | None = None
    photos_model: float | None = None
    photos_file: float | None = None
    cameras: int = 0


def export(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    degree: int = MAX_DEGREE,
    data: Scene | None = None,
    crop: Sequence[float] | None = None,
    min_opacity: float = 0.0,
    background: bool = True,
    say: Callable[[str], None] = lambda sentence: None,
) -> ExportReport:
    """Write a `.hyrf` model as what other programs read, in its own axes and units, and measure what was lost.

    The ending of `target` names the format:

    - .ply, .splat, .spz, .glb, .usda, .usdc, .usdz, .sog: 3D Gaussians with spherical harmonics;
    - .html: a page that shows the scene in any browser, by itself;
    - .points.ply, .points.glb: the Gaussians' centres as coloured points, and the cameras as frusta;
    - .json: the cameras as a transforms.json; no ending: a folder with cameras and points as a COLMAP model.

    Nothing is measured where a part of the scene was cropped, or only points or cameras were written.

    Args:
        source: the model.
        target: the file, or for COLMAP the folder, to write.
        degree: of the spherical harmonics, 0 to 3; ".splat" has 0.
        data: photos of the scene: colours are fitted where they were taken from, the held-out ones are scored. Without
            them the cameras that the file keeps serve, or else rings of them around the scene.
        crop: (min x, min y, min z, max x, max y, max z) in world units; Gaussians whose centres lie outside, and the
            background, are left out. Infinite numbers leave a side open.
        min_opacity: fainter Gaussians are left out.
        background: whether the model's background goes along.
        say: told what is going on.

    Raises:
        HyrfError: a file cannot be read or written, or the options do not go together.
    """
    kind = kind_of(target)
    _check(kind, target, degree, crop, min_opacity)
    read = Source.read(source, data)
    if kind in (TRANSFORMS, COLMAP) and not read.cameras:
        raise HyrfError(f"{source}: it keeps no cameras; export them from the file that training wrote, or name --data")
    if kind == TRANSFORMS:
        frames = encode_transforms(read.cameras)
        write_atomic(target, frames)
        return ExportReport(str(target), len(frames), cameras=len(read.cameras))
    _check_choice(read.model, crop, min_opacity)
    degree = 0 if kind in (".splat", COLMAP, *POINTS) else degree
    where = (
        "cameras" if read.cameras else "places around the scene, for the file keeps no cameras (--data names photos)"
    )
    say(f"fitting colours of degree {degree} at {len(read.fitted)} {where}")
    if kind in (COLMAP, *POINTS):
        return _export_points(read, kind, target, chosen(bake(read.model, read.fitted, (0,))[0], crop, min_opacity))
    measured = read.measured if crop is None else []
    degrees = range(degree + 1) if measured else (degree,)
    baked = {d: chosen(splats, crop, min_opacity) for d, splats in bake(read.model, read.fitted, degrees).items()}
    sphere = background and crop is None and read.model.config.background
    picture = background_picture(read.model) if sphere and kind == PAGE else None
    behind = background_splats(read.model, read.fitted) if sphere and kind != PAGE else None
    whole = {d: splats if behind is None else concatenate((splats, behind)) for d, splats in baked.items()}
    say(f"writing {len(whole[degree]):,} Gaussians")
    if kind == PAGE:
        written = page(read, whole[degree], picture, Path(target).stem)
        back = decode_page(written, str(target))
    else:
        first = read.cameras[0][1] if read.cameras else None
        written = encode_splats(whole[degree], kind, up=read.up, camera=first)
        back = decode_splats(written, kind, str(target)), None
    write_atomic(target, written)
    count = 0 if behind is None else len(behind)
    report = ExportReport(str(target), len(written), len(whole[degree]), count, degree)
    if not measured:
        why = "no photo is held out" if crop is None else "a part of the scene was cropped"
        say(f"nothing is measured, for {why}")
        return report
    say(f"measuring at {len(measured)} views")
    contenders = {**{str(d): (splats, picture) for d, splats in whole.items()}, "file": back}
    scores = likeness(read.model, contenders, measured, sphere=sphere)
    if not scores:
        say("nothing is measured, for the masks leave no pixel of the held-out photos")
        return report
    file, before = scores["file"], scores[str(degree)].model
    if min(before, INVISIBLE) - file.model > COARSE:
        if read.model.config.antialiased and not back[0].antialiased:
            say(f"{kind} cannot tell that the model is antialiased: say so where it is drawn, or choose .spz or .sog")
        else:
            say(f"{kind} is too coarse for this scene, perhaps for its unit of length: choose another format")
    return replace(
        report,
        views=file.views,
        by_degree={d: scores[str(d)].model for d in whole},
        psnr=file.model,
        photos_model=scores["model"].photos,
        photos_file=file.photos,
    )


def page_of(source: str | os.PathLike[str], degree: int = MAX_DEGREE) -> bytes:
    """The page that shows a `.hyrf` model in a browser, as `export` writes it to .html.

    Raises:
        HyrfError: the file cannot be read.
    """
    read = Source.read(source)
    picture = background_picture(read.model) if read.model.config.background else None
    return page(read, bake(read.model, read.fitted, (degree,))[degree], picture, Path(source).stem)


def page(read: Source, splats: Splats, picture: np.ndarray | None, title: str) -> bytes:
    """The page that shows splats of a model.

    Args:
        read: the model.
        splats: what it was baked to.
        picture: (H, 2H, 3) its background, see `background_picture`; None for its solid colour.
        title: of the page.
    """
    cameras = [camera for _, camera in read.cameras] or [camera for camera, _ in read.measured]
    return encode_page(
        splats,
        title=title,
        cameras=evenly_spaced(cameras, PAGE_CAMERAS),
        up=read.up,
        center=read.center,
        background=picture,
        solid=read.model.config.solid,
        near=RenderSettings().near * read.model.config.frame.scale,
    )


def kind_of(target: str | os.PathLike[str]) -> str:
    """The ending that decides the format, one of ENDINGS; COLMAP for a folder or a name without ending.

    Raises:
        HyrfError: it is none of them.
    """
    name = Path(target).name.lower()
    if name.endswith(".compressed.ply"):
        raise HyrfError(
            f"{target}: compressed PLY is read, not written; .sog and .spz are small, .ply is not compressed"
        )
    for kind in ENDINGS:
        if name.endswith(kind):
            return kind
    if Path(target).is_dir() or not Path(name).suffix:
        return COLMAP
    raise HyrfError(
        f"{target}: the ending names the format; end it in one of {', '.join(ENDINGS)}, or name a folder for COLMAP"
    )


def chosen(splats: Splats, crop: Sequence[float] | None = None, min_opacity: float = 0.0) -> Splats:
    """Those with centres in the box `crop` and not fainter than `min_opacity`; see `export`.

    Raises:
        HyrfError: none is left.
    """
    keep = _kept(splats.positions, splats.opacities, crop, min_opacity)
    return splats if keep.all() else splats[keep]


def _kept(positions: np.ndarray, opacities: np.ndarray, crop: Sequence[float] | None, min_opacity: float) -> np.ndarray:
    """(N,) bool: which Gaussians with positions (N, 3) and opacities (N,) `chosen` keeps. HyrfError when none."""
    keep = opacities >= min_opacity
    if crop is not None:
        keep &= ((positions >= crop[:3]) & (positions <= crop[3:])).all(axis=1)
    if not len(positions):
        raise HyrfError("no Gaussian is left: no camera sees any; name the photos with --data, or train again")
    if not keep.any():
        low, high = (corner.round(4).tolist() for corner in (positions.min(0), positions.max(0)))
        raise HyrfError(
            f"no Gaussian is left: centres lie between {low} and {high}, opacities reach {opacities.max():.3f}; "
            "widen --crop or lower --min-opacity"
        )
    return keep


def _check(
    kind: str, target: str | os.PathLike[str], degree: int, crop: Sequence[float] | None, min_opacity: float
) -> None:
    """Refuse, before minutes of work, what would fail after them: see `export`."""
    if degree not in range(MAX_DEGREE + 1):
        raise HyrfError(f"spherical harmonics of degree {degree} are not known; name 0 to {MAX_DEGREE}")
    if crop is not None and (np.shape(crop) != (6,) or np.isnan(crop).any()):
        raise HyrfError(f"the crop {crop} is no box; name the least x, y, z, then the greatest, in world units")
    if not 0 <= min_opacity <= 1:
        raise HyrfError(f"an opacity of {min_opacity} cannot be asked for; name 0 to 1")
    if kind == TRANSFORMS and (crop is not None or min_opacity > 0):
        raise HyrfError(
            f"{target}: this holds cameras only, and --crop and --min-opacity choose Gaussians; leave them out"
        )
    if kind in PACKAGES:
        module, package = PACKAGES[kind]
        with needs_package(package, f"{target}: writing this format"):
            import_module(module)
    if kind != COLMAP and Path(target).is_dir():
        raise HyrfError(f"{target}: this is a folder; name a file in it")
    place = Path(os.path.realpath(target))
    place = place.parent if kind != COLMAP else next(path for path in (place, *place.parents) if path.exists())
    if not place.exists():
        raise HyrfError(f"{target}: there is no folder '{Path(target).parent}'; make it first")
    check_writable(place)


@torch.no_grad()
def _check_choice(model: HybridModel, crop: Sequence[float] | None, min_opacity: float) -> None:
    """Refuse a choice that leaves nothing, before the bake, which makes no Gaussian less faint."""
    if crop is not None or min_opacity > 0:
        positions = model.config.frame.to_world(model.gaussians.positions.numpy())
        _kept(positions, model.decode_geometry().opacities.numpy(), crop, min_opacity)


def _export_points(read: Source, kind: str, target: str | os.PathLike[str], splats: Splats) -> ExportReport:
    """Centres of splats, and cameras."""
    if kind == COLMAP:
        write_colmap(read.cameras, target, splats)
        size = sum(table.stat().st_size for table in Path(target, "sparse", "0").glob("*.bin"))
        return ExportReport(str(target), size, cameras=len(read.cameras))
    data = encode_points(splats, [camera for _, camera in read.cameras], Path(kind).suffix[1:], read.up)
    write_atomic(target, data)
    return ExportReport(str(target), len(data), len(splats), cameras=len(read.cameras))
