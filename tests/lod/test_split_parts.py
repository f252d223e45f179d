"""A merged file that is split into a scene folder stays the merged file: chunks of each part use the fields of it."""

from __future__ import annotations

import json
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from exposures import map_with_gains
from json_schema import matches

from hyrfpack.cameras.capture import Capture
from hyrfpack.config.edit import Rotate, Translate
from hyrfpack.config.split import SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.edit import merge_models
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import describe_file, load_merged_model, load_model, save_model, scene_manifest
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import load_parts, load_with_provenance
from hyrfpack.format.scene_folder import SceneFolder, as_single_file
from hyrfpack.lod import LevelRenderer, split, split_model
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import render_view
from tools.safety import minimal_reader
from tools.safety.make_golden import GOLDEN_FOLDER, GOLDEN_MERGED_FILE, GOLDEN_PARTS_SCENE_FOLDER, GOLDEN_SCENE_FOLDER

COMPACT_FILE, RAW_FILE = (GOLDEN_FOLDER / "trained" / name for name in ("demo_compact.hyrf", "demo.hyrf"))
QUIET_CONTEXT = RunContext(progress=None)
MANIFEST_SCHEMA = json.loads(Path(scene_manifest.__file__).with_name("scene.schema.json").read_text())


@pytest.fixture(scope="module")
def cameras():
    return Capture(describe_file(RAW_FILE)).cameras[:3]


@pytest.fixture(scope="module")
def merged_file(tmp_path_factory, cameras) -> Path:
    """Return a merged file of two raw parts, which overlap, have frames of their own and different exposures."""
    folder = tmp_path_factory.mktemp("merged")
    for name, gain in (("first", 0.8), ("second", 1.6)):
        model, provenance = load_with_provenance(RAW_FILE)
        model.exposure = map_with_gains(cameras, model.config.frame, np.linspace(gain, gain + 0.3, 3)[:, None])
        save_model(model, folder / f"{name}.hyrf", provenance=provenance)
    moves = {"second": [Translate((0.3, 0.1, 0.0)), Rotate((0.0, 0.0, 1.0), 40.0)]}
    merge_models([folder / "first.hyrf", folder / "second.hyrf"], folder / "both.hyrf", moves)
    return folder / "both.hyrf"


@pytest.fixture(scope="module")
def folder(merged_file, tmp_path_factory) -> Path:
    """Return a scene folder of two parts, each of two chunks at two levels."""
    path = tmp_path_factory.mktemp("split") / "both-scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
        split_model(merged_file, path, SplitConfig(chunk_gaussians=800, levels=2, refit_steps=1), context=QUIET_CONTEXT)
    return path


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def read_manifest(path: Path) -> dict:
    return json.loads((path / "scene.json").read_text())


def write_manifest(path: Path, values: dict) -> None:
    (path / "scene.json").write_text(json.dumps(values))


def draw(model, camera) -> torch.Tensor:
    with torch.no_grad():
        return render_view(model, camera).rgb


def sorted_rows(model) -> np.ndarray:
    rows = np.concatenate(list(to_arrays(model).values())[:4], axis=1)
    return rows[np.lexsort(rows.T)]


def test_the_manifest_has_a_shared_file_for_each_part_and_matches_the_schema(folder):
    values = read_manifest(folder)

    assert values["version"] == "2.0" and "shared" not in values
    assert [part["name"] for part in values["parts"]] == ["first", "second"]
    assert [chunk["part"] for chunk in values["chunks"]] == [0, 0, 1, 1]
    listed = [*values["parts"], *(level for chunk in values["chunks"] for level in chunk["levels"])]
    assert {item["file"] for item in listed} == {path.name for path in folder.glob("*.hyrf")}
    assert matches(values, MANIFEST_SCHEMA)


