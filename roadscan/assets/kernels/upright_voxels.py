"""Upright planes in voxels: moments of the returns seen from above, thin elements, and regions of them."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import inlined, kernel


@kernel
def gather_moments(x, y, above, corner, sizes, index, moments, voxel_of):
    """Compute voxels with returns, their moments, and the voxel of each return (-1: none); returns how many there are.

    x, y : (n,) float64; above : (n,) float32 heights (m), NaN is left out; corner : (x, y, height) of voxel (0, 0, 0);
    sizes : (side, height of a layer) of a voxel (m); index : (layers, rows, columns) int32, all -1, gets the voxel's
    number; moments : (most voxels, 10): n, Σx, Σy, Σx², Σxy, Σy² (from the voxel's corner), least and greatest height,
    row, column; voxel_of : (n,) int32.
    """
    layers, rows, columns = index.shape
    found = 0
    for i in range(x.size):
        voxel_of[i] = -1
        height = above[i] - corner[2]
        if not height >= 0.0:
            continue
        k = int(height / sizes[1])
        u, v = (x[i] - corner[0]) / sizes[0], (y[i] - corner[1]) / sizes[0]
        if k >= layers or u < 0.0 or v < 0.0 or u >= columns or v >= rows:
            continue
        r, c = int(v), int(u)
        j = index[k, r, c]
        if j < 0:
            j = found
            index[k, r, c] = j
            found += 1
            moments[j, :6] = 0.0
            moments[j, 6], moments[j, 7] = above[i], above[i]
            moments[j, 8], moments[j, 9] = r, c
        a, b = (u - c) * sizes[0], (v - r) * sizes[0]
        moments[j, 0] += 1.0
        moments[j, 1] += a
        moments[j, 2] += b
        moments[j, 3] += a * a
        moments[j, 4] += a * b
        moments[j, 5] += b * b
        moments[j, 6], moments[j, 7] = min(moments[j, 6], above[i]), max(moments[j, 7], above[i])
        voxel_of[i] = j
    return found


@inlined
def with_moments(total, sums, i, a, b):
    """Returns six sums (n, Σx, Σy, Σx², Σxy, Σy²) with those of a row, whose corner lies (a, b) off theirs (m)."""
    n, x, y, xx, xy, yy = total
    m = sums[i, 0]
    return (
        n + m, x + (sums[i, 1] + m * a), y + (sums[i, 2] + m * b),
        xx + (sums[i, 3] + 2.0 * a * sums[i, 1] + m * a * a),
        xy + (sums[i, 4] + a * sums[i, 2] + b * sums[i, 1] + m * a * b),
        yy + (sums[i, 5] + 2.0 * b * sums[i, 2] + m * b * b),
    )  # fmt: skip


@inlined
def plane_of(total):
    """Returns the upright plane of some returns seen from above, by their six sums: middle x and y, direction (its
    cosine and sine), and standard deviations along and across it.
    """
    n, x, y, xx, xy, yy = total
    mx, my = x / n, y / n
    cxx, cxy, cyy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    mean, half = 0.5 * (cxx + cyy), math.hypot(0.5 * (cxx - cyy), cxy)
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    along, across = math.sqrt(max(mean + half, 0.0)), math.sqrt(max(mean - half, 0.0))
    return mx, my, math.cos(angle), math.sin(angle), along, across


@inlined
def is_thin(plane, limits):
    """Returns whether a plane is long and thin enough for an element; limits : as of `thin_elements`."""
    along, across = plane[4], plane[5]
    return along >= limits[1] and across <= limits[2] and across <= limits[3] * along


@inlined
def write_element(elements, row, plane, thin, x, y):
    """Write the element of a plane, whose middle counts from a corner x, y (m)."""
    elements[row, 0] = 1.0 if thin else 0.0
    elements[row, 1], elements[row, 2] = x + plane[0], y + plane[1]
    elements[row, 3], elements[row, 4], elements[row, 5] = plane[2], plane[3], plane[5]


@kernel
def thin_elements(index, moments, side_m, limits, elements):
    """Find voxels whose returns, with those of the eight beside them in their layer, lie on an upright plane.

    limits : (4,) fewest returns, least standard deviation along the plane, greatest across it (m), greatest ratio of
    the two; elements : (voxels, 6) float64, gets 1 or 0, middle x, y (from the corner of the voxels, m), direction of
    the plane seen from above (its cosine and sine), standard deviation across it (m).
    """
    layers, rows, columns = index.shape
    good = 0
    for k in range(layers):
        for r in range(rows):
            for c in range(columns):
                j = index[k, r, c]
                if j < 0:
                    continue
                total = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for rr in range(max(r - 1, 0), min(r + 2, rows)):
                    for cc in range(max(c - 1, 0), min(c + 2, columns)):
                        i = index[k, rr, cc]
                        if i >= 0:
                            total = with_moments(total, moments, i, (cc - c) * side_m, (rr - r) * side_m)
                elements[j] = 0.0
                if total[0] < limits[0]:
                    continue
                plane = plane_of(total)
                thin = is_thin(plane, limits)
                write_element(elements, j, plane, thin, c * side_m, r * side_m)
                good += thin
    return good


@inlined
def _continue_one_another(elements, i, j, least_cosine, most_m):
    """Returns whether two elements lie on one plane, within limits."""
    if abs(elements[i, 3] * elements[j, 3] + elements[i, 4] * elements[j, 4]) < least_cosine:
        return False
    dx, dy = elements[j, 1] - elements[i, 1], elements[j, 2] - elements[i, 2]
    first = abs(dy * elements[i, 3] - dx * elements[i, 4])
    second = abs(dy * elements[j, 3] - dx * elements[j, 4])
    return first <= most_m and second <= most_m


@kernel
def grow_regions(index, second, elements, least_cosine, most_m, reach, region, stack):
    """Join elements that touch, in and across layers, and lie on one plane; returns the number of regions.

    second : (voxels,) int32 number of the other element of a voxel, -1 of most. reach : (layers, cells) that a
    neighbour may be away; region : (elements,) int32, all 0, gets the region's number from 1, in the order of layers,
    rows and columns; stack : (elements, 4) int32, working space.
    """
    layers, rows, columns = index.shape
    found = 0
    for k in range(layers):
        for r in range(rows):
            for c in range(columns):
                voxel = index[k, r, c]
                if voxel < 0:
                    continue
                for seed in (voxel, second[voxel]):
                    if seed < 0 or elements[seed, 0] == 0.0 or region[seed] != 0:
                        continue
                    found += 1
                    region[seed] = found
                    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = k, r, c, seed
                    waiting = 1
                    while waiting > 0:
                        waiting -= 1
                        level, row, column, i = stack[waiting]
                        for kk in range(max(level - reach[0], 0), min(level + reach[0] + 1, layers)):
                            for rr in range(max(row - reach[1], 0), min(row + reach[1] + 1, rows)):
                                for cc in range(max(column - reach[1], 0), min(column + reach[1] + 1, columns)):
                                    other = index[kk, rr, cc]
                                    if other < 0:
                                        continue
                                    for j in (other, second[other]):
                                        if j < 0 or elements[j, 0] == 0.0 or region[j] != 0:
                                            continue
                                        if _continue_one_another(elements, i, j, least_cosine, most_m):
                                            region[j] = found
                                            stack[waiting, 0], stack[waiting, 1] = kk, rr
                                            stack[waiting, 2], stack[waiting, 3] = cc, j
                                            waiting += 1
    return found


@kernel
def beside_line(x, y, rows, middle, along, t, d):
    """Fill `t` and `d` (k,): how far the places at `rows` (k,) lie along a line from its middle, and left of it (m)."""
    for i in range(rows.size):
        past_x, past_y = x[rows[i]] - middle[0], y[rows[i]] - middle[1]
        t[i] = past_x * along[0] + past_y * along[1]
        d[i] = past_y * along[0] - past_x * along[1]


@kernel
def in_stretches(t, edges, stretch):
    """Fill `stretch` (k,) int32: the stretch of a line that t (k,) lies in; beyond the ends, the first and the last.

    edges : (stretches + 1,) float64 where they begin, evenly apart, and where the last one ends (m).
    """
    last = edges.size - 2
    scale = (last + 1) / max(edges[last + 1] - edges[0], 1e-9)
    for i in range(t.size):
        k = int(min(max((t[i] - edges[0]) * scale, 0.0), float(last)))
        while k < last and t[i] >= edges[k + 1]:
            k += 1
        while k > 0 and t[i] < edges[k]:
            k -= 1
        stretch[i] = k


@kernel
def near_middles(t, d, stretch, edges, middle, most_m, near):
    """Fill `near` (k,) bool: whether d is no farther than `most_m` from the line through the middles of stretches.

    middle : (stretches,) float64 d of the line halfway along each; t, stretch, edges : as :func:`in_stretches`.
    """
    for i in range(t.size):
        k = stretch[i]
        share = (t[i] - edges[k]) / (edges[k + 1] - edges[k]) - 0.5
        other = min(max(k + (1 if share > 0.0 else -1), 0), middle.size - 1)
        near[i] = abs(d[i] - middle[k] - abs(share) * (middle[other] - middle[k])) <= most_m


@kernel
def passing_lines(x, y, height, sensor_x, sensor_y, sensor_height, segments, bands, reach_m, passed):
    """Count the sight lines that cross upright rectangles and end behind them.

    x, y, height : (n,) returns; sensor_x, sensor_y, sensor_height : (n,) where they were seen from (m); segments :
    (s, 4) ends x, y and x, y of rectangles seen from above; bands : (s, b, 2) heights of the lower and upper edges of b
    rectangles above one another; reach_m : lines that end farther from the middle of a rectangle, seen from above, do
    not count; passed : (s, p, b) int64, is added to in each of p equal parts along the rectangles.
    """
    for s in range(segments.shape[0]):
        ax, ay, bx, by = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
        ux, uy = bx - ax, by - ay
        length = math.hypot(ux, uy)
        if length == 0.0:
            continue
        ux, uy = ux / length, uy / length
        mx, my = 0.5 * (ax + bx), 0.5 * (ay + by)
        for i in range(x.size):
            if (x[i] - mx) ** 2 + (y[i] - my) ** 2 > reach_m * reach_m:
                continue
            beyond = ux * (y[i] - ay) - uy * (x[i] - ax)
            before = ux * (sensor_y[i] - ay) - uy * (sensor_x[i] - ax)
            if beyond * before >= 0.0 or abs(beyond) < 0.3:
                continue
            share = before / (before - beyond)
            px, py = sensor_x[i] + share * (x[i] - sensor_x[i]), sensor_y[i] + share * (y[i] - sensor_y[i])
            along = (px - ax) * ux + (py - ay) * uy
            if along < 0.0 or along > length:
                continue
            crossing = sensor_height[i] + share * (height[i] - sensor_height[i])
            part = min(int(along / length * passed.shape[1]), passed.shape[1] - 1)
            for b in range(bands.shape[1]):
                passed[s, part, b] += bands[s, b, 0] <= crossing <= bands[s, b, 1]


@kernel
def region_ranges(region, members, starts):
    """Sort the voxels by region: members (voxels,) int64 in their order, starts (regions + 2,) int64 of each region.

    region : (voxels,) int32 from 0 (none).
    """
    starts[:] = 0
    for j in range(region.size):
        starts[region[j] + 1] += 1
    for k in range(1, starts.size):
        starts[k] += starts[k - 1]
    at = starts.copy()
    for j in range(region.size):
        members[at[region[j]]] = j
        at[region[j]] += 1
