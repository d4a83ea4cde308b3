"""Points of a model of the pavement → chunks of LAZ (layered, point format 6), to the bit as other writers make them.

What all points share (returns, class, angle, user data, source, time) costs nothing here; general writers look at each
of it. A chunk is the first point as it is, the number of points, the size of each layer, and the layers (LASzip,
*compression of the point types 6 to 10*, 2017).
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.arithmetic_coder import HEAD, WHOLE, finished, model, number_models, put_number, put_symbol
from roadscan.kernels.copies import copy_values
from roadscan.kernels.options import bare, bare_inlined, kernel

_U = np.uint64
LAYERS = 9
"""Of point format 6: places and returns, heights, class, flags, intensity, angle, user data, source, time."""
_XY, _Z, _FLAGS, _INTENSITY = 0, 1, 3, 4
_POINT = 30
"""Bytes of point format 6; further dimensions follow."""
_SIZE = 4
_SAME, _BYTE, _FLAG = 128, 256, 64
"""Symbols of models: which fields changed, a byte, the flags."""
_ONE_OF_ONE = 0x11

_SAME_MODEL, _BYTE_MODEL, _FLAG_MODELS = model(_SAME), model(_BYTE), np.tile(model(_FLAG), _FLAG)
_X_MODELS, _Y_MODELS, _Z_MODELS, _LIGHT_MODELS = (
    number_models(bits, contexts) for bits, contexts in ((32, 2), (32, 22), (32, 20), (16, 4))
)
_ALL = (_SAME_MODEL, _X_MODELS, _Y_MODELS, _Z_MODELS, _FLAG_MODELS, _LIGHT_MODELS, _BYTE_MODEL)
MODELS = np.concatenate(_ALL)
"""All models as a chunk begins."""
_SAME_AT, _X_AT, _Y_AT, _Z_AT, _FLAGS_AT, _LIGHT_AT, _BYTE_AT = (
    _U(sum(part.size for part in _ALL[:k])) for k in range(len(_ALL))
)


def room(points: int, size: int) -> int:
    """Bytes that a chunk takes at most, of points of so many bytes each: two a symbol, three where bits are plain."""
    return (points + LAYERS) * (60 + 3 * size)


@bare_inlined
def _number(points, p, at):
    """Four bytes as a whole number with a sign."""
    low = np.uint32(points[p, at]) | np.uint32(points[p, at + 1]) << np.uint32(8)
    high = np.uint32(points[p, at + 2]) | np.uint32(points[p, at + 3]) << np.uint32(8)
    return np.int64(np.int32(low | high << np.uint32(16)))


@bare_inlined
def _median_with(seen, add):
    """Take a number among the five that a running median keeps, sorted; seen[5] says which end gives way."""
    if seen[5] == 0:
        if add < seen[2]:
            seen[4], seen[3] = seen[3], seen[2]
            k = 0 if add < seen[0] else 1 if add < seen[1] else 2
            if k < 2:
                seen[2] = seen[1]
            if k < 1:
                seen[1] = seen[0]
            seen[k] = add
        else:
            if add < seen[3]:
                seen[4], seen[3] = seen[3], add
            else:
                seen[4] = add
            seen[5] = 1
    elif seen[2] < add:
        seen[0], seen[1] = seen[1], seen[2]
        k = 4 if seen[4] < add else 3 if seen[3] < add else 2
        if k > 2:
            seen[2] = seen[3]
        if k > 3:
            seen[3] = seen[4]
        seen[k] = add
    else:
        if seen[1] < add:
            seen[0], seen[1] = seen[1], add
        else:
            seen[0] = add
        seen[5] = 0


@bare
def _places(points, models, seen, widths, out, to):
    """Layer of places; widths[p]: bits of the steps to the point, both together."""
    base, length = _U(0), WHOLE
    seen[:] = 0
    east, north = _number(points, 0, 0), _number(points, 0, 4)
    for p in range(1, points.shape[0]):
        to, base, length = put_symbol(models, _SAME_AT, _U(_SAME), _U(0), out, to, base, length)
        x, y = _number(points, p, 0), _number(points, p, 4)
        step, rise = np.int64(np.int32(x - east)), np.int64(np.int32(y - north))
        to, base, length, k = put_number(
            models, _X_AT, 32, 2, _U(1), np.int64(np.int32(step - seen[0, 2])), out, to, base, length
        )
        _median_with(seen[0], step)
        context = _U(1) + (k & ~_U(1) if k < _U(20) else _U(20))
        to, base, length, more = put_number(
            models, _Y_AT, 32, 22, context, np.int64(np.int32(rise - seen[1, 2])), out, to, base, length
        )
        _median_with(seen[1], rise)
        widths[p] = k + more
        east, north = x, y
    return finished(out, to, base, length)


@bare
def _heights(points, models, widths, out, to):
    base, length = _U(0), WHOLE
    last = _number(points, 0, 8)
    for p in range(1, points.shape[0]):
        k = _U(widths[p]) >> _U(1)
        context = _U(1) + (k & ~_U(1) if k < _U(18) else _U(18))
        z = _number(points, p, 8)
        to, base, length, _ = put_number(
            models, _Z_AT, 32, 20, context, np.int64(np.int32(z - last)), out, to, base, length
        )
        last = z
    return finished(out, to, base, length)


@bare
def _lights(points, models, out, to):
    base, length = _U(0), WHOLE
    last = np.int64(points[0, 12]) | np.int64(points[0, 13]) << 8
    for p in range(1, points.shape[0]):
        light = np.int64(points[p, 12]) | np.int64(points[p, 13]) << 8
        to, base, length, _ = put_number(
            models, _LIGHT_AT, 16, 4, _U(3), np.int64(np.int16(light - last)), out, to, base, length
        )
        last = light
    return finished(out, to, base, length)


@bare
def _flags(points, models, out, to):
    base, length = _U(0), WHOLE
    for p in range(1, points.shape[0]):
        own = _FLAGS_AT + _U(points[p - 1, 15]) * _U(HEAD + 2 * _FLAG)
        to, base, length = put_symbol(models, own, _U(_FLAG), _U(points[p, 15]), out, to, base, length)
    return finished(out, to, base, length)


@bare
def _bytes(points, k, models, out, to):
    """Layer of the byte `k` of a point."""
    base, length = _U(0), WHOLE
    for p in range(1, points.shape[0]):
        step = np.uint8(points[p, k] - points[p - 1, k])
        to, base, length = put_symbol(models, _BYTE_AT, _U(_BYTE), _U(step), out, to, base, length)
    return finished(out, to, base, length)


@bare_inlined
def _changes(points, first, last):
    """Whether some of the bytes `first` to `last` − 1 differ from point to point."""
    for p in range(1, points.shape[0]):
        for k in range(first, last):
            if points[p, k] != points[p - 1, k]:
                return True
    return False


@bare
def is_model(points):
    """True if points share all that a chunk's kernel takes to be the same."""
    same = points[0, 14] == _ONE_OF_ONE and not _changes(points, 14, 15) and not _changes(points, 16, _POINT)
    for p in range(points.shape[0]):
        same = same and points[p, 15] < 16
    return same


