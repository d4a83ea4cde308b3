"""Delaunay triangulation of scattered points by insertion, with exact decisions.

Each point removes the triangles whose circle contains it and is joined to the rim of the hole (Bowyer 1981; Watson
1981). Beyond each edge of the hull lies a triangle with the corner `beyond`, so points outside the hull need no special
treatment. Positions are integers, and every decision is that of :mod:`roadscan.surface.kernels.delaunay`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from roadscan.compute.kernel_options import kernel
from roadscan.surface.kernels.delaunay import in_circle, turn


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
