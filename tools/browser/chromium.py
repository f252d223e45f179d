"""Drive a headless Chromium over a pipe with the DevTools protocol, without any Python package."""

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

PROGRAM_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
LAUNCH_FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --disable-extensions --disable-default-apps --hide-scrollbars --mute-audio --disable-dev-shm-usage "
    "--remote-debugging-pipe"
).split()
# The browser's own reactions to keys depend on these codes.
WINDOWS_KEY_CODES = {"Tab": 9, "Enter": 13, "Escape": 27, "End": 35}
SHIFT_MODIFIER = 8
KEY_TEXTS = {"Enter": {"text": "\r"}}
TIMEOUT_SECONDS = 30.0  # time limit for each answer of the browser


def find() -> str | None:
    """Return the path of the installed browser, or None."""
    return next(filter(None, map(shutil.which, PROGRAM_NAMES)), None)


class Chromium:
    """A running browser with one page.

    Args:
        profile: an empty folder for the browser's profile.
        flags: further command-line flags.
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
            ["bash", "-c", redirected, find(), *LAUNCH_FLAGS, f"--user-data-dir={profile}", *flags, "about:blank"],
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
        """Wait for the browser's first tab and return its target id."""
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while time.monotonic() < deadline:
            for target in self.call("Target.getTargets")["targetInfos"]:
                if target["type"] == "page":
                    return target["targetId"]
            time.sleep(0.05)
        raise TimeoutError("the browser did not open a tab in time")

    def call(self, method: str, **arguments: Any) -> dict:
        """Send one command of the protocol and return its result; events before the answer go to `events`."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": arguments}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while True:
            answer = self._receive(deadline)
            if answer.get("id") != self._number:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']}")
            else:
                return answer["result"]

    def _receive(self, deadline: float) -> dict:
        while b"\0" not in self._received:
            if not select.select([self._in], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError("the browser did not answer in time")
            data = os.read(self._in, 1 << 20)
            if not data:
                raise RuntimeError("the browser has ended")
            self._received += data
        message, _, self._received = self._received.partition(b"\0")
        return json.loads(message)

    def open(self, address: str) -> None:
        """Open an address and wait until its document is loaded."""
        self.events.clear()
        self.call("Page.navigate", url="about:blank")  # a change of the fragment alone would not reload
        self.call("Page.navigate", url=address)
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while self.evaluate("location.href === 'about:blank' || document.readyState !== 'complete'"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{address} did not load in time")
            time.sleep(0.02)

    def evaluate(self, expression: str) -> Any:
        """Evaluate JavaScript and return its value; a promise is awaited.

        Raises:
            RuntimeError: the script throws an exception, whose text is the message.
        """
        answer = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description") or details["text"])
        return answer["result"].get("value")

    def resize(self, width: int, height: int, *, dense: float = 1.0, phone: bool = False) -> None:
        """Set the window's size in CSS pixels; `dense` is the device pixel ratio, `phone` emulates a touch screen."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=dense, mobile=phone
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send a mouse event: mousePressed, mouseReleased, mouseMoved or mouseWheel."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left", steps: int = 4) -> None:
        """Drag the mouse from one point to another, in CSS pixels."""
        buttons = {"left": 1, "right": 2}[button]
        self.mouse("mousePressed", *start, button=button, buttons=buttons, clickCount=1)
        for step in range(1, steps + 1):
            point = [a + (b - a) * step / steps for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *point, button=button, buttons=buttons)
        self.mouse("mouseReleased", *end, button=button, clickCount=1)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send a touch event (touchStart, touchMove or touchEnd) with the points of all fingers that are down."""
        fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    def prefer(self, scheme: str = "light", *, less_motion: bool = False) -> None:
        """Emulate the user's preferences for a colour scheme and for reduced motion."""
        motion = "reduce" if less_motion else "no-preference"
        wishes = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}
        features = [{"name": name, "value": value} for name, value in wishes.items()]
        self.call("Emulation.setEmulatedMedia", features=features)

    def press(self, key: str, seconds: float = 0.0, *, shift: bool = False) -> None:
        """Press a key, given as a letter or a key name, and release it after `seconds`."""
        code = f"Key{key.upper()}" if len(key) == 1 and key.isalpha() else key
        number = WINDOWS_KEY_CODES.get(key, ord(key.upper()) if len(key) == 1 else 0)
        which = {"key": key, "code": code, "windowsVirtualKeyCode": number, **KEY_TEXTS.get(key, {})}
        which["modifiers"] = SHIFT_MODIFIER if shift else 0
        held = {"key": "Shift", "code": "ShiftLeft", "windowsVirtualKeyCode": 16}
        if shift:
            self.call("Input.dispatchKeyEvent", type="keyDown", **held, modifiers=SHIFT_MODIFIER)
        self.call("Input.dispatchKeyEvent", type="keyDown", **which)
        time.sleep(seconds)
        self.call("Input.dispatchKeyEvent", type="keyUp", **which)
        if shift:
            self.call("Input.dispatchKeyEvent", type="keyUp", **held)

    @contextlib.contextmanager
    def before_every_page(self, script: str) -> Iterator[None]:
        """Within this context, run a script before the scripts of every opened page; its variables are local."""
        added = self.call("Page.addScriptToEvaluateOnNewDocument", source=f"{{{script}\n}}")["identifier"]
        try:
            yield
        finally:
            self.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added)

    def screenshot(self) -> bytes:
        """Return a PNG of the window."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def list_errors(self) -> list[str]:
        """Return the errors of the page since it was opened: console errors and warnings, refused loads, exceptions."""
        self.call("Runtime.evaluate", expression="0")  # all earlier events arrive before this answer
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
