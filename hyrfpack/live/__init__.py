"""A model shown in a browser while it is trained."""

from hyrfpack.live.view import LiveView, live_view

__all__ = ["LiveView", "live_view"]
