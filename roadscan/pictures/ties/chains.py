"""Chains: features of several pictures that show one place, of which those become tie points that the poses explain."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.pictures.lens import rays_of
from roadscan.pictures.ties.tracks import places_of, spread, tracks_of, widest_parallax_rad
from roadscan.pictures.ties.work import (
    ALL,
    FEATURES,
    MATCHES,
    MatchTask,
    TieWork,
    load_features,
    odd_pictures,
    written,
)
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

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
