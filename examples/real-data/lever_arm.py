# ruff: noqa: T201
"""The lever arm between lidar and radar of the Boreas vehicle, and the heights of its two passes.

Both follow from ingested poses alone, interpolated by roadscan.

    python lever_arm.py [PICTURE.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.spatial import KDTree

from roadscan.core.survey import Survey
from roadscan.ingest.ingest import survey_records
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_trajectory
from roadscan.poses.trajectory import Trajectory
from roadscan.store.store import Store

SURVEY_FILE = Path("two_pass.toml")
MAX_GAP_S = 1.0

Float64 = npt.NDArray[np.float64]


def trajectory_of(run: str, survey_file: Path) -> Trajectory:
    """The trajectory of a run, as it lies in the store."""
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    (record,) = (r for r in survey_records(survey, store) if r.run == run)
    files = record.tables["trajectory"]
    source = TrajectorySource(run, record.attributes["world_frame"], files)
    return load_trajectory(store, source, [f.span for f in files if f.span], MAX_GAP_S)


def lever_arms(lidar: Trajectory, other: Trajectory) -> pd.DataFrame:
    """The other sensor as seen from the lidar at each of its own epochs.

    Returns
    -------
    gps_s, forward_m, right_m, down_m (body axes of the lidar) and length_m, where the lidar has a pose.
    """
    poses = lidar.poses(other.epochs_gps_ns)
    apart = other.position_world_m[poses.found] - poses.position_world_m[poses.found]
    arm = np.einsum("nij,ni->nj", poses.world_from_body[poses.found], apart)
    columns = dict(zip(("forward_m", "right_m", "down_m"), arm.T, strict=True))
    gps_s = other.epochs_gps_ns[poses.found] * 1e-9
    return pd.DataFrame({"gps_s": gps_s} | columns | {"length_m": np.linalg.norm(arm, axis=1)})


def height_differences(first: Trajectory, second: Trajectory, survey_file: Path, within_m: float = 1.0) -> Float64:
    """Height of the second pass above the first (n,) where its poses come within `within_m` of the first's."""
    frame = Survey.load(survey_file).frame()
    a, b = (frame.map_from_world(t.world, t.position_world_m) for t in (first, second))
    distance, nearest = KDTree(a[:, :2]).query(b[:, :2])
    close = distance < within_m
    heights: Float64 = b[close, 2] - a[nearest[close], 2]
    return heights


def main(picture: Path | None) -> None:
    """Print the figures; draw the picture."""
    lidar, radar, second = (trajectory_of(run, SURVEY_FILE) for run in ("pass1_lidar", "pass1_radar", "pass2_lidar"))
    arms = lever_arms(lidar, radar)
    worst = (arms.length_m - 0.21).abs().max()
    print(f"{len(arms):,} of {len(radar.epochs_gps_ns):,} radar poses lie inside the lidar's trajectory")
    print(f"lever arm {arms.length_m.mean():.4f} m, standard deviation {1000 * arms.length_m.std():.3f} mm, "
          f"worst {1000 * worst:.2f} mm off 0.21 m")  # fmt: skip
    mean = arms[["forward_m", "right_m", "down_m"]].mean()
    print(f"forward {mean.forward_m:+.5f}, right {mean.right_m:+.5f}, down {mean.down_m:+.5f} m from the lidar")
    dz = height_differences(lidar, second, SURVEY_FILE)
    print(f"{len(dz):,} poses of the second pass within 1 m of the first: dz median {np.median(dz):+.4f} m, "
          f"standard deviation {dz.std():.4f} m")  # fmt: skip
    if picture is not None:
        draw(arms, dz, picture)


def draw(arms: pd.DataFrame, dz: Float64, picture: Path) -> None:
    """Length of the lever arm over the drive, and the heights between the passes."""
    import matplotlib.pyplot as plt

    figure, (time, bars) = plt.subplots(1, 2, figsize=(10, 3.4), width_ratios=[2, 1], layout="constrained")
    time.plot(arms.gps_s - arms.gps_s.iloc[0], (arms.length_m - 0.21) * 1000, ".", markersize=2, color="tab:blue")
    time.set(xlabel="time (s)", ylabel="lever arm − 210 mm (mm)", ylim=(-1.3, 1.3))
    bars.hist(dz * 1000, bins=60, color="tab:gray")
    bars.set(xlabel="second pass above first (mm)", ylabel="poses within 1 m")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
