"""The scene representation: explicit Gaussians, two neural fields and a background, in one frame."""

from hyrfpack.model.config import ModelConfig
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.model.frame import Frame
from hyrfpack.model.hash_grid import HashGridConfig
from hyrfpack.model.hybrid import Decoded, Geometry, HybridModel
from hyrfpack.ops.background import BACKGROUND_RADIUS
from hyrfpack.ops.contraction import contract, expand
from hyrfpack.ops.shade import DIRECTION_FEATURES

__all__ = [
    "BACKGROUND_RADIUS",
    "DIRECTION_FEATURES",
    "Decoded",
    "ExposureMap",
    "Frame",
    "Geometry",
    "HashGridConfig",
    "HybridModel",
    "ModelConfig",
    "contract",
    "expand",
]
