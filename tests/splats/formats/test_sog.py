"""SOG: splats round-trip within the precision of the format, invalid and oversized bundles are refused."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from property_tests import examples

from hyrfpack.errors import HyrfDataError
from hyrfpack.ops.harmonics import num_sh_bases
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.palette import build_palette, find_nearest_entries
from hyrfpack.splats.splats import Splats, normalize_quats


def random_splats(count: int, degree: int = 3) -> Splats:
    """Return random splats with far outliers and opacities of 0 and 1."""
    rng = np.random.default_rng(count)
    return Splats(
        rng.standard_cauchy((count, 3)),
        np.exp(rng.normal(-4, 1, (count, 3))),
        normalize_quats(rng.normal(size=(count, 4))),
        np.clip(rng.normal(0.5, 0.5, count), 0, 1),
        rng.normal(0, 0.3, (count, num_sh_bases(degree), 3)),
    )


def encode_webp(pixels: list) -> bytes:
    """Encode one row of pixels as lossless WebP."""
    file = io.BytesIO()
    Image.fromarray(np.array([pixels], np.uint8)).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def hand_packed_bundle(**changes: object) -> dict[str, bytes]:
    """Return the files of one hand-packed Gaussian at (0, e - 1, 1 - e), rotated by 90 degrees about z."""
    book = [float(i) for i in range(256)]
    meta = {
        "version": 2,
        "count": 1,
        "means": {"mins": [-1, -1, -1], "maxs": [1, 1, 1], "files": ["low.webp", "high.webp"]},
        "scales": {"codebook": book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [value / 10 for value in book], "files": ["sh0.webp"]},
    } | changes
    pictures = {"low": [0, 255, 0], "high": [128, 255, 0], "scales": [0, 1, 2], "quats": [255, 128, 128, 255]}
    files = {f"{name}.webp": encode_webp([pixel]) for name, pixel in (pictures | {"sh0": [1, 2, 3, 51]}).items()}
    return {"meta.json": json.dumps(meta).encode(), **files}


def test_a_hand_packed_bundle_is_decoded() -> None:
    splats = sog.decode_files(hand_packed_bundle(antialias=True), "hand")
    np.testing.assert_allclose(splats.positions, [[0, np.e - 1, 1 - np.e]], atol=2e-5)
    np.testing.assert_allclose(splats.scales, np.exp([[0, 1, 2]]), rtol=1e-6)
    np.testing.assert_allclose(splats.quats, [[0.5**0.5, 0, 0, 0.5**0.5]], atol=5e-3)
    np.testing.assert_allclose(splats.opacities, [0.2], rtol=1e-6)
    np.testing.assert_allclose(splats.harmonics, [[[0.1, 0.2, 0.3]]], rtol=1e-6)
    assert splats.antialiased


def test_a_missing_first_codebook_entry_is_extrapolated() -> None:
    files = hand_packed_bundle(scales={"codebook": [None, *map(float, range(1, 256))], "files": ["scales.webp"]})
    np.testing.assert_allclose(np.log(sog.decode_files(files, "old").scales), [[1 - 254 / 255, 1, 2]], atol=1e-6)


def test_a_sog_of_splat_transform_equals_its_ply(shared_data: Path) -> None:
    folder = shared_data / "trained_models"
    if not folder.is_dir():
        pytest.skip(f"trained models not found at {folder}")
    files = {file.name: file.read_bytes() for file in (folder / "playbot_lod3_sog").iterdir()}
    splats = sog.decode_files(files, "playbot")
    data = (folder / "playbot_lod3_sh2.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    table = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))

    def columns(stem: str, count: int) -> np.ndarray:
        return np.stack([table[f"{stem}_{number}"] for number in range(count)], 1)

    higher = columns("f_rest", 24).reshape(-1, 3, 8).transpose(0, 2, 1)
    np.testing.assert_allclose(splats.positions, np.stack([table[axis] for axis in "xyz"], 1), atol=1e-6)
    np.testing.assert_allclose(np.log(splats.scales), columns("scale", 3), atol=1e-5)
    np.testing.assert_allclose(splats.quats, normalize_quats(columns("rot", 4)), atol=1e-5)
    np.testing.assert_allclose(splats.opacities, 1 / (1 + np.exp(-table["opacity"])), atol=2e-6)
    np.testing.assert_array_equal(splats.harmonics, np.concatenate((columns("f_dc", 3)[:, None], higher), 1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_round_trip_within_the_precision_of_the_format(degree: int) -> None:
    splats = random_splats(500, degree)
    read = sog.decode(sog.encode(splats), "bundle")
    cells = np.sign(splats.positions) * np.log1p(np.abs(splats.positions))
    read_cells = np.sign(read.positions) * np.log1p(np.abs(read.positions))
    # The file reorders Gaussians, so each is matched by its position.
    order = np.abs(cells[:, None] - read_cells).max(2).argmin(1)
    read, read_cells = read[order], read_cells[order]
    assert sorted(order) == list(range(500))
    assert (np.abs(cells - read_cells).max(0) <= np.ptp(cells, 0) / 65535 * 0.501).all()
    np.testing.assert_allclose(np.log(read.scales), np.log(splats.scales), atol=0.02)
    assert np.abs((read.quats * splats.quats).sum(1)).min() > np.cos(np.radians(1) / 2)
    np.testing.assert_allclose(read.opacities, splats.opacities, atol=0.501 / 255)
    # Also of Gaussians with opacity 0.
    np.testing.assert_allclose(read.harmonics[:, 0], splats.harmonics[:, 0], atol=0.005)
    assert read.degree == degree


def test_repeated_colors_are_stored_exactly() -> None:
    splats = random_splats(64)
    read = sog.decode_files(sog.encode_files(splats[np.arange(512) % 2]), "same")
    assert set(map(bytes, read.harmonics[:, 0])) == set(map(bytes, splats.harmonics[:2, 0]))
    np.testing.assert_allclose(np.unique(read.harmonics[:, 1:]), np.unique(splats.harmonics[:2, 1:]))


def test_an_outlier_does_not_coarsen_the_other_values() -> None:
    splats = random_splats(2000, 0)
    splats.harmonics[7] = 1000
    read = sog.decode_files(sog.encode_files(splats), "outlier").harmonics
    ordinary = np.sort(splats.harmonics[np.arange(2000) != 7].ravel())
    assert np.abs(np.sort(read[read < 999].ravel()) - ordinary).max() < 0.1  # evenly spaced steps would be 2 apart
    assert read.max() == pytest.approx(1000)


@pytest.mark.parametrize("count", [0, 1, 65])
def test_bundles_of_few_gaussians_round_trip(count: int) -> None:
    splats = random_splats(count)
    read = sog.decode(sog.encode(splats), "small")
    assert len(read) == count and read.degree == (3 if count else 0)


def test_zero_scales_and_flat_scenes_round_trip() -> None:
    flat = random_splats(300, 1)
    flat.positions[:, 2], flat.scales[:, 1] = 5, 0
    read = sog.decode_files(sog.encode_files(flat), "flat")
    np.testing.assert_allclose(read.positions[:, 2], 5, rtol=1e-12)
    assert read.scales.min() < 1e-11


def test_encoding_is_deterministic_and_the_zip_is_uncompressed() -> None:
    data = sog.encode(random_splats(200))
    assert data == sog.encode(random_splats(200))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {(member.compress_type, member.date_time[0]) for member in archive.infolist()} == {(0, 1980)}
        assert archive.namelist()[0] == "meta.json"


def test_a_palette_finds_separate_clusters() -> None:
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(20, 45)).astype(np.float32)
    rows = centers[np.repeat(np.arange(20), 50)] + rng.normal(0, 0.01, (1000, 45)).astype(np.float32)
    palette = build_palette(rows, np.ones(1000), 40)
    labels, distances = find_nearest_entries(rows, palette)
    brute = ((rows[:, None].astype(float) - palette) ** 2).sum(2)
    np.testing.assert_allclose(distances, brute.min(1), atol=1e-4)
    np.testing.assert_allclose(np.take_along_axis(brute, labels[:, None], 1)[:, 0], brute.min(1), atol=1e-4)
    assert brute.min(1).max() < 0.02


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 1}, "version 1, but only version 2 can be read"),
        ({"version": 3}, "version 3, but only version 2 can be read"),
        ({"count": 2}, "1 pixels for 2 Gaussians"),
        ({"count": 10**9}, "count of Gaussians"),
        ({"count": True}, "count of Gaussians"),
        ({"count": "1" * 99999}, "^.{0,200}count of Gaussians.{0,200}$"),
        ({"scales": {"codebook": [0.0] * 255, "files": ["scales.webp"]}}, "scales.codebook"),
        ({"scales": {"codebook": [float("nan")] * 256, "files": ["scales.webp"]}}, "scales.codebook"),
        (
            {"scales": {"codebook": [1e9] * 256, "files": ["scales.webp"]}},
            "the scale of Gaussian 0 of 1 is not a finite number",
        ),
        (
            {"means": {"mins": [1e9] * 3, "maxs": [1e9] * 3, "files": ["low.webp", "high.webp"]}},
            "the position of Gaussian 0",
        ),
        ({"quats": {"files": ["../quats.webp"]}}, "picture 1 of quats"),
        ({"quats": {"files": ["gone.webp"]}}, "gone.webp is missing"),
        ({"quats": {"files": ["meta.json"]}}, "not a picture"),
        ({"quats": {"files": ["sh0.webp"]}}, "tag 51"),
        ({"shN": {"codebook": [0.0] * 256, "files": ["low.webp", "high.webp"]}}, "no palette"),
    ],
)
def test_invalid_metadata_is_refused_with_the_reason(changes: dict, message: str) -> None:
    with pytest.raises(HyrfDataError, match=message):
        sog.decode_files(hand_packed_bundle(**changes), "bad")


def test_a_zip_bomb_is_refused_before_it_is_unpacked() -> None:
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in hand_packed_bundle().items():
            archive.writestr(name, data if name == "meta.json" else data + bytes(10_000_000))
    with pytest.raises(HyrfDataError, match="far too many"):
        sog.unzip(bundle.getvalue(), "bomb")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_with_forged_sizes_is_refused_before_it_is_unpacked(method: int) -> None:
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w", method) as archive:
        archive.writestr("meta.json", bytes(10_000_000))
    data = bytearray(bundle.getvalue())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 100)
    tracemalloc.start()
    with pytest.raises(HyrfDataError, match="stored or deflated"):
        sog.unzip(bytes(data), "bomb")
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


@pytest.mark.parametrize("side", [300, 16000])
def test_a_picture_with_too_many_pixels_is_refused_before_it_is_decoded(side: int) -> None:
    file = io.BytesIO()
    Image.new("RGB" if side == 300 else "1", (side, side)).save(file, "PNG")
    with pytest.raises(HyrfDataError, match=r"quats.webp .*(pixels|picture)"):
        sog.decode_files(hand_packed_bundle() | {"quats.webp": file.getvalue()}, "bomb")


def test_only_files_named_in_the_metadata_are_unpacked() -> None:
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w") as archive:
        for name, data in (hand_packed_bundle() | {"../evil": b"!"}).items():
            archive.writestr(name, data)
    assert set(sog.unzip(bundle.getvalue(), "bundle")) == set(hand_packed_bundle())


@examples(150)
@given(st.data())
def test_mutated_bundles_are_decoded_or_refused(data: st.DataObject) -> None:
    bundle = bytearray(SAMPLE_BUNDLE)
    for _ in range(data.draw(st.integers(1, 6))):
        bundle[data.draw(st.integers(0, len(bundle) - 1))] = data.draw(st.integers(0, 255))
    bundle = bundle[: data.draw(st.integers(0, 2 * len(bundle)))]
    try:
        sog.decode(bytes(bundle), "fuzz")
    except HyrfDataError:
        pass


@examples(150)
@given(st.data())
def test_mutated_files_are_decoded_or_refused(data: st.DataObject) -> None:
    files = dict(SAMPLE_FILES)
    name = data.draw(st.sampled_from(sorted(files)))
    changed = bytearray(files[name])
    for _ in range(data.draw(st.integers(1, 6))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    files[name] = bytes(changed)
    try:
        sog.decode_files(files, "fuzz")
    except HyrfDataError:
        pass


SAMPLE_FILES = sog.encode_files(random_splats(40))
SAMPLE_BUNDLE = sog.encode(random_splats(40))


def test_harmonics_of_a_failed_training_do_not_change_those_of_others(caplog) -> None:
    splats = random_splats(300)
    splats.harmonics[7, 5, 1] = 1e20
    decoded = sog.decode(sog.encode(splats), "x.sog")
    usual = sog.decode(sog.encode(random_splats(300)), "x.sog")
    assert np.isfinite(decoded.harmonics).all() and np.abs(decoded.harmonics).max() == pytest.approx(1e5, rel=1e-3)
    normal = np.abs(decoded.harmonics).max(axis=(1, 2)) < 10
    assert normal.sum() == len(usual) - 1
    assert "harmonics of 1 of 300 Gaussians are beyond 100,000" in caplog.text
