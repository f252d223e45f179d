"""The page of a training: each newer snapshot is shown from where the viewer stands."""

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
from web.pages import Browser, eye, message, rested, settled, until

from hyrfpack.format import encode_model
from hyrfpack.model import Frame
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import MemoryFile, serve_in_thread

pytestmark = pytest.mark.in_turn
COUNT = "window.hyrfpack?.player?.loaded && hyrfpack.player.scene.count"
REMARK = "document.getElementById('remark').textContent"


def snapshot(count: int, scale: float = 1.0, exposure: ExposureMap | None = None) -> bytes:
    """A model of so many Gaussians; those of a smaller one are the first ones of a larger one."""
    positions = np.random.default_rng(0).normal(size=(100, 3))[:count] * 0.3
    model = small_model(positions, frame=Frame((0.0, 0.0, 0.0), scale, (1.0, 1.0, 1.0)))
    model.exposure = exposure
    return encode_model(model)


class Training:
    """A training whose snapshots a test gives."""

    def __init__(self) -> None:
        self.scene, self.updates, self.count = MemoryFile(b""), MemoryFile(b""), -1
        self.tell(0)

    def tell(self, step: int) -> None:
        self.count += 1
        self.updates.replace(json.dumps({"snapshot": self.count, "step": step, "steps": 3000}).encode())

    def show(self, data: bytes, step: int) -> None:
        self.scene.replace(data)
        self.tell(step)


@contextmanager
def trained(browser: Browser, *first: tuple[bytes, int]) -> Iterator[tuple[Training, Callable[[], None]]]:
    """A training whose page is open, and what ends it."""
    training = Training()
    for data, step in first:
        training.show(data, step)
    page = encode_player("fern", content="scene.hyrf", updates="training.json", fetches="'self'")
    with ExitStack() as server:
        files = {"scene.hyrf": training.scene, "training.json": training.updates}
        browser.open(server.enter_context(serve_in_thread(page, files)))
        yield training, server.close


def test_the_page_waits_for_the_first_step_and_says_so(browser: Browser):
    with trained(browser) as (training, _):
        until(browser, f"{REMARK} === 'The training has not taken its first step yet.'")
        training.show(snapshot(20), 1)
        until(browser, f"{COUNT} === 20")
        until(browser, "document.title === 'fern, step 1 of 3,000'")
        assert browser.evaluate(REMARK) == "" and browser.list_errors() == []


def test_a_newer_snapshot_takes_the_place_of_the_one_before_and_the_camera_stays(browser: Browser):
    browser.prefer(less_motion=True)
    with trained(browser, (snapshot(20), 1)) as (training, _):
        until(browser, f"{COUNT} === 20")
        home = eye(browser)
        rested(browser).drag((120, 90), (170, 100))
        before = eye(settled(browser))
        assert not np.allclose(before.camera_from_world, home.camera_from_world, atol=1e-3)
        picture = browser.screenshot()
        browser.evaluate("(window.seen = [], new MutationObserver(() => seen.push(loading.hidden)))"
                         ".observe(document.getElementById('loading'), { attributes: true })")  # fmt: skip

        training.show(snapshot(60), 1200)
        until(browser, f"{COUNT} === 60")
        until(browser, "document.title === 'fern, step 1,200 of 3,000'")
        np.testing.assert_array_equal(eye(settled(browser)).camera_from_world, before.camera_from_world)
        assert browser.evaluate("document.getElementById('count').textContent") == "hybrid field, 60 Gaussians"
        assert browser.screenshot() != picture
        assert browser.evaluate("window.seen") == []  # no progress bar comes and goes
        assert browser.list_errors() == []
    browser.prefer()


def test_a_training_in_another_frame_is_looked_at_anew(browser: Browser):
    with trained(browser, (snapshot(20), 1)) as (training, _):
        until(browser, f"{COUNT} === 20")
        before = eye(browser).position
        training.show(snapshot(30, scale=7.0), 2)
        until(browser, f"{COUNT} === 30")
        assert np.linalg.norm(eye(browser).position) == pytest.approx(7 * np.linalg.norm(before), rel=1e-6)


def test_a_snapshot_brings_the_exposure_map_and_its_control(browser: Browser):
    exposure = random_map(3, 8)
    control = "!document.getElementById('exposure').hidden"
    with trained(browser, (snapshot(20), 1)) as (training, _):
        until(browser, f"{COUNT} === 20")
        assert not browser.evaluate(control)
        training.show(snapshot(30, exposure=exposure), 2)
        until(browser, f"{COUNT} === 30")
        camera = eye(settled(browser))
        assert browser.evaluate(control)
        gains = browser.evaluate("hyrfpack.player.gains(hyrfpack.player.view())")
        np.testing.assert_allclose(
            gains, np.exp(exposure.predict_log_gains(camera.position, camera.forward)), rtol=1e-9
        )
        training.show(snapshot(40), 3)
        until(browser, f"{COUNT} === 40")
        assert not browser.evaluate(control)


def test_a_snapshot_that_cannot_be_read_leaves_the_one_before(browser: Browser):
    with trained(browser, (snapshot(20), 1)) as (training, _):
        until(browser, f"{COUNT} === 20")
        training.show(snapshot(60)[:-40], 2)
        time.sleep(3)
        assert browser.evaluate(COUNT) == 20 and browser.evaluate("document.getElementById('message').hidden")
        training.show(snapshot(40), 3)
        until(browser, f"{COUNT} === 40")


def test_the_last_snapshot_stays_when_the_training_ends_and_the_page_says_so(browser: Browser):
    with trained(browser, (snapshot(20), 3000)) as (_, end):
        until(browser, f"{COUNT} === 20")
        end()
        until(browser, f"{REMARK}.startsWith('The training does not answer any more')", seconds=30)
        assert browser.evaluate(COUNT) == 20
        browser.drag((120, 90), (170, 100))
        settled(browser)


def test_a_first_snapshot_that_cannot_be_read_is_said_in_a_sentence(browser: Browser):
    with trained(browser, (snapshot(20)[:-40], 1)):
        assert "scene.hyrf cannot be opened" in message(browser)


OPENED = """(() => {
    const chosen = new DataTransfer(), input = document.getElementById("file");
    const bytes = Uint8Array.from(atob("%s"), (letter) => letter.charCodeAt(0));
    chosen.items.add(new File([bytes], "other.hyrf"));
    input.files = chosen.files;
    input.dispatchEvent(new Event("change"));
})()"""


@pytest.mark.parametrize("begun", [False, True], ids=["before the first step", "after it"])
def test_a_file_that_a_person_opens_is_not_replaced_by_a_newer_snapshot(begun, browser: Browser):
    with trained(browser, *([(snapshot(20), 1)] if begun else [])) as (training, _):
        until(browser, f"{COUNT} === 20" if begun else f"{REMARK} !== ''")
        browser.evaluate(OPENED % base64.b64encode(snapshot(50)).decode())
        until(browser, f"{COUNT} === 50")
        training.show(snapshot(60), 2)
        time.sleep(5)
        assert browser.evaluate(COUNT) == 50 and browser.evaluate("document.title") == "other"
