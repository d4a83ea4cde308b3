"""Ways to damage a file: bytes, structure of binary headers, structure of text, packed content.

A change is a function of the bytes and a source of random numbers. The same numbers give the same damage.
"""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable, Sequence

Change = Callable[[bytes, random.Random], bytes]
Inside = Callable[[bytes, random.Random, Change], bytes]
"""Takes a packed or checksummed file, changes what is inside, and packs it again soundly."""

LONG_LINE = 2 << 20
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_ODD_NUMBERS = (
    b"nan", b"NaN", b"-nan", b"inf", b"-Infinity", b"1e308", b"-1e308", b"1e999", b"5e-324", b"0", b"-0", b"-1", b"",
    b" ", b"1_000", b"0x10", b"1,5", b"1.2.3", b"--1", b"+", b"e5", b"9223372036854775807", b"9223372036854775808",
    b"-9223372036854775809", b"4294967296", b"2147483648", b"99999999999999999999999", b"0" * 400 + b"1", b"9" * 5000,
    b"1." + b"3" * 20_000, "١٢٣".encode(), "１２".encode(), b"1\x00", b"\xff\xfe", b'"5"', b"'5'", b"true", b"null",
    b"*missing*",
)  # fmt: skip
_ODD_TEXT = (
    b",", b";", b"\t", b" ", b"\n", b"\r", b"\r\n", b"\n\n\n", b'"', b'""', b'"\n', b"\x00", b"\xff", b"\xef\xbb\xbf",
    b"#", b"%", b"$", b"!", b"*", b"<", b">", b"&", b"{", b"}", b"[", b"]", b"\\", b"\x1a", b"\x0c", b"\x85",
    "°".encode(), "\u2028".encode(),
)  # fmt: skip
_INTEGERS = (0, 1, 2, -1, -2, 7, 255, 256, 32_767, 32_768, 65_535, 65_536, 10**6, 1 << 24, 1 << 30, (1 << 31) - 1,
             1 << 31, (1 << 32) - 1, 1 << 32, 10**12, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip
_DOUBLES = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324, 1e-300, 1e10, 1e20,
            -1e20, 604_800.0, 0.5)  # fmt: skip
_SPANS = (1, 1, 1, 2, 4, 8, 16, 40, 136, 400)


# --- any bytes --------------------------------------------------------------------------------------


def overwritten(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data) + 1), rng.choice(_SPANS)
    return data[:at] + rng.randbytes(min(size, len(data) - at)) + data[at + size :]


def flipped(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 3, 20))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def cut_out(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.choice(_SPANS) :]


def doubled(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at : at + rng.choice(_SPANS)] * rng.choice((2, 2, 3, 50)) + data[at + 1 :]


def put_in(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice(_SPANS)) + data[at:]


def cut_off(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice((rng.randrange(len(data) + 1), max(0, len(data) - rng.randrange(64)), rng.randrange(64)))]