@pytest.mark.acceptance
def test_the_finest_levels_are_drawn_as_the_merged_file(folder, merged_file, cameras):
    merged, scene = load_merged_model(merged_file), SceneFolder(folder).load()

    assert isinstance(scene, MergedModel) and scene.names == merged.names
    for one, other in zip(merged.parts, scene.parts, strict=True):
        np.testing.assert_array_equal(sorted_rows(one), sorted_rows(other))
    for camera in cameras:
        torch.testing.assert_close(draw(scene, camera), draw(merged, camera), atol=1e-5, rtol=0)


def test_each_chunk_has_the_exposure_map_of_its_part(folder):
    scene = SceneFolder(folder)

    maps = [scene.load_chunk(number).exposure for number in (0, 1, 2, 3)]

    assert maps[0] is maps[1] and maps[2] is maps[3] and maps[0] is not maps[2]


def test_the_box_of_a_chunk_holds_its_gaussians_in_the_world(folder):
    scene = SceneFolder(folder)
    for number, chunk in enumerate(scene.manifest.chunks):
        model = scene.load_chunk(number)
        means = model.config.frame.to_world(model.gaussians.positions.numpy())
        assert (means >= np.array(chunk.low)).all() and (means <= np.array(chunk.high)).all()


def test_coarse_levels_have_measured_errors_and_fit_a_budget(folder, cameras):
    scene = SceneFolder(folder)
    renderer = LevelRenderer(scene, gaussians=1600)

    model, choice = renderer.load(cameras[0])

    for chunk in scene.manifest.chunks:
        fine, coarse = chunk.levels
        assert coarse.gaussians == fine.gaussians // 4
        assert set(fine.errors) == {0.0} and 0 < max(coarse.errors) < 1
    assert isinstance(model, MergedModel) and len(model) == choice.gaussians <= 1600 < len(scene.load())
    assert choice.bytes == sum(part.bytes for part in scene.manifest.parts) + sum(
        chunk.levels[level].bytes for chunk, level in zip(scene.manifest.chunks, choice.levels, strict=True)
    )


def test_commands_read_the_folder_like_the_merged_file(folder, merged_file, tmp_path):
    info = json.loads(succeeded("info", folder, "--json").stdout)
    text = succeeded("info", folder).stdout
    succeeded("render", folder, "-o", tmp_path / "views", "--orbit", 1, "--gaussians", 1600)
    succeeded("decompress", folder, "-o", tmp_path / "joined.hyrf")
    succeeded("export", folder, "-o", tmp_path / "player")

    assert info["gaussians"] == 3000 and [part["gaussians"] for part in info["parts"]] == [1500, 1500]
    assert [part["provenance"] for part in info["parts"]] == [part[2] for part in load_parts(merged_file)]
    assert sum(part["bytes"] for part in info["parts"]) == info["bytes"]
    assert "3,000 Gaussians in 4 chunks" in text and "second" in text
    with as_single_file(folder) as file:
        for joined in (tmp_path / "joined.hyrf", tmp_path / "player" / "scene.hyrf", file):
            assert load_merged_model(joined).names == ("first", "second")
    provenances = [[part[2] for part in load_parts(path)] for path in (tmp_path / "joined.hyrf", merged_file)]
    assert provenances[0] == provenances[1]


def test_one_model_of_several_is_refused_as_for_merged_files(folder, tmp_path):
    with pytest.raises(HyrfFormatError, match="holds 2 merged models, and one model is needed; join its chunks"):
        load_model(folder)
    assert "a scene of several files already" in refused("split", folder, "-o", tmp_path / "scene")


def damage_file(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])


@pytest.mark.parametrize(
    ("damage", "problem"),
    [(Path.unlink, "this file of the scene is missing"), (damage_file, "its bytes are not those that the manifest")],
)
def test_a_missing_or_damaged_shared_file_of_a_part_is_one_clear_sentence(copy, damage, problem):
    damage(copy / "shared-01.hyrf")

    with pytest.raises(HyrfFormatError, match=f"shared-01.hyrf: {problem}"):
        load_merged_model(copy)


