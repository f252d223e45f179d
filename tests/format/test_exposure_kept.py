"""Whatever is done with a model or its file, the exposure map goes along; `describe` and `info` tell of it."""

from __future__ import annotations

import copy
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from exposures import maps_equal, random_map
from scenes import ball_points, small_model

from hyrfpack.compress import plan
from hyrfpack.compress.plan import replan_moved
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import decode_model, describe_file, load_model, repack, save_model
from hyrfpack.format.container import MINOR_VERSION, read_container, write_container
from hyrfpack.format.min_file_size import check_target_bytes, min_file_bytes
from hyrfpack.model import HybridModel
from tools.safety.synthetic_encoding import encode, quantize_with_drawn_sensitivity

EXPOSURE = random_map(11, 17)
EXPOSURE_BYTES = 84 + 12 * 17


def exposed_model(count: int = 50) -> HybridModel:
    model = small_model(ball_points(count)[0])
    model.exposure = EXPOSURE
    return model


@pytest.fixture
def raw(tmp_path) -> Path:
    path = tmp_path / "raw.hyrf"
    save_model(exposed_model(), path)
    return path


@pytest.fixture(scope="module")
def in_layers() -> bytes:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MAX_LAYERS", 100)
        data = encode(exposed_model(600), "compact", prune=False)
    assert "POS1" in read_container(data)
    return data


def placed_last(data: bytes) -> bytes:
    """The same sections, with the exposure map after all others."""
    sections = sorted(read_container(data).sections, key=lambda section: section.type == "EXPO")
    return write_container(sections, minor=MINOR_VERSION)


def damaged(data: bytes) -> bytes:
    """The file with an exposure map of zeros, and right checksums."""
    sections = read_container(data).sections
    zeros = bytes(EXPOSURE_BYTES)
    return write_container(
        [dataclasses.replace(part, data=zeros) if part.type == "EXPO" else part for part in sections],
        minor=MINOR_VERSION,
    )


# --- models ---


def test_a_copy_of_a_model_has_a_map_of_its_own():
    model = exposed_model()
    model.exposure.predict_log_gains(np.zeros(3), np.array([0.0, 0.0, 1.0]))  # which it keeps something of
    copied = copy.deepcopy(model)

    assert maps_equal(copied.exposure, EXPOSURE) and copied.exposure is not model.exposure


@pytest.mark.parametrize("target", ["cpu", "meta", torch.float64])
def test_a_model_that_is_moved_keeps_its_map(target):
    assert maps_equal(exposed_model().to(target).exposure, EXPOSURE)


def test_a_planned_model_keeps_its_map_also_after_its_gaussians_have_moved():
    model = exposed_model()
    decided = quantize_with_drawn_sensitivity(model).plan
    planned = decided.apply(model)

    assert maps_equal(planned.exposure, EXPOSURE)
    assert maps_equal(replan_moved(decided, planned)[1].exposure, EXPOSURE)


# --- files ---


def test_repacking_from_profile_to_profile_keeps_the_map(raw, tmp_path):
    (tmp_path / "compact.hyrf").write_bytes(encode(exposed_model(), "compact"))
    repack(raw, tmp_path / "paper.hyrf", "paper")
    for name in ("compact", "paper"):
        repack(tmp_path / f"{name}.hyrf", tmp_path / "again.hyrf", "raw")
        assert maps_equal(load_model(tmp_path / "again.hyrf").exposure, EXPOSURE)


@pytest.mark.parametrize("profile", ["raw", "paper"])
def test_compress_and_decompress_keep_the_map(profile, raw, tmp_path):
    succeeded("compress", raw, "-o", tmp_path / "packed.hyrf", "--profile", profile)
    succeeded("decompress", tmp_path / "packed.hyrf", "-o", tmp_path / "unpacked.hyrf")

    assert maps_equal(load_model(tmp_path / "unpacked.hyrf").exposure, EXPOSURE)


def test_the_start_of_a_file_that_makes_a_model_has_the_map(in_layers, tmp_path):
    first = in_layers[: read_container(in_layers).entries["RTAB"].end]
    (tmp_path / "first.hyrf").write_bytes(first)

    assert maps_equal(decode_model(first, fraction=1.0).exposure, EXPOSURE)
    model = load_model(tmp_path / "first.hyrf", fraction=1.0)
    assert maps_equal(model.exposure, EXPOSURE) and len(model) < 600
    assert maps_equal(decode_model(in_layers, fraction=1.0).exposure, EXPOSURE)


