"""Model + camera -> picture."""

from hyrfpack.render.renderer import Rendering, RenderSettings, render

__all__ = ["RenderSettings", "Rendering", "render"]
