# ruff: noqa: T201
"""How well the scans of the KITTI drive agree on the road, and how many returns hit labelled road users.

Reads the written LAS tiles with laspy and compares them with the recording's own poses and boxes. From
roadscan it takes nothing, so poses are interpolated here by SciPy.

    python road_cells.py [PICTURE.png]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
from las_points import read_points
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr
from scipy.spatial.transform import Rotation, Slerp

SURVEY = Path("store/survey=kitti_0005")
RECORDING = Path("recordings/kitti_drive")
SWEEPS = Path("unpacked/kitti_drive/velodyne_points/data")

GPS_MINUS_UNIX_S = 15 - 315_964_800
"""GPS time minus POSIX time: 15 leap seconds in 2011, and 1980-01-06."""
CELL_M = 0.2
ROAD_BELOW_IMU_M = 0.93
"""Height of the IMU above the road (Geiger et al. 2013, figure 3)."""
VELO_FROM_IMU = np.array([[9.999976e-01, 7.553071e-04, -2.035826e-03],
                          [-7.854027e-04, 9.998898e-01, -1.482298e-02],
                          [2.024406e-03, 1.482454e-02, 9.998881e-01]])  # fmt: skip
IMU_IN_VELO_M = np.array([-0.8086759, 0.3195559, -0.7997231])

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """The recording: poses of the IMU, stamps of the sweeps, labelled boxes."""

    recording: Path
    sweeps: Path

    @cached_property
    def poses(self) -> pd.DataFrame:
        """A row a scan of the drive."""
        return pd.read_csv(self.recording / "poses.csv")

    @cached_property
    def gps_s(self) -> Float64:
        """(154,) stamps of all scans."""
        return self.poses.unix_utc_s.to_numpy() + GPS_MINUS_UNIX_S

    @cached_property
    def rotation(self) -> Rotation:
        """(154,) local frame from IMU."""
        columns = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        return Rotation.from_matrix(self.poses[columns].to_numpy().reshape(-1, 3, 3))

    @cached_property
    def position_m(self) -> Float64:
        """(154, 3) IMU in the local frame."""
        return self.poses[["t1", "t2", "t3"]].to_numpy()

    @cached_property
    def boxes(self) -> pd.DataFrame:
        """A row a labelled road user and scan."""
        return pd.read_csv(self.recording / "boxes.csv")

    @cached_property
    def frames(self) -> npt.NDArray[np.int64]:
        """Numbers of the recorded sweeps: every third scan."""
        return np.array(sorted(int(path.stem) for path in self.sweeps.glob("*.bin")))


def locate(points: pd.DataFrame, drive: Drive) -> pd.DataFrame:
    """Points with their sweep, and where they lie as seen from the car and from the laser scanner.

    Adds frame (the sweep with the nearest stamp), ahead_m, left_m, above_road_m (axes of the IMU at the sweep's
    stamp, above the plane on which the car stands), and velo_x_m, velo_y_m, velo_z_m: the coordinates that the
    scanner measured, got back with the pose at the point's own time.
    """
    stamps = drive.gps_s[drive.frames]
    frame = drive.frames[np.searchsorted((stamps[1:] + stamps[:-1]) / 2, points.gps_s)]
    map_m = points[["x", "y", "z"]].to_numpy()
    at_stamp = drive.rotation[frame].inv().apply(map_m - drive.position_m[frame])
    own_rotation = Slerp(drive.gps_s, drive.rotation)(points.gps_s)
    own_position = CubicSpline(drive.gps_s, drive.position_m)(points.gps_s)
    velo = own_rotation.inv().apply(map_m - own_position) @ VELO_FROM_IMU.T + IMU_IN_VELO_M
    return points.assign(
        frame=frame,
        ahead_m=at_stamp[:, 0],
        left_m=at_stamp[:, 1],
        above_road_m=at_stamp[:, 2] + ROAD_BELOW_IMU_M,
        velo_x_m=velo[:, 0],
        velo_y_m=velo[:, 1],
        velo_z_m=velo[:, 2],
    )


def box_of(velo_m: Float64, boxes: pd.DataFrame) -> npt.NDArray[np.int64]:
    """Index (n,) of the box of `boxes` (one scan's) that holds each point (n, 3), −1 where none does."""
    found = np.full(len(velo_m), -1)
    for box in boxes.itertuples():
        x, y, z = (velo_m - [box.x_velo_m, box.y_velo_m, box.z_velo_m]).T
        c, s = np.cos(box.yaw_velo_rad), np.sin(box.yaw_velo_rad)
        along, across = c * x + s * y, c * y - s * x
        inside = (np.abs(along) <= box.length_m / 2) & (np.abs(across) <= box.width_m / 2)
        found[inside & (np.abs(z) <= box.height_m / 2)] = box.Index
    return found


def label(points: pd.DataFrame, drive: Drive) -> pd.DataFrame:
    """Located points with `box`: the row of the drive's boxes that holds each, −1 where none does."""
    box = np.full(len(points), -1)
    velo = points[["velo_x_m", "velo_y_m", "velo_z_m"]].to_numpy()
    for frame, rows in points.groupby("frame").indices.items():
        box[rows] = box_of(velo[rows], drive.boxes[drive.boxes.frame == frame])
    return points.assign(box=box)


def recorded_in_boxes(drive: Drive) -> pd.DataFrame:
    """The boxes of the recorded sweeps with `returns`, counted in the raw files, and `distance_m`."""
    boxes = drive.boxes[drive.boxes.frame.isin(drive.frames)]
    counts = np.zeros(len(drive.boxes), dtype=int)
    for frame in drive.frames:
        xyz = np.fromfile(drive.sweeps / f"{frame:010d}.bin", "<f4").reshape(-1, 4)[:, :3].astype(float)
        box = box_of(xyz, boxes[boxes.frame == frame])
        counts += np.bincount(box[box >= 0], minlength=len(counts))
    return boxes.assign(returns=counts[boxes.index], distance_m=np.hypot(boxes.x_velo_m, boxes.y_velo_m))


def beside_car(points: pd.DataFrame) -> pd.Series:
    """Which points lie 2–15 m ahead of the IMU and within 5 m to the left and right of it."""
    return points.ahead_m.between(2, 15) & points.left_m.between(-5, 5)


def is_road(points: pd.DataFrame) -> pd.Series:
    """Which points are road: beside the car, in no labelled box, within 0.3 m of the plane the car stands on."""
    return beside_car(points) & (points.box < 0) & points.above_road_m.between(-0.3, 0.3)


def cell_heights(points: pd.DataFrame) -> pd.DataFrame:
    """Mean height `z` of each cell in each sweep: column, row, frame, z."""
    cell = {name: np.floor(points[axis] / CELL_M).astype(int) for name, axis in (("column", "x"), ("row", "y"))}
    return points.assign(**cell).groupby(["column", "row", "frame"], as_index=False).z.mean()


def cell_spread(heights: pd.DataFrame) -> pd.DataFrame:
    """Cells that three sweeps or more have seen: column, row, sweeps, and the spread of their heights.

    `std_m` is the sample standard deviation between sweeps (divided by n − 1), `std_population_m` the
    population's (divided by n).
    """
    of_cell = heights.groupby(["column", "row"]).z
    spread = pd.DataFrame({"sweeps": of_cell.count(), "std_m": of_cell.std(ddof=1)}).query("sweeps >= 3")
    return spread.assign(std_population_m=spread.std_m * np.sqrt(1 - 1 / spread.sweeps)).reset_index()


def height_drift(heights: pd.DataFrame) -> pd.Series:
    """One constant height a sweep (m, by frame, mean 0) that lets the sweeps agree best on their common cells.

    Least squares of z = height of the cell + constant of the sweep: what the poses' heights swim by.
    """
    cell = heights.groupby(["column", "row"]).ngroup().to_numpy()
    frames, sweep = np.unique(heights.frame, return_inverse=True)
    rows, cells = np.arange(len(heights)), cell.max() + 1
    design = csr_array(
        (np.ones(2 * len(rows)), (np.tile(rows, 2), np.concatenate([cell, cells + sweep]))),
        shape=(len(rows), cells + len(frames)),
    )
    drift = lsqr(design, heights.z.to_numpy(), atol=1e-10, btol=1e-10, iter_lim=5000)[0][cells:]
    return pd.Series(drift - drift.mean(), index=frames)


def main(picture: Path | None) -> None:
    """Print the figures; draw the picture."""
    drive = Drive(RECORDING, SWEEPS)
    points = label(locate(read_points(SURVEY), drive), drive)
    print_boxes(points, drive)
    beside = beside_car(points)
    print(f"2-15 m ahead, 5 m to each side: {beside.sum():,} points, {(beside & (points.box >= 0)).sum():,} in boxes")
    heights = cell_heights(points[is_road(points)])
    drift = height_drift(heights)
    print("median standard deviation between sweeps (and the population's):")
    print_spread("road: in no box, 0.3 m from the plane", heights)
    print_spread("in no box, at any height", cell_heights(points[beside & (points.box < 0)]))
    print_spread("everything", cell_heights(points[beside]))
    print_spread("road, less one constant a sweep", heights.assign(z=heights.z - heights.frame.map(drift)))
    print(f"constants of the sweeps: {drift.min():+.2f} to {drift.max():+.2f} m")
    if picture is not None:
        draw(points, cell_spread(heights), drift, drive, picture)


def print_boxes(points: pd.DataFrame, drive: Drive) -> None:
    """How many returns hit labelled road users, in the recording and in the tiles."""
    raw = recorded_in_boxes(drive)
    near = raw[(raw.frame % 15 == 0) & (raw.distance_m < 40)].returns
    whole = drive.frames[1:-1]
    recorded = raw[raw.frame.isin(whole)].returns.sum()
    written = (points.frame.isin(whole) & (points.box >= 0)).sum()
    print(f"recording: {raw.returns.sum():,} returns in {len(raw)} labelled boxes")
    print(f"  every 15th scan, within 40 m: {len(near)} boxes, {100 * (near > 20).mean():.0f} % hold more than 20")
    print(f"  their median: {near.median():.0f} returns")
    print(f"LAS tiles: {len(points):,} points, {(points.box >= 0).sum():,} in boxes")
    print(f"  sweeps {whole[0]} to {whole[-1]}: {written:,} in boxes, recorded {recorded:,}")


def print_spread(name: str, heights: pd.DataFrame) -> None:
    """One line of the comparison."""
    cells = cell_spread(heights)
    median = f"{cells.std_m.median():.4f} m ({cells.std_population_m.median():.4f} m)"
    print(f"  {name:38s} {len(cells):,} cells  {median}")


def draw(points: pd.DataFrame, cells: pd.DataFrame, drift: pd.Series, drive: Drive, picture: Path) -> None:
    """Map of the road cells with the labelled road users, distribution of the spread, drift of the poses."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplot_mosaic([["plan", "plan"], ["bars", "drift"]], figsize=(9, 6.6), height_ratios=[1.35, 1])
    plan, bars, swim = axes["plan"], axes["bars"], axes["drift"]
    image = np.full((cells.row.max() - cells.row.min() + 1, cells.column.max() - cells.column.min() + 1), np.nan)
    image[cells.row - cells.row.min(), cells.column - cells.column.min()] = cells.std_m * 1000
    west, south = cells.column.min() * CELL_M, cells.row.min() * CELL_M
    extent = (west, west + image.shape[1] * CELL_M, south, south + image.shape[0] * CELL_M)
    users = points[points.box >= 0].iloc[::5]
    shown = plan.imshow(image, origin="lower", extent=extent, vmin=0, vmax=150, cmap="viridis", interpolation="none")
    plan.plot(users.x, users.y, ",", color="tab:red", alpha=0.5)
    plan.plot(*drive.position_m[:, :2].T, color="black", linewidth=1)
    plan.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=extent[:2], ylim=extent[2:])
    plan.set_title("road cells of 0.2 m; red: returns in labelled boxes; black: the car")
    figure.colorbar(shown, ax=plan, label="standard deviation\nbetween sweeps (mm)", shrink=0.7)
    bars.hist(cells.std_m * 1000, bins=np.arange(0, 205, 5), color="tab:gray")
    bars.axvline(cells.std_m.median() * 1000, color="tab:red", label=f"median {cells.std_m.median() * 1000:.1f} mm")
    bars.set(xlabel="standard deviation between sweeps (mm)", ylabel="cells")
    bars.legend()
    swim.plot(drive.gps_s[drift.index] - drive.gps_s[0], drift, ".-", color="tab:blue")
    swim.set(xlabel="time (s)", ylabel="height constant of the sweep (m)")
    figure.tight_layout()
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
