"""Cells tile the ground, and every photo and point belongs to a block."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import look_at

from hyrfpack.blocks.cells import divide_ground
from hyrfpack.blocks.plan import MIN_BLOCK_PHOTOS, MIN_PHOTO_SHARE, parse_grid, plan_blocks
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Camera, Picture, Scene, View


def load_nothing() -> Picture:
    raise AssertionError("a plan reads no photo")


def survey(
    seed: int = 0, photos: int = 24, points: int = 200, *, tracks: bool = True, reach: float = 3.0, turn: float = 0.0
) -> Scene:
    """Return photos of flat ground of 20 x 8 units from a height of 5, each of which shows the points within `reach`.

    The ground is turned by `turn` radians about the vertical axis and tilted, so that it follows no axis of the world.
    """
    generator = np.random.default_rng(seed)
    ground = generator.uniform((-10, -4, 0), (10, 4, 0.3), (points, 3))
    stands = generator.uniform((-10, -4, 5), (10, 4, 5), (photos, 3))
    rotation = look_at((0, 0, 0), (1, 2, 3))[:3, :3] @ look_at((0, 0, 0), (np.cos(turn), np.sin(turn), 0))[:3, :3]
    views, seen = [], {}
    for number, stand in enumerate(stands):
        pose = look_at(stand, stand - (0, 0, 1), up=(0, 1, 0))
        pose[:3, :3] = pose[:3, :3] @ rotation.T
        name = f"{number:03d}.jpg"
        views.append(View(name, Camera(40, 40, 30.0, 30.0, 20.0, 20.0, pose), load_nothing))
        seen[name] = np.flatnonzero(np.linalg.norm((ground - stand)[:, :2], axis=1) < reach)
    return Scene(
        "survey", "colmap", views, [], ground @ rotation.T, np.full((points, 3), 0.5), tracks=seen if tracks else {}
    )


surveys = st.builds(
    survey,
    seed=st.integers(0, 2**32),
    photos=st.integers(24, 40),
    points=st.integers(1, 200),
    tracks=st.booleans(),
    reach=st.floats(0.1, 20),
    turn=st.floats(0, 6),
)
grids = st.tuples(st.integers(1, 3), st.integers(1, 2))


@examples(40)
@given(surveys, grids, st.integers(0, 2**32))
def test_cores_tile_space_and_every_photo_and_point_is_in_a_block(scene, grid, seed):
    plan = plan_blocks(scene, *grid)
    anywhere = np.random.default_rng(seed).normal(size=(50, 3)) * 10.0 ** np.arange(-1, 4).repeat(10)[:, None]
    for places in (anywhere, scene.points):
        assert (sum(plan.core_mask(block, places).astype(int) for block in plan.blocks) == 1).all()
    assert {view.name for block in plan.blocks for view in block.photos} == {view.name for view in scene.train}
    for block in plan.blocks:
        cut = block.cut(scene)
        held = {tuple(point) for point in cut.points.tolist()}
        assert {tuple(point) for point in scene.points[plan.core_mask(block, scene.points)].tolist()} <= held
        assert len(cut.train) >= MIN_BLOCK_PHOTOS and not cut.test
        for view in cut.train:
            seen, kept = scene.points[scene.shown_points(view)], cut.points[cut.shown_points(view)]
            assert np.array_equal(seen, kept)
    assert sorted(cell for block in plan.blocks for cell in block.cells) == list(range(plan.cells.count))


@examples(20)
@given(surveys, grids)
def test_a_plan_is_deterministic_and_puts_the_largest_block_first(scene, grid):
    plans = [plan_blocks(scene, *grid) for _ in range(2)]
    first, second = (
        [(block.name, block.cells, block.photos, block.point_mask.tolist()) for block in plan.blocks] for plan in plans
    )
    assert first == second
    sizes = [len(block.photos) for block in plans[0].blocks]
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_columns_follow_the_longer_side_and_have_equal_shares_of_points_and_cameras(turn):
    scene = survey(photos=40, points=400, turn=turn)
    cells = divide_ground(scene, 4, 2)
    along = scene.points @ cells.axes[0]
    assert np.ptp(along) > 2 * np.ptp(scene.points @ cells.axes[1])
    cameras = np.array([view.camera.position for view in scene.train])
    shares = np.bincount(cells.find(scene.points), minlength=8) / 400
    shares += np.bincount(cells.find(cameras), minlength=8) / 40
    assert shares / 2 == pytest.approx(np.full(8, 1 / 8), abs=1 / 40 + 1 / 400)  # one of each at each border


def test_a_photo_belongs_to_each_block_that_holds_a_tenth_of_what_it_shows():
    scene = survey(photos=40, points=400)
    plan = plan_blocks(scene, 2, 2)
    missed = 0
    for view in scene.train:
        seen = scene.points[scene.tracks[view.name]]
        for block in plan.blocks:
            is_member = view in block.photos
            assert is_member or plan.core_mask(block, seen).mean() < MIN_PHOTO_SHARE
            missed += not is_member
    assert missed > 30  # of 160 pairs, so that the claim is not true of all


def test_a_block_without_photos_is_merged_into_its_neighbour():
    """Half of the points lie far away, where no photo shows them: they fill the last cell."""
    scene = survey(photos=80, points=400)
    along = divide_ground(scene, 2, 1).axes[0]
    photos = [view for view in scene.train if view.camera.position @ along < -3]
    unseen = np.setdiff1d(np.arange(400), np.concatenate([scene.tracks[view.name] for view in photos]))
    scene.points[unseen] += 100 * along
    plan = plan_blocks(dataclasses.replace(scene, train=photos), 5, 1)
    assert sorted(block.cells for block in plan.blocks) == [(0,), (1,), (2,), (3, 4)]


@pytest.mark.parametrize("text", ["2", "2x", "0x2", "2x-1", "2X2", "a x b", "2x2x2", "", "1e1x2", "65x1", "9999x9999"])
def test_a_grid_that_makes_no_sense_is_one_clear_error(text):
    with pytest.raises(HyrfError, match="blocks") as caught:
        parse_grid(text)
    assert "`blocks" in caught.value.fix


@pytest.mark.parametrize(
    ("scene", "problem"),
    [
        (survey(photos=15), "15 training photos are too few for 2x2 blocks; use at most 3 blocks"),
        (survey(points=0), "there are no points"),
    ],
    ids=["too few photos", "no points"],
)
def test_a_scene_that_cannot_be_divided_is_one_clear_error(scene, problem):
    with pytest.raises(HyrfError, match=problem):
        plan_blocks(scene, 2, 2)
