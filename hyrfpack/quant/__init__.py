"""Quantisers and entropy coders: numbers to symbols to bytes, and back. They know arrays, never models."""

from hyrfpack.quant.bits import pack_bits, unpack_bits
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.huffman import HuffmanCode, HuffmanStream, huffman_decode, huffman_encode
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.min_max import MinMaxParams, MinMaxQuantizer
from hyrfpack.quant.residual_vq import ResidualVectorQuantizer

__all__ = [
    "DamagedDataError",
    "HuffmanCode",
    "HuffmanStream",
    "MinMaxParams",
    "MinMaxQuantizer",
    "ResidualVectorQuantizer",
    "decode_integers",
    "encode_integers",
    "huffman_decode",
    "huffman_encode",
    "pack_bits",
    "unpack_bits",
]
