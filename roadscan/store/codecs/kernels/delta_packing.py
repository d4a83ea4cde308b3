"""Parquet's DELTA_BINARY_PACKED: whole numbers as bit-packed differences.

A page states the values of a block, the miniblocks of a block, the number of values and the first value. Each block
then has the least of its differences, a bit width for each miniblock, and the miniblocks: differences above the least
one, packed from the low bit up (Apache Parquet format, *Encodings.md*, "Delta encoding"; layout after Lemire and
Boytsov, 2015, *Decoding billions of integers per second through vectorization*).

Arithmetic is that of unsigned 64-bit numbers, wrapping. Values come out modulo the type of the array they are written
to: a page whose values do not fit gives wrong values, but touches nothing outside its arrays.
Pages in the layout of the common writers go through `wide_unpacking` where the processor is made for it, all others
through `_miniblocks` and `_unpack`.
Arrays are not handed to functions inside the innermost loops: counting their references takes longer than the work.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.store.codecs.kernels.deflate import appended
from roadscan.store.codecs.kernels.wide_unpacking import NOT_KNOWN, READ_AHEAD_BYTES, unpack_blocks

BLOCK = 128  # values of a block
MINIBLOCKS = 4  # miniblocks of a block
MINIBLOCK = 32
"""Values of a miniblock; this is the layout of the common writers."""
SLACK_BYTES = READ_AHEAD_BYTES
"""Bytes that must follow a page in its buffer; their content does not matter."""

WHOLE, NO_BUFFER, BAD_HEADER, OTHER_COUNT, CUT_SHORT, BAD_WIDTH, LEFT_OVER = range(7)
"""Results of decoding."""
FAULTS = (
    "",
    "the page lies outside its buffer",
    "the page's header is damaged",
    "the page holds another number of values",
    "the page ends inside a block",
    "a miniblock is wider than its numbers",
    "bytes follow the page's last block",
)

_WIDEST = 32
"""Most bits of the numbers that Parquet packs: it stores the types used here as 32-bit numbers."""
_LONGEST_BLOCK = 1 << 20  # larger blocks count as damage

_U = np.uint64
_BYTE = _U(127)  # value bits of a varint's byte


@inlined
def _signed(zigzag):
    return (zigzag >> _U(1)) ^ (_U(0) - (zigzag & _U(1)))


@inlined
def _joined(low, high, bit):
    """Return 64 bits from bit `bit` (0 to 63) of two words on."""
    return (low >> bit) | (high << _U(1) << (_U(63) - bit))


@kernel
def _varints(data, at, end, found):
    """Read as many unsigned varints as `found` has room for; return where they end, −1 where they do not."""
    for k in range(found.size):
        value, shift, more = _U(0), _U(0), True
        while more:
            if at >= end or shift > _U(63):
                return -1
            byte = _U(data[at])
            value |= (byte & _BYTE) << shift
            shift += _U(7)
            at += 1
            more = byte > _BYTE
        found[k] = value
    return at


@kernel
def _miniblocks(data, at, end, miniblocks, per_miniblock, offsets, widths, steps):
    """List where the miniblocks of a page start (byte), their bit widths and least differences; return (fault, end).

    A last block may leave out miniblocks without values, not the rest of its last one.
    """
    k, count = 0, offsets.size
    while k < count:
        zigzag, shift, more = _U(0), _U(0), True
        while more:
            if at >= end or shift > _U(63):
                return CUT_SHORT, at
            byte = _U(data[at])
            zigzag |= (byte & _BYTE) << shift
            shift += _U(7)
            at += 1
            more = byte > _BYTE
        if at + miniblocks > end:
            return CUT_SHORT, at
        step, own = _signed(zigzag), at
        at += miniblocks
        for m in range(min(miniblocks, count - k)):
            width = np.int64(data[own + m])
            if width > _WIDEST:
                return BAD_WIDTH, at
            offsets[k], widths[k], steps[k] = at, width, step
            at += per_miniblock // 8 * width
            k += 1
        if at > end:
            return CUT_SHORT, at
    return WHOLE, at


@kernel
def _unpack(words, per_miniblock, offsets, widths, steps, zigzag, values):
    """Write the values of listed miniblocks; `words` is the page's buffer as 64-bit words."""
    value, size = _signed(zigzag), values.size
    values[0] = value
    for k in range(offsets.size):
        width, step = _U(widths[k]), steps[k]
        mask = (_U(1) << width) - _U(1)
        start = 1 + k * per_miniblock
        for g in range(start, min(start + per_miniblock, size), MINIBLOCK):
            n = min(MINIBLOCK, size - g)
            to = _U(g)
            bit = _U(offsets[k]) * _U(8) + _U(g - start) * width
            if width == 0:
                for i in range(n):
                    values[to + _U(i)] = value + step * _U(i + 1)
                value += step * _U(n)
                continue
            if n < MINIBLOCK or width > 16:
                for i in range(n):
                    word = _joined(words[bit >> _U(6)], words[(bit >> _U(6)) + _U(1)], bit & _U(63))
                    value += step + (word & mask)
                    values[to + _U(i)] = value
                    bit += width
            elif width <= 8:
                for q in range(4):
                    word = _joined(words[bit >> _U(6)], words[(bit >> _U(6)) + _U(1)], bit & _U(63))
                    for i in range(8):
                        value += step + (word & mask)
                        word >>= width
                        values[to + _U(8 * q + i)] = value
                    bit += width * _U(8)
            else:
                for q in range(8):
                    word = _joined(words[bit >> _U(6)], words[(bit >> _U(6)) + _U(1)], bit & _U(63))
                    for i in range(4):
                        value += step + (word & mask)
                        word >>= width
                        values[to + _U(4 * q + i)] = value
                    bit += width * _U(4)


