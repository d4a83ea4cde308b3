"""Text files of COLMAP and OpenSfM (OpenDroneMap): cameras, poses of pictures and points, in a local frame.

Formats: COLMAP's documentation, *Output format*, text (colmap.github.io/format.html); OpenSfM's documentation,
*Dataset structure* and *Geometric models* (opensfm.readthedocs.io). COLMAP's pixels count from the corner of the upper
left one, OpenSfM's from the picture's middle in units of its longer side.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.frames import ENU_FROM_NED, quaternion_from_rotation
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.export.export import Exported, published
from roadscan.export.pictures.copies import (
    Choice,
    LocalFrame,
    chosen_pictures,
    exported_names,
    local_frame,
)
from roadscan.georeference.picture_axes import map_from_ned
from roadscan.measuring.measure import posed_pictures
from roadscan.measuring.poses import PicturePoses
from roadscan.pictures.lens import Lens, rays_of
from roadscan.pictures.ties.tracks import ALL, TRACKS, places_of
from roadscan.pictures.views import Views
from roadscan.run.session import Session
from roadscan.store.manifest import recorded_table

OFFSET_FILE: Final = "offset.json"
"""Where the local frame lies."""
_GREY: Final = 128  # Colour of points that have none.
_TRACKS_HEADER: Final = "OPENSFM_TRACKS_VERSION_v2"  # First line of OpenSfM's file of tracks.
_NO_CODE: Final = -1  # OpenSfM's segment and instance of a feature of which none is known.


def export_colmap(session: Session, out: Path, choice: Choice, points: Path | None = None) -> Exported:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt`` of COLMAP, and where their frame lies.

    Parameters
    ----------
    points : CSV with columns easting_m, northing_m, height_m (metres of the survey's map). They have no tracks; they
        come before the tie points that the adjustment kept.

    Raises
    ------
    ConfigError
        where `out` holds something, no picture is chosen, or all are pictures of 360°, which COLMAP does not know.
    """
    poses = chosen_pictures(session, choice)
    flat = [k for k in range(len(poses)) if not poses.pictures.views.lens_of(k).is_around]
    if not flat:
        raise ConfigError("all pictures are of 360°, for which COLMAP has no camera", expected="perspective pictures")
    frame, lenses, names = local_frame(poses), _lenses(poses, flat), exported_names(poses)
    ties, notes = tie_points(session, poses, frame, flat)
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", f"# Number of cameras: {len(lenses)}"]
    cameras += [_colmap_camera(number, lens) for number, (lens, _) in lenses.items()]
    places = _points(poses, frame, points)
    seen, tracks = _colmap_tracks(ties, flat, len(places) + 1)
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)",
              f"# Number of images: {len(flat)}"]  # fmt: skip
    for number, k in enumerate(flat, start=1):
        turn, shift = _camera_from_local(poses, frame, k)
        values = " ".join(repr(float(v)) for v in (*quaternion_from_rotation(turn), *shift))
        images += [f"{number} {values} {int(poses.pictures.views.lens[k]) + 1} {names[k]}", " ".join(seen[k])]
    whole = np.concatenate([places, ties.place_m])
    errors = np.concatenate([np.zeros(len(places)), ties.error_px])
    listed = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
              f"# Number of points: {len(whole)}"]  # fmt: skip
    listed += [
        " ".join([f"{n} {' '.join(repr(v) for v in place)} {_GREY} {_GREY} {_GREY} {error:g}", *tracks.get(n, ())])
        for n, (place, error) in enumerate(zip(whole.tolist(), errors.tolist(), strict=True), start=1)
    ]
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": listed}
    written = {name: "\n".join(lines) + "\n" for name, lines in texts.items()}
    written[OFFSET_FILE] = _json(_offset(poses, frame))
    if len(flat) < len(poses):
        notes.append(f"{len(poses) - len(flat):,} pictures of 360° are left out")
    return _written(out, written, [*notes, *_where_pictures_are(poses)])


