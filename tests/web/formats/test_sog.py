"""A browser reads SOG, whose pictures are lossless, and SPZ with zstd in a worker, as the player does."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_splats import random_splats
from PIL import Image
from splats.formats.test_sog import encode_webp, hand_packed_bundle
from web.formats.comparison import PageSplats
from web.served import serve_project

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS
from tools.browser.chromium import Chromium, find_program

READ_IN_WORKER_JS = """(async (address) => {
  const worker = new Worker("reader.mjs", { type: "module" });
  const answer = new Promise((resolve, reject) => {
    worker.onmessage = ({ data }) => resolve(data);
    worker.onerror = ({ message }) => reject(new Error(message));
  });
  worker.postMessage(address);
  return answer.finally(() => worker.terminate());
})"""


class BrowserReader:
    """Runs the player's readers in a browser."""

    def __init__(self, browser: Chromium, address: str, folder: Path) -> None:
        self.browser, self.address, self.folder = browser, address, folder
        browser.open(f"{address}/tests/web/formats/page.html")

    def read(self, name: str, data: bytes) -> PageSplats | str:
        (self.folder / name).write_bytes(data)
        answer = self.browser.evaluate(f"{READ_IN_WORKER_JS}({json.dumps(f'{self.address}/own/{name}')})")
        if "error" in answer:
            assert answer["kind"] == "HyrfFormatError", answer["error"]
            assert "\n" not in answer["error"]
            return answer["error"]
        return PageSplats(answer["facts"], base64.b64decode(answer["data"]))


@pytest.fixture(scope="module")
def browser_reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserReader]:
    if find_program() is None:
        pytest.skip("there is no Chromium on this machine")
    folder = tmp_path_factory.mktemp("files")
    flags = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")
    with serve_project(folder) as address, Chromium(*flags) as browser:
        yield BrowserReader(browser, address, folder)


