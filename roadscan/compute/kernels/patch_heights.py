"""Heights of a Clough–Tocher patch at eight nodes at once, in vector registers.

Numba's loop over the nodes stays scalar, and the third that contains a node is a branch that no processor predicts.
Here the control points of its third are chosen for all nodes at once. Without the compiler NumPy does the same.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel
from roadscan.compute.kernels.column_statistics import generator
from roadscan.compute.kernels.vectors import I64, everywhere, load, store
from roadscan.compute.numba_internals import ir, types

CORNER, EDGE, BY_CORNER, BY_EDGE, INNER, CENTRE, POINTS = 0, 3, 9, 12, 15, 18, 19
"""Where the control points of a patch begin in its row, and how many there are; the table stands in
``surface.clough_tocher``."""
AT_ONCE = 8  # Nodes that are handled at once: 64-bit lanes of a 512-bit register.
PER_EDGE = 4
"""Numbers of an edge: a point (x, y) and a direction (dx, dy)."""
SCALE = 3 * PER_EDGE
"""Where 1 / twice the triangle's area stands, behind its three edges."""

_EIGHT = ir.VectorType(ir.DoubleType(), AT_ONCE)
_EDGES, _PATCHES, _PATCH, _X, _Y, _HEIGHTS, _FIRST = range(7)  # Places of the arguments of `heights_of_eight`.


class _Eight:
    """Eight numbers in a vector, with the operators of a NumPy array."""

    def __init__(self, builder, value):
        self.b, self.value = builder, value

    def _of(self, other):
        return other.value if isinstance(other, _Eight) else ir.Constant(_EIGHT, [float(other)] * AT_ONCE)

    def __add__(self, other):
        return _Eight(self.b, self.b.fadd(self.value, self._of(other)))

    def __sub__(self, other):
        return _Eight(self.b, self.b.fsub(self.value, self._of(other)))

    def __mul__(self, other):
        return _Eight(self.b, self.b.fmul(self.value, self._of(other)))

    __rmul__ = __mul__

    def __lt__(self, other):
        return _Eight(self.b, self.b.fcmp_ordered("<", self.value, self._of(other)))

    def __ge__(self, other):
        return _Eight(self.b, self.b.fcmp_ordered(">=", self.value, self._of(other)))

    def __and__(self, other):
        return _Eight(self.b, self.b.and_(self.value, other.value))

    def where(self, first, second):
        """Return lanes of `first` where this holds, of `second` elsewhere."""
        return _Eight(self.b, self.b.select(self.value, first.value, self._of(second)))


class _Array(np.ndarray):
    """The same interface as :class:`_Eight`, in NumPy."""

    def where(self, first, second):
        return np.where(self, first, second).view(_Array)


def _heights(edge, patch, x, y):
    """Heights at x, y, NaN outside the triangle; edge(k), patch(k) : a number for all lanes."""
    sides = [
        edge(PER_EDGE * k + 2) * (y - edge(PER_EDGE * k + 1)) - edge(PER_EDGE * k + 3) * (x - edge(PER_EDGE * k))
        for k in range(3)
    ]
    inside = (sides[0] >= 0.0) & (sides[1] >= 0.0) & (sides[2] >= 0.0)
    l0, l1, l2 = (side * edge(SCALE) for side in sides)
    second = l1 < l0
    least = second.where(l1, l0)
    third = l2 < least
    least = third.where(l2, least)

    def own(at0, at1, at2):
        return third.where(at2, second.where(at1, at0))

    def at_ends(first):
        a, b, c = (patch(first + k) for k in range(3))
        return own(b, c, a), own(c, a, b)

    u, v, w = own(l1, l2, l0) - least, own(l2, l0, l1) - least, 3.0 * least
    (inner_i, inner_j), (corner_i, corner_j), (z_i, z_j) = at_ends(INNER), at_ends(BY_CORNER), at_ends(CORNER)
    by_edge = own(*(patch(BY_EDGE + k) for k in range(3)))
    edge_i, edge_j = (own(*(patch(EDGE + 2 * k + end) for k in range(3))) for end in range(2))
    towards = 3.0 * (u * inner_i + v * inner_j) + w * patch(CENTRE)
    around = u * u * corner_i + 2.0 * u * v * by_edge + v * v * corner_j
    near, far = u * u * (u * z_i + 3.0 * v * edge_i), v * v * (v * z_j + 3.0 * u * edge_j)
    return inside.where(near + far + w * (3.0 * around + w * towards), np.nan)


def _write(lanes):
    b = lanes.b

    def spread(which, first):
        at = b.gep(lanes.data[which], [first])
        return lambda k: _Eight(b, everywhere(b, _EIGHT, b.load(b.gep(at, [I64(k)]))))

    x, y = (_Eight(b, load(b, b.gep(lanes.data[which], [lanes.data[_FIRST]]), _EIGHT)) for which in (_X, _Y))
    found = _heights(spread(_EDGES, I64(0)), spread(_PATCHES, lanes.data[_PATCH]), x, y)
    store(b, found.value, b.gep(lanes.data[_HEIGHTS], [lanes.data[_FIRST]]))


@intrinsic
def _written(typingctx, edges, patches, patch, x, y, heights, first):
    return types.void(edges, patches, patch, x, y, heights, first), generator(_write)


def _by_numpy(edges, patches, patch, x, y, heights, first):
    own = slice(int(first), int(first) + AT_ONCE)
    places = x[own].view(_Array), y[own].view(_Array)
    heights[own] = _heights(lambda k: edges[k], lambda k: patches[int(patch) + k], *places)


heights_of_eight: Kernel = _by_numpy if numba.config.DISABLE_JIT else _written
"""heights_of_eight(edges, patches, patch, x, y, heights, first)

edges : (SCALE + 1,) float64, the edges opposite the three corners, the triangle where dx·Δy - dy·Δx ≥ 0, and 1 / twice
its area; patches : float64, the control points of all triangles, one after another; patch : uint64, where those of the
triangle begin; x, y : float64 (m), nodes; heights : float64 (m), out, NaN outside the triangle; first : uint64, number
of the first node."""
