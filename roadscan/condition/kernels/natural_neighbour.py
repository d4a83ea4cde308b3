"""Exact natural-neighbour interpolation (Sibson 1981) over a Delaunay triangulation of scattered points.

A query point inserted among the points would take its Voronoi cell from those of its natural neighbours; the areas
taken are their weights. The Delaunay triangles whose circles contain the point (Watson 1992) give the neighbours, and
the centres of these circles, with those of the circles through the point and the edges around them, are the corners of
these areas. With the slopes of the field at the points the values have a continuous slope themselves (Sibson's C1).

Delaunay triangulation of scattered points by insertion, with exact decisions.

Each point removes the triangles whose circle contains it and is joined to the rim of the hole (Bowyer 1981; Watson
1981). Beyond each edge of the hull lies a triangle with the corner `beyond`, so points outside the hull need no special
treatment. Positions are integers, and every decision is that of :mod:`roadscan.surface.kernels.delaunay`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.surface.kernels.delaunay import in_circle, turn

STEP_M = 2.0**-36
"""Unit of integer positions (m)."""
WIDEST = 4e4
"""Squared distance of a circle's centre to the area taken, above which digits are lost: there the linear value of the
triangle is taken. It concerns flat triangles at the hull."""


@inlined
def circle_centre(ax, ay, bx, by):
    """Return the centre of the circle through the origin and two places; not finite where they lie on a line."""
    twice = 2.0 * (ax * by - ay * bx)
    a, b = ax * ax + ay * ay, bx * bx + by * by
    if twice == 0.0:
        return np.inf, np.inf
    return (by * a - ay * b) / twice, (ax * b - bx * a) / twice


@kernel
def circle_centres(mesh, count, centres):
    """Fill `centres` (≥ count, 2), in steps, from each triangle's first corner; of those beyond the hull: infinite."""
    beyond = mesh.x.size
    for t in range(count):
        a, b, c = mesh.triangles[t, 0], mesh.triangles[t, 1], mesh.triangles[t, 2]
        if beyond in (a, b, c):
            centres[t, 0], centres[t, 1] = np.inf, np.inf
            continue
        centres[t, 0], centres[t, 1] = circle_centre(
            STEP_M * np.float64(mesh.x[b] - mesh.x[a]),
            STEP_M * np.float64(mesh.y[b] - mesh.y[a]),
            STEP_M * np.float64(mesh.x[c] - mesh.x[a]),
            STEP_M * np.float64(mesh.y[c] - mesh.y[a]),
        )


@kernel
def linear(mesh, t, value):
    """Return the value at the query point of the plane through triangle t's corners."""
    q = mesh.x.size - 1
    total, weighed = 0.0, 0.0
    for k in range(3):
        a, b = mesh.triangles[t, (k + 1) % 3], mesh.triangles[t, (k + 2) % 3]
        ax, ay = np.float64(mesh.x[a] - mesh.x[q]), np.float64(mesh.y[a] - mesh.y[q])
        bx, by = np.float64(mesh.x[b] - mesh.x[q]), np.float64(mesh.y[b] - mesh.y[q])
        area = ax * by - ay * bx
        total += area
        weighed += area * value[mesh.triangles[t, k]]
    return weighed / total


@inner
def sibson(mesh, centres, value, slopes, weight, arriving, t, question):
    """Return Sibson's value at the query point in triangle t; slopes: (n, 2) of the field at the points, or (0, 2).

    Each side of the area taken from one neighbour is a side of the next one's in the opposite direction, so the doubled
    areas are summed up over sides, in any order.
    """
    q = mesh.x.size - 1
    many, edges = dig(mesh, t, q, question)
    widest = 0.0
    for e in range(edges):
        weight[mesh.rim[e, 0]] = 0.0
    for k in range(many):
        u = mesh.hole[k]
        corner = mesh.triangles[u, 0]
        cx = centres[u, 0] + STEP_M * np.float64(mesh.x[corner] - mesh.x[q])
        cy = centres[u, 1] + STEP_M * np.float64(mesh.y[corner] - mesh.y[q])
        widest = max(widest, cx * cx + cy * cy)
        for j in range(3):
            a, b, v = mesh.triangles[u, (j + 1) % 3], mesh.triangles[u, (j + 2) % 3], mesh.across[u, j]
            if mesh.mark[v] == question:
                if v < u:  # the adjacent triangle adds this side
                    continue
                corner = mesh.triangles[v, 0]
                nx = centres[v, 0] + STEP_M * np.float64(mesh.x[corner] - mesh.x[q])
                ny = centres[v, 1] + STEP_M * np.float64(mesh.y[corner] - mesh.y[q])
            else:
                nx, ny = circle_centre(
                    STEP_M * np.float64(mesh.x[a] - mesh.x[q]),
                    STEP_M * np.float64(mesh.y[a] - mesh.y[q]),
                    STEP_M * np.float64(mesh.x[b] - mesh.x[q]),
                    STEP_M * np.float64(mesh.y[b] - mesh.y[q]),
                )
                widest = max(widest, nx * nx + ny * ny)
                arriving[b, 0], arriving[b, 1] = nx, ny
            area = cx * ny - cy * nx
            weight[a] += area
            weight[b] -= area
    return _weighed(mesh, value, slopes, weight, arriving, t, edges, widest)


