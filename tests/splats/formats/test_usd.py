from __future__ import annotations

import importlib
import zipfile
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from made_up_splats import random_splats
from scenes import look_at
from scipy.spatial.transform import Rotation

from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import usd
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats

USD_EXTENSIONS = ("usda", "usdc", "usdz")
Y_DOWN, Z_UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
TEST_CAMERA = Camera(640, 480, 500.0, 520.0, 300.0, 250.0, look_at((3, -4, 2), (0, 0, 0)))


@pytest.fixture
def pxr():
    """Return a function that imports a module of usd-core by name, such as pxr("Gf")."""
    pytest.importorskip("pxr")
    return lambda name: importlib.import_module(f"pxr.{name}")


def write_and_open_stage(pxr, tmp_path, splats: Splats, hints: Hints, extension: str = "usdc", **options):
    file = tmp_path / f"a.{extension}"
    file.write_bytes(usd.encode(splats, hints, extension=extension, **options))
    return pxr("Usd").Stage.Open(str(file))


@pytest.mark.parametrize("extension", USD_EXTENSIONS)
@pytest.mark.parametrize("degree", [0, 3])
def test_splats_round_trip_in_the_same_axes(pxr, extension, degree):
    splats = random_splats(degree=degree, shift=(5e5, -4e6, 120.0))
    read = usd.decode(usd.encode(splats, Hints(Y_DOWN), extension=extension), "a", extension)
    np.testing.assert_allclose(read.positions, splats.positions, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.quats, splats.quats, rtol=0, atol=1e-7)
    for name in ("scales", "opacities", "harmonics"):
        np.testing.assert_array_equal(getattr(read, name), getattr(splats, name))


@pytest.mark.parametrize("extension", USD_EXTENSIONS)
def test_encoding_is_deterministic(pxr, extension):
    first, second = (usd.encode(random_splats(), Hints(Y_DOWN, TEST_CAMERA), extension=extension) for _ in range(2))
    assert first == second


def test_the_omniverse_validator_accepts_far_splats_and_zero_scales(pxr, tmp_path):
    validator = pytest.importorskip("omni.asset_validator")
    splats = random_splats(shift=(1e6, 1e6, 1e6))
    splats = replace(splats, scales=np.maximum(splats.scales - 0.02, 0))
    assert (splats.scales == 0).any()
    write_and_open_stage(pxr, tmp_path, splats, Hints(Y_DOWN, TEST_CAMERA))
    engine = validator.ValidationEngine()
    engine.enable_rule(validator.GaussianSplatSchemaChecker)
    assert [issue.message for issue in engine.validate(str(tmp_path / "a.usdc")).issues()] == []


def test_the_validators_of_openusd_report_nothing(pxr, tmp_path):
    stage = write_and_open_stage(pxr, tmp_path, random_splats(), Hints(Z_UP, TEST_CAMERA), "usdz")
    registry = pxr("UsdValidation").ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(each.name) for each in registry.GetAllValidatorMetadata()]
    assert validators
    assert [error.GetMessage() for error in pxr("UsdValidation").ValidationContext(validators).Validate(stage)] == []


@pytest.mark.parametrize(
    ("up", "axis"), [(Y_DOWN, "Y"), (Z_UP, "Z"), (-Z_UP, "Y"), (np.array([0.48, -0.6, 0.64]), "Z")]
)
def test_the_stage_rotates_up_to_its_up_axis(pxr, tmp_path, up, axis):
    stage = write_and_open_stage(pxr, tmp_path, random_splats(5), Hints(up))
    assert (stage.GetMetadata("upAxis"), stage.GetMetadata("metersPerUnit")) == (axis, 1.0)
    world = pxr("UsdGeom").Xformable(stage.GetDefaultPrim())
    turned = world.GetLocalTransformation().TransformDir(pxr("Gf").Vec3d(*up))
    np.testing.assert_allclose(turned, (0, 1, 0) if axis == "Y" else (0, 0, 1), atol=1e-12)
    assert bool(world.GetOrderedXformOps()) != np.array_equal(up, Z_UP)


def test_upright_decoding_rotates_the_harmonics_too(pxr):
    splats, turn = random_splats(), np.diag([1.0, -1.0, -1.0])
    read = usd.decode(usd.encode(splats, Hints(Y_DOWN), extension="usdc"), "a", "usdc", upright=True)
    np.testing.assert_allclose(read.positions, splats.positions * (1, -1, -1), atol=1e-6)
    np.testing.assert_allclose(read.harmonics, splats.rotated(turn).harmonics, atol=1e-6)


