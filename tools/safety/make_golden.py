"""Write the golden files in tests/golden: files of the current format that all later versions must be able to read.

    python -m tools.safety.make_golden

It prints one line for each file or scene folder, and keeps those that exist. Golden files of a released format version
never change. To replace one before the release, delete it by hand first.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.config.split import SplitConfig
from hyrfpack.format import decode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.parts import encode_parts
from hyrfpack.lod import split_model
from hyrfpack.model import ExposureMap, Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.residuals import SHAPE_RESIDUALS, count_color_residuals
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.rotations import IDENTITY, Quaternion
from hyrfpack.scene import Camera
from tools.safety import minimal_reader
from tools.safety.synthetic_encoding import encode

TESTS_FOLDER = Path(__file__).parents[2] / "tests"
GOLDEN_FOLDER = TESTS_FOLDER / "golden"
GOLDEN_PROVENANCE = {
    "preset": "standard",
    "steps": 100,
    "why": {"geometry": "one entry a Gaussian", "name": "caf\u00e9"},
}
# The map has centers with the smallest and the largest codes, and log gains that reach the limits.
GOLDEN_EXPOSURE_MAP = ExposureMap(
    box=np.array([[-0.5, -0.25, -1.0], [0.75, -0.25, 2.0]], np.float32),
    lengths=np.array([0.7, 1.3], np.float32),
    mean=np.array([0.1, 0.0, -0.05], np.float32),
    limits=np.array([[-0.6, -0.5, -0.7], [0.9, 0.8, 0.4]], np.float32),
    steps=np.array([3e-5, 2e-5, 4e-5], np.float32),
    positions=np.array([[0, 0, 0], [255, 7, 255], [128, 255, 90], [33, 64, 200]], np.uint8),
    directions=np.array([[0, 0, 127], [-128, 0, 0], [90, -90, 5], [-60, 1, 111]], np.int8),
    weights=np.array([[32767, -20000, 1], [-32768, 9000, 250], [15000, 30000, -12000], [0, -1, 22222]], np.int16),
)
GOLDEN_ROTATION = (0.5, -0.1, 0.7, 0.5)


@dataclass(frozen=True)
class GoldenFile:
    """How a golden file is encoded: profile and its settings, exposure map, rotation, residuals, and provenance."""

    profile: str
    settings: dict[str, Any]
    exposure: ExposureMap | None = None
    rotation: Quaternion = IDENTITY
    residual_degree: int | None = None
    provenance: dict[str, Any] = field(default_factory=lambda: GOLDEN_PROVENANCE)


GOLDEN_CAMERA_CENTERS = ((0.1, 0.2, 1.0), (-1.5, 0.0, 2.5))  # the scene's centre in each camera, in local units
GOLDEN_FRAME_CENTER, GOLDEN_FRAME_SCALE = (1e6, -0.1, 3.0), 12.5


def make_camera_at(center: tuple[float, float, float], rotation: Quaternion = IDENTITY) -> Camera:
    """Return a camera in which the centre of the golden model is at `center`, in local units.

    In local units, the camera is the same for all rotations of the frame.
    """
    w, x, y, z = rotation
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose[:3, 3] = GOLDEN_FRAME_SCALE * np.array(center) - pose[:3, :3] @ GOLDEN_FRAME_CENTER
    return Camera(16, 12, 20.0, 20.0, 8.0, 6.0, pose)


GOLDEN_SAMPLING = {
    "coarse_cameras": [camera_to_numbers(make_camera_at(center)) for center in GOLDEN_CAMERA_CENTERS],
    "rate_ratio": 1.75,
}
GOLDEN_FILES = {
    "v1.0_raw": GoldenFile("raw", {}),
    "v1.0_paper": GoldenFile("paper", {"color": (3, 8), "scale": (2, 4), "opacity": (1, 16)}),
    "v1.1_compact": GoldenFile("compact", {"distortion": 5e-4}),
    "v1.1_compact_layers": GoldenFile("compact", {"distortion": 1e-5, "layered": True}),
    "v1.1_compact_sampling": GoldenFile(
        "compact", {"distortion": 5e-4}, provenance={**GOLDEN_PROVENANCE, **GOLDEN_SAMPLING}
    ),
    "v1.2_compact_exposure": GoldenFile("compact", {"distortion": 5e-4}, GOLDEN_EXPOSURE_MAP),
    "v1.3_compact_rotated": GoldenFile("compact", {"distortion": 5e-4}, GOLDEN_EXPOSURE_MAP, GOLDEN_ROTATION),
    "v1.6_compact_residuals": GoldenFile("compact", {"distortion": 1e-5, "layered": True}, residual_degree=2),
}


# Name and file of each part of the merged file. It lies in a folder of its own, because it is read in another way.
GOLDEN_PARTS = {"scene": "v1.2_compact_exposure", "turned": "v1.3_compact_rotated", "on paper": "v1.0_paper"}
GOLDEN_MERGED_FILE = GOLDEN_FOLDER / "merged" / "v1.4_merged.hyrf"
# A scene folder of one chunk, made of a golden file.
GOLDEN_SCENE_SOURCE, GOLDEN_SCENE_FOLDER = "v1.2_compact_exposure", GOLDEN_FOLDER / "scene"
# A scene folder of several parts, each with one chunk, made of the merged golden file.
GOLDEN_PARTS_SCENE_FOLDER = GOLDEN_FOLDER / "parts_scene"


def make_golden_model(rotation: Quaternion = IDENTITY) -> HybridModel:
    """Return a model of 20 Gaussians with one dense and one hashed level in each grid, and no two equal sizes."""
    rng = np.random.default_rng(20)
    config = ModelConfig(
        frame=Frame(GOLDEN_FRAME_CENTER, GOLDEN_FRAME_SCALE, (1.0, 0.75, 0.25), rotation),
        geometry=HashGridConfig(log2_table_size=4, levels=2, base=2, finest=5),
        radiance=HashGridConfig(log2_table_size=5, levels=2, base=3, finest=7),
        hidden=3,
        background=True,
        solid=(0.0, 0.5, 1.0),
        scale_rule="sum",
        scale_grows=True,
        direction_encoding="sh",
        position_gradients=False,
        antialiased=True,
    )
    values = torch.from_numpy(rng.normal(size=(20, 8)).astype(np.float32))
    values[0, :3] = torch.tensor([-0.0, 1e-42, -1234.5])
    model = HybridModel(config, Gaussians(values[:, :3], values[:, 3:6], values[:, 6:7], values[:, 7:] * 4))
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.from_numpy(rng.laplace(scale=0.1, size=parameter.shape)))
    return model


def add_golden_residuals(model: HybridModel, degree: int) -> HybridModel:
    """Return the golden model with residuals of two thirds of its Gaussians."""
    rng = np.random.default_rng(7)
    explicit = {name: getattr(model.gaussians, name).detach() for name in Gaussians.PARAMETER_NAMES}
    shapes, colors = (
        torch.from_numpy((0.3 * rng.normal(size=(len(model), width))).astype(np.float32))
        for width in (SHAPE_RESIDUALS, count_color_residuals(degree))
    )
    shapes[::3], colors[1::3] = 0, 0
    gaussians = Gaussians(**explicit, shape_residuals=shapes, color_residuals=colors)
    return model.with_gaussians(gaussians, replace(model.config, residual_degree=degree))


def expect_parameter(model: HybridModel, name: str) -> np.ndarray:
    """Return a parameter as profile paper must decode it, computed from the original by the profile's definition."""
    values = model.state_dict()[name].numpy()
    if name.endswith("grid.table"):
        low, high = values.min().astype(np.float64), values.max().astype(np.float64)
        codes = np.rint((values - low) / (high - low) * 255)
        return (((255 - codes) * low + codes * high) / 255).astype(np.float32)
    return values.astype(np.float16).astype(np.float32)


