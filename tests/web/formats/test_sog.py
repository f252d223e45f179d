"""What only browsers can read: pictures without loss, and zstd. Read in a worker, as the player does it."""

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
from splats.formats.test_sog import packed, webp
from web.formats.comparison import PageSplats
from web.served import served

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS
from tools.browser.chromium import Chromium, find

READ = """(async (address) => {
  const worker = new Worker("reader.mjs", { type: "module" });
  const answer = new Promise((resolve, reject) => {
    worker.onmessage = ({ data }) => resolve(data);
    worker.onerror = ({ message }) => reject(new Error(message));
  });
  worker.postMessage(address);
  return answer.finally(() => worker.terminate());
})"""


class Reader:
    """The player's readers in a browser."""

    def __init__(self, browser: Chromium, address: str, folder: Path) -> None:
        self.browser, self.address, self.folder = browser, address, folder
        browser.open(f"{address}/tests/web/formats/page.html")

    def read(self, name: str, data: bytes) -> PageSplats | str:
        (self.folder / name).write_bytes(data)
        answer = self.browser.evaluate(f"{READ}({json.dumps(f'{self.address}/own/{name}')})")
        if "error" in answer:
            assert answer["kind"] == "HyrfFormatError", answer["error"]
            assert "\n" not in answer["error"]
            return answer["error"]
        return PageSplats(answer["facts"], base64.b64decode(answer["data"]))


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    if find() is None:
        pytest.skip("there is no Chromium on this machine")
    folder = tmp_path_factory.mktemp("files")
    flags = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")
    with served(folder) as address, Chromium(tmp_path_factory.mktemp("profile"), *flags) as browser:
        yield Reader(browser, address, folder)


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return file.getvalue()


SPLATS = {
    **{f"degree {degree}": random_splats(300, degree) for degree in range(4)},
    "one": random_splats(1, 2),
    "none": random_splats(0, 3),
    "antialiased": replace(random_splats(70, 1), antialiased=True),
    "far": random_splats(70, 1, shift=(3e4, 0, -2e3)),
}


@pytest.mark.parametrize("name", SPLATS)
def test_sog_is_read_as_python_reads_it(reader: Reader, name: str) -> None:
    data = sog.encode(SPLATS[name])
    answer = reader.read("a.sog", data)
    assert isinstance(answer, PageSplats), answer
    answer.assert_are(sog.decode(data, "a.sog"))


def test_a_file_of_playcanvas_is_read_as_python_reads_it(reader: Reader, shared_data: Path) -> None:
    folder = shared_data / "trained_models" / "playbot_lod3_sog"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    data = zipped({file.name: file.read_bytes() for file in folder.iterdir()}, zipfile.ZIP_DEFLATED)
    answer = reader.read("playbot.sog", data)
    assert isinstance(answer, PageSplats), answer
    answer.assert_are(sog.decode(data, "playbot.sog"))


def test_colours_stay_where_alpha_is_small_and_png_is_read_too(reader: Reader) -> None:
    files = packed(antialias=True)
    pixel = Image.fromarray(np.array([[[1, 254, 3, 0]]], np.uint8))
    for kind, more in (("WEBP", {"lossless": True, "exact": True}), ("PNG", {})):
        file = io.BytesIO()
        pixel.save(file, kind, **more)
        data = zipped({**files, "sh0.webp": file.getvalue()})
        answer = reader.read("a.sog", data)
        assert isinstance(answer, PageSplats), answer
        answer.assert_are(sog.decode(data, "a.sog"))


def meta(**changes: object) -> dict[str, bytes]:
    return packed(**changes)


def large_picture() -> bytes:
    """More pixels than a file of one Gaussian may have."""
    file = io.BytesIO()
    Image.fromarray(np.full((300, 300, 4), 255, np.uint8)).save(file, "WEBP", lossless=True)
    return file.getvalue()


WRONG = {
    "no zip": b"PK" + bytes(40),
    "empty": b"",
    "no meta.json": zipped({"a": b""}),
    "no JSON": zipped({"meta.json": b"{"}),
    "a list": zipped({"meta.json": b"[]"}),
    "version 1": zipped(meta(version=1)),
    "count": zipped(meta(count=-1)),
    "many": zipped(meta(count=60_000_000)),
    "more than pixels": zipped(meta(count=2)),
    "bounds": zipped(meta(means={"mins": [0, 0], "maxs": [1, 1, 1], "files": ["low.webp", "high.webp"]})),
    "infinite bounds": zipped(meta(means={"mins": [0] * 3, "maxs": [1e38] * 3, "files": ["low.webp", "high.webp"]})),
    "too far": zipped(meta(means={"mins": [0] * 3, "maxs": [1e4] * 3, "files": ["low.webp", "high.webp"]})),
    "codebook": zipped(meta(scales={"codebook": [0.0], "files": ["scales.webp"]})),
    "no picture": zipped({name: data for name, data in packed().items() if name != "low.webp"}),
    "a path": zipped(meta(quats={"files": ["../quats.webp"]})),
    "no image": zipped({**packed(), "quats.webp": b"RIFF" + bytes(60)}),
    "half an image": zipped({**packed(), "quats.webp": webp([[1, 2, 3, 255]])[:-9]}),
    "tag": zipped({**packed(), "quats.webp": webp([[255, 128, 128, 7]])}),
    "palette": zipped({**meta(shN={"codebook": [0.0] * 256, "files": ["scales.webp", "low.webp"]})}),
    "large picture": zipped({**packed(), "quats.webp": large_picture()}),
    "damaged": zipped(packed()).replace(packed()["sh0.webp"], bytes(len(packed()["sh0.webp"]))),
    "truncated": zipped(packed())[:-30],
    "bomb": zipped({**packed(), "low.webp": bytes(50_000_000)}, zipfile.ZIP_DEFLATED),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_python_refuses_is_refused_in_a_sentence(reader: Reader, name: str) -> None:
    data = WRONG[name]
    try:
        expected: Splats | None = sog.decode(data, "a.sog")
    except HyrfDataError:
        expected = None
    answer = reader.read("a.sog", data)
    if expected is None:
        assert isinstance(answer, str)
    else:
        assert isinstance(answer, PageSplats), answer
        answer.assert_are(expected)


def test_spz_4_is_read_where_the_browser_knows_zstd(reader: Reader, shared_data: Path) -> None:
    known = reader.browser.evaluate("try { !!new DecompressionStream('zstd') } catch { false }")
    data = FORMATS[".spz"].encode(random_splats(200, 3), Hints(spz_version=4))
    answer = reader.read("a.spz", data)
    if known:
        assert isinstance(answer, PageSplats), answer
        answer.assert_are(FORMATS[".spz"].decode(data, "a.spz"))
    else:
        assert "packed by zstd, which this browser cannot unpack" in answer
