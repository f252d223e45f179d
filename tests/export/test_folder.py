"""Export folders for hosting: all files are complete, other files are kept and inputs are never overwritten."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import QUIET_CONTEXT, ball_scene, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.edit import Background, CropSphere, Translate
from hyrfpack.config.export import ExportConfig
from hyrfpack.edit import edit_model
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.export import ExportReport, export_gallery, export_model, export_player
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.codec import repack

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
GOLDEN_SCENE = Path(__file__).parents[1] / "golden" / "scene"
PLAYER_FILES = {"README.txt", "hyrf-viewer.js", "index.html", "player.css", "player.js", "player-worker.js"}


def write_model(path: Path, **provenance) -> Path:
    cameras = ring(4)
    kept = {
        "cameras": provenance_cameras(cameras),
        "viewpoint": Viewpoint.from_cameras(cameras).to_json(),
        **provenance,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(small_model(GAUSSIAN_POSITIONS, fields=2.0), path, provenance=kept)
    return path


@pytest.fixture(scope="module")
def model_file(tmp_path_factory) -> Path:
    return write_model(tmp_path_factory.mktemp("models") / "room.hyrf", psnr=24.3)


@pytest.fixture(scope="module")
def splats_file(model_file) -> Path:
    export_model(model_file, model_file.parent / "cloud.ply", ExportConfig(degree=1))
    return model_file.parent / "cloud.ply"


def file_names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def read_content_json(page: Path) -> dict:
    (text,) = re.findall(r'<script type="text/plain" id="content">([^<]*)</script>', page.read_text())
    return json.loads(text)


# -- a player ----------------------------------------------------------------------------------------------------------


def test_a_player_folder_has_a_page_the_file_a_poster_and_the_element(model_file, tmp_path):
    folder = tmp_path / "player"
    report = export_model(model_file, folder)
    assert file_names(folder) == PLAYER_FILES | {"scene.hyrf", "poster.jpg"}
    assert (folder / "scene.hyrf").read_bytes() == model_file.read_bytes()
    content = read_content_json(folder / "index.html")
    assert (content["content"], content["title"]) == ("scene.hyrf", "room") and content["views"]["scene.hyrf"][
        "cameras"
    ]
    page = (folder / "index.html").read_text()
    assert '<meta property="og:image" content="poster.jpg">' in page and "<title>room</title>" in page
    assert f'<meta property="og:description" content="40 Gaussians, {model_file.stat().st_size:,} bytes">' in page
    assert Image.open(folder / "poster.jpg").size == (32, 32)
    size = sum(path.stat().st_size for path in folder.iterdir())
    assert report == ExportReport(str(folder), size, 40, native=True)
    readme = (folder / "README.txt").read_text()
    assert "keep hyrf-viewer.js and player-worker.js together" in readme
    assert readme.startswith("room\n") and "content=URL" in readme and "{{" not in readme


def test_a_player_of_splats_contains_the_file_unchanged(splats_file, tmp_path):
    report = export_player(splats_file, tmp_path / "p")
    assert file_names(tmp_path / "p") == PLAYER_FILES | {"scene.ply", "poster.jpg"} and report.gaussians == 40
    assert (tmp_path / "p" / "scene.ply").read_bytes() == splats_file.read_bytes()
    assert np.asarray(Image.open(tmp_path / "p" / "poster.jpg")).std() > 5  # the poster is not uniform
    content = read_content_json(tmp_path / "p" / "index.html")
    assert content["content"] == "scene.ply" and len(content["views"]["scene.ply"]["cameras"]) == 1


def test_a_player_without_a_scene_has_no_content(tmp_path):
    report = export_player(None, tmp_path / "p")
    assert file_names(tmp_path / "p") == PLAYER_FILES and (report.gaussians, report.native) == (0, False)
    assert 'id="content"' not in (tmp_path / "p" / "index.html").read_text()


def test_title_and_credit_are_shown_by_players_and_galleries(model_file, splats_file, tmp_path):
    texts = {"title": "The room", "credit": "Photos: A. & B."}
    export_model(model_file, tmp_path / "p", ExportConfig(**texts))
    export_gallery([model_file, splats_file], tmp_path / "g", **texts)
    for page in ("p/index.html", "g/player.html"):
        text = (tmp_path / page).read_text()
        assert "<title>The room</title>" in text and '<p id="credit">Photos: A. &amp; B.</p>' in text
    assert "<h1>The room</h1>" in (tmp_path / "g" / "index.html").read_text()


def test_the_player_of_a_run_has_the_title_of_its_folder(tmp_path):
    write_model(tmp_path / "garden.v2" / "model.hyrf")
    export_model(tmp_path / "garden.v2", tmp_path / "player")
    assert "<title>garden.v2</title>" in (tmp_path / "player" / "index.html").read_text()


@pytest.mark.parametrize("target", ["a.html", "player"])
def test_no_note_names_the_temporary_file_of_a_scene_folder(target, tmp_path, caplog):
    export_model(GOLDEN_SCENE, tmp_path / target)
    assert caplog.messages == []


def test_messages_about_cameras_name_the_scene_folder(tmp_path, caplog):
    try:
        export_model(GOLDEN_SCENE, tmp_path / "a.json")
        messages = "\n".join(caplog.messages)
    except HyrfError as error:
        messages = str(error)
    assert messages.startswith(str(GOLDEN_SCENE))


def test_other_files_in_the_folder_are_kept(model_file, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for _ in range(2):
        export_model(model_file, tmp_path)
        assert (tmp_path / "mine.txt").read_text() == "mine"
    assert file_names(tmp_path) == PLAYER_FILES | {"scene.hyrf", "poster.jpg", "mine.txt"}


def test_an_input_file_is_never_overwritten(model_file, tmp_path):
    export_model(model_file, tmp_path)
    before = (tmp_path / "scene.hyrf").read_bytes()
    with pytest.raises(HyrfError, match=r"scene\.hyrf: the output is an input itself"):
        export_model(tmp_path / "scene.hyrf", tmp_path)
    assert (tmp_path / "scene.hyrf").read_bytes() == before


def test_a_folder_of_input_photos_is_refused(model_file, tmp_path, data):
    scene = hyrfpack.load_scene(data)
    with pytest.raises(HyrfError, match="reads what lies in this folder"):
        export_player(model_file, Path(scene.path), data=scene)


def test_a_full_disk_leaves_no_partial_file(model_file, tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hyrfpack.atomic.os.replace", fail)
    with pytest.raises(HyrfError, match=r"scene\.hyrf: the disk is full"):
        export_model(model_file, tmp_path / "p")
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    "write", [export_model, lambda source, target, **options: export_gallery([source], target, **options)]
)
def test_a_full_disk_in_the_middle_leaves_what_was_there_and_the_call_can_be_repeated(
    write, model_file, tmp_path, monkeypatch
):
    replace, calls = os.replace, []

    def fail_third(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        replace(*arguments)

    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "notes.txt").write_text("mine")
    with monkeypatch.context() as patch:
        patch.setattr("hyrfpack.atomic.os.replace", fail_third)
        with pytest.raises(HyrfError, match="the disk is full"):
            write(model_file, tmp_path / "p")
    assert file_names(tmp_path / "p") == {"notes.txt"}
    assert write(model_file, tmp_path / "p", overwrite=False).bytes > 0


def test_splats_without_extent_have_no_poster(tmp_path):
    save_model(small_model(np.zeros((3, 3))), tmp_path / "m.hyrf", provenance={"cameras": provenance_cameras(ring(2))})
    export_model(tmp_path / "m.hyrf", tmp_path / "a.ply", ExportConfig(degree=0))
    export_player(tmp_path / "a.ply", tmp_path / "p")
    assert file_names(tmp_path / "p") == PLAYER_FILES | {"scene.ply"} and "poster" not in read_content_json(
        tmp_path / "p" / "index.html"
    )


# -- a gallery ---------------------------------------------------------------------------------------------------------


def test_a_gallery_lists_its_scenes_and_links_to_its_player(model_file, splats_file, tmp_path):
    report = export_gallery([model_file, splats_file], tmp_path / "g")
    assert file_names(tmp_path / "g") == {
        *("index.html", "player.html", "README.txt", "gallery.css", "player.css", "player.js", "player-worker.js"),
        *("room.hyrf", "room.jpg", "cloud.ply", "cloud.jpg"),
    }
    assert "hyrf-viewer" not in (tmp_path / "g" / "README.txt").read_text()
    page = (tmp_path / "g" / "index.html").read_text()
    assert '<a href="player.html?content=room.hyrf&amp;poster=room.jpg">room</a>' in page
    assert '<a href="player.html?content=cloud.ply&amp;poster=cloud.jpg">cloud</a>' in page
    assert "40 Gaussians" in page and "24.3 dB on its training photos" in page
    size = sum(path.stat().st_size for path in (tmp_path / "g").iterdir())
    assert report == ExportReport(str(tmp_path / "g"), size, 80, native=True)


@pytest.mark.parametrize("psnr, shown", [(24, "24.0 dB on"), (24.5, "24.5 dB on"), (True, None), ("24", None)])
def test_a_gallery_shows_a_stated_psnr_that_is_a_number(psnr, shown, tmp_path):
    save_model(load_model(write_model(tmp_path / "m.hyrf")), tmp_path / "stated.hyrf", provenance={"psnr": psnr})
    export_gallery([tmp_path / "stated.hyrf"], tmp_path / "g")
    page = (tmp_path / "g" / "index.html").read_text()
    assert shown in page if shown else " dB" not in page


def test_a_gallery_says_that_a_compressed_model_was_scored_before(model_file, tmp_path):
    save_model(load_model(model_file), tmp_path / "old.hyrf", "paper", provenance={"psnr": 24.3})
    repack(model_file, tmp_path / "small.hyrf", "paper")
    repack(tmp_path / "small.hyrf", tmp_path / "raw.hyrf", "raw")
    export_gallery([tmp_path / name for name in ("old.hyrf", "small.hyrf", "raw.hyrf")], tmp_path / "g")
    assert (tmp_path / "g" / "index.html").read_text().count("24.3 dB on its training photos before compression<") == 3


def test_a_gallery_says_that_an_edited_model_was_scored_before(model_file, tmp_path):
    edits = {
        "cropped": (model_file, [CropSphere((0.0, 0.0, 0.0), 0.5)]),
        "background": (model_file, [Background((0.0, 0.0, 0.5))]),
        "moved": (model_file, [Translate((1.0, 0.0, 0.0))]),
    }
    files = []
    for name, (source, actions) in edits.items():
        edit_model(source, tmp_path / f"{name}.hyrf", actions, context=QUIET_CONTEXT)
        files.append(tmp_path / f"{name}.hyrf")
    repack(files[0], tmp_path / "small.hyrf", "paper")
    repack(model_file, tmp_path / "packed.hyrf", "paper")
    edit_model(tmp_path / "packed.hyrf", tmp_path / "last.hyrf", [CropSphere((0.0, 0.0, 0.0), 0.5)])
    files += [tmp_path / "small.hyrf", tmp_path / "last.hyrf"]

    export_gallery(files, tmp_path / "g")

    page = (tmp_path / "g" / "index.html").read_text()
    quality = re.findall(r"24\.3 dB on its training photos( before [^<]+)?<", page)
    edited = " before an edit"
    assert quality == [edited, edited, "", edited, edited]
    assert all(describe_file(file)["provenance"]["psnr"] == 24.3 for file in files)


def test_a_gallery_shows_the_psnr_on_held_out_photos(model_file, tmp_path):
    photos = ball_scene(8)
    photos = type(photos)(**{**vars(photos), "train": photos.train[1:], "test": photos.train[:1]})
    export_gallery([model_file], tmp_path / "g", data=[photos])
    score = evaluate_model(load_model(model_file), photos.test).psnr
    assert f"{score:.2f} dB on 1 held-out photo<" in (tmp_path / "g" / "index.html").read_text()


def test_scenes_with_equal_names_get_different_file_names(tmp_path):
    sources = [
        write_model(tmp_path / folder / name) for folder, name in (("a", "m.hyrf"), ("b", "M.hyrf"), ("c", "m.hyrf"))
    ]
    export_gallery(sources, tmp_path / "g")
    assert {"m.hyrf", "M-2.hyrf", "m-3.hyrf"} <= file_names(tmp_path / "g")
    for source, name in zip(sources, ("m.hyrf", "M-2.hyrf", "m-3.hyrf"), strict=True):
        assert (tmp_path / "g" / name).read_bytes() == source.read_bytes()


def test_file_names_are_sanitized_and_escaped(tmp_path):
    source = write_model(tmp_path / "<b>ä & ?#%..hyrf")
    export_gallery([source], tmp_path / "g")
    assert {"b-ä.hyrf", "b-ä.jpg"} <= file_names(tmp_path / "g")
    assert "content=b-%C3%A4.hyrf&amp;poster=b-%C3%A4.jpg" in (tmp_path / "g" / "index.html").read_text()


def test_a_manifest_is_named_after_its_folder_before_and_after_the_work(tmp_path, monkeypatch):
    manifest = shutil.copytree(GOLDEN_SCENE, tmp_path / "city") / "scene.json"
    export_gallery([manifest], tmp_path / "new")
    assert "city.hyrf" in file_names(tmp_path / "new")
    assert ">city</a>" in (tmp_path / "new" / "index.html").read_text()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "city.hyrf").touch()
    monkeypatch.setattr("hyrfpack.export.folder.as_single_file", lambda source: pytest.fail("the work began"))
    with pytest.raises(HyrfError, match=r"city\.hyrf of the files to be written is there"):
        export_gallery([manifest], tmp_path / "old", overwrite=False)


def test_photos_of_splats_are_refused(splats_file, tmp_path):
    for call in (
        lambda: export_player(splats_file, tmp_path / "page", data=ball_scene(3)),
        lambda: export_gallery([splats_file], tmp_path / "page", data=[ball_scene(3)]),
    ):
        with pytest.raises(HyrfError, match="photos go with .hyrf files only; leave out `data`, or this file"):
            call()
    assert not (tmp_path / "page").exists()


def test_a_wrong_number_of_photo_sets_is_refused(model_file, tmp_path):
    for sources, data, words in (([model_file], [None, None], "one for each"), ([], [], "there are no models")):
        with pytest.raises(ValueError, match=words):
            export_gallery(sources, tmp_path / "g", data=data)
    assert list(tmp_path.iterdir()) == []


def test_an_unreadable_model_leaves_no_files(model_file, tmp_path):
    (tmp_path / "bad.hyrf").write_bytes(model_file.read_bytes()[:-8])
    with pytest.raises(HyrfError, match=r"bad\.hyrf: "):
        export_gallery([model_file, tmp_path / "bad.hyrf"], tmp_path / "g")
    assert not (tmp_path / "g").exists() or not file_names(tmp_path / "g")
