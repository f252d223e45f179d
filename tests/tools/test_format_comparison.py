"""The comparison of formats runs from its command line."""

from __future__ import annotations

import json
import sys

import hyrfpack
from tools.safety.train_golden import DEMO_COMPACT_FILE, DEMO_MODEL_FILE, write_demo_photos
from tools.studies import format_comparison


def test_the_command_measures_profiles_given_files_and_other_formats(tmp_path, monkeypatch, capsys):
    data = write_demo_photos(tmp_path / "demo")
    monkeypatch.setattr(format_comparison, "SH_DEGREES", (0,))
    monkeypatch.setattr(format_comparison, "MIN_OPACITIES", (0.0,))
    monkeypatch.setattr(format_comparison, "PROFILE_SETTINGS", {})
    command = [DEMO_MODEL_FILE, data, "--ours", DEMO_COMPACT_FILE, "--formats", "SPZ", "--out", tmp_path / "out"]
    monkeypatch.setattr(sys, "argv", ["format_comparison", *map(str, command)])

    format_comparison.main()

    report = json.loads((tmp_path / "out" / "peers.json").read_text())
    named = {(row["format"], row["setting"]) for row in report["rows"]}
    assert ("hyrfpack compact", DEMO_COMPACT_FILE.stem) in named and ("hyrfpack paper", "default") in named
    assert len([name for name, _ in named if name == "SPZ"]) == len(hyrfpack.choices.SPZ_VERSIONS)
    assert (tmp_path / "out" / "peers.png").stat().st_size > 0 and "wrote" in capsys.readouterr().out
