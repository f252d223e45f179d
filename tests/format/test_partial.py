"""The start of a file is a coarser model where Gaussians come in layers, and one sentence where it is not enough."""

from __future__ import annotations

import re
import struct
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import small_model

from hyrfpack.compress import plan
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import decode_model, describe_file, load_model
from hyrfpack.format.arrays import MODEL_RULES, to_arrays
from hyrfpack.format.codec import repack
from hyrfpack.format.container import MINOR_VERSION, Container, Section, read_container, write_container
from hyrfpack.format.metadata import Metadata, read_metadata
from hyrfpack.model import HybridModel
from tools.safety.synthetic_encoding import encode

GROUPS = ("POSI", "COLO", "SCAL", "OPAC")
FIELDS = ("GTAB", "RTAB", "GMLP", "RMLP")
COUNT = 600


def drawn_model(count: int = COUNT) -> HybridModel:
    rng = np.random.default_rng(count)
    return small_model(
        rng.standard_t(2, (count, 3)),
        fields=1.0,
        color_logits=rng.normal(size=(count, 3)),
        scale_logits=rng.normal(-4, 1, (count, 1)),
        opacity_logits=rng.normal(0, 3, (count, 1)),
    )


def names(layer: int) -> list[str]:
    """Types of a layer's sections, as docs/reference/format.md has them."""
    return [group[:3] + str(layer) if layer else group for group in GROUPS]


def compact_in_layers(model: HybridModel) -> bytes:
    """A file of profile "compact" with layers as small as can be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MIN_LAYER_GAUSSIANS", 1)
        patch.setattr(plan, "MAX_LAYERS", 100)
        return encode(model, "compact", prune=False)


def in_layers(model: HybridModel, layers: list[int]) -> bytes:
    """A file in layers put together by hand, all float32."""
    arrays = to_arrays(model)
    stops = np.cumsum([0, *layers])
    parts = {group: arrays[group] for group in FIELDS}
    for layer, (start, stop) in enumerate(zip(stops, stops[1:], strict=False)):
        for name, group in zip(names(layer), GROUPS, strict=True):
            parts[name] = arrays[group][start:stop]
    return write_container(
        [metadata_of(model, layers), *[exact(type, part) for type, part in parts.items()]], minor=MINOR_VERSION
    )


def exact(type: str, values: np.ndarray) -> Section:
    return Section(type, 1, values.tobytes(), values.nbytes)


def metadata_of(model: HybridModel, layers: object, gaussians: int | None = None) -> Section:
    count = len(model) if gaussians is None else gaussians
    config = model.config.to_dict()
    return Metadata("compact", count, config, MODEL_RULES, layers=layers).to_section()


def with_metadata(data: bytes, metadata: Section) -> bytes:
    return write_container(
        [metadata, *[s for s in read_container(data).sections if s.type != "META"]], minor=MINOR_VERSION
    )


def prefix(arrays: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """A model's arrays with the first Gaussians only."""
    return {group: values[:count] if group in GROUPS else values for group, values in arrays.items()}


def assert_same_bits(model: HybridModel, expected: dict[str, np.ndarray]) -> None:
    arrays = to_arrays(model)
    assert arrays.keys() == expected.keys()
    for group, values in arrays.items():
        assert values.shape == expected[group].shape, group
        assert np.array_equal(values.view(np.uint32), expected[group].view(np.uint32)), group


