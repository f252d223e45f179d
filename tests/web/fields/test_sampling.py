"""JavaScript finds how finely photos sampled a model as Python does: pixel sizes, and strides of the background."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import ring, shift_cameras
from web.fields.test_viewpoint import MODEL_FRAME, make_metadata
from web.scripts import run_script

from hyrfpack.cameras.files import camera_to_numbers
from hyrfpack.cameras.sampling import PhotoCameras
from hyrfpack.rotations import Quaternion, rotation_matrix
from hyrfpack.scene import Camera

SAMPLING_SCRIPT = Path(__file__).parent / "sampling.mjs"
FOCAL_PIXELS, WIDTH_PIXELS, HEIGHT_PIXELS = 100.0, 80, 60
FLOAT32_ROUNDING = 3e-7


def axis_camera(distance: float = 4.0, focal: float = FOCAL_PIXELS) -> Camera:
    """Return a camera that looks along +z of the world at the frame's centre, `distance` local units away from it."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array(MODEL_FRAME.center)
    pose[2, 3] += distance * MODEL_FRAME.scale
    return Camera(WIDTH_PIXELS, HEIGHT_PIXELS, focal, focal, WIDTH_PIXELS / 2, HEIGHT_PIXELS / 2, pose)


def provenance_of(cameras: list[Camera], key: str = "cameras", **more: Any) -> dict:
    return {key: [camera_to_numbers(camera) for camera in cameras], **more}


def sample_in_node(
    tmp_path: Path,
    provenance: Any,
    positions: Any = ((0.0, 0.0, 0.0),),
    focals: tuple[float, ...] = (),
    **frame: Any,
) -> dict:
    file = tmp_path / "cases.json"
    points = np.asarray(positions, np.float32).tolist()
    metadata = make_metadata(provenance, **frame)
    file.write_text(json.dumps([{"metadata": metadata, "positions": points, "focals": focals}]))
    return run_script(SAMPLING_SCRIPT, file)[0]


def test_the_pixel_size_is_the_depth_by_the_focal_length(tmp_path: Path) -> None:
    depths = np.array([0.02, 1.0, 4.0, 30.0])
    positions = [(0.0, 0.0, depth - 4) for depth in depths]

    found = sample_in_node(tmp_path, provenance_of([axis_camera()]), positions)

    np.testing.assert_allclose(found["sizes"], depths / FOCAL_PIXELS, rtol=1e-5)


def test_the_finest_camera_that_sees_a_position_decides(tmp_path: Path) -> None:
    cameras = [axis_camera(4.0), axis_camera(2.0, focal=30.0), axis_camera(6.0, focal=300.0), axis_camera(-1.0)]

    found = sample_in_node(tmp_path, provenance_of(cameras))

    np.testing.assert_allclose(found["sizes"], [6 / 300], rtol=FLOAT32_ROUNDING)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_cameras_see_15_percent_beyond_each_edge_and_otherwise_the_distance_counts(
    tmp_path: Path, axis: int, side: int
) -> None:
    reach = (
        (0.5 + 0.15) * (WIDTH_PIXELS, HEIGHT_PIXELS)[axis] / FOCAL_PIXELS
    )  # the tangent at which the camera ceases to see
    positions = np.zeros((2, 3))
    positions[:, axis] = [side * 4 * (reach - 1e-4), side * 4 * (reach + 1e-4)]

    found = sample_in_node(tmp_path, provenance_of([axis_camera()]), positions)

    np.testing.assert_allclose(found["sizes"], np.array([4, 4 * np.hypot(1, reach + 1e-4)]) / FOCAL_PIXELS, rtol=1e-6)


def test_a_position_behind_all_cameras_has_a_size_by_its_distance(tmp_path: Path) -> None:
    found = sample_in_node(tmp_path, provenance_of([axis_camera()]), [(0, 0, -5), (0, 3, -8), (0, 0, -4)])

    np.testing.assert_allclose(found["sizes"], np.array([1, 5, 0.01]) / FOCAL_PIXELS, rtol=1e-5)


def test_coarse_cameras_count_only_without_exact_ones_and_for_a_tenth_more(tmp_path: Path) -> None:
    coarse = provenance_of([axis_camera(8.0)], "coarse_cameras")
    both = {**coarse, **provenance_of([axis_camera(4.0)])}
    broken = {**both, "cameras": [*both["cameras"], [1, 2, 3]]}

    sizes = [sample_in_node(tmp_path, provenance)["sizes"][0] for provenance in (coarse, both, broken)]

    np.testing.assert_allclose(
        sizes, [8 / FOCAL_PIXELS / 1.1, 4 / FOCAL_PIXELS, 8 / FOCAL_PIXELS / 1.1], rtol=FLOAT32_ROUNDING
    )


