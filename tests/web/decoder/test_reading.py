"""The JavaScript decoder returns the same bits as hyrfpack and refuses the same files.

Every number of every codec is exact: codes are integers, and floats are float32 results of float64 operations that
docs/reference/format.md prescribes one by one. So arrays are compared by hash, without a tolerance.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch
from forged_files import (
    CONSTANT_PAYLOADS,
    EXTRA_DECODED_BYTES,
    EXTRA_GAUSSIANS,
    SMALL_HOSTILE_FILES,
    assemble_file,
    build_file,
    channel_payload,
    file_with_empty_deflate_blocks,
    file_with_largest_tables,
    file_with_most_gaussians,
    make_meta,
    metadata_json,
    points_payload,
    section_shapes,
    zero_payloads,
)

from hyrfpack.format import encode_model
from hyrfpack.format.arrays import SECTION_PARAMETERS
from hyrfpack.format.container import read_container
from hyrfpack.format.sections import LAYERED_SECTIONS, SECTION_CONTENTS, layer_section
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.quant import huffman_encode, rans_lanes
from hyrfpack.quant.bits import pack_bits
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.rans_models import adaptive_frequencies, iter_update_ranges
from tools.safety.fuzz_browser import compare, find_disagreement, read_in_javascript, read_in_python
from tools.safety.fuzz_mutate import INPUT_KINDS, RawSection, assemble, disassemble, load_seed_files
from tools.safety.make_golden import add_golden_residuals
from tools.safety.synthetic_encoding import encode

TESTS_FOLDER = Path(__file__).parents[2]
GOLDEN_FILES = sorted((TESTS_FOLDER / "golden").glob("*.hyrf"))
CORPUS_FILES = sorted((TESTS_FOLDER / "fuzz" / "corpus").glob("*/*.hyrf"))


def check_readers_agree(files: dict[str, bytes], cut: bool = False) -> tuple[list[str], list[str]]:
    """Assert that both readers agree on these files; return the names of accepted files and of refused files."""
    accepted: list[str] = []
    refused: list[str] = []
    for (name, data), verdict in zip(
        files.items(), read_in_javascript([(data, cut) for data in files.values()]), strict=True
    ):
        assert not find_disagreement(read_in_python(data, cut), verdict), name
        (refused if verdict.refused else accepted).append(name)
    return accepted, refused


def random_model(seed: int, count: int) -> HybridModel:
    """Return a model with a random configuration."""
    rng = np.random.default_rng(seed)

    def grid() -> HashGridConfig:
        base = int(rng.integers(2, 9))
        levels, finest = int(rng.integers(1, 7)), int(rng.integers(base, 65))
        return HashGridConfig(int(rng.integers(4, 11)), levels, base, finest)

    config = ModelConfig(
        frame=Frame(tuple(rng.normal(size=3) * 100), float(rng.uniform(0.01, 50)), tuple(rng.uniform(0.25, 1, 3))),
        geometry=grid(),
        radiance=grid(),
        hidden=int(rng.integers(1, 20)),
        background=bool(rng.integers(2)),
        scale_rule=str(rng.choice(["sum", "product"])),
        scale_grows=bool(rng.integers(2)),
        direction_encoding=str(rng.choice(["sh", "frequency"])),
        antialiased=bool(rng.integers(2)),
    )
    values = torch.from_numpy(rng.normal(size=(count, 8)).astype(np.float32))
    model = HybridModel(config, Gaussians(values[:, :3], values[:, 3:6], values[:, 6:7], values[:, 7:]))
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.from_numpy(rng.laplace(scale=0.1, size=parameter.shape)))
    return add_golden_residuals(model, seed % 3) if seed % 2 else model


def test_golden_files_decode_to_the_recorded_numbers():
    verdicts = read_in_javascript([(file.read_bytes(), False) for file in GOLDEN_FILES])

    for file, verdict in zip(GOLDEN_FILES, verdicts, strict=True):
        recorded = np.load(file.with_suffix(".npz"))
        assert verdict.whole and sum(verdict.layers) == len(recorded["gaussians.positions"]), file.stem
        for group, names in SECTION_PARAMETERS.items():
            if names[0] not in recorded:  # a model without residuals
                continue
            numbers = b"".join(recorded[name].astype("<f4").tobytes() for name in names)
            assert verdict.groups[group] == hashlib.sha256(numbers).hexdigest(), (file.stem, group)


@pytest.mark.parametrize("major", [0, 2])
def test_a_file_of_an_unknown_version_is_refused_by_the_version_that_is_read(major: int):
    data = bytearray(GOLDEN_FILES[0].read_bytes())
    data[8:12] = struct.pack("<2H", major, 3)
    (verdict,) = read_in_javascript([(bytes(data), False)])
    assert f"version {major}.3 and this reader knows version 1" in verdict.refused and "newer" not in verdict.refused


def test_random_configurations_decode_to_the_same_numbers():
    files = {}
    for seed in range(6):
        model = random_model(seed, (0, 1, 2, 7, 150, 400)[seed % 6])
        for profile in ("raw", "paper", "compact"):
            files[f"{profile} {seed}"] = encode(model, profile)
        files[f"layers {seed}"] = encode(model, "compact", distortion=1e-6, prune=False, layered=True)

    accepted, _ = check_readers_agree(files)

    assert accepted == list(files)


def test_every_group_in_every_codec_decodes_to_the_same_numbers():
    files = {str(number): data for number, data in enumerate(load_seed_files()[0])}

    accepted, _ = check_readers_agree(files)

    assert accepted == list(files)


@pytest.mark.acceptance
def test_streams_of_many_lanes_decode_to_the_same_numbers():
    """The file has dozens of lanes, static and adaptive models, and a layer of which every second point is counted."""
    data = encode(random_model(3, 160_000), "compact", prune=False)
    assert read_container(data)["POSI"].raw_length // 12 > 65536

    accepted, _ = check_readers_agree({"many": data})

    assert accepted


def random_morton_codes(rng: np.random.Generator, count: int, base: int) -> np.ndarray:
    """Return sorted random Morton codes (count,) int64, which include the smallest and the largest code."""
    codes = rng.integers(0, 1 << 3 * base, count)
    codes[:2] = 0, (1 << 3 * base) - 1
    return np.sort(codes)


def test_points_of_any_depth_decode_to_the_same_numbers():
    """Codes have up to 54 bits, more than a JavaScript number holds exactly, and tails have up to 51."""
    files, count = {}, 300
    for base in (1, 2, 8, 9, 10, 17, 18):
        rng = np.random.default_rng(base)
        bits = [base, 18, min(base + 1, 18), (base + 18) // 2]
        classes = rng.integers(0, 4, count).astype(np.uint8)
        tails = pack_bits(
            rng.integers(0, 1 << 54, count).astype(np.uint64), (3 * (np.array(bits) - base)).astype(np.uint8)[classes]
        )
        meta = make_meta(count)
        payload = points_payload(random_morton_codes(rng, count, base), base, bits, classes, tails)
        files[f"base {base}"] = build_file(meta, zero_payloads(meta) | {"POSI": (6, payload)})

    accepted, _ = check_readers_agree(files)

    assert accepted == list(files)


def test_points_one_step_outside_the_cube_are_refused():
    files, meta = {}, make_meta(2)
    for base in (1, 8, 9, 10, 17, 18):
        for step, place in enumerate(("inside", "outside")):
            codes = np.array([5, (1 << 3 * base) - 1]) + step
            payload = points_payload(codes, base, [base], np.zeros(2, np.uint8))
            files[f"{place}, base {base}"] = build_file(meta, zero_payloads(meta) | {"POSI": (6, payload)})

    accepted, refused = check_readers_agree(files)

    assert len(accepted) == len(refused) == 6 and all(name.startswith("inside") for name in accepted)


def test_channels_at_their_limits_decode_to_the_same_numbers():
    """The cases cover all step sizes, every weight and residuals up to their limits; a larger residual is refused."""
    rng, files = np.random.default_rng(5), {}
    for weight in range(17):
        count = int(rng.integers(2, 200))
        classes = rng.integers(0, 16, count).astype(np.uint8)
        points = points_payload(random_morton_codes(rng, count, 5), 5, [5] * 16, classes)
        codes = bytes(rng.integers(0, 256, 16).tolist())
        steps = np.array([(8 + code % 8) << code // 8 for code in codes])[classes]
        limits = np.minimum((1 << 39) // steps, 1 << 30)
        differences = rng.integers(-limits, limits + 1)
        differences[0] = limits[0]
        meta = make_meta(count)
        basis = rng.uniform(-1, 1, 9).astype("<f4").tobytes()
        good, beyond = (
            channel_payload(values, classes, codes, rng.uniform(-4096, 4096), weight)
            for values in (differences, differences + (np.arange(count) == 0))
        )
        one = {"POSI": (6, points), "COLO": (7, basis + 3 * good), "SCAL": (7, good), "OPAC": (7, good)}
        files[f"good {weight}"] = build_file(meta, zero_payloads(meta) | one)
        files[f"beyond {weight}"] = build_file(meta, zero_payloads(meta) | one | {"OPAC": (7, beyond)})

    accepted, refused = check_readers_agree(files)

    assert len(accepted) > 10 and len(accepted) == len(refused)
    assert all(name.startswith("good") for name in accepted)


def test_groups_at_their_limits_decode_to_the_same_numbers():
    rng, files = np.random.default_rng(6), {}
    meta = make_meta(0, hidden=30)
    count = 2 * 30 + 8 + 3
    for largest in (1 << 24, (1 << 24) + 1):
        codes = rng.integers(0, 256, count)
        codes[0] = 255
        models = rng.integers(0, 8, int((codes > 0).sum()))
        sizes = [size for inputs, outputs in ((2, 30), (30, 30), (30, 8)) for size in [inputs] * outputs + [outputs]]
        all_models = np.zeros(count, np.int64)
        all_models[codes > 0] = models
        contexts = np.repeat(all_models, sizes)[np.repeat(codes > 0, sizes)].astype(np.uint8)
        symbols = rng.integers(-(1 << 24), (1 << 24) + 1, len(contexts))
        symbols[:2] = largest, -(1 << 24)
        parts = encode_integers(codes), encode_integers(models), encode_integers(symbols, contexts, signed=True)
        payload = np.array([len(parts[0]), len(parts[1])], "<u4").tobytes() + b"".join(parts)
        files[str(largest)] = build_file(meta, zero_payloads(meta) | {"GMLP": (8, payload)})

    assert check_readers_agree(files) == ([str(1 << 24)], [str((1 << 24) + 1)])


@pytest.fixture(scope="module")
def layered_file() -> bytes:
    """Return the golden file whose Gaussians are stored in layers."""
    return next(file for file in GOLDEN_FILES if file.stem == "v1.1_compact_layers").read_bytes()


def test_truncated_files_are_read_or_refused_as_in_python(layered_file):
    entries = read_container(layered_file, SECTION_CONTENTS).entries.values()
    ends = {end + step for entry in entries for end in (entry.offset + entry.length, entry.end) for step in (-1, 0, 1)}
    cuts = sorted({*range(0, len(layered_file), 67), *ends, len(layered_file)} - {len(layered_file) + 1})

    accepted, refused = check_readers_agree({str(cut): layered_file[:cut] for cut in cuts}, cut=True)

    assert len(accepted) > 10 and len(refused) > 50
    first_layer = max(entry.end for entry in entries if entry.type[:4] not in _sections_of_further_layers())
    assert min(map(int, accepted)) == first_layer and max(map(int, refused)) < first_layer


def _sections_of_further_layers() -> set[str]:
    return {layer_section(group, layer) for group in LAYERED_SECTIONS for layer in range(1, 8)}


def test_the_reader_reports_which_layers_it_has_read(layered_file):
    whole, most = read_in_javascript([(layered_file, False), (layered_file[:-8], True)])

    assert whole.whole and not most.whole and most.layers == whole.layers[:-1]


def test_a_truncated_file_is_refused_when_the_whole_file_is_required(layered_file):
    (verdict,) = read_in_javascript([(layered_file[:-8], False)])

    assert verdict.refused.startswith("The file is truncated: its header says ")


def test_trailing_bytes_are_refused_when_truncation_is_allowed(layered_file):
    _, refused = check_readers_agree({"longer": layered_file + b"\0"}, cut=True)

    assert refused


# For each case: the bytes to replace in valid metadata, their replacement, and whether the result is valid.
JSON_CASES: dict[str, tuple[bytes, bytes, bool]] = {
    "as it is": (b"", b"", True),
    "float for an integer": (b'"gaussians":0', b'"gaussians":0.0', False),
    "exponent for an integer": (b'"gaussians":0', b'"gaussians":0e0', False),
    "minus zero": (b'"gaussians":0', b'"gaussians":-0', True),
    "boolean for an integer": (b'"hidden":1', b'"hidden":true', False),
    "null for an integer": (b'"hidden":1', b'"hidden":null', False),
    "beyond 64 bits": (b'"hidden":1', b'"hidden":%d' % 2**63, False),
    "digits for a boolean": (b'"background":true', b'"background":1', False),
    "integer for a float": (b'"scale":1.0', b'"scale":1', True),
    "large integer for a float": (b'"scale":1.0', b'"scale":1' + b"0" * 300, True),
    "too large integer for a float": (b'"scale":1.0', b'"scale":1' + b"0" * 309, False),
    "overflowing float": (b'"scale":1.0', b'"scale":1e400', False),
    "underflowing float": (b'"scale":1.0', b'"scale":1e-400', False),
    "least float": (b'"scale":1.0', b'"scale":5e-324', True),
    "negative": (b'"scale":1.0', b'"scale":-1.0', False),
    "NaN": (b'"writer":""', b'"writer":"","x":NaN', False),
    "infinity": (b'"writer":""', b'"writer":"","x":-Infinity', False),
    "overflow where it means nothing": (b'"writer":""', b'"writer":"","x":1e400', False),
    "400 digits where they mean nothing": (b'"writer":""', b'"writer":"","x":' + b"7" * 400, True),
    "4,300 digits": (b'"writer":""', b'"writer":"","x":-' + b"7" * 4300, True),
    "4,301 digits": (b'"writer":""', b'"writer":"","x":-' + b"7" * 4301, False),
    "4,301 digits of a float": (b'"writer":""', b'"writer":"","x":0.' + b"7" * 4301, True),
    "unknown key": (b'"writer":""', b'"writer":"","x":[{}]', True),
    "key of JavaScript": (b'"writer":""', b'"writer":"","__proto__":{"hidden":7}', True),
    "key of JavaScript in config": (b'"hidden":1', b'"hidden":1,"__proto__":1', False),
    "key of JavaScript for another": (b'"hidden":1', b'"toString":1', False),
    "unknown key in config": (b'"hidden":1', b'"hidden":1,"x":1', False),
    "unknown key in a grid": (b'"levels":1', b'"levels":1,"x":1', False),
    "unknown key in the frame": (b'"scale":1.0', b'"scale":1.0,"x":1', False),
    "rotation": (b'"scale":1.0', b'"scale":1.0,"rotation":[0.6,0,-0.8,0.0]', True),
    "no rotation": (b'"scale":1.0', b'"scale":1.0,"rotation":[1,0,0,0]', True),
    "rotation of nearly unit length": (b'"scale":1.0', b'"scale":1.0,"rotation":[0,-0.9999991,0,0]', True),
    "shorter rotation": (b'"scale":1.0', b'"scale":1.0,"rotation":[0,-0.9999989,0,0]', False),
    "longer rotation": (b'"scale":1.0', b'"scale":1.0,"rotation":[0,1.0000011,0,0]', False),
    "rotation of length 0": (b'"scale":1.0', b'"scale":1.0,"rotation":[0,0,0,0]', False),
    "rotation of huge numbers": (b'"scale":1.0', b'"scale":1.0,"rotation":[1e308,1e308,1e308,1e308]', False),
    "rotation of three numbers": (b'"scale":1.0', b'"scale":1.0,"rotation":[1,0,0]', False),
    "rotation of five numbers": (b'"scale":1.0', b'"scale":1.0,"rotation":[1,0,0,0,0]', False),
    "rotation with text": (b'"scale":1.0', b'"scale":1.0,"rotation":["1",0,0,0]', False),
    "rotation with a boolean": (b'"scale":1.0', b'"scale":1.0,"rotation":[true,0,0,0]', False),
    "rotation is null": (b'"scale":1.0', b'"scale":1.0,"rotation":null', False),
    "rotation for the scale": (b'"scale":1.0', b'"rotation":[1,0,0,0]', False),
    "rotation of the config": (b'"hidden":1', b'"hidden":1,"rotation":[1,0,0,0]', False),
    "unknown rule": (b'"hash":"instant-ngp"', b'"hash":"instant-ngp","x":1', False),
    "unknown rule that is null": (b'"hash":"instant-ngp"', b'"hash":"instant-ngp","x":null', False),
    "integer in a rule": (b'"background_radius":100.0', b'"background_radius":100', True),
    "other spelling in a rule": (b'"background_radius":100.0', b'"background_radius":1E+2', True),
    "text in a rule": (b'"background_radius":100.0', b'"background_radius":"100"', False),
    "equal keys, the last one right": (b'"hidden":1', b'"hidden":7,"hidden":1', True),
    "equal keys, the last one wrong": (b'"hidden":1', b'"hidden":1,"hidden":0', False),
    "layers are null": (b'"writer":""', b'"writer":"","layers":null', False),
    "layers are empty": (b'"writer":""', b'"writer":"","layers":[]', True),
    "one empty layer": (b'"writer":""', b'"writer":"","layers":[0]', True),
    "a layer of minus one": (b'"writer":""', b'"writer":"","layers":[1,-1]', False),
    "a layer with a point": (b'"writer":""', b'"writer":"","layers":[0.0]', False),
    "nine layers": (b'"writer":""', b'"writer":"","layers":[0,0,0,0,0,0,0,0,0]', False),
    "a list too short": (b'"solid":[0.0,0.0,0.0]', b'"solid":[0.0,0.0]', False),
    "an object for a list": (b'"solid":[0.0,0.0,0.0]', b'"solid":{"length":3}', False),
    "64 levels": (b'"writer":""', b'"writer":"","x":' + b"[" * 63 + b"]" * 63, True),
    "65 levels": (b'"writer":""', b'"writer":"","x":' + b"[" * 64 + b"]" * 64, False),
    "65 levels of objects": (b'"writer":""', b'"writer":"","x":' + b'{"a":' * 64 + b"0" + b"}" * 64, False),
    "escapes": (b'"writer":""', rb'"writer":"\"\\\/\b\f\n\r\t\u00e9\uD83D\ude00"', True),
    "unknown escape": (b'"writer":""', rb'"writer":"\x41"', False),
    "short escape": (b'"writer":""', rb'"writer":"\u00e"', False),
    "half of a pair": (b'"writer":""', rb'"writer":"\ud83d"', True),
    "half of a pair for a choice": (b'"scale_rule":"sum"', rb'"scale_rule":"\ud83d"', False),
    "escaped choice": (b'"scale_rule":"sum"', rb'"scale_rule":"\u0073um"', True),
    "line end in text": (b'"writer":""', b'"writer":"\n"', False),
    "delete in text": (b'"writer":""', b'"writer":"\x7f"', True),
    "line separator in text": (b'"writer":""', '"writer":"\u2028"'.encode(), True),
    "text without end": (b'"writer":""', b'"writer":"\\"', False),
    "no UTF-8": (b'"writer":""', b'"writer":"\xff"', False),
    "surrogate in UTF-8": (b'"writer":""', b'"writer":"\xed\xa0\x80"', False),
    "overlong UTF-8": (b'"writer":""', b'"writer":"\xc0\x80"', False),
    "byte order mark": (b'{"gauss', b'\xef\xbb\xbf{"gauss', False),
    "blanks": (b'"writer":""', b' \t\r\n"writer" \t\r\n: \t\r\n"" \t\r\n', True),
    "blank of another kind": (b'"writer":""', b'\f"writer":""', False),
    "blank that does not break": (b'"writer":""', b'\xc2\xa0"writer":""', False),
    "comma at the end": (b'"writer":""', b'"writer":"",', False),
    "comma at the end of a list": (b'"writer":""', b'"writer":"","x":[1,]', False),
    "two commas": (b'"writer":""', b'"writer":"",,"x":1', False),
    "quotes of another kind": (b'"writer":""', b"'writer':''", False),
    "comment": (b'"writer":""', b'"writer":""/**/', False),
    "leading zero": (b'"writer":""', b'"writer":"","x":01', False),
    "plus": (b'"writer":""', b'"writer":"","x":+1', False),
    "point first": (b'"writer":""', b'"writer":"","x":.5', False),
    "point last": (b'"writer":""', b'"writer":"","x":1.', False),
    "exponent without digits": (b'"writer":""', b'"writer":"","x":1e', False),
    "hexadecimal": (b'"writer":""', b'"writer":"","x":0x1', False),
    "words in capitals": (b'"writer":""', b'"writer":"","x":True', False),
    "words run together": (b'"writer":""', b'"writer":"","x":truefalse', False),
    "undefined": (b'"writer":""', b'"writer":"","x":undefined', False),
    "text after the end": (b'"writer":""}', b'"writer":""}}', False),
    "zero after the end": (b'"writer":""}', b'"writer":""}\0', False),
    "no object": (b"{", b"[{", False),
}


def test_metadata_is_checked_as_strictly_as_in_python():
    meta = make_meta(0)
    payloads = zero_payloads(meta)
    valid = metadata_json(meta)
    files = {}
    for name, (old, new, _) in JSON_CASES.items():
        assert old in valid, name
        files[name] = assemble_file(valid.replace(old, new, 1), payloads, section_shapes(meta))
    files["empty"] = assemble_file(b"", payloads, section_shapes(meta))
    files["not an object"] = assemble_file(b"7", payloads, section_shapes(meta))

    accepted, _ = check_readers_agree(files)

    assert accepted == [name for name, (_, _, is_valid) in JSON_CASES.items() if is_valid]


def deflate_halves(
    text: bytes, level: int = 9, wbits: int = 15, strategy: int = 0, flush: int = 0, words: bytes = b""
) -> bytes:
    """Deflate the text as a zlib stream of two halves, with the given kind of flush between them."""
    make = zlib.compressobj(level, zlib.DEFLATED, wbits, 8, strategy, *((words,) if words else ()))
    middle = len(text) // 2
    return make.compress(text[:middle]) + make.flush(flush) + make.compress(text[middle:]) + make.flush()


def test_deflated_metadata_is_checked_as_strictly_as_in_python():
    meta = make_meta(0, {"why": "because " * 40, "letters": bytes(range(32, 127)).decode()})
    payloads, shapes, text = zero_payloads(meta), section_shapes(meta), metadata_json(meta)

    def packed(stream: bytes) -> bytes:
        return assemble_file(text, payloads, shapes, stream)

    streams = {
        f"level {level}, window {wbits}, strategy {strategy}": deflate_halves(
            text, level, wbits, strategy, zlib.Z_FULL_FLUSH
        )
        for level in (0, 1, 9)
        for wbits in (9, 15)
        for strategy in (zlib.Z_DEFAULT_STRATEGY, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FIXED)
    }
    valid = list(streams)
    good = streams[valid[-1]]
    streams |= {"byte after it": good + b"\0", "cut": good[:-1], "checksum": good[:-1] + bytes([good[-1] ^ 1])}
    streams |= {"no header": deflate_halves(text, wbits=-15), "gzip": deflate_halves(text, wbits=31)}
    streams |= {
        "dictionary": deflate_halves(text, words=b"because"),
        "another text": deflate_halves(text + b" "),
    }
    streams |= {
        "shorter text": deflate_halves(text[:-1]),
        "bomb": deflate_halves(text + b" " * 10_000_000),
    }
    rng = Random(1)
    for number in range(400):
        damaged = bytearray(streams[rng.choice(valid)])
        damaged[rng.randrange(min(len(damaged), rng.choice((4, 60, 10_000))))] ^= 1 << rng.randrange(8)
        streams[f"damaged {number}"] = bytes(damaged)

    accepted, _ = check_readers_agree(
        {name: assemble_file(text, payloads, shapes, data) for name, data in streams.items()}
    )

    assert accepted[: len(valid)] == valid and len(accepted) < len(valid) + 40


def encode_tokens_in_lanes(tokens: np.ndarray, lanes_log2: int) -> bytes:
    """Encode tokens in 2^lanes_log2 lanes, which the coder allows even where the file format forbids it."""
    lanes, alphabet = rans_lanes.LaneLayout(len(tokens), 1 << lanes_log2), int(tokens.max()) + 1
    selector, counts, segments = (
        rans_lanes.ModelSelector(None, np.zeros(alphabet, np.uint8), 1),
        np.zeros((1, alphabet)),
        [],
    )
    counts = counts.astype(np.int64)
    for start, stop in iter_update_ranges(lanes.steps):
        segments.append((start, stop, adaptive_frequencies(counts)))
        counts += rans_lanes.count_tokens(tokens, selector, lanes, start, stop, counts.shape)
    states, words = rans_lanes.encode_lanes(tokens, selector, lanes, segments)
    return bytes((lanes_log2, alphabet)) + states.astype("<u4").tobytes() + words.astype("<u2").tobytes()


def file_with_opacity_stream(stream: bytes, classes: np.ndarray, steps: bytes = b"\x40") -> bytes:
    """Build a file whose opacities are one channel that holds this stream."""
    meta = make_meta(len(classes))
    points = points_payload(np.zeros(len(classes), np.int64), 1, [1] * 16, classes)
    payload = struct.pack("<fBIB", 0.5, 16, len(stream), len(steps)) + steps + stream
    return build_file(meta, zero_payloads(meta) | {"POSI": (6, points), "OPAC": (7, payload)})


@pytest.mark.acceptance
def test_too_many_and_too_long_lanes_are_refused():
    few, many = np.array([0, 1, 2, 1, 0], np.uint8), np.zeros(65537, np.uint8)
    many[7] = 1
    files = {
        f"{log2} lanes": file_with_opacity_stream(encode_tokens_in_lanes(few, log2), np.zeros(5, np.uint8))
        for log2 in (0, 13, 14)
    }
    files |= {
        f"{count} tokens": file_with_opacity_stream(encode_tokens_in_lanes(many[:count], 0), np.zeros(count, np.uint8))
        for count in (65536, 65537)
    }

    assert check_readers_agree(files) == (["0 lanes", "13 lanes", "65536 tokens"], ["14 lanes", "65537 tokens"])


def test_single_numbers_out_of_range_are_refused():
    """One file has a number just outside its range, and a second file has the same number just inside."""
    zeros, classes = np.zeros(8, np.int64), np.arange(8).astype(np.uint8) % 2
    largest = 1 + 2**-10
    files = {}
    for step in (0, 1):
        name = "beyond" if step else "good"
        basis = np.eye(3, dtype="<f4")
        basis[0, 0] = np.nextafter(np.float32(largest), np.float32(2)) if step else largest
        meta = make_meta(8)
        points = {"POSI": (6, points_payload(zeros, 1, [1] * 16, classes))}
        flat = channel_payload(zeros, classes, b"\x40\x40", 0.5, 0)
        files[f"{name} basis"] = build_file(
            meta, zero_payloads(meta) | points | {"COLO": (7, basis.tobytes() + 3 * flat)}
        )
        files[f"{name} step sizes"] = file_with_opacity_stream(
            encode_integers(zeros, classes, signed=True), classes, bytes(2 - step)
        )
        large = zeros + (step << 32) * (classes == 1)  # the lower 32 bits are 0, also after folding the sign
        files[f"{name} difference"] = file_with_opacity_stream(
            encode_integers(large, classes, signed=True), classes, b"\x40\x40"
        )
        base = 1 - step
        files[f"{name} base"] = build_file(
            meta, zero_payloads(meta) | {"POSI": (6, points_payload(zeros, base, [base], 0 * classes))}
        )
        one = make_meta(1)
        tail = struct.pack("<BBII", 1, 1, 3, 4) + b"\2" + 7 * b"\0" + bytes([step << 3])
        files[f"{name} bits left over"] = build_file(one, zero_payloads(one) | {"POSI": (6, tail)})
        words = struct.pack("<BBH", 1, 1, 1 - step) + bytes(2 - 2 * step) + struct.pack("<Q", 26)
        empty = make_meta(0)
        none = words + struct.pack("<QQIIBB", 0, 0, 0, 0, 1, 2)
        files[f"{name} codewords"] = build_file(empty, zero_payloads(empty) | {"OPAC": (3, none)})
        unused = struct.pack("<BBH", 1, 1, 2) + b"\0\0" + struct.pack("<e", np.inf if step else 1.0)
        stream = huffman_encode(np.zeros(8, np.uint8)).to_bytes()
        unused += struct.pack("<Q", len(stream)) + stream
        files[f"{name} codeword"] = build_file(meta, zero_payloads(meta) | {"OPAC": (3, unused)})
        chunks = bytearray(huffman_encode((np.arange(1500) % 3).astype(np.uint8)).to_bytes())
        at = 26 + chunks[16] + chunks[16] - 1
        first, second = struct.unpack_from("<HH", chunks, at)
        struct.pack_into("<HH", chunks, at, first + step, second - step)
        long = make_meta(1500)
        files[f"{name} chunk"] = build_file(
            long, zero_payloads(long) | {"OPAC": (4, struct.pack("<ffB", 0, 1, 2) + chunks)}
        )

    accepted, refused = check_readers_agree(files)

    assert [name.split()[0] for name in (*accepted, *refused)] == ["good"] * len(accepted) + ["beyond"] * len(refused)
    assert len(accepted) == len(refused)


def test_every_file_of_the_corpus_gets_the_same_verdict():
    _, refused = check_readers_agree({file.stem: file.read_bytes() for file in CORPUS_FILES})

    assert len(refused) > 50


@pytest.mark.parametrize(
    ("count", "limit_per_byte", "words"),
    [(50_000, 1024, "say they decode to"), (0, 32, "Gaussians")],
    ids=["bytes", "Gaussians"],
)
def test_declared_bytes_and_gaussians_are_limited_by_the_length_of_the_file(count, limit_per_byte, words):
    """At the limit the reader finds that POSI is empty; one Gaussian more is refused before POSI is read."""
    grid = {"log2_table_size": 24, "levels": 1, "base": 144 if count else 2, "finest": 144 if count else 2}
    empty = dict.fromkeys(("POSI", "COLO", "SCAL", "OPAC"), (1, b"")) | {
        "GTAB": CONSTANT_PAYLOADS["GTAB"],
        "RTAB": CONSTANT_PAYLOADS["RTAB"],
    }
    decoders = {group: part for group, part in zero_payloads(make_meta(0)).items() if group.endswith("MLP")}

    def file_and_slack(count: int) -> tuple[bytes, int]:
        data = build_file(make_meta(count, geometry=grid, radiance=grid), decoders | empty)
        raw = sum(entry.raw_length for entry in read_container(data, SECTION_CONTENTS, fraction=0).entries.values())
        if limit_per_byte == 1024:
            return data, (EXTRA_DECODED_BYTES + 1024 * len(data) - raw) // 32
        return data, EXTRA_GAUSSIANS + 32 * len(data) - count

    for _ in range(3):  # a count with more digits makes the file longer
        count += file_and_slack(count)[1]
    files = [file_and_slack(count + step)[0] for step in (0, 1)]
    at, beyond = read_in_javascript([(data, False) for data in files])

    assert at.refused.startswith("Section 'POSI'") and "'POSI'" in read_in_python(files[0]).refused
    assert words in beyond.refused and words in read_in_python(files[1]).refused
    assert "'POSI'" not in beyond.refused


def test_missing_layers_of_a_truncated_file_may_declare_any_size():
    meta = make_meta(1 << 39) | {"layers": [0, 1 << 39]}
    tags = {layer_section(group, 1): 1 << 39 for group in LAYERED_SECTIONS}
    parts = disassemble(build_file(make_meta(0), zero_payloads(make_meta(0))))
    parts[0] = RawSection(b"META", 0, 1, metadata_json(meta), len(metadata_json(meta)))
    parts += [RawSection(tag.encode(), 1, 1, b"12345678", 4 * (3, 3, 1, 1)[k] << 39) for k, tag in enumerate(tags)]
    data = assemble(parts)

    assert check_readers_agree({"start": data[:-32]}, cut=True) == (["start"], [])
    assert check_readers_agree({"whole": data}) == ([], ["whole"])


@pytest.mark.parametrize("count", [120, pytest.param(800, marks=pytest.mark.acceptance)])
def test_hostile_files_get_the_same_verdict(count):
    tally = compare(range(100_000, 100_000 + count), seed=3)

    assert not tally.failures
    assert set(tally.kinds) == set(INPUT_KINDS) and tally.accepted.total() > count / 40


def test_small_hostile_files_are_read_or_refused_soon():
    files = {name: make() for name, make in SMALL_HOSTILE_FILES.items()}
    assert max(map(len, files.values())) < 3000

    verdicts = read_in_javascript([(data, False) for data in files.values()])

    for (name, data), verdict in zip(files.items(), verdicts, strict=True):
        python = read_in_python(data)
        assert bool(verdict.refused) == bool(python.refused), name
        # Half a second of CPU time is enough on most machines. Python's time shows how slow this one is.
        assert verdict.seconds < max(0.5, 3 * python.seconds) and not verdict.failed, name


def test_many_empty_deflate_blocks_are_read_soon():
    """There are some 160,000 of them, for each of which a slow reader builds its tables again."""
    data = file_with_empty_deflate_blocks(text_bytes=200_000, added_bytes=0)

    (verdict,) = read_in_javascript([(data, False)])

    python = read_in_python(data)
    assert verdict.groups and not python.refused
    assert verdict.seconds < max(0.5, 3 * python.seconds)


def test_deflated_metadata_is_at_most_1024_bytes_longer_than_its_text():
    files = {str(added): file_with_empty_deflate_blocks(1000, added) for added in (1024, 1025)}

    assert check_readers_agree(files) == (["1024"], ["1025"])


@pytest.mark.parametrize("make", [file_with_most_gaussians, file_with_largest_tables], ids=lambda make: make.__name__)
def test_the_largest_models_that_fit_a_kilobyte_are_read_in_bounded_memory(make):
    small, largest = read_in_javascript([(GOLDEN_FILES[0].read_bytes(), False), (make(), False)])

    assert largest.groups and largest.seconds < 10
    # The small file shows the memory that node itself needs, which depends on the machine.
    assert largest.peak - small.peak < 4 * EXTRA_DECODED_BYTES


def test_an_unknown_section_is_ignored_if_optional_and_refused_if_required():
    raw = encode_model(random_model(2, 5), "raw")
    files = {"optional": assemble([*disassemble(raw), RawSection(b"NEW_", 99, 0, b"abc", 0)])}
    files["required"] = assemble([*disassemble(raw), RawSection(b"NEW_", 99, 1, b"abc", 0)])

    assert check_readers_agree(files) == (["optional"], ["required"])
