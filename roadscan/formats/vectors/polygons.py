"""Reads layers of polygons (any that GDAL reads: shapefile, GeoPackage, GeoJSON) into the survey's map."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import shapely

from roadscan.core.crs import MapFrame
from roadscan.core.errors import FormatError
from roadscan.formats.vectors.road_lines import Place, layer_crs, place_in_map
from roadscan.formats.vectors.vector_layer import (
    check_archive,
    chosen_layer,
    feature_batches,
    gdal_faults,
    layer_info,
    layer_names,
    shapes_of,
)

_EXPECTED: Final = "a layer of polygons"


def check_polygons(path: Path, stated_crs: str | None, frame: MapFrame) -> None:
    """Check a layer of polygons and its CRS against the stated one; its features are not read.

    Raises
    ------
    FormatError, ConfigError, CrsError
        if there is none, GDAL cannot read it, or its CRS is unknown, another one, or leads to no place in the map.
    """
    _opened(path, stated_crs, frame)


def read_polygons(path: Path, stated_crs: str | None, frame: MapFrame) -> shapely.Geometry:
    """Return the union of a layer's polygons on the map (m).

    Raises
    ------
    FormatError, ConfigError, CrsError
        as of :func:`check_polygons`, and where a feature is no polygon or a corner has no place in the map.
    """
    name, geometry, place = _opened(path, stated_crs, frame)
    found: list[shapely.Geometry] = []
    first = 0
    for batch in feature_batches(path, name, _EXPECTED, columns=[]):
        shapes = shapely.force_2d(shapes_of(batch, geometry))
        kinds = np.isin(shapely.get_type_id(shapes), (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON))
        if not kinds.all():
            record = first + int(np.argmin(kinds))
            raise FormatError(
                "a feature that is no polygon", expected=_EXPECTED, change="take it out of the layer", file=path,
                record=record,
            )  # fmt: skip
        placed = shapely.transform(shapes, place)
        lost = np.flatnonzero(~np.isfinite(shapely.bounds(placed)).all(axis=1) & ~shapely.is_empty(shapes))
        if lost.size:
            raise FormatError(
                "a corner has no place in the map", expected="polygons that lie in the map",
                change="state the layer's CRS, or mend the feature", file=path, record=first + int(lost[0]),
            )  # fmt: skip
        found += list(shapely.make_valid(placed))
        first += batch.num_rows
    if not found:
        raise FormatError("a layer without features", expected=_EXPECTED, file=path)
    return shapely.union_all(np.array(found, object))


def _opened(path: Path, stated_crs: str | None, frame: MapFrame) -> tuple[str, str, Place]:
    if not path.exists():
        raise FormatError("the layer does not exist", change="check its path in the survey file", file=path)
    check_archive(path)
    with gdal_faults(path, _EXPECTED):
        name = chosen_layer(layer_names(path), None, path)
        info = layer_info(path, name)
    place = place_in_map(layer_crs(info["crs"], stated_crs, path), frame, path)
    return name, str(info.get("geometry_name") or ""), place
