"""The start of a layered file decodes to a coarser model; too short a start is refused in one sentence."""

from __future__ import annotations

import re
import struct
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from layers import only_in_acceptance
from property_tests import examples
from scenes import small_model

from hyrfpack.compress import plan
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import SectionSize, decode_model, describe_file, load_model
from hyrfpack.format.arrays import MODEL_RULES, to_arrays
from hyrfpack.format.codec import repack
from hyrfpack.format.container import MINOR_VERSION, Container, Section, read_container, write_container
from hyrfpack.format.info import sum_layers
from hyrfpack.format.metadata import Metadata, read_metadata
from hyrfpack.format.sections import POSITIONS, layer_section
from hyrfpack.model import HybridModel
from tools.safety.synthetic_encoding import encode

GAUSSIAN_SECTIONS = ("POSI", "COLO", "SCAL", "OPAC")
FIELD_SECTIONS = ("GTAB", "RTAB", "GMLP", "RMLP")
GAUSSIAN_COUNT = 600


def random_model(count: int = GAUSSIAN_COUNT) -> HybridModel:
    rng = np.random.default_rng(count)
    return small_model(
        rng.standard_t(2, (count, 3)),
        fields=1.0,
        color_logits=rng.normal(size=(count, 3)),
        scale_logits=rng.normal(-4, 1, (count, 1)),
        opacity_logits=rng.normal(0, 3, (count, 1)),
    )


def layer_sections(layer: int) -> list[str]:
    """Return the section types of a layer, as docs/reference/format.md defines them."""
    return [group[:3] + str(layer) if layer else group for group in GAUSSIAN_SECTIONS]


def encode_in_small_layers(model: HybridModel) -> bytes:
    """Encode a model with profile compact in as many and as small layers as possible."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MIN_LAYER_SHARE", 0.01)
        return encode(model, "compact", prune=False)


def build_layered_file(model: HybridModel, layers: list[int]) -> bytes:
    """Build a layered file from float32 sections."""
    arrays = to_arrays(model)
    stops = np.cumsum([0, *layers])
    parts = {group: arrays[group] for group in FIELD_SECTIONS}
    for layer, (start, stop) in enumerate(zip(stops, stops[1:], strict=False)):
        for name, group in zip(layer_sections(layer), GAUSSIAN_SECTIONS, strict=True):
            parts[name] = arrays[group][start:stop]
    return write_container(
        [metadata_section(model, layers), *[float32_section(type, part) for type, part in parts.items()]],
        minor=MINOR_VERSION,
    )


def float32_section(type: str, values: np.ndarray) -> Section:
    return Section(type, 1, values.tobytes(), values.nbytes)


def metadata_section(model: HybridModel, layers: object, gaussians: int | None = None) -> Section:
    count = len(model) if gaussians is None else gaussians
    config = model.config.to_dict()
    return Metadata("compact", count, config, MODEL_RULES, layers=layers).to_section()


def replace_metadata(data: bytes, metadata: Section) -> bytes:
    return write_container(
        [metadata, *[s for s in read_container(data).sections if s.type != "META"]], minor=MINOR_VERSION
    )


def first_gaussians(arrays: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Return a model's arrays with the first `count` Gaussians only."""
    return {group: values[:count] if group in GAUSSIAN_SECTIONS else values for group, values in arrays.items()}


def assert_same_bits(model: HybridModel, expected: dict[str, np.ndarray]) -> None:
    arrays = to_arrays(model)
    assert arrays.keys() == expected.keys()
    for group, values in arrays.items():
        assert values.shape == expected[group].shape, group
        assert np.array_equal(values.view(np.uint32), expected[group].view(np.uint32)), group


