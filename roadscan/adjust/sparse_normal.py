"""Sparse normal equations: their factor, their solution, and the needed part of their inverse.

The factor L D Lᵀ with an approximate minimum degree ordering is QDLDL's (Stellato et al. 2020; Davis 2005); the
selected inverse is in `adjust/kernels/normal_equations.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from roadscan.adjust.kernels.normal_equations import (
    add_observations,
    entries,
    path_lengths,
    selected_inverse,
    solved_units,
    variances,
)
from roadscan.compute.array_types import Float64, Int64


@dataclass(frozen=True)
class Rows:
    """n observations of u unknowns in compressed rows."""

    first: Int64
    """(n + 1,) where each row begins."""
    unknown: Int64
    """(nnz,) ascending within a row."""
    derivative: Float64
    """(nnz,)"""

    @classmethod
    def of(cls, unknown: Int64, derivative: Float64) -> Rows:
        """Rows from tables (n, w); entries of unknown −1 or of derivative 0 are left out, double ones are added up."""
        size, width = unknown.shape
        here = (unknown >= 0) & (derivative != 0.0)
        row = np.repeat(np.arange(size), width)[here.ravel()]
        column, value = unknown[here], derivative[here]
        order = np.lexsort((column, row))
        row, column, value = row[order], column[order], value[order]
        new = np.ones(row.size, bool)
        new[1:] = (np.diff(row) != 0) | (np.diff(column) != 0)
        value = np.add.reduceat(value, np.flatnonzero(new)) if row.size else value
        first = np.concatenate([[0], np.cumsum(np.bincount(row[new], minlength=size))])
        return cls(first.astype(np.int64), column[new].astype(np.int64), np.asarray(value, np.float64))

    def times(self, x: Float64) -> Float64:
        """Returns the product (n,) with a vector of unknowns; each row is summed separately."""
        products = np.concatenate([self.derivative * x[self.unknown], [0.0]])
        sums = np.add.reduceat(products, self.first[:-1]) if self.first.size > 1 else np.zeros(0)
        return np.where(np.diff(self.first) > 0, sums, 0.0)

    def transposed_times(self, y: Float64, unknowns: int) -> Float64:
        """Returns the sum (u,) over the rows, in their order, of derivative · y."""
        row = np.repeat(np.arange(self.first.size - 1), np.diff(self.first))
        return np.bincount(self.unknown, self.derivative * y[row], minlength=unknowns).astype(np.float64)

    def pairs(self, unknowns: int) -> Any:
        """Returns the Boolean pattern (u, u) of unknowns that share a row."""
        ones = np.ones(self.unknown.size, np.int8)
        rows = scipy.sparse.csr_array((ones, self.unknown, self.first), shape=(self.first.size - 1, unknowns))
        return (rows.T.astype(bool) @ rows.astype(bool)).tocsc()


class NormalEquations:
    """Σ weight · rowᵀ row + prior; its pattern is fixed, its weights change from round to round."""

    def __init__(self, rows: Rows, prior: tuple[Int64, Int64, Float64], wanted: tuple[Int64, Int64], size: int) -> None:
        """Lay out the pattern.

        Parameters
        ----------
        rows : observations, whitened.
        prior : upper entries of the prior's inverse covariance: row, column, value.
        wanted : pairs of unknowns, row ≤ column, whose covariance is asked for beside those of the rows.
        size : number of unknowns.
        """
        self.rows, self.size = rows, size
        i, j = (np.concatenate([a, b, np.arange(size)]) for a, b in zip(prior[:2], wanted, strict=True))
        more = scipy.sparse.coo_array((np.ones(i.size, bool), (i, j)), shape=(size, size)).tocsc()
        pattern = scipy.sparse.triu(rows.pairs(size) + more, format="csc")
        pattern.sort_indices()
        self._starts, self._rows = pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64)
        column = np.repeat(np.arange(size), np.diff(self._starts))
        self._of_prior = np.searchsorted(column * size + self._rows, prior[1] * size + prior[0])
        self._solver: Any = None
        self._permuted: Rows | None = None

    def factor(self, weight: Float64, prior: Float64) -> None:
        """Sum and factor the equations.

        Parameters
        ----------
        weight : (n,) of each observation.
        prior : values of the prior's entries.
        """
        import qdldl

        values = np.zeros(self._rows.size)
        np.add.at(values, self._of_prior, prior)
        rows = self.rows
        add_observations(rows.first, rows.unknown, rows.derivative, weight, self._starts, self._rows, values)
        upper = scipy.sparse.csc_matrix((values, self._rows, self._starts), shape=(self.size, self.size))
        if self._solver is None:
            self._solver = qdldl.Solver(upper, upper=True)
        else:
            self._solver.update(upper, upper=True)

    def solve(self, right: Float64) -> Float64:
        """Returns the solution (u,) of the factored equations."""
        return np.asarray(self._solver.solve(right))

    def inverse(self) -> SelectedInverse:
        """Returns the covariance in the pattern of the factor."""
        lower, pivots, order = self._solver.factors()
        place = np.empty(self.size, np.int64)
        place[np.asarray(order)] = np.arange(self.size)
        starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int32)
        diagonal, below = np.zeros(self.size), np.zeros(rows.size)
        selected_inverse(starts, rows, lower.data, np.asarray(pivots, np.float64), diagonal, below)
        if self._permuted is None:  # the order of the factor is that of the pattern, which stays
            self._permuted = _permuted(self.rows, place)
        return SelectedInverse(place, starts, rows, diagonal, below, self._permuted)

    def covariances(self, groups: Sequence[Int64]) -> list[Float64]:
        """Returns covariances (m, m) of the unknowns of each group: (L⁻¹ E)ᵀ D⁻¹ (L⁻¹ E), E their unit vectors."""
        lower, pivots, order = self._solver.factors()
        place = np.empty(self.size, np.int64)
        place[np.asarray(order)] = np.arange(self.size)
        starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int32)
        roots, found = 1.0 / np.sqrt(np.asarray(pivots, np.float64)), []
        for group in groups:
            lengths = np.zeros(group.size, np.int64)
            path_lengths(starts, rows, place[group], lengths)
            first = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
            at, values = np.zeros(first[-1], np.int64), np.zeros(first[-1])
            solved_units(starts, rows, lower.data, place[group], first, at, values)
            reached = np.zeros(self.size, bool)
            reached[at] = True
            halves = np.zeros((int(reached.sum()), group.size))
            halves[(np.cumsum(reached) - 1)[at], np.repeat(np.arange(group.size), lengths)] = values * roots[at]
            found.append(np.asarray(halves.T @ halves))
        return found


@dataclass(frozen=True)
class SelectedInverse:
    """Inverse of normal equations in the pattern of their factor."""

    place: Int64
    """(u,) of each unknown in the order of the factor."""
    starts: Int64
    rows: npt.NDArray[np.int32]
    diagonal: Float64
    below: Float64
    observed: Rows
    """The observations, their unknowns replaced by places, ascending within a row."""

    def at(self, first: Int64, second: Int64) -> Float64:
        """Returns covariances of pairs of unknowns, of any shape; NaN where the factor lacks the pair."""
        found = np.empty(first.size)
        places = self.place[first.ravel()], self.place[second.ravel()]
        entries(*places, self.starts, self.rows, self.diagonal, self.below, found)
        return found.reshape(first.shape)

    def variances(self) -> Float64:
        """Returns variances (n,) of the observations' predictions."""
        own, found = self.observed, np.empty(self.observed.first.size - 1)
        variances(own.first, own.unknown, own.derivative, self.starts, self.rows, self.diagonal, self.below, found)
        return found


def _permuted(rows: Rows, place: Int64) -> Rows:
    """Returns rows with the place of each unknown in its stead, ascending within a row."""
    row = np.repeat(np.arange(rows.first.size - 1), np.diff(rows.first))
    order = np.lexsort((place[rows.unknown], row))
    return Rows(rows.first, place[rows.unknown][order], rows.derivative[order])
