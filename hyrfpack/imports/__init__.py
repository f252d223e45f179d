"""Make `.hyrf` files from explicit 3D Gaussians of other programs, without photos."""

from hyrfpack.config.imports import ImportConfig
from hyrfpack.imports.run import ImportReport, import_loaded_splats, import_splats

__all__ = ["ImportConfig", "ImportReport", "import_splats", "import_loaded_splats"]
