# ruff: noqa: T201
"""A robot's scans matched to each other, against relations between its poses that were made by hand.

The recording has 7,374 scans with odometry, and a list of relations: pose of the robot at t2 as seen from its pose at
t1. Scans and poses are read from the tables that roadscan wrote.

    python scan_matching.py [PICTURE.png]
"""

from __future__ import annotations

import gzip
import itertools
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import duckdb
import laspy
import numpy as np
import numpy.typing as npt
import pandas as pd
import small_gicp
from scipy.spatial.transform import Rotation

from roadscan.core.rig import ScanGeometry
from roadscan.core.survey import Survey
from roadscan.store.logs import read_log_records
from roadscan.store.store import Store

SURVEY_FILE = Path("aces.toml")
RELATIONS = Path("recordings/lms/aces.relations.gz")
STAMPS_FROM_NS = 10**18
"""The survey file puts stamp 0 at this epoch."""

NEAR_S = 30.0
"""Odometry is near the truth for so long."""
FARTHEST_M = 20.0
"""Beyond, the beams lie too far apart to show a wall's direction."""
SPACING_M = 0.1
SAME_WALL_M = 0.5
"""Neighbouring readings nearer than this are taken as one wall, and points are put between them."""
LEVELS_M = (-0.2, -0.1, 0.0, 0.1, 0.2)
OVERLAP = 0.8
"""A match that lays a smaller share of a scan on the other is not believed."""

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Recording:
    """Scans and odometry as they lie in the store."""

    stamps_s: Float64
    """(n,) the log's own stamps."""
    points_m: list[Float64]
    """Ends of each scan's beams (k, 2), x forward, y left of the scanner."""
    spans: list[npt.NDArray[np.int64]]
    """Number of the beam of each of these points."""
    poses: Float64
    """(n, 3) x, y (m) and θ (rad, counter-clockwise from x)."""

    def at(self, stamps_s: Float64) -> npt.NDArray[np.int64]:
        """Scan (m,) of each stamp."""
        found = np.searchsorted(self.stamps_s, stamps_s - 1e-5)
        if np.abs(self.stamps_s[found] - stamps_s).max() > 1e-5:
            raise ValueError("a relation's stamp is none of a scan")
        return found


def read_recording(survey_file: Path) -> Recording:
    """Scans and poses from the tables."""
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    (record,) = read_log_records(store)
    scans, trajectory = (
        duckdb.sql(f"FROM read_parquet('{store.root}/tables/{table}/**/*.parquet') ORDER BY epoch_gps_ns").df()
        for table in ("scans", "trajectory")
    )
    geometry = ScanGeometry.parse(record.attributes["scan_geometry"])
    _, directions = geometry.rays()
    forward_left = directions[:, [2, 1]] * [1, -1]  # sensor axes: x up, y right, z ahead
    ranges = np.stack(scans["range"].to_numpy()) * geometry.range_step_m
    beams = [np.flatnonzero((r > 0) & (r < FARTHEST_M)) for r in ranges]
    quaternions = trajectory[["qx", "qy", "qz", "qw"]].to_numpy()
    ahead = Rotation.from_quat(quaternions).apply([1.0, 0.0, 0.0])
    theta = np.arctan2(ahead[:, 1], ahead[:, 0])
    return Recording(
        (scans.epoch_gps_ns.to_numpy() - STAMPS_FROM_NS) * 1e-9,
        [r[b, None] * forward_left[b] for r, b in zip(ranges, beams, strict=True)],
        beams,
        np.column_stack([trajectory.x_world_m, trajectory.y_world_m, theta]),
    )


def read_relations(file: Path) -> pd.DataFrame:
    """The relations: t1, t2 (s), x, y (m), theta (rad)."""
    with gzip.open(file) as stream:
        columns = np.loadtxt(stream)[:, [0, 1, 2, 3, 7]]
    return pd.DataFrame(columns, columns=["t1", "t2", "x", "y", "theta"])


# --- poses in the plane -----------------------------------------------------------------------------


