"""All pictures of a survey's cameras as rows of the table `pictures`, and the files that hold them."""

from __future__ import annotations

import datetime as dt
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer, write_geopackage
from roadscan.compute.array_types import Float64
from roadscan.core.errors import RoadscanError
from roadscan.core.frames import quaternion_from_rotation
from roadscan.core.gpstime import NS_PER_S, utc_from_gps_ns
from roadscan.core.rig import Sensor
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.measuring.ground import Ground
from roadscan.measuring.measure import ground_hits
from roadscan.measuring.poses import PicturePoses, omega_phi_kappa_deg, picture_poses, yaw_pitch_roll_deg
from roadscan.navigation.tasks.recorded_pictures import TakenPictures
from roadscan.pictures.exposures import camera_pictures
from roadscan.pictures.lens import Lens, rays_of
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.views import HEIGHT, WIDTH, PictureRule
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, publish_file
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table

_A_SIDE: Final = 8
"""Rays along each side of a picture."""
_AROUND: Final = 32
"""Corners of the circle that a picture of 360° shows."""
_BELOW_M: Final = (3.0, 10.0)
"""The road's height is that of the ground within the first of these radii below the camera that holds any (m)."""
_BOTTOM_SHARE: Final = 1.02
"""The circle's radius over the reach, so that its sides touch it."""


class Footprint(NamedTuple):
    """The ground that a picture shows."""

    polygon_m: Any
    """Polygon on the map with heights, counter-clockwise; None where the picture shows no ground."""
    on_ground: float
    """Share of its border's rays that meet surveyed ground; NaN without a polygon."""
    without: str = ""
    """Why there is no polygon."""


_NONE: Final = Footprint(None, math.nan, "the picture shows no ground")
_NO_ROAD: Final = Footprint(
    None, math.nan, "no ground is surveyed below the camera, and the rig file states no above_road_m of it"
)
_BELOW: Final = Footprint(None, math.nan, "the camera lies below the surveyed ground")


def footprint(
    poses: PicturePoses, ground: Ground, number: int, reach_m: float, above_road_m: float | None = None
) -> Footprint:
    """Return what a picture shows of the ground within a reach of the camera, on the map.

    Rays that meet no surveyed ground are compared with a level plane at the height of the road below the camera; those
    that rise or go farther end at the reach. Where no ground is surveyed there, that plane lies `above_road_m` below.
    """
    place = poses.place_m[number]
    heights = (ground.height_m(float(place[0]), float(place[1]), radius) for radius in _BELOW_M)
    known_m = next((h for h in heights if math.isfinite(h)), None)
    if known_m is None and above_road_m is None:
        return _NO_ROAD
    road_m = float(place[2]) - (above_road_m or 0.0) if known_m is None else known_m
    if road_m >= place[2]:
        return _BELOW
    lens = poses.pictures.views.lens_of(number)
    if lens.is_around:
        turn = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
        circle = place[:2] + _BOTTOM_SHARE * reach_m * np.column_stack([np.cos(turn), np.sin(turn)])
        return Footprint(shapely.Polygon(np.column_stack([circle, np.full(_AROUND, road_m)])), 0.0)
    ray = rays_of(lens, border_pixels(lens))
    ray = ray[np.isfinite(ray).all(axis=1)]
    if len(ray) < 3:
        return _NONE
    way = ray @ (poses.map_from_ned[number] @ poses.ned_from_camera[number]).T
    if not (way[:, 2] < 0.0).any():
        return _NONE
    corners, level = _on_level(place, way, road_m, reach_m)
    hits = ground_hits(poses, ground, number, ray, 1.5 * reach_m)
    met = place + hits[:, None] * way
    far = np.hypot(*(met[:, :2] - place[:2]).T)
    on_ground = (hits >= 0.0) & (far <= reach_m) & level
    exact = np.where(on_ground[:, None], met, corners)
    for ring in (exact, corners):
        polygon = shapely.Polygon(ring)
        if polygon.is_valid and polygon.area > 0.0:
            return Footprint(shapely.orient_polygons(polygon), float(on_ground.mean()) if ring is exact else 0.0)
    parts = shapely.get_parts(shapely.make_valid(shapely.Polygon(corners)))
    parts = [one for one in parts if one.geom_type == "Polygon"]
    if not parts:
        return _NONE
    return Footprint(shapely.orient_polygons(max(parts, key=lambda one: one.area)), 0.0)


