"""The two sweeps of the Argoverse drive as a scene, and the distance of places to its lane boundaries."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.feather as feather
import shapely
from scipy.spatial.transform import Rotation
from shapely.ops import substring

from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns, Scene
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, leap_seconds_at_unix
from tests.assets.scenes import joined, recordings_folder

Float64 = npt.NDArray[np.float64]

HALF_M = 40.0
PIECE_M = 4.0
_LIDARS = (("up_lidar", 0), ("down_lidar", 1))


@functools.cache
def av2_scene() -> Scene:
    """Returns of both sweeps in the city frame, around the vehicle; each lidar is a sensor of its own."""
    folder = recordings_folder() / "av2_drive"
    poses = feather.read_table(folder / "city_SE3_egovehicle.feather").to_pandas()
    mounts = feather.read_table(folder / "calibration" / "egovehicle_SE3_sensor.feather").to_pandas()
    files = sorted((folder / "sensors" / "lidar").glob("*.feather"))
    first = poses[poses.timestamp_ns == int(files[0].stem)].iloc[0]
    corner = (float(round(first.tx_m / 10) * 10), float(round(first.ty_m / 10) * 10))
    parts = [_returns(file, poses, mounts, corner) for file in files]
    box = Box(-HALF_M, -HALF_M, HALF_M, HALF_M)
    returns = joined(parts)
    returns = returns.at(box.holds(returns.x_m, returns.y_m))
    drive = poses[["tx_m", "ty_m", "tz_m"]].to_numpy()[::20] - np.array([*corner, 0.0])
    return make_scene(returns, box, box, np.column_stack([drive, np.ones(len(drive))]))


@functools.cache
def boundaries() -> tuple[list[shapely.LineString], list[shapely.LineString]]:
    """Lane boundaries with paint and without, in the city frame. One with paint in either lane's words has it."""
    folder = recordings_folder() / "av2_drive" / "map"
    segments = json.loads(next(Path(folder).glob("log_map_archive*.json")).read_text())["lane_segments"].values()
    marks: dict[tuple[tuple[float, float], ...], set[str]] = {}
    for segment in segments:
        for side in ("left", "right"):
            line = tuple((p["x"], p["y"]) for p in segment[f"{side}_lane_boundary"])
            marks.setdefault(min(line, line[::-1]), set()).add(segment[f"{side}_lane_mark_type"])
    painted = [shapely.LineString(line) for line, kinds in marks.items() if kinds - {"NONE"}]
    bare = [shapely.LineString(line) for line, kinds in marks.items() if kinds == {"NONE"}]
    return painted, bare


def _returns(file: Path, poses: object, mounts: object, corner: tuple[float, float]) -> Returns:
    sweep = feather.read_table(file)
    xyz = np.stack([sweep[c].to_numpy().astype(np.float64) for c in "xyz"], axis=1)
    laser = sweep["laser_number"].to_numpy().astype(np.int64)
    pose = poses[poses.timestamp_ns == int(file.stem)].iloc[0]  # type: ignore[attr-defined]
    turn = Rotation.from_quat([pose.qx, pose.qy, pose.qz, pose.qw])
    shift = np.array([pose.tx_m, pose.ty_m, pose.tz_m]) - np.array([*corner, 0.0])
    sensor = (laser >= 32).astype(np.uint8)
    places = np.array([mounts[mounts.sensor_name == n][["tx_m", "ty_m", "tz_m"]].to_numpy()[0] for n, _ in _LIDARS])  # type: ignore[attr-defined]
    place, seen_from = turn.apply(xyz) + shift, turn.apply(places)[sensor] + shift
    unix_s = int(file.stem) / 1e9
    gps_ns = int(file.stem) + (int(leap_seconds_at_unix(unix_s)) - GPS_EPOCH_UNIX_S) * 10**9
    n = len(xyz)
    return Returns(
        corner_m=corner,
        x_m=place[:, 0],
        y_m=place[:, 1],
        height_m=place[:, 2],
        intensity=sweep["intensity"].to_numpy().astype(np.float32),
        epoch_gps_ns=gps_ns + sweep["offset_ns"].to_numpy().astype(np.int64),
        pass_id=np.ones(n, np.uint16),
        sensor=sensor,
        laser=(laser % 32).astype(np.uint16),
        return_number=np.ones(n, np.uint8),
        number_of_returns=np.ones(n, np.uint8),
        sensor_x_m=seen_from[:, 0],
        sensor_y_m=seen_from[:, 1],
        sensor_height_m=seen_from[:, 2],
        sensors=("up_lidar", "down_lidar"),
    )


def ratio(scene: Scene, lines: list[shapely.LineString], away_from: list[shapely.LineString] | None = None) -> float:
    """Intensity of the road within 0.1 m of the lines, divided by that 0.5 to 1 m beside them.

    Lines are compared with what lies beside them in pieces of 4 m or so, since the road is not everywhere the same.
    Left out are crossings for people, what is not for driving or farther than 30 m, and ground near `away_from`.
    """
    found = scene.returns
    road = np.flatnonzero((np.abs(scene.above_ground_m) <= 0.1) & (found.range_m < 30.0))
    points = shapely.points(found.corner_m[0] + found.x_m[road], found.corner_m[1] + found.y_m[road])
    drivable, crossings = _areas()
    good = shapely.contains(drivable, points) & ~shapely.contains(crossings, points)
    if away_from is not None:
        good[np.unique(shapely.STRtree(points).query(away_from, predicate="dwithin", distance=0.5)[1])] = False
    road, points = road[good], points[good]
    pieces = [
        substring(line, i / n, (i + 1) / n, normalized=True)
        for line in lines
        for n in [max(1, round(line.length / PIECE_M))]
        for i in range(n)
    ]
    nearest = shapely.STRtree(pieces).query_nearest(points, max_distance=1.0, return_distance=True, all_matches=False)
    (row, piece), away = nearest
    value = found.intensity[road[row]].astype(np.float64)
    sums = []
    for there in (away <= 0.1, away >= 0.5):
        total = np.bincount(piece[there], weights=value[there], minlength=len(pieces))
        sums.append((total, np.bincount(piece[there], minlength=len(pieces))))
    (on, count_on), (beside, count_beside) = sums
    both = (count_on >= 3) & (count_beside >= 3) & (beside > 0)
    expected = beside[both] / count_beside[both] * count_on[both]
    return float(on[both].sum() / expected.sum())


@functools.cache
def _areas() -> tuple[shapely.Geometry, shapely.Geometry]:
    """Where the map says that one drives, 0.3 m within its edges, and crossings for people with 1 m around."""
    folder = recordings_folder() / "av2_drive" / "map"
    known = json.loads(next(Path(folder).glob("log_map_archive*.json")).read_text())
    drivable = [
        shapely.Polygon([(p["x"], p["y"]) for p in a["area_boundary"]]) for a in known["drivable_areas"].values()
    ]
    crossings = [
        shapely.MultiPoint([(p["x"], p["y"]) for p in (*c["edge1"], *c["edge2"])]).convex_hull.buffer(1.0)
        for c in known["pedestrian_crossings"].values()
    ]
    return shapely.union_all(drivable).buffer(-0.3), shapely.union_all(crossings)
