"""A worker evaluates a model for the viewpoint of a page, and its arrays are those of the fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from web.pages import Browser, wait_until
from web.served import serve_project

import hyrfpack

GOLDEN_FOLDER = Path(__file__).parents[2] / "golden"
FILE_NAME = "demo_compact.hyrf"
EYE = np.array([0.2, -0.3, -2.5])
VIEW = {
    "rows": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": list(-EYE),
    "fx": 100, "fy": 100, "cx": 60, "cy": 45, "width": 120, "height": 90,
}  # fmt: skip
PAGE_HTML = """<!doctype html><link rel="icon" href="data:,"><script type="module">
import { openRemoteModel } from "/hyrfpack/web/hyrf/remote.js";
window.openRemoteModel = openRemoteModel;
window.open_ = async (source, options) => {
  const got = (window.got = { orders: [], rows: [], tiles: [] });
  window.model = await openRemoteModel(source, {
    onOrder: (order, drawn) => got.orders.push(Array.from(order.subarray(0, drawn))),
    onRow: ({ shapes, pixelSizes, colors }) => {
      got.rows.push([shapes, pixelSizes, colors].map((numbers) => Array.from(numbers)));
    },
    onTile: ({ isCoarse, x, y, width, height, pixels }) => {
      got.tiles.push([isCoarse, x, y, width, height, pixels.length]);
    },
    ...options,
  });
  return window.model.count;
};
</script>"""
OPEN_JS = "open_(%s, {%s}).catch((error) => [error.name, error.message])"


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Iterator[Browser]:
    (tmp_path / "page.html").write_text(PAGE_HTML)
    (tmp_path / "scene.hyrf").write_bytes((GOLDEN_FOLDER / "trained" / FILE_NAME).read_bytes())
    (tmp_path / "damaged.hyrf").write_bytes(b"\x89HYRF\r\n\n" + bytes(100))
    with serve_project(tmp_path) as address:
        browser.open(f"{address}/own/page.html")
        wait_until(browser, "Boolean(window.open_)")
        yield browser
        browser.evaluate("window.model?.close()")


def open_model(page: Browser, source: str = "scene.hyrf", options: str = "") -> object:
    return page.evaluate(OPEN_JS % (json.dumps(source), options))


@pytest.mark.in_turn
def test_a_view_gets_its_order_its_shapes_and_its_colors(page: Browser):
    reference = hyrfpack.load_model(GOLDEN_FOLDER / "trained" / FILE_NAME)
    assert open_model(page) == len(reference)

    assert page.evaluate(f"model.look({json.dumps(VIEW)})") is True
    order, shapes, sizes, colors = page.evaluate("[got.orders[0], ...got.rows[0]]")

    geometry = reference.decode_geometry()
    means = reference.gaussians.positions.detach().numpy().astype(np.float64)
    depths = (means - EYE)[:, 2]
    assert len(order) > 100 and np.all(np.diff(depths[order]) <= 1e-6)
    assert len(set(order)) == len(order) and depths[order].min() > 0.01
    shapes = np.reshape(shapes, (-1, 4, 3))
    np.testing.assert_allclose(shapes[:, 0], means, atol=1e-6)
    quats = torch.nn.functional.normalize(geometry.quats).detach().numpy()[:, [1, 2, 3, 0]]
    np.testing.assert_allclose(sizes, reference.gaussians.pixel_sizes, rtol=1e-5)
    axes = Rotation.from_quat(quats).as_matrix() * geometry.scales.detach().numpy()[:, None, :]
    np.testing.assert_allclose(shapes[:, 1:], axes.transpose(0, 2, 1), atol=1e-5)
    rgb = reference.decode_colors(torch.tensor(EYE, dtype=torch.float32))
    colors = np.reshape(colors, (-1, 4))
    np.testing.assert_allclose(colors[:, :3], rgb.detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(colors[:, 3], geometry.opacities.detach().numpy(), atol=1e-5)


@pytest.mark.in_turn
def test_only_the_latest_of_several_views_is_completed(page: Browser):
    open_model(page)
    views = [{**VIEW, "translation": [0, 0, 2 + 0.1 * step]} for step in range(5)]
    answers = page.evaluate(f"Promise.all({json.dumps(views)}.map((view) => model.look(view)))")
    assert answers == [False, False, False, False, True]
    assert page.evaluate("got.orders.length") < 5, "a stale view is not sorted while a newer one waits"


@pytest.mark.in_turn
def test_the_background_is_delivered_whole_and_then_in_tiles(page: Browser):
    open_model(page)
    page.evaluate(f"model.look({json.dumps(VIEW)})")
    sky, tiles = page.evaluate("[model.sky, got.tiles]")
    assert sky["width"] == 2 * sky["height"]
    assert tiles[0] == [
        True,
        0,
        0,
        sky["coarseWidth"],
        sky["coarseHeight"],
        4 * sky["coarseWidth"] * sky["coarseHeight"],
    ]
    assert len(tiles) > 1
    for is_coarse, x, y, width, height, length in tiles[1:]:
        assert not is_coarse and length == 4 * width * height
        assert x + width <= sky["width"] and y + height <= sky["height"]


@pytest.mark.in_turn
@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("damaged.hyrf", "damaged.hyrf: The file"),
        ("absent%20scene.hyrf?a=b", "absent scene.hyrf: Its server answers with the status 404; check the address."),
        ("http://127.0.0.1:9/far.hyrf", "far.hyrf: It cannot be fetched; check the address"),
        ("http://[", "[: It cannot be read ("),
    ],
)
def test_errors_are_sentences_that_name_the_file(page: Browser, source: str, sentence: str):
    name, message = open_model(page, source)
    assert name == ("HyrfFormatError" if source == "damaged.hyrf" else "HyrfError")
    assert message.startswith(sentence)


@pytest.mark.in_turn
@pytest.mark.parametrize("source", ["undefined", "null", "5", "{}", "{ byteLength: 9 }"])
def test_a_source_that_is_none_is_refused(page: Browser, source: str):
    name, message = page.evaluate(f"openRemoteModel({source}).catch(({{ name, message }}) => [name, message])")
    assert name == "HyrfError" and message.startswith("the file: It cannot be read (neither an address nor ")


class InterruptedDownloads(BaseHTTPRequestHandler):
    """Sends the starts of files, and then nothing, or bytes without an end."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Access-Control-Allow-Origin", "*")
        start = (GOLDEN_FOLDER / "trained" / FILE_NAME).read_bytes()
        if self.path == "/lost.hyrf":
            self.send_header("Content-Length", str(len(start)))
        self.end_headers()
        with suppress(ConnectionError):
            if self.path != "/other.hyrf":
                self.wfile.write(start[:20_000] if self.path == "/lost.hyrf" else start)
            while self.path != "/lost.hyrf":
                self.wfile.write(b"more" * 10_000)

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.in_turn
@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        # Firefox takes a lost connection for the end of the file.
        ("lost.hyrf", ("The connection was lost after ", "The file is truncated: ")),
        ("other.hyrf", ("This is not a .hyrf file",)),
        ("longer.hyrf", ("The file is damaged: its header says ",)),
    ],
)
def test_a_download_that_breaks_or_does_not_end_is_refused(page: Browser, name: str, sentences: tuple[str, ...]):
    server = ThreadingHTTPServer(("127.0.0.1", 0), InterruptedDownloads)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        _, message = open_model(page, f"http://127.0.0.1:{server.server_port}/{name}")
    finally:
        server.shutdown()
        server.server_close()
    assert message.startswith(tuple(f"{name}: {sentence}" for sentence in sentences))


