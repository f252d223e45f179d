"""Hostile tables of other programs: each is read, or refused in one line, and asks for no memory to speak of."""

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
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from tools.safety.fuzz_mutate import HOSTILE_JSON, edit_bytes, list_json_values

MOST_MEMORY = 60e6  # bytes: the tables are of some kilobytes, and a package may be loaded at its first use
TABLES = {
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
def sets(tmp_path_factory) -> Path:
    """A valid set of each layout, three photos of 32 x 24."""
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


def mutated(data: bytes, name: str, rng: Random) -> bytes:
    """Bytes, words or lines of a table changed, or values of JSON."""
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


def read_mutant(sets: Path, layout: str, seed: int) -> str:
    """What became of a mutant: "read" or the sentence. Fails at any other error, and where memory is asked for."""
    rng = Random(seed)
    table = rng.choice(TABLES[layout])
    file = sets / layout / table
    original = file.read_bytes()
    file.write_bytes(mutated(original, file.name, rng))
    tracemalloc.start()
    try:
        scene = load_scene(sets / layout, layout=layout, test_every=0)
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
    assert most < MOST_MEMORY, f"seed {seed} asked for {most} bytes"
    return outcome


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_mutated_tables_are_read_or_refused_in_a_line(sets, layout):
    @settings(max_examples=80, deadline=None)
    @given(st.integers(0, 2**32 - 1))
    def search(seed):
        read_mutant(sets, layout, seed)

    search()


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"\xff" * 100, b"\n" * 100])
def test_tables_of_nothing(sets, tmp_path, layout, content):
    for table in TABLES[layout]:
        root = shutil.copytree(sets / layout, tmp_path / table.replace("/", "-"))
        (root / table).write_bytes(content)
        with pytest.raises(HyrfError) as caught:
            load_scene(root)
        assert str(caught.value).isprintable()