def test_a_chunk_that_is_listed_with_another_part_is_refused(copy):
    values = read_manifest(copy)
    values["chunks"][2]["part"] = 0
    write_manifest(copy, values)

    with pytest.raises(HyrfFormatError, match="its configuration is not that|refers to shared-01.hyrf"):
        load_merged_model(copy)


def test_a_chunk_that_refers_to_the_shared_file_of_another_part_is_refused(copy):
    """Both shared files have the same sections, so that only the name tells them apart."""
    values, data = read_manifest(copy), (copy / "shared-00.hyrf").read_bytes()
    values["parts"][1] |= {"bytes": len(data), "crc32": f"{zlib.crc32(data):08x}"}
    (copy / "shared-01.hyrf").write_bytes(data)
    values["chunks"][0]["part"] = 1
    write_manifest(copy, values)

    with pytest.raises(
        HyrfFormatError, match="chunk-0000-0.hyrf: it refers to shared-00.hyrf, and the manifest says shared-01.hyrf"
    ):
        load_merged_model(copy)


def test_a_shared_file_with_gaussians_is_refused(copy):
    values, data = read_manifest(copy), RAW_FILE.read_bytes()
    values["parts"][1] |= {"bytes": len(data), "crc32": f"{zlib.crc32(data):08x}"}
    (copy / "shared-01.hyrf").write_bytes(data)
    write_manifest(copy, values)

    with pytest.raises(HyrfFormatError, match=r"shared-01.hyrf: it holds Gaussians"):
        load_merged_model(copy)


def test_a_merged_file_of_one_part_makes_a_folder_of_one_model(tmp_path):
    merge_models([COMPACT_FILE], tmp_path / "one.hyrf")

    split_model(tmp_path / "one.hyrf", tmp_path / "scene", SplitConfig(levels=1), context=QUIET_CONTEXT)

    values = read_manifest(tmp_path / "scene")
    assert values["version"] == "1.0" and values["shared"]["file"] == "shared.hyrf"
    assert len(load_model(tmp_path / "scene")) == len(load_model(COMPACT_FILE))


def test_the_golden_scene_of_several_parts_is_read_as_the_file_that_it_was_made_of():
    merged, scene = load_merged_model(GOLDEN_MERGED_FILE), load_merged_model(GOLDEN_PARTS_SCENE_FOLDER)
    others = {file.name: file.read_bytes() for file in GOLDEN_PARTS_SCENE_FOLDER.glob("*.hyrf")}

    assert scene.names == merged.names
    for number, (one, other) in enumerate(zip(merged.parts, scene.parts, strict=True)):
        for name, values in one.state_dict().items():
            if not name.startswith("gaussians"):
                assert torch.equal(other.state_dict()[name], values), name
        assert len(one) == len(other) and (one.exposure is None) == (other.exposure is None)
        _, groups, _ = minimal_reader.read(others[f"chunk-{number:04d}-0.hyrf"], folder=others)
        for group, values in to_arrays(other).items():
            np.testing.assert_array_equal(values, groups[group], err_msg=group)


@pytest.mark.parametrize("in_scene", [True, False], ids=["in its scene", "beside its shared file"])
def test_a_chunk_is_not_split_into_its_own_folder(tmp_path, in_scene):
    """The files of the scene, among them the chunk, would be replaced."""
    folder = Path(shutil.copytree(GOLDEN_PARTS_SCENE_FOLDER, tmp_path / "scene"))
    if not in_scene:
        folder = tmp_path / "alone"
        folder.mkdir()
        shutil.copy(GOLDEN_SCENE_FOLDER / "chunk-0000-0.hyrf", folder)
        shutil.copy(GOLDEN_SCENE_FOLDER / "shared.hyrf", folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}

    with pytest.raises(HyrfError, match="the output is an input itself"):
        split_model(sorted(folder.glob("chunk*"))[-1], folder, SplitConfig(levels=1, refit_steps=0))
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
