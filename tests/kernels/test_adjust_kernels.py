"""Kernels of the adjustment against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
import qdldl
import scipy

from roadscan.adjust.kernels.normal_equations import (
    add_observations,
    entries,
    path_lengths,
    selected_inverse,
    solved_units,
    variances,
)

SIZE = 40


@pytest.fixture
def matrix() -> scipy.sparse.csc_array:
    """A grid's neighbours, with some far ones: its factor fills in."""
    rng = np.random.default_rng(3)
    i, j = rng.integers(0, SIZE, (2, 60))
    rough = scipy.sparse.coo_array((rng.standard_normal(60), (i, j)), shape=(SIZE, SIZE))
    return scipy.sparse.csc_array(rough @ rough.T + scipy.sparse.eye_array(SIZE))


def test_observations_are_summed_in_their_places() -> None:
    rng = np.random.default_rng(4)
    dense = np.where(rng.uniform(size=(30, SIZE)) < 0.15, rng.standard_normal((30, SIZE)), 0.0)
    rows, weight = scipy.sparse.csr_array(dense), rng.uniform(size=30)
    weight[:5] = 0.0
    pattern = scipy.sparse.triu(rows.T.astype(bool) @ rows.astype(bool) + scipy.sparse.eye_array(SIZE), format="csc")
    pattern.sort_indices()
    starts, places = pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64)
    values = np.zeros(places.size)
    first, unknown = rows.indptr.astype(np.int64), rows.indices.astype(np.int64)
    add_observations(first, unknown, rows.data, weight, starts, places, values)
    summed = scipy.sparse.csc_array((values, places, starts), shape=(SIZE, SIZE)).toarray()
    np.testing.assert_allclose(summed, np.triu(dense.T @ (weight[:, None] * dense)), atol=1e-12)


def test_selected_entries_are_those_of_the_inverse(matrix: scipy.sparse.csc_array) -> None:
    lower, pivots, order = qdldl.Solver(scipy.sparse.csc_matrix(matrix)).factors()
    inverse = np.linalg.inv(matrix.toarray()[np.ix_(order, order)])
    starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int32)
    diagonal, below = np.zeros(SIZE), np.zeros(rows.size)
    selected_inverse(starts, rows, lower.data, np.asarray(pivots), diagonal, below)
    column = np.repeat(np.arange(SIZE), np.diff(starts))
    assert rows.size < SIZE * (SIZE - 1) / 2
    np.testing.assert_allclose(diagonal, np.diag(inverse), rtol=1e-10)
    np.testing.assert_allclose(below, inverse[rows, column], atol=1e-12)
    found = np.zeros(rows.size)
    entries(column.astype(np.int64), rows.astype(np.int64), starts, rows, diagonal, below, found)
    np.testing.assert_array_equal(found, below)
    there = np.zeros((SIZE, SIZE), bool)
    there[rows, column] = there[column, rows] = True
    i, j = np.argwhere(~there & ~np.eye(SIZE, dtype=bool))[:1].T
    found = np.zeros(1)
    entries(i, j, starts, rows, diagonal, below, found)
    assert np.isnan(found).all()
    # A prediction from places that a column of the factor holds together.
    k = int(np.argmax(np.diff(starts)))
    unknown = np.concatenate([[k], rows[starts[k] : starts[k + 1]]]).astype(np.int64)
    derivative = np.random.default_rng(5).standard_normal(unknown.size)
    first, found = np.array([0, unknown.size], np.int64), np.zeros(1)
    variances(first, unknown, derivative, starts, rows, diagonal, below, found)
    assert found[0] == pytest.approx(derivative @ inverse[np.ix_(unknown, unknown)] @ derivative, rel=1e-10)


def test_solutions_for_unit_vectors_are_columns_of_the_inverse_of_the_factor(matrix: scipy.sparse.csc_array) -> None:
    lower, _, _ = qdldl.Solver(scipy.sparse.csc_matrix(matrix)).factors()
    starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int32)
    places = np.array([0, 3, SIZE - 1], np.int64)
    lengths = np.zeros(places.size, np.int64)
    path_lengths(starts, rows, places, lengths)
    first = np.concatenate([[0], np.cumsum(lengths)])
    at, values = np.zeros(first[-1], np.int64), np.zeros(first[-1])
    solved_units(starts, rows, lower.data, places, first, at, values)
    inverse = np.linalg.inv(lower.toarray() + np.eye(SIZE))
    for number, place in enumerate(places.tolist()):
        column = np.zeros(SIZE)
        own = slice(first[number], first[number + 1])
        column[at[own]] = values[own]
        np.testing.assert_allclose(column, inverse[:, place], atol=1e-12)
