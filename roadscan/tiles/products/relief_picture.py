"""Pictures of shaded relief: mean heights in large pixels, and grey with transparency as PNG."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.store.codecs.tiff import raster_settings, without_place_warning

PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"

_EMPTY: Final = 0  # Grey of a pixel without a height.


@dataclass(frozen=True)
class MeanPixels:
    """Mean heights in pixels of several cells, north up."""

    steps: tuple[int, int]
    """Cells along the edges of a pixel: down, and to the right."""
    total: Float64
    """(rows, columns) sum of the heights (m)."""
    count: Float64

    @classmethod
    def over(cls, rows: int, columns: int, steps: tuple[int, int]) -> Self:
        """Create empty pixels over so many rows and columns of cells."""
        shape = -(-rows // steps[0]), -(-columns // steps[1])
        return cls(steps, np.zeros(shape), np.zeros(shape))

    def add(self, row: Int64, column: Int64, heights_m: Float64) -> None:
        """Add cells: row and column (n,) from the north-west, and their heights (n,)."""
        down, right = self.steps
        number = (row // down) * self.total.shape[1] + column // right
        pixel, inverse = np.unique(number, return_inverse=True)
        self.total.reshape(-1)[pixel] += np.bincount(inverse, weights=heights_m)
        self.count.reshape(-1)[pixel] += np.bincount(inverse)

    def trimmed(self) -> Float64:
        """Return (rows, columns) mean heights, NaN where empty, without empty rows and columns at the edges."""
        with np.errstate(invalid="ignore"):
            heights_m = self.total / self.count
        known = self.count > 0
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        return heights_m[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def write_picture(path: Path, grey: npt.NDArray[np.uint8]) -> None:
    """Write (rows, columns) of grey as a PNG in which 0 is transparent."""
    from rasterio.shutil import copy as translate

    opaque = np.where(grey == _EMPTY, 0, 255).astype(np.uint8)
    with raster_settings(), without_place_warning(), _in_memory(grey, opaque) as picture:
        translate(picture, str(path), driver="PNG", zlevel=6)


@contextmanager
def _in_memory(*bands: npt.NDArray[np.uint8]) -> Iterator[Any]:
    import rasterio

    rows, columns = bands[0].shape
    with rasterio.open(
        "picture", "w+", driver="MEM", width=columns, height=rows, count=len(bands), dtype="uint8"
    ) as raster:
        for number, band in enumerate(bands, start=1):
            raster.write(band, number)
        yield raster
