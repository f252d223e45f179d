"""Pages with the model itself inside contain it unchanged; options that change it and invalid files are refused."""

from __future__ import annotations

import base64
import io
import logging
import os
import re

import numpy as np
import pytest
from PIL import Image
from scenes import ball_scene, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.export import ExportConfig
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.export import export_gallery, export_model
from hyrfpack.export.pages import MAX_POSTER_BYTES
from hyrfpack.export.poster import encode_poster
from hyrfpack.format import load_model, save_model
from hyrfpack.render import render_view
from hyrfpack.web.html import extract_payload

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    """Write a model of forty Gaussians and a background sphere, with twenty cameras around it."""
    path, cameras = tmp_path_factory.mktemp("models") / "model.hyrf", ring(20, width=96, height=64)
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(
        small_model(GAUSSIAN_POSITIONS, fields=2.0, background=True, solid=(0.1, 0.2, 0.3)), path, provenance=kept
    )
    return path


@pytest.fixture(scope="module")
def compact_file(model_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("compact") / "compact.hyrf"
    hyrfpack.compress_model(model_file, path)
    return path


def test_the_page_contains_the_file_and_its_metadata(model_file, tmp_path):
    report = export_model(model_file, tmp_path / "room.html")
    page = (tmp_path / "room.html").read_bytes()
    scene, inside = extract_payload(page, "page")
    assert inside == model_file.read_bytes() and b"<title>room</title>" in page
    frame = load_model(model_file).config.frame
    assert (scene["kind"], scene["title"], scene["count"]) == ("hyrf", "room", 40)
    assert (scene["center"], scene["unit"], scene["solid"]) == (list(frame.center), frame.scale, [0.1, 0.2, 0.3])
    first = np.array(scene["cameras"][0]["camera_from_world"])
    assert len(scene["cameras"]) == 12 and np.allclose(first, ring(20)[0].camera_from_world, atol=1e-6)
    assert (report.native, report.bytes, report.gaussians) == (True, len(page), 40)
    assert (report.views, report.psnr, report.psnr_baked, report.chosen_by) == (0, None, None, {})


def test_names_that_are_not_valid_utf8_become_escapes_in_titles(model_file, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "hyrfpack")  # pytest's processes send each other the log in UTF-8
    name = os.fsdecode(b"caf\xe9")
    copy = tmp_path / f"{name}.hyrf"
    try:
        copy.write_bytes(model_file.read_bytes())
    except OSError:
        pytest.skip("this file system stores only names in UTF-8")
    for target, config in (("native.html", ExportConfig(editable=True)), ("baked.html", ExportConfig(baked=True))):
        (tmp_path / target).mkdir()
        export_model(copy, tmp_path / target / f"{name}.html", config)
        page = (tmp_path / target / f"{name}.html").read_bytes()
        assert rb"<title>caf\udce9</title>" in page and extract_payload(page, "page")[0]["title"] == r"caf\udce9"
    export_model(copy, tmp_path / "player", ExportConfig(credit=name))
    export_gallery([copy], tmp_path / name)
    page = (tmp_path / "player" / "index.html").read_text("utf-8")
    assert r"<title>caf\udce9</title>" in page and r'"title": "caf\\udce9"' in page
    assert (tmp_path / "player" / "README.txt").read_text("utf-8").startswith("caf\\udce9\n")
    page = (tmp_path / name / "index.html").read_text("utf-8")
    assert r"<title>caf\udce9</title>" in page and r">caf\udce9</a></h2>" in page


def test_pages_and_players_have_the_editing_panel_on_request_only(model_file, tmp_path):
    export_model(model_file, tmp_path / "plain.html")
    export_model(model_file, tmp_path / "room.html", ExportConfig(editable=True, title="A room"))
    export_model(model_file, tmp_path / "player", ExportConfig(editable=True))
    plain, page = ((tmp_path / name).read_bytes() for name in ("plain.html", "room.html"))
    index = (tmp_path / "player" / "index.html").read_text()
    script, style = ((tmp_path / "player" / name).read_text() for name in ("player.js", "player.css"))

    assert b'id="edit"' not in plain and "file" not in extract_payload(plain, "page")[0]
    assert b'id="edit"' in page and extract_payload(page, "page")[0]["file"] == "model.hyrf"
    assert 'id="edit"' in index and '"file": "model.hyrf"' in index
    assert "hyrfpack edit" in script and "#edit-handles" in style


@pytest.mark.parametrize(("name", "more"), [("a.ply", {}), ("a.html", {"baked": True})])
def test_outputs_without_the_model_have_no_editing_panel(model_file, tmp_path, name, more):
    with pytest.raises(HyrfError, match="only pages of the model itself can edit it"):
        export_model(model_file, tmp_path / name, ExportConfig(editable=True, **more))


def test_pages_are_deterministic(model_file, tmp_path):
    (tmp_path / "again").mkdir()
    for path in (tmp_path / "a.html", tmp_path / "again" / "a.html"):
        export_model(model_file, path)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "again" / "a.html").read_bytes()


