"""Rendering of a model from a camera."""

from hyrfpack.render.renderer import RenderedPicture, Rendering, RenderSettings, apply_exposure_map, render_view

__all__ = ["RenderSettings", "RenderedPicture", "Rendering", "apply_exposure_map", "render_view"]
