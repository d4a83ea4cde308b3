"""A triangle mesh over the cells of a surface."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.store.codecs.mesh import Mesh


def mesh_of(easting_m: Float64, northing_m: Float64, height_m: Float64, colour: npt.NDArray[np.uint8]) -> Mesh:
    """Return two triangles between four nodes with a height, one between three.

    Of a square's diagonals the one whose ends differ less in height is taken: edges and cracks keep their lines.

    Parameters
    ----------
    easting_m, northing_m : (columns,), (rows,) from the mesh's origin.
    height_m : (rows, columns), row 0 the southernmost; NaN where there is no node.
    colour : (rows, columns) or (rows, columns, 3).
    """
    known = ~np.isnan(height_m)
    sw, se, nw, ne = (known[r, c] for r, c in _CORNERS)
    south_west, south_east, north_west, north_east = (height_m[r, c] for r, c in _CORNERS)
    with np.errstate(invalid="ignore"):
        rising = np.abs(south_west - north_east) <= np.abs(south_east - north_west)
    number = np.arange(known.size, dtype=np.int64).reshape(known.shape)
    a, b, d, c = (number[r, k] for r, k in _CORNERS)
    whole = sw & se & nw & ne
    parts = [
        _picked(whole & rising, a, b, c), _picked(whole & rising, a, c, d),
        _picked(whole & ~rising, a, b, d), _picked(whole & ~rising, b, c, d),
        _picked(sw & se & ne & ~nw, a, b, c), _picked(sw & ne & nw & ~se, a, c, d),
        _picked(sw & se & nw & ~ne, a, b, d), _picked(se & ne & nw & ~sw, b, c, d),
    ]  # fmt: skip
    corners = np.concatenate(parts)
    used, triangles = np.unique(corners, return_inverse=True)
    row, column = np.divmod(used, known.shape[1])
    places = np.stack([easting_m[column], northing_m[row], height_m.ravel()[used]], axis=-1)
    return Mesh(places.astype(np.float32), colour[row, column], triangles.reshape(-1, 3).astype(np.uint32))


_LOW, _HIGH = slice(None, -1), slice(1, None)  # First and second node of an edge, along an axis.
_CORNERS: Final = ((_LOW, _LOW), (_LOW, _HIGH), (_HIGH, _LOW), (_HIGH, _HIGH))


def _picked(where: npt.NDArray[np.bool_], *corners: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.stack([corner[where] for corner in corners], axis=-1)
