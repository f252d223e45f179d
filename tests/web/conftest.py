"""Start the browsers in which pages are tested."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from web.site import Site, serve_player

from tools.browser import chromium, firefox
from tools.browser.browser import Browser

WINDOW_SIZE = (240, 180)
WEB_FOLDER = Path(__file__).parent
BROWSER_NAMES = ["chromium", "firefox"]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run each test marked `in_turn` in one browser only, unless HYRFPACK_BROWSERS=all, and tests of the player first.

    The first of several parallel processes then runs all of these, and only it has to start browsers.
    """
    items.sort(key=lambda item: not item.path.is_relative_to(WEB_FOLDER))
    if os.environ.get("HYRFPACK_BROWSERS") == "all" or None in (chromium.find_program(), firefox.find_program()):
        return
    left = {item for item in items if _is_turn_of_another_browser(item)}
    config.hook.pytest_deselected(items=list(left))
    items[:] = [item for item in items if item not in left]


def _is_turn_of_another_browser(item: pytest.Item) -> bool:
    if item.get_closest_marker("in_turn") is None or not isinstance(item, pytest.Function):
        return False
    given = item.callspec.params if hasattr(item, "callspec") else {}
    if "browser" not in given:
        return False
    others = sorted(str(value) for name, value in given.items() if name != "browser")
    turn = zlib.crc32("".join([item.originalname, *others]).encode())
    return BROWSER_NAMES[turn % len(BROWSER_NAMES)] != given["browser"]


@pytest.fixture(scope="session")
def start_browser() -> Iterator[Callable[[str], Browser]]:
    """Return a function that returns a running browser by name, with a small window; all tests share it."""
    running: dict[str, Browser] = {}

    with ExitStack() as stack:

        def start(name: str) -> Browser:
            if name not in running:
                if name == "chromium":
                    if chromium.find_program() is None:
                        pytest.skip("there is no Chromium here, or no Playwright to drive it")
                    running[name] = stack.enter_context(chromium.Chromium())
                else:
                    if firefox.find_program() is None:
                        pytest.skip("there is no Firefox here, or no Xvfb for it to draw on")
                    running[name] = stack.enter_context(firefox.Firefox())
            running[name].resize(*WINDOW_SIZE)
            return running[name]

        yield start


@pytest.fixture(params=BROWSER_NAMES)
def browser(request: pytest.FixtureRequest, start_browser: Callable[[str], Browser]) -> Browser:
    """Run the test in every installed browser, or in one of them if it is marked `in_turn`."""
    return start_browser(request.param)


@pytest.fixture
def one_browser(start_browser: Callable[[str], Browser]) -> Browser:
    """Return Chromium, for tests that are slow or do not depend on the browser."""
    return start_browser("chromium")


@pytest.fixture
def host() -> Iterator[Site]:
    """Yield a server that has a player and two files."""
    with serve_player() as server_state:
        yield server_state


@pytest.fixture
def reset_window(browser: Browser) -> Iterator[None]:
    """Reset the window size and the user's preferences after each test."""
    yield
    browser.resize(*WINDOW_SIZE)
    browser.prefer()
