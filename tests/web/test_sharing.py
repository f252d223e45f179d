"""The Share button gives a link only where others can open it, by the dialog of touch screens or by the clipboard."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.pages import Browser, make_splats_page, random_splats, wait_until
from web.site import GOLDEN_FILE_DATA, Site, drop_file

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
PHONE_OPTIONS = {"pixel_ratio": 2.0, "phone": True}


RECORD_SHARING_JS = """(() => {
    window.copied = [];
    window.shared = [];
    const define = (name, value) => Object.defineProperty(Navigator.prototype, name, { configurable: true, value });
    define("clipboard", { writeText: async (text) => { copied.push(text); } });
    define("share", async (what) => {
        shared.push(what);
        if (window.refusal) throw Object.assign(new Error(), { name: window.refusal });
    });
})()"""


def press_share(browser: Browser) -> None:
    browser.evaluate("document.querySelector('[data-key=\"L\"]').click()")


def test_a_page_on_disk_says_that_it_has_no_link(browser: Browser, tmp_path: Path):
    (tmp_path / "page.html").write_bytes(make_splats_page(random_splats(50)))
    browser.open((tmp_path / "page.html").as_uri())
    browser.evaluate("hyrfpack.ready")
    browser.evaluate(RECORD_SHARING_JS)
    press_share(browser)
    wait_until(browser, "document.getElementById('done').textContent.includes('not on the web')")
    assert browser.evaluate("[copied, shared]") == [[], []]
    assert browser.evaluate("location.hash.startsWith('#camera=')"), "the address does not hold the view"


def test_an_opened_file_has_no_link(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    browser.evaluate(RECORD_SHARING_JS)
    drop_file(browser, GOLDEN_FILE_DATA, "model.hyrf")
    wait_until(browser, "hyrfpack.player.scene.kind === 'hyrf'")
    press_share(browser)
    wait_until(browser, "document.getElementById('done').textContent.includes('not include the opened file')")
    assert browser.evaluate("[copied, shared]") == [[], []]


def test_touch_screens_share_by_their_dialog_and_others_copy(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz&title=A%20cloud")
    browser.evaluate("hyrfpack.ready")
    browser.evaluate(RECORD_SHARING_JS)
    press_share(browser)
    wait_until(browser, "copied.length === 1")
    assert browser.evaluate("shared") == []
    assert "on this device only" in browser.evaluate("document.getElementById('done').textContent")  # 127.0.0.1
    browser.resize(390, 844, **PHONE_OPTIONS)
    browser.open(f"{host.address}/index.html?content=cloud.spz&title=A%20cloud")
    browser.evaluate("hyrfpack.ready")
    browser.evaluate(RECORD_SHARING_JS)
    press_share(browser)
    wait_until(browser, "shared.length === 1")
    assert browser.evaluate("shared[0]") == {"title": "A cloud", "url": browser.evaluate("location.href")}
    browser.evaluate("(window.refusal = 'AbortError', 0)")  # the user closes the dialog
    press_share(browser)
    wait_until(browser, "shared.length === 2")
    assert browser.evaluate("copied") == []
    browser.evaluate("(window.refusal = 'NotAllowedError', 0)")
    press_share(browser)
    wait_until(browser, "copied.length === 1")
    assert browser.evaluate("copied[0]") == browser.evaluate("location.href")
