"""Slots of heights in memory: their layout, statistics of sixteen cells of one slot each, and groups as tables.

Slots of heights in memory: their layout, storing eight heights as one vector, and prefetching.

A slot has 64 bytes, as long as a line of the cache: SLOT_HEIGHTS differences from the slot's base, and a header with
their number, the sum of their intensities and the passes they are from.

Written as instructions, because Numba stores numbers one by one and cannot prefetch.

Statistics of sixteen cells of one slot each, with two heights of a cell in a lane.

The heights of a slot are differences of 16 bits, and sorting is comparing: with 16 bits a register compares 32 at
once. The heights with even numbers of a cell stand in the lower half of its lane, those with odd numbers in the upper
one. Both halves are sorted apart by one network; the element in the middle of two sorted lists a and b of r each is
the largest of min(aᵢ, bᵣ₋₁₋ᵢ) (the first step of Batcher's 1968 bitonic merge). Places without a height are filled so
that the lower median stands in the middle: as many small numbers as bring it there, large ones for the rest.

Turns the sixteen slots of a group into a table of heights with a column a cell, and reads their headers.

A slot has the heights of one cell; statistics need rows with heights of every cell. So the slots are transposed in
registers, two heights at a time.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, bare
from roadscan.compute.kernels.column_statistics import (
    LANES,
    exchanges,
    generator,
    reach_of,
    statistics_by_numpy,
    write_statistics,
)
from roadscan.compute.kernels.vectors import (
    I8,
    I16,
    I32,
    I64,
    compiles_for,
    constant,
    everywhere,
    instruction,
    load,
    picked,
    start,
    store,
)
from roadscan.compute.numba_internals import ir, types

VECTOR = 8
"""Number of heights that are stored at once."""
SLOT_SIZE = 32
"""Numbers of 16 bits in a slot: the heights, then the header."""
SLOT_HEIGHTS = 28
"""Number of heights in a slot."""
SLOT_HEADERS = 8
"""Numbers of 64 bits in a slot; the last one is its header."""
LAST = SLOT_SIZE - VECTOR
"""Most heights that a slot may hold before a whole vector is stored behind them."""
FARTHEST = 32_000
"""Largest difference (quanta) between a height and the base of its slot."""

COUNTS = 31  # Mask of the number of heights in a header.
LIGHT_SHIFT, LIGHTS = 5, (1 << 21) - 1  # Lowest bit and mask of the sum of intensities.
WORD_SHIFT, WORDS = 26, (1 << 14) - 1  # Lowest bit and mask of the word of passes.
MARK_SHIFT = 40  # Lowest bit of the passes.
PASSES = 24
"""A header, from its lowest bit: number of heights (5), sum of intensities (21), word (14), passes (24).

Pass number p has the bit p mod 24 in slots of the word p div 24; a slot has one word."""

_WHOLE, _HALF = ir.VectorType(I32, VECTOR), ir.VectorType(I16, VECTOR)


@intrinsic
def _stored(typingctx, heights, first, base, slots, at):
    def write(context, builder, signature, arguments):
        source, target = (start(context, builder, signature, arguments, k) for k in (0, 3))
        values = load(builder, builder.gep(source, [arguments[1]]), _WHOLE)
        values = builder.trunc(builder.sub(values, everywhere(builder, _WHOLE, arguments[2])), _HALF)
        store(builder, values, builder.gep(target, [arguments[4]]))
        return context.get_dummy_value()

    return types.void(heights, first, base, slots, at), write


def _stored_by_numpy(heights, first, base, slots, at):
    own = heights[int(first) : int(first) + VECTOR]
    slots[int(at) : int(at) + VECTOR] = (own - base).astype(np.int16)


@intrinsic
def _fetched(typingctx, array, at):
    def write(context, builder, signature, arguments):
        place = builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]])
        place = builder.bitcast(place, I8.as_pointer())  # arrays of any type are fetched by one instruction
        instruction(
            builder, "llvm.prefetch.p0", ir.VoidType(), place, I32(1), I32(3), I32(1)
        )  # to write, to keep, data
        return context.get_dummy_value()

    return types.void(array, at), write


def _not_fetched(array, at):
    """Do nothing: without the compiler there is no prefetch."""


store_heights: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_heights(heights, first, base, slots, at): heights[first : first + VECTOR] − base → slots[at : at + VECTOR].

heights : (≥ first + VECTOR,) int32; slots : (m,) int16, contiguous; first, at : uint64; base : int32."""

