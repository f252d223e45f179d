"""A reader written from docs/reference/format.md alone decodes the same bits as hyrfpack and refuses the same files."""

from __future__ import annotations

import ast
import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exposures import random_map
from hypothesis import given
from hypothesis import strategies as st
from layers import only_in_acceptance
from scenes import camera_at, small_model

from hyrfpack.compress import plan
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import decode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import MINOR_VERSION, read_container, write_container
from hyrfpack.format.exposure import decode_exposure, encode_exposure
from hyrfpack.model import ExposureMap, Frame
from hyrfpack.quant.integers import encode_integers
from tools.safety import minimal_reader
from tools.safety.synthetic_encoding import encode

GOLDEN_PATHS = sorted((Path(__file__).parents[1] / "golden").glob("*.hyrf"))
ALL_PROFILES = ("raw", "paper", "compact")


def random_model(count: int, **settings):
    """Return a model with random values of every parameter and Gaussians inside and outside the frame."""
    rng = np.random.default_rng(count)
    return small_model(
        rng.standard_t(2, (count, 3)),
        fields=1.0,
        color_logits=rng.normal(size=(count, 3)),
        scale_logits=rng.normal(-4, 1, (count, 1)),
        opacity_logits=rng.normal(0, 3, (count, 1)),
        **settings,
    )


def assert_same_bits(data: bytes, part: bool = False) -> None:
    metadata, groups, exposure = minimal_reader.read(data, part)
    model = decode_model(data, fraction=1.0 if part else None)

    assert metadata["config"] == json.loads(json.dumps(model.config.to_dict()))
    expected = to_arrays(model)
    assert groups.keys() == expected.keys()
    for name, values in groups.items():
        assert values.shape == expected[name].shape, name
        assert values.dtype == np.float32
        assert np.array_equal(values.view(np.uint32), expected[name].view(np.uint32)), name
    assert (exposure is None) == (model.exposure is None)
    if exposure is not None:
        assert_same_gains(exposure, model.exposure)


def assert_same_gains(read: minimal_reader.Exposure, exposure: ExposureMap) -> None:
    rng = np.random.default_rng(0)
    positions, directions = 2 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gains = [minimal_reader.log_gains(read, *view) for view in zip(positions, directions, strict=True)]

    np.testing.assert_allclose(exposure.predict_log_gains(positions, directions), gains, rtol=1e-12, atol=1e-12)


def test_minimal_reader_imports_nothing_of_hyrfpack():
    nodes = list(ast.walk(ast.parse(Path(minimal_reader.__file__).read_text())))

    imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}

    assert imported == {
        *("__future__", "bisect", "collections.abc", "dataclasses", "json", "math", "re", "struct", "typing", "zlib"),
        "numpy",
    }


@pytest.mark.parametrize("file", GOLDEN_PATHS, ids=lambda file: file.stem)
def test_golden_files_decode_to_the_same_bits(file):
    assert_same_bits(file.read_bytes())


@pytest.mark.parametrize("rotation", [(1.0, 0.0, 0.0, 0.0), (0.5, -0.1, 0.7, 0.5), (0.0, 0.6 * (1 + 5e-7), 0.0, -0.8)])
def test_local_units_are_those_of_the_page(rotation):
    frame = Frame((10.0, -20.0, 30.0), 2.5, (1.0, 1.0, 0.5), rotation)
    camera = camera_at((12.0, -23.0, 31.0), (10.0, -20.0, 30.0))
    config = random_model(1, frame=frame).config.to_dict()

    pose = minimal_reader.local_pose(config["frame"], camera.camera_from_world)

    np.testing.assert_allclose(frame.local_pose(camera), pose, rtol=0, atol=1e-13)


@pytest.mark.parametrize("profile", ALL_PROFILES)
@pytest.mark.parametrize(
    ("count", "background"), [(0, True), (1, False), (2, True), (3, False), (1000, True), (1000, False)]
)
def test_new_files_decode_to_the_same_bits(profile, count, background):
    encoding = "sh" if background else "frequency"

    assert_same_bits(encode(random_model(count, background=background, direction_encoding=encoding), profile))


@pytest.fixture(scope="module")
def layered_data() -> bytes:
    """Encode a model large enough for layers."""
    data = encode(random_model(12_000), "compact")
    assert "POS1" in read_container(data)
    return data


def test_layered_files_decode_to_the_same_bits(layered_data):
    assert_same_bits(layered_data)


@pytest.mark.parametrize(
    "least",
    [pytest.param(None, id="two layers", marks=pytest.mark.acceptance), pytest.param(100, id="many layers")],
)
def test_partial_layered_files_decode_to_the_same_bits(layered_data, least, monkeypatch):
    if least:
        monkeypatch.setattr(plan, "MIN_LAYER_GAUSSIANS", least)
        monkeypatch.setattr(plan, "MIN_LAYER_SHARE", 0.01)
        layered_data = encode(random_model(2000), "compact")
    entries = read_container(layered_data).entries
    base, top = entries["RTAB"].end, entries["OPA1"].end

    for cut in (base, top - 1, top, len(layered_data) - 1, len(layered_data)):
        assert_same_bits(layered_data[:cut], part=True)
    for cut in (base - 1, entries["META"].end, 60):
        with pytest.raises(ValueError):
            minimal_reader.read(layered_data[:cut], part=True)
        with pytest.raises(HyrfFormatError):
            decode_model(layered_data[:cut], fraction=1.0)


