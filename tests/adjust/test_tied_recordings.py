"""Ties on recordings: two passes of a street by their trajectories, and one drive of a lidar by its planes."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from roadscan.adjust.adjustment import Adjustment, adjust
from roadscan.adjust.observations import KINDS, GaussMarkov, Observations, RunPrior
from roadscan.adjust.places import PassReadings, Place, Track, places_of_overlap
from roadscan.adjust.settings import AdjustmentSettings, PlaceSettings, TieSettings
from roadscan.adjust.tasks.tie_work import Ties, ties_at

GPS_MINUS_UNIX_NS = (18 - 315_964_800) * 10**9


def prior(run: str, epochs: np.ndarray, sigma_m: float, sigma_rad: float = 0.0) -> RunPrior:
    level, turn = GaussMarkov(sigma_m, 60.0), GaussMarkov(sigma_rad, 60.0)
    return RunPrior(run, int(epochs[0]), int(epochs[-1]), (level, level, level, turn, turn, turn))


def pass_track(folder: Path, run: int) -> Track:
    table = pd.read_csv(folder / f"pass{run + 1}_lidar_poses.csv.gz")
    epochs = table["GPSTime"].to_numpy() * 1000 + GPS_MINUS_UNIX_NS
    heading = np.arctan2(np.gradient(table.easting), np.gradient(table.northing))
    columns = (table[name].to_numpy() for name in ("easting", "northing", "altitude"))
    return Track(run, "lidar", epochs, *columns, heading, 0.5, 0.5)


def middle(place: Place, end: int) -> int:
    return (place.traverses[end].first_gps_ns + place.traverses[end].last_gps_ns) // 2


def height_at(track: Track, epoch: int) -> float:
    since = (track.epoch_gps_ns - track.epoch_gps_ns[0]) * 1e-9
    return float(np.interp((epoch - track.epoch_gps_ns[0]) * 1e-9, since, track.height_m))


def lifted(result: Adjustment, run: str, epoch: int) -> float:
    shift, _ = result.corrections(run).at(np.array([epoch]))
    return -float(shift[0, 2])


def test_heights_of_two_passes_agree_where_they_were_not_tied(recordings: Path) -> None:
    """dz has a median of −0.044 m and a standard deviation of 0.027 m where the passes come within 1 m."""
    tracks = [pass_track(recordings / "two_pass", run) for run in (0, 1)]
    settings = PlaceSettings(per_km=100.0, radius_m=0.2, least_overlap_m=0.01, height_apart_m=1.0)
    places = [p for p in places_of_overlap(tracks, settings) if {t.run for t in p.traverses} == {0, 1}]
    assert len(places) > 400
    epochs = np.array([[middle(p, end) for end in (0, -1)] for p in places])
    dz = np.array([height_at(tracks[1], b) - height_at(tracks[0], a) for a, b in epochs.tolist()])
    assert np.median(dz) == pytest.approx(-0.044, abs=0.004)
    assert dz.std() == pytest.approx(0.027, abs=0.004)
    tied, withheld = np.arange(0, dz.size, 2), np.arange(1, dz.size, 2)
    n = tied.size
    partials = np.zeros((n, 2, 6))
    partials[:, :, 2] = [-1.0, 1.0]
    observations = Observations(
        np.full(n, KINDS.index("height_tie"), np.uint8), np.tile(np.array([0, 1], np.int32), (n, 1)), epochs[tied],
        partials, dz[tied], np.full(n, 0.01), np.arange(n), tied,
    )  # fmt: skip
    priors = [prior(f"pass{run + 1}", tracks[run].epoch_gps_ns, 0.03) for run in (0, 1)]
    result = adjust(observations, priors, AdjustmentSettings(mode="vertical", knot_spacing_s=1.0))
    left = np.array(
        [dz[k] + lifted(result, "pass2", epochs[k, 1]) - lifted(result, "pass1", epochs[k, 0]) for k in withheld]
    )
    # Reached: 0.0053 m, of 334 places tied and 334 withheld.
    assert left.std() <= 0.015
    assert np.sqrt(np.mean(left**2)) <= 0.015
    direction = np.zeros((withheld.size, 6))
    direction[:, 2] = 1.0
    sigma = result.sigma_of(0, epochs[withheld, 0], direction)
    assert np.isfinite(sigma).all()
    assert 0.001 < np.median(sigma) < 0.03


IMU_FROM_VELO = np.array([[9.999976e-01, -7.854027e-04, 2.024406e-03],
                          [7.553071e-04, 9.998898e-01, 1.482454e-02],
                          [-2.035826e-03, -1.482298e-02, 9.998881e-01]])  # fmt: skip
VELO_OF_IMU_M = np.array([-0.8086759, 0.3195559, -0.7997231])
ROAD_BELOW_IMU_M = 0.93
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NED_FROM_LOCAL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class KittiDrive:
    """The recording, its returns within 25 m placed by SciPy at their own epochs; the head turns clockwise."""

    def __init__(self, folder: Path, unpacked: Path) -> None:
        with tarfile.open(folder / "velodyne_points.tar.xz") as archive:
            archive.extraction_filter = getattr(tarfile, "data_filter", None)  # from Python 3.11.4
            archive.extractall(unpacked)
        poses = pd.read_csv(folder / "poses.csv")
        self.stamp_s = poses.unix_utc_s.to_numpy() - poses.unix_utc_s[0]
        columns = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        self.rotation = Rotation.from_matrix(poses[columns].to_numpy().reshape(-1, 3, 3))
        self.position_m = poses[["t1", "t2", "t3"]].to_numpy()
        parts = [self._sweep(file) for file in sorted((unpacked / "velodyne_points/data").glob("*.bin"))]
        self.sweep, self.since_s, self.imu_m = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(self.since_s, kind="stable")
        self.sweep, self.since_s, self.imu_m = self.sweep[order], self.since_s[order], self.imu_m[order]
        self.place_m = self.placed(np.zeros((len(order), 3)), np.zeros((len(order), 3)))

    def _sweep(self, file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        velo = np.fromfile(file, "<f4").reshape(-1, 4)[:, :3].astype(float)
        velo = velo[(np.hypot(velo[:, 0], velo[:, 1]) < 25.0) & velo.any(axis=1)]
        frame = int(file.stem)
        since = self.stamp_s[frame] - 0.1035 * np.arctan2(velo[:, 1], velo[:, 0]) / (2 * np.pi)
        known = (since > self.stamp_s[0]) & (since < self.stamp_s[-1])
        imu = (velo - VELO_OF_IMU_M) @ IMU_FROM_VELO.T
        return np.full(known.sum(), frame), since[known], imu[known]

    @property
    def epochs(self) -> np.ndarray:
        """GPS time of the poses, from a second of its own."""
        return 10**18 + np.rint(self.stamp_s * 1e9).astype(np.int64)

    def placed(self, north_east_down_m: np.ndarray, turn_rad: np.ndarray) -> np.ndarray:
        """Places (n, 3) of the returns with corrections (n, 3), (n, 3) at their epochs."""
        turned = Rotation.from_rotvec(turn_rad @ FRD_FROM_FLU).apply(self.imu_m)
        position = CubicSpline(self.stamp_s, self.position_m)(self.since_s)
        local: np.ndarray = Slerp(self.stamp_s, self.rotation)(self.since_s).apply(turned) + position
        return local + north_east_down_m @ NED_FROM_LOCAL

    def spread(self, place_m: np.ndarray, boxes: pd.DataFrame) -> tuple[float, float]:
        """Median standard deviation between sweeps of road cells of 0.2 m, of the sample and of the population."""
        ahead, left, up = self.rotation[self.sweep].inv().apply(self.place_m - self.position_m[self.sweep]).T
        road = (ahead >= 2) & (ahead <= 15) & (np.abs(left) <= 5) & (np.abs(up + ROAD_BELOW_IMU_M) <= 0.3)
        velo = self.imu_m @ IMU_FROM_VELO + VELO_OF_IMU_M
        for frame, own in boxes.groupby("frame"):
            which = np.flatnonzero(road & (self.sweep == frame))
            for box in own.itertuples():
                away = velo[which] - [box.x_velo_m, box.y_velo_m, box.z_velo_m]
                c, s = np.cos(box.yaw_velo_rad), np.sin(box.yaw_velo_rad)
                along, across = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
                inside = (np.abs(along) <= box.length_m / 2) & (np.abs(across) <= box.width_m / 2)
                road[which[inside & (np.abs(away[:, 2]) <= box.height_m / 2)]] = False
        cell = np.floor(place_m[road, :2] / 0.2).astype(int)
        table = pd.DataFrame({"c": cell[:, 0], "r": cell[:, 1], "f": self.sweep[road], "z": place_m[road, 2]})
        of_cell = table.groupby(["c", "r", "f"]).z.mean().groupby(["c", "r"])
        many = of_cell.count() >= 3
        assert many.sum() > 15_000
        return float(of_cell.std(ddof=1)[many].median()), float(of_cell.std(ddof=0)[many].median())


def drive_ties(drive: KittiDrive) -> Ties:
    """Ties of planes within the drive, at a place each 10 m."""
    epochs, level = drive.epochs, NED_FROM_LOCAL @ drive.rotation.as_matrix() @ FRD_FROM_FLU
    forward = drive.rotation.as_matrix()[:, :, 0]
    road = drive.position_m - [0.0, 0.0, ROAD_BELOW_IMU_M]
    heading = np.arctan2(forward[:, 0], forward[:, 1])
    track = Track(0, "velodyne", epochs, *road.T, heading, 10.0, 10.0, ahead_m=18.0)
    pose = np.searchsorted((drive.stamp_s[1:] + drive.stamp_s[:-1]) / 2, drive.since_s).astype(np.int32)
    parts = []
    for place in places_of_overlap([track], PlaceSettings()):
        away = np.abs(drive.place_m[:, :2] - [place.easting_m, place.northing_m]).max(axis=1)
        (near,) = np.nonzero(away < place.radius_m)
        readings = PassReadings(
            0, "velodyne", *drive.place_m[near].T, np.zeros(near.size, np.uint16), pose[near], epochs,
            drive.position_m, level, laser=np.zeros(near.size, np.uint8),
        )  # fmt: skip
        parts.append(ties_at(place, [readings], TieSettings()))
    return Ties.joined(parts)


@pytest.mark.nightly
def test_ties_within_a_drive_halve_the_spread_between_its_sweeps(recordings: Path, tmp_path: Path) -> None:
    """Recorded poses: 0.0291 m (sample) and 0.0256 m (population) on road cells."""
    folder = recordings / "kitti_drive"
    drive, boxes = KittiDrive(folder, tmp_path), pd.read_csv(folder / "boxes.csv")
    before = drive.spread(drive.place_m, boxes)
    assert before == pytest.approx((0.0291, 0.0256), abs=2e-3)
    ties = drive_ties(drive)
    result = adjust(ties.counted(), [prior("drive", drive.epochs, 0.1, 2e-3)], AdjustmentSettings(knot_spacing_s=0.3))
    shift, turn = result.corrections("drive").at(10**18 + np.rint(drive.since_s * 1e9).astype(np.int64))
    after = drive.spread(drive.placed(shift, turn), boxes)
    # Reached: 0.0097 m and 0.0086 m.
    assert after[0] < 0.5 * before[0]
    assert after[1] < 0.5 * before[1]
