"""Huffman coding of whole arrays: codes built by dahuffman, bits packed and unpacked with numpy.

The packed bytes are exactly what `dahuffman.HuffmanCodec.from_frequencies(histogram).encode(symbols)` writes: codes
follow one another, most significant bit first; the last byte, if not full, is filled with the first bits of the code
of the end mark and then with zeros. dahuffman keeps no symbol count, so a decoder of such bytes alone may read extra
symbols out of the last byte; the count is kept here.

**The code.** Leaves of the Huffman tree are listed from left to right, that is by rising code, each with its symbol
and its length in bits; one leaf is the end mark. The codes follow from the lengths: the first is all zeros, and as
binary fractions each is the one before plus 2^-length of that one. The fractions 2^-length add up to exactly 1.

**Chunks.** A prefix code can only be read from one end to the other, one symbol after another. So that an array
processor can read many symbols at a time, the bits taken by every `chunk_length(count)` consecutive symbols are kept
beside the stream; the stream itself is not interrupted.

**Bytes of a stream** (`HuffmanStream.to_bytes`), little-endian, nothing between or after:

    u64  count of symbols
    u64  P, bytes of packed codes
    u32  n, leaves of the code, the end mark among them; 0 only when count is 0
    u32  place of the end mark among the leaves, 0 to n - 1; 0 when n is 0
    u8   bytes of a symbol, 1 or 2
    u8   bytes of a chunk size, 2 or 4
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

END = -1
"""Stands for the end mark among the symbols of a code."""

MAX_LENGTH = 57
"""Longest code in bits: a code of this length that starts anywhere in a byte ends within 64 bits. No array of fewer
than 10^12 symbols can need more (a Huffman code that long needs a histogram that grows like the Fibonacci numbers)."""

_HEADER = struct.Struct("<QQIIBB")
_PEEK = 16  # bits looked up at once in decoding
_BLOCK = 1 << 16  # codes packed at once: few enough that temporaries stay in the caches
_ROWS = 64  # decoding steps between two transpositions of what was decoded


def chunk_length(count: int) -> int:
    """Symbols in a chunk (the last may have fewer): 1024, or more so that there are at most 1024 chunks; even."""
    return max(1024, 2 * -(-count // 2048))


@dataclass(frozen=True, eq=False)
class HuffmanCode:
    """A complete prefix code.

    Attributes:
        symbols: (n,) int32 symbols by rising code, 0 to 65535, and `END` once.
        lengths: (n,) uint8 bits of each code, 1 to `MAX_LENGTH`.
    """

    symbols: np.ndarray
    lengths: np.ndarray

    @classmethod
    def from_frequencies(cls, counts: np.ndarray) -> HuffmanCode:
        """Build dahuffman's code for a histogram.

        Args:
            counts: (K,) how often each symbol 0 to K - 1 occurs, K at most 65536. Symbols that do not occur get no
                code. All zero gives the empty code, which codes the empty array only.

        Raises:
            ValueError: a count is negative, K is too large, or a code would be longer than `MAX_LENGTH`.
        """
        counts = np.asarray(counts)
        if counts.ndim != 1 or len(counts) > 65536 or (counts < 0).any():
            raise ValueError(f"a histogram is up to 65536 counts of 0 or more, got shape {counts.shape}")
        occurring = np.flatnonzero(counts)
        if len(occurring) == 0:
            return cls(np.zeros(0, np.int32), np.zeros(0, np.uint8))
        from dahuffman import HuffmanCodec

        frequencies = {int(symbol): int(counts[symbol]) for symbol in occurring}
        table = HuffmanCodec.from_frequencies(frequencies, eof=END).get_code_table()
        if max(length for length, _ in table.values()) > MAX_LENGTH:
            raise ValueError(f"the histogram is so skewed that a code is longer than {MAX_LENGTH} bits")
        leaves = sorted((code << (MAX_LENGTH - length), symbol, length) for symbol, (length, code) in table.items())
        return cls(np.array([leaf[1] for leaf in leaves], np.int32), np.array([leaf[2] for leaf in leaves], np.uint8))

    @cached_property
    def left_codes(self) -> np.ndarray:
        """(n,) uint64 codes, each shifted so that its first bit is bit 63."""
        shares = np.uint64(1) << (np.uint64(64) - self.lengths.astype(np.uint64))
        return np.cumsum(shares, dtype=np.uint64) - shares  # only the sum of all, 2^64, wraps around

    @property
    def codes(self) -> np.ndarray:
        """(n,) uint64 codes as numbers of `lengths` bits, as dahuffman's code table has them."""
        return self.left_codes >> (np.uint64(64) - self.lengths.astype(np.uint64))

    def check(self) -> None:
        """Raise DamagedDataError unless this is a complete prefix code with each symbol once (or the empty code)."""
        if len(self.symbols) == 0:
            return
        if len(np.unique(self.symbols)) != len(self.symbols):
            raise DamagedDataError("Huffman code table: a symbol has two codes; the data is damaged")
        if len(self.symbols) < 2 or self.lengths.min() < 1 or self.lengths.max() > MAX_LENGTH:
            raise DamagedDataError(
                f"Huffman code table: a length is not in 1 to {MAX_LENGTH} bits; the data is damaged"
            )
        histogram = np.bincount(self.lengths).tolist()
        if sum(leaves << (MAX_LENGTH - length) for length, leaves in enumerate(histogram)) != 1 << MAX_LENGTH:
            raise DamagedDataError("Huffman code table: the lengths make no complete code; the data is damaged")
        if (self.left_codes << self.lengths.astype(np.uint64)).any():
            raise DamagedDataError("Huffman code table: the leaves are not in the order of their codes; it is damaged")

    def by_symbol(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Left codes (uint64) and lengths (uint64, 0 = no code) of the symbols 0 to size - 1."""
        codes, lengths = np.zeros((2, size), np.uint64)
        real = self.symbols != END
        codes[self.symbols[real]] = self.left_codes[real]
        lengths[self.symbols[real]] = self.lengths[real]
        return codes, lengths


@dataclass(frozen=True, eq=False)
class HuffmanStream:
    """Coded symbols with all that is needed to decode them.

    Attributes:
        code: the prefix code.
        count: symbols in the stream.
        dtype: uint8 or uint16, of the symbols.
        chunk_bits: (C,) int64 bits taken by every `chunk_length(count)` symbols.
        payload: the packed codes, byte-identical to dahuffman's.
    """

    code: HuffmanCode
    count: int
    dtype: np.dtype
    chunk_bits: np.ndarray
    payload: bytes

    def to_bytes(self) -> bytes:
        """Serialise; the layout is in the head of this module."""
        symbols, width = self.code.symbols, self.dtype.itemsize
        wide = 4 if self.chunk_bits.max(initial=0) > 0xFFFF else 2
        end = int(np.argmax(symbols == END)) if len(symbols) else 0
        return b"".join(
            (
                _HEADER.pack(self.count, len(self.payload), len(symbols), end, width, wide),
                self.code.lengths.tobytes(),
                symbols[symbols != END].astype(f"<u{width}").tobytes(),
                self.chunk_bits.astype(f"<u{wide}").tobytes(),
                self.payload,
            )
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> HuffmanStream:
        """Read what `to_bytes` wrote. Nothing is allocated that the length of `data` does not bear out.

        Raises:
            DamagedDataError: the bytes are truncated, too many, or contradict themselves.
        """
        if len(data) < _HEADER.size:
            raise DamagedDataError(f"Huffman stream: {len(data)} bytes are fewer than its header; it is truncated")
        count, payload_size, leaves, end, width, wide = _HEADER.unpack_from(data)
        if width not in (1, 2) or wide not in (2, 4) or leaves > 256**width + 1 or end > max(leaves - 1, 0):
            raise DamagedDataError("Huffman stream: its header says what cannot be; the data is damaged")
        if count > 8 * payload_size or (count > 0) != (payload_size > 0) or (leaves == 0 and count > 0):
            raise DamagedDataError(
                f"Huffman stream: {count} symbols cannot come from {payload_size} bytes; the data is damaged"
            )
        chunks = -(-count // chunk_length(count))
        sizes = (leaves, max(leaves - 1, 0) * width, chunks * wide, payload_size)
        if len(data) != _HEADER.size + sum(sizes):
            raise DamagedDataError(
                f"Huffman stream: {len(data)} bytes where {_HEADER.size + sum(sizes)} are announced; it is truncated "
                "or damaged"
            )
        edges = np.cumsum((_HEADER.size, *sizes)).tolist()
        lengths, symbols, chunk_bits, payload = (
            data[start:stop] for start, stop in zip(edges, edges[1:], strict=False)
        )
        alphabet = np.frombuffer(symbols, f"<u{width}").astype(np.int32)
        code = HuffmanCode(np.insert(alphabet, end, END) if leaves else alphabet, np.frombuffer(lengths, np.uint8))
        code.check()
        bits = np.frombuffer(chunk_bits, f"<u{wide}").astype(np.int64)
        return cls(code, count, np.dtype(f"u{width}"), bits, bytes(payload))


def huffman_encode(symbols: np.ndarray, code: HuffmanCode | None = None) -> HuffmanStream:
    """Code an array of symbols.

    Args:
        symbols: (N,) uint8 or uint16, N >= 0.
        code: the code to use; by default the best one for these symbols, built by dahuffman.

    Raises:
        ValueError: another dtype or shape, or a symbol for which `code` has no code.

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
    codes, lengths = code.by_symbol(len(counts))
    if (missing := np.flatnonzero((lengths == 0) & (counts > 0))).size:
        raise ValueError(f"the code has no code for symbol {missing[0]}")
    count, bits = len(symbols), int(counts @ lengths.astype(np.int64))

    # One key looks up one packed entry: a code at the top and its length in the 6 lowest bits.
    if symbols.dtype == np.uint8 and 2 * int(code.lengths.max(initial=0)) <= MAX_LENGTH:
        # Two symbols at once. A last single one is doubled; what that adds is cut off below.
        keys = (np.append(symbols, symbols[-1:]) if count % 2 else symbols).view("<u2")
        table = (codes | codes[:, None] >> lengths | lengths + lengths[:, None]).ravel()
        words, chunk_starts = _pack(keys, table, bits, chunk_length(count) // 2)
    else:
        words, chunk_starts = _pack(symbols, codes | lengths, bits, chunk_length(count))
    packed = bytearray(words.astype(">u8").tobytes()[: (bits + 7) // 8])
    if free := -bits % 8:
        end_code = int(code.left_codes[code.symbols == END][0])
        packed[-1] = packed[-1] >> free << free | end_code >> (64 - free)
    return HuffmanStream(code, count, symbols.dtype, np.diff(chunk_starts, append=bits), bytes(packed))


def _histogram(symbols: np.ndarray) -> np.ndarray:
    """How often each symbol occurs: (256,) int64 for uint8, (65536,) for uint16."""
    if symbols.dtype == np.uint16:
        return np.bincount(symbols, minlength=65536)
    # Pairs are counted in half the time.
    even = len(symbols) // 2 * 2
    pairs = np.bincount(symbols[:even].view(np.uint16), minlength=65536).reshape(256, 256)
    return pairs.sum(axis=0) + pairs.sum(axis=1) + np.bincount(symbols[even:], minlength=256)


def _pack(keys: np.ndarray, table: np.ndarray, bits: int, interval: int) -> tuple[np.ndarray, np.ndarray]:
    """Pack the entries table[keys] one after another.

    Codes are cut at word ends: of all codes that start in a word only the last reaches into the next. They do not
    overlap, so adding them is joining them. Every word has a start, as no code is longer than 57 bits.

    Returns:
        Words of 64 bits, first bit highest; and the int64 bit at which every interval-th entry starts.
    """
    words = np.zeros(bits // 64 + 3, np.uint64)
    sampled = [np.zeros(0, np.uint64)]
    position = 0
    for first in range(0, len(keys), _BLOCK):
        entries = table[keys[first : first + _BLOCK]]
        lengths = entries & np.uint64(63)
        entries ^= lengths
        starts = np.cumsum(lengths)
        starts += np.uint64(position)
        position = int(starts[-1])
        starts -= lengths
        sampled.append(starts[-first % interval :: interval].copy())
        offsets = starts & np.uint64(63)
        places = starts >> np.uint64(6)
        heads = np.append(0, np.flatnonzero(places[1:] != places[:-1]) + 1)
        tails = np.append(heads[1:], len(entries)) - 1
        word, stop = int(places[0]), int(places[0]) + len(heads)
        words[word:stop] |= np.add.reduceat(entries >> offsets, heads)
        # Two shifts, as one by all 64 bits would be undefined.
        words[word + 1 : stop + 1] |= entries[tails] << np.uint64(1) << (np.uint64(63) - offsets[tails])
    return words, np.concatenate(sampled).astype(np.int64)


def huffman_decode(stream: HuffmanStream) -> np.ndarray:
    """Decode a stream into its (count,) symbols.

    All chunks are read side by side, one symbol of each a step. Damage may yield wrong symbols, but never reads
    outside the stream, and any damage that changes where a chunk ends is found.

    Raises:
        DamagedDataError: a chunk does not end where the next starts, or the end mark comes early.
    """
    count, interval = stream.count, chunk_length(stream.count)
    if count == 0:
        return np.zeros(0, stream.dtype)
    ends = np.cumsum(stream.chunk_bits)
    if (int(ends[-1]) + 7) // 8 != len(stream.payload):
        raise DamagedDataError("Huffman stream: its chunks do not add up to its length; the data is damaged")
    steps, lanes = min(interval, count), len(ends)
    left_over = count - (lanes - 1) * interval  # symbols in the last chunk

    halves = np.frombuffer(stream.payload + bytes(20 + -len(stream.payload) % 4), ">u4").astype(np.uint64)
    windows = halves[:-1] << np.uint64(32) | halves[1:]  # the 64 bits that start at each 32nd bit
    table, leaf_entries = _decoding_tables(stream.code, count)
    has_long = len(leaf_entries) > 0
    peek_shift = np.uint64(64 - int(table.size).bit_length() + 1)

    position = (ends - stream.chunk_bits).astype(np.uint64)
    index, offset, window, advance = np.empty((4, lanes), np.uint64)
    entries = np.empty((_ROWS, lanes), np.uint64)
    decoded = np.empty((lanes, steps), stream.dtype)
    last_end = None
    for first in range(0, steps, _ROWS):
        rows = min(_ROWS, steps - first)
        for row in range(rows):
            if first + row == left_over:
                last_end = int(position[-1])
            entry = entries[row]
            np.right_shift(position, np.uint64(5), out=index)
            np.bitwise_and(position, np.uint64(31), out=offset)
            # "clip" keeps a lane that runs away inside; where it ends up betrays it below.
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
    """What the next bits mean: entries with the symbol in the 16 lowest bits and the code's length above.

    Returns:
        (2^p,) entries by the next p bits, 0 where a code is longer: p is the longest code, but no more than 16 nor than
        `count` symbols pay for; and (n,) the entries by leaf, empty if no code is longer.
    """
    advance = code.lengths.astype(np.uint64)
    advance[code.symbols == END] = 1 << 40  # out of the stream: no chunk can end there
    leaf_entries = advance << np.uint64(16) | (code.symbols & 0xFFFF).astype(np.uint64)
    longest = int(code.lengths.max())
    peek = min(longest, _PEEK, max(8, count.bit_length()))
    # Leaves are in the order of their codes: the one that holds some bits is the last that starts at or before them.
    next_bits = np.arange(1 << peek, dtype=np.uint64) << np.uint64(64 - peek)
    leaf = np.searchsorted(code.left_codes, next_bits, side="right") - 1
    table = np.where(code.lengths[leaf] <= peek, leaf_entries[leaf], np.uint64(0))
    return table, leaf_entries if longest > peek else leaf_entries[:0]


def _long_entries(code: HuffmanCode, leaf_entries: np.ndarray, windows: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Entries of the codes at these bit positions, whatever their length."""
    index = np.minimum(position >> np.uint64(5), np.uint64(len(windows) - 3)).astype(np.int64)
    offset = position & np.uint64(31)
    bits = windows[index] << offset | windows[index + 2] >> (np.uint64(63) - offset) >> np.uint64(1)
    return leaf_entries[np.searchsorted(code.left_codes, bits, side="right") - 1]
