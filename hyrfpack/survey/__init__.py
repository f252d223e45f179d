"""Survey of photos or a video before they are used: their properties, their problems, and what to do about them."""

from hyrfpack.survey.describe import PhotoSurvey, describe_photos

__all__ = ["PhotoSurvey", "describe_photos"]