def border_pixels(lens: Lens) -> Float64:
    """Return pixels (32, 2) along the border of a picture, clockwise from the upper left."""
    right, bottom = lens.parameters[WIDTH] - 0.5, lens.parameters[HEIGHT] - 0.5
    corner = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    share = np.arange(_A_SIDE) / _A_SIDE
    sides = corner[:-1, None] + share[None, :, None] * (corner[1:] - corner[:-1])[:, None]
    return np.asarray(sides.reshape(-1, 2))


def _on_level(place: Float64, way: Float64, road_m: float, reach_m: float) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Return where rays (m, 3) meet a level plane, at most at the reach, and which of them meet it within."""
    level = np.hypot(way[:, 0], way[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.where(way[:, 2] < 0.0, (road_m - place[2]) / way[:, 2], np.inf)
        within = along * level <= reach_m
        along = np.where(within, along, reach_m / level)
    corners = place + along[:, None] * way
    corners[:, 2] = road_m
    return corners, within


_ANYWHERE: Final = PictureRule((), 30.0, -90.0, 1)
"""Pictures of all cameras; its reach selects none here."""


@dataclass(frozen=True)
class Unplaced:
    """A picture without a pose."""

    run: str
    camera: str
    file: str
    log: str
    epoch_gps_ns: int
    size_px: tuple[int, int]
    """0 where it is not known."""
    reason: str


@dataclass(frozen=True, eq=False)
class ListedPictures:
    """The pictures of all cameras."""

    placed: tuple[PicturePoses, ...]
    """By camera, in the order of their names."""
    unplaced: tuple[Unplaced, ...]
    """In the order of camera, log and epoch."""


def listed_pictures(plan: SurveyPlan) -> ListedPictures:
    """Return all pictures of a survey's cameras; a camera whose pictures cannot be placed costs those alone."""
    placed: list[PicturePoses] = []
    unplaced: list[Unplaced] = []
    cameras = {name: one for name, one in sorted(plan.survey.rig.sensors.items()) if one.kind == "camera"}
    for name, camera in cameras.items():
        taken = [one for one in camera_pictures(plan, name) if one.files]
        if not taken:
            continue
        held, refused = set[tuple[str, str, int]](), ""
        try:
            pictures = plan_pictures(plan, replace(_ANYWHERE, cameras=(name,)))
        except RoadscanError as error:
            refused = error.args[0] if error.args else str(error)
        else:
            placed.append(picture_poses(plan, pictures))
            held = {
                (pictures.logs[log].key, file, epoch)
                for log, file, epoch in zip(
                    pictures.log.tolist(), pictures.files, pictures.epochs_gps_ns.tolist(), strict=True
                )
            }
        for one in taken:
            unplaced += _unplaced(plan, camera, one, held, refused)
    return ListedPictures(tuple(placed), tuple(unplaced))


def _unplaced(
    plan: SurveyPlan, camera: Sensor, taken: TakenPictures, held: set[tuple[str, str, int]], refused: str
) -> list[Unplaced]:
    """Return the pictures of a log that are not among those placed."""
    record, found = taken.record, []
    for number in np.argsort(taken.epochs_gps_ns, kind="stable").tolist():
        epoch, file = int(taken.epochs_gps_ns[number]), taken.files[number]
        if (record.key, file, epoch) in held:
            continue
        width, height = taken.size_px[number].tolist()
        reason = _reason(plan, camera, taken, number, refused)
        found.append(Unplaced(record.run, record.sensor, file, record.path, epoch, (width, height), reason))
    return found


def _reason(plan: SurveyPlan, camera: Sensor, taken: TakenPictures, number: int, refused: str) -> str:
    record, interior = taken.record, camera.interior
    if interior is None:
        return "the camera has no interior orientation in the rig file"
    width, height = taken.size_px[number].tolist()
    if width and (width, height) != (interior.width_px, interior.height_px):
        return (
            f"{width} × {height} pixels, and the interior orientation is for {interior.width_px} × {interior.height_px}"
        )
    try:
        files = trajectory_source(record.run, plan.records).files
    except RoadscanError as error:
        return str(error.args[0] if error.args else error)
    spans = [span for file in files for span in file.group_spans]
    epoch = int(taken.epochs_gps_ns[number])
    first, last = min(a for a, _ in spans), max(b for _, b in spans)
    if epoch < first:
        return f"taken {(first - epoch) / NS_PER_S:.1f} s before the trajectory begins"
    if epoch > last:
        return f"taken {(epoch - last) / NS_PER_S:.1f} s after the trajectory ends"
    return refused or "taken in a gap of the trajectory"


