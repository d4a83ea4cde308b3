"""Writes docs/pictures/cracks.png: what is found on a patch of the simulator's road, beside the truth.

python docs/crack_pictures.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.colors import LightSource

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.bench_cracks import Seen, cracks_of, seen
from roadscan.distress.potholes import join_potholes, pothole_pieces
from roadscan.distress.settings import PotholeDetection, PotholeJoining

PICTURE: Final = Path(__file__).resolve().parent / "pictures" / "cracks.png"
WARM, COOL = "#d1495b", "#00a5b5"
CELL_M, SIZE_M = 0.0025, (2.0, 2.4)
CRACK = {"points_m": [(10.0, 2.35), (10.6, 2.2), (11.3, 2.4), (12.0, 2.3)], "width_m": 0.006, "depth_m": 0.008}
FIELD = {"station_m": 11.0, "offset_m": 1.2, "length_m": 1.4, "width_m": 0.8}
HOLE = {"station_m": 11.45, "offset_m": 1.95, "radius_m": 0.15, "depth_m": 0.04}


def main() -> None:
    """Draw the patch, and over it what was found."""
    mpl.use("Agg")
    one = seen({"cracks": [CRACK], "alligators": [FIELD], "potholes": [HOLE]}, CELL_M, SIZE_M, 1)
    figure, axes = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
    for axis, title in zip(axes, ("before smoothing, shaded", "found: cracks, pothole"), strict=True):
        shade(axis, one, raw=axis is axes[0])
        axis.set_title(title)
        axis.set_xlabel("across the road (m)")
    axes[0].set_ylabel("along the road (m)")
    corner = one.window.map_m(0, 0)
    for crack in cracks_of(one):
        for line in crack.line.geoms:
            axes[1].plot(*(shapely.get_coordinates(line) - corner).T, color=WARM, lw=1.4)
    for hole in join_potholes(pothole_pieces(one.window, PotholeDetection()), PotholeJoining()):
        axes[1].fill(*(shapely.get_coordinates(hole.outline.exterior) - corner).T, fc="none", ec=COOL, lw=1.8)
    figure.savefig(PICTURE, dpi=80, metadata={"Software": "roadscan"})


def shade(axis: Axes, one: Seen, *, raw: bool) -> None:
    """The patch in slanting light."""
    height: Any = one.window.raw_m if raw else one.window.height_m
    known = np.where(np.isnan(height), np.nanmedian(height), height)
    light = LightSource(315, 35).hillshade(known, 3.0, CELL_M, CELL_M)
    axis.imshow(light, cmap="gray", origin="lower", extent=(0, SIZE_M[1], 0, SIZE_M[0]))


if __name__ == "__main__":
    main()
