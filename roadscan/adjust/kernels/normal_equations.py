"""Normal equations of sparse observations, summed into a pattern that is known beforehand.

A symmetric matrix is given by its upper triangle in compressed columns: `starts` (u + 1,) and `rows`, ascending within
a column, the diagonal last. Observations are compressed rows: `first` (n + 1,), `unknown` ascending within a row, and
`derivative`.
"""

from __future__ import annotations

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def place_of(rows, low, high, wanted):
    """Returns the index of a row among the ascending ones from `low` to below `high`; −1 where it is absent."""
    end = high
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    if low < end and rows[low] == wanted:
        return low
    return -1


@kernel
def add_observations(first, unknown, derivative, weight, starts, rows, values):
    """Add weight · derivative · derivativeᵀ of each observation to `values`, the upper triangle.

    The order of the sum is that of the observations, so its bits depend on nothing else.

    Parameters
    ----------
    weight : (n,) of each observation.
    values : (nnz,) changed in place; every pair of unknowns of an observation has its place in the pattern.
    """
    for n in range(first.size - 1):
        if weight[n] == 0.0:
            continue
        for b in range(first[n], first[n + 1]):
            scaled = weight[n] * derivative[b]
            low, end = starts[unknown[b]], starts[unknown[b] + 1]
            for a in range(first[n], b + 1):
                # Unknowns ascend, and most follow one another: the next place is tried first.
                place = low
                if rows[low] != unknown[a]:
                    place = place_of(rows, low, end, unknown[a])
                values[place] += scaled * derivative[a]
                low = place + 1