prefetch: Kernel = _not_fetched if numba.config.DISABLE_JIT else _fetched
"""prefetch(array, at): the line of the cache with array[at] is wanted soon, to be written; at : uint64."""


SMALLEST, LARGEST = -(1 << 15), (1 << 15) - 1
"""Limits of 16-bit numbers; every height lies nearer to its base (``height_slots.FARTHEST``)."""
APART = (1 << 16) - 1
"""Distance from the median in places without a height: greater than that of any height."""

_F64 = ir.DoubleType()
_ROW = ir.VectorType(I32, LANES)
_PAIRS = ir.VectorType(I16, 2 * LANES)  # A row of sixteen lanes with two 16-bit heights each.
_MULTIPLIES = compiles_for("avx512bw")
"""Whether the processor multiplies pairs of 16-bit numbers and adds the products in one instruction."""


class Pairs:
    """Writer of instructions on rows of sixteen lanes of two heights each."""

    def __init__(self, lanes, rows, counts):
        """`rows`, of int32, from memory; `counts`, a row of int32, heights of each lane."""
        self.lanes, self.b = lanes, lanes.b
        self.rows = [self.b.bitcast(row, _PAIRS) for row in rows]
        counts = self.both(counts)
        slots = [constant(_PAIRS, [2 * k, 2 * k + 1] * LANES) for k in range(len(rows))]
        self.there = [self.b.icmp_signed("<", slot, counts) for slot in slots]
        rank = self.b.ashr(self.b.sub(counts, self.all(1)), self.all(1))
        filled = self.b.add(counts, self.b.sub(self.all(len(rows) - 1), rank))
        self.before = [self.b.icmp_signed("<", slot, filled) for slot in slots]
        self.network = exchanges(len(rows))

    def all(self, value):
        """Return a row with the same number in both halves of every lane."""
        return ir.Constant(_PAIRS, [value] * _PAIRS.count)

    def both(self, row):
        """Return a row with the lower half of each lane in both halves."""
        row = self.b.and_(row, self.lanes.all(0xFFFF))
        return self.b.bitcast(self.b.or_(row, self.b.shl(row, self.lanes.all(16))), _PAIRS)

    def split(self, pairs):
        """Return lower and upper halves as rows of int32."""
        row, half = self.b.bitcast(pairs, _ROW), self.lanes.all(16)
        return self.b.ashr(self.b.shl(row, half), half), self.b.ashr(row, half)

    def turned(self, pairs):
        """Return both halves of each lane exchanged."""
        row, half = self.b.bitcast(pairs, _ROW), self.lanes.all(16)
        return self.b.bitcast(self.b.or_(self.b.shl(row, half), self.b.lshr(row, half)), _PAIRS)

    def lower(self, first, second, signed):
        """Return the smaller of two."""
        compare = self.b.icmp_signed if signed else self.b.icmp_unsigned
        return self.b.select(compare("<", first, second), first, second)

    def upper(self, first, second, signed):
        """Return the larger of two."""
        compare = self.b.icmp_signed if signed else self.b.icmp_unsigned
        return self.b.select(compare(">", first, second), first, second)

    def middle(self, rows, least, most, *, signed):
        """Return the lower median of each lane's heights, in both halves."""
        b = self.b
        rows = [
            b.select(there, row, b.select(before, self.all(least), self.all(most)))
            for row, there, before in zip(rows, self.there, self.before, strict=True)
        ]
        for i, j in self.network:
            rows[i], rows[j] = self.lower(rows[i], rows[j], signed), self.upper(rows[i], rows[j], signed)
        found = None
        for first, second in zip(rows, reversed(rows), strict=True):
            pair = self.lower(first, self.turned(second), signed)
            found = pair if found is None else self.upper(found, pair, signed)
        return found

    def sum_of_products(self, first, second):
        """Multiply two rows and add the products of both halves of each lane (int32)."""
        if _MULTIPLIES:
            return instruction(self.b, "llvm.x86.avx512.pmaddw.d.512", _ROW, first, second)
        parts = [self.b.mul(one, other) for one, other in zip(self.split(first), self.split(second), strict=True)]
        return self.b.add(*parts)