def expect_values(model: HybridModel, profile: str, data: bytes) -> dict[str, np.ndarray]:
    """Return the values that the file must decode to, by parameter."""
    _, groups, exposure = minimal_reader.read(data)
    gains = {} if exposure is None else expect_exposure(exposure, decode_model(data))
    if profile == "compact":
        # The encoder chooses what to keep and how finely, so these values are checked against the minimal reader.
        decoded = decode_model(data)
        for group, values in to_arrays(decoded).items():
            assert np.array_equal(values.view(np.uint32), groups[group].view(np.uint32)), group
        return {name: value.numpy() for name, value in decoded.state_dict().items()} | gains
    original = {name: value.numpy() for name, value in model.state_dict().items()}
    values = dict(original) if profile == "raw" else {name: expect_parameter(model, name) for name in original}
    for group, name in {"COLO": "color_logits", "SCAL": "scale_logits", "OPAC": "opacity_logits"}.items():
        before = original[f"gaussians.{name}"]
        after = groups[group]
        # Codebooks depend on k-means, so these values come from the minimal reader; they must be near the original.
        assert np.abs(after - before).max() < 0.5 * before.std()
        values[f"gaussians.{name}"] = after
    return values | gains


def make_golden_camera(rotation: Quaternion = IDENTITY) -> Camera:
    """Return a camera that sees the golden model from inside the box of the exposure map."""
    return make_camera_at(GOLDEN_CAMERA_CENTERS[0], rotation)