def decode(data: Any, words: Any, start: int, end: int, values: Any) -> int:
    """Write the values of the page in bytes `start` to `end` of a buffer; return one of the faults, WHOLE where none.

    Parameters
    ----------
    data, words
        the buffer as uint8 and, the same memory, as uint64; SLACK_BYTES follow the page.
    values
        (n,) uint16, uint8 or int64, contiguous; of a page with a fault they may be anything.
    """
    if not (0 <= start <= end <= data.size - SLACK_BYTES and data.size <= 8 * words.size):
        return NO_BUFFER
    header = np.empty(4, np.uint64)
    at = _varints(data, start, end, header)
    block, miniblocks, count, _ = (int(number) for number in header)
    if at < 0 or not (0 < block <= _LONGEST_BLOCK and miniblocks > 0):
        return BAD_HEADER
    if block % 128 or block % (MINIBLOCK * miniblocks):
        return BAD_HEADER
    if count != values.size:
        return OTHER_COUNT
    common = count > 0 and (block, miniblocks) == (BLOCK, MINIBLOCKS) and values.itemsize <= 2
    last = unpack_blocks(data, at, end, header[3], values) if common else NOT_KNOWN
    if last != NOT_KNOWN:
        return WHOLE if last == end else LEFT_OVER
    per_miniblock = block // miniblocks
    listed = max(count + per_miniblock - 2, 0) // per_miniblock
    offsets, widths, steps = np.empty(listed, np.int64), np.empty(listed, np.uint8), np.empty(listed, np.uint64)
    fault, at = _miniblocks(data, at, end, miniblocks, per_miniblock, offsets, widths, steps)
    if fault != WHOLE:
        return fault
    if count:
        _unpack(words, per_miniblock, offsets, widths, steps, header[3], values)
    return WHOLE if at == end else LEFT_OVER


