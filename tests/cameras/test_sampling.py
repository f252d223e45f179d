"""The sampling rate of photos at points, and cameras that represent it."""

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball_scene, camera_at, ring, shift_cameras
from scipy.spatial.transform import Rotation

from hyrfpack.cameras.capture import MIN_COARSE_CAMERAS, provenance_cameras, quantized_provenance, scene_provenance
from hyrfpack.cameras.sampling import (
    COARSE_RATE_RATIO,
    DEFAULT_BACKGROUND_STRIDE,
    MAX_BACKGROUND_STRIDE,
    MAX_PIXEL_SIZE,
    MAX_REPRESENTED_RATIO,
    MAX_SAMPLING_CAMERAS,
    REPRESENTED_SHARE,
    PhotoCameras,
    select_representative_cameras,
)
from hyrfpack.scene import Camera

FRAME_CENTER, FRAME_SCALE = (10.0, -20.0, 5.0), 4.0


def along_z(z: float, focal: float = 50.0) -> Camera:
    """Return a camera of 100 x 80 pixels that looks along +z from (0, 0, z), in local units."""
    pose = np.eye(4)
    pose[:3, 3] = -(np.array(FRAME_CENTER) + FRAME_SCALE * np.array([0, 0, z]))
    return Camera(100, 80, focal, 0.8 * focal, 50.0, 40.0, pose)


def pixel_sizes(cameras: list[Camera], points: list[list[float]], rate_ratio: float = 1.0) -> list[float]:
    sizes = PhotoCameras(cameras, rate_ratio, 2).pixel_sizes(np.array(points, np.float32), FRAME_CENTER, FRAME_SCALE)
    assert sizes is not None and sizes.dtype == np.float32
    return sizes.tolist()


def test_the_photo_with_the_highest_rate_counts():
    cameras = [along_z(-2.0), along_z(-1.0), along_z(-4.0, focal=300.0)]
    assert pixel_sizes(cameras, [[0, 0, 0], [0, 0, 8.0]]) == pytest.approx([1 / 75, 12 / 300], rel=1e-6)


def test_a_photo_sees_points_up_to_15_percent_outside_its_picture():
    near, far = along_z(-1.0), along_z(-3.0)
    edge = 1.3  # the half-width of the picture at depth 1, enlarged by 30 %, in local units
    found = pixel_sizes([near, far], [[0.999 * edge, 0, 0], [1.001 * edge, 0, 0]])
    assert found == pytest.approx([1 / 50, 3 / 50], rel=1e-6)


def test_a_point_that_no_photo_sees_takes_the_highest_rate_by_distance():
    cameras = [along_z(1.0), along_z(4.0, focal=100.0)]
    assert pixel_sizes(cameras, [[0, 3.0, -3.0]]) == pytest.approx([min(5 / 50, math.hypot(3, 7) / 100)], rel=1e-6)


def test_points_in_a_rotated_frame_have_the_sizes_of_the_same_points_in_the_world():
    axes = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    points = np.random.default_rng(1).normal(size=(500, 3))
    photos = PhotoCameras([along_z(-2.0), along_z(-1.0, focal=100.0)], 1.0, 2)

    straight, rotated = (
        photos.pixel_sizes(local.astype(np.float32), FRAME_CENTER, FRAME_SCALE, turn)
        for local, turn in ((points, np.eye(3)), (points @ axes, axes))
    )

    assert len(set(np.sign(points[:, 2] + 2))) == 2  # some are behind the cameras
    np.testing.assert_allclose(rotated, straight, rtol=1e-5)


def test_sizes_are_divided_by_the_rate_ratio():
    exact, fewer = (pixel_sizes([along_z(-2.0)], [[0, 0, 0]], ratio) for ratio in (1.0, 2.5))
    assert fewer == pytest.approx([exact[0] / 2.5], rel=1e-6)


def test_many_points_have_the_sizes_that_single_ones_have():
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    found = pixel_sizes([along_z(-2.0), along_z(-1.0)], points.tolist())
    few = [0, 8191, 8192, 19_999]
    assert [found[k] for k in few] == pixel_sizes([along_z(-2.0), along_z(-1.0)], points[few].tolist())


def test_without_cameras_nothing_is_known():
    photos = PhotoCameras.from_provenance({})
    assert photos.pixel_sizes(np.zeros((3, 3), np.float32), FRAME_CENTER, FRAME_SCALE) is None
    assert photos.background_spacing == 0


