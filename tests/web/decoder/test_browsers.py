"""The unbundled modules decode files in browsers, in the page and in a module worker."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue

import numpy as np
import pytest

PROJECT_FOLDER = Path(__file__).parents[3]
PACKAGE_FOLDER = PROJECT_FOLDER / "hyrfpack" / "web" / "hyrf"
GOLDEN_FOLDER = PROJECT_FOLDER / "tests" / "golden"
BROWSER_FLAGS = {
    "chromium": ["--headless", "--no-sandbox", "--disable-dev-shm-usage", "--user-data-dir={profile}"],
    "firefox-esr": ["--headless", "--no-remote", "--profile", "{profile}"],
}
RECORDED_NAME_BY_FIELD = {"positions": "positions", "colorLogits": "color_logits", "scaleLogits": "scale_logits"}
PAGE_HTML = """<!doctype html><title>page</title><script type="module">
const sendAnswer = (answer) => fetch("/answer", { method: "POST", body: JSON.stringify(answer) });
const numbers = ({ positions, colorLogits, scaleLogits }) =>
  [positions, colorLogits, scaleLogits].map((array) => Array.from(new Uint32Array(array.buffer)));
try {
  const { read } = await import("./hyrf/index.js");
  const answer = {};
  for (const name of NAMES) {
    const bytes = new Uint8Array(await (await fetch(name)).arrayBuffer());
    answer[name] = [numbers(await read(bytes))];
    const worker = new Worker("worker.js", { type: "module" });
    worker.postMessage(bytes);
    const { data } = await new Promise((resolve) => worker.onmessage = resolve);
    answer[name].push(numbers(data));
    answer[name].push(await read(bytes.subarray(0, -8)).catch((error) => error.message));
  }
  await sendAnswer(answer);
} catch (error) {
  await sendAnswer(String(error));
}
</script>"""
WORKER_JS = """
import { read } from "./hyrf/index.js";
onmessage = async ({ data }) => postMessage(await read(data));
"""


@contextmanager
def serve_page(answers: Queue) -> Iterator[str]:
    """Serve the page, put the answer that it posts into the queue, and yield its address."""
    names = [file.name for file in sorted(GOLDEN_FOLDER.glob("*.hyrf"))]
    files = {"/": ("text/html", PAGE_HTML.replace("NAMES", json.dumps(names)).encode())}
    files["/worker.js"] = ("text/javascript", WORKER_JS.encode())
    files |= {f"/hyrf/{file.name}": ("text/javascript", file.read_bytes()) for file in PACKAGE_FOLDER.glob("*.js")}
    files |= {f"/{name}": ("application/octet-stream", (GOLDEN_FOLDER / name).read_bytes()) for name in names}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            kind, data = files.get(self.path, ("text/plain", b""))
            self.send_response(200 if data else 404)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_POST(self) -> None:
            answers.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("browser", BROWSER_FLAGS)
def test_golden_files_decode_to_the_recorded_numbers_in_a_browser(browser, tmp_path):
    if not shutil.which(browser):
        pytest.skip(f"{browser} is not here")
    answers: Queue = Queue()
    flags = [flag.format(profile=tmp_path) for flag in BROWSER_FLAGS[browser]]

    with serve_page(answers) as address:
        process = subprocess.Popen(
            [browser, *flags, address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "HOME": str(tmp_path)},
        )
        try:
            answer = answers.get(timeout=120)
        finally:
            process.kill()
            process.wait()

    assert isinstance(answer, dict), answer
    for name, (in_page, in_worker, refusal) in answer.items():
        recorded = np.load((GOLDEN_FOLDER / name).with_suffix(".npz"))
        for bits, key in zip(in_page, RECORDED_NAME_BY_FIELD.values(), strict=True):
            assert bits == recorded[f"gaussians.{key}"].astype("<f4").view("<u4").ravel().tolist(), (name, key)
        assert in_worker == in_page
        assert refusal.startswith("The file is truncated: ")