def exposure_section(data: bytes) -> minimal_reader.Section:
    """Return a section EXPO with these bytes."""
    padded = data + bytes(-len(data) % 8)
    return minimal_reader.Section("EXPO", 9, len(data), len(data), zlib.crc32(data), padded, whole=True)


@given(st.integers(0, 2**32 - 1), st.integers(0, 64))
def test_random_exposure_maps_give_the_same_gains(seed, centers):
    exposure = random_map(seed, centers)

    assert_same_gains(minimal_reader.read_exposure(exposure_section(encode_exposure(exposure).data)), exposure)


NEXT_FLOAT32_ABOVE_8 = float(np.nextafter(np.float32(8), np.float32(9)))
HOSTILE_FLOATS = (
    np.nan,
    np.inf,
    -np.inf,
    0.0,
    -0.0,
    2.0**-149,
    -1.0,
    8.0,
    -8.0,
    NEXT_FLOAT32_ABOVE_8,
    -NEXT_FLOAT32_ABOVE_8,
    1e30,
    -1e30,
)


def test_both_readers_accept_the_same_exposure_maps():
    """Each float takes every hostile value in turn, and each other byte of the header takes every value."""
    valid = encode_exposure(random_map(4, 2)).data
    maps = [
        valid[: 4 * place] + np.float32(v).tobytes() + valid[4 * place + 4 :]
        for place in range(1, 21)
        for v in HOSTILE_FLOATS
    ]
    maps += [valid[:place] + b"\1" + valid[place + 1 :] for place in (1, 2, 3)]
    maps += [bytes([count]) + valid[1:84] + bytes(12 * count) for count in (0, 1, 63, 64, 65, 255)]
    maps += [valid[:-1], valid + b"\0", valid[:83], valid[:84], b""]
    accepted = 0
    for data in maps:
        try:
            read = minimal_reader.read_exposure(exposure_section(data))
        except ValueError:
            with pytest.raises(HyrfFormatError):
                decode_exposure(9, memoryview(data), len(data))
        else:
            assert_same_gains(read, decode_exposure(9, memoryview(data), len(data)))
            accepted += 1

    assert 50 < accepted < len(maps) - 100


def test_a_partial_file_without_the_bytes_of_its_exposure_map_has_none():
    model = random_model(30)
    model.exposure = random_map(1, 5)
    sections = list(read_container(encode(model, "raw")).sections)
    data = write_container(sorted(sections, key=lambda section: section.type == "EXPO"), minor=MINOR_VERSION)

    assert minimal_reader.read(data)[2] is not None and minimal_reader.read(data[:-1], part=True)[2] is None
    assert_same_bits(data)
    assert_same_bits(data[:-1], part=True)


def test_the_example_stream_of_the_specification_is_decoded():
    data = bytes.fromhex("00 12 29 B0 03 00 69 B1 00")

    assert minimal_reader.read_integers(data, np.zeros(5, np.int64)).tolist() == [0, 0, 1, 0, 20]


# By case: the scale of the integers, and whether (first byte, alphabet) of their stream show the intended kind.
STREAM_CASES = {
    "one lane": (np.ones(500), lambda first, alphabet: first == 0 and alphabet),
    "lanes": (1e9 * np.ones(20_000), lambda first, alphabet: first & 15),
    "classes": (np.exp(4 * np.sin(np.arange(20_000) / 50)), lambda first, alphabet: first >> 4 & 7),
    "static models": (1e9 * np.ones(70_000), lambda first, alphabet: first >> 7),
    "one token": (np.zeros(70_000), lambda first, alphabet: alphabet == 0),
}


@pytest.mark.parametrize("contexts", [1, 3])
@pytest.mark.parametrize("kind", STREAM_CASES)
def test_streams_of_every_kind_decode_to_the_same_integers(kind, contexts):
    rng = np.random.default_rng(0)
    scale, has_kind = STREAM_CASES[kind]
    context = rng.integers(0, contexts, len(scale)).astype(np.uint8)
    values = np.rint(rng.laplace(size=len(scale)) * scale * (1 + context)).astype(np.int64)
    data = encode_integers(values, context, signed=True)

    read = minimal_reader.read_integers(data, context.astype(np.int64), signed=True)

    assert has_kind(data[0], data[1])
    assert np.array_equal(read, values)


