"""The bound on the file size: no packed file is smaller, and the smallest ones come close to it."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack import compress_model
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.compress.distortion import DISTORTION_RANGE
from hyrfpack.config.compress import CompressConfig
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.min_file_size import check_target_bytes, min_file_bytes, min_merged_file_bytes
from hyrfpack.format.parts import encode_parts
from hyrfpack.train import TrainConfig, train_model

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("quick_calibration")]


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


def test_an_exact_target_below_the_bound_is_refused_with_the_bound(tiny_file_and_provenance):
    message = r"of 1,000 bytes .*; use a larger `target_bytes`; \d,\d{3} is a lower bound"
    with pytest.raises(HyrfError, match=message):
        check_target_bytes(1_000, tiny_file_and_provenance[1])


def test_a_target_at_the_bound_is_allowed():
    check_target_bytes(min_file_bytes())
    with pytest.raises(HyrfError):
        check_target_bytes(min_file_bytes() - 1)


def test_the_bound_of_a_merged_file_is_that_of_its_parts_together(tiny_file_and_provenance, tmp_path):
    packed, provenance = tiny_file_and_provenance
    parts = [("scene", provenance, None), ("chair", provenance, None)]
    merged = encode_parts([(name, packed.read_bytes()) for name, _, _ in parts])
    bound = min_merged_file_bytes(parts)
    assert len(merged) - bound == 2 * (packed.stat().st_size - min_file_bytes(provenance))
    (tmp_path / "merged.hyrf").write_bytes(merged)
    config = CompressConfig(target_bytes=bound - 1)
    with pytest.raises(HyrfError, match=f"below the smallest possible file, about {bound:,} bytes"):
        compress_model(tmp_path / "merged.hyrf", tmp_path / "out.hyrf", config, context=QUIET_CONTEXT)


def test_a_file_of_the_size_that_the_message_names_can_be_packed(tiny_file_and_provenance, tmp_path):
    source, target = tiny_file_and_provenance[0].with_name("model.hyrf"), tmp_path / "small.hyrf"
    bound = min_file_bytes(tiny_file_and_provenance[1])
    with pytest.raises(HyrfSizeError, match=r"use a `target_bytes` of at least [\d,]+, or") as caught:
        compress_model(source, target, CompressConfig(target_bytes=bound), context=QUIET_CONTEXT)
    named = int(re.search(r"at least ([\d,]+), or", caught.value.fix)[1].replace(",", ""))
    report = compress_model(source, target, CompressConfig(target_bytes=named), context=QUIET_CONTEXT)
    assert report.bytes_after <= named


def test_training_for_an_impossible_file_size_is_refused_before_anything_is_written(tiny_file_and_provenance, tmp_path):
    scene = dataclasses.replace(ball_scene(6), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.float32))
    with pytest.raises(HyrfError, match="did you mean 10MB"):
        train_model(scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=10), context=QUIET_CONTEXT)
    assert not (tmp_path / "run").exists()
    with pytest.raises(HyrfError, match="below the smallest possible file"):  # the file would contain cameras too
        train_model(
            scene, tmp_path / "run", TrainConfig(steps=3, target_bytes=min_file_bytes() + 1), context=QUIET_CONTEXT
        )