PRODUCT: Final = "pictures"
"""Name in the manifest, and of the table."""
GEOPACKAGE: Final = "pictures.gpkg"
_NUDGE_RAD: Final = 1e-6  # Small turn with which derivatives of angles are taken.
_UPRIGHT_DEG: Final = 89.0
"""Beyond this middle angle the outer two of three angles are not distinguished, and have no σ."""


@dataclass(frozen=True, eq=False)
class PictureRows:
    """Some pictures of a camera whose rows make a file. Sent to workers: it holds no picture."""

    store: Store
    context: ProductContext
    unit: str
    """Name of the file."""
    key: str
    poses: PicturePoses | None
    """Those with a pose."""
    ground: Ground | None
    """The ground around them."""
    unplaced: tuple[Unplaced, ...]
    logs: tuple[str, ...]
    """Paths of the logs that the poses name by number."""
    reach_m: float
    above_road_m: float | None
    """Height of the camera above the road, as the rig file states it."""


def write_rows(task: PictureRows) -> OutputRecord:
    """Write a file of the table (runs on a worker)."""
    rows, places, prints = picture_rows(task)
    schema = table_schema(PRODUCT)
    table = pa.Table.from_pylist(rows, schema=schema.arrow())
    without = Counter(row["without_footprint"] for row in rows if row.get("without_footprint"))
    told = {"pictures": len(rows), "without_pose": len(task.unplaced), "without_footprint": without}
    with task.store.scratch() as folder:
        path = folder / task.unit
        write_geo_table(
            path, table, "geometry", places, ["Point Z"], task.context, counterclockwise=True,
            more={"footprint": (prints, ["Polygon Z"])},
        )  # fmt: skip
        target = f"{schema.location}/{task.unit}"
        return publish_file(task.store, path, target, PRODUCT, task.unit, task.key, json.dumps(told, sort_keys=True))


