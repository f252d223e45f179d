"""Truncated files on the command line: their complete layers are unpacked, rendered and scored on request."""

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
from hyrfpack.format.parts import encode_parts
from tools.safety.synthetic_encoding import encode

STORED_PROVENANCE = {"preset": "standard"}


@pytest.fixture(scope="module")
def layered_file(tmp_path_factory) -> Path:
    """A file of profile "compact" with layers, made for the photos of `data`."""
    rng = np.random.default_rng(0)
    model = small_model(
        rng.normal(0, 0.7, (600, 3)), fields=0.5, color_logits=rng.normal(size=(600, 3)), background=True
    )
    path = tmp_path_factory.mktemp("layers") / "whole.hyrf"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MIN_LAYER_SHARE", 0.01)
        path.write_bytes(encode(model, "compact", STORED_PROVENANCE, prune=False))
    return path


@pytest.fixture(scope="module")
def two_layer_file(layered_file) -> Path:
    """The first two layers of that file and a few bytes more."""
    path = layered_file.parent / "cut.hyrf"
    path.write_bytes(layered_file.read_bytes()[: end_of(layered_file, "OPA1") + 3])
    return path


@pytest.fixture(scope="module")
def file_without_layers(layered_file) -> Path:
    """A file that ends before the first layer and the fields are complete."""
    path = layered_file.parent / "stump.hyrf"
    path.write_bytes(layered_file.read_bytes()[: end_of(layered_file, "RTAB") - 1])
    return path


def end_of(path: Path, type: str) -> int:
    return read_container(path.read_bytes(), fraction=1.0).entries[type].end


def count_gaussians(path: Path, count: int) -> int:
    """Return the number of Gaussians in the first layers."""
    return sum(describe_file(path)["layers"][:count])


def assert_first_of(part: Path, layered_file: Path, count: int) -> None:
    """Check that `part` has the first Gaussians of `whole`, and everything else of it."""
    got, expected = to_arrays(load_model(part)), to_arrays(load_model(layered_file))
    for group in ("POSI", "COLO", "SCAL", "OPAC"):
        expected[group] = expected[group][:count]
    assert all(np.array_equal(got[group], expected[group]) for group in expected)


# -- what works ------------------------------------------------------------------------------------------------------


def test_decompress_unpacks_a_fraction(layered_file, tmp_path):
    fraction = (end_of(layered_file, "OPA1") + 0.5) / layered_file.stat().st_size
    arguments = ("decompress", layered_file, "-o", tmp_path / "back.hyrf", "--fraction", fraction, "--json")
    report = json.loads(succeeded(*arguments).stdout)

    count = count_gaussians(layered_file, 2)
    assert report["profile"] == "raw" and report["gaussians"] == count < count_gaussians(layered_file, 8) == 600
    assert_first_of(tmp_path / "back.hyrf", layered_file, count)
    facts = describe_file(tmp_path / "back.hyrf")
    assert (facts["layers"], facts["provenance"]) == ([], STORED_PROVENANCE)


@pytest.mark.parametrize("fraction", [(), ("--fraction", 1), ("--fraction", "1.0")])
def test_decompress_of_a_complete_file_gives_the_complete_model(fraction, layered_file, tmp_path):
    succeeded("decompress", layered_file, "-o", tmp_path / "back.hyrf", *fraction)
    assert_first_of(tmp_path / "back.hyrf", layered_file, 600)


def test_decompress_reads_the_complete_layers_of_a_truncated_file(layered_file, two_layer_file, tmp_path):
    printed = succeeded("decompress", two_layer_file, "-o", tmp_path / "back.hyrf", "--fraction", 1).stdout
    count = count_gaussians(layered_file, 2)
    assert f"{count:,} Gaussians, all numbers as float32" in printed
    assert_first_of(tmp_path / "back.hyrf", layered_file, count)


def test_decompress_takes_the_fraction_of_the_original_file_size(layered_file, two_layer_file, tmp_path):
    fraction = (end_of(layered_file, "RTAB") + 0.5) / layered_file.stat().st_size
    for path in (layered_file, two_layer_file):
        succeeded("decompress", path, "-o", tmp_path / f"{path.stem}.hyrf", "--fraction", fraction)
        assert_first_of(tmp_path / f"{path.stem}.hyrf", layered_file, count_gaussians(layered_file, 1))


def test_render_and_evaluate_read_a_truncated_file_with_the_option(layered_file, two_layer_file, data, tmp_path):
    succeeded(
        "decompress",
        layered_file,
        "-o",
        tmp_path / "coarse.hyrf",
        "--fraction",
        two_layer_file.stat().st_size / layered_file.stat().st_size,
    )
    scores = []
    for path, option in ((two_layer_file, ["--allow-partial"]), (tmp_path / "coarse.hyrf", [])):
        succeeded("render", path, "-o", tmp_path / path.stem, "--data", data, *option)
        scores.append(json.loads(succeeded("evaluate", path, "--data", data, "--json", *option).stdout))

    for name in ("0000.png", "0008.png"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "coarse" / name).read_bytes()
    assert scores[0]["psnr"] == scores[1]["psnr"]
    assert scores[0]["gaussians"] == scores[1]["gaussians"] == count_gaussians(layered_file, 2)
    assert scores[0]["bytes"] == two_layer_file.stat().st_size


def test_render_orbits_a_truncated_model(two_layer_file, tmp_path):
    arguments = ("render", two_layer_file, "-o", tmp_path, "--orbit", 1, "--allow-partial", "--json")
    assert len(json.loads(succeeded(*arguments).stdout)["pictures"]) == 1


