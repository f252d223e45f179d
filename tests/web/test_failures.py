"""What a page shows when it cannot start or its scene cannot be loaded: one readable sentence, and no false hopes."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from PIL import Image
from web.pages import Browser, make_splats_page, random_splats, wait_for_message, wait_until
from web.site import Site, drop_file

from hyrfpack.web.player import encode_player

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
PHONE_OPTIONS = {"pixel_ratio": 2.0, "phone": True}
SCENE_FOLDER = Path(__file__).parents[1] / "golden" / "scene"
HTML_DATA = b"\xef\xbb\xbf\n<!doctype html><title>Sorry</title>" * 20


def open_cloud(browser: Browser, host: Site) -> None:
    """Open a cloud in a player, and wait until its picture is complete."""
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready.then(() => hyrfpack.player.settled)")


def is_visible(browser: Browser, name: str) -> bool:
    return browser.evaluate(f"document.getElementById('{name}').checkVisibility({{ visibilityProperty: true }})")


def encode_picture(image_format: str) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, image_format)
    return file.getvalue()


# ---- the invitation to open a file


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=str)
def test_a_failed_load_over_a_poster_shows_one_sentence_and_no_drop_hint(browser: Browser, host: Site, size):
    browser.resize(*size)
    host.files["/index.html"] = encode_player("room", content="gone.hyrf", poster="poster.jpg")
    host.files["/poster.jpg"] = encode_picture("JPEG")
    browser.open(f"{host.address}/index.html")
    assert wait_for_message(browser).startswith("gone.hyrf could not be fetched (404 Not Found); check")
    assert is_visible(browser, "poster") and not is_visible(browser, "invitation")
    drop_file(browser, b"not a scene", "notes.txt")
    wait_until(browser, "document.getElementById('sentence').textContent.startsWith('notes.txt cannot be opened')")
    assert not is_visible(browser, "invitation")


def test_a_page_that_names_no_scene_invites_to_open_one_after_a_failure_too(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?poster=poster.jpg")
    browser.evaluate("hyrfpack.ready")
    assert is_visible(browser, "invitation")
    drop_file(browser, b"not a scene", "notes.txt")
    wait_for_message(browser)
    assert is_visible(browser, "invitation")
    background = browser.evaluate("getComputedStyle(document.getElementById('invitation')).backgroundColor")
    assert float(re.findall(r"[\d.]+", background)[-1]) > 0.85, "the text stands on the poster"


def test_phones_are_asked_to_open_a_file_and_not_to_drop_one(browser: Browser, host: Site):
    words = "document.getElementById('invitation').innerText"
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(words).startswith("Drop a .hyrf, ")
    browser.resize(390, 844, **PHONE_OPTIONS)
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(words).startswith("Open a .hyrf, ") and "here" not in browser.evaluate(words)


def test_an_invalid_content_address_shows_one_sentence_and_no_drop_hint(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=javascript:0&poster=poster.jpg")
    assert wait_for_message(browser).startswith("The content in the address")
    assert not is_visible(browser, "invitation") and not is_visible(browser, "loading")


# ---- pages that cannot start

SHORT_WAIT_JS = (  # CSS delays become short, so that tests need not wait for 8 s
    "addEventListener('DOMContentLoaded', () => document.getAnimations()"
    ".forEach((animation) => { animation.currentTime = 20000; }))"
)


@pytest.mark.parametrize(
    "policy", ["default-src 'self'", "script-src 'self'", "script-src 'self'; style-src 'unsafe-inline'"]
)
def test_a_page_whose_script_is_forbidden_says_that_it_has_not_started(browser: Browser, host: Site, policy: str):
    host.headers = {"Content-Security-Policy": policy}
    with browser.before_every_page(SHORT_WAIT_JS):
        browser.open(f"{host.address}/index.html?content=cloud.spz")
        wait_until(browser, "document.body.innerText.includes('The player has not started')")
    assert is_visible(browser, "stalled") and not is_visible(browser, "loading")
    assert not is_visible(browser, "invitation") and not is_visible(browser, "target")


@pytest.mark.parametrize("cut", ["inside the player's text", "inside the script"])
def test_a_page_that_was_cut_short_says_that_it_has_not_started(browser: Browser, host: Site, cut: str):
    page = make_splats_page(random_splats(50))
    place = page.index(b'id="player">') + 3000 if cut == "inside the player's text" else page.index(b"<script>") + 200
    host.files["/cut.html"] = page[:place]
    with browser.before_every_page(SHORT_WAIT_JS):
        browser.open(f"{host.address}/cut.html")
        wait_until(browser, "document.body.innerText.includes('The player has not started')")
    assert is_visible(browser, "stalled") and not is_visible(browser, "loading")


def test_a_page_that_starts_never_shows_that_it_has_not_started(browser: Browser, host: Site):
    watch = (
        "addEventListener('DOMContentLoaded', () => { window.seen ="
        " [document.getElementById('stalled'), document.getElementById('page').hidden]; })"
    )
    with browser.before_every_page(watch):
        browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate("seen") == [None, False]


@pytest.mark.parametrize(("blocked", "words"), [("script", "forbids the player's script"), ("worker", "worker-src")])
def test_a_policy_that_forbids_a_part_of_the_player_is_named(browser: Browser, host: Site, blocked: str, words: str):
    page = host.files["/index.html"].decode()
    allowed = re.findall(r"'sha256-[^']+'", re.findall(r"script-src ([^;]*)", page)[0])
    scripts = allowed[:1] if blocked == "script" else allowed
    workers = "blob:" if blocked == "script" else "'none'"
    host.headers = {"Content-Security-Policy": f"script-src {' '.join(scripts)}; worker-src {workers}"}
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    assert words in wait_for_message(browser)
    assert not is_visible(browser, "loading")


def test_a_damaged_player_text_is_reported_and_loading_ends(browser: Browser, host: Site):
    page = host.files["/index.html"]
    place = page.index(b'id="player">') + 3000
    host.files["/damaged.html"] = page[:place] + bytes(page[place : place + 400]).swapcase() + page[place + 400 :]
    browser.open(f"{host.address}/damaged.html")
    assert wait_for_message(browser) == "The player in this page is damaged; load the page again."
    assert not is_visible(browser, "loading")


# ---- files that are no scenes

WORDS_BY_OTHER_FILE = {
    "page.hyrf": (HTML_DATA, "it is a web page (HTML) and no scene"),
    "page.ply": (HTML_DATA, "it is a web page (HTML) and no scene"),
    "answer.hyrf": (b'{"message": "Not Found"}', "it is a JSON text"),
    "answer.spz": (b"<?xml version='1.0'?><Error>AccessDenied</Error>", "it is an XML text"),
    "pointer.hyrf": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "pointer to the file in Git LFS"),
    "empty.hyrf": (b"", "it is empty (0 bytes)"),
    "empty.splat": (b"", "it is empty (0 bytes)"),
    "photo.hyrf": (encode_picture("JPEG"), "it is a JPEG picture and no scene"),
    "photo.png": (encode_picture("PNG"), "it is a PNG picture and no scene"),
    "photo.webp": (encode_picture("WEBP"), "it is a WebP picture and no scene"),
    "notes.hyrf": (b"plain text", "it is neither a .hyrf file nor one of .ply, .spz, .splat, .sog"),
}


@pytest.mark.parametrize("name", WORDS_BY_OTHER_FILE)
def test_a_file_that_is_no_scene_is_reported_by_what_it_is(browser: Browser, host: Site, name: str):
    data, words = WORDS_BY_OTHER_FILE[name]
    host.files[f"/{name}"] = data
    browser.open(f"{host.address}/index.html?content={name}")
    message = wait_for_message(browser)
    assert message.startswith(f"{name} cannot be opened: ") and words in message and "\n" not in message


def test_a_page_with_a_model_inside_reports_other_files_by_what_they_are(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf")
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    drop_file(browser, encode_picture("JPEG"), "photo.jpg")
    assert wait_for_message(browser) == "photo.jpg cannot be opened: it is a JPEG picture and no scene."


def test_a_dropped_manifest_of_a_scene_folder_is_recognised(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    drop_file(browser, (SCENE_FOLDER / "scene.json").read_bytes(), "scene.json")
    message = wait_for_message(browser)
    assert message.startswith("scene.json cannot be opened: it is only the list of a scene folder; serve the folder")
    assert "hyrfpack view FOLDER" in message


def test_a_sandboxed_frame_says_that_the_sandbox_forbids_the_request(browser: Browser, host: Site):
    host.files["/around.html"] = (
        b"<!DOCTYPE html><script>window.messages = []; onmessage = ({ data }) => messages.push(data);</script>"
        b'<iframe sandbox="allow-scripts" src="index.html?content=cloud.spz"></iframe>'
    )
    failed = "messages.find(({ hyrf }) => hyrf === 'error')?.message ?? ''"
    browser.open(f"{host.address}/around.html")
    wait_until(browser, f"{failed} !== ''")
    assert "allow-same-origin" in browser.evaluate(failed)
    host.headers = {"Access-Control-Allow-Origin": "*"}
    browser.open(f"{host.address}/around.html")
    wait_until(browser, "messages.some(({ hyrf }) => hyrf === 'load')")


# ---- a worker that fails after the scene is loaded

WORKER_FAILURES_JS = {
    "it cannot handle a message": "player.loader.connection.post({ sort: { ticket: 0 } })",
    "it ends": (
        "player.loader.connection.shared.worker.dispatchEvent(new ErrorEvent('error', { message: 'no memory' }))"
    ),
}


@pytest.mark.parametrize("failure", WORKER_FAILURES_JS)
def test_a_worker_that_fails_is_reported_and_nothing_waits_for_it(browser: Browser, host: Site, failure: str):
    open_cloud(browser, host)
    browser.evaluate(f"void (({{ player }}) => {{ {WORKER_FAILURES_JS[failure]}; }})(hyrfpack)")
    message = wait_for_message(browser)
    assert message.startswith("The player's worker has failed (") and message.endswith("); load the page again.")
    browser.drag((120, 90), (150, 90))
    rejected = "(({ message }) => message)"
    for promise in ("settled", "select([])", "show(hyrfpack.camera())"):
        assert browser.evaluate(f"hyrfpack.player.{promise}.then(() => '', {rejected})") == message, promise
    assert not browser.evaluate("hyrfpack.player.loader.busy")
    drop_file(browser, host.files["/cloud.spz"], "cloud.spz")
    wait_until(browser, "hyrfpack.player.loaded")


def test_an_order_that_a_failed_worker_owes_is_null(browser: Browser, host: Site):
    open_cloud(browser, host)
    expression = (
        "(({ loader, scene, ...player }, view) => { const order = loader.sort(view, scene),"
        " answer = loader.ask({ select: [] }).catch(({ message }) => message);"
        " loader.connection.shared.worker.dispatchEvent(new ErrorEvent('error', { message: 'no memory' }));"
        " return Promise.all([order, answer]); })(hyrfpack.player, hyrfpack.player.view())"
    )
    order, answer = browser.evaluate(expression)
    assert order is None and "no memory" in answer


def test_replies_of_a_failed_worker_are_ignored(browser: Browser, host: Site):
    open_cloud(browser, host)
    expression = (
        "(({ loader, scene }, view) => { const { number, shared: { worker } } = loader.connection,"
        " sort = () => loader.sort(view, scene),"
        " ask = () => loader.ask({ select: [] }).catch(({ message }) => message),"
        " send = (message) => worker.onmessage({ data: { reader: number, ...message } }), pending = [sort(), ask()],"
        " tickets = [...loader.waiting.keys(), ...loader.asked.keys()];"
        " send({ failure: 'no memory' });"
        " send({ order: { ticket: tickets[0] } });"
        " send({ answer: { ticket: tickets[1] } });"
        " send({ content: {} });"
        " return Promise.all([...pending, sort(), ask()]).then((ends) => [...ends, loader.busy]);"
        " })(hyrfpack.player, hyrfpack.player.view())"
    )
    order, answer, later_order, later_answer, busy = browser.evaluate(expression)
    assert order is None and later_order is None and not busy
    assert "no memory" in answer and later_answer == answer
    assert browser.list_errors() == []


FAIL_JS = "dispatchEvent(new ErrorEvent('error', { message: 'no memory' }))"


def test_after_a_failure_of_the_worker_the_error_of_another_file_is_reported(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=some scene.hyrf")
    browser.evaluate("hyrfpack.ready.then(() => hyrfpack.player.settled)")
    browser.evaluate(f"hyrfpack.player.loader.connection.shared.worker.{FAIL_JS}")
    wait_for_message(browser)
    drop_file(browser, b"not a scene", "notes.txt")
    wait_until(browser, "document.getElementById('sentence').textContent.startsWith('notes.txt')")
    message = wait_for_message(browser)
    for promise in ("settled", "show(hyrfpack.camera())"):
        answer = browser.evaluate(f"hyrfpack.player.{promise}.then(() => '', ({{ message }}) => message)")
        assert answer and message == f"notes.txt cannot be opened: {answer}", promise
    browser.evaluate("document.getElementById('views').click()")  # the strip waits for no picture
    assert browser.evaluate("document.getElementById('strip').hidden") is False


def test_a_scene_whose_worker_fails_while_it_is_prepared_is_not_shown(browser: Browser, host: Site):
    open_cloud(browser, host)
    browser.evaluate("void (hyrfpack.player.renderer.prepare = () => new Promise((go) => (window.go = go)))")
    drop_file(browser, host.files["/some scene.hyrf"], "other.hyrf")
    wait_until(browser, "Boolean(window.go)")
    browser.evaluate(f"hyrfpack.player.next.connection.shared.worker.{FAIL_JS}")
    message = wait_for_message(browser)
    assert message.startswith("other.hyrf cannot be opened: The player's worker has failed (no memory)")
    browser.evaluate("(go(), new Promise((done) => setTimeout(done, 300)))")
    assert browser.evaluate("hyrfpack.player.scene.kind") == "splats" and wait_for_message(browser) == message


# ---- progress


def test_the_progress_has_one_word_and_never_falls(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf")
    watch = (
        "addEventListener('DOMContentLoaded', () => { window.shown = [];"
        "  const step = document.getElementById('step');"
        "  new MutationObserver(() => shown.push(step.textContent)).observe(step, { childList: true });"
        "})"
    )
    with browser.before_every_page(watch):
        browser.open(f"{host.address}/index.html")
        browser.evaluate("hyrfpack.ready")
    shown = [re.fullmatch(r"Loading (\d+) %", text) for text in browser.evaluate("shown")]
    assert shown and all(shown), browser.evaluate("shown")
    parts = [int(match[1]) for match in shown]
    assert parts == sorted(parts) and parts[-1] == 100
