"""The filter test through the command line: a sample as a LAS file, and the classes that `roadscan run` wrote of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt

from roadscan.assets import classes

CORNER_M = (500_017.0, 5_400_011.0, 200.0)
_FIRST_S, _STEP_S = 200_000_000.0, 0.001
_SURVEY = """
id = "sample"

[map]
crs = "EPSG:32632"

[defaults]
height = "ellipsoidal"

[tiles]
cell_m = 0.5
size_m = 40.0

[products]
make = []

[[runs]]
id = "flight"
logs = [{ path = "sample.las", format = "las", crs = "EPSG:32632" }]
"""
_NO_KINDS = """
[assets]
kinds = []
"""


def classified(points: npt.NDArray[np.float64], folder: Path, settings: str = "") -> npt.NDArray[np.uint8]:
    """Class (n,) of each point of a cloud (n, 3), from the classified points of a run; stamps tell which is which."""
    run_cloud(points, folder, _NO_KINDS + settings)
    found = np.full(len(points), classes.UNCLASSIFIED, np.uint8)
    for file in folder.rglob("classified_points/*.laz"):
        read = laspy.read(file)
        found[np.rint((read.gps_time - _FIRST_S) / _STEP_S).astype(np.int64)] = np.asarray(read.classification)
    return found


def run_cloud(points: npt.NDArray[np.float64], folder: Path, settings: str) -> None:
    """Write a cloud (n, 3) as a LAS file without a trajectory, its corner at `CORNER_M`, and run its survey."""
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.scales, las.header.offsets = [0.001] * 3, list(CORNER_M)
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.x, las.y, las.z = (points + CORNER_M).T
    las.gps_time = _FIRST_S + _STEP_S * np.arange(len(points))
    las.return_number[:] = las.number_of_returns[:] = 1
    las.write(folder / "sample.las")
    (folder / "SURVEY.toml").write_text(_SURVEY + settings)
    subprocess.run([sys.executable, "-m", "roadscan", "run", "SURVEY.toml"], cwd=folder, check=True)
