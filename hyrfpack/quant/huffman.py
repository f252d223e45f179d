"""Huffman coding of whole arrays: dahuffman builds the codes, numpy packs and unpacks the bits.

The packed bytes are exactly those of `dahuffman.HuffmanCodec.from_frequencies(histogram).encode(symbols)`: codes
follow one another, most significant bit first. If the last byte is not full, it is filled with the first bits of the
end mark's code and then with zeros. dahuffman stores no symbol count, so a decoder that has only these bytes may read
extra symbols from the last byte. This module stores the count.

**The code.** Leaves of the Huffman tree are listed from left to right, that is by rising code. Each has its symbol and
its length in bits; one leaf is the end mark. The codes follow from the lengths. The first code is all zeros. Read as a
binary fraction, each further code is the previous code plus 2^-length of that code. The fractions 2^-length add up to
exactly 1.

**Chunks.** A prefix code can only be read from one end to the other, one symbol after another. To decode many symbols
in parallel, the number of bits of every `chunk_length(count)` consecutive symbols is stored beside the stream. The
stream itself has no gaps between chunks.

**Bytes of a stream** (`HuffmanStream.to_bytes`), little-endian, nothing between or after:

    u64  count of symbols
    u64  P, bytes of packed codes
    u32  n, leaves of the code, the end mark among them; 0 only when count is 0
    u32  index of the end mark among the leaves, 0 to n - 1; 0 when n is 0
    u8   bytes per symbol, 1 or 2
    u8   bytes per chunk size, 2 or 4
    n x u8              length of each leaf, 1 to 57 bits
    (n - 1) x u8|u16    symbol of each leaf but the end mark
    C x u16|u32         bits in each chunk; C = ceil(count / chunk_length(count))
    P x u8              the packed codes
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hyrfpack.quant.errors import DamagedDataError

END_MARK = -1
"""Symbol of the end mark among the symbols of a code."""

MAX_CODE_BITS = 57
"""Length in bits of the longest code: a code of this length that starts anywhere in a byte ends within 64 bits. No
array of fewer than 10^12 symbols needs more: a Huffman code that long needs a histogram that grows like the Fibonacci
numbers."""

_HEADER_STRUCT = struct.Struct("<QQIIBB")
_MAX_PEEK_BITS = 16  # The lookup table of the decoder then has at most 2^16 entries.
_CODES_PER_BLOCK = 1 << 16  # Temporary arrays of this size stay in the caches.
_STEPS_PER_BLOCK = 64  # After each block the decoded symbols are transposed.


def chunk_length(count: int) -> int:
    """Return the even number of symbols per chunk: 1024, or more where `count` would need more than 1024 chunks.

    The last chunk may have fewer symbols.
    """
    return max(1024, 2 * -(-count // 2048))


@dataclass(frozen=True, eq=False)
class HuffmanCode:
    """A complete prefix code.

    Attributes:
        symbols: (n,) int32 symbols by rising code, 0 to 65535, and `END_MARK` once.
        lengths: (n,) uint8 bits of each code, 1 to `MAX_CODE_BITS`.
    """

    symbols: np.ndarray
    lengths: np.ndarray

    @classmethod
    def from_frequencies(cls, counts: np.ndarray) -> HuffmanCode:
        """Build dahuffman's code for a histogram.

        Args:
            counts: (K,) number of occurrences of each symbol 0 to K - 1, K at most 65536. Symbols that do not occur
                get no code. If all counts are zero, the result is the empty code, which codes the empty array only.

        Raises:
            ValueError: a count is negative, K is too large, or a code would be longer than `MAX_CODE_BITS`.
        """
        counts = np.asarray(counts)
        if counts.ndim != 1 or len(counts) > 65536 or (counts < 0).any():
            raise ValueError(f"a histogram is up to 65536 counts of 0 or more, got shape {counts.shape}")
        occurring = np.flatnonzero(counts)
        if len(occurring) == 0:
            return cls(np.zeros(0, np.int32), np.zeros(0, np.uint8))
        from dahuffman import HuffmanCodec

        frequencies = {int(symbol): int(counts[symbol]) for symbol in occurring}
        table = HuffmanCodec.from_frequencies(frequencies, eof=END_MARK).get_code_table()
        if max(length for length, _ in table.values()) > MAX_CODE_BITS:
            raise ValueError(f"the histogram is so skewed that a code is longer than {MAX_CODE_BITS} bits")
        leaves = sorted((code << (MAX_CODE_BITS - length), symbol, length) for symbol, (length, code) in table.items())
        return cls(np.array([leaf[1] for leaf in leaves], np.int32), np.array([leaf[2] for leaf in leaves], np.uint8))

    @cached_property
    def left_aligned_codes(self) -> np.ndarray:
        """The codes, (n,) uint64, each shifted so that its first bit is bit 63."""
        shares = np.uint64(1) << (np.uint64(64) - self.lengths.astype(np.uint64))
        return np.cumsum(shares, dtype=np.uint64) - shares  # exact although the last sum, 2^64, wraps to 0

    def check(self) -> None:
        """Raise DamagedDataError unless this is a complete prefix code with each symbol once (or the empty code)."""
        if len(self.symbols) == 0:
            return
        if len(np.unique(self.symbols)) != len(self.symbols):
            raise DamagedDataError("Huffman code table: a symbol has two codes; the data is damaged")
        if len(self.symbols) < 2 or self.lengths.min() < 1 or self.lengths.max() > MAX_CODE_BITS:
            raise DamagedDataError(
                f"Huffman code table: a length is not in 1 to {MAX_CODE_BITS} bits; the data is damaged"
            )
        histogram = np.bincount(self.lengths).tolist()
        if sum(leaves << (MAX_CODE_BITS - length) for length, leaves in enumerate(histogram)) != 1 << MAX_CODE_BITS:
            raise DamagedDataError("Huffman code table: the lengths make no complete code; the data is damaged")
        if (self.left_aligned_codes << self.lengths.astype(np.uint64)).any():
            raise DamagedDataError("Huffman code table: the leaves are not in the order of their codes; it is damaged")

    def codes_by_symbol(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return left-aligned codes (uint64) and lengths (uint64, 0 = no code) of the symbols 0 to size - 1."""
        codes, lengths = np.zeros((2, size), np.uint64)
        is_symbol = self.symbols != END_MARK
        codes[self.symbols[is_symbol]] = self.left_aligned_codes[is_symbol]
        lengths[self.symbols[is_symbol]] = self.lengths[is_symbol]
        return codes, lengths


