"""Edges of range between neighbouring returns, and how well they lie on edges of a picture for turns of its camera."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

OPPOSITE = -0.7
"""Cosine of the angle between two ways from a return, at most, of which one goes on the other beyond it."""
LENGTHS = 4.0
"""The way beyond is so many times longer or shorter at most."""


@kernel
def continued(
    starts: npt.NDArray[np.int64], neighbours: npt.NDArray[np.int64], tangent: npt.NDArray[np.float64],
    inverse: npt.NDArray[np.float64], first: npt.NDArray[np.int64], second: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:  # fmt: skip
    """Returns inverse depths (e,; 1/m) at the second ends, if the surface of the first ends goes on as it came.

    A plane has an inverse depth that is linear in the tangents, so that a road far ahead shows no edge.

    Parameters
    ----------
    starts, neighbours : of return k the neighbours from `starts[k]` to `starts[k + 1]`.
    tangent : (n, 2) of the returns. inverse : (n,) inverse depth (1/m). first, second : (e,) ends.
    """
    found = np.empty(first.size)
    for e in range(first.size):
        a, b = first[e], second[e]
        right, down = tangent[b, 0] - tangent[a, 0], tangent[b, 1] - tangent[a, 1]
        length = math.sqrt(right * right + down * down)
        found[e], most = inverse[a], OPPOSITE
        for k in range(starts[a], starts[a + 1]):
            c = neighbours[k]
            aside, under = tangent[c, 0] - tangent[a, 0], tangent[c, 1] - tangent[a, 1]
            own = math.sqrt(aside * aside + under * under)
            if own * LENGTHS < length or own > LENGTHS * length or own == 0.0 or length == 0.0:
                continue
            cosine = (aside * right + under * down) / (own * length)
            if cosine < most:
                most = cosine
                found[e] = inverse[a] + (inverse[a] - inverse[c]) * length / own
    return found


@kernel
def scores_of_turns(
    place: npt.NDArray[np.float64], slope: npt.NDArray[np.float64], direction: npt.NDArray[np.int64],
    weight: npt.NDArray[np.float64], response: npt.NDArray[np.float32],
    turns: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]],
    out: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """Write the weighted sum of responses at m edges for each of the turns about three axes.

    Parameters
    ----------
    place : (m, 2) column and row of the edges in the responses, without a turn.
    slope : (m, 2, 3) by which turns move them (1/rad).
    direction : (m,) which response an edge asks.
    response : (k, height, width).
    turns : angles about each axis (rad).
    out : (a, b, c)
    """
    height, width = response.shape[1], response.shape[2]
    for a in range(turns[0].size):
        for b in range(turns[1].size):
            for c in range(turns[2].size):
                total = 0.0
                for m in range(place.shape[0]):
                    u = place[m, 0] + slope[m, 0, 0] * turns[0][a] + slope[m, 0, 1] * turns[1][b]
                    v = place[m, 1] + slope[m, 1, 0] * turns[0][a] + slope[m, 1, 1] * turns[1][b]
                    u += slope[m, 0, 2] * turns[2][c]
                    v += slope[m, 1, 2] * turns[2][c]
                    column, row = math.floor(u), math.floor(v)
                    if column < 0 or row < 0 or column >= width - 1 or row >= height - 1:
                        continue
                    i, j, right, down = int(column), int(row), u - column, v - row
                    own = response[direction[m]]
                    upper = own[j, i] * (1.0 - right) + own[j, i + 1] * right
                    lower = own[j + 1, i] * (1.0 - right) + own[j + 1, i + 1] * right
                    total += weight[m] * (upper * (1.0 - down) + lower * down)
                out[a, b, c] = total
