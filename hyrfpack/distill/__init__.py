"""Distil explicit 3D Gaussians of other programs into a hybrid model, without photos."""

from hyrfpack.config.distill import DistillConfig
from hyrfpack.distill.fit import DistillReport, distill_splats, import_splats

__all__ = ["DistillConfig", "DistillReport", "import_splats", "distill_splats"]