@dataclass(frozen=True, eq=False)
class HuffmanStream:
    """Coded symbols and everything that is needed to decode them.

    Attributes:
        code: the prefix code.
        count: number of symbols in the stream.
        dtype: dtype of the symbols, uint8 or uint16.
        chunk_bits: (C,) int64 number of bits of every `chunk_length(count)` symbols.
        payload: the packed codes, byte-identical to dahuffman's.
    """

    code: HuffmanCode
    count: int
    dtype: np.dtype
    chunk_bits: np.ndarray
    payload: bytes

    def to_bytes(self) -> bytes:
        """Serialise the stream; the docstring of this module describes the layout."""
        symbols, symbol_bytes = self.code.symbols, self.dtype.itemsize
        size_bytes = 4 if self.chunk_bits.max(initial=0) > 0xFFFF else 2
        end = int(np.argmax(symbols == END_MARK)) if len(symbols) else 0
        return b"".join(
            (
                _HEADER_STRUCT.pack(self.count, len(self.payload), len(symbols), end, symbol_bytes, size_bytes),
                self.code.lengths.tobytes(),
                symbols[symbols != END_MARK].astype(f"<u{symbol_bytes}").tobytes(),
                self.chunk_bits.astype(f"<u{size_bytes}").tobytes(),
                self.payload,
            )
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> HuffmanStream:
        """Read a stream that `to_bytes` wrote. Allocations are bounded by the length of `data`.

        Raises:
            DamagedDataError: the bytes are truncated, too many, or inconsistent.
        """
        if len(data) < _HEADER_STRUCT.size:
            raise DamagedDataError(f"Huffman stream: {len(data)} bytes are fewer than its header; it is truncated")
        count, payload_size, leaves, end, symbol_bytes, size_bytes = _HEADER_STRUCT.unpack_from(data)
        has_valid_widths = symbol_bytes in (1, 2) and size_bytes in (2, 4)
        if not has_valid_widths or leaves > 256**symbol_bytes + 1 or end > max(leaves - 1, 0):
            raise DamagedDataError("Huffman stream: its header has impossible values; the data is damaged")
        if count > 8 * payload_size or (count > 0) != (payload_size > 0) or (leaves == 0 and count > 0):
            raise DamagedDataError(
                f"Huffman stream: {count} symbols cannot come from {payload_size} bytes; the data is damaged"
            )
        chunks = -(-count // chunk_length(count))
        sizes = (leaves, max(leaves - 1, 0) * symbol_bytes, chunks * size_bytes, payload_size)
        if len(data) != _HEADER_STRUCT.size + sum(sizes):
            raise DamagedDataError(
                f"Huffman stream: {len(data)} bytes where {_HEADER_STRUCT.size + sum(sizes)} are announced; it is "
                "truncated or damaged"
            )
        edges = np.cumsum((_HEADER_STRUCT.size, *sizes)).tolist()
        lengths, symbols, chunk_bits, payload = (
            data[start:stop] for start, stop in zip(edges, edges[1:], strict=False)
        )
        alphabet = np.frombuffer(symbols, f"<u{symbol_bytes}").astype(np.int32)
        code = HuffmanCode(np.insert(alphabet, end, END_MARK) if leaves else alphabet, np.frombuffer(lengths, np.uint8))
        code.check()
        bits = np.frombuffer(chunk_bits, f"<u{size_bytes}").astype(np.int64)
        return cls(code, count, np.dtype(f"u{symbol_bytes}"), bits, bytes(payload))


def huffman_encode(symbols: np.ndarray, code: HuffmanCode | None = None) -> HuffmanStream:
    """Encode an array of symbols.

    Args:
        symbols: (N,) uint8 or uint16, N >= 0.
        code: the code to use; by default the best one for these symbols, built by dahuffman.

    Raises:
        ValueError: the dtype or shape is wrong, or `code` has no code for a symbol.

    Example:
        >>> symbols = np.array([7, 7, 7, 9], np.uint8)
        >>> huffman_decode(huffman_encode(symbols)).tolist()
        [7, 7, 7, 9]
    """
    if symbols.ndim != 1 or symbols.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"symbols must be (N,) uint8 or uint16, got {symbols.shape} {symbols.dtype}")
    symbols = np.ascontiguousarray(symbols)
    counts = _histogram(symbols)
    code = code or HuffmanCode.from_frequencies(counts)
    codes, lengths = code.codes_by_symbol(len(counts))
    if (missing := np.flatnonzero((lengths == 0) & (counts > 0))).size:
        raise ValueError(f"the code has no code for symbol {missing[0]}")
    count, bits = len(symbols), int(counts @ lengths.astype(np.int64))

    # The table holds a packed entry for each key: the code in the top bits and its length in the 6 lowest bits.
    if symbols.dtype == np.uint8 and 2 * int(code.lengths.max(initial=0)) <= MAX_CODE_BITS:
        # Symbols are coded in pairs. The last symbol of an odd number is repeated; its extra bits are cut off below.
        keys = (np.append(symbols, symbols[-1:]) if count % 2 else symbols).view("<u2")
        table = (codes | codes[:, None] >> lengths | lengths + lengths[:, None]).ravel()
        words, chunk_starts = _pack(keys, table, bits, chunk_length(count) // 2)
    else:
        words, chunk_starts = _pack(symbols, codes | lengths, bits, chunk_length(count))
    packed = bytearray(words.astype(">u8").tobytes()[: (bits + 7) // 8])
    if free := -bits % 8:
        end_code = int(code.left_aligned_codes[code.symbols == END_MARK][0])
        packed[-1] = packed[-1] >> free << free | end_code >> (64 - free)
    return HuffmanStream(code, count, symbols.dtype, np.diff(chunk_starts, append=bits), bytes(packed))


def _histogram(symbols: np.ndarray) -> np.ndarray:
    """Count the occurrences of each symbol: (256,) int64 for uint8, (65536,) for uint16."""
    if symbols.dtype == np.uint16:
        return np.bincount(symbols, minlength=65536)
    # Counting pairs takes half the time.
    even = len(symbols) // 2 * 2
    pairs = np.bincount(symbols[:even].view(np.uint16), minlength=65536).reshape(256, 256)
    return pairs.sum(axis=0) + pairs.sum(axis=1) + np.bincount(symbols[even:], minlength=256)


def _pack(keys: np.ndarray, table: np.ndarray, bits: int, interval: int) -> tuple[np.ndarray, np.ndarray]:
    """Pack the entries table[keys] one after another.

    Codes are cut at word ends: only the last code that starts in a word reaches into the next word. Codes do not
    overlap, so that adding them joins them. A code starts in every word, because no code is longer than 57 bits.

    Returns:
        Words of 64 bits, first bit highest; and the int64 bit position of every interval-th entry.
    """
    words = np.zeros(bits // 64 + 3, np.uint64)
    sampled = [np.zeros(0, np.uint64)]
    position = 0
    for first in range(0, len(keys), _CODES_PER_BLOCK):
        entries = table[keys[first : first + _CODES_PER_BLOCK]]
        lengths = entries & np.uint64(63)
        entries ^= lengths
        starts = np.cumsum(lengths)
        starts += np.uint64(position)
        position = int(starts[-1])
        starts -= lengths
        sampled.append(starts[-first % interval :: interval].copy())
        offsets, word_index = starts & np.uint64(63), starts >> np.uint64(6)
        heads = np.append(0, np.flatnonzero(word_index[1:] != word_index[:-1]) + 1)
        tails = np.append(heads[1:], len(entries)) - 1
        word, stop = int(word_index[0]), int(word_index[0]) + len(heads)
        words[word:stop] |= np.add.reduceat(entries >> offsets, heads)
        # Two shifts are used, because one shift by all 64 bits would be undefined.
        words[word + 1 : stop + 1] |= entries[tails] << np.uint64(1) << (np.uint64(63) - offsets[tails])
    return words, np.concatenate(sampled).astype(np.int64)


def huffman_decode(stream: HuffmanStream) -> np.ndarray:
    """Decode a stream into its (count,) symbols.

    All chunks are decoded in parallel, one symbol of each per step. Damaged data may give wrong symbols, but never
    reads outside the stream; damage that changes the end of a chunk is detected.

    Raises:
        DamagedDataError: a chunk does not end where the next one starts, or the end mark comes too early.
    """
    count, interval = stream.count, chunk_length(stream.count)
    if count == 0:
        return np.zeros(0, stream.dtype)
    ends = np.cumsum(stream.chunk_bits)
    if (int(ends[-1]) + 7) // 8 != len(stream.payload):
        raise DamagedDataError("Huffman stream: its chunks do not add up to its length; the data is damaged")
    steps, lanes = min(interval, count), len(ends)
    last_chunk_symbols = count - (lanes - 1) * interval

    halves = np.frombuffer(stream.payload + bytes(20 + -len(stream.payload) % 4), ">u4").astype(np.uint64)
    windows = halves[:-1] << np.uint64(32) | halves[1:]  # A window has the 64 bits from every 32nd bit on.
    table, leaf_entries = _decoding_tables(stream.code, count)
    has_long = len(leaf_entries) > 0
    peek_shift = np.uint64(64 - int(table.size).bit_length() + 1)

    position = (ends - stream.chunk_bits).astype(np.uint64)
    index, offset, window, advance = np.empty((4, lanes), np.uint64)
    entries = np.empty((_STEPS_PER_BLOCK, lanes), np.uint64)
    decoded = np.empty((lanes, steps), stream.dtype)
    last_end = None
    for first in range(0, steps, _STEPS_PER_BLOCK):
        rows = min(_STEPS_PER_BLOCK, steps - first)
        for row in range(rows):
            if first + row == last_chunk_symbols:
                last_end = int(position[-1])
            entry = entries[row]
            np.right_shift(position, np.uint64(5), out=index)
            np.bitwise_and(position, np.uint64(31), out=offset)
            # "clip" keeps a lane of damaged data inside the stream; the check of its end position below detects it.
            windows.take(index.view(np.int64), out=window, mode="clip")
            np.left_shift(window, offset, out=window)
            np.right_shift(window, peek_shift, out=index)
            table.take(index.view(np.int64), out=entry, mode="clip")
            np.right_shift(entry, np.uint64(16), out=advance)
            if has_long and not advance.all():
                lane = np.flatnonzero(advance == 0)
                entry[lane] = _long_entries(stream.code, leaf_entries, windows, position[lane])
                advance[lane] = entry[lane] >> np.uint64(16)
            np.add(position, advance, out=position)
        decoded[:, first : first + rows] = entries[:rows].T
    if last_end is not None:
        position[-1] = last_end
    if (position != ends.astype(np.uint64)).any():
        chunk = int(np.argmax(position != ends.astype(np.uint64)))
        raise DamagedDataError(f"Huffman stream: chunk {chunk} does not end where it should; the data is damaged")
    return decoded.reshape(-1)[:count]


def _decoding_tables(code: HuffmanCode, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Build the decoding tables: entries with the symbol in the 16 lowest bits and the code's length above.

    Returns:
        (2^p,) entries by the next p bits, 0 where the code is longer; and (n,) entries by leaf, empty if no code is
        longer than p bits. p is the length of the longest code, but at most 16. It is less if `count` symbols are too
        few for the larger table to save time.
    """
    advance = code.lengths.astype(np.uint64)
    advance[code.symbols == END_MARK] = 1 << 40  # leads out of the stream, so that the check of chunk ends fails
    leaf_entries = advance << np.uint64(16) | (code.symbols & 0xFFFF).astype(np.uint64)
    longest = int(code.lengths.max())
    peek = min(longest, _MAX_PEEK_BITS, max(8, count.bit_length()))
    # Leaves are in the order of their codes, so that bits belong to the last leaf whose code is not above them.
    next_bits = np.arange(1 << peek, dtype=np.uint64) << np.uint64(64 - peek)
    leaf = np.searchsorted(code.left_aligned_codes, next_bits, side="right") - 1
    table = np.where(code.lengths[leaf] <= peek, leaf_entries[leaf], np.uint64(0))
    return table, leaf_entries if longest > peek else leaf_entries[:0]


def _long_entries(code: HuffmanCode, leaf_entries: np.ndarray, windows: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Look up the entries of the codes at the given bit positions, of any length."""
    index = np.minimum(position >> np.uint64(5), np.uint64(len(windows) - 3)).astype(np.int64)
    offset = position & np.uint64(31)
    bits = windows[index] << offset | windows[index + 2] >> (np.uint64(63) - offset) >> np.uint64(1)
    return leaf_entries[np.searchsorted(code.left_aligned_codes, bits, side="right") - 1]
