"""Folders to be hosted: every file in its place and whole, nothing else touched, and inputs never replaced."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import ball_scene, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.export import ExportReport, export_gallery, export_model, export_player
from hyrfpack.format import load_model, save_model

POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
PLAYER = {"README.txt", "hyrf-viewer.js", "index.html"}


def write(path: Path, **provenance) -> Path:
    cameras = ring(4)
    kept = {
        "cameras": provenance_cameras(cameras),
        "viewpoint": Viewpoint.from_cameras(cameras).to_json(),
        **provenance,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(small_model(POSITIONS, fields=2.0), path, provenance=kept)
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("models") / "room.hyrf", psnr=24.3)


@pytest.fixture(scope="module")
def splats(model) -> Path:
    export_model(model, model.parent / "cloud.ply", degree=1)
    return model.parent / "cloud.ply"


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def content_of(page: Path) -> dict:
    (text,) = re.findall(r'<script type="text/plain" id="content">([^<]*)</script>', page.read_text())
    return json.loads(text)


# -- a player ----------------------------------------------------------------------------------------------------------


def test_a_player_is_a_page_the_file_its_picture_and_what_others_need(model, tmp_path):
    folder = tmp_path / "player"
    report = export_model(model, folder)
    assert names(folder) == PLAYER | {"scene.hyrf", "poster.jpg"}
    assert (folder / "scene.hyrf").read_bytes() == model.read_bytes()
    told = content_of(folder / "index.html")
    assert (told["content"], told["title"]) == ("scene.hyrf", "room") and told["stages"]["scene.hyrf"]["cameras"]
    page = (folder / "index.html").read_text()
    assert '<meta property="og:image" content="poster.jpg">' in page and "<title>room</title>" in page
    assert f'<meta property="og:description" content="40 Gaussians, {model.stat().st_size:,} bytes">' in page
    assert Image.open(folder / "poster.jpg").size == (32, 32)
    size = sum(path.stat().st_size for path in folder.iterdir())
    assert report == ExportReport(str(folder), size, 40, native=True)
    readme = (folder / "README.txt").read_text()
    assert readme.startswith("room\n") and "content=URL" in readme and "{{" not in readme


def test_splats_are_played_as_they_are(splats, tmp_path):
    report = export_player(splats, tmp_path / "p")
    assert names(tmp_path / "p") == PLAYER | {"scene.ply", "poster.jpg"} and report.gaussians == 40
    assert (tmp_path / "p" / "scene.ply").read_bytes() == splats.read_bytes()
    assert np.asarray(Image.open(tmp_path / "p" / "poster.jpg")).std() > 5  # something is to be seen
    assert content_of(tmp_path / "p" / "index.html")["content"] == "scene.ply"


def test_a_player_without_a_scene_waits_for_one(tmp_path):
    report = export_player(None, tmp_path / "p")
    assert names(tmp_path / "p") == PLAYER and (report.gaussians, report.native) == (0, False)
    assert 'id="content"' not in (tmp_path / "p" / "index.html").read_text()


def test_what_else_is_in_the_folder_stays(model, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for _ in range(2):
        export_model(model, tmp_path)
        assert (tmp_path / "mine.txt").read_text() == "mine"
    assert names(tmp_path) == PLAYER | {"scene.hyrf", "poster.jpg", "mine.txt"}


def test_a_file_never_replaces_itself(model, tmp_path):
    export_model(model, tmp_path)
    before = (tmp_path / "scene.hyrf").read_bytes()
    with pytest.raises(HyrfError, match=r"scene\.hyrf: the output is an input itself"):
        export_model(tmp_path / "scene.hyrf", tmp_path)
    assert (tmp_path / "scene.hyrf").read_bytes() == before


def test_nothing_is_put_among_photos_that_are_read(model, tmp_path, data):
    scene = hyrfpack.load_scene(data)
    with pytest.raises(HyrfError, match="reads what lies in this folder"):
        export_player(model, Path(scene.path), data=scene)


def test_a_disk_that_fills_up_leaves_no_half_file(model, tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hyrfpack.atomic.os.replace", fail)
    with pytest.raises(HyrfError, match=r"scene\.hyrf: the disk is full"):
        export_model(model, tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_splats_at_one_place_have_no_picture(tmp_path):
    save_model(small_model(np.zeros((3, 3))), tmp_path / "m.hyrf", provenance={"cameras": provenance_cameras(ring(2))})
    export_model(tmp_path / "m.hyrf", tmp_path / "a.ply", degree=0)
    export_player(tmp_path / "a.ply", tmp_path / "p")
    assert names(tmp_path / "p") == PLAYER | {"scene.ply"} and "poster" not in content_of(tmp_path / "p" / "index.html")


# -- a gallery ---------------------------------------------------------------------------------------------------------


def test_a_gallery_lists_its_scenes_and_links_to_its_player(model, splats, tmp_path):
    report = export_gallery([model, splats], tmp_path / "g")
    assert names(tmp_path / "g") == {
        *("index.html", "player.html", "README.txt"),
        *("room.hyrf", "room.jpg", "cloud.ply", "cloud.jpg"),
    }
    page = (tmp_path / "g" / "index.html").read_text()
    assert '<a href="player.html?content=room.hyrf&amp;poster=room.jpg">room</a>' in page
    assert '<a href="player.html?content=cloud.ply&amp;poster=cloud.jpg">cloud</a>' in page
    assert "40 Gaussians" in page and "24.3 dB on its training photos" in page
    size = sum(path.stat().st_size for path in (tmp_path / "g").iterdir())
    assert report == ExportReport(str(tmp_path / "g"), size, 80, native=True)


def test_held_out_photos_score_a_scene(model, tmp_path):
    photos = ball_scene(8)
    photos = type(photos)(**{**vars(photos), "train": photos.train[1:], "test": photos.train[:1]})
    export_gallery([model], tmp_path / "g", data=[photos])
    score = evaluate_model(load_model(model), photos.test).psnr
    assert f"{score:.2f} dB on 1 held-out photo<" in (tmp_path / "g" / "index.html").read_text()


def test_scenes_of_one_name_get_names_of_their_own(tmp_path):
    sources = [write(tmp_path / folder / name) for folder, name in (("a", "m.hyrf"), ("b", "M.hyrf"), ("c", "m.hyrf"))]
    export_gallery(sources, tmp_path / "g")
    assert {"m.hyrf", "M-2.hyrf", "m-3.hyrf"} <= names(tmp_path / "g")
    for source, name in zip(sources, ("m.hyrf", "M-2.hyrf", "m-3.hyrf"), strict=True):
        assert (tmp_path / "g" / name).read_bytes() == source.read_bytes()


def test_names_of_files_are_neither_html_nor_paths(tmp_path):
    source = write(tmp_path / "<b>ä & ?#%..hyrf")
    export_gallery([source], tmp_path / "g")
    assert {"b-ä.hyrf", "b-ä.jpg"} <= names(tmp_path / "g")
    assert "content=b-%C3%A4.hyrf&amp;poster=b-%C3%A4.jpg" in (tmp_path / "g" / "index.html").read_text()


def test_as_many_photos_as_models_or_none(model, tmp_path):
    for sources, data in (([model], [None, None]), ([], [])):
        with pytest.raises(ValueError, match="one for each"):
            export_gallery(sources, tmp_path / "g", data=data)
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_cannot_be_read_leaves_nothing(model, tmp_path):
    (tmp_path / "bad.hyrf").write_bytes(model.read_bytes()[:-8])
    with pytest.raises(HyrfError, match=r"bad\.hyrf: "):
        export_gallery([model, tmp_path / "bad.hyrf"], tmp_path / "g")
    assert not (tmp_path / "g").exists() or not names(tmp_path / "g")
