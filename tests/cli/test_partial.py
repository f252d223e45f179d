"""Files cut short, on the command line: what is there of them is unpacked, rendered and scored if asked to."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import hyrfpack, refused, succeeded
from scenes import small_model

from hyrfpack.compress import plan
from hyrfpack.format import describe_file, load_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import read_container
from tools.safety.synthetic_encoding import encode

PROVENANCE = {"preset": "standard"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A file of profile "compact" in layers; to be seen with the photos of `data`."""
    rng = np.random.default_rng(0)
    model = small_model(
        rng.normal(0, 0.7, (600, 3)), fields=0.5, color_logits=rng.normal(size=(600, 3)), background=True
    )
    path = tmp_path_factory.mktemp("layers") / "whole.hyrf"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MAX_LAYERS", 100)
        path.write_bytes(encode(model, "compact", PROVENANCE, prune=False))
    return path


@pytest.fixture(scope="module")
def cut(whole) -> Path:
    """The first two layers of it, and a little more."""
    path = whole.parent / "cut.hyrf"
    path.write_bytes(whole.read_bytes()[: end_of(whole, "OPA1") + 3])
    return path


@pytest.fixture(scope="module")
def stump(whole) -> Path:
    """Not even the first layer and the fields."""
    path = whole.parent / "stump.hyrf"
    path.write_bytes(whole.read_bytes()[: end_of(whole, "RTAB") - 1])
    return path


def end_of(path: Path, type: str) -> int:
    return read_container(path.read_bytes(), fraction=1.0).entries[type].end


def first_layers(path: Path, count: int) -> int:
    """How many Gaussians they have."""
    return sum(describe_file(path)["layers"][:count])


def assert_first_of(part: Path, whole: Path, count: int) -> None:
    """The model in `part` has the first Gaussians of the one in `whole`, and all else of it."""
    got, expected = to_arrays(load_model(part)), to_arrays(load_model(whole))
    for group in ("POSI", "COLO", "SCAL", "OPAC"):
        expected[group] = expected[group][:count]
    assert all(np.array_equal(got[group], expected[group]) for group in expected)


# -- what works ------------------------------------------------------------------------------------------------------


def test_decompress_unpacks_a_fraction(whole, tmp_path):
    fraction = (end_of(whole, "OPA1") + 0.5) / whole.stat().st_size
    arguments = ("decompress", whole, "-o", tmp_path / "back.hyrf", "--fraction", fraction, "--json")
    report = json.loads(succeeded(*arguments).stdout)

    count = first_layers(whole, 2)
    assert report["profile"] == "raw" and report["gaussians"] == count < first_layers(whole, 8) == 600
    assert_first_of(tmp_path / "back.hyrf", whole, count)
    facts = describe_file(tmp_path / "back.hyrf")
    assert (facts["layers"], facts["provenance"]) == ([], PROVENANCE)


@pytest.mark.parametrize("fraction", [(), ("--fraction", 1), ("--fraction", "1.0")])
def test_decompress_of_a_whole_file_is_the_whole_model(fraction, whole, tmp_path):
    succeeded("decompress", whole, "-o", tmp_path / "back.hyrf", *fraction)
    assert_first_of(tmp_path / "back.hyrf", whole, 600)


def test_decompress_takes_what_is_there_of_a_file_cut_short(whole, cut, tmp_path):
    printed = succeeded("decompress", cut, "-o", tmp_path / "back.hyrf", "--fraction", 1).stdout
    count = first_layers(whole, 2)
    assert f"{count:,} Gaussians, every number as float32" in printed
    assert_first_of(tmp_path / "back.hyrf", whole, count)


def test_decompress_counts_the_fraction_of_the_whole_file_and_not_of_what_is_there(whole, cut, tmp_path):
    fraction = (end_of(whole, "RTAB") + 0.5) / whole.stat().st_size
    for path in (whole, cut):
        succeeded("decompress", path, "-o", tmp_path / f"{path.stem}.hyrf", "--fraction", fraction)
        assert_first_of(tmp_path / f"{path.stem}.hyrf", whole, first_layers(whole, 1))


