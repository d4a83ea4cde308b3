"""Filters points by their distance from a road's centre line.

The extent kept beside a centre line is half the road's width and a margin "in order to accommodate the roadside
landscape, pavement and other features of interest" (Sairam, Nagarajan, Ornitz 2016, 3.3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class CentreLineBuffer:
    """The area within a distance of centre lines."""

    lines: npt.NDArray[np.object_]
    """(n,) Shapely lines, easting and northing (m)."""
    half_widths_m: Float64
    """(n,) distance from each line that is kept."""

    def keeps(self, easting_m: Float64, northing_m: Float64, box_m: Box) -> Bool:
        """Return which points (n,) of one tile lie in the area; `box_m` is the tile's west, south, east, north edge.

        The rounding of ends and corners departs from a circle by less than 0.13 % of the half width (16 chords a
        quarter). Only lines near the tile are widened, so the cost does not grow with the layer.
        """
        tile = shapely.box(*box_m)
        near = np.sort(self._tree.query(tile))
        if not near.size:
            return np.zeros(easting_m.size, dtype=bool)
        area = shapely.union_all(shapely.buffer(self.lines[near], self.half_widths_m[near], quad_segs=16))
        if area.contains(tile):
            return np.ones(easting_m.size, dtype=bool)
        part = area.intersection(tile)
        shapely.prepare(part)
        inside: Bool = shapely.intersects_xy(part, easting_m, northing_m)
        return inside

    @cached_property
    def _tree(self) -> shapely.STRtree:
        """Spatial index of the boxes of the widened lines."""
        bounds = shapely.bounds(self.lines) + self.half_widths_m[:, None] * np.array([-1.0, -1.0, 1.0, 1.0])
        return shapely.STRtree(shapely.box(*bounds.T))
