"""Tracks: all pictures' measurements of one place, from matches of pairs; and the place that their rays meet in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.pictures.lens import rays_of
from roadscan.pictures.ties.work import FEATURES, MATCHES, MatchTask, TieWork, load_features, odd_pictures, written
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

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


CHAINS: Final = "picture_chains"
TRACKS: Final = "picture_tracks"
_ABOVE: Final = float(np.sin(np.radians(1.0)))
"""Sine of the angle above the horizon from which on there may be sky: poses are off by some tenths of a degree."""
_SKY_M: Final = 30.0
"""What looks like the sky is some if it is farther than this from all cameras (m): a smooth wall is nearer."""


def chains_key(work: TieWork, tasks: Sequence[MatchTask], manifest: Manifest) -> str:
    """Returns the key of the chains."""
    made = [(record.digest if (record := manifest.get(MATCHES, task.unit)) is not None else "") for task in tasks]
    settings = work.settings.model_dump(mode="json")
    return key_of(code_digest(f"{__name__}:write_chains"), settings, [task.key for task in tasks], made)


def write_chains(work: TieWork, tasks: Sequence[MatchTask], manifest: Manifest, store: Store) -> OutputRecord:
    """Join all matches to chains, and write those that are kept."""
    number = {unit: k for k, unit in enumerate(work.units)}
    counts = np.zeros(len(work.units), np.int64)
    for k, unit in enumerate(work.units):
        record = manifest.get(FEATURES, unit)
        counts[k] = 0 if record is None or not record.path else json.loads(record.detail)["features"]
    starts = np.concatenate([[0], np.cumsum(counts)])
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for task in tasks:
        record = manifest.get(MATCHES, task.unit)
        if record is None or not record.path:
            continue
        rows = recorded_table(store, record)
        names = rows.column("other").dictionary_encode().combine_chunks()
        others = np.array([number[name] for name in names.dictionary.to_pylist()], np.int64)
        first.append(starts[task.number] + rows.column("first").to_numpy())
        second.append(starts[others[names.indices.to_numpy()]] + rows.column("second").to_numpy())
    picture = np.repeat(np.arange(len(work.units)), counts)
    features, track = tracks_of(np.concatenate(first), np.concatenate(second), picture)
    pixel, size, of_sky = _pixels(work, manifest, store, (features, picture[features], starts))
    kept, figures = _kept(work, track, picture[features], (pixel, of_sky))
    rows = rows_of(work, track[kept], picture[features][kept], (pixel[kept], size[kept]))
    odd = [[work.exposures.name(number), why] for number, why in odd_pictures(work, manifest)]
    detail = json.dumps({**figures, **_masked(work, tasks, manifest), "odd": odd})
    return written(store, CHAINS, ALL, chains_key(work, tasks, manifest), rows, detail)


def _masked(work: TieWork, tasks: Sequence[MatchTask], manifest: Manifest) -> dict[str, int]:
    """Returns how many features and matches were left out for what, before they became tie points."""
    features = [r.figures() for unit in work.units if (r := manifest.get(FEATURES, unit)) is not None]
    compared = [r.figures() for task in tasks if (r := manifest.get(MATCHES, task.unit)) is not None]
    return {
        "hidden": sum(one.get("hidden", 0) for one in features),
        **{word: sum(one.get(word, 0) for one in compared) for word in ("matches", "own_vehicle", "against")},
    }


def _pixels(
    work: TieWork, manifest: Manifest, store: Store, chosen: tuple[Int64, Int64, Int64]
) -> tuple[Float64, Float64, Bool]:
    """Returns places (m, 2) and diameters (m,) of some features, and whether they look like sky (m,); pictures are read
    one by one.

    chosen : number of each feature, in order, its picture, and the first feature of every picture.
    """
    features, picture, starts = chosen
    pixel, size, of_sky = np.empty((features.size, 2)), np.empty(features.size), np.zeros(features.size, bool)
    ends = np.searchsorted(picture, np.arange(len(work.units) + 1))
    for number in np.unique(picture).tolist():
        record = manifest.get(FEATURES, work.units[number])
        if record is None:
            continue
        own = slice(ends[number], ends[number + 1])
        found, rows = load_features(store, record), features[own] - starts[number]
        pixel[own], size[own], of_sky[own] = found.pixel[rows], found.size_px[rows], found.of_sky[rows]
    return pixel, size, of_sky


def _kept(work: TieWork, track: Int64, picture: Int64, shown: tuple[Float64, Bool]) -> tuple[Bool, dict[str, int]]:
    """Returns a mask (m,) of the measurements of tracks that are kept, and how many were left out for what.

    A tie point has to lie before its cameras, within reach, and be seen from directions far enough apart. What does not
    and lies above the horizon is sky, and so is what looks like it there and is far.

    shown : pixels (m, 2), and whether they look like sky (m,).
    """
    pixel, looks_sky = shown
    if not track.size:
        return np.zeros(0, bool), {"tracks": 0, "found": 0, "behind": 0, "sky": 0, "far": 0}
    sight = np.empty((track.size, 3))
    sizes = np.empty((track.size, 2))
    for camera in range(len(work.exposures.cameras)):
        own = work.exposures.camera[picture] == camera
        lens = work.exposures.cameras[camera].lens
        sight[own], sizes[own] = rays_of(lens, pixel[own]), lens.size_px
    eye = work.exposures.eye_world_m[picture]
    ray = np.einsum("nij,nj->ni", work.exposures.world_from_opencv[picture], sight)
    found = places_of(track, eye, ray)
    count = len(found.place_m)
    wide = widest_parallax_rad(track, eye, found.place_m) >= np.radians(work.settings.least_parallax_deg)
    near = np.ones(count, bool)
    near[track[~((found.distance_m > 0.0) & (found.distance_m < work.settings.reach_m))]] = False
    behind = np.zeros(count, bool)
    behind[track[found.distance_m <= 0.0]] = True
    down = (work.exposures.level_from_body[:, 2:] @ work.exposures.body_from_opencv)[picture, 0]
    above = np.ones(count, bool)
    above[track[~(np.einsum("ni,ni->n", sight, down) < -_ABOVE)]] = False
    looks = np.bincount(track, looks_sky, count) > 0.5 * np.bincount(track, minlength=count)
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, track, found.distance_m)
    sky = above & (~(wide & near) | (looks & (nearest > _SKY_M)))
    good = np.flatnonzero(wide & near & ~sky)
    own = np.isin(track, good)
    number = np.searchsorted(good, track[own])
    chosen = spread(number, picture[own], pixel[own], sizes[own], work.settings.measurements)
    kept = np.zeros(track.size, bool)
    kept[np.flatnonzero(own)[chosen[number]]] = True
    figures = {"tracks": chosen, "found": near, "behind": behind, "sky": sky, "far": ~(wide & near) & ~sky}
    return kept, {word: int(which.sum()) for word, which in figures.items()} | {"found": count}


def rows_of(work: TieWork, track: Int64, picture: Int64, of_feature: tuple[Float64, Float64]) -> pa.Table:
    """Returns rows of the tables of chains and tracks, by track and picture; tracks are numbered from 0."""
    order = np.lexsort((picture, track))
    exposures, rows = work.exposures, picture[order]
    cameras = [exposures.cameras[k] for k in exposures.camera[rows].tolist()]
    pixel, size = of_feature
    return pa.Table.from_arrays(
        [
            pa.array(np.unique(track[order], return_inverse=True)[1], pa.int64()),
            pa.array([c.run for c in cameras], pa.string()), pa.array([c.sensor for c in cameras], pa.string()),
            pa.array([c.log for c in cameras], pa.string()),
            pa.array(exposures.file[rows].tolist(), pa.string()), pa.array(pixel[order, 0], pa.float32()),
            pa.array(pixel[order, 1], pa.float32()), pa.array(size[order], pa.float32()),
        ],
        schema=table_schema(TRACKS).arrow(),
    )  # fmt: skip


@dataclass(frozen=True)
class Chains:
    """What several pictures show, m measurements, as the features lie."""

    track: Int64
    """(m,) number of the tie point, ascending from 0."""
    picture: Int64
    """(m,) number of the picture."""
    pixel: Float64
    """(m, 2)"""
    size_px: Float64
    """(m,) diameter of the feature."""


def chains_of(work: TieWork, manifest: Manifest, store: Store) -> Chains:
    """Returns the chains of a survey, as they were written last."""
    record = manifest.get(CHAINS, ALL)
    if record is None or not record.path:
        return Chains(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
    rows = recorded_table(store, record)
    logs = [work.exposures.cameras[k].log for k in work.exposures.camera.tolist()]
    number = {one: k for k, one in enumerate(zip(logs, work.exposures.file.tolist(), strict=True))}
    names = zip(*(rows.column(c).to_pylist() for c in ("log", "file")), strict=True)
    pixel = np.stack([rows.column(name).to_numpy() for name in ("u_px", "v_px")], axis=-1)
    picture = np.array([number[one] for one in names], np.int64)
    return Chains(rows.column("track").to_numpy(), picture, pixel.astype(np.float64), rows.column("size_px").to_numpy())


ALL: Final = "all"
"""Unit of chains and tracks in the manifest."""
