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

from roadscan.assets.make_scene import make_scene
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, Scene
from roadscan.model.gpstime import GPS_EPOCH_UNIX_S, leap_seconds_at_unix
from tests.assets.scenes import joined, recordings_folder

Float64 = npt.NDArray[np.float64]

HALF_M = 40.0
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


def ratios(scene: Scene, lines: list[shapely.LineString], others: list[shapely.LineString]) -> tuple[float, int]:
    """Mean intensity of ground within 0.1 m of the lines, over that 0.5 to 1 m beside them; and returns on the lines.

    Ground near `others` is left out.
    """
    found = scene.returns
    ground = np.abs(scene.above_ground_m) <= 0.1
    points = shapely.points(found.corner_m[0] + found.x_m[ground], found.corner_m[1] + found.y_m[ground])
    value = found.intensity[ground].astype(np.float64)
    away, apart = (_distance(points, some) for some in (lines, others))
    on, beside = (away <= 0.1) & (apart > 0.5), (away >= 0.5) & (away <= 1.0) & (apart > 0.5)
    return float(value[on].mean() / value[beside].mean()), int(on.sum())


def _distance(points: npt.NDArray[np.object_], lines: list[shapely.LineString]) -> Float64:
    """Distance (n,) to the nearest line; infinite beyond 2 m."""
    tree = shapely.STRtree(lines)
    out = np.full(len(points), np.inf)
    (row, _), away = tree.query_nearest(points, max_distance=2.0, return_distance=True, all_matches=False)
    out[row] = away
    return out
