"""DEFLATE in zlib's format (RFC 1950, 1951) for rasters: runs of one byte, and Huffman codes for everything else.

Measured heights and intensities hold no repetitions but runs, and looking for them is what takes a compressor's time.
The data are divided into segments of 16 bytes: one that repeats the byte before it belongs to a run (a match at
distance 1), the bytes of all others are coded one by one. A sample of them gives the code's lengths.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inlined, inlined, kernel

SEGMENT = 16  # bytes that are examined together
_SHORTEST_GAP = 4
"""Segments of zeros from which a run is coded; shorter runs are coded byte by byte."""
_SAMPLE = 1024
"""Approximate number of segments from which the code is estimated."""
SYMBOLS, END, _LONGEST = 286, 256, 285  # literal and length symbols; end of block; the longest match (RFC 1951)
_DISTANCE = np.ones(1, np.uint8)
"""Code length (bits) of a distance: there is one distance, 1."""
_MOST_BITS = 13
"""Longest code (bits): two of them and their length fit in 32 bits."""
_PAIR_BITS = 27  # bits of the codes of a pair, below their length
PAIRS = 1 << 16  # pairs of bytes
_PAIR, _PAIR_MASK = np.uint64(0xFFFF), np.uint32((1 << _PAIR_BITS) - 1)  # masks of a pair of bytes, and of its codes
_LONGEST_RUN = 258  # longest match (RFC 1951)
ADLER = 65_521  # modulus of Adler-32 (RFC 1950)
_U = np.uint64
_LANES, _ONES = _U(0x00FF_00FF_00FF_00FF), _U(0x0001_0001_0001_0001)  # every other byte; adds up 16-bit lanes
_FALLING_EVEN, _FALLING_ODD = _U(0x0008_0006_0004_0002), _U(0x0007_0005_0003_0001)
"""Weights of a word's even and odd bytes, counted from the first, in the second sum of Adler-32."""


