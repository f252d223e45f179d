"""Models for other programs: baked to explicit Gaussians, written in their formats, and shown in a browser."""

from hyrfpack.export.pipeline import ExportReport, export

__all__ = ["ExportReport", "export"]
