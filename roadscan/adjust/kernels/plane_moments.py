"""Moments of points by group, and rejection of points too far from the plane of their group."""

from __future__ import annotations

from roadscan.compute.kernel_options import bare


@bare
def add_moments(point_m, group, kept, count, total_m, squares_m2):
    """Add count, sum and second moments about the origin of the points of each group.

    Parameters
    ----------
    point_m : (n, 3), near the origin of their group, or digits are lost.
    group : (n,)
    kept : (n,) points that count.
    count : (g,) int64, changed in place.
    total_m : (g, 3), changed in place.
    squares_m2 : (g, 6) of xx, xy, xz, yy, yz, zz, changed in place.
    """
    for n in range(group.size):
        if not kept[n]:
            continue
        g = group[n]
        x, y, z = point_m[n, 0], point_m[n, 1], point_m[n, 2]
        count[g] += 1
        total_m[g, 0] += x
        total_m[g, 1] += y
        total_m[g, 2] += z
        squares_m2[g, 0] += x * x
        squares_m2[g, 1] += x * y
        squares_m2[g, 2] += x * z
        squares_m2[g, 3] += y * y
        squares_m2[g, 4] += y * z
        squares_m2[g, 5] += z * z


@bare
def leave_out_far(point_m, group, mean_m, normal, limit_m, kept):
    """Reject points that lie farther than a limit from the plane of their group.

    Parameters
    ----------
    mean_m, normal : (g, 3) of the plane of each group.
    limit_m : (g,); negative where no point of the group counts.
    kept : (n,) changed in place.
    """
    for n in range(group.size):
        if kept[n]:
            g = group[n]
            away = 0.0
            for a in range(3):
                away += (point_m[n, a] - mean_m[g, a]) * normal[g, a]
            kept[n] = abs(away) <= limit_m[g]
