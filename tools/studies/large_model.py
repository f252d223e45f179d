"""Measure the web player with a large model in a phone's window: times, and memory of textures.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --gaussians 1000000 --out runs/million
    python -m tools.studies.large_model runs/million/model.hyrf

The table has seconds from opening the page of `hyrfpack export` to the first picture and to the complete one, and the
megabytes of textures and render targets then. The browser is headless Chromium, which draws in software without a GPU.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hyrfpack
from tools.browser.browser import Browser
from tools.browser.chromium import Chromium
from tools.command import run_command
from tools.studies.web_player import PAGE_TIMEOUT_SECONDS, open_page
from tools.tables import print_measured_table

WINDOW_SIZE = (390, 844)
# Counts the bytes of textures. Levels of detail, buffers and the canvas are not counted; the player has few of them.
COUNT_TEXTURES_SCRIPT = """
  const proto = WebGL2RenderingContext.prototype, sizes = new Map(), bound = new Map();
  const formats = { RGBA32UI: 16, RGBA32F: 16, RG32UI: 8, RG32F: 8, RGBA16F: 8, R32UI: 4, RGBA8: 4, RGB10_A2: 4 };
  const bytes = new Map(Object.entries({ ...formats, R32F: 4, R8: 1 }).map(([name, size]) => [proto[name], size]));
  const wrap = (name, before) => {
    const call = proto[name];
    proto[name] = function (...values) { before(...values); return call.apply(this, values); };
  };
  wrap("bindTexture", (kind, texture) => bound.set(kind, texture));
  wrap("texStorage2D", (kind, _, format, w, h) => sizes.set(bound.get(kind), w * h * bytes.get(format)));
  wrap("texStorage3D", (kind, _, format, w, h, d) => sizes.set(bound.get(kind), w * h * d * bytes.get(format)));
  wrap("deleteTexture", (texture) => sizes.delete(texture));
  window.countTextureBytes = () => [...sizes.values()].reduce((sum, size) => sum + size, 0);
"""


def measure(browser: Browser, model: Path, page: Path) -> list[str]:
    """Return the row of a model."""
    hyrfpack.export_model(model, page, overwrite=True)
    with browser.before_every_page(COUNT_TEXTURES_SCRIPT):
        open_page(browser, page)
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    first, complete = (browser.evaluate(f"hyrfpack.player.times.{name}") / 1000 for name in ("first", "complete"))
    megabytes = browser.evaluate("countTextureBytes()") / 1e6
    count = len(hyrfpack.load_model(model))
    return [f"{count:,}", f"{page.stat().st_size:,}", f"{first:.1f}", f"{complete:.1f}", f"{megabytes:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help=".hyrf files")
    arguments = parser.parse_args()

    def measure_model(model: Path) -> Iterator[list[str]]:
        with tempfile.TemporaryDirectory() as folder, Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
            browser.resize(*WINDOW_SIZE, phone=True)
            yield measure(browser, model, Path(folder) / "page.html")

    columns = ["Gaussians", "page bytes", "first s", "complete s", "textures MB"]
    print_measured_table(columns, arguments.models, measure_model)


if __name__ == "__main__":
    run_command(main)