def wrapped(angle_rad: Float64) -> Float64:
    """Angles within ± π."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def relative(first: Float64, second: Float64) -> Float64:
    """Poses (…, 3) as seen from the poses `first`."""
    across, along = np.sin(first[..., 2]), np.cos(first[..., 2])
    dx, dy = (second - first)[..., 0], (second - first)[..., 1]
    turn = wrapped(second[..., 2] - first[..., 2])
    return np.stack([along * dx + across * dy, along * dy - across * dx, turn], axis=-1)


def moved(pose: Float64, by: Float64) -> Float64:
    """The pose (3,) after the relative motion `by` (3,)."""
    across, along = np.sin(pose[2]), np.cos(pose[2])
    return pose + np.array([along * by[0] - across * by[1], across * by[0] + along * by[1], by[2]])


# --- matching ---------------------------------------------------------------------------------------


class Matcher:
    """Matches scans with small_gicp's generalised ICP.

    A scan is flat, and a covariance of flat points has no thickness across the plane: the matcher would take all of
    them for floor. So each scan is set up as what it is a section of, walls: between neighbouring readings on one wall
    points are put every 10 cm, and all of them are repeated on five levels. Their neighbourhoods are then vertical
    planes, height, roll and pitch stay where they start, and the solution is x, y and θ.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._cloud = lru_cache(maxsize=4096)(self._make_cloud)
        self.from_odometry = lru_cache(maxsize=4096)(self._from_odometry)

    def match(self, first: int, second: int, guess: Float64, distances_m: tuple[float, ...]) -> tuple[Float64, float]:
        """Pose of scan `second` as seen from scan `first`, (3,), and the share of its points that found a partner.

        Parameters
        ----------
        guess : (3,) where to start.
        distances_m : farthest partners, one round each.
        """
        target, tree = self._cloud(first)
        source, _ = self._cloud(second)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec([0, 0, guess[2]]).as_matrix()
        matrix[:2, 3] = guess[:2]
        inliers = 0
        for distance in distances_m:
            found = small_gicp.align(
                target, source, tree, matrix, registration_type="GICP", max_correspondence_distance=distance,
                max_iterations=50,
            )  # fmt: skip
            matrix, inliers = found.T_target_source, found.num_inliers
        pose = np.array([matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0])])
        return pose, inliers / source.size()

    def _from_odometry(self, first: int, second: int) -> tuple[Float64, float]:
        """As `match`, starting from what odometry says."""
        poses = self._recording.poses
        return self.match(first, second, relative(poses[first], poses[second]), (SAME_WALL_M,))

    def _make_cloud(self, scan: int) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
        flat = walls(self._recording.points_m[scan], self._recording.spans[scan])
        levels = np.repeat(LEVELS_M, len(flat))[:, None]
        cloud = small_gicp.PointCloud(np.hstack([np.tile(flat, (len(LEVELS_M), 1)), levels]))
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=20)
        return cloud, tree


def walls(points_m: Float64, beams: npt.NDArray[np.int64]) -> Float64:
    """Points (n, 2) every 10 cm along the walls that neighbouring beams hit."""
    step = np.diff(points_m, axis=0)
    length = np.hypot(*step.T)
    count = np.where((np.diff(beams) == 1) & (length < SAME_WALL_M), np.ceil(length / SPACING_M), 1).astype(int)
    count = np.maximum(count, 1)
    first = np.repeat(np.arange(count.size), count)
    part = (np.arange(first.size) - np.repeat(np.cumsum(count) - count, count)) / count[first]
    return np.concatenate([points_m[first] + part[:, None] * step[first], points_m[-1:]])


def matched_trajectory(recording: Recording, matcher: Matcher, scans: npt.NDArray[np.int64]) -> Float64:
    """Poses (n, 3) of some scans, each matched to the one before, from odometry."""
    poses = [recording.poses[scans[0]]]
    for before, scan in itertools.pairwise(scans.tolist()):
        found, overlap = matcher.from_odometry(before, scan)
        if overlap < OVERLAP:
            found = relative(recording.poses[before], recording.poses[scan])
        poses.append(moved(poses[-1], found))
    return np.array(poses)


