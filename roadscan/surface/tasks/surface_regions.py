"""Polygons of the survey file inside which the surface of points is made; they are read once a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.crs import LOCAL_WORLD, MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds
from roadscan.core.survey import Survey
from roadscan.formats.vectors.road_lines import place_in_map
from roadscan.formats.vectors.vector_layer import (
    chosen_layer,
    feature_batches,
    gdal_faults,
    layer_info,
    layer_names,
    shapes_of,
)
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.window import GridWindow

_EXPECTED: Final = "a layer of polygons"
_POLYGONS: Final = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


@dataclass(frozen=True)
class Regions:
    """Regions in which the surface is made: (n,) polygons on the map (m)."""

    shapes: npt.NDArray[Any]

    def near(self, *boxes: Bounds) -> Regions:
        """Returns those that intersect one of some boxes."""
        own = [shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m) for b in boxes]
        touch = shapely.intersects(self.shapes[:, None], np.array(own, object)[None, :])
        return Regions(self.shapes[touch.any(axis=1)])

    def key(self) -> list[str]:
        """Returns a key of their corners, all that affects a surface."""
        return sorted(one.hex() for one in shapely.to_wkb(self.shapes))

    def holds(self, window: GridWindow) -> npt.NDArray[np.bool_]:
        """Returns a mask (rows, columns) of the cells of a window whose centre lies in one of them."""
        easting_m, northing_m = np.meshgrid(*window.nodes_m())
        inside = np.zeros(easting_m.shape, bool)
        for shape in self.shapes:
            shapely.prepare(shape)
            inside |= shapely.intersects_xy(shape, easting_m, northing_m)
        return inside


def stated_regions(survey: Survey) -> Regions | None:
    """Returns polygons that the survey file names, on its map; None where the surface is made everywhere.

    Raises
    ------
    ConfigError, FormatError, CrsError
        if the layer cannot be read as stated, or a feature of it is no polygon that lies in the map.
    """
    stated = SurfaceConfig.stated(survey)
    if stated is None or stated.polygons is None:
        return None
    path = survey.resolve(stated.polygons)
    if not path.is_file():
        raise ConfigError("the layer of polygons does not exist", change="check surface.polygons", file=path)
    return Regions(_placed(_shapes(path), _crs(path, stated.polygons_crs), survey.frame(), path))


def _shapes(path: Path) -> npt.NDArray[Any]:
    with gdal_faults(path, _EXPECTED):
        layer = chosen_layer(layer_names(path), None, path)
        geometry = layer_info(path, layer).get("geometry_name") or ""
    parts = [shapes_of(batch, geometry) for batch in feature_batches(path, layer, _EXPECTED)]
    shapes = np.concatenate(parts) if parts else np.empty(0, object)
    holds_ground = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    sound = np.isin(shapely.get_type_id(shapes), _POLYGONS) & shapely.is_valid(shapes) | ~holds_ground
    if not sound.all():
        raise ConfigError(
            f"feature {int(np.flatnonzero(~sound)[0])} of the layer (counted from 0) is no sound polygon",
            expected="polygons whose rings do not cross themselves",
            change="mend the feature, or take it out of the layer",
            file=path,
        )
    shapes = shapes[holds_ground]  # a feature without area is skipped
    if not shapes.size:
        raise ConfigError("the layer has no polygon", expected="at least one", file=path)
    return np.asarray(shapes)


def _crs(path: Path, stated: str | None) -> str:
    with gdal_faults(path, _EXPECTED):
        own = layer_info(path)["crs"]
    crs = stated or own
    if crs is None:
        raise ConfigError(
            "the layer of polygons does not name its CRS",
            change=f'state surface.polygons_crs, such as "EPSG:25832" or "{LOCAL_WORLD}"',
            file=path,
        )
    return str(crs)


def _placed(shapes: npt.NDArray[Any], crs: str, frame: MapFrame, path: Path) -> npt.NDArray[Any]:
    placed = shapely.transform(shapely.force_2d(shapes), place_in_map(crs, frame, path))
    bad = ~(np.isfinite(shapely.bounds(placed)).all(axis=1) & shapely.is_valid(placed))
    if bad.any():
        raise ConfigError(
            f"feature {int(np.flatnonzero(bad)[0])} of the layer (counted from 0) does not lie in the map",
            expected="polygons near the survey",
            file=path,
        )
    return np.asarray(placed)
