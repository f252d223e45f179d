"""The asset validator of Omniverse accepts our USD files, and OpenUSD reads from them what we wrote."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent.clouds import (
    FLOAT32_PRECISION,
    Cloud,
    cloud_from_parameters,
    cloud_from_splats,
    compare_clouds,
    sample_splats,
)
from independent.formats import UP_DIRECTION
from scipy.spatial.transform import Rotation

from hyrfpack.scene import Camera

pytest.importorskip("pxr", reason="usd-core is not installed")

from pxr import Usd, UsdGeom

from hyrfpack.splats.formats import usd
from hyrfpack.splats.formats.hints import Hints

USD_EXTENSIONS = ("usda", "usdc", "usdz")
TEXT_FORMAT_RULE = "UsdAsciiPerformanceChecker"  # the validator recommends .usdc for every .usda file


def make_camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20, -35, 10], degrees=True).as_matrix()
    pose[:3, 3] = [0.3, -0.2, 6.0]
    return Camera(640, 360, 500.0, 520.0, 300.0, 190.0, pose)


@pytest.fixture(scope="module")
def usd_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("usd")
    paths = {kind: folder / f"splats.{kind}" for kind in USD_EXTENSIONS}
    for kind, path in paths.items():
        path.write_bytes(usd.encode(sample_splats(3), Hints(UP_DIRECTION, make_camera()), extension=kind))
    return paths


@pytest.mark.parametrize("kind", USD_EXTENSIONS)
def test_the_validator_finds_nothing_wrong(kind, usd_files):
    logging.getLogger("omni").setLevel(logging.WARNING)
    validator = pytest.importorskip("omni.asset_validator", reason="omniverse-asset-validator is not installed")
    engine = validator.ValidationEngine()  # has all rules that are enabled by default
    engine.enable_rule(validator.GaussianSplatSchemaChecker)
    complaints = [f"{issue.rule.__name__}: {issue.message}" for issue in engine.validate(str(usd_files[kind])).issues()]
    assert [text for text in complaints if not (kind == "usda" and text.startswith(TEXT_FORMAT_RULE))] == []


def find_splats_prim(stage: Usd.Stage) -> Usd.Prim:
    (prim,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat")
    return prim


def cloud_from_usd(prim: Usd.Prim) -> Cloud:
    """Make a cloud from a prim, in the prim's own axes."""
    values = {name: prim.GetAttribute(name).Get() for name in ("positions", "scales", "orientations", "opacities")}
    quats = [(quat.GetReal(), *quat.GetImaginary()) for quat in values["orientations"]]
    terms = (prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() + 1) ** 2
    harmonics = np.reshape(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(), (-1, terms, 3))
    return cloud_from_parameters(values["positions"], values["scales"], np.array(quats), values["opacities"], harmonics)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", USD_EXTENSIONS)
def test_openusd_reads_what_we_write(kind, degree, tmp_path):
    path = tmp_path / f"splats.{kind}"
    path.write_bytes(usd.encode(sample_splats(degree), Hints(UP_DIRECTION), extension=kind))
    stage = Usd.Stage.Open(str(path))
    assert compare_clouds(cloud_from_splats(sample_splats(degree)), cloud_from_usd(find_splats_prim(stage))).is_within(
        FLOAT32_PRECISION
    )


@pytest.mark.parametrize("up", np.concatenate((np.eye(3), -np.eye(3), UP_DIRECTION[None])))
def test_the_stage_is_upright_and_declares_its_unit(up, tmp_path):
    path = tmp_path / "splats.usdc"
    path.write_bytes(usd.encode(sample_splats(0), Hints(up), extension="usdc"))
    stage = Usd.Stage.Open(str(path))
    stage_from_prim = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(find_splats_prim(stage))).T
    turn = stage_from_prim[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) > 0
    np.testing.assert_allclose(turn @ up, np.eye(3)["XYZ".index(UsdGeom.GetStageUpAxis(stage))], atol=1e-6)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0


def test_a_stage_far_from_the_origin_keeps_its_precision(tmp_path):
    near = sample_splats(0)
    far = replace(near, positions=near.positions + [3e6, -5e6, 2e6])
    path = tmp_path / "far.usdc"
    path.write_bytes(usd.encode(far, Hints(UP_DIRECTION), extension="usdc"))
    stage = Usd.Stage.Open(str(path))
    prim = find_splats_prim(stage)
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    cloud = cloud_from_usd(prim)
    theirs = replace(cloud, positions=cloud.positions + matrix[:3, :3].T @ matrix[:3, 3])
    assert compare_clouds(cloud_from_splats(far), theirs).position < 1e-5  # float32 positions would be off by 0.25


@pytest.mark.parametrize("kind", USD_EXTENSIONS)
def test_the_stored_camera_projects_splats_to_the_same_pixels(kind, usd_files):
    stage = Usd.Stage.Open(str(usd_files[kind]))
    (prim,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    clip_from_stage = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).T
    splats = find_splats_prim(stage)
    clip_from_prim = clip_from_stage @ np.array(UsdGeom.XformCache().GetLocalToWorldTransform(splats)).T
    positions = np.array(splats.GetAttribute("positions").Get(), np.float64)
    clip = np.column_stack((positions, np.ones(len(positions)))) @ clip_from_prim.T
    ours = make_camera()
    seen = sample_splats(3).positions @ ours.rotation.T + ours.camera_from_world[:3, 3]
    expected = seen[:, :2] / seen[:, 2:] * [ours.fx, ours.fy] + [ours.cx, ours.cy]
    pixels = (clip[:, :2] / clip[:, 3:] * [0.5, -0.5] + 0.5) * [ours.width, ours.height]
    in_front = seen[:, 2] > 0.5
    assert in_front.sum() > 200
    np.testing.assert_allclose(pixels[in_front], expected[in_front], rtol=1e-4, atol=0.01)
