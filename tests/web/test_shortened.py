"""The stored scripts with shortened names belong to the current scripts."""

from __future__ import annotations

import json

import pytest

from hyrfpack.web.bundle import bundle, read_web_file, script_digest
from hyrfpack.web.player import SCRIPT_NAMES, read_script


@pytest.mark.parametrize("name", SCRIPT_NAMES)
def test_shortened_scripts_are_made_from_the_current_scripts(name):
    entry = json.loads(read_web_file("shortened.json")).get(name, {})
    assert entry.get("of") == script_digest(bundle(f"viewer/{name}")), "a script has changed: run 'make player'"
    assert read_script(name) == entry["script"] and len(entry["script"]) < len(bundle(f"viewer/{name}"))
    assert "</script" not in entry["script"] and "<!--" not in entry["script"]
