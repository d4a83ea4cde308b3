"""Statistics of the columns of a small table, sixteen cells at a time, in vector registers.

Numba's loops over such a table stay scalar: the compiler cannot know that two rows do not overlap. So the rows are
loaded into registers here and everything is written out as instructions: medians by a sorting network (Batcher 1968,
"Sorting networks and their applications", odd-even mergesort). Without the compiler NumPy does the same.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.compute.kernel_options import Kernel, bare
from roadscan.compute.kernels import vectors
from roadscan.compute.kernels.vectors import I16, I32, I64, constant, everywhere, instruction, load, store
from roadscan.compute.numba_internals import ir, types

LANES = 16  # Cells that are handled at a time: 32-bit lanes of a 512-bit register.
LARGEST = np.int32(2**31 - 1)  # Stands for a missing height in sorting.

OUTLIER_SIGMAS = 3.0  # Heights farther from the median than this many robust σ do not count.
REACH = OUTLIER_SIGMAS * SIGMA_OF_MAD
"""Heights up to this many median absolute deviations (MAD) from the median count."""

_F64 = ir.DoubleType()
_ROW = ir.VectorType(I32, LANES)


def exchanges(n):
    """Return pairs (i, j), i < j, that sort n rows when the rows of each pair are put in order one after another."""
    pairs = []
    p = 1
    while p < n:
        k = p
        while k >= 1:
            pairs += [
                (i + j, i + j + k)
                for j in range(k % p, n - k, 2 * k)
                for i in range(min(k, n - j - k))
                if (i + j) // (2 * p) == (i + j + k) // (2 * p)
            ]
            k //= 2
        p *= 2
    return pairs


class Lanes:
    """Writer of instructions on rows of sixteen lanes; arguments are contiguous arrays."""

    def __init__(self, context, builder, signature, arguments):
        self.b = builder
        self.data = [
            vectors.start(context, builder, signature, arguments, k) if isinstance(kind, types.Array) else arguments[k]
            for k, kind in enumerate(signature.args)
        ]

    def load(self, which, k=0):
        """Load row k of an array of int32."""
        return vectors.load(self.b, self._place(which, k, _ROW), _ROW)

    def store(self, which, value, k=0):
        """Store a vector; k counts vectors of its type."""
        vectors.store(self.b, value, self._place(which, k, value.type))

    def _place(self, which, k, kind):
        start = self.b.bitcast(self.data[which], kind.as_pointer())
        return self.b.gep(start, [I64(k)])

    def all(self, value, kind=_ROW):
        """Return a row with the same number in every lane."""
        number = float(value) if isinstance(kind.element, ir.DoubleType) else int(value)
        return ir.Constant(kind, [number] * kind.count)

    def least(self, a, b):
        """Return the smaller of two, lane by lane."""
        return self.b.select(self.b.icmp_signed("<", a, b), a, b)

    def most(self, a, b):
        """Return the larger of two, lane by lane."""
        return self.b.select(self.b.icmp_signed(">", a, b), a, b)

    def size(self, a):
        """Return the absolute value."""
        return self.b.select(self.b.icmp_signed("<", a, self.all(0)), self.b.neg(a), a)

    def ordered(self, rows, pairs):
        """Return the rows sorted within each lane."""
        rows = list(rows)
        for i, j in pairs:
            rows[i], rows[j] = self.least(rows[i], rows[j]), self.most(rows[i], rows[j])
        return rows

    def picked(self, rows, index):
        """Return for each lane the value of the row with the lane's index."""
        found = rows[0]
        for k, row in enumerate(rows[1:], start=1):
            found = self.b.select(self.b.icmp_signed("==", index, self.all(k)), row, found)
        return found

    def halves(self, row, kind=I64):
        """Return both halves of a row of int32 as wider numbers."""
        wide = ir.VectorType(kind, LANES // 2)
        parts = []
        for first in (0, LANES // 2):
            half = vectors.picked(self.b, row, row, range(first, first + LANES // 2))
            parts.append(self.b.sitofp(half, wide) if kind is _F64 else self.b.sext(half, wide))
        return parts

    def medians(self, n, heights, counts):
        """Return rows of `heights`, which of them exist in each lane, and lower medians of them and their distances."""
        count = self.load(counts)
        there = [self.b.icmp_signed(">", count, self.all(k)) for k in range(n)]
        middle = self.b.ashr(self.b.sub(count, self.all(1)), self.all(1))
        pairs = exchanges(n)
        raw = [self.load(heights, k) for k in range(n)]
        rows = [self.b.select(t, r, self.all(LARGEST)) for t, r in zip(there, raw, strict=True)]
        centre = self.picked(self.ordered(rows, pairs), middle)
        away = [self.size(self.b.sub(row, centre)) for row in rows]
        away = [self.b.select(t, a, self.all(LARGEST)) for t, a in zip(there, away, strict=True)]
        return raw, there, centre, self.picked(self.ordered(away, pairs), middle)


def generator(write):
    """Build an intrinsic without return value whose instructions `write` (Lanes) writes."""

    def generate(context, builder, signature, arguments):
        write(Lanes(context, builder, signature, arguments))
        return context.get_dummy_value()

    return generate


def _medians(n):
    def write(lanes):
        _, _, centre, away = lanes.medians(n, 0, 1)
        lanes.store(2, centre)
        lanes.store(3, away)

    @intrinsic
    def written(typingctx, heights, counts, median, deviation):
        return types.void(heights, counts, median, deviation), generator(write)

    def medians(heights, counts, median, deviation):
        written(heights, counts, median, deviation)

    return bare(medians)


def reach_of(lanes, away, floor):
    """Return the distance from the median up to which heights count: REACH · away or the larger floor, in quanta."""
    b, double = lanes.b, ir.VectorType(_F64, LANES // 2)
    reach = []
    for half in lanes.halves(away, _F64):
        far = b.fmul(lanes.all(REACH, double), half)
        far = instruction(b, "llvm.floor.v8f64", double, b.select(b.fcmp_ordered(">", far, floor), far, floor))
        reach.append(b.fptosi(far, ir.VectorType(I32, LANES // 2)))
    return vectors.picked(b, *reach, range(LANES))


def write_statistics(lanes, out, quantum, bases, size, light, centre, low, high, used, sums):
    """Write the statistics of sixteen cells, see :func:`statistics_of`, as rows of the argument `out`.

    bases, size, light, centre, low, high, used : rows of int32: the cells' bases, heights and sums of intensities, the
    medians, lowest and highest heights as differences from the median, heights near the median.
    sums : of the differences from the median, of their squares, and of those near it: each as two halves of int64.
    """
    b, double = lanes.b, ir.VectorType(_F64, LANES // 2)
    medians, lows, highs = (lanes.halves(row) for row in (b.add(centre, bases), low, high))
    sizes, useds, lights = (lanes.halves(row, _F64) for row in (size, used, light))
    for k in range(2):
        middle, total, square, close = (b.sitofp(v[k], double) for v in (medians, *sums))
        average = b.fdiv(total, sizes[k])
        lanes.store(out, b.fmul(b.fadd(middle, average), quantum), k)
        lanes.store(out, b.fmul(b.fadd(middle, b.fdiv(close, useds[k])), quantum), 2 + k)
        lanes.store(out, b.fmul(b.sitofp(b.add(medians[k], lows[k]), double), quantum), 4 + k)
        lanes.store(out, b.fmul(b.sitofp(b.add(medians[k], highs[k]), double), quantum), 6 + k)
        variance = b.fsub(b.fdiv(square, sizes[k]), b.fmul(average, average))
        variance = b.select(b.fcmp_ordered(">", variance, lanes.all(0, double)), variance, lanes.all(0, double))
        lanes.store(out, b.fmul(instruction(b, "llvm.sqrt.v8f64", double, variance), quantum), 8 + k)
        lanes.store(out, b.fdiv(lights[k], sizes[k]), 10 + k)


def _statistics(n):
    def write(lanes):
        b = lanes.b
        raw, there, centre, away = lanes.medians(n, 0, 1)
        double, wide = (ir.VectorType(kind, LANES // 2) for kind in (_F64, I64))
        least, quantum = (everywhere(b, double, lanes.data[k]) for k in (4, 5))
        farthest = reach_of(lanes, away, least)
        total, squares, near = ([lanes.all(0, wide)] * 2 for _ in range(3))
        used, low, high = lanes.all(0), lanes.all(LARGEST), lanes.all(-int(LARGEST))
        for row, own in zip(raw, there, strict=True):
            d = b.sub(row, centre)
            low, high = b.select(own, lanes.least(low, d), low), b.select(own, lanes.most(high, d), high)
            d = b.select(own, d, lanes.all(0))
            inside = b.and_(own, b.icmp_signed("<=", lanes.size(d), farthest))
            used = b.add(used, b.zext(inside, _ROW))
            close = b.select(inside, d, lanes.all(0))
            parts = lanes.halves(d)
            total = [b.add(t, p) for t, p in zip(total, parts, strict=True)]
            squares = [b.add(t, b.mul(p, p)) for t, p in zip(squares, parts, strict=True)]
            near = [b.add(t, p) for t, p in zip(near, lanes.halves(close), strict=True)]
        bases, size, light = lanes.load(3), lanes.load(1), lanes.load(2)
        write_statistics(
            lanes, 6, quantum, bases, size, light, centre, low, high, used, (total, squares, near)
        )  # fmt: skip

    @intrinsic
    def written(typingctx, heights, counts, light, bases, floor, quantum_m, out):
        arguments = heights, counts, light, bases, floor, quantum_m, out
        return types.void(*arguments), generator(write)

    def statistics(heights, counts, light, bases, floor, quantum_m, out):
        written(heights, counts, light, bases, floor, quantum_m, out)

    return bare(statistics)


def _medians_by_numpy(heights, counts, median, deviation):
    for lane in np.flatnonzero(counts):
        own = np.sort(heights[: counts[lane], lane])
        median[lane] = own[(own.size - 1) // 2]
        deviation[lane] = np.sort(np.abs(own - median[lane]))[(own.size - 1) // 2]


def statistics_by_numpy(heights, counts, light, bases, floor, quantum_m, out):
    """Compute in NumPy what the kernel of :func:`statistics_of` computes."""
    median, away = np.zeros(LANES, np.int32), np.zeros(LANES, np.int32)
    _medians_by_numpy(heights, counts, median, away)
    for lane in np.flatnonzero(counts):
        n, middle = int(counts[lane]), int(median[lane]) + int(bases[lane])
        d = heights[:n, lane].astype(np.int64) - median[lane]
        near = d[np.abs(d) <= np.floor(max(REACH * away[lane], floor))]
        average = d.sum() / n
        deviation = np.sqrt(max((d * d).sum() / n - average * average, 0.0))
        heights_of = middle + average, middle + near.sum() / near.size, middle + d.min(), middle + d.max(), deviation
        out[:5, lane] = np.array(heights_of) * quantum_m
        out[5, lane] = light[lane] / n


def medians_of(n: int) -> Kernel:
    """Return the kernel that finds the medians of up to `n` heights a lane.

    Its arguments: heights (n, 16) int32, of which the first `counts` (16,) int32 of each lane count, differences of
    no more than 2³¹; median (16,) int32, out, the lower one for an even count; deviation (16,) int32, out, the lower
    median of the distances from it (MAD). Lanes without a height get any value.
    """
    return _medians_by_numpy if numba.config.DISABLE_JIT else _medians(n)


def statistics_of(n: int) -> Kernel:
    """Return the kernel that finds the statistics of up to `n` heights a lane.

    Its arguments: heights, counts as for :func:`medians_of`, relative to bases (16,) int32, quanta; light (16,) int32,
    sums of intensities; floor, float64, distance from the median (quanta) up to which heights always count, else it is
    3 · 1.4826 · MAD; quantum_m, float64; out (6, 16) float64: mean, robust, lowest and highest height, standard
    deviation of the heights (m), mean intensity. The robust height is the mean of those within reach of the median.
    """
    return statistics_by_numpy if numba.config.DISABLE_JIT else _statistics(n)


medians_of_16 = medians_of(16)  # Finds medians of up to 16 heights a lane.
statistics_of_64 = statistics_of(64)  # Finds statistics of up to 64 heights a lane.


_SHORTS, _DOUBLES, _FLOATS = (ir.VectorType(kind, LANES) for kind in (I16, ir.DoubleType(), ir.FloatType()))
_OUT, _COUNTS, _COLUMN, _TILE_ROW, _CELL, _WRITTEN, _PASS, _COLUMNS = range(
    8
)  # Places of the arguments of `store_group`.


def _write_to(kinds, context):
    """Writer to the columns of an argument that is a tuple of arrays of these types."""

    def write(lanes):
        b = lanes.b

        def put(k, at, value):
            array = context.make_array(kinds[k])(context, b, b.extract_value(lanes.data[_COLUMNS], k))
            store(b, value, b.gep(array.data, [at]))

        def counting(kind, first):
            vector = ir.VectorType(kind, LANES)
            return b.add(everywhere(b, vector, lanes.data[first]), constant(vector, range(LANES)))

        table = b.bitcast(lanes.data[_OUT], _DOUBLES.as_pointer())
        statistics = [load(b, b.gep(table, [I64(k)]), _DOUBLES) for k in range(6)]
        statistics[4:] = [b.fptrunc(row, _FLOATS) for row in statistics[4:]]
        cells = [
            counting(I16, _COLUMN),
            everywhere(b, _SHORTS, lanes.data[_TILE_ROW]),
            lanes.load(_COUNTS),
            *statistics,
        ]
        for k, value in enumerate([*cells, counting(I32, _WRITTEN)]):
            put(k, lanes.data[_CELL], value)
        put(len(cells) + 1, b.sext(lanes.data[_WRITTEN], I64), everywhere(b, _SHORTS, lanes.data[_PASS]))

    return write


@intrinsic
def _stored(typingctx, out, counts, first_column, row_number, cell, written, pass_id, columns):
    def write(context, builder, signature, arguments):
        return generator(_write_to(columns.types, context))(context, builder, signature, arguments)

    return types.void(out, counts, first_column, row_number, cell, written, pass_id, columns), write


def _stored_by_numpy(out, counts, first_column, row_number, cell, written, pass_id, columns):
    own = slice(int(cell), int(cell) + LANES)
    columns.column[own], columns.row[own] = int(first_column) + np.arange(LANES), row_number
    columns.readings[own] = counts
    for array, values in zip(columns[3:9], out, strict=True):
        array[own] = values
    columns.pass_offsets[own] = int(written) + np.arange(LANES)
    columns.pass_ids[int(written) : int(written) + LANES] = pass_id


store_group: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_group(out, counts, first_column, row_number, cell, written, pass_id, columns): statistics of sixteen cells.

out : (6, 16) float64; counts : (16,) int32; first_column, row_number : uint16; cell : uint64, where the sixteen go in
the columns; written : int32, where their passes go; pass_id : uint16; columns : ``CellColumns`` (`tiles`)."""
