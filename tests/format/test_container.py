"""The container round-trips sections and refuses truncated, damaged and forged files."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import container as format_container
from hyrfpack.format.container import (
    MINOR_VERSION,
    Container,
    Section,
    raw_bytes_limit,
    read_container,
    write_container,
)

# Offsets and types of header fields and table columns, taken from docs/reference/format.md and not from the code.
HEADER_FIELDS = {"major": (8, "<H"), "minor": (10, "<H"), "flags": (12, "<I"), "file_length": (16, "<Q")}
HEADER_FIELDS |= {"toc_offset": (24, "<Q"), "toc_length": (32, "<I"), "count": (36, "<I"), "toc_checksum": (40, "<I")}
ENTRY_FIELDS = {"type": (0, "<4s"), "codec": (4, "<H"), "flags": (6, "<H"), "offset": (8, "<Q"), "length": (16, "<Q")}
ENTRY_FIELDS |= {"raw_length": (24, "<Q"), "checksum": (32, "<I"), "reserved": (36, "<I")}
HEADER_BYTES, ENTRY_BYTES = 48, 40

SAMPLE_SECTIONS = [
    Section("META", 1, b'{"gaussians": 3}', 16),
    Section("POSI", 7, b"abc", 36),
    Section("NOTE", 0, b"", 0, required=False),
    Section("TABL", 65535, bytes(range(9)), 5000, required=False),
]
KNOWN_TYPES = {section.type for section in SAMPLE_SECTIONS}


def forge_fields(data: bytes, index: int | None = None, **fields: int | bytes) -> bytes:
    """Change fields of the header, or of entry `index` of the table, and recompute all checksums."""
    forged = bytearray(data)
    base, columns = (0, HEADER_FIELDS) if index is None else (HEADER_BYTES + ENTRY_BYTES * index, ENTRY_FIELDS)
    for name, value in fields.items():
        place, code = columns[name]
        struct.pack_into(code, forged, base + place, value)
    if index is not None:
        (count,) = struct.unpack_from("<I", forged, 36)
        struct.pack_into("<I", forged, 40, zlib.crc32(forged[HEADER_BYTES : HEADER_BYTES + ENTRY_BYTES * count]))
    struct.pack_into("<I", forged, 44, zlib.crc32(forged[:44]))
    return bytes(forged)


def read_all(data: bytes, known: set[str] | None = KNOWN_TYPES) -> list[Section]:
    return read_container(data, known).sections


def section_contents(sections: list[Section]) -> list[tuple]:
    return [(s.type, s.codec, bytes(s.data), s.raw_length, s.required) for s in sections]


section_lists = st.lists(
    st.builds(
        Section,
        type=st.text("ABCxyz019_", min_size=4, max_size=4),
        codec=st.integers(0, 65535),
        data=st.binary(max_size=100),
        raw_length=st.integers(0, 100_000),
        required=st.booleans(),
    ),
    unique_by=lambda section: section.type,
    max_size=8,
)


# --- round trip ---


@given(section_lists)
def test_sections_round_trip(sections):
    assert section_contents(read_all(write_container(sections, minor=MINOR_VERSION), known=None)) == section_contents(
        sections
    )


@given(section_lists)
def test_writing_is_deterministic_and_rewriting_changes_nothing(sections):
    data = write_container(sections, minor=MINOR_VERSION)

    assert write_container(sections, minor=MINOR_VERSION) == data
    assert write_container(read_all(data, known=None), minor=MINOR_VERSION) == data


def test_bytes_follow_the_specification():
    # The expected bytes are built by hand from docs/reference/format.md.
    payload = b"hello"
    entry = b"TEXT" + struct.pack("<HHQQQII", 3, 1, 88, 5, 10, zlib.crc32(payload), 0)
    header = b"\x89HYRF\r\n\n" + struct.pack("<HHIQQIII", 1, 2, 0, 96, 48, 40, 1, zlib.crc32(entry))
    by_hand = header + struct.pack("<I", zlib.crc32(header)) + entry + payload + bytes(3)

    assert write_container([Section("TEXT", 3, payload, 10)], minor=2) == by_hand


def test_sections_start_at_multiples_of_eight():
    assert all(
        entry.offset % 8 == 0
        for entry in read_container(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)).entries.values()
    )


def test_section_data_is_a_view_of_the_input():
    data = write_container([Section("BULK", 0, bytes(1 << 20), 1 << 20)], minor=MINOR_VERSION)

    tracemalloc.start()
    section = read_container(data)["BULK"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert len(section.data) == 1 << 20 and peak < 100_000


@pytest.mark.parametrize("values", [np.arange(6.0).reshape(2, 3), np.empty((0, 3))], ids=["filled", "empty"])
def test_writer_accepts_any_contiguous_buffer(values):
    (section,) = read_all(
        write_container([Section("DATA", 0, values.data, values.nbytes)], minor=MINOR_VERSION), known=None
    )

    assert bytes(section.data) == values.tobytes()


@pytest.mark.parametrize(
    "sections",
    [
        [Section("TOOLONG", 0, b"", 0)],
        [Section("A B ", 0, b"", 0)],
        [Section("é000", 0, b"", 0)],
        [Section("ABC\n", 0, b"", 0)],
        [Section("SAME", 0, b"", 0), Section("SAME", 0, b"x", 1)],
        [Section("CODC", 65536, b"", 0)],
        [Section("NEGA", 0, b"", -1)],
        [Section("BOMB", 0, b"", 1 << 30)],
        [Section(f"{i:04}", 0, b"", 0) for i in range(1025)],
    ],
    ids=["long", "space", "unicode", "newline", "twice", "codec", "negative", "bomb", "many"],
)
def test_writer_refuses_sections_that_the_reader_would_refuse(sections):
    with pytest.raises(ValueError):
        write_container(sections, minor=MINOR_VERSION)


@pytest.mark.parametrize("minor", [-1, 7])
def test_writer_refuses_an_unspecified_minor_version(minor):
    with pytest.raises(ValueError, match=f"version 1.{minor} "):
        write_container(SAMPLE_SECTIONS, minor=minor)


# --- reading from a path ---


def test_open_reads_only_header_and_table_until_a_section_is_requested(tmp_path):
    path = tmp_path / "large.hyrf"
    path.write_bytes(
        write_container([Section("BULK", 0, bytes(8 << 20), 8 << 20), *SAMPLE_SECTIONS], minor=MINOR_VERSION)
    )

    tracemalloc.start()
    with Container.open(path) as container:
        meta = container["META"]
        places = list(container.entries)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert bytes(meta.data) == SAMPLE_SECTIONS[0].data and places == ["BULK", "META", "POSI", "NOTE", "TABL"]
    assert peak < 200_000


def test_damage_is_detected_only_in_the_section_that_is_read(tmp_path):
    path = tmp_path / "damaged.hyrf"
    data = bytearray(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION))
    data[-9] ^= 1
    path.write_bytes(data)

    with Container.open(path, KNOWN_TYPES) as container:
        assert section_contents([container["META"], container["POSI"]]) == section_contents(SAMPLE_SECTIONS[:2])
        with pytest.raises(HyrfFormatError, match="damaged.hyrf.*'TABL'"):
            container["TABL"]


def test_a_file_truncated_while_it_is_read_is_reported(tmp_path):
    path = tmp_path / "cut.hyrf"
    path.write_bytes(write_container([Section("BULK", 0, bytes(1 << 20), 1 << 20)], minor=MINOR_VERSION))

    with Container.open(path) as container:
        os.truncate(path, 1 << 19)
        with pytest.raises(HyrfFormatError, match="cut.hyrf: the file became shorter"):
            container["BULK"]


def make_folder(path: Path) -> None:
    path.mkdir()


def make_empty_file(path: Path) -> None:
    path.write_bytes(b"")


def make_text_file(path: Path) -> None:
    path.write_text("version https://example.org/pointer\nsize 12345\n" * 9)


def make_file_mangled_as_text(path: Path) -> None:
    path.write_bytes(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION).replace(b"\r\n", b"\n"))


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def make_link_to_itself(path: Path) -> None:
    path.symlink_to(path)


def make_nothing(path: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("make", "message_part"),
    [
        (make_folder, "folder"),
        (make_empty_file, "empty"),
        (make_text_file, "not a .hyrf file"),
        (make_file_mangled_as_text, "not a .hyrf file"),
        (make_pipe, "not a regular file"),
        (make_link_to_itself, "cannot be read"),
        (make_nothing, "no such file"),
    ],
)
def test_open_refuses_other_paths_than_hyrf_files(tmp_path, make: Callable[[Path], None], message_part: str):
    path = tmp_path / "model.hyrf"
    make(path)

    with pytest.raises(HyrfFormatError, match=f"model.hyrf: .*{message_part}"):
        Container.open(path)


def test_open_refuses_a_name_with_a_null_byte():
    with pytest.raises(HyrfFormatError, match="cannot be read"):
        Container.open("model\0.hyrf")


# --- versions and unknown sections ---


def test_unknown_optional_section_is_skipped_but_listed():
    container = read_container(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), known={"META", "POSI"})

    assert section_contents(container.sections) == section_contents(SAMPLE_SECTIONS[:2])
    assert "TABL" not in container and list(container.entries) == ["META", "POSI", "NOTE", "TABL"]
    with pytest.raises(HyrfFormatError, match="no section 'TABL'"):
        container["TABL"]


def test_unknown_required_section_is_refused_by_name():
    with pytest.raises(HyrfFormatError, match="'POSI' is required.*update hyrfpack"):
        read_container(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), known={"META"})


def test_newer_major_version_is_refused_regardless_of_the_content():
    with pytest.raises(HyrfFormatError, match="version 2.7.*update hyrfpack"):
        read_container(b"\x89HYRF\r\n\n" + struct.pack("<HH", 2, 7) + b"\xff" * 100)


def test_newer_minor_version_is_read():
    container = read_container(
        forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), minor=9), KNOWN_TYPES
    )

    assert container.version == (1, 9) and section_contents(container.sections) == section_contents(SAMPLE_SECTIONS)


def test_unknown_header_flag_is_refused():
    with pytest.raises(HyrfFormatError, match="flags 0x4.*update hyrfpack"):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), flags=4))


# --- damage ---


def test_every_truncation_is_refused():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)

    for length in range(len(data)):
        with pytest.raises(HyrfFormatError, match="truncated" if length >= HEADER_BYTES else None):
            read_container(data[:length])


def test_every_truncation_with_a_matching_header_is_refused():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)

    for length in range(HEADER_BYTES, len(data)):
        with pytest.raises(HyrfFormatError):
            read_container(forge_fields(data[:length], file_length=length))


def test_bytes_after_the_end_are_refused():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)

    with pytest.raises(HyrfFormatError, match=f"says {len(data)} bytes and there are {len(data) + 8}"):
        read_container(data + bytes(8))
    with pytest.raises(HyrfFormatError, match="sections end at"):
        read_container(forge_fields(data + bytes(8), file_length=len(data) + 8))


def test_every_flipped_bit_is_detected():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)

    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(HyrfFormatError):
            read_all(bytes(flipped))


def test_nonzero_padding_is_refused():
    data = bytearray(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION))
    data[-1] = 1

    with pytest.raises(HyrfFormatError, match="padding after section 'TABL'"):
        read_all(bytes(data))


# --- forged numbers with valid checksums ---

HUGE_NUMBERS = (1 << 63, (1 << 64) - 1, 1 << 40)


@pytest.mark.parametrize("value", (0, 8, 56, *HUGE_NUMBERS))
@pytest.mark.parametrize(
    ("field", "message_part"), [("file_length", "the header says"), ("toc_offset", "misplaces the table of contents")]
)
def test_forged_header_field_is_refused(field, message_part, value):
    with pytest.raises(HyrfFormatError, match=message_part):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), **{field: value}))


@pytest.mark.parametrize("field", ["toc_length", "count"])
@pytest.mark.parametrize("value", (0, 3, 5, 1024, 1025, (1 << 32) - 1))
def test_forged_table_size_is_refused(field, value):
    with pytest.raises(HyrfFormatError):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), **{field: value}))


@pytest.mark.parametrize("count", (20, 1024))
def test_table_past_the_end_is_refused(count):
    with pytest.raises(HyrfFormatError, match="misplaces the table of contents"):
        read_container(
            forge_fields(
                write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), count=count, toc_length=count * ENTRY_BYTES
            )
        )


def test_more_sections_than_allowed_are_refused(monkeypatch):
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    monkeypatch.setattr(format_container, "MAX_SECTIONS", 3)

    with pytest.raises(HyrfFormatError, match="4 sections, more than the 3"):
        read_container(data)


def test_the_error_for_a_section_past_the_end_contains_its_type():
    with pytest.raises(HyrfFormatError, match="'TABL' says 64 bytes and 16 are left"):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), 3, length=64))


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize(
    "fields",
    [
        *({"offset": value} for value in (0, 48, 200, 212, *HUGE_NUMBERS)),
        *({"length": value} for value in (64, *HUGE_NUMBERS)),
        {"offset": (1 << 64) - 8, "length": 16},
        *({"raw_length": value} for value in HUGE_NUMBERS),
        *({"flags": value} for value in (2, 3, 0x8000)),
        {"reserved": 1},
        *({"type": value} for value in (b"\0\0\0\0", b"a-b\n", b"[b] ", b"\xff\xfe\xfd\xfc")),
    ],
    ids=str,
)
def test_forged_entry_is_refused(index, fields):
    with pytest.raises(HyrfFormatError):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), index, **fields))


def test_overlapping_sections_are_refused():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    first = read_container(data).entries["META"]

    with pytest.raises(HyrfFormatError, match="'POSI' says it starts at"):
        read_container(forge_fields(data, 1, offset=first.offset))


def test_gap_between_sections_is_refused():
    with pytest.raises(HyrfFormatError, match="'POSI' says it starts at"):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), 0, length=5))


def test_repeated_type_is_refused():
    with pytest.raises(HyrfFormatError, match="'META' occurs twice"):
        read_container(forge_fields(write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION), 1, type=b"META"))


def test_declared_bytes_of_all_sections_together_are_limited():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    half = raw_bytes_limit(len(data)) // 2
    assert read_container(forge_fields(data, 0, raw_length=half)).entries["META"].raw_length == half

    with pytest.raises(HyrfFormatError, match="decode to"):
        read_container(forge_fields(forge_fields(data, 0, raw_length=half), 1, raw_length=half + 1))


def test_file_above_the_size_limit_is_refused(monkeypatch):
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    monkeypatch.setattr(format_container, "MAX_FILE_BYTES", len(data) - 1)

    with pytest.raises(HyrfFormatError, match="more than a .hyrf file may have"):
        read_container(data)
    with pytest.raises(ValueError, match="exceed"):
        write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)


def test_forged_sizes_are_refused_before_any_allocation():
    data = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    forgeries = [forge_fields(data, file_length=v) for v in HUGE_NUMBERS] + [
        forge_fields(data, toc_offset=v) for v in HUGE_NUMBERS
    ]
    forgeries += [forge_fields(data, count=v, toc_length=v) for v in (1024, (1 << 32) - 1)]
    forgeries += [
        forge_fields(data, i, **{f: v})
        for i in range(4)
        for f in ("offset", "length", "raw_length")
        for v in HUGE_NUMBERS
    ]

    tracemalloc.start()
    for forged in forgeries:
        with pytest.raises(HyrfFormatError):
            read_container(forged)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1_000_000


hostile_numbers = st.one_of(
    st.integers(0, 300), st.sampled_from([1 << 15, 1 << 31, *HUGE_NUMBERS]), st.integers(0, (1 << 64) - 1)
)


@settings(max_examples=400)
@given(st.data())
def test_any_mutation_is_canonical_or_raises_a_format_error(data):
    file = write_container(SAMPLE_SECTIONS, minor=MINOR_VERSION)
    for _ in range(data.draw(st.integers(1, 3))):
        kind = data.draw(st.sampled_from(["header", "entry", "splice", "raw"]))
        if kind == "splice":
            start, stop = sorted(data.draw(st.tuples(*[st.integers(0, len(file))] * 2)))
            file = file[:start] + data.draw(st.binary(max_size=40)) + file[stop:]
        elif kind == "raw" and file:
            place = data.draw(st.integers(0, len(file) - 1))
            file = file[:place] + bytes([data.draw(st.integers(0, 255))]) + file[place + 1 :]
        elif len(file) >= HEADER_BYTES + ENTRY_BYTES * 4:
            index = data.draw(st.integers(0, 3)) if kind == "entry" else None
            columns = HEADER_FIELDS if index is None else ENTRY_FIELDS
            field = data.draw(st.sampled_from(sorted(columns)))
            size = struct.calcsize(columns[field][1])
            value = data.draw(hostile_numbers) % (1 << 8 * size)
            # The table's checksum can be recomputed only if the count still fits the file.
            if int.from_bytes(file[36:40], "little") <= 4:
                file = forge_fields(file, index, **{field: value.to_bytes(4, "little") if field == "type" else value})

    try:
        sections = read_all(file, known=None)
    except HyrfFormatError as error:
        assert str(error).count("\n") == 0
    else:
        # Accepted bytes are canonical: the writer reproduces them, except for another minor version.
        assert write_container(sections, minor=MINOR_VERSION) == forge_fields(file, minor=MINOR_VERSION)


@given(st.binary(max_size=300))
def test_random_bytes_raise_a_format_error(junk):
    with pytest.raises(HyrfFormatError):
        read_container(junk)
