"""Compressing models for pictures: what matters is measured, what does not is left out."""

from hyrfpack.compress.packer import compress

__all__ = ["compress"]
