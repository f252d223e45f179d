"""The journal of a run in blocks: what it trains, and how far each block is.

The journal itself does not change during a run. The files of a block say whether its training has begun and finished,
so that several processes need no other record.
"""

from __future__ import annotations

import dataclasses
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.blocks.cells import Cells
from hyrfpack.blocks.plan import BlockPlan
from hyrfpack.config.train import TrainConfig
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format.run_folder import BLOCKS_JOURNAL_FILE, CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE, PREPARED_FILES
from hyrfpack.train.checkpoint import names_and_sizes
from hyrfpack.train.results import RECORD_FILE
from hyrfpack.train.run import is_begun as is_run_begun
from hyrfpack.train.run import remove_run_files

JOURNAL_VERSION = 1


@dataclass(frozen=True)
class Journal:
    """The journal of a run in blocks.

    Attributes:
        path: its file, `blocks/blocks.json` in the folder of the run.
        settings: settings of the run by name. They and `photos` must be the same in a resumed run.
        photos: name, width and height of each photo of each block.
        division: numbers that describe the cells, see `describe_cells`; None in journals of earlier versions.
    """

    path: Path
    settings: dict[str, Any]
    photos: dict[str, list]
    division: list[float] | None = None

    def folder(self, block: str) -> Path:
        """Return the folder of the run of a block."""
        return self.path.parent / block

    def is_begun(self, block: str) -> bool:
        """Return whether the training of a block can be resumed."""
        return is_run_begun(self.folder(block))

    def is_finished(self, block: str) -> bool:
        """Return whether a block is trained and all its results are written."""
        files = (self.folder(block) / name for name in (MODEL_FILE, METRICS_FILE))
        return all(file.is_file() for file in files) and not self.is_begun(block)

    def start(self) -> None:
        """Write the journal of a new run, and remove what would be taken for results of its blocks, or resumed."""
        replaced = self.path.parent.parent  # may hold a run without blocks
        remove_run_files(replaced / name for name in (CHECKPOINT_FILE, *PREPARED_FILES, RECORD_FILE))
        names = (CHECKPOINT_FILE, *PREPARED_FILES, RECORD_FILE, METRICS_FILE, MODEL_FILE)
        remove_run_files(self.folder(block) / name for block in self.photos for name in names)
        content = {"version": JOURNAL_VERSION, "settings": self.settings, "photos": self.photos}
        content["division"] = self.division
        write_atomic(self.path, json.dumps(content, indent=1).encode())


def open_journal(
    out: Path, blocks: str, plan: BlockPlan, config: TrainConfig, *, resume: bool, overwrite: bool
) -> Journal:
    """Return the journal of a run, which is new unless it is resumed.

    Raises:
        HyrfError: there is no run to resume, it had other settings or photos, or a new run would replace an earlier
            one without `overwrite`.
    """
    path = out / BLOCKS_JOURNAL_FILE
    photos = {block.name: names_and_sizes(block.photos) for block in plan.blocks}
    settings = json.loads(json.dumps({"blocks": blocks, **config.to_dict()}))
    new = Journal(path, settings, photos, describe_cells(plan.cells))
    if resume:
        other = _describe_difference(_read_journal(path), new)
        if other is not None:
            raise HyrfTrainingError(
                f"{out}: the run was started with other {other}",
                fix="resume with the same ones or train anew with `overwrite=True`",
            )
    elif not overwrite and (is_begun(out) or (out / MODEL_FILE).exists()):
        hint = "`resume=True` continues it, " if is_begun(out) else ""
        raise HyrfError(f"{out}: the folder holds an earlier run", fix=f"{hint}`overwrite=True` replaces it")
    return new


def _describe_difference(old: Journal, new: Journal) -> str | None:
    """Return in words what differs between the journal of a run and that of the call that resumes it, if anything."""
    different = [name for name, value in new.settings.items() if old.settings.get(name) != value]
    if different:
        return f"settings ({', '.join(different)})"
    if old.photos != new.photos:
        return "photos"
    return None if _is_same_division(old.division, new.division) else "poses or points"


def describe_cells(cells: Cells) -> list[float]:
    """Return the axes, borders and overlap of cells, which change with the poses and points of a scene."""
    numbers = np.concatenate([np.ravel(part) for part in dataclasses.astuple(cells)])
    return np.nan_to_num(numbers).tolist()  # outer borders are infinite


def _is_same_division(old: Any, new: list[float] | None) -> bool:
    """Return whether cells are the same, up to rounding; journals of earlier versions do not say."""
    if old is None or new is None:
        return True
    with suppress(TypeError, ValueError):
        return len(old) == len(new) and np.allclose(old, new, rtol=1e-6, atol=1e-9)
    return False


def is_begun(out: Path) -> bool:
    """Return whether a folder holds a run in blocks that can be resumed."""
    return (out / BLOCKS_JOURNAL_FILE).is_file()


def read_grid(out: Path) -> str:
    """Return the grid of the run in a folder, as "2x3".

    Raises:
        HyrfError: there is no run in blocks, or its journal is damaged.
    """
    journal = _read_journal(out / BLOCKS_JOURNAL_FILE)
    return str(journal.settings.get("blocks"))


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
        if content["version"] != JOURNAL_VERSION or not isinstance(content["settings"], dict):
            raise ValueError("it is of another version")
        return Journal(path, content["settings"], content["photos"], content.get("division"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise HyrfTrainingError(f"{path}: the journal is damaged", fix="train anew with `overwrite=True`") from error
