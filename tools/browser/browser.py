"""The interface of a driven browser with one page, which `Chromium` and `Firefox` implement."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any

TIMEOUT_SECONDS = 60.0  # time limit for loading a page and for a promise of it


class Browser(ABC):
    """A running browser with one page. Positions and sizes are in CSS pixels, from the window's top left corner."""

    name: str

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """End the browser."""

    @abstractmethod
    def open(self, address: str) -> None:
        """Open an address and wait until its document is loaded."""

    @abstractmethod
    def evaluate(self, expression: str) -> Any:
        """Evaluate a JavaScript expression and return its value; a promise is awaited.

        Raises:
            RuntimeError: the script throws an exception, whose text is the message.
        """

    @abstractmethod
    def resize(self, width: int, height: int, *, pixel_ratio: float = 1.0, phone: bool = False) -> None:
        """Set the window's size; `pixel_ratio` is that of the device, `phone` emulates a touch screen."""

    @abstractmethod
    def move(self, x: float, y: float) -> None:
        """Move the mouse."""

    @abstractmethod
    def button_down(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        """Move the mouse and press a button, "left" or "right"; `clicks` is 2 for the second of a double click."""

    @abstractmethod
    def button_up(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        """Move the mouse and release a button."""

    @abstractmethod
    def wheel(self, x: float, y: float, delta: float) -> None:
        """Turn the mouse's wheel by `delta` pixels; positive values scroll down."""

    def click(self, x: float, y: float, count: int = 1) -> None:
        """Click with the left button, `count` times."""
        for clicks in range(1, count + 1):
            self.button_down(x, y, clicks=clicks)
            self.button_up(x, y, clicks=clicks)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left", steps: int = 4) -> None:
        """Drag the mouse from one point to another."""
        self.button_down(*start, button)
        for step in range(1, steps + 1):
            self.move(*(a + (b - a) * step / steps for a, b in zip(start, end, strict=True)))
        self.button_up(*end, button)

    @abstractmethod
    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send a touch event, of kind "touchStart", "touchMove" or "touchEnd".

        Args:
            kind: the kind of the event.
            points: the positions of all fingers that are down after it.
        """

    @abstractmethod
    def prefer(self, scheme: str = "light", *, reduced_motion: bool = False) -> None:
        """Emulate the user's preferences for a colour scheme and for reduced motion."""

    @abstractmethod
    def press(self, key: str, seconds: float = 0.0, *, shift: bool = False) -> None:
        """Press a key, given as a letter or a name such as "ArrowLeft", and release it after `seconds`."""

    @abstractmethod
    def before_every_page(self, script: str) -> contextlib.AbstractContextManager[None]:
        """Within this context, run a script before the scripts of every opened page; its variables are local."""

    @abstractmethod
    def screenshot(self) -> bytes:
        """Return a PNG of the window."""

    @abstractmethod
    def list_errors(self) -> list[str]:
        """Return the errors of the page since it was opened: console errors and warnings, refused loads, exceptions."""
