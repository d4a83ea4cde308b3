# ruff: noqa: T201
"""Points of the Argoverse 2 drive against the city's own raster of ground heights.

Reads the written LAS tiles with laspy; raster, its transform and the vehicle's track come from the recording.

    python ground_raster.py [PICTURE.png]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
from las_points import read_points

SURVEY = Path("store/survey=av2_7fab2350")
RECORDING = Path("recordings/av2_drive")

GPS_MINUS_UNIX_S = -315_964_800
"""The stamps count from 1970; the survey file calls their scale unix_gps, without leap seconds."""
WITHIN_M = 30.0
GROUND_M = 0.3

Float64 = npt.NDArray[np.float64]


def raster_heights(xy_m: Float64, recording: Path) -> Float64:
    """Heights (n,) of the city's raster at positions (n, 2), NaN where it has none."""
    (sim2,) = (recording / "map").glob("*___img_Sim2_city.json")
    (grid,) = (recording / "map").glob("*_ground_height_surface*.npy")
    transform, heights = json.loads(sim2.read_text()), np.load(grid).astype(float)
    column, row = np.floor(transform["s"] * (xy_m + transform["t"])).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < heights.shape[1]) & (row < heights.shape[0])
    found = np.full(len(xy_m), np.nan)
    found[inside] = heights[row[inside], column[inside]]
    return found


def differences(points: pd.DataFrame, recording: Path) -> pd.DataFrame:
    """Points with `above_m`, their height above the raster, and `distance_m` from the vehicle at their own time."""
    track = pd.read_feather(recording / "city_SE3_egovehicle.feather")
    track_gps_s = track.timestamp_ns.to_numpy() * 1e-9 + GPS_MINUS_UNIX_S
    vehicle = [np.interp(points.gps_s, track_gps_s, track[axis]) for axis in ("tx_m", "ty_m")]
    return points.assign(
        above_m=points.z - raster_heights(points[["x", "y"]].to_numpy(), recording),
        distance_m=np.hypot(points.x - vehicle[0], points.y - vehicle[1]),
    )


def ground(points: pd.DataFrame) -> pd.Series:
    """Heights above the raster of the ground returns: within 30 m of the vehicle and 0.3 m of the raster."""
    return points.above_m[(points.distance_m < WITHIN_M) & (points.above_m.abs() < GROUND_M)]


def deviation(values: pd.Series) -> float:
    """Median absolute deviation from the median, not scaled to a standard deviation."""
    return float((values - values.median()).abs().median())


def main(picture: Path | None) -> None:
    """Print the figures; draw the picture."""
    points = differences(read_points(SURVEY), RECORDING)
    above = ground(points)
    print(f"{len(points):,} points, {points.above_m.notna().sum():,} over the raster, {len(above):,} ground returns")
    print(f"above the raster: median {above.median():+.4f} m, median absolute deviation {deviation(above):.4f} m")
    if picture is not None:
        draw(points.loc[above.index], picture)


def draw(points: pd.DataFrame, picture: Path) -> None:
    """Map and distribution of the differences."""
    import matplotlib.pyplot as plt

    figure, (plan, bars) = plt.subplots(1, 2, figsize=(10, 4.4), width_ratios=[1.5, 1], layout="constrained")
    above_mm = points.above_m * 1000
    shown = plan.scatter(points.x, points.y, s=1, c=above_mm, vmin=-100, vmax=100, cmap="RdBu", linewidths=0)
    plan.set(xlabel="city x (m)", ylabel="city y (m)", aspect="equal", facecolor="0.9")
    plan.ticklabel_format(useOffset=False)
    figure.colorbar(shown, ax=plan, label="height above the city's raster (mm)")
    bars.hist(above_mm, bins=np.arange(-300, 305, 10), color="tab:gray")
    bars.axvline(above_mm.median(), color="tab:red", label=f"median {above_mm.median():.1f} mm")
    bars.set(xlabel="height above the city's raster (mm)", ylabel="ground returns")
    bars.legend()
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
