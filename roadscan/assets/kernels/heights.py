"""Heights of returns above a raster of ground."""

from __future__ import annotations

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def bilinear(z, u, v):
    """Height at column u and row v (cells, counted from the middle of the first), clamped to the raster z."""
    rows, columns = z.shape
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    j, i = int(u), int(v)
    j2, i2 = min(j + 1, columns - 1), min(i + 1, rows - 1)
    fu, fv = u - j, v - i
    south = z[i, j] + fu * (z[i, j2] - z[i, j])
    north = z[i2, j] + fu * (z[i2, j2] - z[i2, j])
    return south + fv * (north - south)


@kernel
def heights_above(x, y, z, origin, per_m, ground, out):
    """Compute the height of each return above a raster of ground.

    Parameters
    ----------
    x, y, z : (n,) float64 (m).
    origin : (2,) float64, x and y of the raster's corner (m).
    per_m : cells a metre.
    ground : (rows, columns) float32, heights at the middles of cells; NaN where unknown.
    out : (n,) float32, NaN where the ground is unknown.
    """
    for k in range(x.size):
        u, v = (x[k] - origin[0]) * per_m - 0.5, (y[k] - origin[1]) * per_m - 0.5
        out[k] = z[k] - bilinear(ground, u, v)
