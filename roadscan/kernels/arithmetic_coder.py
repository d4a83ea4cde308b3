"""The adaptive arithmetic coder of LAZ: symbols and whole numbers → bytes.

(Said 2004, *Introduction to Arithmetic Coding*, HP Labs HPL-2004-76; Isenburg 2013, *LASzip: lossless compression of
LiDAR data*, PE&RS 79.) A coder is three numbers: `to`, where its next byte goes, and `base` and `length`, its interval
of 32 bits. All models lie in one array of 32-bit numbers; a model is named by its place there.
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import bare, bare_inlined

_U = np.uint64
WHOLE = _U(2**32 - 1)
"""Length of the interval that a coder starts with."""
_SHORTEST = _U(2**24)
_TOTAL, _CYCLE, _LEFT, HEAD = _U(0), _U(1), _U(2), 3
"""Places in a model: sum of its counts, symbols from one renewal to the next, those left; then counts, then shares."""
_MOST = 2**15
"""Counts are halved beyond this sum."""
_BIT_ZEROS, _BIT_TOTAL, _BIT_SHARE, _BIT_CYCLE, _BIT_LEFT, BIT_ROOM = _U(0), _U(1), _U(2), _U(3), _U(4), 5
_HIGH_BITS = 8
"""Of a number so many are modelled, the rest are written as they are."""
_HIGH_ROOM = HEAD + 2 * 2**_HIGH_BITS


def model(symbols: int) -> np.ndarray:
    """A model in which all symbols are as likely; (HEAD + 2 · symbols,) uint32."""
    scale = 2**31 // symbols
    cycle = (symbols + 6) >> 1
    shares = [(scale * s) >> 16 for s in range(symbols)]
    return np.array([symbols, cycle, cycle, *[1] * symbols, *shares], np.uint32)


def number_models(bits: int, contexts: int) -> np.ndarray:
    """Models of :func:`put_number`, one behind the other."""
    parts = [np.array([1, 2, 2**12, 4, 4], np.uint32), *[model(bits + 1)] * contexts]
    for k in range(1, bits + 1):
        part = model(2 ** min(k, _HIGH_BITS))
        parts.append(np.pad(part, (0, _HIGH_ROOM - part.size)))
    return np.concatenate(parts)


@bare
def _renew(models, at, symbols):
    """Shares of a model by its counts."""
    counts, shares = at + _U(HEAD), at + _U(HEAD) + symbols
    total = models[at + _TOTAL] + models[at + _CYCLE]
    if total > _MOST:
        total = np.uint32(0)
        for s in range(symbols):
            models[counts + s] = (models[counts + s] + np.uint32(1)) >> np.uint32(1)
            total += models[counts + s]
    models[at + _TOTAL] = total
    scale, below = _U(2**31) // _U(total), _U(0)
    for s in range(symbols):
        models[shares + s] = (scale * below) >> _U(16)
        below += _U(models[counts + s])
    cycle = min((_U(5) * _U(models[at + _CYCLE])) >> _U(2), (symbols + _U(6)) << _U(3))
    models[at + _CYCLE] = models[at + _LEFT] = cycle


@bare
def _carry(out, to):
    """Add 1 to the bytes written."""
    k = to - _U(1)
    while out[k] == 255:
        out[k] = 0
        k -= _U(1)
    out[k] += 1


@bare_inlined
def _settled(out, to, base, length):
    """Write the bytes of an interval that are certain: up to three, and what lies behind them is written over later."""
    if base > WHOLE:
        _carry(out, to)
        base &= WHOLE
    out[to] = base >> _U(24)
    out[to + _U(1)] = base >> _U(16)
    out[to + _U(2)] = base >> _U(8)
    sure = _U(length < _U(2**24)) + _U(length < _U(2**16)) + _U(length < _U(2**8))
    shift = sure << _U(3)
    return to + sure, (base << shift) & WHOLE, length << shift


@bare_inlined
def put_symbol(models, at, symbols, symbol, out, to, base, length):
    """Write a symbol by the model at `at`; all whole numbers are uint64."""
    share = at + _U(HEAD) + symbols + symbol
    if symbol + _U(1) == symbols:
        below = _U(models[share]) * (length >> _U(15))
        length -= below
    else:
        length >>= _U(15)
        below = _U(models[share]) * length
        length = _U(models[share + _U(1)]) * length - below
    to, base, length = _settled(out, to, base + below, length)
    models[at + _U(HEAD) + symbol] += np.uint32(1)
    left = models[at + _LEFT] - np.uint32(1)
    models[at + _LEFT] = left
    if left == 0:
        _renew(models, at, symbols)
    return to, base, length


@bare_inlined
def _put_bit(models, at, bit, out, to, base, length):
    below = _U(models[at + _BIT_SHARE]) * (length >> _U(13))
    if bit == 0:
        length = below
        models[at + _BIT_ZEROS] += np.uint32(1)
    else:
        base += below
        length -= below
    to, base, length = _settled(out, to, base, length)
    models[at + _BIT_LEFT] -= np.uint32(1)
    if models[at + _BIT_LEFT] == 0:
        _renew_bit(models, at)
    return to, base, length


@bare
def _renew_bit(models, at):
    zeros, total = _U(models[at + _BIT_ZEROS]), _U(models[at + _BIT_TOTAL]) + _U(models[at + _BIT_CYCLE])
    if total > _U(2**13):
        total, zeros = (total + _U(1)) >> _U(1), (zeros + _U(1)) >> _U(1)
        total += _U(zeros == total)
    models[at + _BIT_ZEROS], models[at + _BIT_TOTAL] = zeros, total
    models[at + _BIT_SHARE] = (zeros * (_U(2**31) // total)) >> _U(18)
    cycle = min((_U(5) * _U(models[at + _BIT_CYCLE])) >> _U(2), _U(64))
    models[at + _BIT_CYCLE] = models[at + _BIT_LEFT] = cycle


@bare_inlined
def _put_plain(bits, value, out, to, base, length):
    """Write up to 32 bits as they are, the lower 16 first where there are more than 19."""
    if bits > _U(19):
        length >>= _U(16)
        to, base, length = _settled(out, to, base + (value & _U(0xFFFF)) * length, length)
        value >>= _U(16)
        bits -= _U(16)
    length >>= bits
    return _settled(out, to, base + value * length, length)


@bare_inlined
def _bits_of(value):
    """Bits that a number below 2³² has."""
    bits = _U(0)
    for step in (_U(16), _U(8), _U(4), _U(2), _U(1)):
        more = step if value >> step else _U(0)
        value >>= more
        bits += more
    return bits + value


@bare
def put_number(models, at, bits, contexts, context, number, out, to, base, length):
    """Write a whole number of up to `bits` bits and a sign: first how many bits it has, by the model of its context.

    Returns
    -------
    to, base, length, and the bits.
    """
    far = -number if number <= 0 else number - 1
    k = _bits_of(_U(far))
    symbols = _U(bits + 1)
    first = at + _U(BIT_ROOM)
    to, base, length = put_symbol(
        models, first + _U(context) * (_U(HEAD) + _U(2) * symbols), symbols, k, out, to, base, length
    )
    if k == _U(0):
        to, base, length = _put_bit(models, at, number, out, to, base, length)
        return to, base, length, k
    if k == _U(32):
        return to, base, length, k
    own = first + _U(contexts) * (_U(HEAD) + _U(2) * symbols) + (k - _U(1)) * _U(_HIGH_ROOM)
    value = _U(number - 1 if number >= 0 else number + (1 << np.int64(k)) - 1)
    low = k - _U(_HIGH_BITS) if k > _U(_HIGH_BITS) else _U(0)
    to, base, length = put_symbol(models, own, _U(1) << (k - low), value >> low, out, to, base, length)
    if low > _U(0):
        to, base, length = _put_plain(low, value & ((_U(1) << low) - _U(1)), out, to, base, length)
    return to, base, length, k


@bare
def finished(out, to, base, length):
    """Write what a reader needs to tell the last symbol; returns where the next byte goes."""
    long = length > _U(2) * _SHORTEST
    base += _SHORTEST if long else _SHORTEST >> _U(1)
    to, base, length = _settled(out, to, base, _SHORTEST >> _U(1) if long else _SHORTEST >> _U(9))
    for _ in range(3 if long else 2):
        out[to] = 0
        to += _U(1)
    return to
