"""Omniverse's asset validator and OpenUSD itself find in our USD files what we wrote."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent.clouds import EXACT, Cloud, cloud_of, cloud_of_ours, differences, made_up
from independent.formats import UP
from scipy.spatial.transform import Rotation

from hyrfpack.scene import Camera

pytest.importorskip("pxr", reason="usd-core is not installed")

from pxr import Usd, UsdGeom

from hyrfpack.splats.formats import usd
from hyrfpack.splats.formats.hints import Hints

KINDS = ("usda", "usdc", "usdz")
TEXT_IS_SLOW = "UsdAsciiPerformanceChecker"  # the validator would rather have .usdc, whatever the text says


def camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20, -35, 10], degrees=True).as_matrix()
    pose[:3, 3] = [0.3, -0.2, 6.0]
    return Camera(640, 360, 500.0, 520.0, 300.0, 190.0, pose)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("usd")
    paths = {kind: folder / f"splats.{kind}" for kind in KINDS}
    for kind, path in paths.items():
        path.write_bytes(usd.encode(made_up(3), Hints(UP, camera()), extension=kind, meters_per_unit=0.5))
    return paths


@pytest.mark.parametrize("kind", KINDS)
def test_the_validator_finds_nothing_wrong(kind, files):
    logging.getLogger("omni").setLevel(logging.WARNING)
    validator = pytest.importorskip("omni.asset_validator", reason="omniverse-asset-validator is not installed")
    engine = validator.ValidationEngine()  # all the rules that are on by default
    engine.enable_rule(validator.GaussianSplatSchemaChecker)
    complaints = [f"{issue.rule.__name__}: {issue.message}" for issue in engine.validate(str(files[kind])).issues()]
    assert [text for text in complaints if not (kind == "usda" and text.startswith(TEXT_IS_SLOW))] == []


def the_splats(stage: Usd.Stage) -> Usd.Prim:
    (prim,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat")
    return prim


def cloud_of_usd(prim: Usd.Prim) -> Cloud:
    """In the prim's own axes."""
    values = {name: prim.GetAttribute(name).Get() for name in ("positions", "scales", "orientations", "opacities")}
    quats = [(quat.GetReal(), *quat.GetImaginary()) for quat in values["orientations"]]
    terms = (prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() + 1) ** 2
    harmonics = np.reshape(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(), (-1, terms, 3))
    return cloud_of(values["positions"], values["scales"], np.array(quats), values["opacities"], harmonics)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", KINDS)
def test_openusd_reads_what_we_write(kind, degree, tmp_path):
    path = tmp_path / f"splats.{kind}"
    path.write_bytes(usd.encode(made_up(degree), Hints(UP), extension=kind))
    stage = Usd.Stage.Open(str(path))
    assert differences(cloud_of_ours(made_up(degree)), cloud_of_usd(the_splats(stage))).within(EXACT)


@pytest.mark.parametrize("up", np.concatenate((np.eye(3), -np.eye(3), UP[None])))
def test_the_stage_stands_upright_and_its_unit_is_told(up, tmp_path):
    path = tmp_path / "splats.usdc"
    path.write_bytes(usd.encode(made_up(0), Hints(up), extension="usdc", meters_per_unit=0.5))
    stage = Usd.Stage.Open(str(path))
    stage_from_prim = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(the_splats(stage))).T
    turn = stage_from_prim[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) > 0
    np.testing.assert_allclose(turn @ up, np.eye(3)["XYZ".index(UsdGeom.GetStageUpAxis(stage))], atol=1e-6)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.5


def test_a_stage_far_from_the_origin_stays_sharp(tmp_path):
    near = made_up(0)
    far = replace(near, positions=near.positions + [3e6, -5e6, 2e6])
    path = tmp_path / "far.usdc"
    path.write_bytes(usd.encode(far, Hints(UP), extension="usdc"))
    stage = Usd.Stage.Open(str(path))
    prim = the_splats(stage)
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    cloud = cloud_of_usd(prim)
    theirs = replace(cloud, positions=cloud.positions + matrix[:3, :3].T @ matrix[:3, 3])
    assert differences(cloud_of_ours(far), theirs).position < 1e-5  # float32 would be off by 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_the_camera_sees_each_splat_at_the_same_pixel(kind, files):
    stage = Usd.Stage.Open(str(files[kind]))
    (prim,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    clip_from_stage = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).T
    splats = the_splats(stage)
    clip_from_prim = clip_from_stage @ np.array(UsdGeom.XformCache().GetLocalToWorldTransform(splats)).T
    positions = np.array(splats.GetAttribute("positions").Get(), np.float64)
    clip = np.column_stack((positions, np.ones(len(positions)))) @ clip_from_prim.T
    ours = camera()
    seen = made_up(3).positions @ ours.rotation.T + ours.camera_from_world[:3, 3]
    expected = seen[:, :2] / seen[:, 2:] * [ours.fx, ours.fy] + [ours.cx, ours.cy]
    pixels = (clip[:, :2] / clip[:, 3:] * [0.5, -0.5] + 0.5) * [ours.width, ours.height]
    in_front = seen[:, 2] > 0.5
    assert in_front.sum() > 200
    np.testing.assert_allclose(pixels[in_front], expected[in_front], rtol=1e-4, atol=0.01)
