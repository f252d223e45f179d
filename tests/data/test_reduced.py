from __future__ import annotations

import numpy as np
import pytest

from hyrfpack.data import PictureCache
from hyrfpack.data.reduced import reduce_camera, reduce_picture, reduce_view
from hyrfpack.scene import Camera, Picture, View


def make_picture(height: int, width: int, *, alpha: bool = False, mask: bool = False, seed: int = 0) -> Picture:
    generator = np.random.default_rng(seed)
    return Picture(
        generator.integers(0, 256, (height, width, 3), dtype=np.uint8),
        generator.integers(0, 256, (height, width), dtype=np.uint8) if alpha else None,
        generator.random((height, width)) < 0.9 if mask else None,
    )


def mean_of_blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """Compute the means of whole blocks with a loop, in float64."""
    rows, columns = values.shape[0] // factor, values.shape[1] // factor
    return np.array(
        [
            [
                values[factor * y : factor * (y + 1), factor * x : factor * (x + 1)].astype(np.float64).mean((0, 1))
                for x in range(columns)
            ]
            for y in range(rows)
        ]
    )


@pytest.mark.parametrize(
    ("height", "width", "factor"), [(8, 12, 2), (9, 13, 4), (17, 8, 8), (3, 5, 3), (2, 2, 2), (40, 60, 17)]
)
def test_a_pixel_is_the_rounded_mean_of_its_block(height: int, width: int, factor: int) -> None:
    picture = make_picture(height, width)

    reduced = reduce_picture(picture, factor)

    expected = mean_of_blocks(picture.rgb, factor)
    assert reduced.rgb.dtype == np.uint8 and reduced.rgb.shape == expected.shape
    assert np.abs(reduced.rgb - expected).max() <= 0.5
    assert reduced.alpha is None and reduced.mask is None


def test_extreme_levels_do_not_overflow() -> None:
    white = Picture(np.full((34, 34, 3), 255, np.uint8), np.full((34, 34), 255, np.uint8))

    for picture in (white, Picture(white.rgb)):
        for factor in (8, 16, 17, 34):
            assert (reduce_picture(picture, factor).rgb == 255).all()
    assert (reduce_picture(white, 16).alpha == 255).all()


def test_composites_of_a_transparent_photo_are_means_of_composites() -> None:
    picture, background = make_picture(16, 24, alpha=True), np.array([0.9, 0.1, 0.4], np.float32)

    reduced = reduce_picture(picture, 4).composite(background)

    # Colours and alpha are each rounded to a byte.
    assert np.abs(reduced - mean_of_blocks(picture.composite(background), 4)).max() <= 1.1 / 255


def test_a_fully_transparent_block_stays_transparent() -> None:
    picture = Picture(np.full((4, 4, 3), 200, np.uint8), np.zeros((4, 4), np.uint8))

    reduced = reduce_picture(picture, 2)

    assert (reduced.alpha == 0).all() and (reduced.composite() == 0).all()


def test_a_block_with_a_masked_pixel_is_masked() -> None:
    mask = np.ones((6, 6), bool)
    mask[0, 1] = mask[5, 4] = False

    reduced = reduce_picture(Picture(np.zeros((6, 6, 3), np.uint8), None, mask), 3)

    np.testing.assert_array_equal(reduced.mask, [[False, True], [True, False]])


def test_a_point_projects_to_the_same_place_of_a_reduced_picture() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 3.0
    camera = Camera(101, 67, 90.0, 85.0, 49.0, 35.5, pose)
    points = np.random.default_rng(1).normal(size=(20, 3))

    reduced = reduce_camera(camera, 4)

    x, y, z = camera.project(points)
    small_x, small_y, small_z = reduced.project(points)
    assert (reduced.width, reduced.height) == (25, 16)
    np.testing.assert_allclose([small_x, small_y], [x / 4, y / 4])
    np.testing.assert_array_equal(small_z, z)


def test_a_reduced_view_is_decoded_once_and_does_not_keep_the_large_photo() -> None:
    loads = []

    def load() -> Picture:
        loads.append(1)
        return make_picture(16, 16)

    view, cache = View("a.png", Camera(16, 16, 9.0, 9.0, 8.0, 8.0, np.eye(4)), load), PictureCache(10_000)

    pictures = [cache.get(reduce_view(view, 4)) for _ in range(3)]

    assert len(loads) == 1 and pictures[0] is pictures[2]
    assert cache.nbytes == pictures[0].nbytes == 4 * 4 * 3
    assert reduce_view(view, 4) == reduce_view(view, 4) != reduce_view(view, 2)


def test_a_factor_of_one_changes_nothing() -> None:
    view = View("a.png", Camera(2, 2, 1.0, 1.0, 1.0, 1.0, np.eye(4)), lambda: make_picture(2, 2))

    assert reduce_view(view, 1) is view
