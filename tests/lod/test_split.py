"""A model that is split into a scene folder stays the model, and damaged or forged folders are refused."""

from __future__ import annotations

import errno
import json
import math
import shutil
import zipfile
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import hyrfpack, refused, succeeded
from json_schema import matches
from scenes import ball_scene, ring, shift_cameras, small_model

from hyrfpack.cameras.capture import Capture, provenance_cameras
from hyrfpack.cameras.files import camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.split import SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import describe_file, load_merged_model, load_model, save_model, scene_manifest
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import MINOR_VERSION, Container, Section, read_container, write_container
from hyrfpack.format.parts import encode_parts
from hyrfpack.format.scene_folder import SceneFolder, as_single_file, is_scene
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.format.shared import CODEC_SHARED
from hyrfpack.lod import LevelRenderer, split, split_model
from hyrfpack.lod.errors import ERROR_RADII
from hyrfpack.model import Frame, HybridModel
from hyrfpack.render import render_view
from tools.safety import minimal_reader
from tools.safety.make_golden import GOLDEN_FOLDER, GOLDEN_SCENE_FOLDER, GOLDEN_SCENE_SOURCE

COMPACT_FILE, RAW_FILE = (GOLDEN_FOLDER / "trained" / name for name in ("demo_compact.hyrf", "demo.hyrf"))
QUIET_CONTEXT = RunContext(progress=None)
FIRST_CAMERA = ring(1)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a scene folder of four chunks at two levels."""
    path = tmp_path_factory.mktemp("split") / "demo-scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 2)
        split_model(
            COMPACT_FILE, path, SplitConfig(chunk_gaussians=400, levels=2, refit_steps=3), context=QUIET_CONTEXT
        )
    return path


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


@pytest.fixture(scope="module")
def cameras():
    return Capture(describe_file(COMPACT_FILE)).cameras[:3]


def read_with_minimal_reader(path: Path):
    others = {file.name: file.read_bytes() for file in path.parent.glob("*.hyrf")}
    return minimal_reader.read(path.read_bytes(), folder=others)


def psnr_between(first, second, camera) -> float:
    with torch.no_grad():
        error = (render_view(first, camera).rgb - render_view(second, camera).rgb).square().mean()
    return -10 * math.log10(float(error) + 1e-12)


def edit_manifest(path: Path, change) -> None:
    values = json.loads((path / "scene.json").read_text())
    change(values)
    (path / "scene.json").write_text(json.dumps(values))


def test_the_manifest_lists_every_file_as_it_is(folder):
    values = json.loads((folder / "scene.json").read_text())
    listed = [values["shared"], *(level for chunk in values["chunks"] for level in chunk["levels"])]

    assert {item["file"] for item in listed} == {path.name for path in folder.glob("*.hyrf")}
    for item in listed:
        data = (folder / item["file"]).read_bytes()
        assert (item["bytes"], item["crc32"]) == (len(data), f"{zlib.crc32(data):08x}")
        metadata = minimal_reader.read_metadata(minimal_reader.read_container(data)["META"])
        assert item.get("gaussians", 0) == metadata["gaussians"]
    assert matches(values, json.loads(Path(scene_manifest.__file__).with_name("scene.schema.json").read_text()))


def test_the_finest_levels_are_the_model(folder, cameras):
    model, scene = load_model(COMPACT_FILE), load_model(folder)

    def sort(positions):
        return positions[np.lexsort(positions.T)]

    np.testing.assert_array_equal(*(sort(each.gaussians.positions.numpy()) for each in (model, scene)))
    for name, values in model.state_dict().items():
        if not name.startswith("gaussians"):
            assert torch.equal(scene.state_dict()[name], values), name
    assert min(psnr_between(model, scene, camera) for camera in cameras) > 45


def test_the_finest_levels_of_a_raw_file_have_its_very_numbers(tmp_path):
    split_model(RAW_FILE, tmp_path / "scene", SplitConfig(chunk_gaussians=500, levels=1), context=QUIET_CONTEXT)

    rows = [
        np.concatenate(list(to_arrays(load_model(path)).values())[:4], axis=1)
        for path in (RAW_FILE, tmp_path / "scene")
    ]
    assert Counter(row.tobytes() for row in rows[0]) == Counter(row.tobytes() for row in rows[1])


@pytest.mark.acceptance
@pytest.mark.parametrize("profile", ["compact", "raw"])
def test_chunks_keep_residuals_exactly_and_merged_gaussians_have_their_own(tmp_path, monkeypatch, profile):
    source = GOLDEN_FOLDER / "v1.6_compact_residuals.hyrf"
    if profile == "raw":
        source = tmp_path / "raw.hyrf"
        save_model(load_model(GOLDEN_FOLDER / "v1.6_compact_residuals.hyrf"), source)
    monkeypatch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
    split_model(source, tmp_path / "scene", SplitConfig(levels=2, refit_steps=0), context=QUIET_CONTEXT)

    exact = ("positions", "shape_residuals", "color_residuals")
    rows = [
        np.concatenate([getattr(load_model(path).gaussians, name).numpy() for name in exact], axis=1)
        for path in (source, tmp_path / "scene")
    ]
    assert Counter(row.tobytes() for row in rows[0]) == Counter(row.tobytes() for row in rows[1])
    _, merged, _ = read_with_minimal_reader(tmp_path / "scene" / "chunk-0000-1.hyrf")
    assert merged["SHAP"].any() and merged["HARM"].any()


def test_a_chunk_opens_by_itself_as_the_format_page_says(folder):
    path = folder / "chunk-0001-0.hyrf"
    metadata, groups, _ = read_with_minimal_reader(path)

    facts = describe_file(path)

    for group, values in to_arrays(load_model(path)).items():
        np.testing.assert_array_equal(values, groups[group], err_msg=group)
    assert facts["version"] == "1.5"
    assert facts["provenance"] == metadata["provenance"] == describe_file(COMPACT_FILE)["provenance"]


def test_chunks_do_not_repeat_the_fields(folder):
    with Container.open(folder / "chunk-0000-0.hyrf", SECTION_CONTENTS) as chunk:
        shared = [entry for entry in chunk.entries.values() if entry.codec == CODEC_SHARED]

    assert {entry.type for entry in shared} >= {"GTAB", "RTAB", "GMLP", "RMLP"}
    assert sum(entry.length for entry in shared) < 100


def test_the_box_of_a_chunk_holds_its_gaussians(folder):
    scene = SceneFolder(folder)
    for number, chunk in enumerate(scene.manifest.chunks):
        model = scene.load_chunk(number)
        means = model.config.frame.to_world(model.gaussians.positions.numpy())
        assert (means >= np.array(chunk.low)).all() and (means <= np.array(chunk.high)).all()


def split_around(folder: Path, positions: np.ndarray, frame: Frame, levels: int) -> SceneFolder:
    """Split a model of Gaussians at local positions, whose cameras surround them."""
    model, cameras = small_model(positions, frame=frame, fields=2.0), ring(4, radius=3 * frame.scale, width=32)
    cameras = shift_cameras(cameras, frame.center)
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(model, folder / "model.hyrf", provenance=kept)
    config = SplitConfig(chunk_gaussians=64, levels=levels, refit_steps=1)
    split_model(folder / "model.hyrf", folder / "scene", config, context=QUIET_CONTEXT)
    return SceneFolder(folder / "scene")


def test_boxes_of_a_small_object_in_map_coordinates_keep_its_size(tmp_path):
    frame = Frame((4_027_893.7, 1_307_045.2, 4_919_474.9), 0.2, (1.0, 1.0, 1.0))
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (256, 3))

    scene = split_around(tmp_path, positions, frame, levels=1)

    for number, chunk in enumerate(scene.manifest.chunks):
        model = scene.load_chunk(number)
        means = frame.to_world(model.gaussians.positions.numpy())
        reach = 3 * frame.scale * model.decode_geometry().scales.amax(dim=1).double().numpy()[:, None]
        low, high = (means - reach).min(axis=0), (means + reach).max(axis=0)
        excess = np.concatenate((low - chunk.low, chunk.high - high))
        assert (excess >= 0).all() and (excess < 1e-4 * np.linalg.norm(high - low)).all()
        assert all(len(repr(value)) <= len("-4027893.712345") for value in (*chunk.low, *chunk.high))


def test_a_model_of_one_gaussian_can_be_split(tmp_path, monkeypatch):
    monkeypatch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
    monkeypatch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)

    scene = split_around(tmp_path, np.zeros((1, 3)), Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0)), levels=2)

    assert [level.gaussians for level in scene.manifest.chunks[0].levels] == [1, 1]
    assert len(scene.load()) == 1


def test_a_coarse_level_has_a_quarter_of_the_gaussians_and_a_measured_error(folder):
    for chunk in SceneFolder(folder).manifest.chunks:
        fine, coarse = chunk.levels
        assert coarse.gaussians == fine.gaussians // 4
        assert coarse.bytes < fine.bytes
        assert set(fine.errors) == {0.0} and 0 < max(coarse.errors) < 1


def test_a_view_with_a_budget_draws_no_more_gaussians(folder, cameras):
    renderer = LevelRenderer(SceneFolder(folder), gaussians=800)

    model, choice = renderer.load(cameras[0])

    assert len(model) == choice.gaussians <= 800
    assert set(choice.levels) == {0, 1}


def test_views_with_the_same_levels_share_one_decoded_model(folder, cameras, monkeypatch):
    scene, joined = SceneFolder(folder), []
    join = SceneFolder.join
    monkeypatch.setattr(SceneFolder, "join", lambda self, chunks: joined.append(len(chunks)) or join(self, chunks))
    decode, decoded = HybridModel.decode, []
    monkeypatch.setattr(HybridModel, "decode", lambda self: decoded.append(len(self)) or decode(self))
    renderer = LevelRenderer(scene)

    pictures = [renderer.draw(camera).rgb for camera in (cameras[0], cameras[1], cameras[0])]

    assert len(joined) == len(decoded) == 1 and len(renderer.choices) == 3
    assert torch.equal(pictures[0], pictures[2]) and not torch.equal(pictures[0], pictures[1])
    renderer.gaussians = 800
    assert torch.equal(renderer.draw(cameras[0]).rgb, LevelRenderer(scene, gaussians=800).draw(cameras[0]).rgb)


@pytest.mark.parametrize("load", [SceneFolder.load, lambda scene: LevelRenderer(scene).load(FIRST_CAMERA)[0]])
def test_a_loaded_model_can_be_moved_without_an_effect_on_others(folder, load):
    scene = SceneFolder(folder)
    first, second = load(scene), load(scene)
    before = {name: values.clone() for name, values in second.state_dict().items()}

    first.to(torch.float64)
    with torch.no_grad():
        for values in first.parameters():
            values.zero_()

    for model in (second, load(scene)):
        for name, values in model.state_dict().items():
            assert values.dtype == before[name].dtype and torch.equal(values, before[name]), name


def test_a_budget_below_the_coarsest_levels_leaves_chunks_out(folder, cameras):
    scene = SceneFolder(folder)
    counts = [chunk.levels[-1].gaussians for chunk in scene.manifest.chunks]
    renderer = LevelRenderer(scene, gaussians=sum(counts) // 2)

    model, choice = renderer.load(cameras[0])

    assert 0 < len(model) == choice.gaussians <= sum(counts) // 2
    assert None in choice.levels
    nothing = render_view(scene.load([None] * len(counts)), cameras[0])
    assert np.isfinite(nothing.rgb.numpy()).all() and not nothing.alpha.any()


@pytest.mark.parametrize("limit", ["gaussians", "bytes"])
def test_a_budget_that_shows_nothing_is_refused(folder, limit):
    scene = SceneFolder(folder)
    least = min(getattr(chunk.levels[-1], limit) for chunk in scene.manifest.chunks)
    least += scene.manifest.shared_bytes if limit == "bytes" else 0

    LevelRenderer(scene, **{limit: least})
    with pytest.raises(HyrfError, match=f"no chunk can be drawn within {least - 1:,} .*allow at least {least:,}"):
        LevelRenderer(scene, **{limit: least - 1})


def test_levels_are_fitted_and_measured_at_the_cameras_of_the_photos(tmp_path, monkeypatch):
    scene, used, source = ball_scene(6), [], tmp_path / "model.hyrf"
    save_model(load_model(COMPACT_FILE), source)  # without the cameras of its own photos

    def record(levels, spheres, cameras, *rest):
        used.extend(cameras)
        return np.zeros((len(levels), len(spheres), len(ERROR_RADII)))

    monkeypatch.setattr(split, "measure_level_errors", record)
    monkeypatch.setattr(split, "MEASURED_VIEWS_PER_PART", 3)
    config = SplitConfig(chunk_gaussians=400, levels=2, refit_steps=1)
    split_model(source, tmp_path / "scene", config, data=scene, context=QUIET_CONTEXT)

    photographed = [view.camera for view in scene.train]
    stored = SceneFolder(tmp_path / "scene").manifest.cameras
    assert [list(row) for row in stored] == [camera_to_numbers(camera) for camera in photographed]
    assert len(used) == 3 and {camera.fx for camera in used} == {photographed[0].fx}
    assert photographed[0].fx not in {camera.fx for camera in Capture(describe_file(source)).cameras}
    with pytest.raises(TypeError, match="data"):
        split_model(source, tmp_path / "scene", config, data=photographed, context=QUIET_CONTEXT)


@pytest.mark.parametrize(
    ("name", "title", "licence", "expected"),
    [
        ("12\u00a0m", None, "CC\u00a0BY", "12\u00a0m"),
        ("two\u2028lines", None, "", "twolines"),
        ("model", "\U0001f469\u200d\U0001f52c", "", "\U0001f469\u200d\U0001f52c"),
    ],
)
def test_the_manifest_of_any_title_is_read_again(tmp_path, name, title, licence, expected):
    source = tmp_path / f"{name}.hyrf"
    shutil.copy(RAW_FILE, source)
    config = SplitConfig(levels=1, title=title, licence=licence)

    split_model(source, tmp_path / "scene", config, context=QUIET_CONTEXT)

    manifest = SceneFolder(tmp_path / "scene").manifest
    assert (manifest.title, manifest.licence) == (expected, licence)


@pytest.mark.parametrize("text", ["two\nlines", "x" * 1001, "\ud83d"])
def test_texts_that_a_manifest_cannot_hold_are_refused_before_the_work(text, tmp_path):
    for key in ("title", "licence"):
        with pytest.raises(ValueError, match=f"{key} is .*at most 1,000 characters without control characters"):
            SplitConfig(**{key: text})
    assert "without control characters" in refused("split", RAW_FILE, "-o", tmp_path / "scene", "--title", "a\nb")


def test_a_manifest_that_readers_would_refuse_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_manifest, "MAX_CHUNKS", 2)
    monkeypatch.setattr("hyrfpack.lod.split.MAX_CHUNKS", 2)
    with pytest.raises(HyrfError, match=r"'chunks' has 4 entries.*`chunk_gaussians`"):
        split_model(RAW_FILE, tmp_path / "scene", SplitConfig(chunk_gaussians=400, levels=1), context=QUIET_CONTEXT)
    assert not (tmp_path / "scene").exists()


def test_a_zip_of_the_folder_is_read_like_the_folder(folder, tmp_path):
    archive = shutil.make_archive(str(tmp_path / "scene"), "zip", folder.parent, folder.name)

    assert is_scene(archive) and describe_file(archive) == describe_file(folder)
    assert all(torch.equal(a, b) for a, b in zip(*(load_model(p).parameters() for p in (archive, folder)), strict=True))


def test_a_zip_that_declares_another_size_is_refused(folder, tmp_path):
    with zipfile.ZipFile(tmp_path / "scene.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in folder.iterdir():
            archive.writestr(path.name, path.read_bytes() if path.name != "shared.hyrf" else bytes(10**6))

    with pytest.raises(HyrfFormatError, match=r"shared.hyrf: the manifest says [\d,]+ bytes and there are"):
        load_model(tmp_path / "scene.zip")


@pytest.mark.parametrize(
    ("name", "damage", "problem"),
    [
        ("chunk-0002-0.hyrf", None, "this file of the scene is missing"),
        ("shared.hyrf", None, "this file of the scene is missing"),
        ("chunk-0002-0.hyrf", lambda data: data[:-8], "the manifest says"),
        ("chunk-0002-0.hyrf", lambda data: data + bytes(8), "the manifest says"),
        (
            "chunk-0002-0.hyrf",
            lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
            "its bytes are not those that the manifest",
        ),
    ],
)
def test_a_missing_or_damaged_file_is_one_clear_sentence(copy, name, damage, problem):
    path = copy / name
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))

    with pytest.raises(HyrfFormatError, match=f"{name}: {problem}"):
        load_model(copy)


def test_a_manifest_that_lies_about_gaussians_is_refused(copy):
    def lie(values):
        values["gaussians"] += 1
        values["chunks"][0]["levels"][0]["gaussians"] += 1

    edit_manifest(copy, lie)

    with pytest.raises(HyrfFormatError, match=r"says [\d,]+ Gaussians and there are"):
        load_model(copy)


def test_a_chunk_of_another_scene_is_refused(copy, tmp_path):
    split_model(RAW_FILE, tmp_path / "other", SplitConfig(chunk_gaussians=400, levels=1), context=QUIET_CONTEXT)
    data = (tmp_path / "other" / "shared.hyrf").read_bytes()
    (copy / "shared.hyrf").write_bytes(data)
    edit_manifest(
        copy, lambda v: v.update(shared={"file": "shared.hyrf", "bytes": len(data), "crc32": f"{zlib.crc32(data):08x}"})
    )

    with pytest.raises(HyrfFormatError, match="configuration is not that|is not the one that .* refers to"):
        load_model(copy)
    with pytest.raises(HyrfFormatError, match="is not the one that .*chunk-0000-0.hyrf refers to"):
        load_model(copy / "chunk-0000-0.hyrf")


@pytest.mark.parametrize("name", [b"../shared.hyrf", b"", b".hyrf", b"a\0.hyrf", b"shared.txt", b"x" * 70 + b".hyrf"])
def test_a_reference_out_of_the_folder_is_refused(copy, name):
    path = copy / "chunk-0000-0.hyrf"
    sections = {section.type: section for section in read_container(path.read_bytes()).sections}
    data = bytes(sections["GTAB"].data[:4]) + name
    sections["GTAB"] = Section("GTAB", CODEC_SHARED, data, len(data))
    path.write_bytes(write_container(list(sections.values()), MINOR_VERSION))

    with pytest.raises(HyrfFormatError, match="section 'GTAB' refers to no file of its folder|refer to several files"):
        load_model(path)
    with pytest.raises(ValueError, match=r"bad name|several files|wrong raw length"):
        read_with_minimal_reader(path)


def test_the_bytes_of_a_chunk_alone_are_refused(folder):
    data = (folder / "chunk-0000-0.hyrf").read_bytes()

    with pytest.raises(HyrfFormatError, match=r"needs the file shared.hyrf of its folder"):
        from hyrfpack.format import decode_model

        decode_model(data)
    with pytest.raises(HyrfError, match="a part cannot refer to another file"):
        encode_parts([("chunk", data)])


def test_a_file_that_the_manifest_does_not_list_is_ignored_with_a_note(copy):
    shutil.copy(copy / "shared.hyrf", copy / "stray.hyrf")

    result = hyrfpack("info", copy)

    assert result.exit_code == 0
    assert "stray.hyrf: not in the manifest and ignored" in result.stderr


def test_an_existing_scene_is_replaced_only_with_permission_and_completely(copy):
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    fewer = SplitConfig(chunk_gaussians=800, levels=1)
    with pytest.raises(HyrfError, match="overwrite"):
        split_model(COMPACT_FILE, copy, fewer, overwrite=False, context=QUIET_CONTEXT)
    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before

    split_model(COMPACT_FILE, copy, fewer, context=QUIET_CONTEXT)

    assert sorted(path.name for path in copy.iterdir()) == [
        "chunk-0000-0.hyrf",
        "chunk-0001-0.hyrf",
        "scene.json",
        "shared.hyrf",
    ]


def fail_to_write(monkeypatch, name: str) -> None:
    """Let the disk be full when the file of this name is written."""
    real = Path.write_bytes

    def write(path, data):
        if path.name == name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", write)


def test_a_failure_leaves_no_half_written_folder(tmp_path, monkeypatch):
    fail_to_write(monkeypatch, "chunk-0001-0.hyrf")
    with pytest.raises(HyrfError, match=r"scene/chunk-0001-0\.hyrf: the disk is full"):
        split_model(COMPACT_FILE, tmp_path / "scene", SplitConfig(chunk_gaussians=400, levels=1), context=QUIET_CONTEXT)

    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("name", ["chunk-0001-0.hyrf", "scene.json"])
def test_a_failure_while_a_scene_is_replaced_leaves_the_old_one(copy, monkeypatch, name):
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    fail_to_write(monkeypatch, name)
    with pytest.raises(HyrfError, match="the disk is full"):
        split_model(COMPACT_FILE, copy, SplitConfig(chunk_gaussians=200, levels=1), context=QUIET_CONTEXT)

    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


def test_a_scene_json_of_another_program_makes_no_scene(tmp_path):
    (tmp_path / "scene.json").write_text('{"scale": 1.0, "center": [0, 0, 0]}')
    archive = shutil.make_archive(str(tmp_path.parent / "other"), "zip", tmp_path)

    assert not is_scene(tmp_path) and not is_scene(tmp_path / "scene.json") and not is_scene(archive)
    with pytest.raises(HyrfFormatError, match="not the manifest of a scene folder"):
        SceneFolder(tmp_path)


def test_a_scene_is_not_written_into_the_folder_of_a_run(tmp_path):
    save_model(small_model(np.zeros((3, 3))), tmp_path / "model.hyrf")

    with pytest.raises(HyrfError, match="holds a training run.*name another folder"):
        split_model(tmp_path / "model.hyrf", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["model.hyrf"]


def test_a_scene_is_refused_as_a_source(folder, tmp_path):
    assert "a scene of several files already" in refused("split", folder, "-o", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


@pytest.mark.acceptance
def test_commands_read_a_scene_like_a_file(folder, tmp_path):
    info = json.loads(succeeded("info", folder, "--json").stdout)
    text = succeeded("info", folder / "scene.json").stdout
    drawn = succeeded("render", folder, "-o", tmp_path / "views", "--orbit", 1, "--gaussians", 700)
    succeeded("decompress", folder, "-o", tmp_path / "joined.hyrf")
    succeeded("export", folder, "-o", tmp_path / "player")

    assert info["gaussians"] == 1500 and len(info["scene"]["chunks"]) == 4
    assert "1,500 Gaussians in 4 chunks" in text and "level 1" in text
    assert "Gaussians; predicted PSNR to the finest" in drawn.stderr
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["0000.png"]
    for joined in (tmp_path / "joined.hyrf", tmp_path / "player" / "scene.hyrf"):
        for first, second in zip(load_model(joined).parameters(), load_model(folder).parameters(), strict=True):
            assert torch.equal(first, second)
    assert len(load_merged_model(folder)) == 1500
    with as_single_file(folder) as file:
        assert file.name == "demo-scene.hyrf"


def test_budgets_are_for_scenes_and_exclude_each_other(folder, tmp_path):
    assert "no levels of detail" in refused("render", COMPACT_FILE, "-o", tmp_path / "a", "--bytes", "1MB")
    assert "give one of them" in refused("render", folder, "-o", tmp_path / "a", "--bytes", "1MB", "--gaussians", 5)
    assert not (tmp_path / "a").exists()


def test_the_golden_scene_is_read_as_the_file_that_it_was_made_of():
    model, scene = load_model(GOLDEN_FOLDER / f"{GOLDEN_SCENE_SOURCE}.hyrf"), load_model(GOLDEN_SCENE_FOLDER)

    for name, values in model.state_dict().items():
        if not name.startswith("gaussians"):
            assert torch.equal(scene.state_dict()[name], values), name
    assert len(scene) == len(model) and scene.exposure is not None
    _, groups, exposure = read_with_minimal_reader(GOLDEN_SCENE_FOLDER / "chunk-0000-0.hyrf")
    for group, values in to_arrays(scene).items():
        np.testing.assert_array_equal(values, groups[group], err_msg=group)
    assert exposure is not None
