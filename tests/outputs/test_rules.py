"""The rules on which files may be written, for every combination of facts."""

from __future__ import annotations

import itertools
from dataclasses import fields

import pytest

from hyrfpack.outputs.rules import FileFacts, Refusal, refuse_file

# (facts, refusal without overwrite, refusal with it)
REFUSALS_BY_FACTS = [
    ({}, None, None),
    ({"is_folder": True, "exists": True}, Refusal.FOLDER, Refusal.FOLDER),
    ({"is_input": True, "exists": True}, Refusal.INPUT, Refusal.INPUT),
    ({"is_device": True, "exists": True}, Refusal.DEVICE, Refusal.DEVICE),
    ({"folder_is_read": True}, Refusal.READ_FOLDER, Refusal.READ_FOLDER),
    ({"folder_is_read": True, "exists": True}, Refusal.READ_FOLDER, Refusal.READ_FOLDER),
    ({"has_ending": False}, Refusal.ENDING, Refusal.ENDING),
    ({"exists": True}, Refusal.EXISTS, None),
    ({"in_photo_set": True}, Refusal.PHOTO_SET, None),
    ({"in_photo_set": True, "exists": True}, Refusal.EXISTS, None),
]
ALL_FACTS = [FileFacts(*values) for values in itertools.product((False, True), repeat=len(fields(FileFacts)))]


@pytest.mark.parametrize(("facts", "plain", "overwriting"), REFUSALS_BY_FACTS, ids=str)
def test_a_file_is_refused_for_the_stated_reason(facts, plain, overwriting):
    assert (refuse_file(FileFacts(**facts), False), refuse_file(FileFacts(**facts), True)) == (plain, overwriting)


def test_what_is_read_is_never_replaced_whatever_else_is_known():
    for facts, overwrite in itertools.product(ALL_FACTS, (False, True)):
        if facts.is_input or facts.folder_is_read or facts.is_folder or facts.is_device or not facts.has_ending:
            assert refuse_file(facts, overwrite) not in (None, Refusal.EXISTS, Refusal.PHOTO_SET)


def test_without_overwrite_nothing_that_exists_is_replaced_and_no_set_of_photos_is_written_to():
    for facts in ALL_FACTS:
        assert (refuse_file(facts, overwrite=False) is None) == (facts == FileFacts(has_ending=True))


def test_overwrite_allows_files_of_others_only():
    for facts in ALL_FACTS:
        is_protected = facts.is_input or facts.folder_is_read or facts.is_folder or facts.is_device
        assert (refuse_file(facts, overwrite=True) is None) == (facts.has_ending and not is_protected)