def test_a_provenance_is_read_back():
    stored = json.loads(json.dumps({"cameras": provenance_cameras([along_z(-2.0), along_z(1.0, 90.0)])}))
    photos = PhotoCameras.from_provenance(stored)
    assert provenance_cameras(photos.cameras) == stored["cameras"] and photos.rate_ratio == 1
    assert photos.background_spacing == pytest.approx(DEFAULT_BACKGROUND_STRIDE / 90)
    assert PhotoCameras.from_provenance({**stored, "background_stride": 7}).background_spacing == pytest.approx(7 / 90)


FORGED_CAMERAS = [[32, 32, value, 1, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0] for value in (0, "700", True, None)]


@pytest.mark.parametrize("cameras", [7, [[1, 2, 3]], *([camera] for camera in FORGED_CAMERAS), {"a": 1}, None, "none"])
def test_invalid_cameras_count_as_missing(cameras):
    coarse = provenance_cameras([along_z(-2.0)])
    assert PhotoCameras.from_provenance({"cameras": cameras}).cameras == ()
    photos = PhotoCameras.from_provenance({"cameras": cameras, "coarse_cameras": coarse})
    assert len(photos.cameras) == 1 and photos.rate_ratio == COARSE_RATE_RATIO


@pytest.mark.parametrize("ratio", [0, 0.99, -2, True, "3", None, math.nan, math.inf, 1001, 10**400, [2]])
def test_an_invalid_rate_ratio_counts_as_missing(ratio):
    cameras = provenance_cameras([along_z(-2.0)])
    assert PhotoCameras.from_provenance({"cameras": cameras, "rate_ratio": ratio}).rate_ratio == 1
    assert (
        PhotoCameras.from_provenance({"coarse_cameras": cameras, "rate_ratio": ratio}).rate_ratio == COARSE_RATE_RATIO
    )


@pytest.mark.parametrize("key", ["cameras", "coarse_cameras"])
@pytest.mark.parametrize("ratio", [1, 1.25, 1000])
def test_a_stored_rate_ratio_counts_for_all_cameras(key, ratio):
    stored = {key: provenance_cameras([along_z(-2.0)]), "rate_ratio": ratio}
    assert PhotoCameras.from_provenance(stored).rate_ratio == ratio


@pytest.mark.parametrize("stride", [0, -1, 2.0, True, "3", None, MAX_BACKGROUND_STRIDE + 1, 10**30])
def test_an_invalid_stride_counts_as_missing(stride):
    assert PhotoCameras.from_provenance({"background_stride": stride}).background_stride == DEFAULT_BACKGROUND_STRIDE


def test_of_a_long_list_only_the_first_cameras_count():
    stored = provenance_cameras([along_z(-2.0), along_z(1.0, 90.0)])
    photos = PhotoCameras.from_provenance({"cameras": [stored[0]] * MAX_SAMPLING_CAMERAS + [stored[1]] * 10_000})
    assert len(photos.cameras) == MAX_SAMPLING_CAMERAS and photos.background_spacing == pytest.approx(2 / 50)


