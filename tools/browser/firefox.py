"""Drive an installed Firefox on a virtual display by its Marionette protocol over a local socket.

Playwright drives only a Firefox of its own: Firefox 153 lacks a command (`emulation.setMediaFeaturesOverride`) that
Playwright 1.65 sends over WebDriver BiDi, and BiDi cannot emulate pointers and reduced motion. Firefox's headless mode
has no WebGL, so it runs on a virtual display (Debian's `xvfb`) and renders in software.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.browser.browser import TIMEOUT_SECONDS, Browser

PROGRAM_NAMES = ("firefox-esr", "firefox")
DEFAULT_PREFERENCES = {
    "marionette.port": 0,  # any free port; the browser writes the chosen one into its profile
    "app.update.enabled": False,
    "app.normandy.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "browser.startup.homepage_override.mstone": "ignore",
    "browser.tabs.remote.autostart": True,
    "datareporting.policy.dataSubmissionEnabled": False,
    "dom.disable_open_during_load": False,
    "dom.events.testing.asyncClipboard": True,  # scripts may write to the clipboard without a click
    "extensions.update.enabled": False,
    "full-screen-api.allow-trusted-requests-only": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "network.proxy.type": 0,
    "remote.prefs.recommended": True,
    "security.fileuri.strict_origin_policy": False,  # as in Chromium, a page from a file may start workers from blobs
    "toolkit.telemetry.enabled": False,
    "webgl.force-enabled": True,
    "webgl.disable-fail-if-major-performance-caveat": True,
}
MOUSE_BUTTONS = {"left": 0, "right": 2}
WEBDRIVER_KEYS = {
    "Shift": "\ue008", "Enter": "\ue007", "Escape": "\ue00c", "Tab": "\ue004", "ArrowLeft": "\ue012",
    "ArrowUp": "\ue013", "ArrowRight": "\ue014", "ArrowDown": "\ue015", "PageUp": "\ue00e",
    "PageDown": "\ue00f", "Space": " ",
}  # fmt: skip


def find_program() -> str | None:
    """Return the path of the installed browser; None if it or Xvfb is missing."""
    return next(filter(None, map(shutil.which, PROGRAM_NAMES)), None) if shutil.which("Xvfb") else None


def _start_display() -> tuple[subprocess.Popen, int]:
    """Start a virtual display; return its process and its number."""
    reads, writes = os.pipe()
    command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"]
    process = subprocess.Popen(command, pass_fds=(writes,), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(writes)
    try:
        with os.fdopen(reads) as answer:
            return process, int(answer.readline())
    except BaseException:
        _end_process(process)
        raise


def _end_process(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


def _script_address(script: str) -> str:
    return "data:text/javascript;base64," + base64.b64encode(script.encode()).decode()


class Firefox(Browser):
    """A running Firefox with an empty profile.

    Args:
        preferences: preferences that add to or replace DEFAULT_PREFERENCES; "__" in a name stands for ".".
    """

    name = "firefox"

    def __init__(self, **preferences: bool | int | str) -> None:
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        profile = Path(self._folder.name)
        merged = {**DEFAULT_PREFERENCES, **{name.replace("__", "."): value for name, value in preferences.items()}}
        lines = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in merged.items())
        (profile / "user.js").write_text("".join(lines))
        self._fingers: list[tuple[float, float]] = []
        self._number = 0
        self._received = b""
        program = find_program()
        if program is None:
            raise FileNotFoundError("Firefox or Xvfb is not installed")
        display, number = _start_display()
        self._processes = [display]
        environment = {"HOME": str(profile), "DISPLAY": f":{number}", "LIBGL_ALWAYS_SOFTWARE": "1"}
        try:
            self._process = subprocess.Popen(
                [program, "--no-remote", "--marionette", "--remote-allow-system-access", "--profile", profile],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **environment, "MOZ_CRASHREPORTER_DISABLE": "1"},
            )
            self._processes.insert(0, self._process)
            self._socket = self._connect(profile / "MarionetteActivePort")
            self._receive()  # the browser begins with a greeting
            self.call("WebDriver:NewSession", strictFileInteractability=False)
            self._forward_console()
            self.call("WebDriver:SetTimeouts", script=int(TIMEOUT_SECONDS * 1000), pageLoad=int(TIMEOUT_SECONDS * 1000))
        except BaseException:
            self._end_processes()
            raise

    def close(self) -> None:
        with contextlib.suppress(OSError, TimeoutError, RuntimeError):
            self.call("Marionette:Quit", flags=["eForceQuit"])
        self._socket.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        self._end_processes()

    def _end_processes(self) -> None:
        for process in self._processes:
            _end_process(process)
        self._folder.cleanup()

    def _connect(self, port_file: Path) -> socket.socket:
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while time.monotonic() < deadline and self._process.poll() is None:
            with contextlib.suppress(OSError, ValueError):
                return socket.create_connection(("127.0.0.1", int(port_file.read_text())), timeout=TIMEOUT_SECONDS)
            time.sleep(0.05)
        raise TimeoutError("Firefox did not open its Marionette port in time")

    # ---- The protocol: each message is JSON after its length in bytes and a colon.

    def call(self, method: str, **arguments: Any) -> Any:
        """Send one command of the protocol and return its result."""
        self._number += 1
        message = json.dumps([0, self._number, method, arguments]).encode()
        self._socket.sendall(b"%d:%b" % (len(message), message))
        while True:
            _, number, error, result = self._receive()
            if number != self._number:
                continue
            if error is not None:
                raise RuntimeError(f"{method}: {error['message']}")
            return result

    def _receive(self) -> Any:
        """Return the next message of the browser, decoded from JSON."""
        while b":" not in self._received:
            self._receive_bytes()
        length, _, self._received = self._received.partition(b":")
        while len(self._received) < int(length):
            self._receive_bytes()
        message, self._received = self._received[: int(length)], self._received[int(length) :]
        return json.loads(message)

    def _receive_bytes(self) -> None:
        data = self._socket.recv(1 << 20)
        if not data:
            raise RuntimeError("the browser has ended")
        self._received += data

    def _run_privileged(self, script: str, *arguments: Any) -> Any:
        """Run a function body in the browser's own window and return its result."""
        self.call("Marionette:SetContext", value="chrome")
        try:
            return self.call("WebDriver:ExecuteScript", script=script, args=arguments)["value"]
        finally:
            self.call("Marionette:SetContext", value="content")

    def _forward_console(self) -> None:
        """Forward console.error and console.warn from the pages' processes to the browser's window."""
        script = (
            "{const forward = ({ wrappedJSObject: { level, innerID, arguments: values } }) => {"
            '  if (typeof innerID !== "number") return;'  # it comes from a module of Firefox
            '  if (level === "error" || level === "warn") sendAsyncMessage("console", values.map(String).join(" "));'
            "};"
            'const storage = Cc["@mozilla.org/consoleAPI-storage;1"].getService(Ci.nsIConsoleAPIStorage);'
            "storage.addLogEventListener(forward, Services.scriptSecurityManager.getSystemPrincipal());"
            'addEventListener("unload", () => storage.removeLogEventListener(forward));}'
        )
        self._run_privileged(
            'window.consoleTexts = []; const frames = window.getGroupMessageManager("browsers");'
            'frames.addMessageListener("console", ({ data }) => window.consoleTexts.push(data));'
            "frames.loadFrameScript(arguments[0], true);",
            _script_address(script),
        )

    def open(self, address: str) -> None:
        self.call("WebDriver:Navigate", url="about:blank")  # a change of the fragment alone would not reload
        self._run_privileged("Services.console.reset(); window.consoleTexts = [];")
        self.call("WebDriver:Navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        script = (
            "const done = arguments[0];"
            "(async () => {return (" + expression + "\n);})()"
            ".then((value) => done({value}), (error) => done({error: String(error)}));"
        )
        answer = self.call("WebDriver:ExecuteAsyncScript", script=script, args=[])["value"]
        if answer is None:
            raise RuntimeError("the page was left before its script answered")
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer.get("value")

    def resize(self, width: int, height: int, *, pixel_ratio: float = 1.0, phone: bool = False) -> None:
        self._run_privileged(
            "const [width, height, pixelRatio, phone] = arguments, browser = gBrowser.selectedBrowser;"
            "for (const [name, value] of Object.entries({width, height})) {"
            '  for (const prefix of ["", "min-", "max-"]) browser.style.setProperty(prefix + name, value + "px");'
            "}"
            "const context = browser.browsingContext;"
            "context.inRDMPane = true;"
            "context.overrideDPPX = pixelRatio;"
            'context.touchEventsOverride = phone ? "enabled" : "disabled";'
            # The pointer's capabilities are 1 for coarse, and 2 | 4 for fine with hover.
            'for (const which of ["primary", "all"]) {'
            "  Services.prefs.setIntPref(`ui.${which}PointerCapabilities`, phone ? 1 : 6);"
            "}",
            width, height, pixel_ratio, phone,
        )  # fmt: skip
        # Without a viewport element a page gets the layout of a larger window, as on phones.
        layout_size = (
            "document.querySelector('meta[name=viewport]') ? [innerWidth, innerHeight] : [outerWidth, outerHeight]"
        )
        deadline = time.monotonic() + 5
        while self.evaluate(layout_size) != [width, height] and time.monotonic() < deadline:
            time.sleep(0.02)

    def _perform_actions(self, *sources: dict) -> None:
        """Perform the actions of input devices, those of all devices at the same time."""
        self.call("WebDriver:PerformActions", actions=list(sources))

    def _act_with_mouse(self, x: float, y: float, *actions: dict) -> None:
        """Move the mouse, then perform actions of its buttons."""
        move = {"type": "pointerMove", "x": x, "y": y, "duration": 0, "origin": "viewport"}
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        self._perform_actions({**mouse, "actions": [move, *actions]})

    def move(self, x: float, y: float) -> None:
        self._act_with_mouse(x, y)

    def button_down(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        self._act_with_mouse(x, y, {"type": "pointerDown", "button": MOUSE_BUTTONS[button]})

    def button_up(self, x: float, y: float, button: str = "left", clicks: int = 1) -> None:
        self._act_with_mouse(x, y, {"type": "pointerUp", "button": MOUSE_BUTTONS[button]})

    def wheel(self, x: float, y: float, delta: float) -> None:
        scroll = {"type": "scroll", "x": x, "y": y, "duration": 0, "origin": "viewport", "deltaX": 0, "deltaY": delta}
        self._perform_actions({"type": "wheel", "id": "wheel", "actions": [scroll]})

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        sources = []
        for number in range(max(len(points), len(self._fingers))):
            actions: list[dict] = []
            if number < len(points):
                x, y = points[number]
                actions.append({"type": "pointerMove", "x": x, "y": y, "duration": 0, "origin": "viewport"})
                if number >= len(self._fingers):
                    actions.append({"type": "pointerDown", "button": 0})
            else:
                actions.append({"type": "pointerUp", "button": 0})
            finger = {"type": "pointer", "id": f"finger {number}", "parameters": {"pointerType": "touch"}}
            sources.append({**finger, "actions": actions})
        self._fingers = list(points)
        self._perform_actions(*sources)

    def prefer(self, scheme: str = "light", *, reduced_motion: bool = False) -> None:
        self._run_privileged(
            'Services.prefs.setIntPref("layout.css.prefers-color-scheme.content-override", arguments[0]);'
            'Services.prefs.setIntPref("ui.prefersReducedMotion", arguments[1]);',
            ["dark", "light"].index(scheme), int(reduced_motion),
        )  # fmt: skip

    def press(self, key: str, seconds: float = 0.0, *, shift: bool = False) -> None:
        values = [*([WEBDRIVER_KEYS["Shift"]] if shift else []), WEBDRIVER_KEYS.get(key, key)]
        for kind in ("keyDown", "keyUp"):
            actions = [{"type": kind, "value": value} for value in values[:: 1 if kind == "keyDown" else -1]]
            self._perform_actions({"type": "key", "id": "keys", "actions": actions})
            time.sleep(seconds if kind == "keyDown" else 0)

    @contextlib.contextmanager
    def before_every_page(self, script: str) -> Iterator[None]:
        text = (
            "{let on = true;"
            f'addMessageListener("forget {self._number}", () => {{ on = false; }});'
            'addEventListener("DOMWindowCreated", ({ target }) => {'
            "  const page = target.defaultView;"
            "  const inside = new Cu.Sandbox(page, {sandboxPrototype: page, wantXrays: false});"
            f"  if (on) Cu.evalInSandbox({json.dumps(script)}, inside);"
            "});}"
        )
        address, forget = _script_address(text), f"forget {self._number}"
        frames = 'const frames = window.getGroupMessageManager("browsers");'
        self._run_privileged(f"{frames} frames.loadFrameScript(arguments[0], true)", address)
        try:
            yield
        finally:
            remove = "frames.removeDelayedFrameScript(arguments[0]); frames.broadcastAsyncMessage(arguments[1]);"
            self._run_privileged(frames + remove, address, forget)

    def screenshot(self) -> bytes:
        return base64.b64decode(self.call("WebDriver:TakeScreenshot", full=False)["value"])

    def list_errors(self) -> list[str]:
        self.evaluate("new Promise((done) => setTimeout(done, 50))")  # earlier messages arrive within this time
        return self._run_privileged(
            "const errors = Services.console.getMessageArray().filter((message) =>"
            "  message instanceof Ci.nsIScriptError && !(message.flags & 1) &&"
            # Errors that are thrown later, for example by timers, have no window id.
            '  (message.innerWindowID || message.category === "content javascript"));'
            "return [...errors.map(({ errorMessage }) => errorMessage), ...window.consoleTexts];"
        )
