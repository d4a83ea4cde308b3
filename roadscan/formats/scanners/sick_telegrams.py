"""Telegrams of SICK LMS 2xx scanners: found in bytes, checked, and written.

A telegram, little-endian (SICK, *Telegrams for Configuring and Operating the LMS2xx*, 8007954)::

    0x02 · address · length n (2 bytes) · n bytes: command, data, status · CRC-16 (2 bytes)

The address is 0x80 in what a scanner says (0x80 + its address, which is 0 unless somebody set it) and 0x00
in what a host says to it. The CRC covers all bytes before it. It is SICK's own: the remainder is shifted by one
*bit* for each byte, and each byte goes in twice, the second time eight bits higher:

    c ← x · c + b[i] + x⁸ · b[i − 1]   over GF(2), modulo x¹⁶ + x¹⁵ + x² + 1 (0x8005)

This is linear, so one run over a buffer gives the CRC of *every* piece of it: c(i, j) = c(0, j) + xʲ⁻ⁱ · c(0, i) +
the byte before i. However many false starts a damaged log holds, it is searched in a time that grows with its
length alone.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, Literal

import numpy as np

from roadscan.compute.array_types import Int64, UInt8, UInt16
from roadscan.core.errors import FormatError

STX: Final = 0x02  # first byte of a telegram
FROM_SCANNER: Final = 0x80  # address of a scanner's telegrams
FROM_HOST: Final = 0x00  # address of a host's telegrams
ACKNOWLEDGES: Final = (0x06, 0x15)
"""ACK and NAK: a scanner sends one before it answers a host."""

OVERHEAD_BYTES: Final = 6
"""Bytes of STX, address, length and CRC."""
LONGEST_PAYLOAD: Final = 1_500
"""Longest payload (bytes): the family's largest, 721 values, has 1,446 between length and CRC; 401 values have 806."""
LONGEST_REQUEST: Final = 64
"""Longest request of a host (bytes); field contours, which no log of a drive has, are longer."""
STAMP_BYTES: Final = 8  # bytes of a stamp before a telegram

ALL_VALUES: Final = 0xB0  # command of complete scans
MEAN_VALUES: Final = 0xB6  # command of means over several scans
SUBRANGE: Final = 0xB7  # command of partial scans
MEAN_SUBRANGE: Final = 0xBF  # command of means of partial scans
VALUES_AND_REMISSION: Final = 0xC4  # command of scans with remission
MEASURED: Final = (ALL_VALUES, MEAN_VALUES, SUBRANGE, MEAN_SUBRANGE, VALUES_AND_REMISSION)
"""Commands of telegrams with a scan of any kind."""

Unit = Literal["cm", "mm"]
UNITS: Final[tuple[Unit, ...]] = ("cm", "mm")
"""Unit by bits 14 and 15 of the count word; the other two values are reserved."""
COUNT_MASK: Final = 0x3FF  # bits of the count word with the count
PARTIAL_BIT: Final = 13
"""Bit of the count word that marks a partial scan: one turn of an interlaced scan."""
QUARTER_BIT: Final = 11
"""First of two bits with the first angle of a partial scan, in quarters of a degree."""

_PIECE_BYTES: Final = 1 << 20  # bytes of a log that are read at once
_CARRIED_BEFORE: Final = 16
"""Bytes before a telegram that are read with it: a stamp, acknowledges."""
_POLYNOMIAL: Final = 0x8005  # SICK's CRC-16 without its highest term
_LARGEST_BLOCK: Final = 1 << 10
"""Largest block (bytes) for checksums of 1 MB, whose blocks are processed in parallel."""


# --- checksum --------------------------------------------------------------------------------------


def _shifted(remainder: UInt16) -> UInt16:
    """Return the remainder (n,) times x."""
    return (remainder << np.uint16(1)) ^ (np.uint16(_POLYNOMIAL) * (remainder >> np.uint16(15)))


