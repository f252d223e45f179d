"""The encoded page is reproducible, small and safe, and its content can be extracted again."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hyrfpack.cameras.paths import look_at
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats, normalize_quats
from hyrfpack.web.html import decode_splats_page, encode_model_page, encode_splats_page, extract_payload
from hyrfpack.web.player import (
    assemble_player_page,
    encode_element_script,
    encode_player,
    encode_player_files,
    strip_shader_comments,
)

UP_DIRECTION, SCENE_CENTER = np.array([0.0, -1.0, 0.0]), np.array([1000.0, -50.0, 20.0])
SCENE_FRAME = Frame((1000.0, -50.0, 20.0), 4.0, (1.0, 1.0, 1.0))
HOSTILE_TITLE = '</title><script>alert("x")</script>{{script}}'
MAX_PAGE_OVERHEAD_BYTES = 109_580


def random_splats(count: int = 1500) -> Splats:
    """Return splats of all shapes around SCENE_CENTER, far from the origin."""
    rng = np.random.default_rng(1)
    harmonics = rng.normal(size=(count, 16, 3)) * np.array([0.8] + [0.12] * 15)[:, None]
    shapes = np.exp(rng.normal(-3.3, 0.8, (count, 3))), normalize_quats(rng.normal(size=(count, 4)))
    return Splats(SCENE_CENTER + rng.normal(size=(count, 3)) * 0.5, *shapes, rng.uniform(size=count), harmonics)


def page_settings(**more: object) -> dict:
    pose = look_at(SCENE_CENTER + np.array([1.5, -0.75, -1.8]), SCENE_CENTER, UP_DIRECTION)
    cameras = [Camera(120, 90, 110.0, 110.0, 60.0, 45.0, pose)]
    return {
        "title": "a scene",
        "cameras": cameras,
        "up": UP_DIRECTION,
        "center": SCENE_CENTER,
        "solid": (0.2, 0.3, 0.1),
        **more,
    }


def encode_baked_page(splats: Splats | None = None, **more: object) -> bytes:
    return encode_splats_page(
        random_splats() if splats is None else splats, **page_settings(**{"near": 0.01, "background": None, **more})
    )


def encode_native_page(data: bytes = b"a model", **more: object) -> bytes:
    return encode_model_page(data, count=1234, frame=SCENE_FRAME, **page_settings(**more))


def unpack_scripts_and_shaders(page: bytes) -> dict[str, str]:
    """Return the player's scripts and shaders by name."""
    (packed,) = re.findall(rb'id="player">([^<]*)<', page)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def parse_policy(page: bytes) -> dict[str, str]:
    (content,) = re.findall(rb'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    return dict(directive.split(" ", 1) for directive in content.decode().split("; "))


PAGE_ENCODERS = {
    "native": lambda: encode_native_page(title=HOSTILE_TITLE, poster=b"picture"),
    "baked": lambda: encode_baked_page(title=HOSTILE_TITLE, poster=b"picture", background=np.full((4, 8, 3), 0.5)),
    "player": lambda: encode_player(
        HOSTILE_TITLE, content="scene.hyrf", poster="poster.jpg", description=HOSTILE_TITLE
    ),
    "in a folder": lambda: encode_player(HOSTILE_TITLE, content="scene.hyrf", poster="poster.jpg", in_folder=True),
    "served": lambda: encode_player(HOSTILE_TITLE, content="scene.hyrf", fetches="'self'"),
}


@pytest.mark.parametrize("kind", ["native", "baked", "player", "served"])
def test_a_page_is_reproducible_and_runs_only_scripts_in_its_policy(kind):
    page = PAGE_ENCODERS[kind]()
    assert page == PAGE_ENCODERS[kind]()
    (script,) = re.findall(r"<script>(.*?)</script>", page.decode(), re.DOTALL)
    allowed = parse_policy(page)
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (
        script,
        unpack_scripts_and_shaders(page)["main.js"],
    )]  # fmt: skip
    assert allowed["script-src"] == " ".join(f"'sha256-{value}'" for value in hashes)
    assert allowed["default-src"] == "'none'" and "unsafe" not in str(allowed)
    assert not re.search(r"\son\w+=", page.decode()), "an inline handler"


