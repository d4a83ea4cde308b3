"""LZF, the compression of PCD files (LibLZF, M. Lehmann)."""

from __future__ import annotations

from roadscan.compute.kernel_options import kernel

_LITERALS = 32  # control bytes below it announce as many literal bytes, and one
_LONG = 7  # length from which another byte adds to it


@kernel
def expand(packed, out):
    """Expand LZF data: runs of literal bytes, and copies of 3 to 264 bytes from up to 8,192 bytes back.

    Parameters
    ----------
    packed : (n,) uint8; out : (m,) uint8, out.

    Returns
    -------
    int, how many bytes of `out` were written before the data ended, or contradicted themselves.
    """
    at, end, written, room = 0, packed.size, 0, out.size
    while at < end:
        control = int(packed[at])
        at += 1
        if control < _LITERALS:
            count = control + 1
            if at + count > end or written + count > room:
                return written
            for k in range(count):
                out[written + k] = packed[at + k]
            at += count
        else:
            count = control >> 5
            if count == _LONG:
                if at >= end:
                    return written
                count += int(packed[at])
                at += 1
            count += 2
            if at >= end:
                return written
            back = ((control & 31) << 8) + int(packed[at]) + 1
            at += 1
            if back > written or written + count > room:
                return written
            for k in range(count):  # byte by byte: a copy may reach into itself
                out[written + k] = out[written + k - back]
        written += count
    return written
