"""Places of tie points to a tenth of a pixel: each is matched from one of its pictures to all others.

A feature lies where its own picture is most contrasted. The nearer the camera, the farther that moves on the thing that
it shows, a hundredth of a pixel a picture and always the same way, so that long drives bend. The grey values of a
patch, matched with its affine form, show the same point of the thing in all pictures.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.pictures.exposures import read_picture
from roadscan.pictures.kernels.patch_matching import match_patches
from roadscan.pictures.lens import derivatives, rays_of
from roadscan.pictures.ties.tracks import ALL, CHAINS, TRACKS, Chains, chains_of, places_of, rows_of
from roadscan.pictures.ties.work import FEATURES, TieWork, written
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

REFINED: Final = "picture_refined"
_BLUR_PX: Final = 0.8  # Smoothing of the pictures (1 σ, px): interpolation between sharp pixels draws places to them.
_MEET_RAD: Final = 0.02
"""Rays that pass their point by more (rad) are of poses that do not tell how patches are turned: features stay."""
_FIXED: Final = 128.0
"""Steps of a grey value: smoothing in whole numbers gives the same on all processors."""


@dataclass(frozen=True)
class RefineTask:
    """The tie points of one picture, and where others show them."""

    store: Store
    path: Path
    size_px: tuple[int, int]
    others: tuple[tuple[Path, tuple[int, int]], ...]
    """File and size of the other pictures."""
    row: Int64
    """(n,) of each measurement in another picture among all chains."""
    other: Int64
    """(n,) its picture, of `others`, ascending."""
    place: Float64
    """(n, 2) the feature in this picture …"""
    guess: Float64
    """(n, 2) … and in the other one."""
    form: Float64
    """(n, 2, 2) by how much column and row move there as they move in this picture, of a thing that faces it."""
    unit: str
    key: str


def refine_tasks(work: TieWork, manifest: Manifest, store: Store) -> list[RefineTask]:
    """Returns a task for each picture from which chains are matched: of each, that of the middle distance."""
    chains = chains_of(work, manifest, store)
    if not chains.track.size:
        return []
    seen, off_rad = _seen_from(work, chains)
    depth = np.linalg.norm(seen, axis=1)
    order = np.lexsort((depth, chains.track))
    starts = np.searchsorted(chains.track[order], np.arange(int(chains.track.max()) + 2))
    middle = order[(starts[:-1] + starts[1:]) // 2]
    base = middle[chains.track]
    near = off_rad < _MEET_RAD
    own = np.flatnonzero((base != np.arange(base.size)) & near & near[base])
    own = own[np.lexsort((own, chains.picture[own], chains.picture[base[own]]))]
    code = code_digest(f"{__name__}:refine_picture")
    cuts = np.flatnonzero(np.diff(chains.picture[base[own]])) + 1
    tasks = []
    for rows in np.split(own, cuts) if own.size else []:
        number = int(chains.picture[base[rows[0]]])
        others, other = np.unique(chains.picture[rows], return_inverse=True)
        place, guess, form = chains.pixel[base[rows]], chains.pixel[rows], _forms(work, chains, seen, base[rows], rows)
        contents = [manifest.get(FEATURES, work.units[k]) for k in (number, *others.tolist())]
        digests = ["" if one is None else one.digest for one in contents]
        key = key_of(code, digests, [v.round(4).tobytes().hex() for v in (place, guess, form)], other.tolist())
        files = tuple((work.exposures.path(k), work.camera(k).lens.size_px) for k in others.tolist())
        tasks.append(
            RefineTask(
                store, work.exposures.path(number), work.camera(number).lens.size_px, files, rows,
                other.astype(np.int64), place, guess, form, work.units[number], key,
            )
        )  # fmt: skip
    return tasks


def _seen_from(work: TieWork, chains: Chains) -> tuple[Float64, Float64]:
    """Returns where each measurement's point lies (m, 3) in the axes of its camera, by the recorded poses, and by how
    much its ray passes that (m,; rad).
    """
    sight, own = np.empty((chains.track.size, 3)), work.exposures.at(chains.picture)
    for k, camera in enumerate(work.exposures.cameras):
        sight[own.camera == k] = rays_of(camera.lens, chains.pixel[own.camera == k])
    ray = np.einsum("nij,nj->ni", own.world_from_opencv, sight)
    met = places_of(chains.track, own.eye_world_m, ray)
    away = met.place_m[chains.track] - own.eye_world_m
    return np.asarray(np.einsum("nji,nj->ni", own.world_from_opencv, away)), met.residual_rad


def _forms(work: TieWork, chains: Chains, seen_m: Float64, first: Int64, second: Int64) -> Float64:
    """Returns by how much pixels (n, 2, 2) move in a second picture as they move in the first, of things that face it.

    first, second : (n,) measurements of the same points, of which `seen_m` (m, 3) says where cameras see them.
    """
    ways = [work.exposures.at(chains.picture[rows]).world_from_opencv for rows in (first, second)]
    turned = np.einsum("nji,njk->nik", ways[1], ways[0])
    # Two vectors across the ray: columns of the reflection that takes the optical axis to it (Householder).
    ray = seen_m[first] / np.linalg.norm(seen_m[first], axis=1)[:, None]
    mirror = ray + np.where(ray[:, 2:] < 0.0, -1.0, 1.0) * np.array([0.0, 0.0, 1.0])
    shrunk = 2.0 / np.einsum("ni,ni->n", mirror, mirror)
    across = (np.eye(3) - shrunk[:, None, None] * mirror[:, :, None] * mirror[:, None, :])[:, :, :2]
    moved = [np.empty((first.size, 2, 2)), np.empty((first.size, 2, 2))]
    for rows, vectors, out in zip((first, second), (across, turned @ across), moved, strict=True):
        number = work.exposures.camera[chains.picture[rows]]
        for k, camera in enumerate(work.exposures.cameras):
            here = number == k
            out[here] = derivatives(camera.lens, seen_m[rows[here]])[1] @ vectors[here]
    size = np.linalg.det(moved[0])
    known = np.flatnonzero(np.isfinite(moved[1]).all(axis=(1, 2)) & np.isfinite(size) & (size != 0.0))
    form = np.tile(np.eye(2), (first.size, 1, 1))
    form[known] = moved[1][known] @ np.linalg.inv(moved[0][known])
    return form


def refine_picture(task: RefineTask) -> OutputRecord:
    """Match the tie points of a picture in all others, and write where they lie there (runs on a worker)."""
    first, found = _smoothed(task.path, task.size_px), np.full((task.row.size, 2), np.nan)
    starts = np.searchsorted(task.other, np.arange(len(task.others) + 1))
    for (path, size_px), begin, end in zip(task.others, starts[:-1], starts[1:], strict=True):
        own = slice(int(begin), int(end))
        second = _smoothed(path, size_px)
        match_patches(first, second, task.place[own], task.guess[own], task.form[own], found[own])
    rows = pa.Table.from_arrays([pa.array(v, pa.float32()) for v in found.T], schema=table_schema(REFINED).arrow())
    known = int(np.isfinite(found[:, 0]).sum())
    return written(task.store, REFINED, task.unit, task.key, rows, json.dumps({"matched": known, "of": len(found)}))


def _smoothed(path: Path, size_px: tuple[int, int]) -> Float32:
    """Returns grey values (height, width) of a picture, smoothed."""
    whole = read_picture(path, size_px, grey=True).astype(np.uint16) * np.uint16(_FIXED)
    return np.asarray(cv2.GaussianBlur(whole, (0, 0), _BLUR_PX), np.float32) / np.float32(_FIXED)


def tracks_key(tasks: Sequence[RefineTask], manifest: Manifest) -> str:
    """Returns the key of the tracks."""
    chains = manifest.get(CHAINS, ALL)
    made = [(record.digest if (record := manifest.get(REFINED, task.unit)) is not None else "") for task in tasks]
    return key_of(code_digest(f"{__name__}:write_tracks"), "" if chains is None else chains.digest, made)


def write_tracks(work: TieWork, tasks: Sequence[RefineTask], manifest: Manifest, store: Store) -> OutputRecord:
    """Write the tie points as they were refined, without the pictures that do not show the patch of their first one; a
    point that no other picture confirms stays as its features lie.
    """
    chains = chains_of(work, manifest, store)
    pixel = chains.pixel.copy()
    others = np.zeros(chains.track.size, bool)
    for task in tasks:
        record = manifest.get(REFINED, task.unit)
        others[task.row], pixel[task.row] = True, np.nan
        if record is not None and record.path:
            rows = recorded_table(store, record)
            pixel[task.row] = np.column_stack([rows.column(name).to_numpy() for name in ("u_px", "v_px")])
    found, count = np.isfinite(pixel[:, 0]), int(chains.track.max(initial=-1)) + 1
    alone = (np.bincount(chains.track[found], minlength=count) < 2)[chains.track]
    pixel[alone], kept = chains.pixel[alone], found | alone
    rows = rows_of(work, chains.track[kept], chains.picture[kept], (pixel[kept], chains.size_px[kept]))
    known = manifest.get(CHAINS, ALL)
    detail = {} if known is None else json.loads(known.detail)
    detail |= {"compared": int(others.sum()), "matched": int((others & found).sum())}
    return written(store, TRACKS, ALL, tracks_key(tasks, manifest), rows, json.dumps(detail))
