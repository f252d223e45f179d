"""The journal of a run in blocks reads the state of each block from its files."""

from __future__ import annotations

from pathlib import Path

import pytest

from hyrfpack.blocks.journal import Journal
from hyrfpack.format.run_folder import BLOCKS_JOURNAL_FILE, CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.train.results import RECORD_FILE


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    """Return the journal of a run of one block, whose folder exists."""
    journal = Journal(tmp_path / BLOCKS_JOURNAL_FILE, {"blocks": "2x1"}, {"block-0": [["a.png", 8, 6]]})
    journal.folder("block-0").mkdir(parents=True)
    return journal


def write_files(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(b"{}")


@pytest.mark.parametrize(
    ("names", "is_begun", "is_finished"),
    [
        ((), False, False),
        ((MODEL_FILE,), False, False),
        ((METRICS_FILE,), False, False),
        ((MODEL_FILE, METRICS_FILE), False, True),
        ((CHECKPOINT_FILE, RECORD_FILE), True, False),
        ((CHECKPOINT_FILE, RECORD_FILE, MODEL_FILE, METRICS_FILE), True, False),
    ],
)
def test_a_block_is_finished_if_its_results_are_there_and_no_checkpoint(journal, names, is_begun, is_finished):
    """A block that is trained again has the results of the earlier run and a checkpoint."""
    write_files(journal.folder("block-0"), *names)
    assert (journal.is_begun("block-0"), journal.is_finished("block-0")) == (is_begun, is_finished)


def test_a_new_run_removes_what_would_be_taken_for_its_results(journal: Journal):
    run_folder = journal.path.parent.parent
    write_files(journal.folder("block-0"), CHECKPOINT_FILE, RECORD_FILE, METRICS_FILE, MODEL_FILE, "notes.txt")
    write_files(run_folder, CHECKPOINT_FILE, RECORD_FILE, MODEL_FILE)
    journal.start()
    assert [file.name for file in journal.folder("block-0").iterdir()] == ["notes.txt"]
    assert journal.path.is_file()
    assert (run_folder / MODEL_FILE).is_file()  # until the blocks are merged
    assert not (run_folder / CHECKPOINT_FILE).exists() and not (run_folder / RECORD_FILE).exists()
