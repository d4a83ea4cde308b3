"""Finds the readings of a profile that hit the road: histogram threshold, height, second derivative, angle, connection.

The steps and how each is read are described in :mod:`roadscan.georeference.road_profiles`. All of it happens in the
plane of the profile, in the sensor's axes: y across, *up* = −z. The last step finds the carriageway: the surface,
connected without a step, with the most readings.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import copy_values
from roadscan.georeference.kernels.readings import CLASS_KEPT, CLASS_NO_RETURN, CLASS_TOO_FAR, CLASS_TOO_NEAR

CLASS_ABOVE, CLASS_GRAZING = 9, 11
"""Classes of readings that did not hit the road; 7 and 8 belong to passes and centre lines."""

HYPOTHESES = 9
"""Number of pieces of a profile whose lines are tried as the road's."""
REFINEMENTS = 4  # Times that the parabola of the datum is fitted again to the readings near it.
SAMPLES = 256
"""About this many readings of a profile are tested for agreement with a line."""
HISTOGRAM_REACH_M = 1.0
"""Readings farther above or below the datum do not enter the histogram."""
FEWEST = 8
"""Profiles with fewer returns have no road."""
NOISE_SAMPLES = 100  # Readings per profile from which its noise is estimated.
LEAST_NOISE_M = 1e-4
"""Least noise that is assumed, since ranges are rounded."""
LEAST_DZ = 0.2
"""For beams nearer to the horizontal, the height error is taken as if they fell by this much per metre."""


@inner
def profile_points(raw, y0, z0, dy, dz, scale, raw_limits, classes, y, up, index):
    """Write the returns of one profile within the range limits, in the order of their readings.

    Parameters
    ----------
    raw : (m,) uint16; y0, z0, dy, dz : (m,) float64, origins (m) and directions of the rays.
    scale : (2,) tuple, range_offset_m, range_step_m; raw_limits : (2,) tuple of int64, lowest and highest that count.
    classes : (m,) uint8, out; y, up : (m,) float64, out, m; index : (m,) int32, out, number of the reading.

    Returns
    -------
    int, how many returns there are.
    """
    place_readings(raw, y0, z0, dy, dz, scale, raw_limits, classes, y, up)
    n = 0
    for j in range(raw.size):
        y[n] = y[j]
        up[n] = up[j]
        index[n] = j
        n += classes[j] == CLASS_KEPT
    return n


@inner
def place_readings(raw, y0, z0, dy, dz, scale, raw_limits, classes, y, up):
    """Write class and position (m,) of every reading; arguments of :func:`profile_points`. It vectorises by itself."""
    low, high = np.uint16(raw_limits[0]), np.uint16(raw_limits[1])
    for j in range(raw.size):
        distance = scale[0] + scale[1] * raw[j]
        y[j] = y0[j] + distance * dy[j]
        up[j] = -(z0[j] + distance * dz[j])
        beyond = np.uint8(CLASS_TOO_NEAR) if raw[j] < low else np.uint8(CLASS_TOO_FAR)
        kind = np.uint8(CLASS_KEPT) if (raw[j] >= low) & (raw[j] <= high) else beyond
        classes[j] = kind if raw[j] else np.uint8(CLASS_NO_RETURN)


@inlined
def parabola_at(p, y):
    """Return the value of a parabola (1, y, y²)."""
    return p[0] + y * (p[1] + y * p[2])


@kernel
def fitted(y, up, first, end, stride, near, gate, bent):
    """Fit a line, or a parabola where `bent`, to readings within `gate` (m) of the parabola `near`.

    `near` is kept where too few readings or too short a piece determine nothing.
    """
    origin = near[3]
    s0, s1, s2, s3, s4, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(first, end, stride):
        x = y[j] - origin
        w = 1.0 if abs(up[j] - parabola_at(near, x)) <= gate else 0.0
        v = w * up[j]
        x2 = x * x
        s0 += w
        s1 += w * x
        s2 += w * x2
        s3 += w * x2 * x
        s4 += w * x2 * x2
        t0 += v
        t1 += v * x
        t2 += v * x2
    if s0 < 5.0:
        return near
    m1, m2, height = s1 / s0, s2 / s0, t0 / s0
    a11 = m2 - m1 * m1
    b1 = t1 / s0 - m1 * height
    if a11 < 1e-6:
        return near
    if bent:
        a12 = s3 / s0 - m1 * m2
        a22 = s4 / s0 - m2 * m2
        b2 = t2 / s0 - m2 * height
        determinant = a11 * a22 - a12 * a12
        if determinant > 1e-6 * a11 * a22:
            p2 = (a11 * b2 - a12 * b1) / determinant
            p1 = (b1 - a12 * p2) / a11
            return (height - p1 * m1 - p2 * m2, p1, p2, origin)
    p1 = b1 / a11
    return (height - p1 * m1, p1, 0.0, origin)


