"""Parquet's RLE_DICTIONARY of columns that keep a value for many rows: its runs, never its bit-packed groups.

A page begins with the bits of an index; each run is twice its length as a varint, then the index in whole bytes
(Apache Parquet format, *Encodings.md*, "RLE / bit-packing hybrid").
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel

LONGEST_RUN_BYTES = 14
"""Bytes of a run at most: a varint of 64 bits, and an index of 32."""
_MOST_BITS = 32  # of an index
_U = np.uint64


@kernel
def encode_runs(lengths, indices, bits, page):
    """Write the page of runs (r,) of dictionary indices of `bits` bits; return its bytes.

    Parameters
    ----------
    lengths, indices : int64; no run is empty.
    page : (1 + LONGEST_RUN_BYTES · r,) uint8, out.
    """
    page[0] = bits
    at = 1
    for k in range(lengths.size):
        head = _U(lengths[k]) << _U(1)
        while head > _U(127):
            page[at] = np.uint8(head & _U(127)) | np.uint8(128)
            head >>= _U(7)
            at += 1
        page[at] = np.uint8(head)
        at += 1
        for byte in range((bits + 7) // 8):
            page[at] = np.uint8((_U(indices[k]) >> _U(8 * byte)) & _U(255))
            at += 1
    return at


@kernel
def decode_runs(page, rows, known, ends, indices):
    """Write the runs of a page: the row after each, and its dictionary index; return their number, −1 at damage.

    Parameters
    ----------
    page : (n,) uint8.
    rows : int, the rows that all runs have together.
    known : int, the values of the dictionary.
    ends, indices : (page bytes,) int64, out.
    """
    if page.size == 0 or page[0] > _MOST_BITS:
        return -1
    index_bytes = (np.int64(page[0]) + 7) // 8
    at, end, count = 1, 0, 0
    while at < page.size:
        head, shift = 0, 0
        while True:
            if at >= page.size or shift > 56:
                return -1
            byte = np.int64(page[at])
            head |= (byte & 127) << shift
            at += 1
            shift += 7
            if byte < 128:
                break
        index = 0
        if at + index_bytes > page.size:
            return -1
        for k in range(index_bytes):
            index |= np.int64(page[at + k]) << (8 * k)
        at += index_bytes
        length = head >> 1
        if head & 1 or length <= 0 or length > rows - end or index >= known:
            return -1
        end += length
        ends[count], indices[count] = end, index
        count += 1
    return count if end == rows else -1
