"""The words that settings accept are those of the packages that define them."""

from __future__ import annotations

from hyrfpack import choices
from hyrfpack.bench.suite import ROW_FUNCTIONS_BY_GROUP
from hyrfpack.data import LAYOUTS
from hyrfpack.make import QUALITIES


def test_the_choices_are_those_of_the_packages_that_define_them():
    assert choices.LAYOUTS == tuple(LAYOUTS)
    assert choices.QUALITIES == tuple(QUALITIES)
    assert choices.BENCH_GROUPS == tuple(ROW_FUNCTIONS_BY_GROUP)
