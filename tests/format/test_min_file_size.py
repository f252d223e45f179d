"""The smallest possible file: nothing that packing writes is smaller, and packing comes near it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import ball_scene

from hyrfpack import compress_model
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.compress.distortion import DISTORTION_RANGE
from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.min_file_size import check_target_bytes, min_file_bytes
from hyrfpack.train import TrainConfig, train_model


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A model of few Gaussians, packed as coarsely as can be: its file and the provenance that this carries."""
    folder = tmp_path_factory.mktemp("tiny")
    scene = ball_scene(6)
    train_model(scene, folder, TrainConfig(steps=3, max_gaussians=20), quiet=True)
    compress_model(folder / "model.hyrf", folder / "small.hyrf", data=scene, distortion=DISTORTION_RANGE[1])
    model, provenance = load_with_provenance(folder / "model.hyrf")
    return folder / "small.hyrf", quantized_provenance(provenance, model.config.frame.scale)


def test_what_packing_reaches_is_above_the_bound_and_near_it(tiny):
    packed, provenance = tiny
    assert min_file_bytes(provenance) < packed.stat().st_size < 1.5 * min_file_bytes(provenance)


def test_without_a_provenance_the_bound_is_lower(tiny):
    assert min_file_bytes() < min_file_bytes(tiny[1])


@pytest.mark.parametrize(
    ("size", "remedy"), [(10, "did you mean 10MB?"), (99, "99MB?"), (100, "100kB?"), (500, "did you mean 500kB?")]
)
def test_a_size_below_the_bound_is_refused_with_the_unit_that_looks_forgotten(size, remedy):
    with pytest.raises(HyrfError, match=rf"of {size} bytes is below the smallest possible file, about \d") as caught:
        check_target_bytes(size)
    assert str(caught.value).endswith(remedy)


def test_a_size_with_all_its_digits_is_refused_without_a_guess(tiny):
    with pytest.raises(HyrfError, match="of 1,000 bytes .*; ask for more"):
        check_target_bytes(1_000, tiny[1])


def test_the_bound_itself_is_allowed():
    check_target_bytes(min_file_bytes())
    with pytest.raises(HyrfError):
        check_target_bytes(min_file_bytes() - 1)


def test_training_for_a_size_that_no_file_of_the_scene_can_have_is_refused_before_anything_is_written(tiny, tmp_path):
    scene = dataclasses.replace(ball_scene(6), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.float32))
    with pytest.raises(HyrfError, match="did you mean 10MB"):
        train_model(scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=10), quiet=True)
    assert not (tmp_path / "run").exists()
    with pytest.raises(HyrfError, match="below the smallest possible file"):  # which carries cameras, too
        train_model(scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=min_file_bytes() + 1), quiet=True)
