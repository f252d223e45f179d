"""Rules on which files may be written, as a function of what is known of a path."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Refusal(Enum):
    """A reason for which a file may not be written, with its problem and its fix in the error message."""

    FOLDER = "this is a folder", "name a file in it"
    INPUT = "the output is an input itself", "name another file"
    DEVICE = "this is a device or a pipe", "name a file"
    READ_FOLDER = "the same command reads what lies in this folder", "name another to write into"
    ENDING = "the file extension does not fit", "change the extension"
    EXISTS = "there is a file of this name", "name another, or replace it with `overwrite=True`"
    PHOTO_SET = "photos or poses lie in this folder", "name another, or write there with `overwrite=True`"

    @property
    def problem(self) -> str:
        """The problem, as in `HyrfError`."""
        return self.value[0]

    @property
    def fix(self) -> str:
        """The fix, as in `HyrfError`."""
        return self.value[1]


@dataclass(frozen=True)
class FileFacts:
    """The facts that decide whether a file may be written.

    Attributes:
        is_folder, is_device: what exists at the path, if that is not a file.
        is_input: a file that is read has this path, or another name or a link of it.
        folder_is_read: photos or poses are read from the folder of the path, with all links followed.
        has_ending: the name has an allowed ending.
        exists: the path is taken, if only by a link that leads nowhere.
        in_photo_set: the folder of the path belongs to a set of posed photos.
    """

    is_folder: bool = False
    is_device: bool = False
    is_input: bool = False
    folder_is_read: bool = False
    has_ending: bool = True
    exists: bool = False
    in_photo_set: bool = False


def refuse_file(facts: FileFacts, overwrite: bool) -> Refusal | None:
    """Return the first reason for which a file may not be written, or None if it may.

    What a command reads is never replaced. `overwrite` allows replacing other files, and writing into sets of photos
    that the command does not read.
    """
    refusals = {
        Refusal.FOLDER: facts.is_folder,
        Refusal.INPUT: facts.is_input,
        Refusal.DEVICE: facts.is_device,
        Refusal.READ_FOLDER: facts.folder_is_read,
        Refusal.ENDING: not facts.has_ending,
        Refusal.EXISTS: facts.exists and not overwrite,
        Refusal.PHOTO_SET: facts.in_photo_set and not facts.exists and not overwrite,
    }
    return next((refusal for refusal, applies in refusals.items() if applies), None)
