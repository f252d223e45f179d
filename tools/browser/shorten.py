"""Minify the web player's scripts into hyrfpack/web/shortened.json, so that exported pages are small.

    python -m tools.browser.shorten            needs node, and terser in tests/node

It prints each script's length in characters before and after. Pages use a minified script only if its source has not
changed since; otherwise they use the source. The player works either way, and `tests/web/test_shortened.py` fails until
this program has run again.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.web.bundle import bundle, script_digest
from hyrfpack.web.player import SCRIPT_NAMES

REPOSITORY_ROOT = Path(__file__).parents[2]
SHORTENED_SCRIPTS_FILE = REPOSITORY_ROOT / "hyrfpack" / "web" / "shortened.json"


def main() -> None:
    bundle.cache_clear()
    scripts = {name: bundle(f"viewer/{name}") for name in SCRIPT_NAMES}
    node = ["node", str(Path(__file__).with_name("minify.mjs"))]
    done = subprocess.run(
        node, input=json.dumps(scripts), capture_output=True, text=True, check=True, cwd=REPOSITORY_ROOT
    )
    short = json.loads(done.stdout)
    entries = {name: {"of": script_digest(scripts[name]), "script": short[name]} for name in SCRIPT_NAMES}
    write_atomic(SHORTENED_SCRIPTS_FILE, json.dumps(entries, indent=0).encode() + b"\n")
    for name in SCRIPT_NAMES:
        print(f"{name}: {len(scripts[name]):,} to {len(short[name]):,} characters")


if __name__ == "__main__":
    main()
