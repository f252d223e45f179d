"""The whole way in one call: photos in, scene out, in stages that are kept and gone on with."""

from hyrfpack.make.plan import QUALITIES
from hyrfpack.make.progress import Progress
from hyrfpack.make.run import MakeResult, Stopped, make
from hyrfpack.make.survey import PhotoSurvey, describe_photos

__all__ = ["QUALITIES", "MakeResult", "PhotoSurvey", "Progress", "Stopped", "describe_photos", "make"]
