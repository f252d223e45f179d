"""The manifest of a scene folder: what is written is read back, and no forged or damaged one is accepted."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from json_schema import matches

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import scene_manifest
from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart, parse_manifest
from hyrfpack.format.shared import is_file_name

MANIFEST_SCHEMA = json.loads(Path(scene_manifest.__file__).with_name("scene.schema.json").read_text())
VALID_MANIFEST = Manifest(
    gaussians=7,
    parts=(ScenePart("shared.hyrf", 1000, "0123abcd"),),
    chunks=(
        Chunk(
            (-1.0, 0.0, 2.5),
            (1.0, 0.0, 4.5),
            (
                ChunkLevel("chunk-0.hyrf", 500, "00000000", 4, (0.0, 0.0)),
                ChunkLevel("chunk-1.hyrf", 200, "ffffffff", 1, (0.01, 0.02)),
            ),
        ),
        Chunk((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (ChunkLevel("b.hyrf", 300, "89abcdef", 3, (0.0, 0.0)),)),
    ),
    error_radii=(16.0, 64.0),
    frame={"center": [0, 0, 0], "scale": 1, "half_extent": [1, 1, 1]},
    background=True,
    solid=(0.0, 0.0, 0.0),
    viewpoint={"center": [0, 0, 0]},
    cameras=((1.0, 2.0),),
    title="a caf\u00e9",
    writer="hyrfpack",
)

PARTS_MANIFEST = replace(
    VALID_MANIFEST,
    parts=(ScenePart("a.hyrf", 1000, "0123abcd", "house"), ScenePart("c.hyrf", 900, "00112233", "gard\u00e9n")),
    chunks=tuple(replace(chunk, part=number) for number, chunk in enumerate(VALID_MANIFEST.chunks)),
)


def with_value(path: list[Any], value: Any, manifest: Manifest = VALID_MANIFEST) -> bytes:
    """Return the text of a manifest with another value at a path of keys and places."""
    values = json.loads(manifest.to_json())
    inner = values
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return json.dumps(values).encode()


@pytest.mark.parametrize(("manifest", "version"), [(VALID_MANIFEST, "1.0"), (PARTS_MANIFEST, "2.0")])
def test_a_manifest_is_read_as_it_was_written_and_matches_the_schema(manifest, version):
    values = json.loads(manifest.to_json())

    assert parse_manifest(manifest.to_json()) == manifest
    assert values["version"] == version and matches(values, MANIFEST_SCHEMA)


@pytest.mark.parametrize("text", ["12\u00a0m", "\u4eac\u90fd\u3000\u5bfa", "\U0001f469\u200d\U0001f52c", "x" * 1000])
def test_texts_without_control_characters_are_read_as_they_were_written(text):
    manifest = replace(VALID_MANIFEST, title=text, licence=text)

    assert parse_manifest(manifest.to_json()) == manifest


def test_a_manifest_is_nested_as_deep_as_a_file_may_be():
    def nested(depth: int) -> Any:
        return {} if depth == 0 else {"a": nested(depth - 1)}

    parse_manifest(with_value(["viewpoint"], nested(62)))
    for key in ("frame", "viewpoint", "unknown"):
        for depth in (63, 64, 700):
            with pytest.raises(HyrfFormatError, match="nested deeper than 64 levels"):
                parse_manifest(with_value([key], nested(depth)))


def test_a_manifest_of_one_part_has_the_keys_of_version_1_alone():
    values = json.loads(VALID_MANIFEST.to_json())

    assert set(values["shared"]) == {"file", "bytes", "crc32"} and "parts" not in values
    assert all(set(chunk) == {"low", "high", "levels"} for chunk in values["chunks"])


@pytest.mark.parametrize(("manifest", "version"), [(VALID_MANIFEST, "1.7"), (PARTS_MANIFEST, "2.7")])
def test_unknown_keys_and_a_later_minor_version_are_accepted(manifest, version):
    values = json.loads(manifest.to_json()) | {"version": version, "sky": "blue"}

    assert parse_manifest(json.dumps(values).encode()) == manifest


@pytest.mark.parametrize(
    "name",
    [
        "../shared.hyrf",
        "a/b.hyrf",
        "a\\b.hyrf",
        "/etc/a.hyrf",
        "C:a.hyrf",
        ".a.hyrf",
        "a.json",
        "a.hyrf\n",
        "",
        1,
        None,
    ],
)
def test_a_name_that_leads_out_of_the_folder_is_refused(name):
    data = with_value(["chunks", 0, "levels", 0, "file"], name)

    assert not is_file_name(name)
    with pytest.raises(HyrfFormatError, match="is not the name of a .hyrf file in the folder"):
        parse_manifest(data)


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        (["version"], "3.0", "version 3.0 and this hyrfpack reads versions 1 and 2"),
        (["version"], "2.0", "'parts' must be of type list"),
        (["version"], None, "no version"),
        (["format"], "other", "not the manifest of a scene folder"),
        (["gaussians"], 8, "do not add up to 8"),
        (["gaussians"], True, "'gaussians' must be of type int"),
        (["shared", "bytes"], -1, "'bytes' is out of range"),
        (["shared", "bytes"], 2**34 + 1, "'bytes' is out of range"),
        (["shared", "crc32"], "XYZ", "not 8 hexadecimal digits"),
        (["chunks", 1, "levels", 0, "file"], "Shared.hyrf", "two files are named 'shared.hyrf'"),
        (["chunks", 0, "levels"], [], "'levels' has 0 entries"),
        (["chunks", 0, "levels", 1, "errors"], [0.1], "'errors' has 1 entries"),
        (["chunks", 0, "levels", 1, "errors"], [0.1, -0.1], "'errors' holds a number out of range"),
        (["chunks", 0, "low"], [5, 5, 5], "box of a chunk is not in order"),
        (["error_radii"], [64, 16], "do not rise"),
        (["error_radii"], [10**400, 16], "out of range"),
        (["title"], "two\nlines", "control character"),
        (["title"], "\ud83d", "control character"),
        (["licence"], "x" * 1001, "at most 1,000 characters"),
    ],
)
def test_a_manifest_with_an_impossible_value_is_refused(path, value, problem):
    with pytest.raises(HyrfFormatError, match=problem):
        parse_manifest(with_value(path, value))


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        (["version"], "1.0", "'shared' must be of type dict"),
        (["parts"], [], "'parts' has 0 entries"),
        (["parts"], [json.loads(PARTS_MANIFEST.to_json())["parts"][0]], "'parts' has 1 entries"),
        (["parts", 1], "c.hyrf", "a part is not an object"),
        (["parts", 1, "name"], "house", "two parts have the same name"),
        (["parts", 1, "name"], "", "cannot be the name of a part"),
        (["parts", 1, "file"], "../c.hyrf", "is not the name of a .hyrf file in the folder"),
        (["parts", 1, "file"], "B.hyrf", "two files are named 'b.hyrf'"),
        (["chunks", 0, "part"], 2, "a chunk belongs to part 2, and there are 2 parts"),
        (["chunks", 0, "part"], -1, "'part' is out of range"),
        (["chunks", 0, "part"], None, "'part' must be of type int"),
    ],
)
def test_a_manifest_with_an_impossible_part_is_refused(path, value, problem):
    with pytest.raises(HyrfFormatError, match=problem):
        parse_manifest(with_value(path, value, PARTS_MANIFEST))


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"{}", b"[" * 5000, b'{"format": NaN}', b"\xff\xfe", VALID_MANIFEST.to_json()[:-20]]
)
def test_a_text_that_is_no_manifest_is_refused(data):
    with pytest.raises(HyrfFormatError):
        parse_manifest(data)


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def list_paths(value: Any, path: tuple = ()) -> list[tuple]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [found for key, item in inner for found in list_paths(item, (*path, key))]


DAMAGING_CHANGES = [
    (manifest, path)
    for manifest in (VALID_MANIFEST, PARTS_MANIFEST)
    for path in list_paths(json.loads(manifest.to_json()))
]


@given(st.sampled_from(DAMAGING_CHANGES), JSON_VALUES)
def test_any_change_of_a_value_gives_a_valid_manifest_or_a_format_error(change, value):
    manifest, path = change
    data = with_value(list(path), deepcopy(value), manifest)
    try:
        parsed = parse_manifest(data)
    except HyrfFormatError:
        return
    assert matches(json.loads(parsed.to_json()), MANIFEST_SCHEMA) and matches(json.loads(data), MANIFEST_SCHEMA)
