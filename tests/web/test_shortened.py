"""The scripts with short names are those of the scripts as they are."""

from __future__ import annotations

import json

import pytest

from hyrfpack.web.bundle import bundle, digest, part
from hyrfpack.web.player import SCRIPTS, script_of


@pytest.mark.parametrize("name", SCRIPTS)
def test_short_names_were_given_to_the_scripts_as_they_are(name):
    entry = json.loads(part("shortened.json")).get(name, {})
    assert entry.get("of") == digest(bundle(f"viewer/{name}")), "a script has changed: run 'make player'"
    assert script_of(name) == entry["script"] and len(entry["script"]) < len(bundle(f"viewer/{name}"))
    assert "</script" not in entry["script"] and "<!--" not in entry["script"]
