"""Models for other programs: baked to explicit Gaussians, written in their formats, and shown in a browser."""

from hyrfpack.export.conversion import ConversionReport, convert
from hyrfpack.export.folder import gallery, player
from hyrfpack.export.pipeline import export
from hyrfpack.export.report import ExportReport

__all__ = ["ConversionReport", "ExportReport", "convert", "export", "gallery", "player"]