@kernel
def _weighed(mesh, value, slopes, weight, arriving, t, edges, widest):
    """Close the areas along the cell of the query point, and weight the values."""
    total, weighed = 0.0, 0.0
    for e in range(edges):
        a, b = mesh.rim[e, 0], mesh.rim[e, 1]
        # The side of the new cell that faces `a`, from the circle of its other edge on the rim to this one's.
        area = arriving[b, 0] * arriving[a, 1] - arriving[b, 1] * arriving[a, 0]
        weight[a] += area
        total += weight[a]
        weighed += weight[a] * value[a]
    if not widest < WIDEST * abs(total):
        return linear(mesh, t, value)
    if slopes.shape[0] == 0:
        return weighed / total
    return _bent(mesh, value, slopes, weight, edges, weighed / total, total)


@kernel
def _bent(mesh, value, slopes, weight, edges, plain, total):
    """Return Sibson's C1 value: the plain one and the planes at the neighbours, weighted by distance (Sibson 1981)."""
    q = mesh.x.size - 1
    near, far, square, planes = 0.0, 0.0, 0.0, 0.0
    for e in range(edges):
        a = mesh.rim[e, 0]
        dx, dy = STEP_M * np.float64(mesh.x[a] - mesh.x[q]), STEP_M * np.float64(mesh.y[a] - mesh.y[q])
        own, d = weight[a] / total, math.sqrt(dx * dx + dy * dy)
        near += own / d
        far += own * d
        square += own * d * d
        planes += own / d * (value[a] - slopes[a, 0] * dx - slopes[a, 1] * dy)
    alpha = far / near
    return (alpha * plain + square * planes / near) / (alpha + square)


@kernel
def slopes_of_points(mesh, count, centres, value, slopes):
    """Fill `slopes` (n, 2) of the field at the points, from the planes that fit their neighbours best.

    A neighbour at distance d counts by the length of the border of both Voronoi cells over d³, so that the slopes of
    a field x² + y² are exact, and at the hull, where cells have no end, by 1/d².
    """
    beyond = mesh.x.size
    at_hull, sums = np.zeros(len(slopes), np.bool_), np.zeros((len(slopes), 5))
    for t in range(count):
        if beyond in (mesh.triangles[t, 0], mesh.triangles[t, 1], mesh.triangles[t, 2]):
            for j in range(3):
                if mesh.triangles[t, j] != beyond:
                    at_hull[mesh.triangles[t, j]] = True
    for t in range(count):
        for j in range(3):
            a, b, v = mesh.triangles[t, (j + 1) % 3], mesh.triangles[t, (j + 2) % 3], mesh.across[t, j]
            if v < t or beyond in (a, b):
                continue
            dx, dy = STEP_M * np.float64(mesh.x[b] - mesh.x[a]), STEP_M * np.float64(mesh.y[b] - mesh.y[a])
            d2, rise = dx * dx + dy * dy, value[b] - value[a]
            c, k = mesh.triangles[t, 0], mesh.triangles[v, 0]
            if beyond not in (c, k):
                ex = centres[t, 0] - centres[v, 0] + STEP_M * np.float64(mesh.x[c] - mesh.x[k])
                ey = centres[t, 1] - centres[v, 1] + STEP_M * np.float64(mesh.y[c] - mesh.y[k])
                border = math.sqrt(ex * ex + ey * ey) / (d2 * math.sqrt(d2))
            else:
                border = 0.0
            for p in (a, b):
                w = 1.0 / d2 if at_hull[p] else border
                sums[p, 0] += w * dx * dx
                sums[p, 1] += w * dx * dy
                sums[p, 2] += w * dy * dy
                sums[p, 3] += w * dx * rise
                sums[p, 4] += w * dy * rise
    for p in range(len(slopes)):
        xx, xy, yy, xr, yr = sums[p]
        det = xx * yy - xy * xy
        slopes[p, 0], slopes[p, 1] = 0.0, 0.0
        if det > 0.0:
            slopes[p, 0], slopes[p, 1] = (yy * xr - xy * yr) / det, (xx * yr - xy * xr) / det


