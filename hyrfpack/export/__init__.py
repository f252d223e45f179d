"""Export of models to other programs: baking to explicit Gaussians, writing file formats, and pages for browsers."""

from hyrfpack.export.conversion import ConversionReport, convert_splats
from hyrfpack.export.folder import export_gallery, export_player
from hyrfpack.export.pipeline import export_model
from hyrfpack.export.report import ExportReport

__all__ = ["ConversionReport", "ExportReport", "convert_splats", "export_gallery", "export_model", "export_player"]