def export_opensfm(session: Session, out: Path, choice: Choice, points: Path | None = None) -> Exported:
    """Write ``reconstruction.json``, ``camera_models.json`` and ``reference_lla.json`` of OpenSfM.

    Where the survey has tie points, ``tracks.csv`` as well.

    Parameters
    ----------
    points : as in :func:`export_colmap`.

    Raises
    ------
    ConfigError
        where `out` holds something, no picture is chosen, or the survey's map is a local frame.
    """
    poses = chosen_pictures(session, choice)
    frame = local_frame(poses)
    origin = frame.lon_lat_height
    if origin is None:
        raise ConfigError("the survey's poses are in a local frame", expected="poses with a place on the Earth",
                          change="use `roadscan export colmap`, which needs none")  # fmt: skip
    lenses, names = _lenses(poses, range(len(poses))), exported_names(poses)
    cameras = {f"roadscan {title}": _opensfm_camera(lens) for lens, title in lenses.values()}
    reference = {"longitude": float(origin[0]), "latitude": float(origin[1]), "altitude": float(origin[2])}
    shots = {}
    for k in range(len(poses)):
        turn, shift = _camera_from_local(poses, frame, k)
        moment = utc_from_gps_ns(int(poses.pictures.epochs_gps_ns[k]))
        spread = float(np.sqrt(np.trace(poses.covariance[k, :3, :3]) / 3.0))
        shots[names[k]] = {
            "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(), "translation": shift.tolist(),
            "camera": f"roadscan {lenses[int(poses.pictures.views.lens[k]) + 1][1]}", "orientation": 1,
            "capture_time": moment.timestamp(), "gps_dop": spread,
            "gps_position": _eye(poses, frame, k).tolist(),
        }  # fmt: skip
    ties, notes = tie_points(session, poses, frame, range(len(poses)))
    given = _points(poses, frame, points)
    places = {
        str(number): {"coordinates": place, "color": [_GREY] * 3}
        for number, place in enumerate(np.concatenate([given, ties.place_m]).tolist())
    }
    whole = [{"cameras": cameras, "shots": shots, "points": places, "reference_lla": reference}]
    written = {
        "reconstruction.json": _json(whole), "camera_models.json": _json(cameras),
        "reference_lla.json": _json(reference), OFFSET_FILE: _json(_offset(poses, frame)),
    }  # fmt: skip
    if ties.point.size:
        written["tracks.csv"] = "\n".join([_TRACKS_HEADER, *_opensfm_tracks(poses, ties, names, len(given))]) + "\n"
    return _written(out, written, [*notes, *_where_pictures_are(poses)])


def _colmap_tracks(
    ties: TiePoints, pictures: Sequence[int], first: int
) -> tuple[Mapping[int, list[str]], Mapping[int, list[str]]]:
    """Return the measurements by picture, and the tracks by point, as COLMAP's lines have them.

    first : number of the first tie point among all points.
    """
    image = {k: number for number, k in enumerate(pictures, start=1)}
    seen, tracks = defaultdict[int, list[str]](list), defaultdict[int, list[str]](list)
    for point, k, (u, v) in zip(ties.point.tolist(), ties.picture.tolist(), ties.pixel.tolist(), strict=True):
        tracks[first + point].append(f"{image[k]} {len(seen[k])}")
        seen[k].append(f"{u + 0.5!r} {v + 0.5!r} {first + point}")
    return seen, tracks


def _opensfm_tracks(poses: PicturePoses, ties: TiePoints, names: Sequence[str], first: int) -> Iterator[str]:
    """Yield the rows of `tracks.csv`: picture, point, feature, place in it and scale, colour, and two codes of none."""
    size = np.array([poses.pictures.views.lens_of(k).size_px for k in range(len(poses))], np.float64)[ties.picture]
    place = (ties.pixel + 0.5 - size / 2.0) / size.max(axis=1, keepdims=True)
    order = np.lexsort((ties.point, ties.picture))
    for feature in order.tolist():
        x, y = place[feature].tolist()
        name, scale = names[ties.picture[feature]], 1.0 / size[feature].max()
        values = name, first + int(ties.point[feature]), feature, repr(x), repr(y), repr(float(scale))
        yield "\t".join(map(str, (*values, *(_GREY,) * 3, *(_NO_CODE,) * 2)))


def _written(out: Path, contents: dict[str, str], notes: Sequence[str]) -> Exported:
    with published(out) as folder:
        for name, text in contents.items():
            (folder / name).write_text(text, encoding="utf-8")
    return Exported(tuple(out / name for name in contents), tuple(notes))


def _lenses(poses: PicturePoses, numbers: Sequence[int]) -> dict[int, tuple[Lens, str]]:
    """Return lenses with the name of their camera, by number from 1."""
    views, found = poses.pictures.views, {}
    for k in numbers:
        lens = int(views.lens[k])
        found[lens + 1] = (views.lenses[lens], poses.pictures.logs[poses.pictures.log[k]].sensor)
    return dict(sorted(found.items()))


def _colmap_camera(number: int, lens: Lens) -> str:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens.parameters[:9].tolist()
    width, height = lens.size_px
    values = [fx, fy, cx + 0.5, cy + 0.5, k1, k2, p1, p2]
    model = "OPENCV"
    if k3 != 0.0:  # OpenCV's model in COLMAP ends with p2; the full one has the denominator's coefficients as well
        model, values = "FULL_OPENCV", [*values, k3, 0.0, 0.0, 0.0]
    return f"{number} {model} {width} {height} " + " ".join(repr(v) for v in values)


