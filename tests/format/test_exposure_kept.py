"""Operations on models and files keep the exposure map, and `describe` and `info` report it."""

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

EXPOSURE_MAP = random_map(11, 17)
EXPOSURE_MAP_BYTES = 84 + 12 * 17


def model_with_map(count: int = 50) -> HybridModel:
    model = small_model(ball_points(count)[0])
    model.exposure = EXPOSURE_MAP
    return model


@pytest.fixture
def raw_file(tmp_path) -> Path:
    path = tmp_path / "raw.hyrf"
    save_model(model_with_map(), path)
    return path


@pytest.fixture(scope="module")
def layered_data() -> bytes:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MIN_LAYER_SHARE", 0.01)
        data = encode(model_with_map(600), "compact", prune=False)
    assert "POS1" in read_container(data)
    return data


def move_map_to_end(data: bytes) -> bytes:
    """Move the section of the exposure map behind all others."""
    sections = sorted(read_container(data).sections, key=lambda section: section.type == "EXPO")
    return write_container(sections, minor=MINOR_VERSION)


def replace_map_by_zeros(data: bytes) -> bytes:
    """Replace the bytes of the exposure map by zeros, with valid checksums."""
    sections = read_container(data).sections
    zeros = bytes(EXPOSURE_MAP_BYTES)
    return write_container(
        [dataclasses.replace(part, data=zeros) if part.type == "EXPO" else part for part in sections],
        minor=MINOR_VERSION,
    )


# --- models ---


def test_a_copy_of_a_model_has_its_own_map():
    model = model_with_map()
    model.exposure.predict_log_gains(np.zeros(3), np.array([0.0, 0.0, 1.0]))  # fills a cache of the map
    copied = copy.deepcopy(model)

    assert maps_equal(copied.exposure, EXPOSURE_MAP) and copied.exposure is not model.exposure


@pytest.mark.parametrize("target", ["cpu", "meta", torch.float64])
def test_to_keeps_the_map(target):
    assert maps_equal(model_with_map().to(target).exposure, EXPOSURE_MAP)


def test_planned_and_replanned_models_keep_their_map():
    model = model_with_map()
    decided = quantize_with_drawn_sensitivity(model).plan
    planned = decided.apply(model)

    assert maps_equal(planned.exposure, EXPOSURE_MAP)
    assert maps_equal(replan_moved(decided, planned)[1].exposure, EXPOSURE_MAP)


# --- files ---


def test_repack_keeps_the_map_in_every_profile(raw_file, tmp_path):
    (tmp_path / "compact.hyrf").write_bytes(encode(model_with_map(), "compact"))
    repack(raw_file, tmp_path / "paper.hyrf", "paper")
    for name in ("compact", "paper"):
        repack(tmp_path / f"{name}.hyrf", tmp_path / "again.hyrf", "raw")
        assert maps_equal(load_model(tmp_path / "again.hyrf").exposure, EXPOSURE_MAP)


@pytest.mark.parametrize("profile", ["raw", "paper"])
def test_compress_and_decompress_keep_the_map(profile, raw_file, tmp_path):
    succeeded("compress", raw_file, "-o", tmp_path / "packed.hyrf", "--profile", profile)
    succeeded("decompress", tmp_path / "packed.hyrf", "-o", tmp_path / "unpacked.hyrf")

    assert maps_equal(load_model(tmp_path / "unpacked.hyrf").exposure, EXPOSURE_MAP)


def test_a_partial_file_has_the_map(layered_data, tmp_path):
    first = layered_data[: read_container(layered_data).entries["RTAB"].end]
    (tmp_path / "first.hyrf").write_bytes(first)

    assert maps_equal(decode_model(first, fraction=1.0).exposure, EXPOSURE_MAP)
    model = load_model(tmp_path / "first.hyrf", fraction=1.0)
    assert maps_equal(model.exposure, EXPOSURE_MAP) and len(model) < 600
    assert maps_equal(decode_model(layered_data, fraction=1.0).exposure, EXPOSURE_MAP)


