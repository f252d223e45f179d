"""Each variant from `tools.safety.variants` of a small rendered set reads as the set itself, or is a known error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import ball_points, photograph, ring

from hyrfpack.data import load_scene
from hyrfpack.rotations import quaternion_from_matrix
from hyrfpack.scene import Camera, Scene
from tools.safety.variants.catalog import ALL_VARIANTS
from tools.safety.variants.check import check_variant
from tools.safety.variants.working_set import WorkingSet

PHOTO_WIDTH = 64
PHOTO_HEIGHT = 40
# Each variant has one of its layouts, in turn; `tools/safety/variants/` tests all of them on real sets.
VARIANTS_WITH_LAYOUT = [
    (variant, variant.layouts[number % len(variant.layouts)]) for number, variant in enumerate(ALL_VARIANTS)
]
PILLOW_FEATURE_BY_SUFFIX = {".avif": "avif", ".jp2": "jpg_2000", ".webp": "webp"}


def write_colmap(root: Path, cameras: list[Camera]) -> None:
    model = root / "sparse" / "0"
    (root / "images").mkdir(parents=True)
    model.mkdir(parents=True)
    images, (points, colors) = [], ball_points(20)
    for number, camera in enumerate(cameras, start=1):
        name, shift = f"{number:03d}.jpg", camera.camera_from_world[:3, 3]
        images.append(" ".join(map(str, (number, *quaternion_from_matrix(camera.rotation), *shift, 1, name))) + "\n\n")
        Image.fromarray(photograph(camera).rgb).save(root / "images" / name, quality=98, subsampling=0)
    fx, fy, cx, cy = cameras[0].intrinsics
    (model / "cameras.txt").write_text(f"1 PINHOLE {PHOTO_WIDTH} {PHOTO_HEIGHT} {fx} {fy} {cx} {cy}\n")
    (model / "images.txt").write_text("".join(images))
    rows = [
        (i, *point, *(255 * color).astype(int), 0)
        for i, (point, color) in enumerate(zip(points, colors, strict=True), 1)
    ]
    (model / "points3D.txt").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    copy = WorkingSet.__new__(WorkingSet)
    copy.root = root
    copy.write_model()


def write_transforms(root: Path, cameras: list[Camera], blender: bool) -> None:
    frames = []
    for number, camera in enumerate(cameras, start=1):
        name = f"train/r_{number}" if blender else f"images/{number:03d}.jpg"
        file = root / (f"{name}.png" if blender else name)
        file.parent.mkdir(parents=True, exist_ok=True)
        picture = photograph(camera, alpha=blender)
        pixels = np.dstack((picture.rgb, picture.alpha)) if blender else picture.rgb
        Image.fromarray(pixels).save(file, **({} if blender else {"quality": 98, "subsampling": 0}))
        pose = np.linalg.inv(camera.camera_from_world) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"./{name}" if blender else name, "transform_matrix": pose.tolist()})
    fx, fy, cx, cy = cameras[0].intrinsics
    known = {"camera_angle_x": 2 * np.arctan(PHOTO_WIDTH / 2 / fx)}
    if not blender:
        known = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": PHOTO_WIDTH, "h": PHOTO_HEIGHT}
    table = "transforms_train.json" if blender else "transforms.json"
    (root / table).write_text(json.dumps({**known, "frames": frames}))


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> dict[str, Path]:
    """One rendered set in each layout."""
    folder = tmp_path_factory.mktemp("sets")
    cameras = ring(7, width=PHOTO_WIDTH, height=PHOTO_HEIGHT)
    write_colmap(folder / "colmap", cameras)
    write_transforms(folder / "nerfstudio", cameras, blender=False)
    write_transforms(folder / "blender", cameras, blender=True)
    return {layout: folder / layout for layout in ("colmap", "nerfstudio", "blender")}


@pytest.fixture(scope="module")
def plain_scenes(sources) -> dict[str, Scene]:
    """The unchanged sets, as scenes."""
    return {layout: load_scene(source) for layout, source in sources.items()}


def test_the_unchanged_sets_are_read_as_rendered(plain_scenes):
    cameras = ring(7, width=PHOTO_WIDTH, height=PHOTO_HEIGHT)
    for scene in plain_scenes.values():
        assert len(scene.views) == 7
        for view in scene.views:
            camera = min(cameras, key=lambda other, at=view.camera.position: np.linalg.norm(other.position - at))
            np.testing.assert_allclose(view.camera.camera_from_world, camera.camera_from_world, atol=1e-9)
            np.testing.assert_allclose(view.camera.intrinsics, camera.intrinsics, rtol=1e-6)
            picture, rendered = view.load(), photograph(camera)
            seen = 1 if picture.alpha is None else picture.alpha[..., None] / 255
            assert np.abs((picture.rgb.astype(float) - rendered.rgb) * seen).mean() < 3


@pytest.mark.parametrize(
    ("variant", "layout"),
    VARIANTS_WITH_LAYOUT,
    ids=[f"{variant.name}, {layout}" for variant, layout in VARIANTS_WITH_LAYOUT],
)
def test_a_variant_is_read_like_the_set_itself_or_is_a_known_error(
    variant, layout, sources, plain_scenes, tmp_path, monkeypatch
):
    from PIL import features

    for ending, feature in PILLOW_FEATURE_BY_SUFFIX.items():
        if ending in variant.name.lower() and not features.check(feature):
            pytest.skip(f"this Pillow cannot write {ending}")
    if "heic" in variant.name.lower():
        pytest.importorskip("pillow_heif")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    outcome = check_variant(variant, sources[layout], layout, tmp_path / "variant", plain_scenes[layout])

    assert outcome.kind == ("refused" if variant.expect else "read"), outcome.message
