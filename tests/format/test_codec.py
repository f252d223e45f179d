"""Encode and decode models as `.hyrf` files: exactness, error bounds and the refusal of hostile files."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import decode_model, describe_file, encode_model, load_model, repack, save_model
from hyrfpack.format.container import MINOR_VERSION, Section, read_container, write_container
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from tools.safety.synthetic_encoding import encode, quantize_with_drawn_sensitivity

ALL_PROFILES = ("raw", "paper", "compact")


def make_model(count: int = 40, grid: HashGridConfig | None = None, **config) -> HybridModel:
    """Return a small model with seeded random values of every parameter."""
    generator = torch.Generator().manual_seed(count)
    grid = grid or HashGridConfig(log2_table_size=6, levels=3, base=3, finest=9)
    frame = Frame(center=(10.0, -2.5, 0.125), scale=3.5, half_extent=(1.0, 0.5, 0.25))
    shape = ModelConfig(frame=frame, geometry=grid, radiance=grid, hidden=5, solid=(1.0, 0.5, 0.0), **config)
    values = torch.randn(count, 8, generator=generator)
    model = HybridModel(shape, Gaussians(values[:, :3], values[:, 3:6], values[:, 6:7], 3 * values[:, 7:]), generator)
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return model


def float_bits(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy().view(np.uint32)


def replace_payloads(data: bytes, **changes: bytes | None) -> bytes:
    """Replace payloads of sections (None drops the section), with valid checksums and uncompressed metadata."""
    sections = []
    for section in read_container(data).sections:
        if section.type == "META" and "META" not in changes:
            changes = {**changes, "META": metadata_text(data)}
        payload = changes.get(section.type, section.data)
        if payload is not None and section.type == "META":
            sections.append(replace(section, codec=0, data=payload, raw_length=len(payload)))
        elif payload is not None:
            sections.append(replace(section, data=payload))
    return write_container(sections, minor=MINOR_VERSION)


def metadata_text(data: bytes) -> bytes:
    section = read_container(data)["META"]
    return zlib.decompress(section.data) if section.codec == 5 else bytes(section.data)


def parse_metadata(data: bytes) -> dict:
    return json.loads(metadata_text(data))


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_raw_is_bit_exact(count):
    model = make_model(count)
    if count:
        with torch.no_grad():
            model.gaussians.positions[0] = torch.tensor([-0.0, 1e-45, -3.4e38])

    decoded = decode_model(encode_model(model, "raw"))

    for name, expected in model.state_dict().items():
        assert np.array_equal(float_bits(decoded.state_dict()[name]), float_bits(expected)), name


@pytest.mark.parametrize("profile", ALL_PROFILES)
@pytest.mark.parametrize(
    "config",
    [
        {},
        {"background": False, "antialiased": True, "scale_rule": "product", "scale_grows": False},
        {"direction_encoding": "frequency", "position_gradients": True},
    ],
)
def test_configuration_round_trips(profile, config):
    model = make_model(**config)

    decoded = decode_model(encode(model, profile))

    assert decoded.config == model.config
    assert not any(parameter.requires_grad for parameter in decoded.parameters())


@pytest.mark.parametrize("count", [0, 1, 3, 500])
def test_paper_stays_within_its_error_bounds(count):
    model = make_model(count)
    with torch.no_grad():  # keeps all opacities away from 0 and 1, where logits are clipped
        model.geometry.weights[-1][0], model.geometry.biases[-1][0] = 0, 0
    original = model.state_dict()

    decoded = decode_model(encode_model(model, "paper", color=(4, 64), scale=(2, 64), opacity=(2, 64))).state_dict()

    for name, expected in original.items():
        expected, got = expected.double(), decoded[name].double()
        assert got.shape == expected.shape
        if "table" in name:
            half_step = (expected.max() - expected.min()) / 510
            assert (got - expected).abs().max() <= half_step * (1 + 1e-6)
        elif "logits" not in name:
            assert ((got - expected).abs() <= expected.abs() * 2**-11 + 2**-25).all()
        elif count > 64:
            # One stage of 64 codewords in 3 dimensions leaves at most a quarter of the standard deviation.
            assert (got - expected).square().mean().sqrt() < 0.25 * expected.std()
        elif count:
            # With fewer rows than codewords, only the rounding of the codebooks remains.
            assert (got - expected).abs().max() <= expected.abs().max() * 2**-10


def test_more_stages_of_paper_lower_the_error_and_raise_the_size():
    model = make_model(2000)

    def size_and_error(stages: int) -> tuple[int, float]:
        data = encode_model(model, "paper", color=(stages, 64))
        error = decode_model(data).gaussians.color_logits - model.gaussians.color_logits
        return len(data), error.square().mean().item()

    (small, coarse), (middle, fine), (large, finest) = map(size_and_error, (1, 2, 4))

    assert small < middle < large
    assert coarse > 2 * fine > 4 * finest


def test_saturated_opacities_do_not_affect_other_opacities():
    model, with_tail = make_model(2000), make_model(2000)
    with torch.no_grad():
        with_tail.gaussians.opacity_logits[:200] = torch.linspace(40, 900, 200)[:, None]

    def worst_opacity(model: HybridModel) -> float:
        with torch.no_grad():
            decoded = decode_model(encode_model(model, "paper")).decode_geometry().opacities
            return (decoded - model.decode_geometry().opacities).abs().max().item()

    assert worst_opacity(with_tail) < 1.5 * worst_opacity(model)


def test_constant_channels_and_tables_are_exact():
    model = make_model(30)
    with torch.no_grad():
        model.geometry.grid.table.fill_(0.1)
        model.radiance.grid.table.zero_()
        for logits in (model.gaussians.color_logits, model.gaussians.scale_logits, model.gaussians.opacity_logits):
            logits.fill_(-1.5)

    decoded = decode_model(encode_model(model, "paper")).state_dict()

    for name, expected in model.state_dict().items():
        if "logits" in name or "table" in name:
            assert torch.equal(decoded[name], expected), name


@pytest.mark.parametrize("profile", ALL_PROFILES)
def test_encoding_is_deterministic(profile):
    provenance = {"steps": 1000, "preset": "standard", "why": {"table": "8 Gaussians an entry"}}

    first = encode(make_model(300), profile, provenance)
    second = encode(make_model(300), profile, dict(reversed(provenance.items())))

    assert first == second


@pytest.mark.parametrize("profile", ALL_PROFILES)
def test_encoding_changes_neither_the_model_nor_the_random_state(profile):
    model = make_model(300)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state = torch.get_rng_state()

    decode_model(encode(model, profile))

    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("profile", ALL_PROFILES)
@pytest.mark.parametrize(
    ("parameter", "holds"),
    [
        ("gaussians.positions", "positions"),
        ("gaussians.opacity_logits", "opacity logits"),
        ("radiance.grid.table", "radiance hash table"),
        ("geometry.biases.2", "geometry decoder"),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_save_refuses_nonfinite_values_with_the_name_of_the_group(tmp_path, profile, parameter, holds, value):
    model = make_model()
    planned = quantize_with_drawn_sensitivity(model).plan.apply if profile == "compact" else None
    with torch.no_grad():
        model.state_dict()[parameter].view(-1)[-1] = value

    with pytest.raises(HyrfError, match=f"1 of [0-9]+ numbers in the model's {holds} "):
        save_model(model, tmp_path / "model.hyrf", profile) if planned is None else planned(model)

    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("parameter", ["gaussians.positions", "gaussians.scale_logits", "radiance.weights.1"])
def test_paper_refuses_values_that_overflow_half_precision(parameter):
    model = make_model()
    with torch.no_grad():
        model.state_dict()[parameter].view(-1)[0] = -65505.0

    with pytest.raises(HyrfError, match="half precision"):
        encode_model(model, "paper")


def test_paper_stores_the_largest_half_precision_value():
    model = make_model()
    with torch.no_grad():
        model.gaussians.positions[0, 0] = 65504.0

    assert decode_model(encode_model(model, "paper")).gaussians.positions[0, 0] == 65504.0


def test_unknown_profile_and_settings_out_of_range_are_refused():
    with pytest.raises(HyrfError, match="no profile 'best'.*raw, paper, compact"):
        encode_model(make_model(), "best")
    with pytest.raises(HyrfError, match="0 stages"):
        encode_model(make_model(), "paper", color=(0, 64))
    with pytest.raises(HyrfError, match="257 codewords"):
        encode_model(make_model(), "paper", opacity=(1, 257))
    with pytest.raises(HyrfError, match="'compact' takes numbers .*; save the model with profile 'raw'"):
        encode_model(make_model(), "compact")


def test_provenance_that_is_not_json_is_refused():
    for provenance in ({"data": object()}, {"loss": float("nan")}, {"loss": -float("inf")}, {1: "a", "b": 2}):
        with pytest.raises(HyrfError, match="cannot be written as JSON .*give a provenance of finite numbers"):
            encode_model(make_model(), provenance=provenance)


def test_section_sizes_in_the_report_add_up_to_the_file(tmp_path):
    path = tmp_path / "model.hyrf"
    model = make_model(500)

    report = save_model(model, path, "paper")

    assert report.bytes_after == path.stat().st_size
    assert report.bytes_before == 4 * sum(parameter.numel() for parameter in model.parameters())
    stored = {size.type: size.after for size in report.sections}
    assert stored["POSI"] == 500 * 6
    # Outside the sections are a header of 48 bytes, 40 bytes for each section, and up to 7 bytes of padding for each.
    overhead = report.bytes_after - sum(stored.values()) - 48 - 40 * len(stored)
    assert 0 <= overhead < 8 * len(stored)


def test_repacking_keeps_configuration_and_provenance(tmp_path):
    model = make_model(100)
    save_model(model, tmp_path / "raw.hyrf", "raw", {"steps": 7})

    report = repack(tmp_path / "raw.hyrf", tmp_path / "paper.hyrf", "paper", color=(3, 16))
    repack(tmp_path / "paper.hyrf", tmp_path / "back.hyrf", "raw")

    assert (tmp_path / "paper.hyrf").read_bytes() == encode_model(model, "paper", {"steps": 7}, color=(3, 16))
    assert report.profile == "paper"
    back, once = load_model(tmp_path / "back.hyrf"), load_model(tmp_path / "paper.hyrf")
    assert all(torch.equal(a, b) for a, b in zip(back.parameters(), once.parameters(), strict=True))
    assert describe_file(tmp_path / "back.hyrf")["provenance"] == {"steps": 7}


@pytest.mark.integration
def test_describe_works_without_torch_and_numpy(tmp_path):
    path = tmp_path / "model.hyrf"
    save_model(make_model(500), path, "paper", {"steps": 30})
    program = (
        "import sys, json; from hyrfpack.format import describe_file; info = describe_file(sys.argv[1]);"
        "print(json.dumps([info, [name for name in ('torch', 'numpy', 'dahuffman') if name in sys.modules]]))"
    )

    output = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    info, imported = json.loads(output.stdout)

    assert imported == []
    assert info["gaussians"] == 500
    assert info["profile"] == "paper"
    assert info["version"] == "1.0"
    assert info["provenance"] == {"steps": 30}
    assert info["settings"] == {"color": [2, 128], "scale": [1, 128], "opacity": [1, 32], "seed": 0}
    assert info["config"] == json.loads(json.dumps(make_model(500).config.to_dict()))
    assert info["bytes"] == path.stat().st_size
    assert info["bits_per_gaussian"] == 8 * path.stat().st_size / 500
    (positions,) = (section for section in info["sections"] if section["type"] == "POSI")
    assert positions["bits_per_gaussian"] == 48
    assert positions["before"] == 6000


def test_describe_reads_deflated_metadata(tmp_path):
    model = make_model(500)
    (tmp_path / "model.hyrf").write_bytes(encode(model, "compact", {"steps": 30}))

    facts = describe_file(tmp_path / "model.hyrf")

    assert facts["profile"] == "compact" and facts["provenance"] == {"steps": 30} and facts["version"] == "1.1"
    assert facts["gaussians"] == len(load_model(tmp_path / "model.hyrf")) < facts["settings"]["gaussians_before"] == 500
    assert facts["config"] == json.loads(json.dumps(model.config.to_dict()))


def test_describe_of_an_empty_model_has_no_bits_per_gaussian(tmp_path):
    save_model(make_model(0), tmp_path / "empty.hyrf")

    assert describe_file(tmp_path / "empty.hyrf")["bits_per_gaussian"] is None


@pytest.mark.parametrize("profile", ALL_PROFILES)
def test_truncation_at_any_byte_is_refused(profile):
    data = encode(make_model(), profile)
    entries = read_container(data).entries.values()
    edges = {
        0,
        1,
        47,
        48,
        49,
        *(entry.offset for entry in entries),
        *(entry.offset + entry.length for entry in entries),
    }
    ends = {end for edge in edges for end in (edge - 1, edge, edge + 1) if 0 <= end < len(data)}

    for end in ends:
        with pytest.raises(HyrfFormatError):
            decode_model(data[:end])


@pytest.mark.parametrize("profile", ALL_PROFILES)
def test_a_flipped_bit_is_detected_anywhere(profile):
    small_codebooks = {"color": (2, 8), "scale": (1, 4), "opacity": (1, 4)} if profile == "paper" else {}
    data = bytearray(encode(make_model(5), profile, **small_codebooks))

    for position in range(0, len(data), 3):
        data[position] ^= 1 << position % 8
        with pytest.raises(HyrfFormatError):
            decode_model(data)
        data[position] ^= 1 << position % 8


def test_errors_contain_the_file_and_the_section(tmp_path):
    path = tmp_path / "model.hyrf"
    data = bytearray(encode_model(make_model()))
    data[read_container(data).entries["GTAB"].offset] ^= 1
    path.write_bytes(data)

    with pytest.raises(HyrfFormatError, match="model.hyrf.*'GTAB'"):
        load_model(path)


@pytest.mark.parametrize("profile", ALL_PROFILES)
@pytest.mark.parametrize("count", [0, 39, 41, 2**39])
def test_a_forged_count_is_refused(profile, count):
    data = encode(make_model(40), profile, **({"prune": False} if profile == "compact" else {}))
    forged = json.dumps(parse_metadata(data) | {"gaussians": count}).encode()

    with pytest.raises(HyrfFormatError):
        decode_model(replace_payloads(data, META=forged))


def test_a_forged_table_size_is_refused_before_any_allocation():
    data = encode_model(make_model())
    metadata = parse_metadata(data)
    metadata["config"]["geometry"] = {"log2_table_size": 24, "levels": 32, "base": 1024, "finest": 65536}

    with pytest.raises(HyrfFormatError, match="'GTAB' says it decodes to"):
        decode_model(replace_payloads(data, META=json.dumps(metadata).encode()))


@pytest.mark.parametrize("profile", ALL_PROFILES)
@pytest.mark.parametrize("type", ["META", "POSI", "RTAB", "GMLP"])
def test_a_missing_section_is_refused(profile, type):
    with pytest.raises(HyrfFormatError):
        decode_model(replace_payloads(encode(make_model(), profile), **{type: None}))


def test_an_unknown_codec_is_refused():
    sections = read_container(encode_model(make_model())).sections

    with pytest.raises(HyrfFormatError, match="unknown codec 99; update"):
        decode_model(
            write_container([replace(s, codec=99) if s.type == "RTAB" else s for s in sections], minor=MINOR_VERSION)
        )


def test_unknown_optional_section_is_skipped():
    model = make_model()
    sections = read_container(encode_model(model)).sections

    decoded = decode_model(
        write_container([*sections, Section("NEW_", 7, b"later", 5, required=False)], minor=MINOR_VERSION)
    )

    assert torch.equal(decoded.gaussians.positions, model.gaussians.positions)


def test_nonfinite_values_are_refused_on_load():
    data = encode_model(make_model())
    positions = bytearray(read_container(data)["POSI"].data)
    positions[:4] = np.float32(np.nan).tobytes()

    with pytest.raises(HyrfFormatError, match="'POSI' holds numbers that are not finite"):
        decode_model(replace_payloads(data, POSI=bytes(positions)))


METADATA_FORGERIES = {
    "not an object": lambda m: [m],
    "no count": lambda m: {key: value for key, value in m.items() if key != "gaussians"},
    "boolean count": lambda m: m | {"gaussians": True},
    "fractional count": lambda m: m | {"gaussians": 40.0},
    "negative count": lambda m: m | {"gaussians": -1},
    "huge count": lambda m: m | {"gaussians": 10**30},
    "config a list": lambda m: m | {"config": []},
    "config empty": lambda m: m | {"config": {}},
    "unknown field": lambda m: m | {"config": m["config"] | {"wavelets": True}},
    "text for a number": lambda m: m | {"config": m["config"] | {"hidden": "5"}},
    "text for a flag": lambda m: m | {"config": m["config"] | {"background": "no"}},
    "fraction for a size": lambda m: m | {"config": m["config"] | {"hidden": 5.5}},
    "unknown scale rule": lambda m: m | {"config": m["config"] | {"scale_rule": "max"}},
    "two coordinates": lambda m: m | {"config": m["config"] | {"solid": [0, 0]}},
    "null grid": lambda m: m | {"config": m["config"] | {"geometry": None}},
    "fractional levels": lambda m: m | {"config": m["config"] | {"geometry": {"log2_table_size": 6, "levels": 2.5}}},
    "negative levels": lambda m: m | {"config": m["config"] | {"geometry": {"log2_table_size": 6, "levels": -1}}},
    "frame without scale": lambda m: m | {"config": m["config"] | {"frame": {"center": [0, 0, 0]}}},
    "number past float64": lambda m: m | {"config": m["config"] | {"solid": [10**400, 0, 0]}},
    "other rule": lambda m: m | {"rules": m["rules"] | {"contraction": "cube"}},
    "new rule": lambda m: m | {"rules": m["rules"] | {"lighting": "sun"}},
    "no rules": lambda m: m | {"rules": {}},
}


@pytest.mark.parametrize("forgery", METADATA_FORGERIES)
def test_forged_metadata_is_refused(forgery):
    data = encode_model(make_model())
    forged = json.dumps(METADATA_FORGERIES[forgery](parse_metadata(data))).encode()

    with pytest.raises(HyrfFormatError):
        decode_model(replace_payloads(data, META=forged))


@pytest.mark.parametrize("key", ["frame", "geometry", "radiance", "hidden", "solid", "background"])
def test_describe_refuses_a_configuration_of_wrong_types(tmp_path, key):
    data = encode_model(make_model())
    metadata = parse_metadata(data)
    metadata["config"][key] = {"center": 0}
    (tmp_path / "model.hyrf").write_bytes(replace_payloads(data, META=json.dumps(metadata).encode()))

    with pytest.raises(HyrfFormatError, match=f"model.hyrf.*config.{key}"):
        describe_file(tmp_path / "model.hyrf")


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[" * 200_000,
        b'{"gaussians":NaN}',
        b'{"gaussians":1e999}',
        b'{"gaussians":' + b"9" * 5000 + b"}",
        b" " * (2 << 20),
    ],
)
def test_metadata_that_is_not_json_is_refused(tmp_path, text):
    path = tmp_path / "model.hyrf"
    path.write_bytes(replace_payloads(encode_model(make_model()), META=text))

    with pytest.raises(HyrfFormatError, match="model.hyrf.*metadata"):
        describe_file(path)


DEFLATED_FORGERIES = {
    "empty": lambda text: (b"", len(text)),
    "not deflated": lambda text: (text, len(text)),
    "truncated": lambda text: (zlib.compress(text)[:-1], len(text)),
    "followed by a byte": lambda text: (zlib.compress(text) + b"!", len(text)),
    "longer than it says": lambda text: (zlib.compress(text), len(text) - 1),
    "shorter than it says": lambda text: (zlib.compress(text), len(text) + 1),
    "a bomb": lambda text: (zlib.compress(b" " * (1 << 28) + text), len(text)),
    "more than a reader takes": lambda text: (zlib.compress(text + b" " * (1 << 20)), len(text) + (1 << 20)),
    "not JSON": lambda text: (zlib.compress(text[:-1]), len(text) - 1),
}


@pytest.mark.parametrize("forgery", DEFLATED_FORGERIES)
def test_forged_deflated_metadata_is_refused_in_little_memory(forgery):
    data = encode(make_model(), "compact")
    payload, raw_length = DEFLATED_FORGERIES[forgery](metadata_text(data))
    sections = [
        replace(section, data=payload, raw_length=raw_length) if section.type == "META" else section
        for section in read_container(data).sections
    ]
    forged = write_container(sections, minor=MINOR_VERSION)

    tracemalloc.start()
    with pytest.raises(HyrfFormatError, match="the metadata "):
        decode_model(forged)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 4 << 20


@examples(150)
@given(
    profile=st.sampled_from(ALL_PROFILES),
    type=st.sampled_from(["META", "POSI", "COLO", "OPAC", "GTAB", "RMLP"]),
    edit=st.tuples(st.floats(0, 1), st.integers(0, 4), st.binary(max_size=8)),
)
def test_forged_payloads_with_valid_checksums_raise_only_format_errors(profile, type, edit):
    data = FILE_BY_PROFILE[profile]
    container = read_container(data)
    where, removed, inserted = edit
    payload = bytes(container[type].data)
    start = int(where * len(payload))
    forged = replace_payloads(data, **{type: payload[:start] + inserted + payload[start + removed :]})

    try:
        model = decode_model(forged)
    except HyrfFormatError:
        return
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())


FILE_BY_PROFILE = {profile: encode(make_model(20), profile) for profile in ALL_PROFILES}
