"""The manifest of a scene folder: what is written is read back, and no forged or damaged one is accepted."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from json_schema import matches

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import scene_manifest
from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, SceneFile, parse_manifest
from hyrfpack.format.shared import is_file_name

MANIFEST_SCHEMA = json.loads(Path(scene_manifest.__file__).with_name("scene.schema.json").read_text())
VALID_MANIFEST = Manifest(
    gaussians=7,
    shared=SceneFile("shared.hyrf", 1000, "0123abcd"),
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


def with_value(path: list[Any], value: Any) -> bytes:
    """Return the text of VALID_MANIFEST with another value at a path of keys and places."""
    values = json.loads(VALID_MANIFEST.to_json())
    inner = values
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return json.dumps(values).encode()


def test_a_manifest_is_read_as_it_was_written():
    assert parse_manifest(VALID_MANIFEST.to_json()) == VALID_MANIFEST


def test_a_written_manifest_matches_the_schema():
    assert matches(json.loads(VALID_MANIFEST.to_json()), MANIFEST_SCHEMA)


def test_unknown_keys_and_a_later_minor_version_are_accepted():
    values = json.loads(VALID_MANIFEST.to_json()) | {"version": "1.7", "sky": "blue"}

    assert parse_manifest(json.dumps(values).encode()) == VALID_MANIFEST


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
        (["version"], "2.0", "version 2.0 and this hyrfpack reads version 1"),
        (["version"], None, "no version"),
        (["format"], "other", "not the manifest of a scene folder"),
        (["gaussians"], 8, "do not add up to 8"),
        (["gaussians"], True, "'gaussians' must be of type int"),
        (["shared", "bytes"], -1, "'bytes' is out of range"),
        (["shared", "crc32"], "XYZ", "not 8 hexadecimal digits"),
        (["chunks", 1, "levels", 0, "file"], "Shared.hyrf", "two files are named 'shared.hyrf'"),
        (["chunks", 0, "levels"], [], "'levels' has 0 entries"),
        (["chunks", 0, "levels", 1, "errors"], [0.1], "'errors' has 1 entries"),
        (["chunks", 0, "levels", 1, "errors"], [0.1, -0.1], "'errors' holds a number out of range"),
        (["chunks", 0, "low"], [5, 5, 5], "box of a chunk is not in order"),
        (["error_radii"], [64, 16], "do not rise"),
        (["error_radii"], [10**400, 16], "out of range"),
        (["title"], "two\nlines", "control character"),
    ],
)
def test_a_manifest_with_an_impossible_value_is_refused(path, value, problem):
    with pytest.raises(HyrfFormatError, match=problem):
        parse_manifest(with_value(path, value))


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


@settings(deadline=None)
@given(st.sampled_from(list_paths(json.loads(VALID_MANIFEST.to_json()))), JSON_VALUES)
def test_any_change_of_a_value_gives_a_valid_manifest_or_a_format_error(path, value):
    data = with_value(list(path), deepcopy(value))
    try:
        parsed = parse_manifest(data)
    except HyrfFormatError:
        return
    assert matches(json.loads(parsed.to_json()), MANIFEST_SCHEMA) and matches(json.loads(data), MANIFEST_SCHEMA)
