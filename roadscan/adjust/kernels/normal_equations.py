"""Normal equations of sparse observations, and entries of the inverse of their matrix, both in a known pattern.

A symmetric matrix is given by its upper triangle in compressed columns: `starts` (u + 1,) and `rows`, ascending within
a column, the diagonal last. Observations are compressed rows: `first` (n + 1,), `unknown` ascending within a row, and
`derivative`.

Entries of the inverse of a sparse symmetric matrix in the pattern of its factor.

With A = P L D Lᵀ Pᵀ, L unit lower triangular, the inverse Z of L D Lᵀ follows from the last column to the first
(Takahashi, Fagan & Chen 1973; Erisman & Tinney 1975):

    Z_ij = − Σ_k Z_ik L_kj   for i > j in the pattern of L,      Z_jj = 1 / D_j − Σ_k L_kj Z_kj,

k over the entries of column j. All Z_ik that occur lie in the pattern of L themselves.
"""

from __future__ import annotations

import numpy as np

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


@kernel
def selected_inverse(starts, rows, lower, pivots, diagonal, below):
    """Fill the entries of the inverse in the pattern of L.

    All Z_ik of a column lie in a small full matrix, the last rows of L first. The next column to the left often has
    the same pattern and one row more (Liu, Ng & Peyton 1993: a supernode): then the matrix only grows by that row.

    Parameters
    ----------
    starts, rows, lower : strictly lower triangle of L in compressed columns, rows ascending.
    pivots : (u,) D.
    diagonal : (u,) out.
    below : (nnz,) out, at the places of `lower`.
    """
    size = pivots.size
    place = np.full(size, -1, np.int64)
    widest = 0
    for j in range(size):
        widest = max(widest, starts[j + 1] - starts[j])
    full, sums = np.zeros((widest, widest)), np.zeros(widest)
    for j in range(size - 1, -1, -1):
        begin, end = starts[j], starts[j + 1]
        m = end - begin
        if m > 0 and rows[begin] == j + 1 and starts[j + 2] - starts[j + 1] == m - 1:
            for i in range(m - 1):
                full[m - 1, i] = full[i, m - 1] = below[starts[j + 2] - 1 - i]
            full[m - 1, m - 1] = diagonal[j + 1]
        else:
            for p in range(begin, end):
                place[rows[p]] = end - 1 - p
            for p in range(begin, end):
                k = rows[p]
                own = place[k]
                full[own, own] = diagonal[k]
                # Column k contains Z_ik of all i > k, and by symmetry Z_ki.
                for q in range(starts[k], starts[k + 1]):
                    other = place[rows[q]]
                    if other >= 0:
                        full[own, other] = full[other, own] = below[q]
            for p in range(begin, end):
                place[rows[p]] = -1
        for i in range(m):
            sums[i] = 0.0
        for k in range(m):
            factor = lower[end - 1 - k]
            for i in range(m):
                sums[i] += full[k, i] * factor
        total = 1.0 / pivots[j]
        for p in range(begin, end):
            below[p] = -sums[end - 1 - p]
            total -= lower[p] * below[p]
        diagonal[j] = total


@kernel
def entries(first, second, starts, rows, diagonal, below, found):
    """Look up entries of the inverse at pairs (n,) of permuted places; NaN where the pattern of L lacks the pair."""
    for n in range(first.size):
        i, j = max(first[n], second[n]), min(first[n], second[n])
        if i == j:
            found[n] = diagonal[i]
        else:
            place = place_of(rows, starts[j], starts[j + 1], i)
            found[n] = below[place] if place >= 0 else np.nan


@kernel
def variances(first, unknown, derivative, starts, rows, diagonal, below, found):
    """Compute the variance derivative · Z · derivativeᵀ of each observation's prediction (n,).

    Parameters
    ----------
    first, unknown, derivative : observations in compressed rows; `unknown` are permuted places, ascending in a row.
    """
    for n in range(first.size - 1):
        total = 0.0
        for b in range(first[n], first[n + 1]):
            column = unknown[b]
            low, end = starts[column], starts[column + 1]
            inner = 0.0
            for a in range(b + 1, first[n + 1]):
                # Places that follow one another stand beside one another: the next one is tried first.
                place = low
                if low >= end or rows[low] != unknown[a]:
                    place = place_of(rows, low, end, unknown[a])
                if place < 0:
                    inner = np.nan
                    break
                inner += derivative[a] * below[place]
                low = place + 1
            total += derivative[b] * (derivative[b] * diagonal[column] + 2.0 * inner)
        found[n] = total


@kernel
def path_lengths(starts, rows, places, lengths):
    """Count the columns of L that each unit vector reaches when L y = e is solved: its path in the elimination tree.

    Parameters
    ----------
    starts, rows : strictly lower triangle of L in compressed columns, rows ascending.
    places : (m,) where the 1 of each unit vector stands.
    lengths : (m,) out.
    """
    for number in range(places.size):
        j, length = places[number], 1
        while starts[j + 1] > starts[j]:
            j = rows[starts[j]]
            length += 1
        lengths[number] = length


@kernel
def solved_units(starts, rows, lower, places, first, at, values):
    """Fill the solutions of L y = e for unit vectors, along their paths in the elimination tree.

    Parameters
    ----------
    starts, rows, lower, places : as above.
    first : (m + 1,) where the solution of each begins.
    at, values : (sum of the lengths,) out, places and values.
    """
    work = np.zeros(starts.size - 1)
    for number in range(places.size):
        j, out = places[number], first[number]
        work[j] = 1.0
        while True:
            value = work[j]
            work[j] = 0.0
            at[out], values[out] = j, value
            out += 1
            if starts[j + 1] == starts[j]:
                break
            for p in range(starts[j], starts[j + 1]):
                work[rows[p]] -= lower[p] * value
            j = rows[starts[j]]
