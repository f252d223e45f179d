"""The exported folders of static files run on servers that allow only their own files."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.pages import Browser, wait_for_message, wait_for_path, wait_until
from web.site import GOLDEN_FILE_DATA, Site

import hyrfpack
from hyrfpack.web.player import encode_player

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
GOLDEN_FILE = Path(__file__).parents[1] / "golden" / "v1.1_compact.hyrf"
STRICT_HEADERS = {"Content-Security-Policy": "default-src 'self'"}


def serve_folder(host: Site, folder: Path) -> None:
    host.files = {f"/{path.name}": path.read_bytes() for path in folder.iterdir()}
    host.headers = STRICT_HEADERS


def test_an_exported_player_runs_under_a_policy_of_self(browser: Browser, host: Site, tmp_path: Path):
    hyrfpack.export_player(GOLDEN_FILE, tmp_path / "player")
    serve_folder(host, tmp_path / "player")
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    wait_until(browser, "document.body.classList.contains('there')")
    assert browser.evaluate("hyrfpack.player.scene.kind === 'hyrf' && hyrfpack.player.hasExposureMap !== undefined")
    assert browser.evaluate("getComputedStyle(document.getElementById('view')).display") == "block", "no style"
    assert not browser.evaluate("document.getElementById('stalled')")
    picture = browser.evaluate("hyrfpack.show(hyrfpack.camera()).then(() => new Set(hyrfpack.pixels()).size)")
    assert picture > 20, "the picture has one colour"


def test_an_exported_gallery_and_its_player_run_under_a_policy_of_self(browser: Browser, host: Site, tmp_path: Path):
    hyrfpack.export_gallery([GOLDEN_FILE, GOLDEN_FILE], tmp_path / "site")
    serve_folder(host, tmp_path / "site")
    browser.open(f"{host.address}/index.html")
    assert browser.evaluate("getComputedStyle(document.querySelector('ul')).display") == "grid", "no style"
    browser.evaluate("document.querySelector('h2 a').click()")
    wait_for_path(browser, "/player.html")
    wait_until(browser, "Boolean(window.hyrfpack)")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate("hyrfpack.player.scene.kind") == "hyrf"


@pytest.mark.parametrize("missing", ["player.js", "player-worker.js"])
def test_a_folder_with_a_missing_file_says_so(browser: Browser, host: Site, missing: str):
    host.files["/index.html"] = encode_player("room", content="scene.hyrf", in_folder=True)
    host.files["/scene.hyrf"] = GOLDEN_FILE_DATA
    del host.files[f"/{missing}"]
    browser.open(f"{host.address}/index.html")
    if missing == "player.js":
        assert "has not started" in browser.evaluate("document.getElementById('stalled').textContent")
    else:
        assert "player-worker.js cannot be started" in wait_for_message(browser)
