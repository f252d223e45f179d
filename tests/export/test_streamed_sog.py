"""A scene folder becomes Streamed SOG whose index fits its files, and whose files hold the chunks at their levels."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
from json_schema import matches

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.export import streamed_sog
from hyrfpack.export.boxes import Box
from hyrfpack.format.scene_folder import SceneFolder
from hyrfpack.format.scene_manifest import Chunk, ChunkLevel
from hyrfpack.lock import exclusive_folder
from hyrfpack.rotations import rotation_matrices
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.formats import sog
from hyrfpack.splats.splats import Splats
from tools.safety.make_golden import GOLDEN_PARTS_SCENE_FOLDER

QUIET_CONTEXT = RunContext(progress=None)
FILE_GAUSSIANS = 140  # two of the four chunks at the finest level, so that levels have several files
# Written from the specification, developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog.
COUNT_SCHEMA = {"type": "integer", "minimum": 0}
CORNER_SCHEMA = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
LEVEL_SCHEMA = {
    "type": "object",
    "properties": {"file": COUNT_SCHEMA, "offset": COUNT_SCHEMA, "count": COUNT_SCHEMA},
    "required": ["file", "offset", "count"],
}
INDEX_SCHEMA = {
    "type": "object",
    "properties": {
        "version": {"const": 1},
        "count": COUNT_SCHEMA,
        "counts": {"type": "array", "items": COUNT_SCHEMA},
        "lodLevels": {"type": "integer", "minimum": 1},
        "lodErrors": {"const": True},
        "environment": {"type": "string"},
        "filenames": {"type": "array", "items": {"type": "string", "pattern": r"^[^/\\]+/meta\.json$"}},
        "tree": {"$ref": "#/$defs/node"},
    },
    "required": ["version", "count", "counts", "lodLevels", "filenames", "tree"],
    "$defs": {
        "node": {
            "type": "object",
            "properties": {
                "bound": {
                    "type": "object",
                    "properties": {"min": CORNER_SCHEMA, "max": CORNER_SCHEMA},
                    "required": ["min", "max"],
                },
                "children": {"type": "array", "items": {"$ref": "#/$defs/node"}, "minItems": 2, "maxItems": 2},
                "lods": {"type": "object", "properties": {str(level): LEVEL_SCHEMA for level in range(8)}},
                "errors": {"type": "array", "items": {"type": "number", "minimum": 0}},
            },
            "required": ["bound"],
        }
    },
}


def export(scene, target, **options):
    config = hyrfpack.ExportConfig(streamed_sog=True, **{"degree": 1, **options})
    return hyrfpack.export_model(scene, target, config, context=QUIET_CONTEXT)


@pytest.fixture(scope="module")
def exported(scene, tmp_path_factory):
    """Return the folder of an export, its report, its index and the splats of its files by name."""
    folder = tmp_path_factory.mktemp("streamed") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed_sog, "MAX_FILE_GAUSSIANS", FILE_GAUSSIANS)
        report = export(scene, folder)
    index = json.loads((folder / "lod-meta.json").read_text())
    return folder, report, index, {name: read_splats((folder / name).parent) for name in index["filenames"]}


def nodes(node: dict) -> Iterator[dict]:
    yield node
    for child in node.get("children", []):
        yield from nodes(child)


def leaves(index: dict) -> list[dict]:
    return [node for node in nodes(index["tree"]) if "lods" in node]


def run_of(leaf: dict, level: int, exported) -> Splats:
    _, _, index, splats = exported
    run = leaf["lods"][str(level)]
    return splats[index["filenames"][run["file"]]][run["offset"] : run["offset"] + run["count"]]


def ellipsoid_points(splats: Splats) -> np.ndarray:
    """Return points on the ellipsoids of splats at three standard deviations, and their centres."""
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions = np.vstack((3 * directions / np.linalg.norm(directions, axis=1, keepdims=True), np.zeros(3)))
    local = directions[None] * splats.scales[:, None].astype(np.float64)
    turned = np.einsum("nij,ndj->ndi", rotation_matrices(splats.quats.astype(np.float64)), local)
    return (splats.positions[:, None] + turned).reshape(-1, 3)


def test_the_index_follows_the_specification(exported):
    _, _, index, _ = exported
    assert matches(index, INDEX_SCHEMA)
    assert all(("children" in node) != ("lods" in node) for node in nodes(index["tree"]))
    assert len(index["counts"]) == index["lodLevels"] == 3 and index["count"] == sum(index["counts"])


def test_the_folder_holds_exactly_the_files_that_the_index_and_its_sogs_name(exported):
    folder, report, index, _ = exported
    named = {"lod-meta.json"}
    for name in (*index["filenames"], index["environment"]):
        pictures = sog.picture_names((folder / name).read_bytes(), name)
        named |= {name, *(f"{name.partition('/')[0]}/{picture}" for picture in pictures)}
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert found == named
    assert report.bytes == sum((folder / name).stat().st_size for name in found)


def test_runs_cover_each_file_without_overlap_and_add_up_to_the_counts(exported):
    _, report, index, splats = exported
    level_of_file: dict[int, set[str]] = {}
    runs: dict[int, list[tuple[int, int]]] = {}
    counts = [0] * index["lodLevels"]
    for leaf in leaves(index):
        for level, run in leaf["lods"].items():
            level_of_file.setdefault(run["file"], set()).add(level)
            runs.setdefault(run["file"], []).append((run["offset"], run["count"]))
            counts[int(level)] += run["count"]
    for file, name in enumerate(index["filenames"]):
        end = 0
        for offset, count in sorted(runs[file]):
            assert offset == end and count > 0
            end += count
        assert end == len(splats[name]) <= FILE_GAUSSIANS
        assert len(level_of_file[file]) == 1
    assert counts == index["counts"] == report.level_gaussians == [256, 64, 16]
    assert len(index["filenames"]) == 2 + 1 + 1


def test_each_leaf_holds_one_chunk_at_all_its_levels(exported, scene):
    assert sorted(chunks_of_leaves(hyrfpack.SceneFolder(scene), exported)) == [0, 1, 2, 3]


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_scores")
def test_a_scene_of_several_parts_keeps_its_chunks(tmp_path):
    report = export(GOLDEN_PARTS_SCENE_FOLDER, tmp_path / "out", degree=0, background=False)
    index = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    splats = {name: read_splats((tmp_path / "out" / name).parent) for name in index["filenames"]}
    scene = hyrfpack.SceneFolder(GOLDEN_PARTS_SCENE_FOLDER)
    found = chunks_of_leaves(scene, (tmp_path / "out", report, index, splats))
    assert sorted(found) == list(range(len(scene.manifest.chunks)))


def chunks_of_leaves(folder: SceneFolder, exported) -> list[int]:
    """Return the number of the chunk that each leaf holds at all its levels."""
    numbers = []
    for leaf in leaves(exported[2]):
        found = []
        for level in map(int, leaf["lods"]):
            positions = run_of(leaf, level, exported).positions
            for number in range(len(folder.manifest.chunks)):
                model = folder.load_chunk(number, level)
                wanted = model.config.frame.to_world(model.gaussians.positions.detach().numpy())
                distances = np.linalg.norm(positions[:, None] - wanted, axis=2)
                # The parts lie 1e6 units from the origin, and some of their Gaussians far from all others.
                if np.quantile(distances.min(axis=1), 0.9) < 3e-3:
                    assert len(set(distances.argmin(axis=1))) == len(positions)
                    found.append(number)
        assert len(found) == len(leaf["lods"]) and len(set(found)) == 1
        numbers.append(found[0])
    return numbers


def test_boxes_hold_the_gaussians_of_all_levels_and_the_boxes_below_them(exported):
    index = exported[2]
    for leaf in leaves(index):
        points = np.concatenate([ellipsoid_points(run_of(leaf, level, exported)) for level in range(3)])
        low, high = (np.array(leaf["bound"][end]) for end in ("min", "max"))
        assert (points >= low - 1e-5).all() and (points <= high + 1e-5).all()
        assert (points.min(axis=0) < low + 0.2).all() and (
            points.max(axis=0) > high - 0.2
        ).all()  # no larger than needed
    for node in nodes(index["tree"]):
        if "children" in node:
            for end, choose in (("min", min), ("max", max)):
                below = zip(*(child["bound"][end] for child in node["children"]), strict=True)
                assert node["bound"][end] == [choose(values) for values in below]


def test_errors_rise_from_zero_with_the_level(exported):
    for leaf in leaves(exported[2]):
        assert leaf["errors"][0] == 0 < leaf["errors"][1] <= leaf["errors"][2]


def test_the_error_of_a_level_is_the_mean_of_its_measured_errors_and_never_falls():
    levels = [(0.0, 0.0), (0.02, 0.04), (0.01, 0.01)]
    chunk = Chunk((0, 0, 0), (1, 1, 1), tuple(ChunkLevel("a.hyrf", 1, "00000000", 1, errors) for errors in levels))
    np.testing.assert_allclose(streamed_sog.compute_level_errors(chunk, 4), [0, 0.03, 0.03, 0.03])


def test_the_background_is_the_environment(exported):
    folder, report, index, splats = exported
    background = read_splats((folder / index["environment"]).parent)
    assert len(background) == report.background > 0
    assert report.gaussians == report.background + 256
    reach = np.linalg.norm(background.positions - np.array((5.0, -2.0, 1.0)), axis=1).min()
    assert reach > max(np.abs(cloud.positions - np.array((5.0, -2.0, 1.0))).max() for cloud in splats.values())


def test_the_report_measures_the_finest_level(exported):
    report = exported[1]
    assert report.views > 0 and abs(report.psnr - report.psnr_baked) < 1 and report.chunks == 4


def test_a_chunk_may_have_fewer_levels_than_others(scene, tmp_path):
    copy = tmp_path / "scene"
    copy.mkdir()
    for path in scene.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    manifest = json.loads((copy / "scene.json").read_text())
    manifest["chunks"][0]["levels"] = manifest["chunks"][0]["levels"][:1]
    (copy / "scene.json").write_text(json.dumps(manifest))
    report = export(copy, tmp_path / "out", degree=0, background=False)
    index = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert sorted(len(leaf["lods"]) for leaf in leaves(index)) == [1, 3, 3, 3]
    assert report.level_gaussians == [256, 48, 12] and "environment" not in index


@pytest.mark.parametrize("offset", [0.0, 4_567_890.0])
def test_bounds_have_7_digits_of_their_size_wherever_they_lie(offset):
    low, high = np.array([0.1, 0.2, 0.3]) + offset, np.array([1.123456789, 0.7, 0.9]) + offset
    bound = streamed_sog._describe_bound(Box(low, high))
    np.testing.assert_allclose(bound["min"], low, rtol=0, atol=1e-6)
    np.testing.assert_allclose(bound["max"], high, rtol=0, atol=1e-6)


def test_a_model_without_levels_is_refused_with_the_command_that_makes_them(scene, tmp_path):
    with pytest.raises(HyrfError, match=r"model\.hyrf: this model has no levels .* 'hyrfpack split [^\n]*'[^\n]*$"):
        export(scene.parent / "model.hyrf", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [{"crop": (0, 0, 0, 1, 1, 1)}, {"min_opacity": 0.1}, {"colmap": True}], ids=str)
def test_settings_that_contradict_the_format_are_refused(options, scene, tmp_path):
    with pytest.raises(HyrfError):
        export(scene, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_without_overwrite_an_existing_export_stays(scene, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "lod-meta.json").write_text("mine")
    monkeypatch.setattr(hyrfpack.export.pipeline, "bake_levels", None)  # refused before any work
    config = hyrfpack.ExportConfig(streamed_sog=True)
    with pytest.raises(HyrfError, match="lod-meta.json of the files to be written is there"):
        hyrfpack.export_model(scene, tmp_path / "out", config, overwrite=False, context=QUIET_CONTEXT)
    assert (tmp_path / "out" / "lod-meta.json").read_text() == "mine"


def test_a_folder_that_another_call_writes_is_refused(scene, tmp_path):
    with exclusive_folder(tmp_path / "out"), pytest.raises(HyrfError, match="another hyrfpack command is at work"):
        export(scene, tmp_path / "out")


def test_a_failed_export_leaves_the_old_index_and_no_new_file(scene, tmp_path, monkeypatch):
    encode, calls = sog.encode_files, []

    def fail_at_the_second_file(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise HyrfError("broken", fix="mend it")
        return encode(*arguments)

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "lod-meta.json").write_text("of an older export")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    monkeypatch.setattr(sog, "encode_files", fail_at_the_second_file)
    with pytest.raises(HyrfError, match="broken"):
        export(scene, tmp_path / "out", degree=0)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["lod-meta.json", "notes.txt"]
    assert (tmp_path / "out" / "lod-meta.json").read_text() == "of an older export"
