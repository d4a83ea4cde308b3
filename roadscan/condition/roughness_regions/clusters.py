"""Connected dim cells of the intensity raster, and their hulls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.condition.roughness_regions.raster import IntensityRaster
from roadscan.core.extras import cv2

_EDGE_CELLS: Final = 3
"""Largest movement of a cluster's edge outward to halfway between its intensity and that of the road."""


@dataclass(frozen=True, eq=False)
class Cluster:
    """Cells that are connected over edges and corners."""

    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]

    def area_m2(self, raster: IntensityRaster) -> float:
        """Return the area of the cells."""
        return float(self.rows.size * raster.cell_m**2)

    def hull(self, raster: IntensityRaster, edge_intensity: float | None = None) -> shapely.Polygon:
        """Return the convex hull of the cells in the frame of the raster (m).

        edge_intensity : its corners lie where the local mean, linear from centre to centre, has this intensity.
        """
        if edge_intensity is None:
            ends = [np.column_stack([self.columns + a, self.rows + b]) for a in (0.0, 1.0) for b in (0.0, 1.0)]
        else:
            ends = list(self._ends(raster, edge_intensity))
        return shapely.convex_hull(shapely.MultiPoint(raster.corner_m + raster.cell_m * np.concatenate(ends)))

    def _ends(self, raster: IntensityRaster, edge: float) -> Iterator[npt.NDArray[np.float64]]:
        """Return places (n, 2), in cells, where the cluster ends on each of four sides."""
        own = np.pad(np.zeros(raster.values.shape, bool), 1)
        own[self.rows + 1, self.columns + 1] = True
        value = np.pad(raster.local_mean, 1, constant_values=np.nan)
        for side in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            beyond = (self.rows + 1 + side[0], self.columns + 1 + side[1])
            last = ~own[beyond]
            outer, inner = value[beyond][last], value[self.rows + 1, self.columns + 1][last]
            crossed = outer > edge  # not where nothing was measured beyond
            way = np.where(crossed, (edge - inner) / np.where(crossed, outer - inner, 1.0), 0.5)
            yield np.column_stack([self.columns[last] + 0.5 + way * side[1], self.rows[last] + 0.5 + way * side[0]])

    def at_half(self, raster: IntensityRaster, intensity: float) -> Cluster:
        """Return the cluster with its edge where the local mean has an intensity, at most three cells farther out.

        It stays as it is if none is left.
        """
        top, left = max(int(self.rows.min()) - _EDGE_CELLS, 0), max(int(self.columns.min()) - _EDGE_CELLS, 0)
        bottom, right = int(self.rows.max()) + _EDGE_CELLS + 1, int(self.columns.max()) + _EDGE_CELLS + 1
        values = raster.local_mean[top:bottom, left:right]
        mask = np.zeros(values.shape, np.uint8)
        mask[self.rows - top, self.columns - left] = 1
        edge = 2 * _EDGE_CELLS + 1
        wide = cv2.dilate(mask, np.ones((edge, edge), np.uint8)).astype(bool)
        rows, columns = np.nonzero(wide & (values <= intensity))
        return Cluster(rows + top, columns + left) if rows.size else self


def clusters_of(
    raster: IntensityRaster, dim_below: int, least_area_m2: float, among: Sequence[Cluster] | None = None
) -> tuple[list[Cluster], int]:
    """Return clusters of cells up to an 8-bit value, from the first row on, and the number of those below an area.

    among : clusters; only their cells are used.
    """
    dim = raster.measured & (raster.values <= dim_below)
    if among is not None:
        asked = np.zeros(dim.shape, bool)
        for one in among:
            asked[one.rows, one.columns] = True
        dim &= asked
    count, label, stats, _ = cv2.connectedComponentsWithStats(dim.astype(np.uint8), connectivity=8)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] * raster.cell_m**2 >= least_area_m2)
    found = []
    for k in large[large > 0].tolist():
        left, top, width, height = (int(v) for v in stats[k, :4])
        rows, columns = np.nonzero(label[top : top + height, left : left + width] == k)
        found.append(Cluster(rows + top, columns + left))
    return found, count - 1 - len(found)