def make_zip(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return file.getvalue()


SPLATS_BY_CASE = {
    **{f"degree {degree}": random_splats(300, degree) for degree in range(4)},
    "one": random_splats(1, 2),
    "none": random_splats(0, 3),
    "antialiased": replace(random_splats(70, 1), antialiased=True),
    "far": random_splats(70, 1, shift=(3e4, 0, -2e3)),
}


@pytest.mark.parametrize("name", SPLATS_BY_CASE)
def test_sog_is_read_as_in_python(browser_reader: BrowserReader, name: str) -> None:
    data = sog.encode(SPLATS_BY_CASE[name])
    answer = browser_reader.read("a.sog", data)
    assert isinstance(answer, PageSplats), answer
    answer.assert_equal(sog.decode(data, "a.sog"))


def test_a_file_of_playcanvas_is_read_as_in_python(browser_reader: BrowserReader, shared_data: Path) -> None:
    folder = shared_data / "trained_models" / "playbot_lod3_sog"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    data = make_zip({file.name: file.read_bytes() for file in folder.iterdir()}, zipfile.ZIP_DEFLATED)
    answer = browser_reader.read("playbot.sog", data)
    assert isinstance(answer, PageSplats), answer
    answer.assert_equal(sog.decode(data, "playbot.sog"))


def test_colors_of_transparent_pixels_are_kept_in_webp_and_png(browser_reader: BrowserReader) -> None:
    files = hand_packed_bundle(antialias=True)
    pixel = Image.fromarray(np.array([[[1, 254, 3, 0]]], np.uint8))
    for kind, more in (("WEBP", {"lossless": True, "exact": True}), ("PNG", {})):
        file = io.BytesIO()
        pixel.save(file, kind, **more)
        data = make_zip({**files, "sh0.webp": file.getvalue()})
        answer = browser_reader.read("a.sog", data)
        assert isinstance(answer, PageSplats), answer
        answer.assert_equal(sog.decode(data, "a.sog"))


def bundle_with_meta(**changes: object) -> dict[str, bytes]:
    return hand_packed_bundle(**changes)


def encode_large_picture() -> bytes:
    """Encode a picture with more pixels than a file of one Gaussian may have."""
    file = io.BytesIO()
    Image.fromarray(np.full((300, 300, 4), 255, np.uint8)).save(file, "WEBP", lossless=True)
    return file.getvalue()


INVALID_FILES = {
    "no zip": b"PK" + bytes(40),
    "empty": b"",
    "no meta.json": make_zip({"a": b""}),
    "no JSON": make_zip({"meta.json": b"{"}),
    "a list": make_zip({"meta.json": b"[]"}),
    "version 1": make_zip(bundle_with_meta(version=1)),
    "count": make_zip(bundle_with_meta(count=-1)),
    "many": make_zip(bundle_with_meta(count=60_000_000)),
    "more than pixels": make_zip(bundle_with_meta(count=2)),
    "bounds": make_zip(bundle_with_meta(means={"mins": [0, 0], "maxs": [1, 1, 1], "files": ["low.webp", "high.webp"]})),
    "infinite bounds": make_zip(
        bundle_with_meta(means={"mins": [0] * 3, "maxs": [1e38] * 3, "files": ["low.webp", "high.webp"]})
    ),
    "too far": make_zip(
        bundle_with_meta(means={"mins": [0] * 3, "maxs": [1e4] * 3, "files": ["low.webp", "high.webp"]})
    ),
    "codebook": make_zip(bundle_with_meta(scales={"codebook": [0.0], "files": ["scales.webp"]})),
    "no picture": make_zip({name: data for name, data in hand_packed_bundle().items() if name != "low.webp"}),
    "a path": make_zip(bundle_with_meta(quats={"files": ["../quats.webp"]})),
    "no image": make_zip({**hand_packed_bundle(), "quats.webp": b"RIFF" + bytes(60)}),
    "half an image": make_zip({**hand_packed_bundle(), "quats.webp": encode_webp([[1, 2, 3, 255]])[:-9]}),
    "tag": make_zip({**hand_packed_bundle(), "quats.webp": encode_webp([[255, 128, 128, 7]])}),
    "palette": make_zip({**bundle_with_meta(shN={"codebook": [0.0] * 256, "files": ["scales.webp", "low.webp"]})}),
    "large picture": make_zip({**hand_packed_bundle(), "quats.webp": encode_large_picture()}),
    "damaged": make_zip(hand_packed_bundle()).replace(
        hand_packed_bundle()["sh0.webp"], bytes(len(hand_packed_bundle()["sh0.webp"]))
    ),
    "truncated": make_zip(hand_packed_bundle())[:-30],
    "bomb": make_zip({**hand_packed_bundle(), "low.webp": bytes(50_000_000)}, zipfile.ZIP_DEFLATED),
}


@pytest.mark.parametrize("name", INVALID_FILES)
def test_files_that_python_refuses_are_refused(browser_reader: BrowserReader, name: str) -> None:
    data = INVALID_FILES[name]
    try:
        expected: Splats | None = sog.decode(data, "a.sog")
    except HyrfDataError:
        expected = None
    answer = browser_reader.read("a.sog", data)
    if expected is None:
        assert isinstance(answer, str)
    else:
        assert isinstance(answer, PageSplats), answer
        answer.assert_equal(expected)


def test_spz_4_is_read_where_the_browser_supports_zstd(browser_reader: BrowserReader, shared_data: Path) -> None:
    has_zstd = browser_reader.browser.evaluate(
        "(() => { try { return !!new DecompressionStream('zstd'); } catch { return false; } })()"
    )
    data = FORMATS[".spz"].encode(random_splats(200, 3), Hints(spz_version=4))
    answer = browser_reader.read("a.spz", data)
    if has_zstd:
        assert isinstance(answer, PageSplats), answer
        answer.assert_equal(FORMATS[".spz"].decode(data, "a.spz"))
    else:
        assert "packed by zstd, which this browser cannot unpack" in answer