def test_the_start_of_a_file_without_the_bytes_of_the_map_is_a_model_without_one(in_layers, tmp_path):
    data = placed_last(in_layers)
    (tmp_path / "whole.hyrf").write_bytes(data)
    (tmp_path / "cut.hyrf").write_bytes(data[:-1])

    assert maps_equal(decode_model(data).exposure, EXPOSURE)
    model = load_model(tmp_path / "cut.hyrf", fraction=1.0)
    assert model.exposure is None and len(model) == len(decode_model(data))
    assert describe_file(tmp_path / "cut.hyrf", fraction=1.0)["exposure"] is None
    assert describe_file(tmp_path / "whole.hyrf")["exposure"]["centers"] == 17


def test_bytes_of_parameters_do_not_count_the_map(tmp_path):
    model = exposed_model()
    report = save_model(model, tmp_path / "raw.hyrf")

    assert report.bytes_before == 4 * sum(parameter.numel() for parameter in model.parameters())


def test_the_smallest_file_counts_the_map():
    with_map = min_file_bytes(exposure=EXPOSURE)

    assert with_map == min_file_bytes() + 40 + (EXPOSURE_BYTES + 7) // 8 * 8
    check_target_bytes(with_map, exposure=EXPOSURE)
    with pytest.raises(HyrfError, match="below the smallest possible file"):
        check_target_bytes(with_map - 1, exposure=EXPOSURE)


# --- what is told of them ---


def stops(log_gains: np.ndarray) -> float:
    """A log gain of ln(2) * 2 / 2.2 is one stop."""
    return float(log_gains.astype(float).mean()) / (np.log(2) * 2 / 2.2)


def test_describe_tells_of_the_map_without_torch_and_numpy(raw):
    program = (
        "import sys, json; from hyrfpack.format import describe; facts = describe(sys.argv[1]);"
        "print(json.dumps([facts['exposure'], [name for name in ('torch', 'numpy') if name in sys.modules]]))"
    )
    output = subprocess.run([sys.executable, "-c", program, str(raw)], capture_output=True, text=True, check=True)
    exposure, imported = json.loads(output.stdout)

    assert imported == []
    assert exposure == {"centers": 17, "stops": pytest.approx([stops(limits) for limits in EXPOSURE.limits])}


def test_describe_reads_the_map_and_no_parameters(raw):
    entries = read_container(raw.read_bytes()).entries
    raw.write_bytes(raw.read_bytes()[: entries["EXPO"].end])

    assert describe_file(raw, fraction=1.0)["exposure"]["centers"] == 17


def test_describe_of_a_file_without_a_map_says_none(tmp_path):
    save_model(small_model(ball_points(5)[0]), tmp_path / "plain.hyrf")

    assert describe_file(tmp_path / "plain.hyrf")["exposure"] is None
    assert "exposure" not in succeeded("info", tmp_path / "plain.hyrf").stdout


def test_info_tells_of_the_map(raw):
    lowest, highest = (stops(limits) for limits in EXPOSURE.limits)

    assert json.loads(succeeded("info", raw, "--json").stdout)["exposure"]["centers"] == 17
    lines = succeeded("info", raw).stdout.splitlines()
    assert f"exposure map        17 centres, {lowest:+.2f} to {highest:+.2f} stops" in [line.strip() for line in lines]
    (section,) = [line.split() for line in lines if line.startswith("EXPO exposure map")]
    assert section[3:5] == [str(EXPOSURE_BYTES)] * 2 and len(section) == 7  # bits/number is left out


def test_a_damaged_map_is_one_sentence_that_names_file_and_section(raw):
    raw.write_bytes(damaged(raw.read_bytes()))

    with pytest.raises(HyrfFormatError, match="raw.hyrf: section 'EXPO': .* damaged"):
        describe_file(raw)
    with pytest.raises(HyrfFormatError, match="raw.hyrf: section 'EXPO': .* damaged"):
        load_model(raw)
    assert "section 'EXPO'" in refused("info", raw)
