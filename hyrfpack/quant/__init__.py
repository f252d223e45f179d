"""Numbers -> few symbols -> few bytes. Knows arrays, never models."""

from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.huffman import HuffmanCode, HuffmanStream, huffman_decode, huffman_encode
from hyrfpack.quant.min_max import MinMaxParams, MinMaxQuantizer
from hyrfpack.quant.residual_vq import ResidualVectorQuantizer

__all__ = [
    "DamagedDataError",
    "HuffmanCode",
    "HuffmanStream",
    "MinMaxParams",
    "MinMaxQuantizer",
    "ResidualVectorQuantizer",
    "huffman_decode",
    "huffman_encode",
]