def room_words(count: int) -> int:
    """Return the 64-bit words that the page of `count` numbers of 16 bits may take."""
    blocks = -(-count // BLOCK)
    return 8 + blocks * (8 + MINIBLOCKS + BLOCK // 8 * 17) // 8


@inlined
def varint_bits(number):
    """Return a number below 2⁴⁹ as the bytes of a varint, the first one lowest, and their bits."""
    bits, size = number & _BYTE, _U(8)
    rest = number >> _U(7)
    while rest > 0:
        bits |= (_U(128) | ((rest & _BYTE) << _U(8))) << (size - _U(8))
        size += _U(8)
        rest >>= _U(7)
    return bits, size


@inner
def pack_block(above, widths, words, to, word, used):
    """Append the miniblocks of a block to the words; return (current word, its index, its bits)."""
    for k in range(MINIBLOCKS):
        width, own = (widths >> _U(8 * k)) & _U(255), _U(MINIBLOCK * k)
        at_once = 8 if width <= 8 else 4 if width <= 16 else 2
        for q in range(0, MINIBLOCK if width > 0 else 0, at_once):
            bits = _U(0)
            for i in range(at_once):
                bits |= _U(above[own + _U(q + i)]) << (width * _U(i))
            words[to], word, used, full = appended(word, used, bits, width * _U(at_once))
            to += full
    return to, word, used


@inner
def widths_of(above):
    """Return the bit widths of a block's miniblocks, one per byte, the first one lowest."""
    widths = _U(0)
    for k in range(MINIBLOCKS):
        union, width = np.int32(0), _U(0)
        for i in range(MINIBLOCK):
            union |= above[MINIBLOCK * k + i]
        while union > 0:
            width += _U(1)
            union >>= 1
        widths |= width << _U(8 * k)
    return widths


@kernel
def encode(values, words):
    """Write contiguous integers of up to 16 bits as a page's values; return its bytes.

    Parameters
    ----------
    values
        (n,) uint16 or uint8.
    words
        uint64, room_words(n) or more.
    """
    count = values.size
    word, used, to = _U(0), _U(0), _U(0)
    first = np.int64(values[0]) if count > 0 else np.int64(0)
    for number in (_U(BLOCK), _U(MINIBLOCKS), _U(count), _U(first << 1)):
        bits, size = varint_bits(number)
        words[to], word, used, full = appended(word, used, bits, size)
        to += full
    above = np.zeros(BLOCK, np.int32)
    for start in range(1, count, BLOCK):
        n, at, least = min(BLOCK, count - start), _U(start), np.int32(1 << 30)
        for i in range(n):
            above[i] = np.int32(values[at + _U(i)]) - np.int32(values[at + _U(i) - _U(1)])
            least = min(least, above[i])
        above[n:] = least
        for i in range(BLOCK):
            above[i] -= least
        widths = widths_of(above)
        for number, size in (varint_bits(_U(np.int64((least << 1) ^ (least >> 31)))), (widths, _U(8 * MINIBLOCKS))):
            words[to], word, used, full = appended(word, used, number, size)
            to += full
        to, word, used = pack_block(above, widths, words, to, word, used)
    words[to] = word
    return np.int64(to) * 8 + np.int64(used) // 8


TOO_FAR = -1
"""Result where differences are too large to be packed."""

_WIDEST_SPAN = 1 << 31
"""Differences within a block must be less than this apart."""
_FARTHEST = 1 << 47
"""Differences must be smaller than this, because the arithmetic wraps."""


@kernel
def encode_long(values, words):
    """Write the blocks of a page, which follow the page's header.

    Parameters
    ----------
    values : (n,) int64, contiguous, n > 0.
    words : uint64, room_words_long(n) or more, out.

    Returns
    -------
    int, bytes written, or TOO_FAR.
    """
    count = values.size
    word, used, to = _U(0), _U(0), _U(0)
    above = np.zeros(BLOCK, np.int32)
    differences = np.zeros(BLOCK, np.int64)
    for start in range(1, count, BLOCK):
        n, at = min(BLOCK, count - start), _U(start)
        least, most = np.int64(_FARTHEST), np.int64(-_FARTHEST)
        for i in range(n):
            step = values[at + _U(i)] - values[at + _U(i) - _U(1)]
            differences[i] = step
            least, most = min(least, step), max(most, step)
        if least <= -_FARTHEST or most >= _FARTHEST or most - least >= _WIDEST_SPAN:
            return TOO_FAR
        for i in range(n):
            above[i] = np.int32(differences[i] - least)
        above[n:] = 0
        widths = widths_of(above)
        for number, size in (
            varint_bits(_U((least << 1) ^ (least >> 63))),
            (widths, _U(8 * MINIBLOCKS)),
        ):
            words[to], word, used, full = appended(word, used, number, size)
            to += full
        to, word, used = pack_block(above, widths, words, to, word, used)
    words[to] = word
    return np.int64(to) * 8 + np.int64(used) // 8


def room_words_long(count: int) -> int:
    """Return the 64-bit words that the blocks of `count` numbers may take."""
    blocks = -(-count // BLOCK)
    return 8 + blocks * (16 + MINIBLOCKS + BLOCK // 8 * 32) // 8
