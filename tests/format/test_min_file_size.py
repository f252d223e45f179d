"""The bound on the file size: no packed file is smaller, and the smallest ones come close to it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack import compress_model
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.compress.distortion import DISTORTION_RANGE
from hyrfpack.config.compress import CompressConfig
from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.min_file_size import check_target_bytes, min_file_bytes
from hyrfpack.train import TrainConfig, train_model

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def tiny_file_and_provenance(tmp_path_factory):
    """Pack a model of few Gaussians as coarsely as possible; return its file and the provenance in it."""
    folder = tmp_path_factory.mktemp("tiny")
    scene = ball_scene(6)
    train_model(scene, folder, TrainConfig(steps=3, max_gaussians=20), context=QUIET_CONTEXT)
    compress_model(
        folder / "model.hyrf", folder / "small.hyrf", CompressConfig(distortion=DISTORTION_RANGE[1]), data=scene
    )
    model, provenance = load_with_provenance(folder / "model.hyrf")
    return folder / "small.hyrf", quantized_provenance(provenance, model.config.frame.scale)


def test_the_smallest_packed_file_is_slightly_above_the_bound(tiny_file_and_provenance):
    packed, provenance = tiny_file_and_provenance
    assert min_file_bytes(provenance) < packed.stat().st_size < 1.5 * min_file_bytes(provenance)


def test_without_a_provenance_the_bound_is_lower(tiny_file_and_provenance):
    assert min_file_bytes() < min_file_bytes(tiny_file_and_provenance[1])


@pytest.mark.parametrize(
    ("size", "remedy"), [(10, "did you mean 10MB?"), (99, "99MB?"), (100, "100kB?"), (500, "did you mean 500kB?")]
)
def test_a_target_below_the_bound_is_refused_with_a_hint_at_a_missing_unit(size, remedy):
    with pytest.raises(HyrfError, match=rf"of {size} bytes is below the smallest possible file, about \d") as caught:
        check_target_bytes(size)
    assert str(caught.value).endswith(remedy)


def test_an_exact_target_below_the_bound_is_refused_without_a_hint(tiny_file_and_provenance):
    with pytest.raises(HyrfError, match="of 1,000 bytes .*; use a `target_bytes` of at least "):
        check_target_bytes(1_000, tiny_file_and_provenance[1])


def test_a_target_at_the_bound_is_allowed():
    check_target_bytes(min_file_bytes())
    with pytest.raises(HyrfError):
        check_target_bytes(min_file_bytes() - 1)


def test_training_for_an_impossible_file_size_is_refused_before_anything_is_written(tiny_file_and_provenance, tmp_path):
    scene = dataclasses.replace(ball_scene(6), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.float32))
    with pytest.raises(HyrfError, match="did you mean 10MB"):
        train_model(scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=10), context=QUIET_CONTEXT)
    assert not (tmp_path / "run").exists()
    with pytest.raises(HyrfError, match="below the smallest possible file"):  # the file would contain cameras too
        train_model(
            scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=min_file_bytes() + 1), context=QUIET_CONTEXT
        )
