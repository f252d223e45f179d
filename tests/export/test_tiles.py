"""A scene folder becomes a tileset that follows 3D Tiles, whose tiles hold the chunks upright and switch in time."""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from json_schema import matches
from scenes import camera_at

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.export import pipeline
from hyrfpack.export.tiles import compute_geometric_errors
from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart
from hyrfpack.lod.select import predict_errors
from hyrfpack.rotations import rotation_matrices
from hyrfpack.splats.formats import gltf, spz
from hyrfpack.splats.splats import Splats
from tools.safety.make_golden import GOLDEN_PARTS_SCENE_FOLDER

QUIET_CONTEXT = RunContext(progress=None)
CONTENT_KINDS = ("gltf", "spz")
Y_TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # 3D Tiles 1.1, section 6.7.1.6.2
# The parts of the JSON schema of 3D Tiles 1.1 that concern our tilesets.
NUMBER_SCHEMA = {"type": "number"}
TEXTS_SCHEMA = {"type": "array", "items": {"type": "string"}, "minItems": 1}
TILESET_SCHEMA = {
    "type": "object",
    "properties": {
        "asset": {"type": "object", "properties": {"version": {"const": "1.1"}}, "required": ["version"]},
        "geometricError": {"type": "number", "minimum": 0},
        "root": {"$ref": "#/$defs/tile"},
        "extensionsUsed": TEXTS_SCHEMA,
        "extensions": {
            "type": "object",
            "properties": {
                "3DTILES_content_gltf": {
                    "type": "object",
                    "properties": {"extensionsUsed": TEXTS_SCHEMA, "extensionsRequired": TEXTS_SCHEMA},
                }
            },
        },
    },
    "required": ["asset", "geometricError", "root"],
    "$defs": {
        "tile": {
            "type": "object",
            "properties": {
                "boundingVolume": {
                    "type": "object",
                    "properties": {"box": {"type": "array", "items": NUMBER_SCHEMA, "minItems": 12, "maxItems": 12}},
                    "required": ["box"],
                },
                "geometricError": {"type": "number", "minimum": 0},
                "refine": {"type": "string", "pattern": "^(ADD|REPLACE)$"},
                "transform": {"type": "array", "items": NUMBER_SCHEMA, "minItems": 16, "maxItems": 16},
                "content": {"type": "object", "properties": {"uri": {"type": "string"}}, "required": ["uri"]},
                "children": {"type": "array", "items": {"$ref": "#/$defs/tile"}, "minItems": 1},
            },
            "required": ["boundingVolume", "geometricError"],
        }
    },
}


@pytest.fixture(scope="module")
def exported(scene, tmp_path_factory) -> dict:
    """Return by kind of content the folder, the report and the tileset."""
    found = {}
    for content in CONTENT_KINDS:
        folder = tmp_path_factory.mktemp("tiles") / content
        config = hyrfpack.ExportConfig(tiles_3d=True, tile_content=content, degree=1)
        report = hyrfpack.export_model(scene, folder, config, context=QUIET_CONTEXT)
        found[content] = folder, report, json.loads((folder / "tileset.json").read_text())
    return found


def tiles(tile: dict) -> Iterator[dict]:
    yield tile
    for child in tile.get("children", []):
        yield from tiles(child)


def corners(tile: dict) -> tuple[np.ndarray, np.ndarray]:
    box = np.array(tile["boundingVolume"]["box"])
    reach = np.abs(box[3:].reshape(3, 3)).sum(axis=0)
    return box[:3] - reach, box[:3] + reach


