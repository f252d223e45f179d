"""The journal of a run in blocks: its settings and its progress, from which an interrupted run resumes."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hyrfpack.atomic import write_atomic
from hyrfpack.blocks.plan import BlockPlan
from hyrfpack.config.train import TrainConfig
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format.run_folder import CHECKPOINT_FILE, MODEL_FILE
from hyrfpack.train.checkpoint import names_and_sizes
from hyrfpack.train.results import RECORD_FILE

BLOCKS_FOLDER, JOURNAL_FILE = "blocks", "blocks.json"
JOURNAL_VERSION = 1


@dataclass
class Journal:
    """The journal of a run in blocks.

    Attributes:
        path: its file, `blocks/blocks.json` in the folder of the run.
        settings: settings of the run by name. They and `photos` must be the same in a resumed run.
        photos: name, width and height of each photo of each block.
        begun, finished: names of the blocks whose training has begun, and of those that are trained.
    """

    path: Path
    settings: dict[str, Any]
    photos: dict[str, list]
    begun: list[str] = field(default_factory=list)
    finished: list[str] = field(default_factory=list)

    def folder(self, block: str) -> Path:
        """Return the folder of the run of a block."""
        return self.path.parent / block

    def begin(self, block: str) -> None:
        """Record that the training of a block begins, which must not resume from a checkpoint of an earlier run."""
        for name in (CHECKPOINT_FILE, RECORD_FILE):
            (self.folder(block) / name).unlink(missing_ok=True)
        self.begun.append(block)
        self._write()

    def finish(self, block: str) -> None:
        """Record that a block is trained."""
        self.finished.append(block)
        self._write()

    def _write(self) -> None:
        content = {"version": JOURNAL_VERSION, **{name: value for name, value in vars(self).items() if name != "path"}}
        write_atomic(self.path, json.dumps(content, indent=1).encode())


def open_journal(
    out: Path, blocks: str, plan: BlockPlan, config: TrainConfig, *, resume: bool, overwrite: bool
) -> Journal:
    """Return the journal of the run that is resumed, or that of a new one, which is written when a block begins.

    Raises:
        HyrfError: there is no run to resume, it had other settings or photos, or a new run would replace an earlier
            one without `overwrite`.
    """
    path = out / BLOCKS_FOLDER / JOURNAL_FILE
    photos = {block.name: names_and_sizes(block.scene.train) for block in plan.blocks}
    new = Journal(path, json.loads(json.dumps({"blocks": blocks, **config.to_dict()})), photos)
    if resume:
        found = _read_journal(path)
        different = [name for name, value in new.settings.items() if found.settings.get(name) != value]
        if different or found.photos != photos:
            other = f"settings ({', '.join(different)})" if different else "photos"
            raise HyrfTrainingError(
                f"{out}: the run was started with other {other}",
                fix="resume with the same ones or train anew with `overwrite=True`",
            )
        return found
    if not overwrite and (is_begun(out) or (out / MODEL_FILE).exists()):
        hint = "`resume=True` continues it, " if is_begun(out) else ""
        raise HyrfError(f"{out}: the folder holds an earlier run", fix=f"{hint}`overwrite=True` replaces it")
    return new


def is_begun(out: Path) -> bool:
    """Return whether a folder holds a run in blocks that can be resumed."""
    return (out / BLOCKS_FOLDER / JOURNAL_FILE).is_file()


def _read_journal(path: Path) -> Journal:
    """Read a journal.

    Raises:
        HyrfError: there is none, or it is damaged.
    """
    if not path.is_file():
        raise HyrfError(
            f"{path.parent.parent}: there is no run in blocks to resume", fix="leave out `resume=True` to start a run"
        )
    try:
        content = json.loads(path.read_bytes())
        if content.pop("version") != JOURNAL_VERSION:
            raise ValueError("another version")
        journal = Journal(path, **content)
        if not all(isinstance(names, list) for names in (journal.begun, journal.finished)):
            raise TypeError("no list")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise HyrfTrainingError(f"{path}: the journal is damaged", fix="train anew with `overwrite=True`") from error
    return journal
