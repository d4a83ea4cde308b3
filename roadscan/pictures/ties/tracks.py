"""Tracks: all pictures' measurements of one place, from matches of pairs; and the place that their rays meet in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64

_CELLS: Final = (10, 6)
"""Columns and rows of a picture's cells over which tie points are spread."""
_ROUNDS: Final = 6  # Rounds of re-weighting of rays by their distance.


def tracks_of(first: Int64, second: Int64, picture: Int64) -> tuple[Int64, Int64]:
    """Returns features (m,) in tracks, and the track (m,) of each, numbered by their first feature.

    A track that holds two features of one picture is ambiguous, and left out as a whole.

    Parameters
    ----------
    first, second : (k,) features that show one place.
    picture : (f,) of each feature.
    """
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    size = picture.size
    edges = scipy.sparse.coo_array((np.ones(first.size, bool), (first, second)), shape=(size, size))
    _, track = connected_components(edges, directed=False)
    count = np.bincount(track)
    pair = np.stack([track.astype(np.int64), picture], axis=-1)[count[track] > 1]
    _, start, times = np.unique(pair, axis=0, return_index=True, return_counts=True)
    ambiguous = np.zeros(count.size, bool)
    ambiguous[pair[start[times > 1], 0]] = True
    features = np.flatnonzero((count[track] > 1) & ~ambiguous[track])
    own = track[features]
    _, begins, number = np.unique(own, return_index=True, return_inverse=True)
    rank = np.empty(begins.size, np.int64)
    rank[np.argsort(begins)] = np.arange(begins.size)
    return features.astype(np.int64), rank[number]


@dataclass(frozen=True)
class Places:
    """Places of t tracks."""

    place_m: Float64
    """(t, 3) where their rays meet best; NaN where they are parallel."""
    precision: Float64
    """(t, 3, 3) inverse covariance of the places, where the weight of a ray is that of its angle (1 / rad²)."""
    residual_rad: Float64
    """(m,) angle of each ray to the place."""
    distance_m: Float64
    """(m,) from each eye to the place; negative behind it."""


def places_of(track: Int64, eye_m: Float64, ray: Float64, weight: Float64 | None = None) -> Places:
    """Returns the places that rays of tracks meet in: least squares of the angles, by re-weighting with the distance.

    Parameters
    ----------
    track : (m,) of each ray, 0 to t − 1.
    eye_m, ray : (m, 3) in a common frame; rays of unit length.
    weight : (m,) of each ray; all alike without it.
    """
    count = int(track.max(initial=-1)) + 1
    own = np.ones(track.size) if weight is None else weight
    centre = _summed(track, eye_m, count) / np.maximum(np.bincount(track, minlength=count), 1)[:, None]
    away = eye_m - centre[track]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    distance = np.ones(track.size)
    place, matrix = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for _ in range(_ROUNDS):
        scaled = (own / distance**2)[:, None, None] * across
        matrix = _summed(track, scaled.reshape(-1, 9), count).reshape(-1, 3, 3)
        right = _summed(track, np.einsum("nij,nj->ni", scaled, away), count)
        place = _solved(matrix, right)
        distance = np.maximum(np.linalg.norm(place[track] - away, axis=1), 0.1)
        distance = np.where(np.isfinite(distance), distance, 1.0)
    seen = place[track] - away
    along = np.einsum("ni,ni->n", seen, ray)
    length = np.linalg.norm(seen, axis=1)
    residual = np.arctan2(np.linalg.norm(np.cross(seen, ray), axis=1), along)
    return Places(place + centre, matrix, residual, np.where(along > 0.0, length, -length))


def widest_parallax_rad(track: Int64, eye_m: Float64, place_m: Float64) -> Float64:
    """Returns the largest angle (t,) at each track's place between the first of its rays and the others."""
    count = len(place_m)
    to_eye = eye_m - place_m[track]
    to_eye = to_eye / np.maximum(np.linalg.norm(to_eye, axis=1, keepdims=True), 1e-9)
    first = np.full(count, track.size, np.int64)
    np.minimum.at(first, track, np.arange(track.size))
    cosine = np.clip(np.einsum("ni,ni->n", to_eye, to_eye[first[track]]), -1.0, 1.0)
    widest = np.zeros(count)
    np.maximum.at(widest, track, np.arccos(cosine))
    return widest


def spread(track: Int64, picture: Int64, pixel: Float64, size_px: Float64, most: int) -> Bool:
    """Returns a mask (t,) of the tracks that are kept: long ones first, until the cells of their pictures are full.

    Parameters
    ----------
    track, picture : (m,) of each measurement.
    pixel : (m, 2)
    size_px : (m, 2) width and height of its picture.
    most : measurements of a picture, about.
    """
    count = int(track.max(initial=-1)) + 1
    columns, rows = _CELLS
    share = max(1, round(most / (columns * rows)))
    column = np.clip(pixel[:, 0] * columns / size_px[:, 0], 0, columns - 1).astype(np.int64)
    row = np.clip(pixel[:, 1] * rows / size_px[:, 1], 0, rows - 1).astype(np.int64)
    cell = (picture * rows + row) * columns + column
    length = np.bincount(track, minlength=count)
    order = np.argsort(track, kind="stable")
    starts = np.searchsorted(track[order], np.arange(count + 1))
    taken = np.zeros(int(cell.max(initial=-1)) + 1, np.int64)
    kept = np.zeros(count, bool)
    for number in np.lexsort((np.arange(count), -length)).tolist():
        own = cell[order[starts[number] : starts[number + 1]]]
        # Half of its pictures still want it.
        if 2 * int((taken[own] < share).sum()) > own.size:
            kept[number] = True
            taken[own] += 1
    return kept


def _summed(group: Int64, values: Float64, count: int) -> Float64:
    """Returns sums (count, k) of rows (m, k) by group."""
    return np.stack([np.bincount(group, column, minlength=count) for column in values.T], axis=-1)


def _solved(matrix: Float64, right: Float64) -> Float64:
    """Returns solutions (t, 3); NaN where the matrix (3, 3) has no inverse."""
    determinant = np.linalg.det(matrix)
    scale = np.einsum("nii->n", matrix) ** 3
    bad = ~(np.abs(determinant) > 1e-12 * np.maximum(scale, 1e-30))
    safe = np.where(bad[:, None, None], np.eye(3), matrix)
    found = np.linalg.solve(safe, right[:, :, None])[:, :, 0]
    found[bad] = np.nan
    return np.asarray(found)
