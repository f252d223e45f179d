"""tools/safety/fuzz_browser.py: which results of the two readers disagree, and what happens if a reader crashes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from tools.safety import fuzz_browser
from tools.safety.fuzz_browser import (
    INPUTS_PER_BATCH,
    Tally,
    Verdict,
    compare_in_processes,
    find_disagreement,
    read_in_javascript,
    read_in_python,
)

ONE_GROUP, TWO_GROUPS = {"POSI": "1"}, {"POSI": "1", "COLO": "2"}


def test_groups_that_only_one_reader_has_are_a_disagreement():
    assert find_disagreement(Verdict(TWO_GROUPS), Verdict(TWO_GROUPS)) == ""
    assert find_disagreement(Verdict(TWO_GROUPS), Verdict(ONE_GROUP)) == "only one reader has COLO"
    assert find_disagreement(Verdict(ONE_GROUP), Verdict(TWO_GROUPS)) == "only one reader has COLO"
    assert find_disagreement(Verdict(TWO_GROUPS), Verdict(TWO_GROUPS | {"COLO": "3"})) == "different numbers in COLO"


def test_an_exception_of_a_reader_is_a_disagreement(monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(fuzz_browser, "read_container", fail)
    python = read_in_python(b"")
    assert find_disagreement(python, Verdict(refused="the file is empty")).startswith("Python fails: ZeroDivisionError")
    javascript = Verdict(failed="node ended: exit code 1")
    assert find_disagreement(Verdict(ONE_GROUP), javascript) == "JavaScript fails: node ended: exit code 1"


@pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")
def test_files_after_one_at_which_node_ends_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    script = tmp_path / "reader.mjs"
    script.write_text(
        """import { readFileSync } from "node:fs";
        const all = readFileSync(process.argv[2]);
        for (let offset = 0; offset < all.length; offset += 6) {
          if (all[offset + 5] === 0) process.abort();
          process.stdout.write(JSON.stringify({ ms: 0, refused: `file ${all[offset + 5]}` }) + "\\n");
        }"""
    )
    monkeypatch.setattr(fuzz_browser, "READER_SCRIPT", script)
    verdicts = read_in_javascript([(bytes([number]), False) for number in (1, 0, 0, 2)])
    assert [verdict.refused for verdict in verdicts] == ["file 1", "", "", "file 2"]
    assert [verdict.failed.startswith("node ended: exit code") for verdict in verdicts] == [False, True, True, False]


def count_inputs(numbers: Sequence[int]) -> Tally:
    tally = Tally()
    tally.kinds["made up"] += len(numbers)
    return tally


def die(numbers: Sequence[int]) -> Tally:
    os._exit(9)


def test_all_inputs_are_compared_once():
    assert compare_in_processes(count_inputs, 2 * INPUTS_PER_BATCH + 1, 2).kinds.total() == 2 * INPUTS_PER_BATCH + 1


def test_a_run_ends_if_a_process_dies():
    assert compare_in_processes(die, INPUTS_PER_BATCH + 1, 1).kinds.total() == 0