def test_a_page_in_a_folder_has_no_script_or_style_inside_and_allows_only_files_beside_it():
    page = PAGE_ENCODERS["in a folder"]()
    assert page == PAGE_ENCODERS["in a folder"]()
    text, allowed = page.decode(), parse_policy(page)
    assert "<style" not in text and not re.search(r"\s(on\w+|style)=", text)
    scripts = re.findall(r"<script([^>]*)>", text)
    assert [tag for tag in scripts if "text/plain" not in tag] == [' src="player.js"']
    assert allowed["script-src"] == allowed["style-src"] == allowed["worker-src"] == "'self'"
    assert set(encode_player_files()) == {"player.css", "player.js", "player-worker.js"}


@pytest.mark.parametrize("kind", PAGE_ENCODERS)
def test_a_hostile_title_is_escaped(kind):
    text = PAGE_ENCODERS[kind]().decode()
    assert '<script>alert("x")' not in text and "&lt;script&gt;alert" in text and "{{script}}" in text


@pytest.mark.parametrize("kind", ["native", "baked"])
def test_a_page_with_a_scene_inside_refers_to_no_other_file_and_may_not_fetch(kind):
    page = PAGE_ENCODERS[kind]()
    assert not re.search(rb'(src|href)="(?!data:)', page) and b"og:image" not in page
    assert not re.search(r"import\(|\bhttps?://", "".join(unpack_scripts_and_shaders(page).values()))
    assert "connect-src" not in parse_policy(page) and parse_policy(page)["img-src"] == "data: blob:"


def test_a_hosted_player_may_fetch_from_the_web_and_a_served_one_only_from_its_server():
    hosted, served = parse_policy(PAGE_ENCODERS["player"]()), parse_policy(PAGE_ENCODERS["served"]())
    assert hosted["connect-src"] == "'self' https: http:" and hosted["img-src"] == "'self' https: http: data: blob:"
    assert served["connect-src"] == "'self'" and served["img-src"] == "'self' data: blob:"


def test_a_player_page_refers_to_its_content_and_poster():
    page = encode_player("room", content="scene.hyrf", poster="poster.jpg", description="a & b").decode()
    assert (
        '<script type="text/plain" id="content">{"content": "scene.hyrf", "title": "room", "views": {}}</script>'
        in page
    )
    assert '<img id="poster" alt="" src="poster.jpg">' in page
    assert '<meta property="og:image" content="poster.jpg">' in page
    assert '<meta property="og:description" content="a &amp; b">' in page
    empty = encode_player("empty").decode()
    assert 'id="content"' not in empty and 'id="poster"' not in empty and 'id="scene"' not in empty


def test_the_credit_is_shown_below_the_title_and_escaped():
    for page in (encode_native_page(credit="A <b> & C"), encode_baked_page(credit="A <b> & C")):
        assert '<p id="credit">A &lt;b&gt; &amp; C</p>' in page.decode()
    assert '<p id="credit"></p>' in encode_native_page().decode()


def test_comments_and_indentation_are_removed_from_shaders():
    text = "// first\nvoid main() { // second\n  x = a / b; // third\n\n}\n"
    assert strip_shader_comments(text) == "void main() {\nx = a / b;\n}"


def test_the_elements_script_holds_all_that_it_needs():
    script = encode_element_script().decode()
    assert script.startswith('(() => {"use strict";const EMBEDDED_TEXTS=')
    assert all(f'"{name}"' in script for name in ("blend.frag", "worker.js"))


@pytest.mark.parametrize(("readers", "max_bytes"), [(False, 68_165), (True, 75_965)])
def test_the_compressed_player_stays_below_its_size_limit(readers, max_bytes):
    assert len(gzip.compress(assemble_player_page("hyrfpack", [], "a player", readers=readers))) <= max_bytes


def test_the_editing_panel_adds_at_most_20_kb_to_pages_that_ask_for_it():
    plain, editable = (assemble_player_page("hyrfpack", [], "a player", editable=choice) for choice in (False, True))
    assert b"edit-" not in plain and len(gzip.compress(editable)) < len(gzip.compress(plain)) + 20_000


def test_a_native_page_adds_less_than_110_kb_to_its_file_in_base64():
    data = np.random.default_rng(0).bytes(86_000)
    assert len(encode_native_page(data, poster=bytes(9_000))) <= len(data) * 4 / 3 + MAX_PAGE_OVERHEAD_BYTES


