"""A headless Chromium, driven over a pipe with the DevTools protocol: no package is needed."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --disable-extensions --disable-default-apps --hide-scrollbars --mute-audio --disable-dev-shm-usage "
    "--remote-debugging-pipe"
).split()
# What the browser itself does with keys hangs on these.
NUMBERS = {"Tab": 9, "Enter": 13, "Escape": 27, "End": 35}
SHIFT = 8
TEXTS = {"Enter": {"text": "\r"}}
SECONDS = 30.0  # that an answer may take


def find() -> str | None:
    """The program, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """A browser with one page.

    Args:
        profile: an empty folder for it.
        flags: further ones.
    """

    name = "chromium"

    def __init__(self, profile: Path, *flags: str) -> None:
        self._number = 0
        self._received = b""
        self.events: deque[dict] = deque(maxlen=1000)
        # The browser reads from descriptor 3 and writes to 4.
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        redirected = f'exec "$0" "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", redirected, find(), *FLAGS, f"--user-data-dir={profile}", *flags, "about:blank"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "HOME": str(profile)},
        )
        os.close(to_browser)
        os.close(from_browser)
        self._session: str | None = None
        self._session = self.call("Target.attachToTarget", targetId=self._page(), flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._session = None
        with contextlib.suppress(OSError, TimeoutError, RuntimeError):
            self.call("Browser.close")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        self._process.kill()
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def _page(self) -> str:
        """The tab that it starts with, once it is there."""
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            for target in self.call("Target.getTargets")["targetInfos"]:
                if target["type"] == "page":
                    return target["targetId"]
            time.sleep(0.05)
        raise TimeoutError("the browser opens no tab")

    def call(self, method: str, **arguments: Any) -> dict:
        """One command of the protocol and its answer; events that come meanwhile are kept in `events`."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": arguments}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        ends = time.monotonic() + SECONDS
        while True:
            answer = self._receive(ends)
            if answer.get("id") != self._number:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']}")
            else:
                return answer["result"]

    def _receive(self, ends: float) -> dict:
        while b"\0" not in self._received:
            if not select.select([self._in], [], [], max(0.0, ends - time.monotonic()))[0]:
                raise TimeoutError("the browser does not answer")
            data = os.read(self._in, 1 << 20)
            if not data:
                raise RuntimeError("the browser has ended")
            self._received += data
        message, _, self._received = self._received.partition(b"\0")
        return json.loads(message)

    def open(self, address: str) -> None:
        """Go to an address and wait until its document is there."""
        self.events.clear()
        self.call("Page.navigate", url="about:blank")  # else a mere change of #... loads nothing
        self.call("Page.navigate", url=address)
        ends = time.monotonic() + SECONDS
        while self.evaluate("location.href === 'about:blank' || document.readyState !== 'complete'"):
            if time.monotonic() > ends:
                raise TimeoutError(f"{address} does not load")
            time.sleep(0.02)

    def evaluate(self, expression: str) -> Any:
        """The value of JavaScript; a promise's when it is fulfilled. Raises RuntimeError with what it throws."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description") or details["text"])
        return answer["result"].get("value")

    def resize(self, width: int, height: int, *, dense: float = 1.0, phone: bool = False) -> None:
        """Give the window a size in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=dense, mobile=phone
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """A mouse event: mousePressed, mouseReleased, mouseMoved or mouseWheel."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left", steps: int = 4) -> None:
        """Drag from one place to another."""
        buttons = {"left": 1, "right": 2}[button]
        self.mouse("mousePressed", *start, button=button, buttons=buttons, clickCount=1)
        for step in range(1, steps + 1):
            place = [a + (b - a) * step / steps for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *place, button=button, buttons=buttons)
        self.mouse("mouseReleased", *end, button=button, clickCount=1)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """A touch event: touchStart, touchMove or touchEnd, with all fingers that are down."""
        fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    def prefer(self, scheme: str = "light", *, less_motion: bool = False) -> None:
        """What the person's system asks of pages: a colour scheme, and movement or not."""
        motion = "reduce" if less_motion else "no-preference"
        wishes = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}
        features = [{"name": name, "value": value} for name, value in wishes.items()]
        self.call("Emulation.setEmulatedMedia", features=features)

    def press(self, key: str, seconds: float = 0.0, *, shift: bool = False) -> None:
        """Press a key, letter or name, for so long."""
        code = f"Key{key.upper()}" if len(key) == 1 and key.isalpha() else key
        number = NUMBERS.get(key, ord(key.upper()) if len(key) == 1 else 0)
        which = {"key": key, "code": code, "windowsVirtualKeyCode": number, **TEXTS.get(key, {})}
        which["modifiers"] = SHIFT if shift else 0
        held = {"key": "Shift", "code": "ShiftLeft", "windowsVirtualKeyCode": 16}
        if shift:
            self.call("Input.dispatchKeyEvent", type="keyDown", **held, modifiers=SHIFT)
        self.call("Input.dispatchKeyEvent", type="keyDown", **which)
        time.sleep(seconds)
        self.call("Input.dispatchKeyEvent", type="keyUp", **which)
        if shift:
            self.call("Input.dispatchKeyEvent", type="keyUp", **held)

    @contextlib.contextmanager
    def before_every_page(self, script: str) -> Iterator[None]:
        """Inside, a script runs before those of the pages that are opened; its names are its own."""
        added = self.call("Page.addScriptToEvaluateOnNewDocument", source=f"{{{script}\n}}")["identifier"]
        try:
            yield
        finally:
            self.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added)

    def screenshot(self) -> bytes:
        """PNG of the window."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def complaints(self) -> list[str]:
        """What the page has complained about since it was opened: errors, refused loads, exceptions."""
        self.call("Runtime.evaluate", expression="0")  # what came before this has arrived
        found = []
        for event in self.events:
            details = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(str(details["exceptionDetails"].get("exception", {}).get("description")))
            elif event.get("method") == "Log.entryAdded" and details["entry"]["level"] == "error":
                found.append(details["entry"]["text"])
            elif event.get("method") == "Runtime.consoleAPICalled" and details["type"] in ("error", "warning"):
                found.append(str(details["args"]))
        return found