def expect_exposure(exposure: minimal_reader.Exposure, model: HybridModel) -> dict[str, np.ndarray]:
    """Return log gains (20, 3) at 20 viewpoints and one exposed picture (12, 16, 3), by the equations of the format.

    Positions are in local units, inside and outside the box. The first viewpoint is that of `make_golden_camera`.
    """
    rng = np.random.default_rng(0)
    positions, directions = rng.uniform(-2, 3, (20, 3)), rng.normal(size=(20, 3))
    positions[0], directions[0] = (-0.1, -0.2, -1.0), (0.0, 0.0, 1.0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    logs = np.array([minimal_reader.log_gains(exposure, *view) for view in zip(positions, directions, strict=True)])
    consistent = (
        render_view(
            model, make_golden_camera(model.config.frame.rotation), RenderSettings(exposure=CONSISTENT_EXPOSURE)
        )
        .rgb.double()
        .numpy()
    )
    return {
        "exposure.positions": positions,
        "exposure.directions": directions,
        "exposure.log_gains": logs,
        "exposure.picture": minimal_reader.expose(consistent, np.exp(logs[0])),
    }


def expect_pixel_sizes(provenance: dict[str, Any], positions: np.ndarray) -> np.ndarray:
    """Return the pixel sizes (N,) at local positions (N, 3) by the equations of the format, for straight frames.

    The cameras look along the axes of the frame.
    """
    rates, rates_by_distance = [], []
    for camera in map(camera_from_numbers, provenance["coarse_cameras"]):
        center = (camera.camera_from_world[:3, :3] @ GOLDEN_FRAME_CENTER + camera.camera_from_world[:3, 3]).round(6)
        x, y, z = (positions.astype(np.float64) + center / GOLDEN_FRAME_SCALE).T
        with np.errstate(divide="ignore"):
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (np.abs(column / camera.width - 0.5) <= 0.65) & (np.abs(row / camera.height - 0.5) <= 0.65)
        rates.append(np.where((z > 0.01) & inside, camera.fx / z, 0))
        rates_by_distance.append(camera.fx / np.maximum(np.sqrt(x**2 + y**2 + z**2), 0.01))
    seen = np.max(rates, axis=0)
    return 1 / np.where(seen > 0, seen, np.max(rates_by_distance, axis=0)) / provenance["rate_ratio"]


def encode_golden_parts() -> bytes:
    """Return the bytes of the merged file."""
    return encode_parts([(name, (GOLDEN_FOLDER / f"{file}.hyrf").read_bytes()) for name, file in GOLDEN_PARTS.items()])


def write_golden_file(target: Path, data: bytes, values: dict[str, np.ndarray]) -> None:
    """Write a golden file and, beside it, the numbers that it must decode to."""
    numbers = io.BytesIO()
    np.savez_compressed(numbers, **values)
    # An existing golden file is kept. So it comes last, lest an interruption leaves one without its numbers.
    write_atomic(target.with_suffix(".npz"), numbers.getvalue())
    write_atomic(target, data)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, golden in GOLDEN_FILES.items():
        target = GOLDEN_FOLDER / f"{name}.hyrf"
        if target.exists():
            print(f"{target} exists and is kept")
            continue
        model = make_golden_model(golden.rotation)
        model.exposure = golden.exposure
        if golden.residual_degree is not None:
            model = add_golden_residuals(model, golden.residual_degree)
        data = encode(model, golden.profile, golden.provenance, **golden.settings)
        values = expect_values(model, golden.profile, data)
        if "rate_ratio" in golden.provenance:
            values["sampling.pixel_sizes"] = expect_pixel_sizes(golden.provenance, values["gaussians.positions"])
        write_golden_file(target, data, values)
        print(f"{target}: {len(data)} bytes")
    if GOLDEN_MERGED_FILE.exists():
        print(f"{GOLDEN_MERGED_FILE} exists and is kept")
    else:
        write_atomic(GOLDEN_MERGED_FILE, encode_golden_parts())
        print(f"{GOLDEN_MERGED_FILE}: {GOLDEN_MERGED_FILE.stat().st_size} bytes")
    scenes = {
        GOLDEN_SCENE_FOLDER: GOLDEN_FOLDER / f"{GOLDEN_SCENE_SOURCE}.hyrf",
        GOLDEN_PARTS_SCENE_FOLDER: GOLDEN_MERGED_FILE,
    }
    for folder, source in scenes.items():
        if folder.exists():
            print(f"{folder} exists and is kept")
        else:
            report = split_model(source, folder, SplitConfig(levels=1))
            print(f"{folder}: {report.bytes} bytes")


if __name__ == "__main__":
    main()
