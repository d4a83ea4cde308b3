"""Steep breaks of the terrain: drops on both sides of a cell, and growth of the ground from return to return."""

from __future__ import annotations

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def _drop(z, i, j, down, right, steps, rise):
    """Greatest height of cell (i, j) above the cells on one side of it, less `rise` a cell of distance."""
    rows, columns = z.shape
    most = -1e9
    for k in range(1, steps + 1):
        a, b = i + round(k * down), j + round(k * right)
        if a < 0 or b < 0 or a >= rows or b >= columns:
            break
        most = max(most, z[i, j] - z[a, b] - rise * k)
    return most


@kernel
def drops_on_both_sides(z, directions, steps, rise, out):
    """Compute by how much each cell stands above what lies on both sides of it, along the line where that is most.

    A bridge, a wall or a roof stands above both of its sides; the upper edge of a break does above one alone.

    Parameters
    ----------
    z : (rows, columns) float32, whole (m).
    directions : (k, 2) float64, unit vectors of the lines, in rows and columns.
    steps : length of a line to each side (cells); rise : what terrain may fall a cell of distance (m).
    out : (rows, columns) float32, the lesser of both drops (m); negative where there is none.
    """
    rows, columns = z.shape
    for i in range(rows):
        for j in range(columns):
            most = -1e9
            for k in range(directions.shape[0]):
                down, right = directions[k, 0], directions[k, 1]
                one = _drop(z, i, j, down, right, steps, rise)
                if one > most:
                    most = max(most, min(one, _drop(z, i, j, -down, -right, steps, rise)))
            out[i, j] = most


@kernel
def grow(z, near, may, step, least, on_ground):
    """Add to the ground each return that may join and of whose neighbours several lie on it at about its own height.

    What joins is the same in any order.

    Parameters
    ----------
    z : (n,) float64 (m); near : (n, k) int64, neighbours of each return; may : (n,) bool, those that may join.
    step : greatest difference of height to such a neighbour (m); least : how many have to be.
    on_ground : (n,) bool, changed.
    """
    changed = True
    while changed:
        changed = False
        for i in range(z.size):
            if may[i] and not on_ground[i]:
                count = 0
                for k in range(near.shape[1]):
                    j = near[i, k]
                    if on_ground[j] and abs(z[i] - z[j]) <= step:
                        count += 1
                if count >= least:
                    on_ground[i] = True
                    changed = True
