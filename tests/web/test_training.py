"""The page of a training run shows each newer snapshot from the current camera."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from exposures import random_map
from scenes import small_model
from web.pages import Browser, wait_for_message, wait_until, wait_until_at_rest, wait_until_still, window_camera

from hyrfpack.format import encode_model
from hyrfpack.model import Frame
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import MemoryFile, serve_in_thread

pytestmark = pytest.mark.in_turn
LOADED_COUNT_JS = "window.hyrfpack?.player?.loaded && hyrfpack.player.scene.count"
REMARK_TEXT_JS = "document.getElementById('remark').textContent"


def encode_snapshot(count: int, scale: float = 1.0, exposure: ExposureMap | None = None) -> bytes:
    """Encode a model of `count` Gaussians, which are the first ones of every larger model."""
    positions = np.random.default_rng(0).normal(size=(100, 3))[:count] * 0.3
    model = small_model(positions, frame=Frame((0.0, 0.0, 0.0), scale, (1.0, 1.0, 1.0)))
    model.exposure = exposure
    return encode_model(model)


class FakeTraining:
    """The served state of a training run, whose snapshots a test sets."""

    def __init__(self) -> None:
        self.scene, self.updates, self.count = MemoryFile(b""), MemoryFile(b""), -1
        self.set_step(0)

    def set_step(self, step: int, kind: str = "") -> None:
        self.count += 1
        self.updates.replace(json.dumps({"snapshot": self.count, "step": step, "steps": 3000, "kind": kind}).encode())

    def show(self, data: bytes, step: int, kind: str = "") -> None:
        self.scene.replace(data)
        self.set_step(step, kind)


@contextmanager
def open_training_page(
    browser: Browser, *first: tuple[bytes, int]
) -> Iterator[tuple[FakeTraining, Callable[[], None]]]:
    """Open the page of a training run; yield the run and a function that ends it."""
    training = FakeTraining()
    for data, step in first:
        training.show(data, step)
    page = encode_player("fern", content="scene.hyrf", updates="training.json", fetches="'self'")
    with ExitStack() as server:
        files = {"scene.hyrf": training.scene, "training.json": training.updates}
        browser.open(server.enter_context(serve_in_thread(page, files)))
        yield training, server.close


def test_the_page_reports_that_it_waits_for_the_first_step(browser: Browser):
    with open_training_page(browser) as (training, _):
        wait_until(browser, f"{REMARK_TEXT_JS} === 'The training has not taken its first step yet.'")
        training.show(encode_snapshot(20), 1, kind="first look")
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        wait_until(browser, "document.title === 'fern, first look, step 1 of 3,000'")
        assert browser.evaluate(REMARK_TEXT_JS) == "" and browser.list_errors() == []


def test_a_newer_snapshot_replaces_the_previous_one_and_keeps_the_camera(browser: Browser):
    browser.prefer(reduced_motion=True)
    with open_training_page(browser, (encode_snapshot(20), 1)) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        home = window_camera(browser)
        wait_until_at_rest(browser).drag((120, 90), (170, 100))
        before = window_camera(wait_until_still(browser))
        assert not np.allclose(before.camera_from_world, home.camera_from_world, atol=1e-3)
        picture = browser.screenshot()
        browser.evaluate("(window.changes = [], new MutationObserver(() => changes.push(loading.hidden)))"
                         ".observe(document.getElementById('loading'), { attributes: true })")  # fmt: skip

        training.show(encode_snapshot(60), 1200)
        wait_until(browser, f"{LOADED_COUNT_JS} === 60")
        wait_until(browser, "document.title === 'fern, step 1,200 of 3,000'")
        np.testing.assert_array_equal(
            window_camera(wait_until_still(browser)).camera_from_world, before.camera_from_world
        )
        assert browser.evaluate("document.getElementById('count').textContent") == "hybrid field, 60 Gaussians"
        assert browser.screenshot() != picture
        assert browser.evaluate("window.changes") == []  # the progress bar has not appeared
        assert browser.list_errors() == []
    browser.prefer()


def test_a_snapshot_in_another_frame_resets_the_camera(browser: Browser):
    with open_training_page(browser, (encode_snapshot(20), 1)) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        before = window_camera(browser).position
        training.show(encode_snapshot(30, scale=7.0), 2)
        wait_until(browser, f"{LOADED_COUNT_JS} === 30")
        assert np.linalg.norm(window_camera(browser).position) == pytest.approx(7 * np.linalg.norm(before), rel=1e-6)


def test_a_snapshot_with_an_exposure_map_shows_its_control(browser: Browser):
    exposure = random_map(3, 8)
    control = "!document.getElementById('exposure').hidden"
    with open_training_page(browser, (encode_snapshot(20), 1)) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        assert not browser.evaluate(control)
        training.show(encode_snapshot(30, exposure=exposure), 2)
        wait_until(browser, f"{LOADED_COUNT_JS} === 30")
        camera = window_camera(wait_until_still(browser))
        assert browser.evaluate(control)
        gains = browser.evaluate("hyrfpack.player.exposureOf(hyrfpack.player.view()).gains")
        np.testing.assert_allclose(
            gains, np.exp(exposure.predict_log_gains(camera.position, camera.forward)), rtol=1e-9
        )
        training.show(encode_snapshot(40), 3)
        wait_until(browser, f"{LOADED_COUNT_JS} === 40")
        assert not browser.evaluate(control)


def test_an_unreadable_snapshot_keeps_the_previous_one(browser: Browser):
    with open_training_page(browser, (encode_snapshot(20), 1)) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        training.show(encode_snapshot(60)[:-40], 2)
        time.sleep(3)
        assert browser.evaluate(LOADED_COUNT_JS) == 20 and browser.evaluate("document.getElementById('message').hidden")
        training.show(encode_snapshot(40), 3)
        wait_until(browser, f"{LOADED_COUNT_JS} === 40")


def test_the_last_snapshot_stays_and_the_page_reports_the_end_of_training(browser: Browser):
    with open_training_page(browser, (encode_snapshot(20), 3000)) as (_, end):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20")
        end()
        wait_until(browser, f"{REMARK_TEXT_JS}.startsWith('The training no longer answers')", seconds=30)
        assert browser.evaluate(LOADED_COUNT_JS) == 20
        browser.drag((120, 90), (170, 100))
        wait_until_still(browser)


def test_a_training_that_ends_before_its_first_step_is_reported(browser: Browser):
    with open_training_page(browser) as (_, end):
        wait_until(browser, f"{REMARK_TEXT_JS} !== ''")
        end()
        sentence = "The training ended before its first step; see its terminal."
        wait_until(browser, f"document.getElementById('sentence').textContent === '{sentence}'", seconds=30)
        assert browser.evaluate("hyrfpack.ready.then(() => '', ({ message }) => message)") == sentence
        assert browser.evaluate(REMARK_TEXT_JS) == "" and browser.evaluate("document.getElementById('loading').hidden")


def test_an_unreadable_first_snapshot_is_reported(browser: Browser):
    with open_training_page(browser, (encode_snapshot(20)[:-40], 1)):
        assert "scene.hyrf cannot be opened" in wait_for_message(browser)


OPEN_FILE_JS = """(() => {
    const chosen = new DataTransfer(), input = document.getElementById("file");
    const bytes = Uint8Array.from(atob("%s"), (letter) => letter.charCodeAt(0));
    chosen.items.add(new File([bytes], "other.hyrf"));
    input.files = chosen.files;
    input.dispatchEvent(new Event("change"));
})()"""


@pytest.mark.parametrize("begun", [False, True], ids=["before the first step", "after it"])
def test_a_file_opened_by_the_user_is_not_replaced_by_a_newer_snapshot(begun, browser: Browser):
    with open_training_page(browser, *([(encode_snapshot(20), 1)] if begun else [])) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20" if begun else f"{REMARK_TEXT_JS} !== ''")
        browser.evaluate(OPEN_FILE_JS % base64.b64encode(encode_snapshot(50)).decode())
        wait_until(browser, f"{LOADED_COUNT_JS} === 50")
        training.show(encode_snapshot(60), 2)
        time.sleep(5)
        assert browser.evaluate(LOADED_COUNT_JS) == 50 and browser.evaluate("document.title") == "other"


DROP_STALLED_FILE_JS = """(() => {
    const start = (controller) => (window.failFile = () => controller.error(new Error("the disk is gone")));
    const file = Object.assign(new File(["0123"], "other.hyrf"), { stream: () => new ReadableStream({ start }) });
    const event = new Event("drop", { cancelable: true });
    dispatchEvent(Object.assign(event, { dataTransfer: { types: ["Files"], files: [file] } }));
})()"""


@pytest.mark.parametrize("begun", [False, True], ids=["before the first step", "after it"])
def test_newer_snapshots_are_shown_again_after_a_file_that_loaded_long_has_failed(begun: bool, browser: Browser):
    with open_training_page(browser, *([(encode_snapshot(20), 1)] if begun else [])) as (training, _):
        wait_until(browser, f"{LOADED_COUNT_JS} === 20" if begun else f"{REMARK_TEXT_JS} !== ''")
        browser.evaluate(DROP_STALLED_FILE_JS)
        training.show(encode_snapshot(60), 2)
        time.sleep(5)  # the page requests the progress meanwhile
        assert browser.evaluate(LOADED_COUNT_JS) == (20 if begun else False)
        browser.evaluate("failFile()")
        wait_until(browser, f"{LOADED_COUNT_JS} === 60")
        assert browser.evaluate("document.title") == "fern, step 2 of 3,000"
