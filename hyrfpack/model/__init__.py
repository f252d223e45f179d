"""The representation: explicit Gaussians, two neural fields and a background, in one frame."""

from hyrfpack.model.config import ModelConfig
from hyrfpack.model.frame import Frame, contract, viewpoint_of
from hyrfpack.model.hash_grid import HashGridConfig
from hyrfpack.model.hybrid import Geometry, HybridModel

__all__ = ["Frame", "Geometry", "HashGridConfig", "HybridModel", "ModelConfig", "contract", "viewpoint_of"]
