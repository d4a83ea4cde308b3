"""Centre-line buffer: only points near a road's centre line are kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyogrio
import shapely
from shapely.geometry.base import BaseGeometry

from roadscan.model.crs import MapFrame, crs_from_text
from roadscan.model.errors import ConfigError, CrsError


@dataclass(frozen=True)
class CentreLineBuffer:
    """Ground within a distance of centre lines, as a polygon of the map frame (m)."""

    area: BaseGeometry

    @classmethod
    def load(cls, path: Path, buffer_m: float, frame: MapFrame) -> CentreLineBuffer:
        """Read the lines of a vector layer and widen them by `buffer_m` on each side.

        The rounding of corners departs from a circle by less than 0.13 % of the buffer (16 chords a quarter).
        """
        try:
            layer = pyogrio.read_dataframe(path)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise ConfigError(f"the centre lines cannot be read: {error}", file=path) from error
        if frame.crs is not None:
            if layer.crs is None:
                raise CrsError("the centre lines state no CRS", expected="a layer with a CRS", file=path)
            layer = layer.to_crs(crs_from_text(frame.crs))
        lines = shapely.transform(layer.geometry.to_numpy(), lambda xy: xy * frame.horizontal_unit_m)
        lines = lines[~shapely.is_missing(lines) & ~shapely.is_empty(lines)]
        if lines.size == 0:
            raise ConfigError("the layer has no centre lines", expected="at least one line", file=path)
        return cls(shapely.union_all(shapely.buffer(lines, buffer_m, quad_segs=16)))

    def keeps(
        self, easting_m: npt.NDArray[np.float64], northing_m: npt.NDArray[np.float64],
        box_m: tuple[float, float, float, float],
    ) -> npt.NDArray[np.bool_]:  # fmt: skip
        """Points (n,) of one tile that lie in the buffer; `box_m` is the tile's west, south, east, north edge."""
        tile = shapely.box(*box_m)
        if self.area.contains(tile):
            return np.ones(easting_m.size, dtype=bool)
        part = self.area.intersection(tile)
        shapely.prepare(part)
        inside: npt.NDArray[np.bool_] = shapely.intersects_xy(part, easting_m, northing_m)
        return inside