SAMPLE_MODEL = random_model()
COMPACT_DATA = encode_in_small_layers(SAMPLE_MODEL)
COMPACT_ENTRIES = read_container(COMPACT_DATA).entries
LAYER_COUNTS = read_metadata(read_container(COMPACT_DATA)).layers
WHOLE_ARRAYS = to_arrays(decode_model(COMPACT_DATA))
MIN_MODEL_BYTES = max(COMPACT_ENTRIES[type].end for type in ("META", *GAUSSIAN_SECTIONS, *FIELD_SECTIONS))
# The end of every section, and positions inside its bytes and its padding.
CUT_BYTES = sorted(
    {cut for e in COMPACT_ENTRIES.values() for cut in (e.offset + e.length // 2, e.end - 1, e.end, e.end + 1)}
)
MODEL_CUT_BYTES = [cut for cut in CUT_BYTES if MIN_MODEL_BYTES <= cut <= len(COMPACT_DATA)]


def count_complete_gaussians(cut: int) -> int:
    """Count the Gaussians in the leading layers that the first `cut` bytes of COMPACT_DATA contain completely."""
    whole = [
        all(COMPACT_ENTRIES[name].end <= cut for name in layer_sections(layer)) for layer in range(len(LAYER_COUNTS))
    ]
    return sum(LAYER_COUNTS[: whole.index(False) if False in whole else None])


# --- truncated files ---


def test_sections_are_ordered_so_that_the_start_of_a_file_is_a_model():
    further = [name for layer in range(1, len(LAYER_COUNTS)) for name in layer_sections(layer)]

    assert 3 <= len(LAYER_COUNTS) <= 8 and sum(LAYER_COUNTS) == GAUSSIAN_COUNT
    assert list(COMPACT_ENTRIES) == ["META", "GMLP", "RMLP", *GAUSSIAN_SECTIONS, "GTAB", "RTAB", *further]


@pytest.mark.parametrize("cut", only_in_acceptance(MODEL_CUT_BYTES, set(MODEL_CUT_BYTES) - set(MODEL_CUT_BYTES[::3])))
def test_a_truncated_file_decodes_to_its_complete_layers(cut):
    model = decode_model(COMPACT_DATA[:cut], fraction=1.0)

    assert len(model) == count_complete_gaussians(cut)
    assert_same_bits(model, first_gaussians(WHOLE_ARRAYS, count_complete_gaussians(cut)))


@pytest.mark.parametrize("cut", [0, 7, 47, 48, 60, *[cut for cut in CUT_BYTES if cut < MIN_MODEL_BYTES]])
def test_a_file_without_a_complete_layer_is_refused_in_one_sentence(cut):
    with pytest.raises(HyrfFormatError) as caught:
        decode_model(COMPACT_DATA[:cut], name="x.hyrf", fraction=1.0)

    assert str(caught.value).startswith("x.hyrf: ") and "\n" not in str(caught.value)
    if cut >= COMPACT_ENTRIES["META"].end:
        assert f"the model needs the first {MIN_MODEL_BYTES:,} of {len(COMPACT_DATA):,} bytes" in str(caught.value)
        assert f"only {cut:,} are available" in str(caught.value)


def test_the_number_of_bytes_in_the_message_is_the_minimum():
    with pytest.raises(HyrfFormatError) as caught:
        decode_model(COMPACT_DATA[: COMPACT_ENTRIES["META"].end], fraction=1.0)

    named = int(re.search("the first ([0-9,]+) of", str(caught.value))[1].replace(",", ""))
    assert len(decode_model(COMPACT_DATA[:named], fraction=1.0)) == LAYER_COUNTS[0]
    with pytest.raises(HyrfFormatError):
        decode_model(COMPACT_DATA[: named - 1], fraction=1.0)


@given(st.floats(0, 1))
@examples(30)
def test_a_fraction_decodes_the_first_bytes_of_a_whole_file(fraction):
    cut = int(fraction * len(COMPACT_DATA))
    if cut < MIN_MODEL_BYTES:
        with pytest.raises(HyrfFormatError, match="read a larger part of the file"):
            decode_model(COMPACT_DATA, fraction=fraction)
    else:
        assert_same_bits(
            decode_model(COMPACT_DATA, fraction=fraction), first_gaussians(WHOLE_ARRAYS, count_complete_gaussians(cut))
        )


def test_no_section_past_the_fraction_is_read():
    furthest = 0

    def read_at(offset: int, count: int) -> bytes:
        nonlocal furthest
        furthest = max(furthest, offset + count)
        return COMPACT_DATA[offset : offset + count]

    container = Container(read_at, len(COMPACT_DATA), fraction=0.7)
    sections = container.sections

    assert [section.type for section in sections] == [type for type, e in COMPACT_ENTRIES.items() if e.end <= furthest]
    assert furthest <= container.available == int(0.7 * len(COMPACT_DATA)) < container.length == len(COMPACT_DATA)
    assert Container(read_at, len(COMPACT_DATA), fraction=0.0).entries == COMPACT_ENTRIES


def test_truncated_files_are_loaded_described_and_repacked(tmp_path):
    cut = COMPACT_ENTRIES["OPA1"].end + 5
    (tmp_path / "cut.hyrf").write_bytes(COMPACT_DATA[:cut])
    expected = first_gaussians(WHOLE_ARRAYS, sum(LAYER_COUNTS[:2]))

    report = repack(tmp_path / "cut.hyrf", tmp_path / "raw.hyrf", fraction=1.0)

    assert_same_bits(load_model(tmp_path / "cut.hyrf", fraction=1.0), expected)
    assert_same_bits(load_model(tmp_path / "raw.hyrf"), expected)
    assert report.gaussians == describe_file(tmp_path / "raw.hyrf")["gaussians"] == sum(LAYER_COUNTS[:2])
    facts = describe_file(tmp_path / "cut.hyrf", 1.0)
    assert (facts["layers"], facts["bytes"]) == (LAYER_COUNTS, len(COMPACT_DATA))


def test_a_truncated_file_is_refused_without_a_fraction(tmp_path):
    (tmp_path / "cut.hyrf").write_bytes(COMPACT_DATA[:-1])
    for read in (load_model, describe_file):
        with pytest.raises(HyrfFormatError, match="cut.hyrf: .* is truncated"):
            read(tmp_path / "cut.hyrf")


@pytest.mark.parametrize("profile", ["raw", "paper", "compact"])
def test_truncated_files_of_one_layer_are_refused(profile):
    data = encode(random_model(40), profile)

    assert_same_bits(decode_model(data, fraction=1.0), to_arrays(decode_model(data)))
    for entry in read_container(data).entries.values():
        for cut in {entry.offset + entry.length // 2, entry.end - 1, entry.end} - {len(data)}:
            with pytest.raises(HyrfFormatError) as caught:
                decode_model(data[:cut], fraction=1.0)
            if cut >= read_container(data).entries["META"].end:
                assert f"the model needs the first {len(data):,} of {len(data):,} bytes" in str(caught.value)


# --- layers ---


@pytest.mark.parametrize(
    "layers", [[], [GAUSSIAN_COUNT], [400, 200], [0, GAUSSIAN_COUNT], [GAUSSIAN_COUNT, 0], [75] * 8, [1, 0, 598, 0, 1]]
)
def test_layers_concatenate_to_all_gaussians(layers):
    arrays = to_arrays(SAMPLE_MODEL)
    data = build_layered_file(SAMPLE_MODEL, layers or [GAUSSIAN_COUNT])
    if not layers:
        data = replace_metadata(data, metadata_section(SAMPLE_MODEL, layers))

    assert_same_bits(decode_model(data), arrays)
    for layer in range(1, len(layers)):
        cut = read_container(data).entries[layer_sections(layer)[0]].end
        assert_same_bits(decode_model(data[:cut], fraction=1.0), first_gaussians(arrays, sum(layers[:layer])))


def test_sections_may_come_in_any_order():
    sections = list(read_container(build_layered_file(SAMPLE_MODEL, [400, 200])).sections)
    data = write_container(sections[::-1], minor=MINOR_VERSION)
    entries = read_container(data).entries

    assert_same_bits(decode_model(data), to_arrays(SAMPLE_MODEL))
    with pytest.raises(HyrfFormatError, match=f"the model needs the first {len(data):,} of {len(data):,} bytes"):
        decode_model(data[: entries["META"].offset], fraction=1.0)


def test_decoding_stops_before_the_first_incomplete_layer():
    sections = read_container(build_layered_file(SAMPLE_MODEL, [200] * 3)).sections
    data = write_container(sorted(sections, key=lambda section: section.type == "SCA1"), minor=MINOR_VERSION)

    assert_same_bits(decode_model(data[:-1], fraction=1.0), first_gaussians(to_arrays(SAMPLE_MODEL), 200))


def test_the_first_layer_and_the_fields_need_no_further_layers():
    """A file without the sections and the metadata of further layers decodes to the same first layer."""
    first = [
        section
        for section in read_container(COMPACT_DATA).sections
        if section.type in (*GAUSSIAN_SECTIONS, *FIELD_SECTIONS)
    ]
    alone = write_container([metadata_section(SAMPLE_MODEL, [], LAYER_COUNTS[0]), *first], minor=MINOR_VERSION)

    assert_same_bits(decode_model(alone), first_gaussians(WHOLE_ARRAYS, LAYER_COUNTS[0]))


def test_sections_of_undeclared_layers_are_ignored():
    data = replace_metadata(build_layered_file(SAMPLE_MODEL, [400, 200]), metadata_section(SAMPLE_MODEL, [], 400))

    assert_same_bits(decode_model(data), first_gaussians(to_arrays(SAMPLE_MODEL), 400))


def test_layers_may_have_different_codecs():
    sections = {section.type: section for section in read_container(COMPACT_DATA).sections}
    part = slice(LAYER_COUNTS[0], sum(LAYER_COUNTS[:2]))
    sections |= {
        name: float32_section(name, to_arrays(SAMPLE_MODEL)[group][part])
        for name, group in zip(layer_sections(1), GAUSSIAN_SECTIONS, strict=True)
    }
    expected = {group: values.copy() for group, values in WHOLE_ARRAYS.items()}
    for group in GAUSSIAN_SECTIONS:
        expected[group][part] = to_arrays(SAMPLE_MODEL)[group][part]

    assert_same_bits(decode_model(write_container([*sections.values()], minor=MINOR_VERSION)), expected)


@pytest.mark.parametrize(("replaced", "refused"), [(["POS1"], "COL1|SCA1|OPA1"), (GAUSSIAN_SECTIONS, "GTAB|RTAB")])
def test_layers_do_not_use_the_lattice_points_of_other_layers(replaced, refused):
    sections = {section.type: section for section in read_container(COMPACT_DATA).sections}
    sections |= {name: float32_section(name, np.zeros(sections[name].raw_length // 4, np.float32)) for name in replaced}

    with pytest.raises(HyrfFormatError, match=f"section '({refused})': codec . needs positions of codec 6"):
        decode_model(write_container([*sections.values()], minor=MINOR_VERSION))


# --- hostile files ---


def forge_number(data: bytes, place: int, code: str, value: int) -> bytes:
    """Change a number in the header or the table of contents, and recompute both checksums."""
    forged = bytearray(data)
    struct.pack_into(code, forged, place, value)
    (count,) = struct.unpack_from("<I", forged, 36)
    struct.pack_into("<I", forged, 40, zlib.crc32(forged[48 : 48 + 40 * count]))
    struct.pack_into("<I", forged, 44, zlib.crc32(forged[:44]))
    return bytes(forged)


def entry_offset(data: bytes, type: str) -> int:
    """Return the offset of a section's entry in the table of contents."""
    return 48 + 40 * list(read_container(data).entries).index(type)


def declare_length(data: bytes, length: int) -> bytes:
    """Declare a longer last section, so that the header says `length` bytes; no bytes are added."""
    last = list(read_container(data).entries.values())[-1]
    data = forge_number(data, entry_offset(data, last.type) + 16, "<Q", length - last.offset)
    return forge_number(data, 16, "<Q", length)


def decode_in_8_mib(data: bytes, fraction: float | None) -> HybridModel | HyrfFormatError:
    """Return the decoded model or the error; fail if decoding takes 8 MiB of memory or more."""
    tracemalloc.start()
    try:
        return decode_model(data, fraction=fraction)
    except HyrfFormatError as error:
        return error
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 8 << 20


def test_a_huge_declared_length_takes_little_memory():
    data = declare_length(COMPACT_DATA, 1 << 33)

    assert "is truncated" in str(decode_in_8_mib(data, None))
    assert_same_bits(decode_in_8_mib(data, 1.0), first_gaussians(WHOLE_ARRAYS, GAUSSIAN_COUNT - LAYER_COUNTS[-1]))
    assert "read a larger part of the file" in str(decode_in_8_mib(data[: MIN_MODEL_BYTES - 1], 1.0))
    assert "more than a .hyrf file may have" in str(decode_in_8_mib(declare_length(COMPACT_DATA, 1 << 35), 1.0))


def test_missing_layers_may_declare_any_size_and_take_no_memory():
    """The metadata declares a layer of 10^11 Gaussians, of which the file contains no bytes."""
    sections = list(read_container(COMPACT_DATA).sections)
    layers = [*LAYER_COUNTS[:-1], 10**11]
    metadata = metadata_section(SAMPLE_MODEL, layers, sum(layers))
    data = write_container([metadata, *sections[1:]], minor=MINOR_VERSION)
    last = layer_sections(len(LAYER_COUNTS) - 1)
    lines, cut = [entry_offset(data, name) for name in last], read_container(data).entries[last[0]].offset
    for place, width in zip(lines, (3, 3, 1, 1), strict=True):
        data = forge_number(data, place + 24, "<Q", 4 * width * 10**11)

    assert_same_bits(decode_in_8_mib(data[:cut], 1.0), first_gaussians(WHOLE_ARRAYS, GAUSSIAN_COUNT - LAYER_COUNTS[-1]))
    assert "the sections say they decode to" in str(decode_in_8_mib(data, 1.0))
    assert "the sections say they decode to" in str(decode_in_8_mib(data, None))


def test_the_decoded_size_is_limited_by_the_available_bytes():
    data = forge_number(declare_length(COMPACT_DATA, 1 << 33), entry_offset(COMPACT_DATA, "GMLP") + 24, "<Q", 1 << 30)

    for fraction in (1.0, len(COMPACT_DATA) / (1 << 33)):
        with pytest.raises(HyrfFormatError, match="the sections say they decode to"):
            read_container(data, fraction=fraction)


@pytest.mark.parametrize("kept", [0, 1, 39])
def test_a_truncated_table_of_contents_is_refused(kept):
    cut = 48 + 40 * (len(COMPACT_ENTRIES) - 1) + kept

    assert "within its table of contents" in str(decode_in_8_mib(COMPACT_DATA[:cut], 1.0))


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_trailing_bytes_are_refused_for_any_fraction(fraction):
    with pytest.raises(HyrfFormatError, match="the header says"):
        decode_model(COMPACT_DATA + bytes(8), fraction=fraction)


@pytest.mark.parametrize(
    "layers",
    [
        *(
            [400, 199],
            [400, 201],
            [0],
            [0, 0],
            [GAUSSIAN_COUNT] * 2,
            [GAUSSIAN_COUNT + 1, -1],
            [-GAUSSIAN_COUNT, 2 * GAUSSIAN_COUNT],
            [GAUSSIAN_COUNT - 10**30, 10**30],
        ),
        *(
            [1 << 63, GAUSSIAN_COUNT - (1 << 63)],
            [GAUSSIAN_COUNT, 0, 0, 0, 0, 0, 0, 0, 0],
            [0] * 9,
            [75] * 9,
            [1] * GAUSSIAN_COUNT,
        ),
        *(
            [300.0, 300],
            [True, GAUSSIAN_COUNT - 1],
            ["300", 300],
            [[300], 300],
            [None, GAUSSIAN_COUNT],
            {"0": GAUSSIAN_COUNT},
            "600",
            GAUSSIAN_COUNT,
            None,
        ),
    ],
    ids=lambda layers: str(layers)[:30],
)
@pytest.mark.parametrize("fraction", [None, 1.0])
def test_invalid_layer_counts_are_refused(layers, fraction):
    metadata = metadata_section(SAMPLE_MODEL, layers or [1])
    text = metadata.data.replace(b'"layers":[1]', b'"layers":null') if layers is None else metadata.data
    data = replace_metadata(
        build_layered_file(SAMPLE_MODEL, [400, 200]), replace(metadata, data=text, raw_length=len(text))
    )

    with pytest.raises(HyrfFormatError, match="the metadata is not valid"):
        decode_model(data, fraction=fraction)


def test_more_layers_than_a_file_may_have_are_named_as_the_problem():
    data = replace_metadata(build_layered_file(SAMPLE_MODEL, [400, 200]), metadata_section(SAMPLE_MODEL, 9 * [1]))

    with pytest.raises(HyrfFormatError, match="there are 9 layers, and there may be 8"):
        decode_model(data)


@pytest.mark.parametrize("fraction", [None, 1.0])
def test_layers_without_sections_are_refused(fraction):
    for missing in layer_sections(1):
        sections = [
            s for s in read_container(build_layered_file(SAMPLE_MODEL, [400, 200])).sections if s.type != missing
        ]
        with pytest.raises(HyrfFormatError, match=f"there is no section '{missing}'"):
            decode_model(write_container(sections, minor=MINOR_VERSION), fraction=fraction)
    with pytest.raises(HyrfFormatError, match="there is no section 'POS2'"):
        decode_model(
            replace_metadata(
                build_layered_file(SAMPLE_MODEL, [400, 200]), metadata_section(SAMPLE_MODEL, [400, 200, 0])
            ),
            fraction=fraction,
        )


def test_a_layer_whose_size_contradicts_the_metadata_is_refused():
    data = replace_metadata(
        build_layered_file(SAMPLE_MODEL, [400, 200]), metadata_section(SAMPLE_MODEL, [400, 199], 599)
    )

    for fraction, part in ((None, data), (1.0, data), (1.0, data[: read_container(data).entries["POS1"].offset])):
        with pytest.raises(HyrfFormatError, match="section 'POS1' says it decodes to 2400 bytes"):
            decode_model(part, fraction=fraction)


def test_a_ninth_layer_has_no_sections():
    extra = Section("POS8", 1, b"", 0)
    sections = list(read_container(build_layered_file(SAMPLE_MODEL, [75] * 8)).sections)

    with pytest.raises(HyrfFormatError, match="section 'POS8' is required"):
        decode_model(write_container([*sections, extra], minor=MINOR_VERSION))


def test_only_damage_before_the_cut_is_detected():
    cut = COMPACT_ENTRIES["OPA1"].end
    for place in range(48 + 40 * len(COMPACT_ENTRIES), cut, 101):
        with pytest.raises(HyrfFormatError):
            decode_model(flip_bit(COMPACT_DATA, place)[:cut], fraction=1.0)
    after = flip_bit(COMPACT_DATA, COMPACT_ENTRIES["POS2"].offset)

    assert_same_bits(
        decode_model(after, fraction=cut / len(COMPACT_DATA)), first_gaussians(WHOLE_ARRAYS, sum(LAYER_COUNTS[:2]))
    )


def flip_bit(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@given(st.data())
@examples(60)
def test_damaged_layers_with_valid_checksums_are_decoded_or_refused(data):
    sections = list(read_container(COMPACT_DATA).sections)
    which = data.draw(st.integers(0, len(sections) - 1), "section")
    stored = bytearray(sections[which].data)
    for _ in range(data.draw(st.integers(1, 3), "changes")):
        stored[data.draw(st.integers(0, len(stored) - 1), "place")] = data.draw(st.integers(0, 255), "value")
    forged = write_container(
        [*sections[:which], replace(sections[which], data=bytes(stored)), *sections[which + 1 :]], minor=MINOR_VERSION
    )
    cut = data.draw(st.integers(0, len(forged)), "cut")

    try:
        model = decode_model(forged[:cut], fraction=1.0)
    except HyrfFormatError:
        return
    assert len(model) in np.cumsum(LAYER_COUNTS)


def test_layers_of_a_section_are_summed():
    sections = [
        SectionSize("META", "metadata", 10, 5),
        SectionSize("POSI", "positions", 120, 30),
        SectionSize("ZZZZ", "unknown", 8, 8),
        SectionSize(layer_section(POSITIONS, 1), "positions", 240, 50),
    ]

    summed = sum_layers(sections)

    assert summed == [sections[0], SectionSize("POSI", "positions", 360, 80), sections[2]]
    assert [part.parameters for part in summed[:2]] == [0, 90]
