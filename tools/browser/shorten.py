"""Gives the player's scripts short names, so that pages are small: writes hyrfpack/web/shortened.json.

    python -m tools.browser.shorten            needs node, and terser in tests/node

Pages carry what it holds as long as it was made of the scripts as they are, else the scripts themselves: the player
works either way, and `tests/web/test_shortened.py` fails until this has been run again.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.web.bundle import bundle, script_digest
from hyrfpack.web.player import SCRIPT_NAMES

ROOT = Path(__file__).parents[2]
SHORTENED = ROOT / "hyrfpack" / "web" / "shortened.json"


def main() -> None:
    bundle.cache_clear()
    scripts = {name: bundle(f"viewer/{name}") for name in SCRIPT_NAMES}
    node = ["node", str(Path(__file__).with_name("minify.mjs"))]
    done = subprocess.run(node, input=json.dumps(scripts), capture_output=True, text=True, check=True, cwd=ROOT)
    short = json.loads(done.stdout)
    entries = {name: {"of": script_digest(scripts[name]), "script": short[name]} for name in SCRIPT_NAMES}
    write_atomic(SHORTENED, json.dumps(entries, indent=0).encode() + b"\n")
    for name in SCRIPT_NAMES:
        print(f"{name}: {len(scripts[name]):,} to {len(short[name]):,} characters")


if __name__ == "__main__":
    main()
