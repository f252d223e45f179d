"""Measure how much neighbouring frames of the web player differ while levels of detail fade into each other.

    python -m tools.studies.fades runs/bonsai-scene

The camera of a scene folder stands still, and the budget of Gaussians changes between a fiftieth, a tenth, a quarter
and all of them. Each step of a fade is as long as on a slow device. For each change the table has the PSNR in dB of the
pictures before and after it, the number of frames that differ from the one before (by a PSNR below 60 dB), and the
lowest PSNR of two neighbouring frames.

The results are in docs/research/levels.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import hyrfpack
from tools.browser.browser import Browser
from tools.browser.chromium import Chromium
from tools.browser.frames import frame_observer_script
from tools.command import run_command
from tools.studies.scene_page import serve_scene
from tools.studies.web_player import PAGE_TIMEOUT_SECONDS
from tools.tables import markdown_row, markdown_table

WINDOW_SIZE = (400, 266)
BUDGET_SHARES = (1, 0.02, 1, 0.1, 1, 0.25, 1)
POLL_SECONDS = 0.2
QUIET_POLLS = 10  # The answer of the worker may take a while.
MIN_EQUAL_FRAMES_PSNR_DB = 60.0
# Compares each frame with the one before.
COMPARE_FRAMES_SCRIPT = """(() => {
  const psnr = (a, b) => {
    let sum = 0;
    for (let i = 0; i < a.length; i++) sum += (a[i] - b[i]) ** 2;
    return 10 * Math.log10((255 ** 2 * 0.75 * a.length) / Math.max(sum, 1e-9)); // alpha is the same
  };
  const frames = { psnrs: [], first: null, last: null };
  window.comparedFrames = {
    begin: () => Object.assign(frames, { psnrs: [], first: frames.last }),
    end: () => [psnr(frames.first, frames.last), ...frames.psnrs],
    add: (rgba) => {
      if (frames.last) frames.psnrs.push(psnr(frames.last, rgba));
      frames.last = rgba;
    },
  };
})()"""
IS_DONE_SCRIPT = """hyrfpack.player.loader.gaussians === %d && hyrfpack.player.loader.state.isComplete &&
  hyrfpack.player.idle && !hyrfpack.player.renderer.content.fades.size"""


def change_budget(browser: Browser, budget: int) -> list[float]:
    """Change the budget; return the PSNR of the first and the last picture, and those of neighbouring frames."""
    browser.evaluate("comparedFrames.begin()")
    loader = "hyrfpack.player.loader"
    browser.evaluate(f"({loader}.gaussians = {budget}, {loader}.post({{ gaussians: {budget} }}))")
    quiet_polls = 0
    while quiet_polls < QUIET_POLLS:
        time.sleep(POLL_SECONDS)
        quiet_polls = quiet_polls + 1 if browser.evaluate(IS_DONE_SCRIPT % budget) else 0
    return browser.evaluate("comparedFrames.end()")


def measure(folder: Path) -> list[list[str]]:
    """Return the rows of a scene folder."""
    rows, gaussians = [], hyrfpack.SceneFolder(folder).manifest.gaussians
    budgets = [round(share * gaussians) for share in BUDGET_SHARES]
    with serve_scene(folder, gaussians) as address, Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
        browser.resize(*WINDOW_SIZE)
        browser.open(address)
        browser.evaluate("hyrfpack.ready")
        browser.evaluate("hyrfpack.player.settled.then(() => true)")
        browser.evaluate(COMPARE_FRAMES_SCRIPT)
        browser.evaluate(frame_observer_script("comparedFrames.add"))
        browser.evaluate("hyrfpack.player.redraw()")
        browser.evaluate("hyrfpack.player.settled.then(() => true)")
        for budget, next_budget in zip(budgets, budgets[1:], strict=False):
            change, *neighbours = change_budget(browser, next_budget)
            different = [psnr for psnr in neighbours if psnr < MIN_EQUAL_FRAMES_PSNR_DB]
            cells = [f"{change:.1f}", str(len(different)), f"{min(neighbours, default=99):.1f}"]
            rows.append([folder.name, f"{budget:,}", f"{next_budget:,}", *cells])
            print(markdown_row(rows[-1]), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scene folders")
    rows = [row for folder in parser.parse_args().folders for row in measure(folder)]
    print(markdown_table(["scene", "budget before", "after", "change, dB", "frames", "least of neighbours, dB"], rows))


if __name__ == "__main__":
    run_command(main)
