"""Edits of a model: select, clean, repair, reduce and move it, and measure what that changes in renders.

- `select`: which Gaussians an action keeps
- `refit`: a region that is trained again
- `transform`: a scene in new world coordinates
- `merge`: several models in one file, and one of them out of it
- `apply`: actions in turn
- `write`: the edited file, within limits on its size or loss
- `run`: all of it for one file, and the report
"""

from hyrfpack.edit.merge import MergedPart, MergeReport, merge_models
from hyrfpack.edit.report import ActionReport, EditReport
from hyrfpack.edit.run import edit_model, plan_edit

__all__ = ["ActionReport", "EditReport", "MergeReport", "MergedPart", "edit_model", "merge_models", "plan_edit"]
