"""Make a scene from photos end to end, in stages whose products are cached and resumed."""

from hyrfpack.make.plan import QUALITIES
from hyrfpack.make.progress import Progress
from hyrfpack.make.run import MakeResult, Stopped, make_scene
from hyrfpack.make.survey import PhotoSurvey, describe_photos

__all__ = ["QUALITIES", "MakeResult", "PhotoSurvey", "Progress", "Stopped", "describe_photos", "make_scene"]
