"""The browsers that pages are looked at in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from web.pages import Browser

from tools.browser import chromium, firefox

WINDOW = (240, 180)


@pytest.fixture(scope="session")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Browser]]:
    """Gives a browser by its name, with a small window; it is started once and serves all tests."""
    running: dict[str, Browser] = {}

    with ExitStack() as stack:

        def start(name: str) -> Browser:
            if name not in running:
                if name == "chromium":
                    if chromium.find() is None:
                        pytest.skip("there is no Chromium here")
                    running[name] = stack.enter_context(chromium.Chromium(tmp_path_factory.mktemp("profile")))
                else:
                    if firefox.find() is None:
                        pytest.skip("there is no Firefox here, or no Xvfb for it to draw on")
                    running[name] = stack.enter_context(firefox.Firefox(tmp_path_factory.mktemp("profile")))
            running[name].resize(*WINDOW)
            return running[name]

        yield start


@pytest.fixture(params=["chromium", "firefox"])
def browser(request: pytest.FixtureRequest, started: Callable[[str], Browser]) -> Browser:
    """A browser; each test runs in every one there is."""
    return started(request.param)


@pytest.fixture
def one_browser(started: Callable[[str], Browser]) -> Browser:
    """Chromium alone, for what is slow or the same in all browsers."""
    return started("chromium")