def picture_rows(task: PictureRows) -> tuple[list[dict[str, Any]], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return rows of `schemas/pictures.toml` in order of time, projection centres and footprints (None of none)."""
    rows: list[dict[str, Any]] = []
    shapes: list[tuple[Any, Any]] = []
    if task.poses is not None and task.ground is not None:
        angles = _angles(task.poses)
        for number in range(len(task.poses)):
            seen = footprint(task.poses, task.ground, number, task.reach_m, task.above_road_m)
            row = _row(task, task.poses, number) | {name: values[number] for name, values in angles.items()}
            if seen.polygon_m is None:
                row["without_footprint"] = seen.without
            else:
                row |= {"footprint_m2": seen.polygon_m.area, "footprint_on_ground": seen.on_ground}
            rows.append({name: _plain(value) for name, value in row.items()})
            shapes.append((shapely.Point(task.poses.place_m[number]), seen.polygon_m))
    for one in task.unplaced:
        size = {"width_px": one.size_px[0] or None, "height_px": one.size_px[1] or None}
        names = {"run": one.run, "camera": one.camera, "file": one.file, "log": one.log, "without_pose": one.reason}
        rows.append({**names, "epoch_gps_ns": one.epoch_gps_ns, "utc": utc_text(one.epoch_gps_ns), **size})
        shapes.append((None, None))
    order = sorted(range(len(rows)), key=lambda k: tuple(rows[k][name] for name in table_schema(PRODUCT).sort))
    places, prints = (np.array([shapes[k][which] for k in order] + [None], object)[:-1] for which in (0, 1))
    return [rows[k] for k in order], places, prints


def utc_text(epoch_gps_ns: int) -> str:
    """Return an epoch as UTC, ISO 8601 to the microsecond."""
    return utc_from_gps_ns(epoch_gps_ns).astimezone(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _row(task: PictureRows, poses: PicturePoses, number: int) -> dict[str, Any]:
    """Return a row without its angles."""
    pictures = poses.pictures
    log = pictures.logs[pictures.log[number]]
    lens = pictures.views.lens_of(number)
    values = lens.parameters
    epoch = int(pictures.epochs_gps_ns[number])
    slope = poses.map_from_ned[number]
    spread = np.sqrt(np.diag(slope @ poses.covariance[number, :3, :3] @ slope.T))
    quaternion = quaternion_from_rotation(poses.map_from_camera[number])
    named = zip(("longitude_deg", "latitude_deg", "ellipsoidal_height_m"), poses.geographic[number], strict=True)
    return {
        "run": log.run, "camera": log.sensor, "file": pictures.files[number], "log": task.logs[pictures.log[number]],
        "epoch_gps_ns": epoch, "utc": utc_text(epoch),
        **dict(zip(("easting_m", "northing_m", "height_m"), poses.place_m[number], strict=True)), **dict(named),
        **dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True)),
        **dict(zip(("sigma_easting_m", "sigma_northing_m", "sigma_height_m"), spread, strict=True)),
        "sigma_assumed": poses.told[number] or None,
        "model": "equirectangular" if lens.is_around else "perspective",
        "width_px": round(values[WIDTH]), "height_px": round(values[HEIGHT]),
        "focal_x_px": values[0], "focal_y_px": values[1],
    }  # fmt: skip


def _angles(poses: PicturePoses) -> dict[str, Float64]:
    """Return the columns (n,) of orientations with their σ."""
    of_map, of_level = poses.map_from_camera, poses.ned_from_camera
    level = of_map @ of_level.transpose(0, 2, 1)  # map from NED, without scale
    covariance = poses.covariance[:, 3:, 3:]
    opk, yaw = omega_phi_kappa_deg(of_map), yaw_pitch_roll_deg(of_level)
    out = dict(zip(("omega_deg", "phi_deg", "kappa_deg"), opk.T, strict=True))
    out |= dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), yaw.T, strict=True))
    slopes = np.empty((2, len(poses), 3, 3))
    for axis in range(3):
        turn = np.eye(3)
        one, other = [k for k in range(3) if k != axis]
        sign = 1.0 if axis != 1 else -1.0
        turn[one, other], turn[other, one] = -sign * _NUDGE_RAD, sign * _NUDGE_RAD
        for which, told, base in ((0, omega_phi_kappa_deg(level @ turn @ of_level), opk),
                                  (1, yaw_pitch_roll_deg(turn @ of_level), yaw)):  # fmt: skip
            slopes[which, :, :, axis] = (np.mod(told - base + 180.0, 360.0) - 180.0) / _NUDGE_RAD
    for which, names, angles in ((0, ("omega", "phi", "kappa"), opk), (1, ("yaw", "pitch", "roll"), yaw)):
        spread = np.sqrt(np.einsum("nij,njk,nik->ni", slopes[which], covariance, slopes[which]))
        steep = np.abs(angles[:, 1]) > _UPRIGHT_DEG
        for k, name in enumerate(names):
            out[f"sigma_{name}_deg"] = spread[:, k] if k == 1 else np.where(steep, np.nan, spread[:, k])
    return out


def _plain(value: Any) -> Any:
    """Return a number that is NaN as null."""
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value


def write_picture_package(
    store: Store, context: ProductContext, records: Sequence[OutputRecord], key: str
) -> OutputRecord:
    """Write the GeoPackage of all files of the table: a layer of projection centres, and one of footprints."""
    parts, places, prints = [], [], []
    for record in records:
        rows, shapes = read_geo_table(read_recorded(store, record), context)
        prints.append(shapely.from_wkb(np.array(rows["footprint"].to_pylist(), object)))
        parts.append(rows.drop_columns(["footprint"]).replace_schema_metadata(None))
        places.append(shapes)
    rows = pa.concat_tables(parts, promote_options="permissive")
    seen = np.concatenate(prints)
    known = ~shapely.is_missing(seen)
    unit_m = context.map.horizontal_unit_m
    in_metres = shapely.transform(seen[known], lambda xyz: xyz * [unit_m, unit_m, context.map.vertical_unit_m],
                                  include_z=True)  # fmt: skip
    names = ["run", "camera", "file", "epoch_gps_ns", "utc", "footprint_m2", "footprint_on_ground"]
    layers = [Layer("pictures", "PointZ", rows, np.concatenate(places))]
    if known.any():
        layers.append(Layer("footprints", "PolygonZ", rows.select(names).filter(pa.array(known)), in_metres))
    with store.scratch() as folder:
        path = folder / GEOPACKAGE
        write_geopackage(path, layers, context)
        return publish_file(store, path, f"{table_schema(PRODUCT).location}/{GEOPACKAGE}", PRODUCT, GEOPACKAGE, key)