def swapped(data: bytes, rng: random.Random) -> bytes:
    a, b, c, d = sorted(rng.randrange(len(data) + 1) for _ in range(4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def blanked(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    b = min(b, a + rng.choice((4, 64, 512, 1 << 20)))
    return data[:a] + rng.choice((b"\x00", b"\xff", b" ", b"0")) * (b - a) + data[b:]


def twice(data: bytes, rng: random.Random) -> bytes:
    return data + rng.choice((data, data[: rng.randrange(len(data) + 1)], data[rng.randrange(len(data) + 1) :]))


def with_tail(data: bytes, rng: random.Random) -> bytes:
    return data + rng.choice((rng.randbytes(rng.choice(_SPANS)), bytes(1000), b"\n" * 1000, bytes(1 << 17)))


ANY: tuple[Change, ...] = (
    overwritten, flipped, flipped, cut_out, doubled, put_in, cut_off, swapped, blanked, twice, with_tail,
)  # fmt: skip


# --- numbers in binary structures -------------------------------------------------------------------


def numbers_claimed(fields: Sequence[int]) -> Change:
    """A count, length, offset or coordinate replaced by an extreme one; mostly at `fields` (byte offsets)."""

    def change(data: bytes, rng: random.Random) -> bytes:
        if len(data) < 8:
            return data
        at = rng.choice((
            rng.choice(fields) if fields else min(len(data) - 1, int(rng.expovariate(1 / 150))),
            min(len(data) - 1, int(rng.expovariate(1 / 150))),
            max(0, len(data) - 1 - int(rng.expovariate(1 / 100))),
            rng.randrange(len(data)),
        ))  # fmt: skip
        piece = _number(len(data), rng)
        return data[:at] + piece + data[at + len(piece) :]

    return change


def _number(size: int, rng: random.Random) -> bytes:
    order = rng.choice("<<>")
    if rng.random() < 0.25:
        return struct.pack(order + rng.choice("fd"), _single(rng.choice(_DOUBLES)))
    code = rng.choice("BHIQ")
    value = rng.choice((rng.choice(_INTEGERS), size + rng.choice((-1, 0, 1)), 2 * size, size // 2))
    return struct.pack(order + code, value % (1 << 8 * struct.calcsize(code)))


def _single(value: float) -> float:
    """The value, or the nearest that four bytes can hold."""
    return value if not abs(value) > 3e38 or abs(value) == float("inf") else 3e38


# --- text -------------------------------------------------------------------------------------------


def odd_number(data: bytes, rng: random.Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(_ODD_NUMBERS) + data[match.end() :]


def odd_text(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(_ODD_TEXT) + data[at + rng.choice((0, 0, 1)) :]


def lines_moved(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 1:
        lines.insert(b, lines[a])
    elif kind == 2:
        lines.insert(b, lines[0])  # a second header
    elif kind == 3:
        del lines[a]
    else:
        lines[a] = lines[a].rstrip(b"\r\n")
    return b"".join(lines)


def fields_moved(data: bytes, rng: random.Random) -> bytes:
    """A field of a line lost, doubled, or put elsewhere in it: mostly the line of names."""
    lines = data.split(b"\n")
    i = rng.choice((0, rng.randrange(len(lines))))
    mark = max((b",", b";", b"\t", b" "), key=lines[i].count)
    words = lines[i].split(mark)
    a, b = rng.randrange(len(words)), rng.randrange(len(words))
    kind = rng.randrange(4)
    if kind == 0:
        words[a], words[b] = words[b], words[a]
    elif kind == 1:
        words.insert(b, words[a])
    elif kind == 2:
        del words[a]
    else:
        words[a] = words[b]
    lines[i] = mark.join(words)
    return b"\n".join(lines)


def line_ends(data: bytes, rng: random.Random) -> bytes:
    end = rng.choice((b"\r\n", b"\r", b"\n\n", b"\n\r", b" ", b""))
    return b"\xef\xbb\xbf" * rng.randrange(2) + data.replace(b"\n", end, rng.choice((-1, 1, 3)))


def long_line(data: bytes, rng: random.Random) -> bytes:
    """A line of megabytes: one word, many fields, or many short lines."""
    at = rng.choice((0, len(data), rng.randrange(len(data) + 1)))
    unit = rng.choice((b"x", b"1", b"1,", b"nan ", b'"', b"\x00", b"\r", b"\n", b"#", b" ", b"<a>", b"[", b'{"a":'))
    return data[:at] + unit * (rng.choice((70_000, LONG_LINE)) // len(unit)) + data[at:]


TEXT: tuple[Change, ...] = (
    odd_number,
    odd_number,
    odd_number,
    odd_text,
    odd_text,
    lines_moved,
    fields_moved,
    line_ends,
)


# --- all together -----------------------------------------------------------------------------------


def changed(
    data: bytes, rng: random.Random, *, text: bool, fields: Sequence[int] = (), inside: Inside | None = None
) -> bytes:
    """One to three changes, of the file itself or of what it holds inside."""
    if rng.random() < 0.004:
        change: Change = long_line
    else:
        kinds = (*ANY, *TEXT, *TEXT) if text else (*ANY, *[numbers_claimed(fields)] * 9, odd_text)
        steps = [rng.choice(kinds) for _ in range(rng.choice((1, 1, 2, 3)))]

        def change(part: bytes, draw: random.Random) -> bytes:
            for step in steps:
                part = step(part, draw)
            return part

    if inside is not None and rng.random() < 0.6:
        return inside(data, rng, change)
    return change(data, rng)