@inner
def road_datum(y, up, gate):
    """Return the road's level in a profile: a parabola (1, y, y²; m) and the y that it counts from.

    Lines through pieces of the profile are tried, that with most readings within `gate` (m) wins; a parabola is then
    fitted to the readings near it, several times. So neither a car's side nor a pavement beside a kerb bends it.
    """
    n = y.size
    stride = max(n // SAMPLES, 1)
    best = (up[n // 2], 0.0, 0.0, y[n // 2])
    most = -1.0
    size = max(2 * n // HYPOTHESES, 5)
    for piece in range(HYPOTHESES):
        first = piece * max(n - size, 0) // (HYPOTHESES - 1)
        end = min(first + size, n)
        step = max((end - first) // 64, 1)
        middle = (first + end) // 2
        line = fitted(y, up, first, end, step, (up[middle], 0.0, 0.0, y[middle]), np.inf, False)
        line = fitted(y, up, first, end, step, line, 2.0 * gate, False)
        agree = 0.0
        for j in range(0, n, stride):
            off = (up[j] - parabola_at(line, y[j] - line[3])) / gate
            agree += max(1.0 - off * off, 0.0)
        if agree > most:
            most, best = agree, line
    for _ in range(REFINEMENTS):
        best = fitted(y, up, 0, n, stride, best, 2.0 * gate, True)
    return best


@kernel
def height_threshold(height, bin_m, share, counts):
    """Step 1 of the segmentation: return the threshold of the heights.

    Parameters
    ----------
    height : (n,) float64, above the datum, m; counts : (b,) int32, scratch.

    Returns
    -------
    float64, m.
    """
    bins = counts.size
    for b in range(bins):
        counts[b] = 0
    low = -0.5 * bin_m * bins
    for j in range(height.size):
        b = np.floor((height[j] - low) / bin_m)
        if 0.0 <= b < bins:
            counts[np.int64(b)] += 1
    # (i) the bin with the highest frequency is N
    peak = 0
    for b in range(bins):
        if counts[b] > counts[peak]:
            peak = b
    # (ii) the last bin of the unbroken run above N with at least 40 % of N's count is N1
    first = peak
    while first + 1 < bins and counts[first + 1] >= share * counts[peak]:
        first += 1
    # (iii) the last bin of the unbroken run above N1 with at least 40 % of N1's count is N2
    second = first
    while second + 1 < bins and counts[second + 1] >= share * counts[first] and counts[second + 1] > 0:
        second += 1
    # The road's level lies anywhere within its bin, so the peak may reach one bin width beyond N2.
    return low + (second + 2) * bin_m


@inner
def mark_above(height, threshold, kinds):
    """Step 2: mark readings higher than the threshold."""
    for j in range(height.size):
        kinds[j] = CLASS_ABOVE if height[j] > threshold else CLASS_KEPT


@inner
def curvatures(y, up, bend):
    """Step 3 (i): return how far each reading lies above the line through its two neighbours (n,), m.

    It is the second difference −z″ · (y₊ − y)(y − y₋) / 2: free of the spacing, which makes z″ itself incomparable.
    """
    n = y.size
    bend[0] = 0.0
    bend[n - 1] = 0.0
    for j in range(1, n - 1):
        span = y[j + 1] - y[j - 1]
        share = (y[j] - y[j - 1]) / (span if span != 0.0 else 1.0)
        inside = (share > 0.0) & (share < 1.0)
        over = up[j] - (up[j - 1] + share * (up[j + 1] - up[j - 1]))
        bend[j] = over if inside else 0.0


@inner
def range_noise(bend, index, dz, kinds, sample):
    """Return the standard deviation of the ranges (m), estimated from the profile's median of :func:`curvatures`.

    A range error e on level ground shifts the height by e · dz, and a second difference has 1.5 times the variance of a
    height; the median of |x| is 0.6745 σ. Texture counts as noise, and objects of a few readings do not count.
    sample : (s,) float64, scratch: so many readings, evenly through the profile.
    """
    n, most = bend.size, sample.size
    stride = max(n // most, 1)
    count = 0
    for j in range(1, n - 1, stride):
        if kinds[j] == CLASS_KEPT and bend[j] != 0.0 and count < most:
            value = abs(bend[j]) / max(abs(dz[index[j]]), LEAST_DZ)
            at = count
            while at > 0 and sample[at - 1] > value:
                sample[at] = sample[at - 1]
                at -= 1
            sample[at] = value
            count += 1
    if count < FEWEST:
        return LEAST_NOISE_M
    return max(sample[count // 2] / (0.6745 * np.sqrt(1.5)), LEAST_NOISE_M)


@inner
def mark_scattered(bend, index, dz, noise, factor, neighbours, sums, kinds):
    """Step 3 (i): mark readings that stand out upwards `factor` times more than the readings around them.

    bend : (n,); sums : (n + 1,) scratch. The two readings beside one share it in their second differences and do
    not count as neighbours. Large ones count no more than 10 σ, lest one hides another.
    """
    n = bend.size
    sums[0] = 0.0
    for j in range(n):
        sums[j + 1] = sums[j] + min(abs(bend[j]), 10.0 * noise)
    for j in range(1, n - 1):
        own = noise * max(abs(dz[index[j]]), LEAST_DZ)
        if kinds[j] == CLASS_KEPT and bend[j] > factor * own and bend[j] >= bend[j - 1] and bend[j] >= bend[j + 1]:
            low, high = max(j - 1 - neighbours, 0), min(j + 2 + neighbours, n)
            left, right = max(j - 1, low), min(j + 2, high)
            count = (left - low) + (high - right)
            around = (sums[left] - sums[low] + sums[high] - sums[right]) / max(count, 1)
            if bend[j] > factor * around:
                kinds[j] = CLASS_SCATTERED


@inlined
def is_grazing(y, up, j, k, beam_y, beam_up, sine):
    """Return True where the chord from reading j to k meets the beam at a smaller angle than that of `sine`."""
    a, b = y[k] - y[j], up[k] - up[j]
    cross = a * beam_up - b * beam_y
    return cross * cross < sine * sine * (a * a + b * b)


@inlined
def is_near(y, up, j, k, least):
    """Return True where the readings j and k are less than √least (m) apart."""
    a, b = y[k] - y[j], up[k] - up[j]
    return a * a + b * b < least


@inner
def mark_grazing(y, up, index, dy, dz, sine, chord, kinds):
    """Step 3 (ii): mark readings where beam and surface meet at less than the limit, seen from both sides.

    The surface is the chord to the next reading at least `chord` (m) away on each side; dy, dz : (m,) rays.
    """
    n = y.size
    least = chord * chord
    after = 0
    for j in range(n):
        after = max(after, min(j + 1, n - 1))
        while after + 1 < n and is_near(y, up, j, after, least):
            after += 1
        if kinds[j] != CLASS_KEPT:
            continue
        beam_y, beam_up = dy[index[j]], -dz[index[j]]
        if j < n - 1 and not is_grazing(y, up, j, after, beam_y, beam_up, sine):
            continue
        before = max(j - 1, 0)
        while before > 0 and is_near(y, up, j, before, least):
            before -= 1
        if j == 0 or is_grazing(y, up, j, before, beam_y, beam_up, sine):
            kinds[j] = CLASS_GRAZING


@kernel
def segment_profiles(ranges, y0, z0, dy, dz, scale, raw_limits, settings, classes):
    """Classify every reading of profiles; each profile is judged by itself.

    Parameters
    ----------
    ranges : (n, m) uint16, raw, 0 no return.
    y0, z0, dy, dz : (m,) float64, y and z of the rays' origins (m) and directions, sensor frame.
    scale : (2,) tuple, range_offset_m, range_step_m; raw_limits : (2,) tuple of int64, lowest and highest raw range.
    settings : (13,) tuple of float64, see :data:`SETTINGS`.
    classes : (n, m) uint8, out: CLASS_KEPT for the road, or why not.
    """
    m = ranges.shape[1]
    y, up, height, bend, sums = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m + 1)
    index, trail = np.empty(m, np.int32), np.empty(m, np.int32)
    kinds, trial, best = np.empty(m, np.uint8), np.empty(m, np.uint8), np.empty(m, np.uint8)
    counts = np.empty(np.int64(2.0 * HISTOGRAM_REACH_M / settings[BIN]) | 1, np.int32)
    sample = np.empty(NOISE_SAMPLES)
    sine = np.sin(settings[GRAZING])
    for p in range(ranges.shape[0]):
        n = profile_points(ranges[p], y0, z0, dy, dz, scale, raw_limits, classes[p], y, up, index)
        if n < FEWEST:
            for i in range(n):
                classes[p, index[i]] = CLASS_OFF_ROAD
            continue
        datum = road_datum(y[:n], up[:n], settings[GATE])
        for i in range(n):
            height[i] = up[i] - parabola_at(datum, y[i] - datum[3])
        threshold = height_threshold(height[:n], settings[BIN], settings[SHARE], counts)
        mark_above(height[:n], threshold, kinds[:n])
        curvatures(y[:n], up[:n], bend[:n])
        noise = range_noise(bend[:n], index[:n], dz, kinds[:n], sample)
        mark_scattered(
            bend[:n], index[:n], dz, noise, settings[SCATTER_FACTOR], np.int64(settings[SCATTER_READINGS]),
            sums[: n + 1], kinds[:n],
        )  # fmt: skip
        mark_grazing(y[:n], up[:n], index[:n], dy, dz, sine, settings[CHORD], kinds[:n])
        for i in range(n):
            bend[i] = settings[NOISE_FACTOR] * noise * max(abs(dz[index[i]]), LEAST_DZ)
        mark_off_road(y[:n], up[:n], height[:n], bend[:n], settings, trail[:n], trial[:n], best[:n], kinds[:n])
        for i in range(n):
            classes[p, index[i]] = kinds[i]


CLASS_SCATTERED, CLASS_OFF_ROAD = 10, 12
"""Classes of objects behind which the road continues, and of readings beyond the road's edge."""

SETTINGS = (
    "bin", "share", "gate", "scatter_factor", "scatter_readings", "grazing", "chord", "step", "noise_factor", "slope",
    "window", "window_readings", "bridge",
)  # fmt: skip
"""Order of the `settings` tuple; lengths in metres, angles in radians (``georeference.road_profiles``)."""
(
    BIN, SHARE, GATE, SCATTER_FACTOR, SCATTER_READINGS, GRAZING, CHORD, STEP, NOISE_FACTOR, SLOPE,
    WINDOW, WINDOW_READINGS, BRIDGE,
) = range(13)  # fmt: skip

PENDING_ABOVE, PENDING_BELOW = np.uint8(254), np.uint8(255)  # Set until the road is found to continue or end.
REJOIN = 3
"""The road continues behind an object or a hole if this many readings in a row lie on its line."""

NO_LINE = (0.0,) * 5
"""Sums of a line before its first reading."""


@inlined
def line_at(line, y):
    """Return the height at y of the least-squares line with the sums `line`: count, Σy, Σup, Σy², Σy up."""
    count, sum_y, sum_up, sum_yy, sum_y_up = line
    spread = count * sum_yy - sum_y * sum_y
    slope = (count * sum_y_up - sum_y * sum_up) / spread if spread > 1e-6 * count * count else 0.0
    return (sum_up + slope * (count * y - sum_y)) / count


@inlined
def counted_in(line, y, up, sign):
    """Return the sums of a line after adding a reading, or after removing one for sign −1."""
    return (
        line[0] + sign,
        line[1] + sign * y,
        line[2] + sign * up,
        line[3] + sign * y * y,
        line[4] + sign * y * up,
    )


@inner
def follow_road(y, up, height, spread, start, way, settings, trail, head, line, kinds):
    """Step 4: follow the road outwards from reading `start` as long as readings continue its line.

    Parameters
    ----------
    spread : (n,) float64, what the noise adds to the tolerance (m); way : +1 or −1.
    trail : (n,) int32, in/out: readings of the line so far; head : int64, how many; line : (5,) tuple, their sums.
    kinds : (n,) uint8, in/out.
    """
    n = y.size
    step, slope, bridge = settings[STEP], settings[SLOPE], settings[BRIDGE]
    window, window_readings = settings[WINDOW], np.int64(settings[WINDOW_READINGS])
    tail = np.int64(0)
    origin_y, origin_up = y[start], up[start]
    last, since, good = start, np.int64(-1), 0
    end = n if way > 0 else -1
    j = start + way
    while j != end:
        if kinds[j] == CLASS_KEPT:
            gap = abs(y[j] - y[last])
            if gap > bridge:
                break
            over = up[j] - origin_up - line_at(line, y[j] - origin_y)
            most = step + spread[j] + slope * gap
            fits = abs(over) <= most
            if since >= 0 and not fits:
                # The line has passed through a hole: the road behind it is as high above the datum as before it.
                before = (height[trail[tail]] + height[trail[tail + 1]] + height[trail[tail + 2]]) / 3.0
                near = step + spread[j]
                deepest = before
                for i in range(tail, head):
                    deepest = min(deepest, height[trail[i]])
                fits = deepest < before - near and abs(height[j] - before) <= near
            if fits and since < 0:
                trail[head] = j
                head += 1
                line = counted_in(line, y[j] - origin_y, up[j] - origin_up, 1.0)
                last = j
            elif fits:
                good += 1
                if good == REJOIN:
                    for i in range(since, j + way, way):
                        if kinds[i] == CLASS_KEPT:
                            trail[head] = i
                            head += 1
                            line = counted_in(line, y[i] - origin_y, up[i] - origin_up, 1.0)
                        elif kinds[i] == PENDING_ABOVE:
                            kinds[i] = CLASS_SCATTERED
                        elif kinds[i] == PENDING_BELOW:
                            kinds[i] = CLASS_KEPT
                    last, since, good = j, np.int64(-1), 0
            else:
                since = j if since < 0 else since
                good = 0
                kinds[j] = PENDING_ABOVE if over > 0.0 else PENDING_BELOW
            while head - tail > window_readings and abs(y[last] - y[trail[tail]]) > window:
                line = counted_in(line, y[trail[tail]] - origin_y, up[trail[tail]] - origin_up, -1.0)
                tail += 1
        j += way
    first = j if since < 0 else since
    while first != end:
        kind = kinds[first]
        if (kind == CLASS_KEPT) | (kind == PENDING_ABOVE) | (kind == PENDING_BELOW):
            kinds[first] = CLASS_OFF_ROAD
        first += way


@inner
def road_from(start, y, up, height, spread, settings, trail, kinds):
    """Step 4 from one reading: follow the road both ways, beginning with the line through the readings around it.

    Readings that begin the line differ from the start by no more than the gate in `height`.

    Returns
    -------
    int, how many readings are left as road.
    """
    n = y.size
    window, window_readings = settings[WINDOW], np.int64(settings[WINDOW_READINGS])
    for way in (-1, 1):
        line, head = NO_LINE, np.int64(0)
        # The line includes readings on both sides of the start, so both ways begin with the same readings.
        first = start
        while (
            first - way >= 0
            and first - way < n
            and (abs(y[first - way] - y[start]) <= 0.5 * window or abs(first - way - start) < window_readings)
        ):
            first -= way
        i = first
        while i != start + way:
            if kinds[i] == CLASS_KEPT and abs(height[i] - height[start]) <= settings[GATE]:
                trail[head] = i
                head += 1
                line = counted_in(line, y[i] - y[start], up[i] - up[start], 1.0)
            i += way
        follow_road(y, up, height, spread, start, way, settings, trail, head, line, kinds)
    return count_kept(kinds)


@inner
def count_kept(kinds):
    """Return the number of readings classified as road."""
    kept = 0
    for j in range(kinds.size):
        kept += kinds[j] == CLASS_KEPT
    return kept


@kernel
def mark_off_road(y, up, height, spread, settings, trail, trial, best, kinds):
    """Step 4: mark readings off the carriageway, which is the connected surface with the most readings.

    The middle reading is tried first; others only where it reaches less than half of all.
    best, trial : (n,) uint8, scratch.
    """
    n = y.size
    every = count_kept(kinds)
    most, found = 0, 0
    copy_values(kinds, best)
    for share in (8, 4, 12, 2, 14):
        start, seen = np.int64(-1), 0
        for j in range(n):
            if kinds[j] == CLASS_KEPT:
                if 16 * seen >= share * every:
                    start = j
                    break
                seen += 1
        if start < 0 or (most > 0 and best[start] == CLASS_KEPT):
            continue
        copy_values(kinds, trial)
        found = road_from(start, y, up, height, spread, settings, trail, trial)
        if found > most:
            most = found
            copy_values(trial, best)
        if 2 * most >= every:
            break
    copy_values(best, kinds)


@kernel
def keep_road(kinds, first_kind, ranges, counts):
    """Set the ranges of readings of the classes from `first_kind` on to 0, and count them.

    Parameters
    ----------
    kinds : (n,) uint8, class of each reading; first_kind : int.
    ranges : (n,) uint16, in/out; counts : (k,) int64, in/out, readings of the classes from `first_kind` on.
    """
    for j in range(kinds.size):
        ranges[j] = ranges[j] if kinds[j] < first_kind else np.uint16(0)
    for k in range(counts.size):
        total = 0
        for j in range(kinds.size):
            total += kinds[j] == first_kind + k
        counts[k] += total