@kernel
def natural_neighbour_raster(mesh, count, centres, value, slopes, west_south, step, out):
    """Fill `out` (rows, columns) with Sibson's values at places one step apart; NaN outside the hull.

    Parameters
    ----------
    mesh, count : of :func:`roadscan.condition.kernels.natural_neighbour.triangulate`; centres : of `circle_centres`.
    value : (n,) float64 at the points; slopes : (n, 2) of `slopes_of_points`, or (0, 2) for values without them.
    west_south : (2,) float64 place of the first value (steps); step : to the next column and row (steps).
    """
    q, beyond = mesh.x.size - 1, mesh.x.size
    weight, arriving = np.zeros(q), np.zeros((q, 2))
    mesh.mark[:count] = -1
    last, question = 0, 0
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            j = k if i % 2 == 0 else out.shape[1] - 1 - k
            out[i, j] = np.nan
            if count == 0:
                continue
            mesh.x[q], mesh.y[q] = (
                np.int64(np.rint(west_south[0] + j * step)),
                np.int64(np.rint(west_south[1] + i * step)),
            )
            for e in range(3):
                if mesh.triangles[last, e] == beyond:
                    last = mesh.across[last, e]
                    break
            last = walk(mesh, last, q)
            inside = True
            for e in range(3):
                c = mesh.triangles[last, e]
                inside = inside and c != beyond
            if not inside:
                continue
            same = -1
            for e in range(3):
                c = mesh.triangles[last, e]
                if mesh.x[c] == mesh.x[q] and mesh.y[c] == mesh.y[q]:
                    same = c
            question += 1
            out[i, j] = (
                value[same] if same >= 0 else sibson(mesh, centres, value, slopes, weight, arriving, last, question)
            )


class Mesh(NamedTuple):
    """A triangulation of n points with its working memory; arrays are changed in place."""

    x: np.ndarray
    """(n + 1,) int64 positions (2⁻³⁶ m), at most 2⁴³ apart; the last is that of a query."""
    y: np.ndarray
    """(n + 1,) int64."""
    triangles: np.ndarray
    """(≥ 2 n + 4, 3) int32 corners, counter-clockwise; corner n + 1 lies beyond the hull."""
    across: np.ndarray
    """(≥ 2 n + 4, 3) int32: the triangle over the edge opposite each corner."""
    mark: np.ndarray
    """(≥ 2 n + 4,) int64: last query for which a triangle was in the hole; -1 before any."""
    hole: np.ndarray
    """(≥ 2 n + 4,) int32: triangles of the hole."""
    rim: np.ndarray
    """(≥ 2 n + 4, 3) int32: edges around the hole, from and to, and the triangle beyond."""
    leaving: np.ndarray
    """(n + 2,) int32: the new triangle whose edge on the rim leaves a corner."""


def mesh_of(x: np.ndarray, y: np.ndarray) -> Mesh:
    """Return memory for a triangulation of points at (n,) int64 positions (2⁻³⁶ m)."""
    n = len(x)
    room = 2 * n + 4
    return Mesh(
        np.append(x, np.int64(0)),
        np.append(y, np.int64(0)),
        np.zeros((room, 3), np.int32),
        np.full((room, 3), -1, np.int32),
        np.full(room, -1, np.int64),
        np.zeros(room, np.int32),
        np.zeros((room, 3), np.int32),
        np.zeros(n + 2, np.int32),
    )


@kernel
def holds(mesh, t, p):
    """Return whether the circle of a triangle contains point p; beyond the hull it is the half-plane outside."""
    beyond = mesh.x.size
    a, b, c = mesh.triangles[t, 0], mesh.triangles[t, 1], mesh.triangles[t, 2]
    if beyond not in (a, b, c):
        return in_circle(mesh.x, mesh.y, a, b, c, p) > 0
    if a == beyond:
        a, b = b, c
    elif b == beyond:
        a, b = c, a
    side = turn(mesh.x, mesh.y, a, b, p)
    if side != 0:
        return side > 0
    dx, dy = mesh.x[b] - mesh.x[a], mesh.y[b] - mesh.y[a]
    px, py = mesh.x[p] - mesh.x[a], mesh.y[p] - mesh.y[a]
    if abs(dx) >= abs(dy):
        return (0 < px < dx) if dx > 0 else (dx < px < 0)
    return (0 < py < dy) if dy > 0 else (dy < py < 0)