@given(
    st.floats(1e-30, 1e30),
    st.floats(1e-30, 1e30),
    st.lists(st.floats(-1e30, 1e30), min_size=3, max_size=3),
    st.floats(1e-6, 1e6),
)
def test_forged_cameras_give_finite_sizes_and_no_warning(fx, fy, translation, scale):
    pose = np.concatenate([np.eye(3), np.array(translation)[:, None]], axis=1)
    camera = [32, 32, fx, fy, 16, 16, *pose.ravel().tolist()]
    photos = PhotoCameras.from_provenance({"cameras": [camera] * 20})
    points = np.random.default_rng(0).normal(size=(50, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sizes = photos.pixel_sizes(points.astype(np.float32), (0, 0, 0), scale)
        chosen, ratio = select_representative_cameras(photos.cameras, points, scale, 14, 16)
    assert sizes is not None and ((sizes >= 0) & (sizes <= MAX_PIXEL_SIZE)).all() and 14 <= len(chosen) <= 16
    assert 1 <= ratio <= 1000.1


def test_representative_cameras_include_the_only_close_up():
    around = ring(30, radius=6.0)
    close_up = camera_at((0.5, 0, 0), (0, 0, 0))
    cameras = [*around[:17], close_up, *around[17:]]
    points = np.random.default_rng(1).normal(scale=0.1, size=(500, 3))
    chosen, ratio = select_representative_cameras(cameras, points, 1.0, 4, 30)
    assert (
        ratio <= MAX_REPRESENTED_RATIO
        and len(chosen) == 4
        and chosen[0] is cameras[0]
        and any(camera is close_up for camera in chosen)
    )
    assert [cameras.index(camera) for camera in chosen] == sorted(cameras.index(camera) for camera in chosen)


def test_cameras_beside_each_other_do_not_represent_a_scene():
    """Two groups of cameras look away from each other; two cameras must show both groups' points."""
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    forward = [camera_at((0.1 * k, 0, 0), (5, 0, 0)) for k in range(9)]
    backward = [replace(camera, camera_from_world=back @ camera.camera_from_world) for camera in forward[:2]]
    points = np.concatenate([np.array([[3.0, 0, 0]] * 50), np.array([[-3.0, 0, 0]] * 50)])
    chosen, _ = select_representative_cameras([*forward, *backward], points, 1.0, 2, 2)
    sizes = PhotoCameras(chosen, 1.0, 2).pixel_sizes(points.astype(np.float32), (0, 0, 0), 1.0)
    assert sizes is not None
    focal = max(forward[0].fx, forward[0].fy)
    assert sizes[0] == pytest.approx(3 / focal, rel=1e-5) and sizes[-1] == pytest.approx(3 / focal, rel=1e-5)


def test_packed_files_keep_representative_cameras():
    cameras = [*ring(30, radius=6.0), camera_at((0.5, 0, 0), (0, 0, 0))]
    points = np.random.default_rng(1).normal(scale=0.1, size=(500, 3))
    kept = quantized_provenance({"cameras": provenance_cameras(cameras)}, 1.0, points)
    every = PhotoCameras(cameras, 1.0, 2).pixel_sizes(points.astype(np.float32), (0, 0, 0), 1.0)
    found = PhotoCameras.from_provenance(kept).pixel_sizes(points.astype(np.float32), (0, 0, 0), 1.0)
    np.testing.assert_allclose(found * COARSE_RATE_RATIO, every, rtol=0.02)


def walk_through(count: int) -> tuple[list[Camera], np.ndarray]:
    """Return cameras along a street that look sideways, and points on its wall, which only the nearest cameras show."""
    cameras = [camera_at((2.0 * k, 0, 0), (2.0 * k, 1, 0)) for k in range(count)]
    rng = np.random.default_rng(2)
    wall = [rng.uniform(-1, 2 * count, 3000), rng.uniform(1, 3, 3000), rng.uniform(-0.5, 0.5, 3000)]
    return cameras, np.stack(wall, axis=1)


def sizes_of(photos: PhotoCameras, points: np.ndarray, center: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    sizes = photos.pixel_sizes((points - center).astype(np.float32), center, 1.0)
    assert sizes is not None
    return sizes


def test_files_of_long_walks_keep_more_cameras():
    cameras, points = walk_through(60)
    kept = json.loads(json.dumps(quantized_provenance({"cameras": provenance_cameras(cameras)}, 1.0, points)))
    found, every = sizes_of(PhotoCameras.from_provenance(kept), points), sizes_of(PhotoCameras(cameras, 1.0, 2), points)
    assert MIN_COARSE_CAMERAS < len(kept["coarse_cameras"]) < len(cameras)
    assert (found <= 1.01 * every).mean() >= REPRESENTED_SHARE - 0.02  # they were selected by some of the points
    assert quantized_provenance(kept, 1.0, points) == kept


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 100.0)], ids=["near", "map coordinates"])
def test_where_no_allowed_number_of_cameras_represents_all_photos_their_rate_ratio_is_kept(origin):
    cameras, points = walk_through(1000)
    cameras, points = shift_cameras(cameras, np.array(origin)), points + origin
    views = [replace(view, camera=camera) for view, camera in zip(ball_scene(1).train * 1000, cameras, strict=True)]
    scene = replace(ball_scene(1), train=views, test=[], points=points)
    every = sizes_of(PhotoCameras(cameras, 1.0, 2), points, origin)

    raw = json.loads(json.dumps(scene_provenance(scene)))
    packed = json.loads(json.dumps(quantized_provenance(raw, 1.0, points)))

    for kept in (raw, packed):
        photos = PhotoCameras.from_provenance(kept)
        assert len(photos.cameras) <= MAX_SAMPLING_CAMERAS and photos.rate_ratio > MAX_REPRESENTED_RATIO
        assert (sizes_of(photos, points, origin) <= 1.01 * every).mean() >= REPRESENTED_SHARE - 0.02