@pytest.mark.parametrize(
    ("stored", "counts"),
    [
        (2.5, 2.5),
        (1, 1),
        (0.9, None),
        ("2", None),
        *(pytest.param(wrong, None, marks=pytest.mark.acceptance) for wrong in (1001, True)),
    ],
)
def test_sizes_are_divided_by_the_rate_ratio_of_the_file(tmp_path: Path, stored: Any, counts: float | None) -> None:
    for key, default in (("cameras", 1.0), ("coarse_cameras", 1.1)):
        found = sample_in_node(tmp_path, provenance_of([axis_camera(4.0)], key, rate_ratio=stored))

        expected = 4 / FOCAL_PIXELS / (counts or default)
        np.testing.assert_allclose(found["sizes"], [expected], rtol=FLOAT32_ROUNDING)


def test_forged_cameras_limit_nothing_and_take_no_long_time(tmp_path: Path) -> None:
    far, near = (camera_to_numbers(axis_camera(distance)) for distance in (4.0, 2.0))
    blurred = [*far[:2], 1e-9, 1e-9, *far[4:]]

    sizes = [sample_in_node(tmp_path, {"cameras": cameras})["sizes"] for cameras in ([far] * 128 + [near], [blurred])]

    np.testing.assert_allclose(sizes, [[4 / FOCAL_PIXELS], [0]], rtol=FLOAT32_ROUNDING)


def test_an_invalid_camera_after_the_first_128_does_not_matter(tmp_path: Path) -> None:
    """In both readers, the same camera among the first 128 makes the list count as missing."""
    row = camera_to_numbers(axis_camera())
    late, early = ({"cameras": [row] * count + [[1, 2, 3], row]} for count in (128, 127))

    sizes = [sample_in_node(tmp_path, provenance)["sizes"] for provenance in (late, early)]

    np.testing.assert_allclose(sizes, [[4 / FOCAL_PIXELS], [0]], rtol=FLOAT32_ROUNDING)
    assert [len(PhotoCameras.from_provenance(each).cameras) for each in (late, early)] == [128, 0]


@pytest.mark.parametrize("provenance", [None, {}, {"cameras": 3}, {"cameras": []}, {"coarse_cameras": [[1]]}])
def test_without_cameras_nothing_is_filtered_and_each_pixel_has_its_background(tmp_path: Path, provenance: Any) -> None:
    found = sample_in_node(tmp_path, provenance, focals=(1.0, 1e4))

    assert found == {"sizes": [0], "spacing": 0, "strides": [1, 1]}


@pytest.mark.parametrize(
    ("stored", "strides"),
    [
        ({}, [1, 1, 2, 2, 3, 6, 64]),
        ({"background_stride": 1}, [1, 1, 1, 1, 1, 3, 64]),
        ({"background_stride": 4}, [1, 2, 3, 4, 6, 12, 64]),
        ({"background_stride": 4.0}, [1, 2, 3, 4, 6, 12, 64]),
        ({"background_stride": 64}, [16, 32, 63, 64, 64, 64, 64]),
        *(({"background_stride": wrong}, [1, 1, 2, 2, 3, 6, 64]) for wrong in (65, 1.5, "4")),
        *(
            pytest.param({"background_stride": wrong}, [1, 1, 2, 2, 3, 6, 64], marks=pytest.mark.acceptance)
            for wrong in (0, -2, None, [4])
        ),
    ],
)
def test_strides_keep_the_spacing_of_training(tmp_path: Path, stored: dict, strides: list[int]) -> None:
    cameras = [axis_camera(), axis_camera(focal=FOCAL_PIXELS / 2)]  # the longer focal length counts
    focals = (25.0, 50.0, 99.6, 100.0, 150.0, 300.0, 1e5)

    found = sample_in_node(tmp_path, provenance_of(cameras, **stored), focals=focals)

    assert found["strides"] == strides
    photos = PhotoCameras.from_provenance(provenance_of(cameras, **stored))
    assert found["spacing"] == pytest.approx(photos.background_spacing, rel=1e-12)


@pytest.mark.parametrize("rotation", [(1.0, 0.0, 0.0, 0.0), (0.5, -0.1, 0.7, 0.5)], ids=["straight", "rotated"])
@pytest.mark.parametrize("key", ["cameras", "coarse_cameras"])
def test_sizes_equal_those_of_python(tmp_path: Path, key: str, rotation: Quaternion) -> None:
    center, scale, axes = MODEL_FRAME.center, MODEL_FRAME.scale, rotation_matrix(rotation)
    cameras = shift_cameras(ring(9, radius=6.0, target=(0, 0, 0), width=50, height=40), np.array(center))
    provenance = provenance_of(cameras, key, background_stride=3)
    positions = (np.random.default_rng(0).normal(size=(3000, 3)) * np.logspace(-1, 2, 3000)[:, None]).astype(np.float32)

    found = sample_in_node(tmp_path, provenance, positions, focals=(40.0, 170.0), rotation=rotation)

    photos = PhotoCameras.from_provenance(json.loads(json.dumps(provenance)))
    np.testing.assert_allclose(found["sizes"], photos.pixel_sizes(positions, center, scale, axes), rtol=1e-5)
    assert found["spacing"] == pytest.approx(photos.background_spacing, rel=1e-12)
