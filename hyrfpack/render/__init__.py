"""Rendering of a model from a camera."""

from hyrfpack.render.exposure import apply_exposure_map
from hyrfpack.render.renderer import RenderedPicture, Rendering, RenderSettings, render_view

__all__ = ["RenderSettings", "RenderedPicture", "Rendering", "apply_exposure_map", "render_view"]