def _spread(pairs):
    """Return lowest and highest height of each lane (int32); places without a height count as the first height."""
    first = pairs.both(pairs.b.bitcast(pairs.rows[0], _ROW))
    low, high = first, first
    for row, there in zip(pairs.rows, pairs.there, strict=True):
        own = pairs.b.select(there, row, first)
        low, high = pairs.lower(low, own, True), pairs.upper(high, own, True)
    lows, highs = pairs.split(low), pairs.split(high)
    return pairs.lanes.least(*lows), pairs.lanes.most(*highs)


def _write_for(rows):
    def write(lanes):
        b = lanes.b
        double = ir.VectorType(_F64, LANES // 2)
        floor, quantum = (everywhere(b, double, lanes.data[k]) for k in (4, 5))
        size = lanes.load(1)
        pairs = Pairs(lanes, [lanes.load(0, k) for k in range(rows)], size)
        median = pairs.middle(pairs.rows, SMALLEST, LARGEST, signed=True)
        away = [b.sub(pairs.upper(row, median, True), pairs.lower(row, median, True)) for row in pairs.rows]
        away = [b.select(there, row, pairs.all(APART)) for there, row in zip(pairs.there, away, strict=True)]
        deviation = pairs.middle(away, 0, APART, signed=False)
        far = reach_of(lanes, b.and_(b.bitcast(deviation, _ROW), lanes.all(0xFFFF)), floor)
        far = pairs.both(lanes.least(far, lanes.all(APART - 1)))
        total, near, used = (lanes.all(0) for _ in range(3))
        squares = [lanes.all(0, half.type) for half in lanes.halves(total)]
        for row, there, distance in zip(pairs.rows, pairs.there, away, strict=True):
            own = b.select(there, row, pairs.all(0))
            inside = b.icmp_unsigned("<=", distance, far)
            ones = b.select(inside, pairs.all(1), pairs.all(0))
            total = b.add(total, pairs.sum_of_products(own, pairs.all(1)))
            near = b.add(near, pairs.sum_of_products(row, ones))
            used = b.add(used, pairs.sum_of_products(ones, ones))
            square = lanes.halves(pairs.sum_of_products(own, own))
            squares = [b.add(s, t) for s, t in zip(squares, square, strict=True)]
        centre = pairs.split(median)[0]
        low, high = (b.sub(row, centre) for row in _spread(pairs))
        middles, sizes, totals, nears, useds = (lanes.halves(row) for row in (centre, size, total, near, used))
        sums = [], [], []
        for k in range(2):
            middle, away_from_base = middles[k], b.add(totals[k], totals[k])
            sums[0].append(b.sub(totals[k], b.mul(sizes[k], middle)))
            sums[1].append(b.add(squares[k], b.mul(middle, b.sub(b.mul(sizes[k], middle), away_from_base))))
            sums[2].append(b.sub(nears[k], b.mul(useds[k], middle)))
        write_statistics(lanes, 6, quantum, lanes.load(3), size, lanes.load(2), centre, low, high, used, sums)

    return write


def _compiled(rows):
    @intrinsic
    def written(typingctx, pairs, counts, light, bases, floor, quantum_m, out):
        return types.void(pairs, counts, light, bases, floor, quantum_m, out), generator(_write_for(rows))

    def statistics(pairs, counts, light, bases, floor, quantum_m, out):
        written(pairs, counts, light, bases, floor, quantum_m, out)

    return bare(statistics)


def _by_numpy(pairs, counts, light, bases, floor, quantum_m, out):
    statistics_by_numpy(heights_of(pairs), counts, light, bases, floor, quantum_m, out)


def heights_of(pairs):
    """Unpack pairs (r, 16) int32 into heights (2 r, 16) int32, in NumPy."""
    return (
        np.ascontiguousarray(pairs.view(np.int16).reshape(len(pairs), LANES, 2).transpose(0, 2, 1))
        .reshape(-1, LANES)
        .astype(np.int32)
    )


def slot_statistics_of(rows: int) -> Kernel:
    """Return the kernel that finds the statistics of up to 2 · `rows` heights a cell.

    Its arguments: pairs (rows, 16) int32, heights 2 k and 2 k + 1 of a cell as the lower and the upper 16 bits of row
    k, relative to bases, each no more than 32,000 away; the others are those of ``column_statistics.statistics_of``.
    """
    return _by_numpy if numba.config.DISABLE_JIT else _compiled(rows)


slot_statistics_of_8, slot_statistics_of_28 = (slot_statistics_of(rows) for rows in (4, 14))  # For 8 and 28 heights.


_LINE = ir.VectorType(I32, LANES)


def _turned(b, rows):
    """Transpose 16 rows by interleaving every row with the one eight rows further on, four times."""
    halves = [[n for k in range(8) for n in (first + k, LANES + first + k)] for first in (0, LANES // 2)]
    for _ in range(4):
        rows = [picked(b, rows[k], rows[k + 8], half) for k in range(8) for half in halves]
    return rows


def _write(lanes):
    b = lanes.b
    first = b.bitcast(b.gep(lanes.data[0], [lanes.data[1]]), _LINE.as_pointer())
    rows = _turned(b, [load(b, b.gep(first, [I64(k)]), _LINE) for k in range(LANES)])
    for k in range(SLOT_HEIGHTS // 2):
        lanes.store(2, rows[k], k)
    low, high = rows[-2:]
    lanes.store(3, b.and_(low, lanes.all(COUNTS)))
    lanes.store(4, b.and_(b.lshr(low, lanes.all(LIGHT_SHIFT)), lanes.all(LIGHTS)))
    lanes.store(5, b.lshr(high, lanes.all(MARK_SHIFT - 32)))


def _write_apart(lanes):
    b, sixteen = lanes.b, lanes.all(16)
    for k in range(SLOT_HEIGHTS // 2):
        row = lanes.load(0, k)
        lanes.store(1, b.ashr(b.shl(row, sixteen), sixteen), 2 * k)
        lanes.store(1, b.ashr(row, sixteen), 2 * k + 1)


@intrinsic
def _opened(typingctx, slots, first, pairs, counts, light, marks):
    return types.void(slots, first, pairs, counts, light, marks), generator(_write)


@intrinsic
def _put_apart(typingctx, pairs, heights):
    return types.void(pairs, heights), generator(_write_apart)


@intrinsic
def _chained(typingctx, chain, first):
    def write(context, builder, signature, arguments):
        own = load(builder, builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]]), _LINE)
        longer = builder.icmp_signed(">=", own, constant(_LINE, [0] * LANES))
        return builder.zext(builder.bitcast(longer, I16), I64)

    return types.uint64(chain, first), write


def _opened_by_numpy(slots, first, pairs, counts, light, marks):
    own = slots[int(first) : int(first) + LANES * SLOT_SIZE].reshape(LANES, SLOT_SIZE)
    pairs[:] = np.ascontiguousarray(own[:, :SLOT_HEIGHTS]).view(np.int32).T
    header = np.ascontiguousarray(own[:, SLOT_HEIGHTS:]).view(np.uint64)[:, 0].astype(object)
    counts[:] = [h & COUNTS for h in header]
    light[:] = [h >> LIGHT_SHIFT & LIGHTS for h in header]
    marks[:] = [h >> MARK_SHIFT for h in header]


def _put_apart_by_numpy(pairs, heights):
    heights[:SLOT_HEIGHTS] = heights_of(pairs)


def _chained_by_numpy(chain, first):
    return np.uint64(sum(1 << k for k in range(LANES) if chain[int(first) + k] >= 0))


open_group: Kernel = _opened_by_numpy if numba.config.DISABLE_JIT else _opened
"""open_group(slots, first, pairs, counts, light, marks): slots of a group, see ``height_slots``.

slots : (m,) int16; first : uint64, where the group begins; pairs : (SLOT_HEIGHTS / 2, LANES) int32, out, two heights
each, relative to the bases, see ``slot_statistics``; counts, light, marks : (LANES,) int32, out: heights, sum of
intensities and passes of each slot."""

put_apart: Kernel = _put_apart_by_numpy if numba.config.DISABLE_JIT else _put_apart
"""put_apart(pairs, heights): each height of the pairs of `open_group` as a number.

heights : (≥ SLOT_HEIGHTS, LANES) int32, out."""

chained_cells: Kernel = _chained_by_numpy if numba.config.DISABLE_JIT else _chained
"""chained_cells(chain, first): a bit for each of sixteen cells that has more than one slot; first : uint64."""
