"""The words that settings take are those that the rooms know."""

from __future__ import annotations

from hyrfpack import choices
from hyrfpack.data import LAYOUTS
from hyrfpack.make import QUALITIES
from hyrfpack.train.config import PRECISIONS


def test_the_words_are_those_of_the_rooms():
    assert choices.LAYOUTS == tuple(LAYOUTS)
    assert choices.QUALITIES == tuple(QUALITIES)
    assert choices.PRECISIONS == PRECISIONS