def _opensfm_camera(lens: Lens) -> dict[str, Any]:
    width, height = lens.size_px
    if lens.is_around:
        return {"projection_type": "spherical", "width": width, "height": height}
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens.parameters[:9].tolist()
    longer = float(max(width, height))
    return {
        "projection_type": "brown", "width": width, "height": height, "focal_x": fx / longer, "focal_y": fy / longer,
        "c_x": (cx + 0.5 - width / 2.0) / longer, "c_y": (cy + 0.5 - height / 2.0) / longer,
        "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3,
    }  # fmt: skip


def _eye(poses: PicturePoses, frame: LocalFrame, number: int) -> Float64:
    return np.asarray(frame.points(poses.pictures.views.eye_world_m[number][None])[0])


def _camera_from_local(poses: PicturePoses, frame: LocalFrame, number: int) -> tuple[Float64, Float64]:
    """Return rotation (3, 3) and translation (3,) from the local frame to camera axes (right, down, ahead)."""
    turn = poses.pictures.views.opencv_from_world[number] @ frame.local_from_world.T
    return turn, -turn @ _eye(poses, frame, number)


def _points(poses: PicturePoses, frame: LocalFrame, file: Path | None) -> Float64:
    """Return the points (n, 3) of a file in the local frame."""
    if file is None:
        return np.zeros((0, 3))
    import pandas as pd

    names = ["easting_m", "northing_m", "height_m"]
    try:
        places = pd.read_csv(file)[names].to_numpy(np.float64)
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"no points can be read: {error}", expected="a CSV with " + ", ".join(names), file=file
        ) from error
    if not np.isfinite(places).all():
        raise ConfigError("a point has no number", expected="numbers in " + ", ".join(names), file=file)
    return frame.points(poses.pictures.map.world_from_map(frame.world, places))


def _offset(poses: PicturePoses, frame: LocalFrame) -> dict[str, Any]:
    """Return where the local frame lies, and by how much the map's axes differ from it."""
    chart = poses.pictures.map
    level = map_from_ned(chart, frame.world, frame.origin_world_m[None])[0] @ ENU_FROM_NED
    eyes = frame.points(poses.pictures.views.eye_world_m)
    apart = frame.origin_map_m + eyes @ level.T - poses.place_m
    offset: dict[str, Any] = {
        "meaning": "local = rotation · (world − origin_world_m); about: map = origin_map_m + map_from_local · local",
        "axes": "x east, y north, z up at the origin (metres)",
        "origin_map_m": frame.origin_map_m.tolist(), "map_crs": chart.crs, "map_height": chart.height,
        "world": frame.world, "origin_world_m": frame.origin_world_m.tolist(),
        "rotation": frame.local_from_world.tolist(), "map_from_local": level.tolist(),
        "map_from_local_error_m": float(np.abs(apart).max()),
    }  # fmt: skip
    origin = frame.lon_lat_height
    if origin is not None:
        offset["origin_wgs84"] = dict(zip(("longitude_deg", "latitude_deg", "height_m"), origin.tolist(), strict=True))
    return offset


def _where_pictures_are(poses: PicturePoses) -> list[str]:
    folders = sorted({f"{log.run}/{log.sensor}: {log.folder}" for log in poses.pictures.logs})
    return ["pictures are named RUN/CAMERA/FILE; `roadscan export pictures` copies them so", *folders]


def _json(value: Any) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


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
    camera = np.array([own_of.get(one, -1) for one in names], np.int64)[picture]
    met = np.asarray(np.isfinite(found.place_m).all(axis=1))
    sound = met[point] & (camera >= 0)
    sound &= (np.bincount(point[sound], minlength=len(found.place_m)) > 1)[point]
    order = np.flatnonzero(sound)[np.lexsort((camera[sound], point[sound]))]
    held, point = np.unique(point[order], return_inverse=True)
    error = np.bincount(point, np.hypot(*after[order].T)) / np.maximum(np.bincount(point), 1)
    left = rows.num_rows - len(order)
    notes = [f"{left:,} measurements of tie points are left out: without a chosen picture, or alone"] if left else []
    return TiePoints(frame.points(found.place_m[held]), error, point, camera[order], pixel[order]), notes


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
        rows = views.lens[picture] == number
        ray[rows] = rays_of(lens, pixel[rows])
    return np.asarray(np.einsum("nji,nj->ni", views.opencv_from_world[picture], ray))
