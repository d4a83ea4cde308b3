"""Kernels for the residuals of ties and their derivatives by mountings and poses.

One end of n ties is a tuple of arrays `side`:

- body : (n,) int64, place among the B traverses and objects; −1: the last, which stands for exact poses.
- point : (n, 3) float64, sensor axes (m); those of the body where the end has no sensor.
- position : (n, 3) or (1, 3) float64, of the body in the world (m).
- rotation : (n, 3, 3) or (1, 3, 3) float64, world from body.

Its `mounting` is a tuple of numbers: body from sensor (9, row by row), lever arm (3), range offset, and the beam along
which the offset moves a point (3, sensor axes; zero: away from the sensor). Errors of poses are `shift` (B, 3), world
axes, and small turns of the body `turn` (B, 3, 3).
"""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import inlined, kernel

SIDE = 13
"""Derivatives of an end: lever arm, rotation of the mounting (3 each), range offset, shift, turn of the body (3 each).
"""


@inlined
def times(m, v):
    """Return a matrix (nine numbers, row by row) times a vector."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@inlined
def back(m, v):
    """Return a transposed matrix (nine numbers, row by row) times a vector."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@inlined
def product(a, b):
    """Return the product of two matrices of nine numbers."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@inlined
def placed(seen, mounting, position, rotation, shift, turn):
    """Return place in the world, in body axes, and from the sensor's origin in body axes; beam; world from body."""
    matrix, lever, offset, axis = mounting
    if axis[0] == 0.0 and axis[1] == 0.0 and axis[2] == 0.0:
        length = max(math.sqrt(seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2]), 1e-9)
        along = (seen[0] / length, seen[1] / length, seen[2] / length)
    else:
        along = axis
    beam = times(matrix, along)
    from_sensor = times(matrix, (seen[0] + offset * along[0], seen[1] + offset * along[1], seen[2] + offset * along[2]))
    in_body = (from_sensor[0] + lever[0], from_sensor[1] + lever[1], from_sensor[2] + lever[2])
    turned = product(rotation, turn)
    away = times(turned, in_body)
    place = (position[0] + shift[0] + away[0], position[1] + shift[1] + away[1], position[2] + shift[2] + away[2])
    return place, in_body, from_sensor, beam, turned


@inlined
def vector(rows, i):
    """Return row i of an array (n, 3) as three numbers."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@inlined
def matrix(stack, i):
    """Return matrix i of an array (n, 3, 3) as nine numbers, row by row."""
    return (
        stack[i, 0, 0], stack[i, 0, 1], stack[i, 0, 2],
        stack[i, 1, 0], stack[i, 1, 1], stack[i, 1, 2],
        stack[i, 2, 0], stack[i, 2, 1], stack[i, 2, 2],
    )  # fmt: skip


@inlined
def end(side, mounting, shift, turn, i):
    """Return end i of a side as :func:`placed` does."""
    body, point, position, rotation = side
    j = i if position.shape[0] > 1 else 0
    b = body[i]
    return placed(
        vector(point, i), mounting, vector(position, j), matrix(rotation, j), vector(shift, b), matrix(turn, b)
    )


@kernel
def tie_residuals(first, first_mounting, second, second_mounting, shift, turn, weight, on_object, residual):
    """Compute the whitened differences of n ties.

    Parameters
    ----------
    first, first_mounting, second, second_mounting, shift, turn : see the module.
    weight : (n, k, 3) float64, 1/m, world axes; with `on_object` the axes of the second end's body.
    residual : (n, k) float64, out.
    """
    for i in range(weight.shape[0]):
        p = end(first, first_mounting, shift, turn, i)
        q = end(second, second_mounting, shift, turn, i)
        d = (p[0][0] - q[0][0], p[0][1] - q[0][1], p[0][2] - q[0][2])
        if on_object:
            d = back(q[4], d)
        for k in range(weight.shape[1]):
            residual[i, k] = weight[i, k, 0] * d[0] + weight[i, k, 1] * d[1] + weight[i, k, 2] * d[2]


@kernel
def tie_rows(first, first_mounting, second, second_mounting, shift, turn, weight, on_object, counts, residual, rows):
    """Compute whitened differences and their derivatives, each multiplied by the root of the tie's weight.

    Parameters
    ----------
    first … on_object : as of :func:`tie_residuals`.
    counts : (n,) float64.
    residual : (n, k) float64, out.
    rows : (n, k, 26) float64, out; derivatives of the first end, then of the second. Those of what an end does not
        have are without meaning.
    """
    for i in range(weight.shape[0]):
        p = end(first, first_mounting, shift, turn, i)
        q = end(second, second_mounting, shift, turn, i)
        root = math.sqrt(counts[i])
        d = (p[0][0] - q[0][0], p[0][1] - q[0][1], p[0][2] - q[0][2])
        arm = q[1]
        if on_object:
            # Rows rotate with the object, and so does the position of the first place relative to it.
            d = back(q[4], d)
            arm = (arm[0] + d[0], arm[1] + d[1], arm[2] + d[2])
        for k in range(weight.shape[1]):
            w = (root * weight[i, k, 0], root * weight[i, k, 1], root * weight[i, k, 2])
            residual[i, k] = w[0] * d[0] + w[1] * d[1] + w[2] * d[2]
            if on_object:
                w = times(q[4], w)
            of_first = derivatives(w, back(p[4], w), p[1], p[2], p[3])
            w = (-w[0], -w[1], -w[2])
            of_second = derivatives(w, back(q[4], w), arm, q[2], q[3])
            for a in range(SIDE):
                rows[i, k, a] = of_first[a]
                rows[i, k, SIDE + a] = of_second[a]


@inlined
def derivatives(w, c, in_body, from_sensor, beam):
    """Return the derivatives of w · place, with w in body axes c."""
    return (
        c[0], c[1], c[2],
        from_sensor[1] * c[2] - from_sensor[2] * c[1],
        from_sensor[2] * c[0] - from_sensor[0] * c[2],
        from_sensor[0] * c[1] - from_sensor[1] * c[0],
        beam[0] * c[0] + beam[1] * c[1] + beam[2] * c[2],
        w[0], w[1], w[2],
        in_body[1] * c[2] - in_body[2] * c[1],
        in_body[2] * c[0] - in_body[0] * c[2],
        in_body[0] * c[1] - in_body[1] * c[0],
    )  # fmt: skip
