"""hyrf.js reads the manifest of a scene folder and chooses levels of detail as hyrfpack does."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from format.test_scene_manifest import PARTS_MANIFEST, VALID_MANIFEST, with_value
from scenes import camera_at
from web.scripts import run_script

from hyrfpack.cameras.files import camera_to_json
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart, parse_manifest
from hyrfpack.lod.select import predict_errors, select_levels
from tools.safety.make_golden import GOLDEN_PARTS_SCENE_FOLDER, GOLDEN_SCENE_FOLDER

SELECT_SCRIPT = Path(__file__).with_name("select_levels.mjs")
LATER_VERSION = json.dumps({**json.loads(VALID_MANIFEST.to_json()), "version": "1.7", "sky": "blue"}).encode()
VALID_FRAME = {"center": [0, 0, 0], "scale": 1, "half_extent": [1, 1, 1]}
ROTATED_MANIFEST = with_value(["frame", "rotation"], [0.6, 0, -0.8, 0])
INTEGRAL_FLOATS = VALID_MANIFEST.to_json().replace(b'"bytes":1000,', b'"bytes":1000.0,')
NESTED_NAME = VALID_MANIFEST.to_json().replace(b'"shared.hyrf"', b"[" * 20_000 + b"]" * 20_000)
VIEWPOINT_BY_DEPTH = {
    depth: json.loads("[" * depth + "]" * depth) for depth in (62, 63)
}  # below the manifest and 'viewpoint'
BAD_MANIFESTS = [
    NESTED_NAME,
    with_value(["viewpoint"], {"a": VIEWPOINT_BY_DEPTH[63]}),
    b"",
    b"[]",
    b"{}",
    b'{"format": NaN}',
    b"\xff\xfe",
    VALID_MANIFEST.to_json()[:-20],
    *(
        with_value(path, value)
        for path, value in [
            (["version"], "2.0"),
            (["version"], "3.0"),
            (["version"], "0.9"),
            (["version"], None),
            (["format"], "other"),
            (["gaussians"], 8),
            (["gaussians"], True),
            (["shared"], None),
            (["shared", "bytes"], -1),
            (["shared", "bytes"], 2**40),
            (["shared", "crc32"], "XYZ"),
            (["shared", "file"], "../shared.hyrf"),
            (["shared", "file"], {"toString": 1, "valueOf": 1}),
            (["shared", "file"], None),
            (["shared", "file"], 5),
            (["chunks", 0, "levels", 0, "file"], "a/b.hyrf"),
            (["chunks", 1, "levels", 0, "file"], "Shared.hyrf"),
            (["chunks", 0, "levels"], []),
            (["chunks", 0], 5),
            (["chunks", 0, "levels", 1, "errors"], [0.1]),
            (["chunks", 0, "levels", 1, "errors"], [0.1, -0.1]),
            (["chunks", 0, "low"], [5, 5, 5]),
            (["chunks", 0, "high"], [5, 5]),
            (["error_radii"], [64, 16]),
            (["error_radii"], []),
            (["solid"], None),
            (["background"], 1),
            (["frame"], []),
            (["frame"], {}),
            (["frame", "center"], [0, 0]),
            (["frame", "center"], [0, 0, "0"]),
            (["frame", "scale"], 0),
            (["frame", "scale"], None),
            (["frame", "rotation"], "x"),
            (["frame", "rotation"], None),
            (["frame", "rotation"], [1, 0, 0]),
            (["frame", "rotation"], [1, 0, 0, 1]),
            (["cameras"], [[]]),
            (["title"], "two\nlines"),
            (["title"], "half of a pair \ud83d"),
            (["licence"], "x" * 1001),
            (["chunks", 0, "levels", 0, "bytes"], 2**34 + 1),
        ]
    ),
    *(
        with_value(path, value, PARTS_MANIFEST)
        for path, value in [
            (["version"], "1.0"),
            (["parts"], []),
            (["parts"], [json.loads(PARTS_MANIFEST.to_json())["parts"][0]]),
            (["parts"], {"0": 1}),
            (["parts", 1], "c.hyrf"),
            (["parts", 1, "name"], "house"),
            (["parts", 1, "name"], ""),
            (["parts", 1, "name"], "a\nb"),
            (["parts", 1, "file"], "../c.hyrf"),
            (["parts", 1, "file"], "B.hyrf"),
            (["parts", 1, "crc32"], "XYZ"),
            (["chunks", 0, "part"], 2),
            (["chunks", 0, "part"], -1),
            (["chunks", 0, "part"], 0.5),
            (["chunks", 0, "part"], None),
        ]
    ),
]


def run(tmp_path: Path, cases: list[dict[str, Any]]) -> list[dict]:
    """Return what the script answers for cases whose manifests are bytes."""
    texts = [{**case, "manifest": base64.b64encode(case["manifest"]).decode()} for case in cases]
    (tmp_path / "cases.json").write_text(json.dumps(texts))
    return run_script(SELECT_SCRIPT, tmp_path / "cases.json")


def random_manifest(rng: np.random.Generator) -> Manifest:
    """Return a manifest of chunks of all sizes, some with levels that are no better than cheaper ones."""
    chunks = []
    radii = tuple(np.cumsum(rng.uniform(1, 200, rng.integers(1, 9))).tolist())
    for number in range(rng.integers(1, 30)):
        low, levels = rng.normal(size=3) * 20, []
        gaussians = int(rng.integers(1, 3000))
        for level in range(rng.integers(1, 9)):
            errors = tuple((rng.uniform(0, 0.02) * level * np.sort(rng.uniform(size=len(radii)))).tolist())
            name, size = f"chunk-{number}-{level}.hyrf", int(rng.integers(1, 40_000))
            levels.append(ChunkLevel(name, size, "0123abcd", max(1, gaussians >> (2 * level)), errors))
        chunks.append(Chunk(tuple(low), tuple(low + rng.uniform(0, 10, 3)), tuple(levels)))
    count = sum(chunk.levels[0].gaussians for chunk in chunks)
    return Manifest(
        count, (ScenePart("shared.hyrf", 500, "0123abcd"),), tuple(chunks), radii, VALID_FRAME, False, (0.0, 0.0, 0.0)
    )


def test_the_selection_is_that_of_python(tmp_path: Path):
    rng = np.random.default_rng(0)
    cases, expected = [], []
    for _ in range(60):
        manifest = random_manifest(rng)
        camera = camera_at(tuple(rng.normal(size=3) * 15), width=200, height=150, focal=float(rng.uniform(50, 900)))
        for options in (
            {},
            {"gaussians": int(rng.integers(0, manifest.gaussians + 1))},
            {"bytes": int(rng.integers(0, manifest.total_bytes))},
        ):
            cases.append({"manifest": manifest.to_json(), "camera": camera_to_json(camera), "options": options})
            expected.append(select_levels(manifest, camera, **options))
    for folder in (GOLDEN_SCENE_FOLDER, GOLDEN_PARTS_SCENE_FOLDER):
        golden = (folder / "scene.json").read_bytes()
        camera = camera_at((1e6, 3, -20), width=80, height=60, focal=70)
        cases.append({"manifest": golden, "camera": camera_to_json(camera)})
        expected.append(select_levels(parse_manifest(golden), camera))

    answers = run(tmp_path, cases)

    for answer, choice in zip(answers, expected, strict=True):
        assert (answer["levels"], answer["gaussians"], answer["bytes"]) == (
            [-1 if level is None else level for level in choice.levels],
            choice.gaussians,
            choice.bytes,
        )
        assert answer["predictedMse"] == pytest.approx(choice.predicted_mse, rel=1e-9, abs=1e-15)
        assert answer["maxGap"] == pytest.approx(choice.max_gap, rel=1e-9, abs=1e-15)


def test_levels_that_are_not_available_are_left_out(tmp_path: Path):
    """The best choice among the rest, by trying all, is at most the stated gap better."""
    rng = np.random.default_rng(1)
    camera = camera_at((0, -30, 0), width=200, height=150, focal=300)
    files = (ScenePart("shared.hyrf", 500, "0123abcd"),)
    chunks = tuple(chunk for _ in range(4) for chunk in random_manifest(rng).chunks[:1])
    names = [f"{number}.hyrf" for number in range(sum(len(chunk.levels) for chunk in chunks))]
    chunks = tuple(
        Chunk(
            chunk.low,
            chunk.high,
            tuple(ChunkLevel(names.pop(), x.bytes, x.crc32, x.gaussians, x.errors[:1]) for x in chunk.levels[:4]),
        )
        for chunk in chunks
    )
    count = sum(chunk.levels[0].gaussians for chunk in chunks)
    manifest = Manifest(count, files, chunks, (50.0,), VALID_FRAME, False, (0.0, 0.0, 0.0))
    missing = [[0, 0], *([1, level] for level in range(len(chunks[1].levels)))]
    limit = count // 3

    (answer,) = run(
        tmp_path,
        [
            {
                "manifest": manifest.to_json(),
                "camera": camera_to_json(camera),
                "options": {"gaussians": limit},
                "missing": missing,
            }
        ],
    )

    assert answer["levels"][1] == -1 and all(
        [chunk, level] not in missing for chunk, level in enumerate(answer["levels"])
    )
    errors, best = predict_errors(manifest, camera), math.inf
    counts = [[*(level.gaussians for level in chunk.levels), 0] for chunk in chunks]
    for levels in product(*map(range, map(len, counts))):
        picked = list(enumerate(levels))
        if all([*each] not in missing for each in picked) and sum(counts[c][level] for c, level in picked) <= limit:
            best = min(best, sum(errors[c][level] for c, level in picked))
    assert answer["gaussians"] <= limit and best < math.inf
    assert answer["predictedMse"] - best <= answer["maxGap"] + 1e-12


def test_manifests_are_accepted_and_refused_as_in_python(tmp_path: Path):
    folders = (GOLDEN_SCENE_FOLDER, GOLDEN_PARTS_SCENE_FOLDER)
    golden = [(folder / "scene.json").read_bytes() for folder in folders]
    titles = [with_value(["title"], title) for title in ("Salle\u00a012", "\u3000", "\U0001f469\u200d\U0001f680")]
    good = [
        VALID_MANIFEST.to_json(),
        PARTS_MANIFEST.to_json(),
        LATER_VERSION,
        INTEGRAL_FLOATS,
        ROTATED_MANIFEST,
        with_value(["viewpoint"], {"a": VIEWPOINT_BY_DEPTH[62]}),
        *titles,
        *golden,
    ]

    answers = run(tmp_path, [{"manifest": data} for data in good + BAD_MANIFESTS])

    for answer, manifest in zip(answers, (VALID_MANIFEST, PARTS_MANIFEST), strict=False):
        expected = json.loads(json.dumps(asdict(manifest)))
        assert {key: answer[key] for key in expected} == expected
    assert all("refused" not in answer for answer in answers[: len(good)])
    for data in good:
        parse_manifest(data)
    for data, answer in zip(BAD_MANIFESTS, answers[len(good) :], strict=True):
        with pytest.raises(HyrfFormatError):
            parse_manifest(data)
        assert answer.get("refused", "").count("\n") == 0 and "refused" in answer, data


@pytest.mark.parametrize("version", ["0.9", "3.0"])
def test_a_manifest_of_an_unknown_version_is_refused_by_the_versions_that_are_read(version: str, tmp_path: Path):
    (answer,) = run(tmp_path, [{"manifest": with_value(["version"], version)}])
    assert f"version {version} and this reader knows versions 1 and 2" in answer["refused"]