MODEL = drawn_model()
COMPACT = compact_in_layers(MODEL)
ENTRIES = read_container(COMPACT).entries
LAYERS = read_metadata(read_container(COMPACT)).layers
WHOLE = to_arrays(decode_model(COMPACT))
LEAST = max(ENTRIES[type].end for type in ("META", *GROUPS, *FIELDS))  # bytes that make a model
# Every section's end, and places within its bytes and within its padding.
CUTS = sorted({cut for e in ENTRIES.values() for cut in (e.offset + e.length // 2, e.end - 1, e.end, e.end + 1)})


def there(cut: int) -> int:
    """Gaussians of the layers that a prefix of COMPACT has whole."""
    whole = [all(ENTRIES[name].end <= cut for name in names(layer)) for layer in range(len(LAYERS))]
    return sum(LAYERS[: whole.index(False) if False in whole else None])


# --- what the start of a file is ---


def test_sections_come_in_an_order_in_which_the_start_is_a_model():
    further = [name for layer in range(1, len(LAYERS)) for name in names(layer)]

    assert 3 <= len(LAYERS) <= 8 and sum(LAYERS) == COUNT
    assert list(ENTRIES) == ["META", "GMLP", "RMLP", *GROUPS, "GTAB", "RTAB", *further]


@pytest.mark.parametrize("cut", [cut for cut in CUTS if LEAST <= cut <= len(COMPACT)])
def test_a_start_of_the_file_is_the_layers_it_holds_whole(cut):
    model = decode_model(COMPACT[:cut], fraction=1.0)

    assert len(model) == there(cut)
    assert_same_bits(model, prefix(WHOLE, there(cut)))


@pytest.mark.parametrize("cut", [0, 7, 47, 48, 60, *[cut for cut in CUTS if cut < LEAST]])
def test_too_short_a_start_is_refused_in_one_sentence(cut):
    with pytest.raises(HyrfFormatError) as caught:
        decode_model(COMPACT[:cut], name="x.hyrf", fraction=1.0)

    assert str(caught.value).startswith("x.hyrf: ") and "\n" not in str(caught.value)
    if cut >= ENTRIES["META"].end:
        assert f"the model needs the first {LEAST:,} of {len(COMPACT):,} bytes" in str(caught.value)
        assert f"only {cut:,} are available" in str(caught.value)


def test_the_bytes_that_the_message_names_make_a_model_and_no_fewer_do():
    with pytest.raises(HyrfFormatError) as caught:
        decode_model(COMPACT[: ENTRIES["META"].end], fraction=1.0)

    named = int(re.search("the first ([0-9,]+) of", str(caught.value))[1].replace(",", ""))
    assert len(decode_model(COMPACT[:named], fraction=1.0)) == LAYERS[0]
    with pytest.raises(HyrfFormatError):
        decode_model(COMPACT[: named - 1], fraction=1.0)


@given(st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_a_fraction_of_a_whole_file_is_its_start(fraction):
    cut = int(fraction * len(COMPACT))
    if cut < LEAST:
        with pytest.raises(HyrfFormatError, match="read a larger part of the file"):
            decode_model(COMPACT, fraction=fraction)
    else:
        assert_same_bits(decode_model(COMPACT, fraction=fraction), prefix(WHOLE, there(cut)))


def test_nothing_past_the_fraction_is_read_but_the_table_of_contents():
    furthest = 0

    def read_at(offset: int, count: int) -> bytes:
        nonlocal furthest
        furthest = max(furthest, offset + count)
        return COMPACT[offset : offset + count]

    container = Container(read_at, len(COMPACT), fraction=0.7)
    sections = container.sections

    assert [section.type for section in sections] == [type for type, e in ENTRIES.items() if e.end <= furthest]
    assert furthest <= container.available == int(0.7 * len(COMPACT)) < container.length == len(COMPACT)
    assert Container(read_at, len(COMPACT), fraction=0.0).entries == ENTRIES


def test_files_cut_short_are_loaded_described_and_repacked(tmp_path):
    cut = ENTRIES["OPA1"].end + 5
    (tmp_path / "cut.hyrf").write_bytes(COMPACT[:cut])
    expected = prefix(WHOLE, sum(LAYERS[:2]))

    report = repack(tmp_path / "cut.hyrf", tmp_path / "raw.hyrf", fraction=1.0)

    assert_same_bits(load_model(tmp_path / "cut.hyrf", fraction=1.0), expected)
    assert_same_bits(load_model(tmp_path / "raw.hyrf"), expected)
    assert report.gaussians == describe_file(tmp_path / "raw.hyrf")["gaussians"] == sum(LAYERS[:2])
    facts = describe_file(tmp_path / "cut.hyrf", 1.0)
    assert (facts["layers"], facts["bytes"]) == (LAYERS, len(COMPACT))


def test_without_a_fraction_the_file_must_be_whole(tmp_path):
    (tmp_path / "cut.hyrf").write_bytes(COMPACT[:-1])
    for read in (load_model, describe_file):
        with pytest.raises(HyrfFormatError, match="cut.hyrf: .* is truncated"):
            read(tmp_path / "cut.hyrf")


@pytest.mark.parametrize("profile", ["raw", "paper", "compact"])
def test_files_of_one_layer_have_no_start_that_is_a_model(profile):
    data = encode(drawn_model(40), profile)

    assert_same_bits(decode_model(data, fraction=1.0), to_arrays(decode_model(data)))
    for entry in read_container(data).entries.values():
        for cut in {entry.offset + entry.length // 2, entry.end - 1, entry.end} - {len(data)}:
            with pytest.raises(HyrfFormatError) as caught:
                decode_model(data[:cut], fraction=1.0)
            if cut >= read_container(data).entries["META"].end:
                assert f"the model needs the first {len(data):,} of {len(data):,} bytes" in str(caught.value)


# --- layers of any kind ---


@pytest.mark.parametrize("layers", [[], [COUNT], [400, 200], [0, COUNT], [COUNT, 0], [75] * 8, [1, 0, 598, 0, 1]])
def test_layers_are_the_gaussians_one_after_another(layers):
    arrays = to_arrays(MODEL)
    data = in_layers(MODEL, layers or [COUNT])
    if not layers:
        data = with_metadata(data, metadata_of(MODEL, layers))

    assert_same_bits(decode_model(data), arrays)
    for layer in range(1, len(layers)):
        cut = read_container(data).entries[names(layer)[0]].end
        assert_same_bits(decode_model(data[:cut], fraction=1.0), prefix(arrays, sum(layers[:layer])))


def test_sections_may_come_in_any_order():
    sections = list(read_container(in_layers(MODEL, [400, 200])).sections)
    data = write_container(sections[::-1], minor=MINOR_VERSION)
    entries = read_container(data).entries

    assert_same_bits(decode_model(data), to_arrays(MODEL))
    with pytest.raises(HyrfFormatError, match="section 'META' ends at byte"):
        decode_model(data[: entries["META"].offset], fraction=1.0)


def test_a_layer_lacking_a_section_ends_the_model_even_where_later_ones_are_whole():
    sections = read_container(in_layers(MODEL, [200] * 3)).sections
    data = write_container(sorted(sections, key=lambda section: section.type == "SCA1"), minor=MINOR_VERSION)

    assert_same_bits(decode_model(data[:-1], fraction=1.0), prefix(to_arrays(MODEL), 200))


def test_each_layer_stands_alone_and_the_fields_lean_on_the_first():
    """Without the bytes of further layers, and without a word of them, the rest reads the same."""
    first = [section for section in read_container(COMPACT).sections if section.type in (*GROUPS, *FIELDS)]
    alone = write_container([metadata_of(MODEL, [], LAYERS[0]), *first], minor=MINOR_VERSION)

    assert_same_bits(decode_model(alone), prefix(WHOLE, LAYERS[0]))


def test_sections_of_layers_that_the_metadata_does_not_have_are_passed_over():
    data = with_metadata(in_layers(MODEL, [400, 200]), metadata_of(MODEL, [], 400))

    assert_same_bits(decode_model(data), prefix(to_arrays(MODEL), 400))


def test_each_layer_may_have_a_codec_of_its_own():
    sections = {section.type: section for section in read_container(COMPACT).sections}
    part = slice(LAYERS[0], sum(LAYERS[:2]))
    sections |= {name: exact(name, to_arrays(MODEL)[group][part]) for name, group in zip(names(1), GROUPS, strict=True)}
    expected = {group: values.copy() for group, values in WHOLE.items()}
    for group in GROUPS:
        expected[group][part] = to_arrays(MODEL)[group][part]

    assert_same_bits(decode_model(write_container([*sections.values()], minor=MINOR_VERSION)), expected)


@pytest.mark.parametrize(("replaced", "refused"), [(["POS1"], "COL1|SCA1|OPA1"), (GROUPS, "GTAB|RTAB")])
def test_lattice_points_of_another_layer_are_none_to_lean_on(replaced, refused):
    sections = {section.type: section for section in read_container(COMPACT).sections}
    sections |= {name: exact(name, np.zeros(sections[name].raw_length // 4, np.float32)) for name in replaced}

    with pytest.raises(HyrfFormatError, match=f"section '({refused})': codec . needs positions of codec 6"):
        decode_model(write_container([*sections.values()], minor=MINOR_VERSION))


# --- what is refused ---


def forge(data: bytes, place: int, code: str, value: int) -> bytes:
    """Change a number of the header or the table of contents, and make both checksums right again."""
    forged = bytearray(data)
    struct.pack_into(code, forged, place, value)
    (count,) = struct.unpack_from("<I", forged, 36)
    struct.pack_into("<I", forged, 40, zlib.crc32(forged[48 : 48 + 40 * count]))
    struct.pack_into("<I", forged, 44, zlib.crc32(forged[:44]))
    return bytes(forged)


def line(data: bytes, type: str) -> int:
    """Where a section's line of the table of contents starts."""
    return 48 + 40 * list(read_container(data).entries).index(type)


def stretched(data: bytes, length: int) -> bytes:
    """The file with a last section so long that the file has `length` bytes, by its header; nothing is added."""
    last = list(read_container(data).entries.values())[-1]
    data = forge(data, line(data, last.type) + 16, "<Q", length - last.offset)
    return forge(data, 16, "<Q", length)


def in_little_memory(data: bytes, fraction: float | None) -> HybridModel | HyrfFormatError:
    """What becomes of a file, for which 8 MiB must be enough."""
    tracemalloc.start()
    try:
        return decode_model(data, fraction=fraction)
    except HyrfFormatError as error:
        return error
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 8 << 20


def test_a_huge_length_in_the_header_costs_nothing():
    data = stretched(COMPACT, 1 << 33)

    assert "is truncated" in str(in_little_memory(data, None))
    assert_same_bits(in_little_memory(data, 1.0), prefix(WHOLE, COUNT - LAYERS[-1]))
    assert "read a larger part of the file" in str(in_little_memory(data[: LEAST - 1], 1.0))
    assert "more than a .hyrf file may have" in str(in_little_memory(stretched(COMPACT, 1 << 35), 1.0))


def test_what_is_not_there_may_promise_anything_and_costs_nothing():
    """A layer of 10^11 Gaussians of which no byte is there."""
    sections = list(read_container(COMPACT).sections)
    layers = [*LAYERS[:-1], 10**11]
    metadata = metadata_of(MODEL, layers, sum(layers))
    data = write_container([metadata, *sections[1:]], minor=MINOR_VERSION)
    last = names(len(LAYERS) - 1)
    lines, cut = [line(data, name) for name in last], read_container(data).entries[last[0]].offset
    for place, width in zip(lines, (3, 3, 1, 1), strict=True):
        data = forge(data, place + 24, "<Q", 4 * width * 10**11)

    assert_same_bits(in_little_memory(data[:cut], 1.0), prefix(WHOLE, COUNT - LAYERS[-1]))
    assert "the sections say they decode to" in str(in_little_memory(data, 1.0))
    assert "the sections say they decode to" in str(in_little_memory(data, None))


def test_the_bytes_that_are_there_bound_what_they_decode_to_and_not_the_length_in_the_header():
    data = forge(stretched(COMPACT, 1 << 33), line(COMPACT, "GMLP") + 24, "<Q", 1 << 30)

    for fraction in (1.0, len(COMPACT) / (1 << 33)):
        with pytest.raises(HyrfFormatError, match="the sections say they decode to"):
            read_container(data, fraction=fraction)


@pytest.mark.parametrize("kept", [0, 1, 39])
def test_a_table_of_contents_that_is_not_all_there_is_refused(kept):
    cut = 48 + 40 * (len(ENTRIES) - 1) + kept

    assert "within its table of contents" in str(in_little_memory(COMPACT[:cut], 1.0))


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_bytes_after_the_end_are_refused_whatever_the_fraction(fraction):
    with pytest.raises(HyrfFormatError, match="the header says"):
        decode_model(COMPACT + bytes(8), fraction=fraction)


@pytest.mark.parametrize(
    "layers",
    [
        *(
            [400, 199],
            [400, 201],
            [0],
            [0, 0],
            [COUNT] * 2,
            [COUNT + 1, -1],
            [-COUNT, 2 * COUNT],
            [COUNT - 10**30, 10**30],
        ),
        *([1 << 63, COUNT - (1 << 63)], [COUNT, 0, 0, 0, 0, 0, 0, 0, 0], [0] * 9, [75] * 9, [1] * COUNT),
        *([300.0, 300], [True, COUNT - 1], ["300", 300], [[300], 300], [None, COUNT], {"0": COUNT}, "600", COUNT, None),
    ],
    ids=lambda layers: str(layers)[:30],
)
@pytest.mark.parametrize("fraction", [None, 1.0])
def test_layers_that_cannot_be_are_refused(layers, fraction):
    metadata = metadata_of(MODEL, layers or [1])
    text = metadata.data.replace(b'"layers":[1]', b'"layers":null') if layers is None else metadata.data
    data = with_metadata(in_layers(MODEL, [400, 200]), replace(metadata, data=text, raw_length=len(text)))

    with pytest.raises(HyrfFormatError, match="the metadata is not valid"):
        decode_model(data, fraction=fraction)


@pytest.mark.parametrize("fraction", [None, 1.0])
def test_layers_whose_sections_are_not_listed_are_refused(fraction):
    for missing in names(1):
        sections = [s for s in read_container(in_layers(MODEL, [400, 200])).sections if s.type != missing]
        with pytest.raises(HyrfFormatError, match=f"there is no section '{missing}'"):
            decode_model(write_container(sections, minor=MINOR_VERSION), fraction=fraction)
    with pytest.raises(HyrfFormatError, match="there is no section 'POS2'"):
        decode_model(with_metadata(in_layers(MODEL, [400, 200]), metadata_of(MODEL, [400, 200, 0])), fraction=fraction)


def test_a_layer_of_another_size_than_the_metadata_says_is_refused_even_where_it_is_not_there():
    data = with_metadata(in_layers(MODEL, [400, 200]), metadata_of(MODEL, [400, 199], 599))

    for fraction, part in ((None, data), (1.0, data), (1.0, data[: read_container(data).entries["POS1"].offset])):
        with pytest.raises(HyrfFormatError, match="section 'POS1' says it decodes to 2400 bytes"):
            decode_model(part, fraction=fraction)


def test_a_ninth_layer_has_no_sections():
    extra = Section("POS8", 1, b"", 0)
    sections = list(read_container(in_layers(MODEL, [75] * 8)).sections)

    with pytest.raises(HyrfFormatError, match="section 'POS8' is required"):
        decode_model(write_container([*sections, extra], minor=MINOR_VERSION))


def test_damage_before_the_cut_is_found_and_after_it_does_not_matter():
    cut = ENTRIES["OPA1"].end
    for place in range(48 + 40 * len(ENTRIES), cut, 101):
        with pytest.raises(HyrfFormatError):
            decode_model(flipped(COMPACT, place)[:cut], fraction=1.0)
    after = flipped(COMPACT, ENTRIES["POS2"].offset)

    assert_same_bits(decode_model(after, fraction=cut / len(COMPACT)), prefix(WHOLE, sum(LAYERS[:2])))


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_layers_with_right_checksums_are_refused_or_make_a_model(data):
    sections = list(read_container(COMPACT).sections)
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
    assert len(model) in np.cumsum(LAYERS)