def _powers(count: int) -> UInt16:
    """Return (count,) x⁰, x¹, … ."""
    out = np.empty(count, dtype=np.uint16)
    power = np.ones(1, dtype=np.uint16)
    for k in range(count):
        out[k] = power[0]
        power = _shifted(power)
    return out


_POWERS: Final = _powers(max(_LARGEST_BLOCK, LONGEST_PAYLOAD + OVERHEAD_BYTES) + 1)  # x to each power


def _times(a: UInt16, b: UInt16) -> UInt16:
    """Return the products of remainders, element by element."""
    out = np.zeros(np.broadcast(a, b).shape, dtype=np.uint16)
    for bit in range(15, -1, -1):
        out = _shifted(out) ^ (a * ((b >> np.uint16(bit)) & np.uint16(1)))
    return out


@functools.cache
def _over_block(block: int) -> tuple[list[int], list[int]]:
    """Return each value of a remainder's low byte and high byte, times x to the power of a block's bytes."""
    values = np.arange(256, dtype=np.uint16)
    low, high = (_times(part, _POWERS[block : block + 1]) for part in (values, values << np.uint16(8)))
    return low.tolist(), high.tolist()


def _block_of(count: int) -> int:
    """Return the block length for a buffer of `count` bytes: about its square root, for few steps."""
    block = 1 << 5
    while block < _LARGEST_BLOCK and block * block < count:
        block <<= 1
    return block


class Checksums:
    """CRCs of any pieces of a buffer, from one pass over it.

    Parameters
    ----------
    data : (n,) the buffer.
    """

    def __init__(self, data: UInt8) -> None:
        self._data = data
        self._block = block = _block_of(data.size)
        rows = data.size // block + 1
        inputs = np.zeros((rows, block), dtype=np.uint16)
        flat = inputs.reshape(-1)
        flat[: data.size] = data
        flat[1 : data.size + 1] ^= data.astype(np.uint16) << np.uint16(8)
        # All blocks advance together by one column at a time, each from 0; the bytes before a block are added below.
        columns = np.ascontiguousarray(inputs.T)
        state = np.zeros(rows, dtype=np.uint16)
        for k in range(block):
            state = _shifted(state) ^ columns[k]
            columns[k] = state
        self._within = columns
        low, high = _over_block(block)
        before = [0]
        for own in state[:-1].tolist():
            last = before[-1]
            before.append(high[last >> 8] ^ low[last & 0xFF] ^ own)
        self._before = np.array(before, dtype=np.uint16)

    def of(self, starts: Int64, ends: Int64) -> UInt16:
        """Return the CRC (k,) of the bytes from `starts` (k,) to `ends` (k,), no farther apart than a telegram."""
        lengths = ends - starts
        head = _shifted(self._running(starts))
        inside = starts > 0
        head[inside] ^= self._data[starts[inside] - 1].astype(np.uint16) << np.uint16(8)
        return self._running(ends) ^ _times(head, _POWERS[lengths - 1])

    def _running(self, counts: Int64) -> UInt16:
        """Return the remainder (k,) after the buffer's first `counts` (k,) bytes."""
        row, column = np.divmod(counts - 1, self._block)
        out: UInt16 = self._within[column, row] ^ _times(self._before[row], _POWERS[column + 1])
        out[counts == 0] = 0
        return out


def checksum(data: bytes) -> int:
    """Return SICK's CRC-16 of some bytes."""
    remainder = before = 0
    for byte in data:
        remainder = (remainder << 1) ^ (0x18005 if remainder & 0x8000 else 0)
        remainder ^= byte | before << 8
        before = byte
    return remainder