def test_a_partial_file_without_the_bytes_of_its_map_has_none(layered_data, tmp_path):
    data = move_map_to_end(layered_data)
    (tmp_path / "whole.hyrf").write_bytes(data)
    (tmp_path / "cut.hyrf").write_bytes(data[:-1])

    assert maps_equal(decode_model(data).exposure, EXPOSURE_MAP)
    model = load_model(tmp_path / "cut.hyrf", fraction=1.0)
    assert model.exposure is None and len(model) == len(decode_model(data))
    assert describe_file(tmp_path / "cut.hyrf", fraction=1.0)["exposure"] is None
    assert describe_file(tmp_path / "whole.hyrf")["exposure"]["centers"] == 17


def test_bytes_before_packing_exclude_the_map(tmp_path):
    model = model_with_map()
    report = save_model(model, tmp_path / "raw.hyrf")

    assert report.bytes_before == 4 * sum(parameter.numel() for parameter in model.parameters())


def test_min_file_bytes_include_the_map():
    with_map = min_file_bytes(exposure=EXPOSURE_MAP)

    assert with_map == min_file_bytes() + 40 + (EXPOSURE_MAP_BYTES + 7) // 8 * 8
    check_target_bytes(with_map, exposure=EXPOSURE_MAP)
    with pytest.raises(HyrfError, match="below the smallest possible file"):
        check_target_bytes(with_map - 1, exposure=EXPOSURE_MAP)


# --- describe and info ---


def mean_stops(log_gains: np.ndarray) -> float:
    """Return the mean log gain in stops; one stop is a log gain of ln(2) * 2 / 2.2."""
    return float(log_gains.astype(float).mean()) / (np.log(2) * 2 / 2.2)


@pytest.mark.integration
def test_describe_reports_the_map_without_torch_and_numpy(raw_file):
    program = (
        "import sys, json; from hyrfpack.format import describe_file; facts = describe_file(sys.argv[1]);"
        "print(json.dumps([facts['exposure'], [name for name in ('torch', 'numpy') if name in sys.modules]]))"
    )
    output = subprocess.run([sys.executable, "-c", program, str(raw_file)], capture_output=True, text=True, check=True)
    exposure, imported = json.loads(output.stdout)

    assert imported == []
    assert exposure == {"centers": 17, "stops": pytest.approx([mean_stops(limits) for limits in EXPOSURE_MAP.limits])}


def test_describe_reads_the_map_but_no_parameters(raw_file):
    entries = read_container(raw_file.read_bytes()).entries
    raw_file.write_bytes(raw_file.read_bytes()[: entries["EXPO"].end])

    assert describe_file(raw_file, fraction=1.0)["exposure"]["centers"] == 17


def test_describe_reports_no_map_for_a_file_without_one(tmp_path):
    save_model(small_model(ball_points(5)[0]), tmp_path / "plain.hyrf")

    assert describe_file(tmp_path / "plain.hyrf")["exposure"] is None
    assert "exposure" not in succeeded("info", tmp_path / "plain.hyrf").stdout


def test_info_reports_the_map(raw_file):
    lowest, highest = (mean_stops(limits) for limits in EXPOSURE_MAP.limits)

    assert json.loads(succeeded("info", raw_file, "--json").stdout)["exposure"]["centers"] == 17
    lines = succeeded("info", raw_file).stdout.splitlines()
    assert f"exposure map        17 centres, {lowest:+.2f} to {highest:+.2f} stops" in [line.strip() for line in lines]
    (section,) = [line.split() for line in lines if line.startswith("EXPO exposure map")]
    assert section[3:5] == [str(EXPOSURE_MAP_BYTES)] * 2 and len(section) == 7  # the column bits/number is empty


def test_a_damaged_map_is_reported_with_file_and_section(raw_file):
    raw_file.write_bytes(replace_map_by_zeros(raw_file.read_bytes()))

    with pytest.raises(HyrfFormatError, match="raw.hyrf: section 'EXPO': .* damaged"):
        describe_file(raw_file)
    with pytest.raises(HyrfFormatError, match="raw.hyrf: section 'EXPO': .* damaged"):
        load_model(raw_file)
    assert "section 'EXPO'" in refused("info", raw_file)
