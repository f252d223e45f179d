"""OpenUSD (.usda, .usdc, .usdz) with UsdVol's ParticleField3DGaussianSplat, through usd-core.

    /World              Xform, the default prim: turns the input's axes so that up is up
    /World/Gaussians    ParticleField3DGaussianSplat, moved to where the scene lies
    /World/Camera       looks as one of the photos did, if a camera is given

All arrays are float. Half twins exist and would nearly halve the file at a loss of a tenth of an 8-bit level, but
checkers ask for the float ones, and half has no room for the scales of scenes in very small or large units.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.scene import Camera
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.harmonics import MAX_DEGREE, terms_of
from hyrfpack.splats.placement import local_origin, local_positions, matrices_of, placed, rotation_of, upright_rotation
from hyrfpack.splats.splats import Splats

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

Extension = Literal["usda", "usdc", "usdz"]
EXTENSIONS: tuple[Extension, ...] = get_args(Extension)
PACKAGE = "pxr", "usd-core"
_SPLATS = "ParticleField3DGaussianSplat"
_APERTURE = 36.0  # width of the film; USD counts focal lengths and film in tenths of a scene unit, only ratios matter
_NEAR, _FAR = 0.01, 1.1  # clipping: times the median depth, and times the largest reach
_ALIGNMENT = 64  # of files within .usdz
_MAX_BYTES = (1 << 32) - 1  # of a .usdz: its zip has no 64-bit form


def encode(
    splats: Splats, hints: Hints = NO_HINTS, *, extension: Extension = "usdc", meters_per_unit: float = 1.0
) -> bytes:
    """Splats as a USD file.

    The numbers stay in the input's axes and units; transforms turn them upright and, where the scene lies far from the
    origin compared to its size, move them there. Same splats, same version of usd-core, same bytes.

    Args:
        splats: any number; scales of 0 become the smallest above it, as the schema's checkers want.
        hints: which way is up in the scene, and a camera to look from first. USD's z is up where that is nearer to the
            world's z than to its y, otherwise USD's y.
        extension: "usda" is text, "usdc" binary, "usdz" an uncompressed package of the latter.
        meters_per_unit: how long a world unit is.

    Raises:
        HyrfError: usd-core is missing.
        HyrfDataError: the splats do not fit into float32, or into 4 GiB of a package.
    """
    with needs_package("usd-core", f"writing .{extension} files"):
        from pxr import Kind, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    z_up = bool(hints.up[2] > abs(hints.up[1]))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if z_up else UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    stage.GetRootLayer().documentation = "3D Gaussians, written by hyrfpack"
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind(Kind.Tokens.component)
    turn = upright_rotation(hints.up, np.array([0.0, 0.0, 1.0] if z_up else [0.0, 1.0, 0.0]))
    _transform(world, turn, np.zeros(3))
    _add_splats(stage, splats)
    if hints.camera is not None:
        _add_camera(stage, hints.camera, splats)
    if extension == "usda":
        return stage.GetRootLayer().ExportToString().encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.usdc")
        stage.GetRootLayer().Export(str(path))
        binary = path.read_bytes()
    return binary if extension == "usdc" else _package(binary, path.name)


def decode(data: bytes, name: str, extension: Extension, *, upright: bool = False) -> Splats:
    """The splats in a USD file such as `encode` writes: float arrays, one field of splats, nothing in other files.

    It measures what a file holds. usd-core parses the bytes, so this is no safer with hostile ones than usd-core is.

    Args:
        data: the file.
        name: what error messages call it.
        extension: as in `encode`.
        upright: give them in the file's axes. Otherwise they are turned back about the origin, which for a file of ours
            gives the axes and numbers `encode` was given.

    Raises:
        HyrfError: usd-core is missing.
        HyrfDataError: the bytes are no such file.
    """
    with needs_package("usd-core", f"{name}: reading it"):
        from pxr import Sdf, Tf, Usd

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"scene.{extension}")
        path.write_bytes(data)
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(path))
            if layer is None or layer.GetCompositionAssetDependencies():
                raise HyrfDataError(f"{name}: this is not a USD file, or it needs others; flatten it into one")
            stage = Usd.Stage.Open(layer)
            fields = [prim for prim in stage.Traverse() if prim.GetTypeName() == _SPLATS]
            if len(fields) != 1:
                raise HyrfDataError(f"{name}: it holds {len(fields)} {_SPLATS}, and one is read; name another file")
            return _read_splats(fields[0], name, upright)
        except Tf.ErrorException as error:
            reason = str(error).strip().splitlines()[-1:] or ["no reason given"]
            raise HyrfDataError(f"{name}: usd-core cannot read it ({reason[0]:.160}); export it again") from error


def _transform(prim: UsdGeom.Xformable, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Give a prim a rotation (3, 3) and a translation (3,), unless they do nothing."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    if not np.array_equal(matrix, np.eye(4)):
        prim.AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))  # USD multiplies row vectors


def _add_splats(stage: Usd.Stage, splats: Splats) -> None:
    from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

    origin = local_origin(splats.positions)
    positions = local_positions(splats, origin)
    scales = np.maximum(splats.scales, np.finfo(np.float32).tiny)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Gaussians")
    _transform(field, np.eye(3), origin)
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(positions))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(splats.quats[:, [1, 2, 3, 0]])))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_extent(positions, scales, splats.quats)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
    harmonics = field.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        Vt.Vec3fArray.FromNumpy(splats.harmonics.reshape(-1, 3))
    )
    primvar = UsdGeom.Primvar(harmonics)
    primvar.SetInterpolation(UsdGeom.Tokens.vertex)
    primvar.SetElementSize(terms_of(splats.degree))
    # USD takes colours for linear unless told otherwise.
    colors = Usd.ColorSpaceAPI.Apply(field.GetPrim())
    colors.CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    # The fallbacks of the schema, said aloud: what the pictures of the training were drawn with.
    field.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    field.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)


def _extent(positions: np.ndarray, scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """(2, 3) float32: corners of the box about all ellipsoids of three standard deviations."""
    if not len(positions):
        return np.zeros((2, 3), np.float32)
    # An ellipsoid reaches along an axis as far as that row of rotation times scales is long.
    half = 3 * np.linalg.norm(matrices_of(quats) * scales[:, None], axis=2)
    return np.stack(((positions - half).min(axis=0), (positions + half).max(axis=0)))


def _add_camera(stage: Usd.Stage, camera: Camera, splats: Splats) -> None:
    """OpenCV's camera as USD's, which looks along -z with y up."""
    from pxr import Gf, UsdGeom

    prim = UsdGeom.Camera.Define(stage, "/World/Camera")
    _transform(prim, camera.rotation.T * (1, -1, -1), camera.position)
    focal = _APERTURE * camera.fx / camera.width
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_APERTURE)
    prim.CreateVerticalApertureAttr(focal * camera.height / camera.fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (camera.width / 2 - camera.cx) / camera.fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (camera.cy - camera.height / 2) / camera.fy)
    depths = (splats.positions - camera.position) @ camera.forward
    reach = np.linalg.norm(splats.positions - camera.position, axis=1) + 3 * splats.scales.max(axis=1)
    if (depths > 0).any():
        near = _NEAR * float(np.median(depths[depths > 0]))
        prim.CreateClippingRangeAttr(Gf.Vec2f(near, max(_FAR * float(reach.max()), 2 * near)))


def _package(binary: bytes, name: str) -> bytes:
    """A .usdz with one file: a zip without compression, each file at a multiple of 64 bytes, no time."""
    info = zipfile.ZipInfo(name)  # dated 1980
    header = 30 + len(name) + 4  # of the file within the zip, with the head of its extra field
    padding = -header % _ALIGNMENT
    info.extra = (0x1986).to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
    if len(binary) + 2 * header + 512 > _MAX_BYTES:
        raise HyrfDataError(f"the scene comes to {len(binary):,} bytes, too many for .usdz; write .usdc")
    package = io.BytesIO()
    with zipfile.ZipFile(package, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(info, binary)
    return package.getvalue()


def _read_splats(prim: Usd.Prim, name: str, upright: bool) -> Splats:
    from pxr import Usd, UsdGeom, UsdVol

    field = UsdVol.ParticleField3DGaussianSplat(prim)
    degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()

    def read(attribute: Usd.Attribute, *shape: int) -> np.ndarray:
        values = np.array(attribute.Get() if attribute.HasValue() else (), np.float32)
        if values.size % int(np.prod(shape)):
            raise HyrfDataError(f"{name}: {attribute.GetName()} has a wrong length; export it again")
        return values.reshape(-1, *shape)

    if not 0 <= degree <= MAX_DEGREE:
        raise HyrfDataError(f"{name}: harmonics of degree {degree} are not read, 0 to {MAX_DEGREE} are; export it so")
    splats: dict[str, Any] = {
        "positions": read(field.GetPositionsAttr(), 3),
        "scales": read(field.GetScalesAttr(), 3),
        "quats": read(field.GetOrientationsAttr(), 4)[:, [3, 0, 1, 2]],
        "opacities": read(field.GetOpacitiesAttr(), 1)[:, 0],
        "harmonics": read(field.GetRadianceSphericalHarmonicsCoefficientsAttr(), terms_of(degree), 3),
    }
    counts = {key: len(values) for key, values in splats.items()}
    if len(set(counts.values())) > 1:
        raise HyrfDataError(f"{name}: its arrays have different lengths ({counts}); export it again")
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
    turn = np.eye(3) if upright else rotation_of(matrix, name)[1].T
    try:
        return placed(checked_splats(name, **splats), matrix, turn, name)
    except ValueError as error:
        raise HyrfDataError(f"{name}: {error}; export it again") from error