# --- finding telegrams -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """A piece of a log with the telegrams that end in it."""

    data: UInt8
    offset: int
    """Byte of the log at which `data` starts."""
    starts: Int64
    """(n,) first byte of each telegram in `data`, ascending; telegrams do not overlap."""
    ends: Int64
    """(n,) byte after each telegram."""

    def commands(self) -> UInt8:
        """Return the command byte (n,) of each telegram."""
        return self.data[self.starts + 4]

    def words(self, at: Int64) -> Int64:
        """Return 16-bit numbers (n,) at the bytes `at` (n,) of the data; 0 beyond its end."""
        low, high = (np.where(at + k < self.data.size, self.data[np.minimum(at + k, self.data.size - 1)], 0)
                     for k in (0, 1))  # fmt: skip
        return low.astype(np.int64) | high.astype(np.int64) << 8


def find_telegrams(data: UInt8, *, is_end: bool) -> tuple[Int64, Int64, int]:
    """Return telegrams with a valid CRC, in order and without overlap: the first that starts wins.

    Parameters
    ----------
    data : (n,) bytes.
    is_end : False if more bytes follow, which may complete a telegram.

    Returns
    -------
    Starts (k,), ends (k,), and the byte from which on the data has to be seen again with what follows.
    """
    starts, ends, unfinished = _candidates(data, is_end=is_end)
    if starts.size:
        said = data[ends - 2].astype(np.uint16) | data[ends - 1].astype(np.uint16) << np.uint16(8)
        valid = Checksums(data).of(starts, ends - 2) == said
        starts, ends = starts[valid], ends[valid]
    chosen = _without_overlap(starts, ends)
    starts, ends = starts[chosen], ends[chosen]
    done = int(ends[-1]) if ends.size else 0
    if is_end:
        return starts, ends, data.size
    # A header may be false; the telegrams after it wait until that is known.
    open_at = int(unfinished[unfinished >= done][0]) if (unfinished >= done).any() else data.size - 3
    earlier = starts < open_at
    starts, ends = starts[earlier], ends[earlier]
    done = int(ends[-1]) if ends.size else 0
    return starts, ends, max(done, open_at - _CARRIED_BEFORE, 0)


def _candidates(data: UInt8, *, is_end: bool) -> tuple[Int64, Int64, Int64]:
    """Return starts and ends of possible telegrams, and starts of those that would end after the data."""
    none = np.zeros(0, dtype=np.int64)
    if data.size < OVERHEAD_BYTES + 1:
        return none, none, none
    address = data[1:-4]
    found = np.flatnonzero((data[:-5] == STX) & ((address == FROM_SCANNER) | (address == FROM_HOST)))
    lengths = data[found + 2].astype(np.int64) | data[found + 3].astype(np.int64) << 8
    longest = np.where(data[found + 1] == FROM_HOST, LONGEST_REQUEST, LONGEST_PAYLOAD)
    possible = (lengths >= 1) & (lengths <= longest)
    found, ends = found[possible], (found + lengths + OVERHEAD_BYTES)[possible]
    inside = ends <= data.size
    return found[inside], ends[inside], none if is_end else found[~inside]


def _without_overlap(starts: Int64, ends: Int64) -> Int64:
    """Return the indices of telegrams that do not start inside an earlier chosen one."""
    if (starts[1:] >= ends[:-1]).all():
        return np.arange(starts.size)
    chosen, free_from = [], 0
    for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        if start >= free_from:
            chosen.append(k)
            free_from = end
    return np.array(chosen, dtype=np.int64)


def read_pieces(path: Path) -> Iterator[Piece]:
    """Yield the pieces of a log with their telegrams, about 1 MB at a time.

    Raises
    ------
    FormatError
        if the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            yield from _pieces(stream)
    except OSError as error:
        raise FormatError(f"the file cannot be read: {error}", file=path) from error


def _pieces(stream: IO[bytes]) -> Iterator[Piece]:
    carry, offset, is_end = b"", 0, False
    while not is_end:
        fresh = stream.read(_PIECE_BYTES)
        is_end = not fresh
        data = np.frombuffer(carry + fresh, dtype=np.uint8)
        starts, ends, resume = find_telegrams(data, is_end=is_end)
        yield Piece(data, offset, starts, ends)
        carry, offset = data[resume:].tobytes(), offset + resume
