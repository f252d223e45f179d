"""Rate-distortion compression, which spends bits on the numbers that change rendered pictures most."""

from hyrfpack.compress.packer import compress_model
from hyrfpack.compress.report import CompressionReport

__all__ = ["CompressionReport", "compress_model"]