@pytest.mark.parametrize("length", [0, 1, 2, 3, 1000, 10_000])
def test_extract_payload_returns_the_file_inside_a_native_page(length, monkeypatch):
    monkeypatch.setattr("hyrfpack.web.player.PAYLOAD_BLOCK_BYTES", 3000)
    data = np.random.default_rng(0).bytes(length)
    page = encode_native_page(data)
    scene, inside = extract_payload(page, "page")
    assert inside == data and page.count(b'class="payload"') == -(-length // 3000)
    assert (scene["kind"], scene["title"], scene["count"], len(scene["cameras"])) == ("hyrf", "a scene", 1234, 1)
    assert (scene["center"], scene["unit"], scene["near"]) == ([1000.0, -50.0, 20.0], 4.0, 0.01)


def test_a_poster_is_embedded_in_the_page():
    file = io.BytesIO()
    Image.new("RGB", (8, 4)).save(file, "WEBP")
    (address,) = re.findall(
        rb'<img id="poster" alt="" src="data:image/webp;base64,([^"]*)"', encode_native_page(poster=file.getvalue())
    )
    assert base64.b64decode(address) == file.getvalue()


@pytest.mark.parametrize("encode_page", [encode_native_page, encode_baked_page])
def test_a_page_without_cameras_is_refused(encode_page):
    with pytest.raises(ValueError, match="camera"):
        encode_page(cameras=[])


# --- splats -----------------------------------------------------------------------------------------------------------


def test_a_page_stores_splats_with_the_precision_of_spz_in_any_unit_and_place():
    for factor in (1e-6, 1.0, 1e6):
        splats = random_splats(300)
        splats = replace(splats, positions=splats.positions * factor, scales=splats.scales * np.float32(factor))
        back, _ = decode_splats_page(encode_baked_page(splats), "page")
        extent = np.ptp(splats.positions, axis=0).max()
        assert np.abs(back.positions - splats.positions).max() < extent * 2**-21
        assert np.abs(np.log(back.scales / splats.scales)).max() < 1 / 31
        assert np.abs(back.opacities - splats.opacities).max() < 1 / 500
        assert back.degree == 3


def test_many_splats_are_stored_in_separate_blocks(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("hyrfpack.web.player.PAYLOAD_BLOCK_BYTES", 3000)
    page = encode_baked_page()
    assert page.count(b'class="payload"') > 10 and len(decode_splats_page(page, "page")[0]) == 1500


@pytest.mark.parametrize(
    "data", [b"", b"<html>", b'<script type="text/plain" id="scene">{}</script>', encode_native_page()]
)
def test_other_files_than_pages_of_splats_are_refused(data: bytes):
    with pytest.raises(HyrfDataError, match=r"^x\.html: this is not a page"):
        decode_splats_page(data, "x.html")


def test_damaged_pages_are_decoded_or_refused_in_one_line():
    page = encode_baked_page(random_splats(20))
    rng = np.random.default_rng(0)
    places = [match.span(1) for match in re.finditer(rb'(?:id="scene"|class="payload")>([^<]*)<', page)]
    for _ in range(300):
        damaged, (first, last) = bytearray(page), places[rng.integers(2)]
        damaged[rng.integers(first, last)] = rng.integers(256)
        try:
            decode_splats_page(bytes(damaged), "x.html")
        except HyrfDataError as error:
            assert str(error).startswith("x.html: ") and "\n" not in str(error)


def test_all_files_of_the_page_are_package_data():
    import hyrfpack.web

    folder = Path(hyrfpack.web.__file__).parent
    listed = (folder.parents[1] / "pyproject.toml").read_text()
    for entry in folder.rglob("*"):
        if entry.is_file() and entry.suffix not in (".py", ".pyc"):
            place = entry.relative_to(folder)
            pattern = f"{place.parent}/*" if len(place.parts) > 1 else place.name
            assert f'"{pattern}"' in listed, entry


def test_a_player_page_contains_the_viewpoints_of_its_files():
    seen = {"cameras": [], "up": [0, -1, 0], "target": [0, 0, 0]}
    page = encode_player("a", views={"a </script>.hyrf": seen}).decode()
    (beside,) = re.findall(r'<script type="text/plain" id="content">([^<]*)</script>', page)
    assert json.loads(beside) == {"content": None, "title": "a", "views": {"a </script>.hyrf": seen}}
