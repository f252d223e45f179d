"""Make a scene from photos end to end, in stages whose products are cached and resumed."""

from hyrfpack.make.plan import QUALITIES
from hyrfpack.make.run import MakeResult, Stopped, make_scene

__all__ = ["QUALITIES", "MakeResult", "Stopped", "make_scene"]