def read_chunks(data: bytes) -> tuple[dict, bytes]:
    """Return the JSON and the binary chunk of a .glb file."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def spz_positions(data: bytes) -> np.ndarray:
    """Return the positions of an SPZ file of version 2 as they are stored."""
    content = gzip.decompress(data)
    magic, version, count, _, bits, _, _ = struct.unpack_from("<4sIIBBBB", content)
    assert (magic, version) == (b"NGSP", 2)
    rows = np.frombuffer(content, np.uint8, 9 * count, 16).reshape(-1, 3)
    return ((np.pad(rows, ((0, 0), (1, 0))).view("<i4").reshape(-1, 3) >> 8) / 2**bits).astype(np.float64)


def splats_in_tile(folder: Path, tile: dict) -> Splats:
    """Return the splats of plain glTF content in the axes of its tile."""
    data = (folder / tile["content"]["uri"]).read_bytes()
    return gltf.decode(data, "content", upright=True).rotated(Y_TO_Z_UP)


@pytest.mark.parametrize("content", CONTENT_KINDS)
def test_the_tileset_follows_the_specification(content, exported):
    folder, report, tileset = exported[content]
    assert matches(tileset, TILESET_SCHEMA)
    named = {"tileset.json", *(tile["content"]["uri"] for tile in tiles(tileset["root"]) if "content" in tile)}
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert found == named and len(named) == 1 + 4 * 3 + 1
    assert report.bytes == sum((folder / name).stat().st_size for name in found)
    assert "refine" in tileset["root"] and tileset["geometricError"] >= tileset["root"]["geometricError"]


@pytest.mark.parametrize("content", CONTENT_KINDS)
def test_the_tileset_names_the_extensions_of_its_contents(content, exported):
    folder, _, tileset = exported[content]
    stated = tileset["extensions"]["3DTILES_content_gltf"]
    assert tileset["extensionsUsed"] == ["3DTILES_content_gltf"]
    for path in (folder / "tiles").iterdir():
        values, _ = read_chunks(path.read_bytes())
        assert set(values["extensionsUsed"]) == set(stated["extensionsUsed"])
        assert set(values.get("extensionsRequired", ())) == set(stated.get("extensionsRequired", ()))


def test_errors_fall_and_boxes_shrink_from_parents_to_children(exported):
    for tile in tiles(exported["gltf"][2]["root"]):
        low, high = corners(tile)
        for child in tile.get("children", []):
            assert child["geometricError"] <= tile["geometricError"]
            below = corners(child)
            assert (below[0] >= low - 1e-9).all() and (below[1] <= high + 1e-9).all()
    finest = [tile for tile in tiles(exported["gltf"][2]["root"]) if not tile.get("children")]
    assert len(finest) == 4 and all(tile["geometricError"] == 0 for tile in finest)


def test_boxes_hold_the_gaussians_of_their_contents(exported):
    folder, _, tileset = exported["gltf"]
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions *= 3 / np.linalg.norm(directions, axis=1, keepdims=True)
    for tile in tiles(tileset["root"]):
        if "content" in tile:
            splats = splats_in_tile(folder, tile)
            turned = np.einsum(
                "nij,ndj->ndi", rotation_matrices(splats.quats.astype(float)), directions * splats.scales[:, None]
            )
            points = (splats.positions[:, None] + turned).reshape(-1, 3)
            low, high = corners(tile)
            assert (points >= low - 1e-4).all() and (points <= high + 1e-4).all()


def test_each_chunk_is_replaced_level_by_level(exported):
    folder, _, tileset = exported["gltf"]
    coarsest = [tile for tile in tiles(tileset["root"]) if tile.get("content", {}).get("uri", "").endswith("-2.glb")]
    assert len(coarsest) == 4
    for tile in coarsest:
        assert tile["refine"] == "REPLACE"
        for level, count in ((2, 4), (1, 16), (0, 64)):
            assert tile["content"]["uri"].endswith(f"-{level}.glb")
            assert len(splats_in_tile(folder, tile)) == count
            assert tile.get("refine", "REPLACE") == "REPLACE"
            (tile,) = tile.get("children") or (None,)
        assert tile is None


def test_the_root_adds_its_children_to_the_background(exported):
    folder, report, tileset = exported["gltf"]
    root = tileset["root"]
    assert root["refine"] == "ADD" and len(splats_in_tile(folder, root)) == report.background > 0
    assert all("content" in tile or tile["refine"] == "ADD" for tile in tiles(root))


@pytest.mark.parametrize("content", CONTENT_KINDS)
def test_contents_stand_upright_at_their_place(content, exported, scene):
    folder, _, tileset = exported[content]
    opened = hyrfpack.SceneFolder(scene)
    up = Capture(hyrfpack.describe_file(scene.parent / "model.hyrf")).viewpoint.up
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    for number in range(4):
        values, binary = read_chunks((folder / "tiles" / f"{number:04d}-0.glb").read_bytes())
        if content == "spz":
            assert values["nodes"][0]["matrix"] == np.eye(4).ravel().tolist()
            extension = values["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"]
            view = values["bufferViews"][extension["KHR_gaussian_splatting_compression_spz_2"]["bufferView"]]
            stored = spz_positions(binary[: view["byteLength"]])
        else:
            x, y, z, w = values["nodes"][0]["rotation"]
            points = np.frombuffer(binary, "<f4", 3 * 64).reshape(-1, 3)
            stored = points @ rotation_matrices(np.array([[w, x, y, z]]))[0].T
        placed = stored @ Y_TO_Z_UP.T @ matrix[:3, :3].T + matrix[:3, 3]
        model = opened.load_chunk(number)
        world = model.config.frame.to_world(model.gaussians.positions.detach().numpy())
        np.testing.assert_allclose(placed[:, 2], world @ np.array(up) / np.linalg.norm(up), atol=1e-4)
        distances = [np.linalg.norm(rows[:, None] - rows, axis=2) for rows in (placed, world)]
        np.testing.assert_allclose(*distances, atol=1e-4)
        np.testing.assert_allclose(*(np.linalg.norm(rows, axis=1) for rows in (placed, world)), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(matrix), 1)


@pytest.mark.parametrize("content", CONTENT_KINDS)
def test_the_report_measures_the_finest_level_as_written(content, exported):
    report = exported[content][1]
    assert report.views > 0 and abs(report.psnr - report.psnr_baked) < {"gltf": 0.01, "spz": 1}[content]


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_scores")
def test_a_scene_of_parts_far_from_the_origin_keeps_its_precision(tmp_path):
    config = hyrfpack.ExportConfig(tiles_3d=True, tile_content="gltf", degree=0, background=False)
    report = hyrfpack.export_model(GOLDEN_PARTS_SCENE_FOLDER, tmp_path / "out", config, context=QUIET_CONTEXT)
    assert report.chunks == 3 and report.psnr == pytest.approx(report.psnr_baked, abs=0.01)
    root = json.loads((tmp_path / "out" / "tileset.json").read_text())["root"]
    assert (
        np.linalg.norm(root["transform"][12:15]) > 1e5
    )  # the transform holds the distance, and float32 numbers do not
    assert "content" not in root


def make_chunk(*errors: tuple[float, ...]) -> Chunk:
    return Chunk((0, 0, 0), (2, 4, 4), tuple(ChunkLevel("a.hyrf", 1, "00000000", 1, each) for each in errors))


RADII_PIXELS = (16.0, 64.0, 256.0)


def test_the_geometric_error_of_a_constant_error_is_proportional_to_its_root():
    errors = compute_geometric_errors(make_chunk((0, 0, 0), (0.01,) * 3, (0.04,) * 3), RADII_PIXELS)
    np.testing.assert_allclose(errors, [0, 4 * 3 * 0.1, 4 * 3 * 0.2])  # the radius is 3


@pytest.mark.parametrize("errors", [(0.09, 0.1, 0.2), (0.0, 0.004, 0.001), (0.0002, 0.0001, 0.0001), (0.0, 0.0, 0.001)])
def test_a_client_switches_where_the_predicted_error_is_that_of_the_wrong_disc(errors):
    chunk = make_chunk((0, 0, 0), errors)
    error = compute_geometric_errors(chunk, RADII_PIXELS)[1]
    frame = {"center": [0, 0, 0], "scale": 1, "half_sides": [1, 1, 1]}
    manifest = Manifest(1, (ScenePart("a.hyrf", 1, "00000000"),), (chunk,), RADII_PIXELS, frame, False, (0, 0, 0))
    focal = 40_000.0  # so long that the chunk is small in the picture even where it is close
    distance = error * focal / 16  # a screen-space error of 16 pixels
    center = np.array(chunk.center)
    camera = camera_at(center + (distance, 0, 0), target=center, width=20_000, height=20_000, focal=focal)
    added = predict_errors(manifest, camera)[0][1] * camera.width * camera.height
    np.testing.assert_allclose(added, math.pi * 4**2, rtol=1e-3)


def test_a_level_without_measured_error_replaces_the_finest_one_at_any_distance():
    assert compute_geometric_errors(make_chunk((0, 0, 0), (0, 0, 0)), RADII_PIXELS) == [0, 0]


def test_one_export_writes_one_kind_of_folder(scene, tmp_path):
    with pytest.raises(HyrfError, match="give only one of `streamed_sog=True` and `tiles_3d=True`"):
        hyrfpack.export_model(scene, tmp_path / "out", hyrfpack.ExportConfig(streamed_sog=True, tiles_3d=True))


def test_tiles_that_spz_cannot_hold_are_refused_before_the_bake(tmp_path, monkeypatch):
    monkeypatch.setattr(spz, "MAX_COORDINATE", 0.01)
    monkeypatch.setattr(pipeline, "bake_levels", None)
    config = hyrfpack.ExportConfig(tiles_3d=True, tile_content="spz")

    with pytest.raises(
        HyrfError, match="units from the origin of the tiles.*use `tile_content='gltf'`, or .*'hyrfpack edit'"
    ):
        hyrfpack.export_model(GOLDEN_PARTS_SCENE_FOLDER, tmp_path / "tiles", config, context=QUIET_CONTEXT)
