"""Where points are in a picture, whether it shows them, and their colours there.

Points are processed one by one, so the result for one does not depend on the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.pictures.kernels.lens import FOCAL_X, FOCAL_Y, HEIGHT, WIDTH, place_of

STEPS = 6000.0
"""Steps of a stored distance in which it grows e-fold: 0.02 % each."""
LEAST_M = 0.1
"""Distance of the first step (m); shorter ones are stored as 0."""
UNKNOWN = 65535
"""Stored distance that stands for any distance, however far."""
NO_NORMAL = 0.5  # Cosine of the incidence where no normal is known.
LEAST_COSINE = 0.05  # Least cosine of the incidence in weights.
ALIKE = 24
"""Largest difference of a channel (8 bits) between looks at the same thing, and between pixels of an even surface."""
EVEN, OTHER, GONE = 1, 2, 4
"""Bits of the state of a look: the pixel and its neighbours are alike, so that the colour is right though the point
lies a pixel beside; the point was seen at another time than the picture; and what lies behind it was seen then."""
MOVED_M, MOVED = 0.5, 0.05
"""What was seen so far behind a place (m, and a share of its distance more) was seen through it, by one picture."""
VOTED_M, VOTED = 0.25, 0.02
"""The same where several pictures vote: the underside of a car is 0.6 m before the road behind it, 6 m away."""


class Camera(NamedTuple):
    """A picture as the kernels take it."""

    eye_m: npt.NDArray[np.float64]
    """(3,) projection centre, from the origin of the points."""
    axes: npt.NDArray[np.float64]
    """(3, 3) camera axes from the map."""
    lens: npt.NDArray[np.float64]
    """(19,) in the order of `roadscan.pictures.kernels.lens`."""


class Depths(NamedTuple):
    """What a picture shows: (rows, columns) stored distances, in pixels that stand for `factor` squared ones."""

    nearest: npt.NDArray[np.uint16]
    """A point nearer than this lies in front of what is seen beside it, at an edge."""
    farthest: npt.NDArray[np.uint16]
    """A point farther than this is hidden."""
    moved: npt.NDArray[np.uint16]
    """A point nearer than this, and seen at another time, was not there: what is behind it was seen."""
    factor: float


class Limits(NamedTuple):
    """Which pixels and distances count, and how they weigh."""

    reach_m: float
    border_px: float
    ramp_px: float
    """Width of the strip inside the border in which weights rise to 1."""
    least_sine: float
    """Least cosine of the angle between the ray and a known normal."""
    moment_ns: int
    """Points seen within this of the picture were there."""
    weight: float
    """Sharpness of the picture among those of its run, 0 to 1."""
    window_ns: int = 0
    """Pictures so near in time to a point tell whether it moved."""


@inlined
def stored(distance_m):
    """Return a distance as it is stored: steps of its logarithm."""
    if distance_m <= LEAST_M:
        return 0.0
    return min(STEPS * math.log(distance_m / LEAST_M), 65535.0)


@kernel
def project(point_m, camera, reach_m, pixel, distance_m):
    """Compute where points are in a picture.

    Parameters
    ----------
    point_m : (n, 3) float32, map, from the origin of the camera.
    camera : its picture.
    reach_m : farther points are left out.
    pixel : (n, 2) float32, u and v from the centre of the upper left pixel; written, NaN where a point is not shown.
    distance_m : (n,) float32, written, NaN likewise.
    """
    lens = camera.lens
    for i in range(point_m.shape[0]):
        x = point_m[i, 0] - camera.eye_m[0]
        y = point_m[i, 1] - camera.eye_m[1]
        z = point_m[i, 2] - camera.eye_m[2]
        pixel[i, 0] = np.nan
        pixel[i, 1] = np.nan
        distance_m[i] = np.nan
        if x * x + y * y + z * z > reach_m * reach_m:
            continue
        u, v, square = place_of(x, y, z, camera.axes, lens)
        if -0.5 <= u < lens[WIDTH] - 0.5 and -0.5 <= v < lens[HEIGHT] - 0.5:
            pixel[i, 0] = u
            pixel[i, 1] = v
            distance_m[i] = math.sqrt(square)


@kernel
def look(point_m, epoch_ns, normal, camera, own_epoch_ns, depths, limits, hidden, picture, colour, weight, state):
    """Compute the colours that a picture gives to points, their weights, and the state of these looks.

    Weights are the cosine of the incidence over the square of the size of a pixel at the point, times a ramp beside the
    border and the picture's sharpness.

    Parameters
    ----------
    point_m : (n, 3) float32 or float64, map, from the origin of the camera.
    epoch_ns : (n,) int64, when they were seen; empty: they were always there.
    normal : (n, 3) float32, unit normals of the surface, NaN where unknown.
    camera, own_epoch_ns : the picture, and when it was taken.
    depths, limits : what it shows, and what counts.
    hidden : (height, width) bool, pixels that are not used; (0, 0) where there are none.
    picture : (height, width, 3) uint8.
    colour : (n, 3) float32, written where the weight is not 0.
    weight : (n,) float32, written, 0 where the picture does not show a point.
    state : (n,) uint8, written: `EVEN`, `OTHER`, `GONE`; at most `GONE` where the weight is 0.
    """
    lens = camera.lens
    right, bottom = lens[WIDTH] - 1.0 - limits.border_px, lens[HEIGHT] - 1.0 - limits.border_px
    focal_square = lens[FOCAL_X] * lens[FOCAL_Y]
    for i in range(point_m.shape[0]):
        weight[i] = 0.0
        state[i] = 0
        x = point_m[i, 0] - camera.eye_m[0]
        y = point_m[i, 1] - camera.eye_m[1]
        z = point_m[i, 2] - camera.eye_m[2]
        if x * x + y * y + z * z > limits.reach_m * limits.reach_m:
            continue
        u, v, square = place_of(x, y, z, camera.axes, lens)
        if not (limits.border_px <= u <= right and limits.border_px <= v <= bottom):
            continue
        if hidden.size > 0 and hidden[int(v + 0.5), int(u + 0.5)]:
            continue
        distance = math.sqrt(square)
        row, column = int((v + 0.5) / depths.factor), int((u + 0.5) / depths.factor)
        row, column = min(row, depths.nearest.shape[0] - 1), min(column, depths.nearest.shape[1] - 1)
        code = stored(distance)
        apart_ns = abs(epoch_ns[i] - own_epoch_ns) if epoch_ns.size > 0 else 0
        is_other = apart_ns > limits.moment_ns
        if is_other and depths.moved[row, column] > 0:
            behind = LEAST_M * math.exp(depths.moved[row, column] / STEPS) * (1.0 + MOVED) + MOVED_M
            if apart_ns <= limits.window_ns and distance * (1.0 + VOTED) + VOTED_M < behind:
                state[i] = GONE
            if code < depths.moved[row, column]:
                continue
        if code < depths.nearest[row, column]:
            continue
        if code > depths.farthest[row, column] and depths.farthest[row, column] < UNKNOWN:
            continue
        cosine = NO_NORMAL
        if not math.isnan(normal[i, 0]):
            cosine = abs(x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]) / math.sqrt(x * x + y * y + z * z)
            if cosine < limits.least_sine:
                continue
            cosine = max(cosine, LEAST_COSINE)
        inside = min(u - limits.border_px, right - u, v - limits.border_px, bottom - v)
        ramp = min(1.0, (inside + 1.0) / (limits.ramp_px + 1.0))
        weight[i] = cosine * ramp * limits.weight * focal_square / square
        x0, y0 = int(u), int(v)
        s, t = u - x0, v - y0
        even = True
        for c in range(3):
            above = (1.0 - s) * picture[y0, x0, c] + s * picture[y0, x0 + 1, c]
            under = (1.0 - s) * picture[y0 + 1, x0, c] + s * picture[y0 + 1, x0 + 1, c]
            colour[i, c] = (1.0 - t) * above + t * under
            low, high = 255, 0
            for row in range(int(v + 0.5) - 1, int(v + 0.5) + 2):
                for column in range(int(u + 0.5) - 1, int(u + 0.5) + 2):
                    low, high = min(low, int(picture[row, column, c])), max(high, int(picture[row, column, c]))
            even = even and high - low <= ALIKE
        state[i] |= (EVEN if even else 0) | (OTHER if is_other else 0)


@kernel
def keep_best(colour, weight, state, gain, number, held_colour, held_weight, held_state, held_number, votes):
    """Put the colours of a picture among the best of each point: those with the largest weights, of equals the first.

    Parameters
    ----------
    colour : (n, 3) float32; weight : (n,) float32, 0: none; state : (n,) uint8.
    gain : (3,) factors of the picture's channels.
    number : the picture's number.
    held_colour : (n, k, 3) uint8; held_weight : (n, k) float32, 0: none; held_state : (n, k) uint8; held_number :
        (n, k) int32. Read and written.
    votes : (n, 2) uint8, read and written: pictures that saw through the point, and those of other times that show it.
    """
    most = held_weight.shape[1]
    for i in range(weight.shape[0]):
        if state[i] & GONE:
            votes[i, 0] = min(votes[i, 0] + 1, 255)
        if weight[i] <= 0.0:
            continue
        if state[i] & OTHER and not state[i] & GONE:
            votes[i, 1] = min(votes[i, 1] + 1, 255)
        least = 0
        for k in range(1, most):
            if held_weight[i, k] < held_weight[i, least]:
                least = k
        if weight[i] <= held_weight[i, least]:
            continue
        held_weight[i, least] = weight[i]
        held_state[i, least] = state[i]
        held_number[i, least] = number
        for c in range(3):
            held_colour[i, least, c] = np.uint8(min(255.0, colour[i, c] * gain[c] + 0.5))


@kernel
def weighted_medians(held_colour, held_weight, colour, count):
    """Compute the weighted median of each channel: the least value with half of the weight at it or below.

    Parameters
    ----------
    held_colour : (n, k, 3) uint8; held_weight : (n, k) float32, 0: none.
    colour : (n, 3) uint8, written; 0 where there is none.
    count : (n,) uint8, written: number of pictures.
    """
    most = held_weight.shape[1]
    for i in range(held_weight.shape[0]):
        total = 0.0
        count[i] = 0
        for k in range(most):
            if held_weight[i, k] > 0.0:
                total += held_weight[i, k]
                count[i] += 1
        for c in range(3):
            colour[i, c] = 0
            if count[i] == 0:
                continue
            best = 256
            for k in range(most):
                value = int(held_colour[i, k, c])
                if held_weight[i, k] <= 0.0 or value >= best:
                    continue
                below = 0.0
                for j in range(most):
                    if held_weight[i, j] > 0.0 and held_colour[i, j, c] <= value:
                        below += held_weight[i, j]
                if below >= 0.5 * total * (1.0 - 1e-6):
                    best = value
            colour[i, c] = best


@kernel
def leave_doubtful(held_colour, held_weight, held_state, colour, count):
    """Take the colour from points at which pictures are uneven and no two of them agree with the median.

    There a pixel shows two surfaces, or the one beside the point's.

    Parameters
    ----------
    held_colour : (n, k, 3) uint8; held_weight : (n, k) float32, 0: none; held_state : (n, k) uint8.
    colour : (n, 3) uint8, medians; count : (n,) uint8, of looks. Read and written, 0 where there is none.
    """
    for i in range(held_weight.shape[0]):
        agree, sure = 0, False
        for k in range(held_weight.shape[1]):
            if held_weight[i, k] <= 0.0:
                continue
            off = 0
            for c in range(3):
                off = max(off, abs(int(held_colour[i, k, c]) - int(colour[i, c])))
            if off <= ALIKE:
                agree += 1
                sure = sure or held_state[i, k] & EVEN != 0
        if not sure and agree < 2:
            count[i] = 0
            for c in range(3):
                colour[i, c] = 0


@kernel
def leave_moved(held_weight, held_state, votes):
    """Leave out the looks of other times at what moved: more pictures saw through it than show it.

    Parameters
    ----------
    held_weight : (n, k) float32, read and written, 0: none.
    held_state : (n, k) uint8.
    votes : (n, 2) uint8, as `keep_best` writes them.
    """
    for i in range(held_weight.shape[0]):
        if votes[i, 0] > votes[i, 1]:
            for k in range(held_weight.shape[1]):
                if held_state[i, k] & OTHER:
                    held_weight[i, k] = 0.0


VOTES = 3  # Fewest looks whose median tells what is there.
SHARE = 2.0
"""Power of the weights of looks that are blended: the best view stands out, and seams stay soft."""


@kernel
def blend(held_colour, held_weight, held_number, median, count, colour, number):
    """Blend the looks that agree: with the median where there are three or more, else with the best.

    Parameters
    ----------
    held_colour : (n, k, 3) uint8; held_weight : (n, k) float32, 0: none; held_number : (n, k) int32.
    median : (n, 3) uint8; count : (n,) uint8, of looks.
    colour : (n, 3) uint8, written, from 1; 0 where there is none.
    number : (n,) int32, written: the picture of most weight; −1 where there is none.
    """
    most = held_weight.shape[1]
    for i in range(held_weight.shape[0]):
        number[i] = -1
        for c in range(3):
            colour[i, c] = 0
        if count[i] == 0:
            continue
        best = -1
        for k in range(most):
            if held_weight[i, k] <= 0.0:
                continue
            if count[i] >= VOTES:
                off = 0.0
                for c in range(3):
                    off = max(off, abs(float(held_colour[i, k, c]) - float(median[i, c])))
                if off > ALIKE:
                    continue
            if best < 0 or held_weight[i, k] > held_weight[i, best]:
                best = k
        if best < 0:  # looks disagree in single channels: the median stands for them
            for k in range(most):
                if held_weight[i, k] > 0.0 and (best < 0 or held_weight[i, k] > held_weight[i, best]):
                    best = k
            number[i] = held_number[i, best]
            for c in range(3):
                colour[i, c] = max(median[i, c], np.uint8(1))
            continue
        number[i] = held_number[i, best]
        total = 0.0
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(most):
            if held_weight[i, k] <= 0.0:
                continue
            off = 0.0
            for c in range(3):
                off = max(off, abs(float(held_colour[i, k, c]) - float(held_colour[i, best, c])))
            if off > ALIKE:
                continue
            share = (held_weight[i, k] / held_weight[i, best]) ** SHARE
            total += share
            red += share * held_colour[i, k, 0]
            green += share * held_colour[i, k, 1]
            blue += share * held_colour[i, k, 2]
        colour[i, 0] = np.uint8(max(1.0, red / total + 0.5))
        colour[i, 1] = np.uint8(max(1.0, green / total + 0.5))
        colour[i, 2] = np.uint8(max(1.0, blue / total + 0.5))