WRONG_VALUES = [None, True, 3, -1, 10**400, 1.5, "red", "", [], [1], [1, 1], [1, 1, True], [1, "1", 1], 4 * [0], {}]
METADATA_PATHS = [
    *(["gaussians"], ["layers"], ["rules"], ["profile"], ["settings"], ["provenance"], ["writer"], ["config"]),
    *(["config", key] for key in sorted(minimal_reader.CONFIG_KEYS)),
    *(["config", "frame", key] for key in sorted(minimal_reader.FRAME_KEYS | {"rotation"})),
    *(["config", "radiance", key] for key in sorted(minimal_reader.GRID_KEYS)),
    ["config", "residual_degree"],
]


@pytest.mark.parametrize("path", METADATA_PATHS, ids=".".join)
def test_both_readers_refuse_the_same_values_of_metadata(path):
    sections = list(read_container(encode(random_model(3), "raw")).sections)
    text = bytes(sections[0].data)
    assert sections[0].type == "META"
    refused = 0
    for value in WRONG_VALUES:
        metadata = json.loads(text)
        inner = metadata
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        changed = json.dumps(metadata).encode()
        meta = replace(sections[0], data=changed, raw_length=len(changed))
        data = write_container([meta, *sections[1:]], minor=MINOR_VERSION)
        try:
            minimal_reader.read(data)
        except ValueError:
            refused += 1
            with pytest.raises(HyrfFormatError):
                decode_model(data)
        else:
            decode_model(data)

    assert refused > len(WRONG_VALUES) / 2


@pytest.mark.parametrize("depth", [62, 63, 950, 100_000])
def test_both_readers_have_the_same_limit_for_the_nesting_of_metadata(depth):
    """The metadata and its provenance are two of at most 64 levels."""
    sections = list(read_container(encode(random_model(3), "raw")).sections)
    metadata = json.loads(bytes(sections[0].data)) | {"provenance": {"a": None}}
    changed = json.dumps(metadata).replace('{"a": null}', '{"a": ' + "[" * depth + "]" * depth + "}").encode()
    meta = replace(sections[0], data=changed, raw_length=len(changed))
    data = write_container([meta, *sections[1:]], minor=MINOR_VERSION)

    if depth == 62:
        assert_same_bits(data)
        return
    with pytest.raises(ValueError, match="too deep"):
        minimal_reader.read(data)
    with pytest.raises(HyrfFormatError):
        decode_model(data)


def test_a_file_without_metadata_or_names_is_refused():
    empty = write_container([], minor=0)

    for read in (minimal_reader.read, minimal_reader.read_parts):
        with pytest.raises(ValueError):
            read(empty)


@pytest.mark.parametrize("sign", [1, -1])
def test_both_readers_have_the_same_limit_for_the_basis(sign):
    sections = list(read_container(encode(random_model(30), "compact")).sections)
    place = [section.type for section in sections].index("COLO")
    largest = np.float32(1 + 2**-10)

    def with_basis(first: np.float32) -> bytes:
        data = np.float32(sign * first).tobytes() + bytes(sections[place].data[4:])
        return write_container(
            [*sections[:place], replace(sections[place], data=data), *sections[place + 1 :]], minor=MINOR_VERSION
        )

    assert_same_bits(with_basis(largest))
    for first in (np.nextafter(largest, np.float32(2)), np.float32("nan")):
        with pytest.raises(ValueError, match="basis"):
            minimal_reader.read(with_basis(first))
        with pytest.raises(HyrfFormatError, match="basis"):
            decode_model(with_basis(first))


@pytest.mark.parametrize(
    "profile",
    only_in_acceptance([*ALL_PROFILES, "compact in layers", "raw with an exposure map"], ["compact", "raw"]),
)
def test_both_readers_refuse_the_same_damage(profile, monkeypatch):
    rng = np.random.default_rng(0)
    if profile == "compact in layers":
        monkeypatch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        monkeypatch.setattr(plan, "MIN_LAYER_SHARE", 0.01)
    model = random_model(30)
    if profile.endswith("map"):
        model.exposure = random_map(2, 40)
    sections = list(read_container(encode(model, profile.split()[0])).sections)
    assert (profile == "compact in layers") == any(section.type == "OPA1" for section in sections)
    refused, count = 0, 30

    for _ in range(count):
        data = write_container(damage_section(sections, rng), minor=MINOR_VERSION)
        try:
            assert_same_bits(data)
        except (ValueError, zlib.error):
            refused += 1
            with pytest.raises(HyrfFormatError):
                decode_model(data)

    assert 0 < refused < count


def damage_section(sections: list, rng: np.random.Generator) -> list:
    """Return the sections with one of them truncated, extended or changed by one bit."""
    which = rng.integers(len(sections))
    data = bytearray(sections[which].data)
    kind, place = rng.integers(4), rng.integers(len(data))
    if kind == 0:
        data = data[:place]
    elif kind == 1:
        data += bytes(1)
    else:
        data[place % (16 if kind == 2 else len(data))] ^= 1 << rng.integers(8)
    return [*sections[:which], replace(sections[which], data=bytes(data)), *sections[which + 1 :]]
