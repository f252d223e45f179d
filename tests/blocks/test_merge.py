"""The models of blocks become parts of one file, at one exposure."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import ball_scene, small_model, visible_points_by_photo

from hyrfpack.blocks.exposure import align_log_gains
from hyrfpack.blocks.merge import merge_blocks
from hyrfpack.blocks.plan import plan_blocks
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format import describe_file, load_merged_model, load_model, save_model
from hyrfpack.model.merged import world_positions


@examples(30)
@given(st.integers(0, 2**32), st.integers(1, 5))
def test_exact_gains_of_blocks_that_share_photos_give_back_offsets_and_exposures(seed, blocks):
    generator = np.random.default_rng(seed)
    exposures = generator.normal(size=(6 * blocks, 3))
    exposures -= exposures.mean(axis=0)
    offsets = generator.normal(size=(blocks, 3))
    found, photos = align_log_gains(
        [
            {f"{n}": exposures[n] + offsets[block] for n in range(max(0, 6 * block - 2), 6 * block + 6)}
            for block in range(blocks)
        ]
    )
    assert found == pytest.approx(offsets, abs=1e-9)
    assert np.stack([photos[f"{n}"] for n in range(len(exposures))]) == pytest.approx(exposures, abs=1e-9)


def test_noisy_gains_are_aligned_by_least_squares():
    """The solution is that of the whole system, with one unknown for each block and each photo."""
    generator = np.random.default_rng(3)
    gains = [{f"{n}": generator.normal(size=3) for n in generator.permutation(8)[:5]} for _ in range(3)]
    names = sorted(set().union(*gains))
    rows, right = [], []
    for block, photos in enumerate(gains):
        for name, gain in photos.items():
            rows.append(np.r_[np.eye(3)[block], np.eye(len(names))[names.index(name)]])
            right.append(gain)
    rows.append(np.r_[np.zeros(3), np.full(len(names), 1e3)])  # the mean of all photos is 0
    expected = np.linalg.lstsq(np.array(rows), np.array([*right, np.zeros(3)]), rcond=None)[0]
    offsets, exposures = align_log_gains(gains)
    assert offsets == pytest.approx(expected[:3], abs=1e-9)
    assert np.stack([exposures[name] for name in names]) == pytest.approx(expected[3:], abs=1e-9)


def test_blocks_that_share_no_photo_and_blocks_without_gains_are_left_as_they_are():
    gains = [{"a": np.ones(3), "b": -np.ones(3)}, {"c": np.zeros(3)}, {}]
    offsets, exposures = align_log_gains(gains)
    assert np.abs(offsets).max() < 1e-12
    assert {name: gain.tolist() for name, gain in exposures.items()} == {"a": [1] * 3, "b": [-1] * 3, "c": [0] * 3}
    assert align_log_gains([{}, {}])[0].tolist() == [[0.0] * 3] * 2


@pytest.fixture
def blocks(tmp_path):
    """A scene of two blocks, its plan, and a file with a model of the whole scene for each block."""
    scene = ball_scene(10, 200)
    scene = dataclasses.replace(scene, tracks=visible_points_by_photo(scene))
    plan = plan_blocks(scene, 2, 1)
    paths = [tmp_path / f"{block.name}.hyrf" for block in plan.blocks]
    positions = np.random.default_rng(0).normal(size=(80, 3))
    for number, path in enumerate(paths):
        model = small_model(positions, fields=0.5, seed=number, background=number == 1)
        save_model(model, path, provenance={"steps": number})
    return scene, plan, paths


def test_each_part_has_the_gaussians_in_the_cells_of_its_block(blocks, tmp_path):
    scene, plan, paths = blocks
    merged = merge_blocks(scene, plan, paths, [{}, {}], tmp_path / "all.hyrf", overwrite=False)
    model = load_merged_model(merged.file.file)
    assert len(plan.blocks) == 2 and sum(merged.kept) == len(model) == 80
    assert model.names == tuple(f"block {block.name}" for block in reversed(plan.blocks))
    for block, part, kept in zip(plan.blocks, reversed(model.parts), merged.kept, strict=True):
        assert plan.core_mask(block, world_positions(part)).all() and len(part) == kept
        assert part.exposure is None


def test_blocks_without_a_gaussian_in_their_cells_are_one_clear_error(blocks, tmp_path):
    scene, plan, paths = blocks
    for block, path in zip(plan.blocks, paths, strict=True):
        model = load_model(path)
        outside = ~plan.core_mask(block, world_positions(model))
        save_model(model.subset(torch.from_numpy(np.flatnonzero(outside))), path)
    with pytest.raises(HyrfTrainingError, match="no block has a Gaussian in its own cells; train with a larger budget"):
        merge_blocks(scene, plan, paths, [{}, {}], tmp_path / "all.hyrf", overwrite=False)
    assert not (tmp_path / "all.hyrf").exists()


def test_the_first_part_has_a_background_and_the_viewpoint_of_all_photos(blocks, tmp_path):
    scene, plan, paths = blocks
    merged = merge_blocks(scene, plan, paths, [{}, {}], tmp_path / "all.hyrf", overwrite=False)
    facts = describe_file(merged.file.file)
    assert facts["config"]["background"] and facts["provenance"]["steps"] == 1
    ring_center = np.mean([view.camera.position for view in scene.train], axis=0)
    assert facts["provenance"]["viewpoint"]["center"][:2] == pytest.approx(ring_center[:2], abs=1e-6)


def test_colours_of_blocks_are_brought_to_one_exposure(blocks, tmp_path):
    """A block whose gains are lower by d in shared photos was trained to be lighter by d, and becomes darker."""
    scene, plan, paths = blocks
    difference = np.array([0.5, -0.2, 0.1])
    exposures = {view.name: np.full(3, 0.1 * number) for number, view in enumerate(scene.train)}
    mean = np.mean(list(exposures.values()), axis=0)
    gains = [exposures, {name: gain - difference for name, gain in exposures.items()}]
    merged = merge_blocks(scene, plan, paths, gains, tmp_path / "all.hyrf", overwrite=False)
    plain = merge_blocks(scene, plan, paths, [{}, {}], tmp_path / "plain.hyrf", overwrite=False)
    viewpoint = torch.tensor([0.3, 0.2, 2.0])
    before, after = (
        [part.decode_colors(viewpoint).logit() for part in load_merged_model(each.file.file).parts]
        for each in (plain, merged)
    )
    for old, new, expected in zip(before, after, (mean - difference, mean), strict=True):
        assert (new - old).numpy() == pytest.approx(np.tile(expected, (len(old), 1)), abs=1e-5)
    first, second = load_merged_model(merged.file.file).parts
    camera = scene.train[3].camera
    assert first.exposure.predict_gains(first.config.frame.local_pose(camera)) == pytest.approx(
        second.exposure.predict_gains(second.config.frame.local_pose(camera))
    )
