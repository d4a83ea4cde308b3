"""Samples of the ISPRS filter test: airborne returns, and which of them lie on bare earth."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import numpy.typing as npt

SAMPLES = ("11", "21", "23", "24", "31", "41", "51", "52", "54", "71")


def isprs_sample(recordings: Path, sample: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Points (n, 3) of a sample from its lowest x and y (m), and which of them lie on the ground.

    The subset of ground holds the bytes of its points in their order.
    """
    folder = recordings / ("ground" if sample == "11" else "isprs_filter_test")
    points = read_pcd(folder / f"samp{sample}.pcd.gz")
    ground = read_pcd(folder / f"samp{sample}-ground.pcd.gz")
    left: dict[bytes, int] = {}
    for row in ground:
        left[row.tobytes()] = left.get(row.tobytes(), 0) + 1
    on_ground = np.zeros(len(points), np.bool_)
    for k, row in enumerate(points):
        if left.get(row.tobytes(), 0):
            left[row.tobytes()] -= 1
            on_ground[k] = True
    xyz = points.astype(np.float64)
    return xyz - [*xyz[:, :2].min(axis=0), 0.0], on_ground


def read_pcd(path: Path) -> npt.NDArray[np.float32]:
    """Points (n, 3) of a PCD file of x, y, z in float32, compressed (LZF, field after field)."""
    content = gzip.decompress(path.read_bytes())
    marker = b"DATA binary_compressed\n"
    begin = content.index(marker) + len(marker)
    packed, full = np.frombuffer(content[begin : begin + 8], "<u4").tolist()
    return np.frombuffer(unpacked(content[begin + 8 : begin + 8 + packed], full), "<f4").reshape(3, -1).T.copy()


def unpacked(packed: bytes, full: int) -> bytes:
    """Bytes that LZF packed: runs as they are, and copies of what came before."""
    out = bytearray()
    k = 0
    while k < len(packed):
        control = packed[k]
        k += 1
        if control < 32:
            out += packed[k : k + control + 1]
            k += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[k]
            k += 1
        start = len(out) - ((control & 31) << 8) - packed[k] - 1
        k += 1
        for m in range(start, start + length + 2):
            out.append(out[m])
    if len(out) != full:
        raise ValueError(f"{len(out)} bytes instead of {full}")
    return bytes(out)