@kernel
def walk(mesh, t, p):
    """Return the triangle that contains point p, or one beyond the hull that sees it, walking from triangle t."""
    beyond = mesh.x.size
    while True:
        moved = False
        for k in range(3):
            if mesh.triangles[t, k] == beyond:
                return t
        for k in range(3):
            a, b = mesh.triangles[t, (k + 1) % 3], mesh.triangles[t, (k + 2) % 3]
            if turn(mesh.x, mesh.y, a, b, p) < 0:
                t = mesh.across[t, k]
                moved = True
                break
        if not moved:
            return t


@kernel
def dig(mesh, t, p, question):
    """Mark the triangles whose circles contain point p, from t on; return their number and that of the rim's edges.

    The triangles stand in `hole`, the edges around them, counter-clockwise each, in `rim`.
    """
    mesh.mark[t] = question
    mesh.hole[0] = t
    many, edges, k = 1, 0, 0
    while k < many:
        t = mesh.hole[k]
        k += 1
        for e in range(3):
            u = mesh.across[t, e]
            if mesh.mark[u] == question:
                continue
            if holds(mesh, u, p):
                mesh.mark[u] = question
                mesh.hole[many] = u
                many += 1
            else:
                mesh.rim[edges, 0] = mesh.triangles[t, (e + 1) % 3]
                mesh.rim[edges, 1] = mesh.triangles[t, (e + 2) % 3]
                mesh.rim[edges, 2] = u
                edges += 1
    return many, edges


@kernel
def triangulate(mesh, order):
    """Triangulate the points in `order` (n,); return the number of triangles, including those beyond the hull.

    Of several points at one place the first is taken. Points on one line give no triangle.
    """
    n = order.size
    beyond = mesh.x.size
    if n < 3:
        return 0
    first, second, third = order[0], -1, -1
    for k in range(1, n):
        p = order[k]
        if second < 0:
            if mesh.x[p] != mesh.x[first] or mesh.y[p] != mesh.y[first]:
                second = p
        elif turn(mesh.x, mesh.y, first, second, p) != 0:
            third = p
            break
    if third < 0:
        return 0
    if turn(mesh.x, mesh.y, first, second, third) < 0:
        second, third = third, second
    corners = (first, second, third)
    for k in range(3):
        mesh.triangles[0, k] = corners[k]
        mesh.across[0, k] = k + 1
        mesh.triangles[k + 1, 0] = corners[(k + 2) % 3]
        mesh.triangles[k + 1, 1] = corners[(k + 1) % 3]
        mesh.triangles[k + 1, 2] = beyond
        mesh.across[k + 1, 0] = 1 + (k + 2) % 3
        mesh.across[k + 1, 1] = 1 + (k + 1) % 3
        mesh.across[k + 1, 2] = 0
    count, last = 4, 0
    for k in range(n):
        p = order[k]
        if p in corners:
            continue
        if mesh.triangles[last, 0] == beyond or mesh.triangles[last, 1] == beyond or mesh.triangles[last, 2] == beyond:
            for e in range(3):
                if mesh.triangles[last, e] == beyond:
                    last = mesh.across[last, e]
                    break
        t = walk(mesh, last, p)
        same = False
        for e in range(3):
            c = mesh.triangles[t, e]
            if c != beyond and mesh.x[c] == mesh.x[p] and mesh.y[c] == mesh.y[p]:
                same = True
        if same:
            last = t
            continue
        count = join(mesh, t, p, k, count)
        last = mesh.hole[0]
    return count


@kernel
def join(mesh, t, p, question, count):
    """Join point p, which triangle t's circle contains, to the triangulation; return the number of triangles."""
    many, edges = dig(mesh, t, p, question)
    for e in range(edges):
        u = mesh.hole[e] if e < many else count + e - many
        a, b, outside = mesh.rim[e, 0], mesh.rim[e, 1], mesh.rim[e, 2]
        mesh.triangles[u, 0], mesh.triangles[u, 1], mesh.triangles[u, 2] = a, b, p
        mesh.across[u, 2] = outside
        mesh.mark[u] = -1
        mesh.leaving[a] = u
        for j in range(3):
            if mesh.triangles[outside, (j + 1) % 3] == b and mesh.triangles[outside, (j + 2) % 3] == a:
                mesh.across[outside, j] = u
    for e in range(edges):
        a, b = mesh.rim[e, 0], mesh.rim[e, 1]
        u, following = mesh.leaving[a], mesh.leaving[b]
        mesh.across[u, 0] = following
        mesh.across[following, 1] = u
    return count + edges - many
