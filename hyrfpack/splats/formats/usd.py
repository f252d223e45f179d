"""OpenUSD files (.usda, .usdc, .usdz) with UsdVol's ParticleField3DGaussianSplat, through usd-core.

    /World              Xform, the default prim: rotates the input's axes so that the scene is upright
    /World/Gaussians    ParticleField3DGaussianSplat, translated to the scene's origin
    /World/Camera       the camera of one of the photos, if one is given

All arrays are float32. The schema also has float16 attributes, which would nearly halve the file at a loss of a tenth
of an 8-bit level. But checkers ask for the float32 ones, and float16 cannot hold the scales of scenes in very small or
very large units.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.ops.harmonics import MAX_DEGREE, num_sh_bases
from hyrfpack.rotations import rotation_matrices
from hyrfpack.scene import Camera
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.placement import (
    apply_transform,
    choose_local_origin,
    decompose_similarity,
    subtract_origin,
    upright_rotation,
)
from hyrfpack.splats.splats import Splats

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

Extension = Literal["usda", "usdc", "usdz"]
EXTENSIONS: tuple[Extension, ...] = get_args(Extension)
REQUIRED_MODULE = "pxr"
_SPLATS_TYPE_NAME = "ParticleField3DGaussianSplat"
# In tenths of a scene unit, like USD's focal lengths. Only its ratio to the focal length matters.
_HORIZONTAL_APERTURE = 36.0
# Clipping range of the camera: near plane over median depth, and far plane over the distance of the farthest splat.
_NEAR_MEDIAN_DEPTH_RATIO = 0.01
_FAR_MAX_REACH_RATIO = 1.1
_USDZ_ALIGNMENT_BYTES = 64
_FLOAT32_MAX = float(np.finfo(np.float32).max)
_MAX_USDZ_BYTES = (1 << 32) - 1  # because a .usdz is a zip without 64-bit lengths


def encode(splats: Splats, hints: Hints = NO_HINTS, *, extension: Extension = "usdc") -> bytes:
    """Encode splats as a USD file.

    The stored numbers keep the input's axes and units. Transforms turn the scene upright and, where it lies far from
    the origin compared to its size, translate it there. The same splats and the same version of usd-core give the same
    bytes.

    Args:
        splats: any number of splats. Scales of 0 become the smallest normal float32, because the schema's checkers
            require positive scales.
        hints: `up` and `camera` are used. The file's up axis is z where `up` is nearer to the world's z than to its y,
            otherwise y.
        extension: "usda" is text, "usdc" binary, "usdz" an uncompressed package of a binary file.

    Raises:
        HyrfError: usd-core is missing.
        HyrfDataError: the splats do not fit into float32, or into 4 GiB of a package.
    """
    with needs_package(f"writing .{extension} files"):
        from pxr import Kind, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    z_up = bool(hints.up[2] > abs(hints.up[1]))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if z_up else UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)  # the length of a world unit is not known
    stage.GetRootLayer().documentation = "3D Gaussians, written by hyrfpack"
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind(Kind.Tokens.component)
    turn = upright_rotation(hints.up, np.array([0.0, 0.0, 1.0] if z_up else [0.0, 1.0, 0.0]))
    _add_transform(world, turn, np.zeros(3))
    _add_splats(stage, splats)
    if hints.camera is not None:
        _add_camera(stage, hints.camera, splats)
    if extension == "usda":
        return stage.GetRootLayer().ExportToString().encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.usdc")
        stage.GetRootLayer().Export(str(path))
        binary = path.read_bytes()
    return binary if extension == "usdc" else _pack_usdz(binary, path.name)


def decode(data: bytes, name: str, extension: Extension, *, upright: bool = False) -> Splats:
    """Decode a USD file like those of `encode`: float32 arrays, one field of splats, no references to other files.

    The loss of an export is measured with it. usd-core parses the bytes, so hostile files are as dangerous here as in
    usd-core.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.
        extension: as in `encode`.
        upright: return the splats in the file's axes. Otherwise they are rotated back about the origin. For a file from
            `encode` that restores the original axes.

    Raises:
        HyrfError: usd-core is missing.
        HyrfDataError: the bytes are not such a file.
    """
    with needs_package(f"{name}: reading it"):
        from pxr import Sdf, Tf, Usd

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"scene.{extension}")
        path.write_bytes(data)
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(path))
            if layer is None or layer.GetCompositionAssetDependencies():
                raise HyrfDataError(
                    f"{name}: this is not a USD file, or it refers to other files",
                    fix="flatten it into one file",
                )
            stage = Usd.Stage.Open(layer)
            fields = [prim for prim in stage.Traverse() if prim.GetTypeName() == _SPLATS_TYPE_NAME]
            if len(fields) != 1:
                raise HyrfDataError(
                    f"{name}: the file holds {len(fields)} {_SPLATS_TYPE_NAME}, but exactly one can be read",
                    fix="give another file",
                )
            return _read_splats(fields[0], name, upright)
        except Tf.ErrorException as error:
            reason = str(error).strip().splitlines()[-1:] or ["no reason given"]
            raise HyrfDataError(f"{name}: usd-core cannot read it ({reason[0]:.160})", fix="export it again") from error


def _add_transform(prim: UsdGeom.Xformable, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Add a rotation (3, 3) and a translation (3,) to a prim, unless they are the identity."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    if not np.array_equal(matrix, np.eye(4)):
        prim.AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))  # USD multiplies row vectors


def _add_splats(stage: Usd.Stage, splats: Splats) -> None:
    from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

    origin = choose_local_origin(splats.positions)
    positions = subtract_origin(splats, origin)
    scales = np.maximum(splats.scales, np.finfo(np.float32).tiny)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Gaussians")
    _add_transform(field, np.eye(3), origin)
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(positions))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(splats.quats[:, [1, 2, 3, 0]])))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_compute_extent(positions, scales, splats.quats)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
    harmonics = field.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        Vt.Vec3fArray.FromNumpy(splats.harmonics.reshape(-1, 3))
    )
    primvar = UsdGeom.Primvar(harmonics)
    primvar.SetInterpolation(UsdGeom.Tokens.vertex)
    primvar.SetElementSize(num_sh_bases(splats.degree))
    # USD takes colours as linear unless a colour space is named.
    colors = Usd.ColorSpaceAPI.Apply(field.GetPrim())
    colors.CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    # These are the schema's defaults, written explicitly because training renders with them.
    field.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    field.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)


def _compute_extent(positions: np.ndarray, scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Return the corners (2, 3) float32 of the box around all ellipsoids of three standard deviations."""
    if not len(positions):
        return np.zeros((2, 3), np.float32)
    # The reach of an ellipsoid along an axis is the length of that row of rotation times scales.
    positions, scales, quats = (values.astype(np.float64) for values in (positions, scales, quats))
    half = 3 * np.linalg.norm(rotation_matrices(quats) * scales[:, None], axis=2)
    corners = np.stack(((positions - half).min(axis=0), (positions + half).max(axis=0)))
    return np.clip(corners, -_FLOAT32_MAX, _FLOAT32_MAX).astype(np.float32)