@pytest.mark.in_turn
def test_a_worker_that_does_not_run_is_reported(page: Browser):
    name, message = open_model(page, options='createWorker: () => new Worker("/own/absent.js")')
    assert name == "HyrfError" and message.startswith("scene.hyrf: The worker remote_worker.js of hyrf.js does not run")


@pytest.mark.in_turn
def test_opening_can_be_cancelled(page: Browser):
    options = "signal: (() => { const c = new AbortController(); setTimeout(() => c.abort()); return c.signal; })()"
    assert open_model(page, options=options)[0] == "AbortError"


@pytest.mark.in_turn
def test_a_closed_model_delivers_nothing_more(page: Browser):
    open_model(page)
    answer, earlier, later = page.evaluate(
        f"""(async () => {{
            const view = {json.dumps(VIEW)}, looked = model.look(view);
            model.close();
            const earlier = got.rows.length, answers = [await looked, await model.look(view)];
            await new Promise((resolve) => setTimeout(resolve, 300));
            return [answers, earlier, got.rows.length];
        }})()"""
    )
    assert answer == [False, False] and earlier == later == 0


@pytest.mark.in_turn
def test_the_content_of_a_file_can_be_opened(page: Browser):
    count = page.evaluate(
        """(async () => {
            const bytes = new Uint8Array(await (await fetch("scene.hyrf")).arrayBuffer());
            const counts = [];
            const longer = new Uint8Array(bytes.length + 16);
            longer.set(bytes, 8);
            const views = [longer.subarray(8, 8 + bytes.length), new DataView(longer.buffer, 8, bytes.length)];
            for (const source of [bytes, bytes.buffer, new File([bytes], "a.hyrf"), ...views]) {
              const model = await openRemoteModel(source);
              counts.push(model.count);
              model.close();
            }
            return [...counts, bytes.length];
        })()"""
    )
    length = (GOLDEN_FOLDER / "trained" / FILE_NAME).stat().st_size
    reference = len(hyrfpack.load_model(GOLDEN_FOLDER / "trained" / FILE_NAME))
    assert count == [*[reference] * 5, length], "the caller keeps its bytes"
