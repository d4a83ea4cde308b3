# ruff: noqa: T201
"""A vendor's LAS file against the LAS tiles made of it: every point, every recorded field, with laspy.

python round_trip.py [PICTURE.png]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import laspy
import numpy as np
import pandas as pd

ORIGINAL = Path("unpacked/strips.las")
SURVEY = Path("store/survey=strips")

SCAN_ANGLE_STEP_DEG = 0.006
"""Unit of scan_angle in point formats 6 and up; older formats record whole degrees."""
AS_RECORDED = (
    "intensity", "return_number", "number_of_returns", "scan_direction_flag", "edge_of_flight_line", "classification",
    "synthetic", "key_point", "withheld", "user_data", "gps_time", "red", "green", "blue",
)  # fmt: skip


def recorded(path: Path, steps: Mapping[str, float]) -> pd.DataFrame:
    """Points of a LAS file as the vendor recorded them.

    Parameters
    ----------
    steps : the resolution to which the vendor recorded x, y and z, in the file's unit.

    Returns
    -------
    Coordinates as whole steps, scan angle in whole degrees, the vendor's source number, all else as it is.
    """
    cloud = laspy.read(path)
    names = set(cloud.point_format.dimension_names)
    columns = {axis: np.rint(np.asarray(cloud[axis]) / step).astype(np.int64) for axis, step in steps.items()}
    columns |= {name: np.asarray(cloud[name]) for name in AS_RECORDED if name in names}
    if "scan_angle" in names:
        columns["scan_angle_deg"] = np.rint(np.asarray(cloud.scan_angle) * SCAN_ANGLE_STEP_DEG).astype(np.int64)
    else:
        columns["scan_angle_deg"] = np.asarray(cloud.scan_angle_rank).astype(np.int64)
    own = "recorded_source_id" if "recorded_source_id" in names else "point_source_id"
    columns["source_id"] = np.asarray(cloud[own])
    return pd.DataFrame(columns)


def in_order(points: pd.DataFrame) -> pd.DataFrame:
    """Points sorted by all their fields: tiles hold them in another order than the file."""
    return points.sort_values(list(points.columns), ignore_index=True)


def differences(original: pd.DataFrame, made: pd.DataFrame) -> dict[str, int]:
    """How many points differ, by field; both tables sorted."""
    return {name: int((original[name] != made[name]).sum()) for name in original.columns}


def main(picture: Path | None) -> None:
    """Print the comparison; draw the picture."""
    with laspy.open(ORIGINAL) as file:
        header = file.header
    steps = dict(zip("xyz", header.scales, strict=True))
    original = in_order(recorded(ORIGINAL, steps))
    tiles = sorted(SURVEY.glob("tiles/las/*.laz"))
    made = in_order(pd.concat([recorded(path, steps) for path in tiles], ignore_index=True))
    print(f"{len(original):,} points in the file, {len(made):,} in {len(tiles)} tiles")
    print(f"points that differ: {differences(original, made)}")
    print(f"source numbers: {sorted(int(n) for n in made.source_id.unique())}")
    if picture is not None:
        draw(made, steps, picture)


def draw(points: pd.DataFrame, steps: Mapping[str, float], picture: Path) -> None:
    """The tiles' points from above: by height, and by the vendor's source number."""
    import matplotlib.pyplot as plt

    figure, (heights, strips) = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    x, y, z = (points[axis] * steps[axis] for axis in "xyz")
    x, y = x - x.min(), y - y.min()
    shown = heights.scatter(x, y, s=1.5, c=z, cmap="viridis", linewidths=0)
    figure.colorbar(shown, ax=heights, label="z (in the file's unit)")
    for number, own in points.groupby("source_id"):
        strips.plot(x[own.index], y[own.index], ".", markersize=0.8, label=str(number))
    strips.legend(title="source", markerscale=10)
    heights.set(ylabel="y")
    for axes in (heights, strips):
        axes.set(xlabel="x (in the file's unit, from its corner)", aspect="equal", facecolor="0.95")
    figure.savefig(picture, dpi=75)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
