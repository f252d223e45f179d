"""Model + camera -> picture."""

from hyrfpack.render.renderer import RenderSettings, Rendering, render

__all__ = ["RenderSettings", "Rendering", "render"]
