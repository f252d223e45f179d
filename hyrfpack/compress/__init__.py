"""Rate-distortion compression, which spends bits on the numbers that change rendered pictures most."""

from hyrfpack.compress.report import CompressionReport
from hyrfpack.compress.run import compress_model

__all__ = ["CompressionReport", "compress_model"]
