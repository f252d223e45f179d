"""Rendering of a model from a camera."""

from hyrfpack.render.renderer import Rendering, RenderSettings, apply_exposure_map, render_view

__all__ = ["RenderSettings", "Rendering", "apply_exposure_map", "render_view"]
