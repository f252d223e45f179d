"""Hostile tables of other programs are read or refused in one line, in little memory."""

from __future__ import annotations

import json
import re
import shutil
import tracemalloc
from pathlib import Path
from random import Random

import numpy as np
import pytest
from exported_sets import WRITERS_BY_LAYOUT, PhotoCamera, photo_path
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from property_tests import examples

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from tools.safety.fuzz_mutate import HOSTILE_JSON, edit_bytes, list_json_values

# The tables have some kilobytes, but a package may be imported at its first use.
MAX_PEAK_BYTES = 60e6
TABLES_BY_LAYOUT = {
    "llff": ("poses_bounds.npy",),
    "metashape": ("cameras.xml", "points.ply"),
    "bundler": ("bundle.out", "list.txt"),
    "realityscan": ("registration.csv", "sparse.ply"),
    "polycam": ("keyframes/corrected_cameras/0.json",),
    "record3d": ("metadata",),
}
HOSTILE_WORDS = ("nan", "inf", "-inf", "1e308", "-1e308", "1e400", "0", "-0", "-1", "5e-324", "9" * 400, "x" * 3000)
HOSTILE_WORDS += (
    "",
    "\0",
    "\u202e",
    "..",
    "/",
    "../../x",
    '"',
    "'",
    ",",
    "<",
    "&amp;",
    "&#0;",
    "#",
    "0x1f",
    "1_0",
    "\u0661",
)


@pytest.fixture(scope="module")
def layout_folders(tmp_path_factory) -> Path:
    """Write a valid scene folder of each layout with three photos of 32 x 24 pixels."""
    root = tmp_path_factory.mktemp("sets")
    cameras = []
    for index in range(3):
        pose = np.eye(4)
        pose[:3, 3] = index, 0, 5
        cameras.append(PhotoCamera(f"{index}.jpg", 32, 24, 30.0, 30.0, 16.0, 12.0, pose))
    for layout, write in WRITERS_BY_LAYOUT.items():
        for index, camera in enumerate(cameras):
            place = root / layout / photo_path(layout, index, camera.name)
            place.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (32, 24), (index, 100, 200)).save(place)
        write(root / layout, cameras, np.array([[0, 0, 0.0], [0.5, 0.2, 1]]), np.eye(3)[:2])
    return root


def mutate_table(data: bytes, name: str, rng: Random) -> bytes:
    """Return the table with some bytes, words, lines or JSON values changed."""
    kind = rng.randrange(4)
    if kind == 0 or name.endswith(".npy"):
        return edit_bytes(data, rng)
    if kind == 1 and (name.endswith(".json") or name == "metadata"):
        content = json.loads(data)
        for _ in range(rng.randint(1, 3)):
            holder, key = rng.choice(list_json_values(content))
            holder[key] = rng.choice((*HOSTILE_JSON, [1e308] * 7, [[0.0] * 7] * 2, "1"))
        return json.dumps(content).encode()
    text = data.decode()
    if kind == 2:
        lines = text.split("\n")
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(lines))
            lines[at : at + rng.randint(0, 2)] = rng.choice(([], [lines[rng.randrange(len(lines))]], [""]))
            lines = lines or [""]
        return "\n".join(lines).encode()
    words = list(re.finditer(r"[-\w.+]+", text))
    for word in sorted(rng.sample(words, min(len(words), rng.randint(1, 4))), key=re.Match.start, reverse=True):
        text = text[: word.start()] + rng.choice(HOSTILE_WORDS) + text[word.end() :]
    return text.encode(errors="surrogatepass")


def read_mutant(layout_folders: Path, layout: str, seed: int) -> str:
    """Load a mutated table; return "read" or the error message.

    Fails at any error but a HyrfError of one line, and at a peak of MAX_PEAK_BYTES or more.
    """
    rng = Random(seed)
    table = rng.choice(TABLES_BY_LAYOUT[layout])
    file = layout_folders / layout / table
    original = file.read_bytes()
    file.write_bytes(mutate_table(original, file.name, rng))
    tracemalloc.start()
    try:
        scene = load_scene(layout_folders / layout, layout=layout, test_every=0)
        assert np.isfinite(scene.points).all()
        for view in scene.views:
            assert view.load().rgb.shape == (24, 32, 3)
        outcome = "read"
    except HyrfError as error:
        assert str(error).isprintable() and 10 < len(str(error)) < 6000
        outcome = str(error)
    finally:
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        file.write_bytes(original)
    assert most < MAX_PEAK_BYTES, f"seed {seed} asked for {most} bytes"
    return outcome


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_mutated_tables_are_read_or_refused_in_one_line(layout_folders, layout):
    @examples(40)
    @given(st.integers(0, 2**32 - 1))
    def search(seed):
        read_mutant(layout_folders, layout, seed)

    search()


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"\xff" * 100, b"\n" * 100])
def test_tables_without_content_are_refused(layout_folders, tmp_path, layout, content):
    for table in TABLES_BY_LAYOUT[layout]:
        root = shutil.copytree(layout_folders / layout, tmp_path / table.replace("/", "-"))
        (root / table).write_bytes(content)
        with pytest.raises(HyrfError) as caught:
            load_scene(root)
        assert str(caught.value).isprintable()