@bare
def _sized(sizes, layer, size):
    for k in range(_SIZE):
        sizes[_SIZE * layer + k] = (size >> _U(8 * k)) & _U(255)


@bare
def _chunk(points, start, models, seen, widths, out):
    n, size = points.shape
    to = _U(0)
    for k in range(size):
        out[k] = points[0, k]
    counted, further = size, size - _POINT
    sizes = out[size:]
    _sized(sizes, 0, _U(n))
    sizes = sizes[_SIZE:]
    for layer in range(LAYERS + further):
        _sized(sizes, layer, _U(0))
    copy_values(start, models)
    to = _U(counted + _SIZE * (1 + LAYERS + further))
    end = _places(points, models, seen, widths, out, to)
    _sized(sizes, _XY, end - to)
    to = end
    end = _heights(points, models, widths, out, to)
    _sized(sizes, _Z, end - to)
    to = end
    if _changes(points, 15, 16):
        end = _flags(points, models, out, to)
        _sized(sizes, _FLAGS, end - to)
        to = end
    if _changes(points, 12, 14):
        end = _lights(points, models, out, to)
        _sized(sizes, _INTENSITY, end - to)
        to = end
    for k in range(further):
        if not _changes(points, _POINT + k, _POINT + k + 1):
            continue
        copy_values(start[np.int64(_BYTE_AT) :], models[np.int64(_BYTE_AT) :])
        end = _bytes(points, _POINT + k, models, out, to)
        _sized(sizes, LAYERS + k, end - to)
        to = end
    return np.int64(to)


@kernel
def pack_chunk(points, start, models, seen, widths, out):
    """Make a chunk of points.

    Parameters
    ----------
    points : (n, 30 and more) uint8, point records of format 6 as in a LAS file, n of 1 or more.
    start : MODELS; models : of its size, uint32, scratch.
    seen : (2, 6) int64, widths : (n,) uint8, scratch.
    out : (room(n, bytes of a point),) uint8, out.

    Returns
    -------
    int, bytes written; 0 if the points differ in more than place, intensity, flags and further dimensions.
    """
    if not is_model(points):
        return 0
    return _chunk(points, start, models, seen, widths, out)