def test_the_poster_is_the_view_of_the_first_camera(model_file, tmp_path):
    export_model(model_file, tmp_path / "a.html")
    (data,) = re.findall(
        rb'id="poster" alt="" src="data:image/webp;base64,([^"]*)"', (tmp_path / "a.html").read_bytes()
    )
    poster = Image.open(io.BytesIO(base64.b64decode(data)))
    seen = render_view(load_model(model_file), ring(20, width=96, height=64)[0]).rgb.numpy().clip(0, 1)
    assert poster.size == (96, 64) and np.abs(np.asarray(poster) / 255 - seen).mean() < 0.03


@pytest.mark.parametrize(("image_format", "max_bytes"), [("WEBP", 3000), ("JPEG", 3000), ("WEBP", 100)])
def test_a_poster_stays_below_its_size_limit(image_format, max_bytes):
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 255, (360, 480, 3), np.uint8))
    data = encode_poster(noise, image_format, max_bytes)
    assert len(data) <= max_bytes and Image.open(io.BytesIO(data)).format == image_format
    plain = Image.new("RGB", (480, 360), (10, 20, 30))
    assert Image.open(io.BytesIO(encode_poster(plain, image_format, MAX_POSTER_BYTES))).size == (480, 360)


def test_a_file_without_cameras_is_viewed_from_an_orbit_or_from_its_photos(compact_file, tmp_path):
    export_model(compact_file, tmp_path / "a.html")
    export_model(compact_file, tmp_path / "b.html", data=ball_scene(10))
    made_up, photos = (extract_payload((tmp_path / name).read_bytes(), name)[0] for name in ("a.html", "b.html"))
    assert len(made_up["cameras"]) == 12 and len(photos["cameras"]) == 10
    assert np.allclose(photos["cameras"][0]["camera_from_world"], ball_scene(10).train[0].camera.camera_from_world)


def test_an_uncompressed_file_is_embedded_with_a_note(model_file, compact_file, tmp_path, caplog):
    export_model(compact_file, tmp_path / "a.html")
    assert caplog.messages == []
    export_model(model_file, tmp_path / "a.html")
    size = model_file.stat().st_size
    assert caplog.messages == [
        f"{model_file} is copied unchanged, {size:,} bytes; 'hyrfpack compress' makes it smaller"
    ]


@pytest.mark.parametrize("target", ["a.html", "player"])
@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"degree": 1}, "`degree`"),
        ({"crop": (0, 0, 0, 1, 1, 1)}, "`crop`"),
        ({"min_opacity": 0.1}, "`min_opacity`"),
        ({"background": False}, "`background=False`"),
        ({"background": False, "degree": 0}, "`degree` and `background=False`"),
    ],
)
def test_options_that_change_the_model_are_refused_with_a_hint_at_baked(target, options, name, model_file, tmp_path):
    with pytest.raises(HyrfError, match=rf"^[^\n]*{target}: [^\n]* {name}, [^\n]*`baked=True`$"):
        export_model(model_file, tmp_path / target, ExportConfig(**options))
    assert list(tmp_path.iterdir()) == []


def test_a_baked_player_folder_is_refused(model_file, tmp_path):
    with pytest.raises(HyrfError, match=r"player: [^\n]*`baked=True`[^\n]*\.html$"):
        export_model(model_file, tmp_path / "player", ExportConfig(baked=True))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("target", ["a.html", "player"])
def test_invalid_files_are_refused_and_nothing_is_written(target, compact_file, tmp_path):
    data = compact_file.read_bytes()
    damaged = bytearray(data)
    damaged[-20] ^= 1
    for bad in (bytes(damaged), data[: len(data) // 2], b"", b"\x89PNG"):
        (tmp_path / "bad.hyrf").write_bytes(bad)
        with pytest.raises(HyrfFormatError, match=r"^[^\n]*bad\.hyrf: [^\n]*$"):
            export_model(tmp_path / "bad.hyrf", tmp_path / target)
        assert [path.name for path in tmp_path.iterdir()] == ["bad.hyrf"]


def test_title_and_credit_are_only_for_pages(model_file, tmp_path):
    export_model(model_file, tmp_path / "a.html", ExportConfig(title="<Room>", credit="A. B."))
    page = (tmp_path / "a.html").read_text()
    assert "<title>&lt;Room&gt;</title>" in page and '<p id="credit">A. B.</p>' in page
    with pytest.raises(HyrfError, match=r"a\.ply: only pages show a title and a credit; leave out `credit`"):
        export_model(model_file, tmp_path / "a.ply", ExportConfig(credit="A. B."))


@pytest.mark.parametrize(
    ("target", "config", "sentence"),
    [
        ("a.ply", ExportConfig(baked=True), "always holds the latter; leave out `baked`"),
        ("a.json", ExportConfig(background=False), "only cameras, so that nothing can be left out"),
    ],
)
def test_settings_without_an_effect_are_refused(model_file, tmp_path, target, config, sentence):
    with pytest.raises(HyrfError, match=sentence):
        export_model(model_file, tmp_path / target, config)
    assert not (tmp_path / target).exists()


def test_a_degree_that_a_format_cannot_store_is_logged(model_file, tmp_path, caplog):
    with caplog.at_level("INFO", "hyrfpack"):
        assert export_model(model_file, tmp_path / "a.splat", ExportConfig(degree=2)).degree == 0
    assert ".splat stores harmonics up to degree 0; higher ones are left out" in caplog.messages