def test_the_extent_is_the_bounding_box_at_three_sigma(pxr, tmp_path):
    splats = random_splats(30)
    stage = write_and_open_stage(pxr, tmp_path, splats, Hints(Y_DOWN))
    field = pxr("UsdVol").ParticleField3DGaussianSplat.Get(stage, "/World/Gaussians")
    sphere = np.random.default_rng(0).normal(size=(20_000, 3))
    sphere *= 3 / np.linalg.norm(sphere, axis=1, keepdims=True)
    axes = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]]).as_matrix() * splats.scales[:, None]
    surface = (splats.positions[:, None] + sphere @ axes.transpose(0, 2, 1)).reshape(-1, 3)
    low, high = np.array(field.GetExtentAttr().Get())
    np.testing.assert_allclose(low, surface.min(0), atol=0.01)
    np.testing.assert_allclose(high, surface.max(0), atol=0.01)
    assert (surface >= low - 1e-6).all() and (surface <= high + 1e-6).all()


def test_the_extent_of_huge_splats_is_finite(pxr, tmp_path):
    splats = replace(random_splats(3), scales=np.full((3, 3), 1e28, np.float32))
    with np.errstate(all="raise"):
        stage = write_and_open_stage(pxr, tmp_path, splats, Hints())
    prims = [prim for prim in stage.Traverse() if prim.GetAttribute("extent")]
    assert np.isfinite(np.array(prims[0].GetAttribute("extent").Get())).all()


def test_the_camera_projects_as_opencv_does(pxr, tmp_path):
    splats = random_splats(20)
    up = np.array([0.1, -0.7, 0.2]) / np.sqrt(0.54)
    stage = write_and_open_stage(pxr, tmp_path, splats, Hints(up, TEST_CAMERA))
    field, camera = stage.GetPrimAtPath("/World/Gaussians"), stage.GetPrimAtPath("/World/Camera")
    geom, code = pxr("UsdGeom"), pxr("Usd").TimeCode.Default()
    frustum = geom.Camera(camera).GetCamera(code).frustum
    stored = geom.Xformable(field).ComputeLocalToWorldTransform(code)
    clip = stored * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()

    for position in splats.positions:
        x, y, depth = TEST_CAMERA.rotation @ position + TEST_CAMERA.camera_from_world[:3, 3]
        pixel = TEST_CAMERA.fx * x / depth + TEST_CAMERA.cx, TEST_CAMERA.fy * y / depth + TEST_CAMERA.cy
        right, up, far = clip.Transform(pxr("Gf").Vec3d(*position))
        np.testing.assert_allclose((320 * (1 + right), 240 * (1 - up)), pixel, atol=1e-3)
        assert -1 < far < 1  # lies within the clipping range


def test_files_in_a_usdz_package_are_aligned_to_64_bytes(pxr):
    data = usd.encode(random_splats(), Hints(Y_DOWN), extension="usdz")
    (info,) = zipfile.ZipFile(BytesIO(data)).infolist()
    start = info.header_offset + 30 + sum(np.frombuffer(data, "<u2", 2, info.header_offset + 26).tolist())
    assert start % 64 == 0 and data[start : start + 8] == b"PXR-USDC" and info.compress_type == zipfile.ZIP_STORED


def test_an_empty_field_round_trips(pxr):
    assert len(usd.decode(usd.encode(random_splats()[:0], Hints(Y_DOWN), extension="usda"), "a", "usda")) == 0


@pytest.mark.parametrize("extension", USD_EXTENSIONS)
def test_files_of_another_kind_are_refused(pxr, extension):
    with pytest.raises(HyrfDataError, match="^a.usd: "):
        usd.decode(b"#usda 1.0\n(nonsense", "a.usd", extension)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("float[] opacities = [", "float[] opacities = [0.5, ", "different lengths"),
        ("sphericalHarmonicsDegree = 0", "sphericalHarmonicsDegree = 9", "degree 9"),
        ("float[] opacities = [", "float[] opacities = [7", "opacities"),
        ('def Xform "World" (', 'def Xform "World" (references = @other.usda@', "refers to other files"),
        ("ParticleField3DGaussianSplat", "Xform", "holds 0"),
    ],
)
def test_inconsistent_fields_are_refused_with_the_reason(pxr, old, new, sentence):
    text = usd.encode(random_splats(2, degree=0), Hints(Z_UP), extension="usda").decode()
    assert old in text
    with pytest.raises(HyrfDataError, match=f"^a.usda: .*{sentence}"):
        usd.decode(text.replace(old, new).encode(), "a.usda", "usda")


def test_the_error_without_usd_core_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(HyrfError, match=r"pip install \"hyrfpack\[usd\]\""):
        usd.encode(random_splats(), Hints(Y_DOWN), extension="usda")
