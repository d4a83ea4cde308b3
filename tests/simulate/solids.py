"""Where lines meet simple solids, written without the simulator: faces one by one, and all solids for every line."""

from __future__ import annotations

import numpy as np

NEVER = np.inf


def box(o, d, centre, length, width, low, high, heading):
    """Through each of the six faces."""
    ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
    right = np.array([np.cos(heading), -np.sin(heading), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    middle = np.array([centre[0], centre[1], (low + high) / 2])
    half = {0: length / 2, 1: width / 2, 2: (high - low) / 2}
    axes = [ahead, right, up]
    best = NEVER
    for k in range(3):
        for side in (-1.0, 1.0):
            if abs(d @ axes[k]) < 1e-15:
                continue
            r = (side * half[k] - (o - middle) @ axes[k]) / (d @ axes[k])
            at = o + r * d - middle
            others = [j for j in range(3) if j != k]
            if r > 0 and all(abs(at @ axes[j]) <= half[j] + 1e-12 for j in others):
                best = min(best, r)
    return best


def cylinder(o, d, centre, radius, low, high):
    """Its wall, then its two ends."""
    rel = o[:2] - np.asarray(centre)
    best = NEVER
    for r in np.roots([d[:2] @ d[:2], 2 * rel @ d[:2], rel @ rel - radius**2]):
        if abs(r.imag) < 1e-12 and r.real > 0 and low <= o[2] + r.real * d[2] <= high:
            best = min(best, r.real)
    for z in (low, high):
        r = (z - o[2]) / d[2]
        if r > 0 and np.hypot(*(rel + r * d[:2])) <= radius:
            best = min(best, r)
    return best


def ellipsoid(o, d, centre, radius, low, high):
    """As a sphere, after stretching all heights. Both crossings, ascending; none: an empty list."""
    stretch = np.array([1.0, 1.0, radius / ((high - low) / 2)])
    rel = (o - np.array([*centre, (low + high) / 2])) * stretch
    way = d * stretch
    roots = np.roots([way @ way, 2 * rel @ way, rel @ rel - radius**2])
    return sorted(r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0)


def quad(o, d, a, b, low, high):
    """An upright rectangle between two points: two triangles, Möller and Trumbore (1997)."""
    corners = [np.array([*a, low]), np.array([*b, low]), np.array([*b, high]), np.array([*a, high])]
    best = NEVER
    for i, j, k in ((0, 1, 2), (0, 2, 3)):
        e1, e2 = corners[j] - corners[i], corners[k] - corners[i]
        p = np.cross(d, e2)
        det = e1 @ p
        if abs(det) < 1e-15:
            continue
        t = (o - corners[i]) / det
        u, q = t @ p, np.cross(t, e1)
        v = d @ q
        if u >= 0 and v >= 0 and u + v <= 1 and e2 @ q > 0:
            best = min(best, e2 @ q)
    return best


def disc(o, d, centre, radius, normal):
    """A disc with a normal."""
    r = (centre - o) @ normal / (d @ normal)
    return r if r > 0 and np.linalg.norm(o + r * d - centre) <= radius else NEVER
