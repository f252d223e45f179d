"""Measure how long the web player takes for the background of a view at rest.

    python -m tools.studies.player_background MODEL.hyrf --repeats 5

It opens the page of a model in headless Chromium, in a window of 1280 x 800. When the picture is complete, it evaluates
the background again, alternately at each pixel and at nodes that are as far apart as in training. The table has the
pixels between these nodes, the medians of both times in ms, and their ratio. Without a GPU the browser draws in
software.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hyrfpack
from tools.browser.chromium import Chromium
from tools.command import positive_integer, run_command
from tools.studies.web_player import PAGE_TIMEOUT_SECONDS, WINDOW_SIZE, open_page
from tools.tables import print_measured_table

# Returns [pixels between nodes, ms] of each evaluation. The first of each spacing warms up.
TIMING_SCRIPT = """(async () => {
  const { player } = hyrfpack, { renderer } = player, { content } = renderer, { sky } = content, { spacing } = sky;
  const times = [], view = player.view();
  for (let k = 0; k < 2 * %d + 2; k++) {
    Object.assign(sky, { spacing: k %% 2 ? spacing : 0, key: null });
    sky.begin(view, (seen) => renderer.blended(seen));
    await content.graphics.whenDone();
    const began = performance.now();
    await sky.complete({ goOn: () => true, changed() {} });
    if (k > 1) times.push([sky.stride, performance.now() - began]);
  }
  return times;
})()"""


def measure_model(browser: Chromium, page: Path, repeats: int) -> list[str]:
    """Return the row of a model without its name."""
    open_page(browser, page)
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    browser.evaluate("new Promise((resolve) => setTimeout(resolve, 3000))")  # work that is done ahead ends meanwhile
    times = browser.evaluate(TIMING_SCRIPT % repeats)
    strides = [min(stride for stride, _ in times), max(stride for stride, _ in times)]
    full_ms, stride_ms = (statistics.median(ms for stride, ms in times if stride == compared) for compared in strides)
    return [str(strides[1]), f"{full_ms:,.0f}", f"{stride_ms:,.0f}", f"{full_ms / stride_ms:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help=".hyrf files")
    parser.add_argument("--repeats", type=positive_integer, default=5, help="evaluations with each spacing (5)")
    arguments = parser.parse_args()
    columns = ["model", "pixels between nodes", "each pixel, ms", "nodes, ms", "ratio"]
    with tempfile.TemporaryDirectory() as folder, Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
        browser.resize(*WINDOW_SIZE)

        def measure(model: Path) -> Iterator[list[str]]:
            page = Path(folder) / "page.html"
            hyrfpack.export_model(model, page, overwrite=True)
            yield [f"{model.parent.name}/{model.name}", *measure_model(browser, page, arguments.repeats)]

        print_measured_table(columns, arguments.models, measure)


if __name__ == "__main__":
    run_command(main)
