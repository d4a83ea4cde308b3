"""Points of a model as LAZ: the bytes that lazrs makes of them, whose own reader is the format's reference here."""

from __future__ import annotations

import io

import lazrs
import numpy as np
import pytest

from roadscan.products.laz_points import write_compressed

RECORD = np.dtype(
    [("xyz", "<i4", 3), ("light", "<u2"), ("returns", "u1"), ("flags", "u1"), ("class", "u1"), ("user", "u1"),
     ("angle", "<i2"), ("source", "<u2"), ("time", "<f8"), ("cells", "<u2"), ("points", "<u2")]
)  # fmt: skip


def model(n, rng):
    """A raster's points, with gaps, jumps over the whole range, and noise of every size."""
    points = np.zeros(n, RECORD)
    row, column = divmod(np.flatnonzero(rng.random(4 * n + 50) < 0.4)[:n], 500)
    height = np.cumsum(rng.normal(0, 40, n)) + rng.normal(0, 2.0 ** rng.integers(0, 12, n))
    points["xyz"] = np.stack([1000 * column + 500, 1000 * row + 500, height], axis=1).astype(np.int32)
    wild = rng.integers(0, n, n // 500)
    points["xyz"][wild] = rng.integers(-(2**31), 2**31 - 1, (len(wild), 3), dtype=np.int64)
    points["light"] = rng.integers(0, 65_536, n)
    points["returns"], points["class"] = 0x11, 1
    points["flags"] = np.where(rng.random(n) < 0.3, 4, 0)
    points["cells"], points["points"] = rng.integers(1, 5, n), rng.geometric(0.01, n)
    return points


def by_lazrs(points, laz):
    stream = io.BytesIO()
    stream.write(b"head")
    compressor = lazrs.LasZipCompressor(stream, laz)
    compressor.compress_many(points.view(np.uint8))
    compressor.done()
    return stream.getvalue()


@pytest.mark.parametrize("case", ["two chunks", "one point", "nothing but places", "times differ", "classes differ"])
def test_bytes_are_those_of_lazrs(case):
    rng = np.random.default_rng(7)
    points = model(1 if case == "one point" else 60_000 if case == "two chunks" else 3_000, rng)
    if case == "nothing but places":
        points["light"], points["flags"], points["cells"], points["points"] = 7, 0, 1, 1
    if case == "times differ":
        points["time"] = np.arange(len(points))
    if case == "classes differ":
        points["class"][-1] = 2
    laz = lazrs.LazVlr.new_for_compression(6, 4)
    stream = io.BytesIO()
    stream.write(b"head")
    write_compressed(stream, laz, points, 6)
    assert stream.getvalue() == by_lazrs(points, laz)
