"""Tie points that the adjustment kept, for exports: their places by adjusted poses, and where pictures show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.export.pictures.chosen import LocalFrame
from roadscan.measuring.measure import posed_pictures
from roadscan.measuring.poses import PicturePoses
from roadscan.pictures.lens import rays_of
from roadscan.pictures.ties.chains import TRACKS
from roadscan.pictures.ties.tracks import places_of
from roadscan.pictures.ties.work import ALL
from roadscan.pictures.views import Views
from roadscan.run.session import Session
from roadscan.store.manifest import recorded_table

_RESIDUALS: Final = "picture_residuals"  # Name of the table of judged measurements, and its manifest's.


@dataclass(frozen=True, eq=False)
class TiePoints:
    """t tie points and their m measurements in the chosen pictures, two of each point or more."""

    place_m: Float64
    """(t, 3) local frame."""
    error_px: Float64
    """(t,) mean distance of the measurements from where the point is projected."""
    point: Int64
    """(m,) number of the point, 0 to t − 1, ascending."""
    picture: Int64
    """(m,) number of the chosen picture."""
    pixel: Float64
    """(m, 2) u, v from the centre of the upper left pixel."""


def tie_points(
    session: Session, poses: PicturePoses, frame: LocalFrame, chosen: Sequence[int]
) -> tuple[TiePoints, list[str]]:
    """Return the tie points that pictures show, of which some numbers are chosen, and notes on those left out.

    A point lies where the rays of all measurements that count meet, of pictures that are not chosen as well, each with
    the weight that the adjustment gave it.
    """
    tracks, judged = (_table(session, name, unit) for name, unit in ((TRACKS, ALL), (_RESIDUALS, None)))
    nothing = np.zeros(0, np.int64)
    none = TiePoints(np.zeros((0, 3)), np.zeros(0), nothing, nothing, np.zeros((0, 2)))
    if tracks is None:
        return none, []
    if judged is None:
        return none, ["tie points were not adjusted, so that none of them is told from a false match: none is written"]
    rows = judged.filter(pc.and_(pc.is_valid(judged["track"]), pc.greater(judged["weight"], 0.0)))
    every = posed_pictures(session)
    names, own_names = _names(every), _names(poses)
    picture = _pictures(rows, tracks, names)
    after = np.stack([rows[f"after_{a}_px"].to_numpy() for a in "uv"], axis=-1)
    inside = np.array([every.pictures.worlds[k] == frame.world for k in every.pictures.views.world.tolist()], np.bool_)
    kept = np.flatnonzero((picture >= 0) & np.isfinite(after).all(axis=1) & inside[picture])
    picture, after = picture[kept], after[kept]
    point = np.unique(rows["track"].to_numpy()[kept], return_inverse=True)[1].astype(np.int64)
    pixel = np.stack([rows[f"{a}_px"].to_numpy() for a in "uv"], axis=-1)[kept]
    weight = (rows["weight"].to_numpy() / rows["sigma_px"].to_numpy() ** 2)[kept]
    views = every.pictures.views
    found = places_of(point, views.eye_world_m[picture], _rays(views, picture, pixel), weight)
    own_of = {own_names[k]: k for k in chosen}
    own = np.array([own_of.get(one, -1) for one in names], np.int64)[picture]
    met = np.asarray(np.isfinite(found.place_m).all(axis=1))
    sound = met[point] & (own >= 0)
    sound &= (np.bincount(point[sound], minlength=len(found.place_m)) > 1)[point]
    order = np.flatnonzero(sound)[np.lexsort((own[sound], point[sound]))]
    held, point = np.unique(point[order], return_inverse=True)
    error = np.bincount(point, np.hypot(*after[order].T)) / np.maximum(np.bincount(point), 1)
    left = rows.num_rows - len(order)
    notes = [f"{left:,} measurements of tie points are left out: without a chosen picture, or alone"] if left else []
    return TiePoints(frame.points(found.place_m[held]), error, point, own[order], pixel[order]), notes


def _pictures(rows: pa.Table, tracks: pa.Table, names: Sequence[tuple[object, object]]) -> Int64:
    """Return the number (m,) of the picture of each judged measurement, −1 without one: tracks tell its log."""
    log_of = {one[:-1]: one[-1] for one in _keys(tracks, "log")}
    number_of = {one: k for k, one in enumerate(names)}
    return np.array([number_of.get((log_of.get(one), one[2]), -1) for one in _keys(rows)], np.int64)


def _table(session: Session, name: str, unit: str | None) -> pa.Table | None:
    records = [one for key, one in session.manifest.of(name).items() if one.path and unit in (None, key)]
    return recorded_table(session.store, records[0]) if records else None


def _keys(rows: pa.Table, *more: str) -> list[tuple[object, ...]]:
    """Return run, camera, file and pixel of measurements, which name each of them, and further columns."""
    pixels = (rows[name].cast(pa.float64()) for name in ("u_px", "v_px"))
    columns = [*(rows[n] for n in ("run", "sensor", "file")), *pixels, *(rows[n] for n in more)]
    return list(zip(*(column.to_pylist() for column in columns), strict=True))


def _names(poses: PicturePoses) -> list[tuple[object, object]]:
    """Return log and file of each picture."""
    pictures = poses.pictures
    return [(pictures.logs[k].key, file) for k, file in zip(pictures.log.tolist(), pictures.files, strict=True)]


def _rays(views: Views, picture: Int64, pixel: Float64) -> Float64:
    """Return unit vectors (m, 3), world frame, of pixels (m, 2) of pictures."""
    ray = np.empty((len(pixel), 3))
    for number, lens in enumerate(views.lenses):
        own = views.lens[picture] == number
        ray[own] = rays_of(lens, pixel[own])
    return np.asarray(np.einsum("nji,nj->ni", views.opencv_from_world[picture], ray))