def _add_camera(stage: Usd.Stage, camera: Camera, splats: Splats) -> None:
    """Add a camera, converted from OpenCV's axes to USD's, which look along -z with y up."""
    from pxr import Gf, UsdGeom

    prim = UsdGeom.Camera.Define(stage, "/World/Camera")
    _add_transform(prim, camera.rotation.T * (1, -1, -1), camera.position)
    focal = _HORIZONTAL_APERTURE * camera.fx / camera.width
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_HORIZONTAL_APERTURE)
    prim.CreateVerticalApertureAttr(focal * camera.height / camera.fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (camera.width / 2 - camera.cx) / camera.fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (camera.cy - camera.height / 2) / camera.fy)
    depths = (splats.positions - camera.position) @ camera.forward
    reach = np.linalg.norm(splats.positions - camera.position, axis=1) + 3 * splats.scales.max(axis=1)
    if (depths > 0).any():
        near_plane = _NEAR_MEDIAN_DEPTH_RATIO * float(np.median(depths[depths > 0]))
        prim.CreateClippingRangeAttr(
            Gf.Vec2f(near_plane, max(_FAR_MAX_REACH_RATIO * float(reach.max()), 2 * near_plane))
        )


def _pack_usdz(binary: bytes, name: str) -> bytes:
    """Pack one file into a .usdz: a zip without compression or time stamps, with files aligned to 64 bytes."""
    info = zipfile.ZipInfo(name)  # dated 1980, so that the bytes do not depend on the time
    header = 30 + len(name) + 4  # bytes of the local file header, with the header of its extra field
    padding = -header % _USDZ_ALIGNMENT_BYTES
    info.extra = (0x1986).to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
    if len(binary) + 2 * header + 512 > _MAX_USDZ_BYTES:
        raise HyrfDataError(f"the scene comes to {len(binary):,} bytes, too many for .usdz", fix="write .usdc")
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
            raise HyrfDataError(
                f"{name}: {attribute.GetName()} has a length that does not fit its type", fix="export it again"
            )
        return values.reshape(-1, *shape)

    if not 0 <= degree <= MAX_DEGREE:
        raise HyrfDataError(
            f"{name}: harmonics of degree {degree} are not supported",
            fix=f"export it with degree 0 to {MAX_DEGREE}",
        )
    splats: dict[str, Any] = {
        "positions": read(field.GetPositionsAttr(), 3),
        "scales": read(field.GetScalesAttr(), 3),
        "quats": read(field.GetOrientationsAttr(), 4)[:, [3, 0, 1, 2]],
        "opacities": read(field.GetOpacitiesAttr(), 1)[:, 0],
        "harmonics": read(field.GetRadianceSphericalHarmonicsCoefficientsAttr(), num_sh_bases(degree), 3),
    }
    counts = {key: len(values) for key, values in splats.items()}
    if len(set(counts.values())) > 1:
        raise HyrfDataError(f"{name}: its arrays have different lengths ({counts})", fix="export it again")
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
    turn = np.eye(3) if upright else decompose_similarity(matrix, name)[1].T
    try:
        return apply_transform(build_valid_splats(name, **splats), matrix, turn, name)
    except ValueError as error:
        raise HyrfDataError(f"{name}: {error}", fix="export it again") from error