def reproduce(recording: Recording, relations: pd.DataFrame) -> pd.DataFrame:
    """The relations by odometry and by matching, and how far each is off.

    Where little time lies between, matching starts from odometry. Where much does, odometry is metres off: matching
    starts from the trajectory that the matches themselves make, and is believed only where the scans overlap.

    Returns
    -------
    The relations with near, believed, and for `odometry` and `matching` the errors …_m and …_deg.
    """
    matcher = Matcher(recording)
    first, second = recording.at(relations.t1.to_numpy()), recording.at(relations.t2.to_numpy())
    scans = np.unique(np.concatenate([first, second]))
    chain = matched_trajectory(recording, matcher, scans)
    known = chain[np.searchsorted(scans, first)], chain[np.searchsorted(scans, second)]
    odometry = relative(recording.poses[first], recording.poses[second])
    near = (relations.t2 - relations.t1).to_numpy() < NEAR_S
    found = [
        matcher.from_odometry(a, b) if is_near else matcher.match(a, b, guess, (1.0, SAME_WALL_M))
        for a, b, is_near, guess in zip(first.tolist(), second.tolist(), near, relative(*known), strict=True)
    ]
    matching = np.array([pose for pose, _ in found])
    out = relations.assign(near=near, believed=near | (np.array([share for _, share in found]) >= OVERLAP))
    truth = relations[["x", "y", "theta"]].to_numpy()
    for name, poses in (("odometry", odometry), ("matching", matching)):
        out[f"{name}_m"] = np.hypot(*(poses - truth)[:, :2].T)
        out[f"{name}_deg"] = np.degrees(np.abs(wrapped(poses[:, 2] - truth[:, 2])))
    return out


def summary(found: pd.DataFrame) -> pd.DataFrame:
    """Pairs, median and 95 % of the errors."""
    far = ~found.near
    rows = {
        "near, odometry": (found[found.near], "odometry"),
        "near, matching": (found[found.near], "matching"),
        "far, odometry": (found[far], "odometry"),
        "far, matching, believed": (found[far & found.believed], "matching"),
        "far, matching, not believed": (found[far & ~found.believed], "matching"),
    }
    return pd.DataFrame(
        {
            label: [len(part)] + [part[f"{how}_{unit}"].quantile(q) for unit in ("m", "deg") for q in (0.5, 0.95)]
            for label, (part, how) in rows.items()
        },
        index=["pairs", "median_m", "q95_m", "median_deg", "q95_deg"],
    ).T


def main(picture: Path | None) -> None:
    """Print the figures; draw the building."""
    recording = read_recording(SURVEY_FILE)
    print(f"{len(recording.stamps_s):,} scans")
    found = reproduce(recording, read_relations(RELATIONS))
    print(summary(found).to_string(formatters={"pairs": "{:,.0f}".format}, float_format="{:.3f}".format))
    same = (found.odometry_m < 1e-5) & found.near
    print(f"{same.sum()} near relations have the odometry's own translation, to 10 µm")
    if picture is not None:
        survey = Survey.load(SURVEY_FILE)
        draw(Path(Store(survey.store_url, survey.config.id).root), picture)


def draw(products: Path, picture: Path) -> None:
    """Points of the written LAS tiles from above, in cells of 5 cm."""
    import matplotlib.pyplot as plt

    tiles = [laspy.read(file) for file in sorted((products / "tiles" / "las").glob("*.laz"))]
    x, y = (np.concatenate([np.asarray(tile[axis]) for tile in tiles]) for axis in "xy")
    edges = [np.arange(np.floor(v.min()), np.ceil(v.max()) + 0.05, 0.05) for v in (x, y)]
    counts, *_ = np.histogram2d(x, y, edges)
    figure, axes = plt.subplots(figsize=(9, 9 * edges[1].size / edges[0].size + 0.6), layout="constrained")
    shown = np.log1p(counts.T)
    axes.imshow(
        shown, origin="lower", cmap="gray_r", vmax=np.quantile(shown[shown > 0], 0.98),
        extent=(edges[0][0], edges[0][-1], edges[1][0], edges[1][-1]), interpolation="antialiased",
    )  # fmt: skip
    axes.set(xlabel="x (m)", ylabel="y (m)")
    figure.savefig(picture, dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
