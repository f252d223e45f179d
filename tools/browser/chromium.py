"""Drive an installed Chromium with Playwright, which downloads no browser of its own."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import importlib.util
import shutil
import threading
import time
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tools.browser.browser import TIMEOUT_SECONDS, Browser

if TYPE_CHECKING:
    from playwright.async_api import Browser as ChromiumBrowser
    from playwright.async_api import ConsoleMessage, Playwright

Result = TypeVar("Result")
# WebGPU in software (SwiftShader). Without the last three, WebGL cannot read what WebGPU has drawn.
WEBGPU_FLAGS = (
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
    "--use-angle=swiftshader",
)
SCREENCAST_SIZE = {"maxWidth": 640, "maxHeight": 400}  # pixels
PROGRAM_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find_program() -> str | None:
    """Return the path of the installed browser; None if it or Playwright is missing."""
    if importlib.util.find_spec("playwright") is None:
        return None
    return next(filter(None, map(shutil.which, PROGRAM_NAMES)), None)


class Chromium(Browser):
    """A running Chromium with an empty profile.

    Playwright runs in a thread of its own, since it keeps an event loop running there: asyncio stays usable for others.

    Args:
        flags: further command-line flags.
        timeout_seconds: time limit for loading a page and for each answer of it.
    """

    name = "chromium"

    def __init__(self, *flags: str, timeout_seconds: float = TIMEOUT_SECONDS) -> None:
        self._timeout_seconds = timeout_seconds
        self._errors: list[str] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._playwright: Playwright | None = None
        self._browser: ChromiumBrowser | None = None
        try:
            self._wait(self._start(flags))
        except BaseException:
            with contextlib.suppress(Exception):
                self.close()
            raise

    async def _start(self, flags: tuple[str, ...]) -> None:
        from playwright.async_api import async_playwright

        self._playwright = await async_playwright().start()
        args = ["--disable-quic", *flags]
        self._browser = await self._playwright.chromium.launch(executable_path=find_program(), args=args)
        self._page = await self._browser.new_page(no_viewport=True)  # `resize` sets the viewport
        self._devtools = await self._page.context.new_cdp_session(self._page)
        self._page.on("console", self._collect_message)
        self._page.on("pageerror", lambda error: self._errors.append(str(error)))

    def _wait(self, call: Coroutine[Any, Any, Result]) -> Result:
        """Return the result of a call of Playwright.

        Raises:
            TimeoutError: it takes longer than `timeout_seconds`.
        """
        return asyncio.run_coroutine_threadsafe(call, self._loop).result(self._timeout_seconds)

    def _collect_message(self, message: ConsoleMessage) -> None:
        # Warnings of the browser itself have no arguments, unlike those of scripts.
        if message.type == "error" or (message.type == "warning" and message.args):
            self._errors.append(message.text)

    def close(self) -> None:
        try:
            if self._browser is not None:
                self._wait(self._browser.close())
            if self._playwright is not None:
                self._wait(self._playwright.stop())
        finally:
            self._stop_loop()

    def _stop_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def open(self, address: str) -> None:
        self._wait(self._page.goto("about:blank"))  # a change of the fragment alone would not reload
        self._errors.clear()
        self._wait(self._page.goto(address, timeout=1000 * self._timeout_seconds))

    def evaluate(self, expression: str) -> Any:
        from playwright.async_api import Error

        try:
            return self._wait(self._page.evaluate(expression))
        except Error as error:
            raise RuntimeError(str(error)) from error

    def resize(self, width: int, height: int, *, pixel_ratio: float = 1.0, phone: bool = False) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": pixel_ratio, "mobile": phone}
        self._wait(self._devtools.send("Emulation.setDeviceMetricsOverride", size))
        self._wait(self._devtools.send("Emulation.setTouchEmulationEnabled", {"enabled": phone}))

    def move(self, x: float, y: float) -> None:
        self._wait(self._page.mouse.move(x, y))

    def button_down(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        self.move(x, y)
        self._wait(self._page.mouse.down(button=button, click_count=clicks))

    def button_up(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        self.move(x, y)
        self._wait(self._page.mouse.up(button=button, click_count=clicks))

    def wheel(self, x: float, y: float, delta: float) -> None:
        self.move(x, y)
        self._wait(self._page.mouse.wheel(0, delta))

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        self._wait(self._devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers}))

    def prefer(self, scheme: str = "light", *, reduced_motion: bool = False) -> None:
        motion = "reduce" if reduced_motion else "no-preference"
        self._wait(self._page.emulate_media(color_scheme=scheme, reduced_motion=motion))

    def press(self, key: str, seconds: float = 0.0, *, shift: bool = False) -> None:
        keys = ["Shift", key] if shift else [key]
        for name in keys:
            self._wait(self._page.keyboard.down(name))
        time.sleep(seconds)
        for name in reversed(keys):
            self._wait(self._page.keyboard.up(name))

    @contextlib.contextmanager
    def before_every_page(self, script: str) -> Iterator[None]:
        added = self._wait(self._page.add_init_script(f"{{{script}\n}}"))
        try:
            yield
        finally:
            self._wait(added.close())

    def screenshot(self) -> bytes:
        return self._wait(self._page.screenshot(timeout=1000 * self._timeout_seconds))

    @contextlib.contextmanager
    def record_screen(self) -> Iterator[list[tuple[float, bytes]]]:
        """Within this context, record the screen: (Unix time in seconds, PNG scaled down) of each change of it."""
        frames: list[tuple[float, bytes]] = []

        def receive(event: dict[str, Any]) -> None:
            picture = base64.b64decode(event["data"])
            if not frames or frames[-1][1] != picture:  # some pages draw the same picture again and again
                frames.append((event["metadata"]["timestamp"], picture))
            acknowledgement = {"sessionId": event["sessionId"]}
            asyncio.ensure_future(self._devtools.send("Page.screencastFrameAck", acknowledgement), loop=self._loop)

        self._devtools.on("Page.screencastFrame", receive)
        self._wait(self._devtools.send("Page.startScreencast", {"format": "png", **SCREENCAST_SIZE}))
        try:
            yield frames
        finally:
            self._wait(self._devtools.send("Page.stopScreencast"))
            self._devtools.remove_listener("Page.screencastFrame", receive)

    def _list_processes(self) -> list[dict[str, Any]]:
        """Return the id and the CPU seconds (cpuTime) of each process of the browser."""

        async def ask() -> list[dict[str, Any]]:
            devtools = await self._browser.new_browser_cdp_session()
            processes = await devtools.send("SystemInfo.getProcessInfo")
            await devtools.detach()
            return processes["processInfo"]

        return self._wait(ask())

    def cpu_seconds(self) -> float:
        """Return the CPU seconds of all processes of the browser since its start."""
        return sum(process["cpuTime"] for process in self._list_processes())

    def measure_memory(self) -> int:
        """Return the bytes of memory of all processes of the browser; memory that several share counts once (PSS)."""
        total = 0
        for process in self._list_processes():
            with contextlib.suppress(OSError):  # it may have ended meanwhile
                text = Path(f"/proc/{process['id']}/smaps_rollup").read_text()
                total += sum(1024 * int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
        return total

    def collect_garbage(self) -> int:
        """Free unused memory of the page's scripts; return the bytes of objects and buffers that are left."""
        self._wait(self._devtools.send("HeapProfiler.collectGarbage"))
        used = self._wait(self._devtools.send("Runtime.getHeapUsage"))
        return used["usedSize"] + used.get("backingStorageSize", 0)

    def list_workers(self) -> list[str]:
        """Return the addresses of the scripts of the page's running workers."""
        self.evaluate("0")
        return [worker.url for worker in self._page.workers]

    def list_errors(self) -> list[str]:
        self.evaluate("0")  # all earlier messages arrive before this answer
        return list(self._errors)
