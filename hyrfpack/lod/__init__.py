"""Levels of detail: a model split into chunks, each at several levels, and the choice of levels for a view."""

from hyrfpack.lod.draw import LevelRenderer
from hyrfpack.lod.select import LevelSelection, select_levels
from hyrfpack.lod.split import SplitReport, split_model

__all__ = ["LevelRenderer", "LevelSelection", "SplitReport", "select_levels", "split_model"]
