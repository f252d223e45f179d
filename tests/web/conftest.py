"""The browsers that pages are looked at in."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from web.pages import Browser

from tools.browser import chromium, firefox

WINDOW = (240, 180)
BROWSERS = ["chromium", "firefox"]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of files that are marked `in_turn` run in one browser each, and in both with HYRFPACK_BROWSERS=all."""
    if os.environ.get("HYRFPACK_BROWSERS") == "all" or None in (chromium.find(), firefox.find()):
        return
    left = {item for item in items if _is_anothers_turn(item)}
    config.hook.pytest_deselected(items=list(left))
    items[:] = [item for item in items if item not in left]


def _is_anothers_turn(item: pytest.Item) -> bool:
    if item.get_closest_marker("in_turn") is None or not isinstance(item, pytest.Function):
        return False
    given = item.callspec.params if hasattr(item, "callspec") else {}
    if "browser" not in given:
        return False
    others = sorted(str(value) for name, value in given.items() if name != "browser")
    turn = zlib.crc32("".join([item.originalname, *others]).encode())
    return BROWSERS[turn % len(BROWSERS)] != given["browser"]


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


@pytest.fixture(params=BROWSERS)
def browser(request: pytest.FixtureRequest, started: Callable[[str], Browser]) -> Browser:
    """A browser; each test runs in every one there is, but see the mark `in_turn`."""
    return started(request.param)


@pytest.fixture
def one_browser(started: Callable[[str], Browser]) -> Browser:
    """Chromium alone, for what is slow or the same in all browsers."""
    return started("chromium")
