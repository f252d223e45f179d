"""Edits of a model: select, clean, reduce and move it, and measure what that changes in renders.

- `select`: which Gaussians an action keeps
- `transform`: a scene in new world coordinates
- `merge`: several models in one file, and one of them out of it
- `run`: actions in turn on a file, and the report
"""

from hyrfpack.edit.merge import MergedPart, MergeReport, merge_models
from hyrfpack.edit.run import ActionReport, EditReport, edit_model, plan_edit

__all__ = ["ActionReport", "EditReport", "MergeReport", "MergedPart", "edit_model", "merge_models", "plan_edit"]