def test_the_option_does_not_change_a_complete_file(layered_file, data):
    scores = [
        json.loads(succeeded("evaluate", layered_file, "--data", data, "--json", *option).stdout)
        for option in ([], ["--allow-partial"])
    ]
    assert scores[0]["psnr"] == scores[1]["psnr"] and scores[0]["gaussians"] == scores[1]["gaussians"] == 600


def test_help_mentions_truncated_files():
    assert "cut short" in succeeded("render", "--help").stdout
    assert "cut short" in succeeded("evaluate", "--help").stdout
    assert "--fraction 0.6" in succeeded("decompress", "--help").stdout


# -- errors ----------------------------------------------------------------------------------------------------------


def reading_commands(path: Path, data: Path, output: Path, *, part: bool) -> list[tuple]:
    """Return every command that reads a model, with or without the option to read a part of it."""
    take = ["--allow-partial"] if part else []
    return [
        ("decompress", path, "-o", output / "x.hyrf", *(["--fraction", 1] if part else [])),
        ("render", path, "-o", output, "--orbit", 1, *take),
        ("render", path, "-o", output, "--data", data, *take),
        ("evaluate", path, "--data", data, "--pictures", output, *take),
    ]


def test_a_truncated_file_is_rejected_without_the_option(two_layer_file, data, tmp_path):
    for arguments in reading_commands(two_layer_file, data, tmp_path / "out", part=False):
        assert f"{two_layer_file}: " in (sentence := refused(*arguments)) and "truncated" in sentence
    assert "truncated" in refused("compress", two_layer_file, "-o", tmp_path / "out.hyrf")
    assert "truncated" in refused("info", two_layer_file)
    assert not (tmp_path / "out").exists()


def test_too_little_of_a_file_is_a_clear_error_that_names_the_bytes_needed(
    layered_file, file_without_layers, data, tmp_path
):
    needed, size = file_without_layers.stat().st_size + 1, layered_file.stat().st_size
    for arguments in reading_commands(file_without_layers, data, tmp_path / "out", part=True):
        assert f"{file_without_layers}: the model needs the first {needed:,} of {size:,} bytes" in refused(*arguments)
    for fraction in (0.0, 0.01, (needed - 1) / size):
        arguments = ("decompress", layered_file, "-o", tmp_path / "out.hyrf", "--fraction", fraction)
        assert "read a larger part of the file, with a --fraction of at least " in refused(*arguments)
    assert not (tmp_path / "out").exists()


def test_the_fraction_that_the_message_names_is_the_smallest_that_works(layered_file, tmp_path):
    for fraction in (0.0, 0.01, 0.1):
        sentence = refused("decompress", layered_file, "-o", tmp_path / "out.hyrf", "--fraction", fraction)
        named = float(sentence.rpartition("at least ")[2])
    assert 0.1 < named < 1
    too_small = ("decompress", layered_file, "-o", tmp_path / "out.hyrf", "--fraction", named - 0.001)
    assert refused(*too_small).endswith(f"at least {named:g}")
    succeeded("decompress", layered_file, "-o", tmp_path / "out.hyrf", "--fraction", named)


def test_a_part_of_a_merged_file_is_a_clear_error(layered_file, tmp_path):
    data = encode_parts([("scene", layered_file.read_bytes()), ("chair", layered_file.read_bytes())])
    merged, cut = tmp_path / "merged.hyrf", tmp_path / "cut.hyrf"
    merged.write_bytes(data)
    cut.write_bytes(data[:-8])
    sentence = refused("decompress", merged, "-o", tmp_path / "out.hyrf", "--fraction", 0.5)
    assert f"{merged}: a merged file can only be read whole" in sentence and sentence.endswith("leave out --fraction")
    sentence = refused("render", cut, "-o", tmp_path / "out", "--orbit", 1, "--allow-partial")
    assert f"{cut}: a merged file can only be read whole" in sentence and sentence.endswith("copy the whole file again")


@pytest.mark.parametrize("profile", ["raw", "paper"])
def test_truncated_files_without_layers_are_rejected(profile, layered_file, data, tmp_path):
    full, part = tmp_path / "full.hyrf", tmp_path / "part.hyrf"
    succeeded("compress", layered_file, "-o", full, "--profile", profile)
    part.write_bytes(full.read_bytes()[:-8])
    size = full.stat().st_size

    for arguments in reading_commands(part, data, tmp_path / "out", part=True):
        assert f"{part}: the model needs the first {size:,} of {size:,} bytes" in refused(*arguments)
        assert "has no layers" in refused(*arguments) and refused(*arguments).endswith("copy the whole file again")
    for fraction in (0.0, 0.99):
        sentence = refused("decompress", full, "-o", tmp_path / "out.hyrf", "--fraction", fraction)
        assert sentence.endswith("has no layers, so that only the whole file can be read; leave out --fraction")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fraction", ["-0.1", "1.01", "60%", "nan", "inf", ""])
def test_an_invalid_fraction_is_rejected(fraction, layered_file, tmp_path):
    result = hyrfpack("decompress", layered_file, "-o", tmp_path / "out.hyrf", "--fraction", fraction)

    assert result.exit_code == 2, result.output
    assert "--fraction" in result.stderr and not (tmp_path / "out.hyrf").exists()


def test_an_old_file_is_kept_when_the_input_is_too_short(file_without_layers, tmp_path):
    (tmp_path / "old.hyrf").write_bytes(b"old")
    refused("decompress", file_without_layers, "-o", tmp_path / "old.hyrf", "--fraction", 1)
    assert (tmp_path / "old.hyrf").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