def room_words(size: int) -> int:
    """Return the 64-bit words that `size` bytes may take."""
    return (size * _MOST_BITS // 8 + 512) // 8


@bare
def _segments(words, rest, literals):
    """List the segments whose bytes are coded one by one; return how many, and Adler-32's two sums over all bytes.

    Sums of a word's bytes are those of 16-bit lanes, added up by a multiplication.
    """
    low, high = _U(1), _U(0)
    found, zeros, before = _U(0), _U(0), _U(1)
    count = words.size // 2
    for group in range(0, count, 4):
        own = min(4, count - group)
        if own == 4:
            at, union = _U(2 * group), before
            for i in range(8):
                union |= words[at + _U(i)]
            if union == 0:
                zeros += _U(4)
                continue
        for k in range(group, group + own):
            first, second = words[_U(2 * k)], words[_U(2 * k + 1)]
            if (first | second | before) == 0:
                zeros += _U(1)
                continue
            literals[found] = k
            found += _U(1)
            high += _U(SEGMENT) * zeros * low
            zeros = _U(0)
            even, odd = first & _LANES, (first >> _U(8)) & _LANES
            own_sum = ((even + odd) * _ONES) >> _U(48)
            even += second & _LANES
            odd += (second >> _U(8)) & _LANES
            high += _U(SEGMENT) * low + _U(8) * own_sum + ((even * _FALLING_EVEN + odd * _FALLING_ODD) >> _U(48))
            low += ((even + odd) * _ONES) >> _U(48)
            before = second >> _U(56)
    high += _U(SEGMENT) * zeros * low
    for i in range(rest.size):
        low += _U(rest[i])
        high += low
    return found, low, high


@bare_inlined
def length_symbol(run):
    """Return the symbol of a match of 3 to 258 bytes, its extra bits, and their number."""
    if run == _LONGEST_RUN:
        return _LONGEST, 0, 0
    above = run - 3
    if above < 8:
        return 257 + above, 0, 0
    bits = 0
    while (above >> bits) >= 8:
        bits += 1
    return 257 + 4 * bits + (above >> bits), above & ((1 << bits) - 1), bits


@kernel
def _count(data, literals, counts):
    """Count the symbols of a sample, at least one of each."""
    four = np.zeros((4, 256), np.int64).ravel()  # consecutive equal bytes would wait for each other
    counts[:] = 0
    step = 1 + literals.size // _SAMPLE
    for j in range(0, literals.size, step):
        at = _U(literals[j] * SEGMENT)
        for i in range(SEGMENT):
            four[_U(256 * (i % 4)) + _U(data[at + _U(i)])] += 1
        gap = literals[j] - literals[j - 1] - 1 if j > 0 else 0
        if gap < _SHORTEST_GAP:
            counts[0] += SEGMENT * gap
        else:
            counts[_LONGEST] += SEGMENT * gap // _LONGEST_RUN
            counts[length_symbol(max(SEGMENT * gap % _LONGEST_RUN, 3))[0]] += 1
    total = 0
    for s in range(SYMBOLS):
        if s < 256:
            counts[s] += four[s] + four[256 + s] + four[512 + s] + four[768 + s]
        total += counts[s]
    least = (total >> (_MOST_BITS - 1)) + 1
    for s in range(SYMBOLS):
        counts[s] += least


@kernel
def code(counts, entries):
    """Write each symbol's code, first bit lowest, and above 16 bits of it its length.

    Lengths are those of Shannon (1948), shortened where most is won until the code is complete.
    """
    total = 0
    for s in range(SYMBOLS):
        total += counts[s]
    lengths = np.empty(SYMBOLS, np.int64)
    room = 1 << _MOST_BITS
    for s in range(SYMBOLS):
        length = 1
        while (counts[s] << length) < total:
            length += 1
        lengths[s] = length
        room -= 1 << (_MOST_BITS - length)
    share = 32
    while room > 0:
        for s in range(SYMBOLS):
            price = 1 << (_MOST_BITS - lengths[s])
            if price <= room and 16 * (counts[s] << lengths[s]) >= share * total and lengths[s] > 1:
                lengths[s] -= 1
                room -= price
        share = max(share - 1, 0)
    following = 0
    for length in range(1, _MOST_BITS + 1):
        following <<= 1
        for s in range(SYMBOLS):
            if lengths[s] == length:
                code = 0
                for bit in range(length):
                    code |= ((following >> bit) & 1) << (length - 1 - bit)
                entries[s] = np.uint32(code | (length << 16))
                following += 1


@bare
def head(entries, distances, words):
    """Write zlib's header and the block's code; return (current word, its index, its bits).

    distances : (codes,) uint8, lengths of the codes of distances, 0 or 1 bit.
    """
    word, used, to = _U(0), _U(0), _U(0)
    for k in range(6 + 19 + SYMBOLS + distances.size):
        if k == 0:
            bits, count = _U(0x0178), _U(16)  # deflate with a window of 32 KiB, fastest level
        elif k == 1:
            bits, count = _U(1), _U(1)  # last block,
        elif k == 2:
            bits, count = _U(2), _U(2)  # dynamic Huffman code
        elif k == 3:
            bits, count = _U(SYMBOLS - 257), _U(5)
        elif k == 4:
            bits, count = _U(distances.size - 1), _U(5)
        elif k == 5:
            bits, count = _U(19 - 4), _U(4)
        elif k < 6 + 3:
            bits, count = _U(0), _U(3)  # repetition codes are not used
        elif k < 6 + 19:
            bits, count = _U(4), _U(3)
        else:
            s = k - 6 - 19
            length = _U(entries[s] >> 16) if s < SYMBOLS else _U(distances[s - SYMBOLS])
            bits = (
                ((length & _U(1)) << _U(3))
                | ((length & _U(2)) << _U(1))
                | ((length >> _U(1)) & _U(2))
                | (length >> _U(3))
            )
            count = _U(4)
        words[to], word, used, full = appended(word, used, bits, count)
        to += full
    return word, to, used


@kernel
def _pair_up(entries, pairs):
    """Write the codes of all pairs of bytes, the first one lowest, and above 27 bits of it their length."""
    bits, lengths = np.empty(256, np.uint32), np.empty(256, np.uint32)
    for s in range(256):
        bits[s], lengths[s] = entries[s] & np.uint32(0xFFFF), entries[s] >> np.uint32(16)
    for second in range(256):
        own, size = bits[second], lengths[second]
        row = pairs[256 * second : 256 * second + 256]
        for s in range(256):
            row[s] = bits[s] | (own << lengths[s]) | ((lengths[s] + size) << np.uint32(_PAIR_BITS))


@bare_inlined
def coded(entries, symbol):
    """Return a symbol's code, first bit lowest, and its length in bits."""
    entry = _U(entries[symbol])
    return entry & _U(0xFFFF), entry >> _U(16)


@bare
def _run(run, entries, words, word, to, used):
    """Write zeros that follow a zero."""
    while run > 2:
        piece = min(run, _LONGEST_RUN)
        run -= piece
        symbol, more, count = length_symbol(piece)
        bits, size = coded(entries, symbol)
        words[to], word, used, full = appended(word, used, bits | (_U(more) << size), size + _U(count) + _U(1))
        to += full  # the distance 1 is a single bit, 0
    for _ in range(run):
        bits, size = coded(entries, 0)
        words[to], word, used, full = appended(word, used, bits, size)
        to += full
    return word, to, used


@bare
def _pack(data, pixels, literals, entries, distances, pairs, words):
    """Write the head, all bytes and the block's end; return the bits written."""
    word, to, used = head(entries, distances, words)
    following = 0
    for j in range(literals.size):
        k = np.int64(literals[j])
        if k - following >= _SHORTEST_GAP:
            word, to, used = _run(SEGMENT * (k - following), entries, words, word, to, used)
            following = k
        for at in range(following * (SEGMENT // 8), (k + 1) * (SEGMENT // 8)):
            eight = pixels[_U(at)]
            for _ in range(2):
                one, two = pairs[eight & _PAIR], pairs[(eight >> _U(16)) & _PAIR]
                eight >>= _U(32)
                size = _U(one >> np.uint32(_PAIR_BITS))
                bits = _U(one & _PAIR_MASK) | (_U(two & _PAIR_MASK) << size)
                words[to], word, used, full = appended(word, used, bits, size + _U(two >> np.uint32(_PAIR_BITS)))
                to += full
        following = k + 1
    whole = data.size // SEGMENT * SEGMENT
    word, to, used = _run(whole - SEGMENT * following, entries, words, word, to, used)
    for i in range(whole, data.size + 1):
        bits, size = coded(entries, np.int64(data[i]) if i < data.size else END)
        words[to], word, used, full = appended(word, used, bits, size)
        to += full
    words[to] = word
    return np.int64(to) * 64 + np.int64(used)


def deflate(data: Any, words: Any, segments: Any, pairs: Any, out: Any) -> bytes:
    """Return a zlib stream. Its parts are called from here: as one kernel they take twice as long to compile.

    Parameters
    ----------
    data : (n,) uint8; words : (2 · (n // SEGMENT),) uint64, the same memory without its last bytes.
    segments : (n // SEGMENT,) int32, scratch; pairs : (PAIRS,) uint32, scratch.
    out : uint64, room_words(n) or more, scratch.
    """
    counts, entries = np.empty(SYMBOLS, np.int64), np.empty(SYMBOLS, np.uint32)
    found, low, high = _segments(words, data[8 * words.size :], segments)
    literals = segments[:found]
    _count(data, literals, counts)
    code(counts, entries)
    _pair_up(entries, pairs)
    bits = _pack(data, words, literals, entries, _DISTANCE, pairs, out)
    stream: bytes = out.view(np.uint8)[: (bits + 7) // 8].tobytes()
    return stream + (int(high) % ADLER << 16 | int(low) % ADLER).to_bytes(4, "big")


@inlined
def appended(word, used, bits, count):
    """Append `count` bits to the `used` bits of a word; return (first word, current word, its bits, 1 if it is new).

    A new word follows where the old one is full.
    """
    now = word | (bits << used)
    total = used + count
    full = total >> _U(6)
    following = (bits >> _U(1)) >> (_U(63) - used)
    return now, following if full else now, total & _U(63), full
