from dataclasses import replace

import numpy as np
import pytest
from scenes import camera_at
from scipy.spatial.transform import Rotation

from hyrfpack.model import Frame
from hyrfpack.rotations import quaternion_from_matrix
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats, concatenate, normalize_quats

UNIT_FRAME = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))


def random_splats(count: int, degree: int = 3, seed: int = 0) -> Splats:
    generator = np.random.default_rng(seed)
    return Splats(
        generator.uniform(-0.6, 0.6, (count, 3)),
        generator.uniform(0.02, 0.2, (count, 3)),
        normalize_quats(generator.normal(size=(count, 4))),
        generator.uniform(0.2, 1, count),
        generator.normal(0, 0.3, (count, (degree + 1) ** 2, 3)),
    )


@pytest.mark.parametrize(
    "change",
    [
        {"scales": np.ones((2, 3))},
        {"scales": -np.ones((3, 3))},
        {"opacities": np.full(3, 1.1)},
        {"positions": np.full((3, 3), np.nan)},
        {"scales": np.full((3, 3), 1e39)},  # exceeds float32
        {"harmonics": np.zeros((3, 0, 3))},
        {"harmonics": np.zeros((3, 5, 3))},
        {"harmonics": np.zeros((3, 25, 3))},
    ],
)
def test_invalid_values_and_shapes_are_refused(change):
    with pytest.raises(ValueError):
        replace(random_splats(3), **change)


def test_positions_are_float64_and_everything_else_float32():
    splats = random_splats(3)
    assert splats.positions.dtype == np.float64
    assert {splats.scales.dtype, splats.quats.dtype, splats.opacities.dtype, splats.harmonics.dtype} == {
        np.dtype(np.float32)
    }


def test_concatenate_joins_parts_of_different_degrees():
    splats = random_splats(5)
    low = splats[:2].with_degree(1)
    whole = concatenate((low, splats[np.arange(2, 5)]))
    assert len(whole) == 5 and whole.degree == 3
    assert np.array_equal(whole.positions, splats.positions)
    assert np.array_equal(whole.harmonics[:2, :4], splats.harmonics[:2, :4]) and not whole.harmonics[:2, 4:].any()


def test_empty_splats_can_be_rotated():
    nothing = random_splats(4)[:0]
    assert len(nothing.rotated(np.diag([1.0, -1, -1]))) == 0 and nothing.degree == 3


@pytest.mark.parametrize("turn", [*Rotation.random(8, rng=0).as_matrix(), np.eye(3), np.diag([-1.0, -1, 1])])
def test_quaternions_of_matrices_equal_those_of_scipy(turn):
    x, y, z, w = Rotation.from_matrix(turn).as_quat(canonical=True)
    assert np.allclose(quaternion_from_matrix(turn), (w, x, y, z), atol=1e-7)


def test_zero_quaternions_become_the_identity():
    quats = normalize_quats([[0, 0, 0, 0], [-2, 0, 0, 0], [0, 0, 3, 4]])
    assert np.allclose(quats, [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0.6, 0.8]])


def test_rotating_splats_and_camera_together_changes_no_picture():
    splats, camera = random_splats(30), camera_at((0.3, -3.0, 0.7))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(rng=3).as_matrix()
    sizes = camera.width, camera.height, *camera.intrinsics
    turned = Camera(*sizes, camera.camera_from_world @ turn.T)
    before = draw(Drawable.from_splats(splats, UNIT_FRAME), camera).rgb
    after = draw(Drawable.from_splats(splats.rotated(turn[:3, :3]), UNIT_FRAME), turned).rgb
    assert before.max() > 0.3 and (before - after).abs().max() < 1e-5