def test_render_and_evaluate_take_a_file_cut_short_if_asked_to(whole, cut, data, tmp_path):
    succeeded(
        "decompress", whole, "-o", tmp_path / "coarse.hyrf", "--fraction", cut.stat().st_size / whole.stat().st_size
    )
    scores = []
    for path, option in ((cut, ["--allow-partial"]), (tmp_path / "coarse.hyrf", [])):
        succeeded("render", path, "-o", tmp_path / path.stem, "--data", data, *option)
        scores.append(json.loads(succeeded("evaluate", path, "--data", data, "--json", *option).stdout))

    for name in ("0000.png", "0008.png"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "coarse" / name).read_bytes()
    assert scores[0]["psnr"] == scores[1]["psnr"]
    assert scores[0]["gaussians"] == scores[1]["gaussians"] == first_layers(whole, 2)
    assert scores[0]["bytes"] == cut.stat().st_size


def test_render_goes_around_a_model_cut_short(cut, tmp_path):
    arguments = ("render", cut, "-o", tmp_path, "--orbit", 1, "--allow-partial", "--json")
    assert len(json.loads(succeeded(*arguments).stdout)["pictures"]) == 1


def test_a_whole_file_is_the_same_with_the_option(whole, data):
    scores = [
        json.loads(succeeded("evaluate", whole, "--data", data, "--json", *option).stdout)
        for option in ([], ["--allow-partial"])
    ]
    assert scores[0]["psnr"] == scores[1]["psnr"] and scores[0]["gaussians"] == scores[1]["gaussians"] == 600


def test_help_tells_of_it():
    assert "cut short" in succeeded("render", "--help").stdout
    assert "cut short" in succeeded("evaluate", "--help").stdout
    assert "--fraction 0.6" in succeeded("decompress", "--help").stdout


# -- what is refused -------------------------------------------------------------------------------------------------


def attempts(path: Path, data: Path, output: Path, *, part: bool) -> list[tuple]:
    """Every command that reads a model, told to take a part of it or not."""
    take = ["--allow-partial"] if part else []
    return [
        ("decompress", path, "-o", output / "x.hyrf", *(["--fraction", 1] if part else [])),
        ("render", path, "-o", output, "--orbit", 1, *take),
        ("render", path, "-o", output, "--data", data, *take),
        ("evaluate", path, "--data", data, "--pictures", output, *take),
    ]


def test_a_file_cut_short_is_rejected_unless_asked_for(cut, data, tmp_path):
    for arguments in attempts(cut, data, tmp_path / "out", part=False):
        assert f"{cut}: " in (sentence := refused(*arguments)) and "truncated" in sentence
    assert "truncated" in refused("compress", cut, "-o", tmp_path / "out.hyrf")
    assert "truncated" in refused("info", cut)
    assert not (tmp_path / "out").exists()


def test_too_little_of_a_file_is_rejected_with_a_clear_error_that_says_how_much_it_takes(whole, stump, data, tmp_path):
    needed, size = stump.stat().st_size + 1, whole.stat().st_size
    for arguments in attempts(stump, data, tmp_path / "out", part=True):
        assert f"{stump}: the model needs the first {needed:,} of {size:,} bytes" in refused(*arguments)
    for fraction in (0.0, 0.01, (needed - 1) / size):
        arguments = ("decompress", whole, "-o", tmp_path / "out.hyrf", "--fraction", fraction)
        assert "read a larger part of the file" in refused(*arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("profile", ["raw", "paper"])
def test_files_without_layers_are_rejected_in_part(profile, whole, data, tmp_path):
    full, part = tmp_path / "full.hyrf", tmp_path / "part.hyrf"
    succeeded("compress", whole, "-o", full, "--profile", profile)
    part.write_bytes(full.read_bytes()[:-8])
    size = full.stat().st_size

    for arguments in attempts(part, data, tmp_path / "out", part=True):
        assert f"{part}: the model needs the first {size:,} of {size:,} bytes" in refused(*arguments)
    assert "read a larger part of the file" in refused(
        "decompress", full, "-o", tmp_path / "out.hyrf", "--fraction", 0.99
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fraction", ["-0.1", "1.01", "60%", "nan", "inf", ""])
def test_a_fraction_that_is_none_is_rejected(fraction, whole, tmp_path):
    result = hyrfpack("decompress", whole, "-o", tmp_path / "out.hyrf", "--fraction", fraction)

    assert result.exit_code == 2, result.output
    assert "--fraction" in result.stderr and not (tmp_path / "out.hyrf").exists()


def test_an_old_file_stays_where_too_little_is_there(stump, tmp_path):
    (tmp_path / "old.hyrf").write_bytes(b"old")
    refused("decompress", stump, "-o", tmp_path / "old.hyrf", "--fraction", 1)
    assert (tmp_path / "old.hyrf").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
