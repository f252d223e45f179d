"""Edits of a model: select, clean, reduce and move it, and measure what that changes in renders.

- `select`: which Gaussians an action keeps
- `transform`: a scene in new world coordinates
- `run`: actions in turn on a file, and the report
"""

from hyrfpack.edit.run import ActionReport, EditReport, edit_model, plan_edit

__all__ = ["ActionReport", "EditReport", "edit_model", "plan_edit"]
