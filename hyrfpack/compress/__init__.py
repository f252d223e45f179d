"""Rate-distortion compression, which spends bits on the numbers that change rendered pictures most."""

from hyrfpack.compress.packer import compress_model

__all__ = ["compress_model"]
