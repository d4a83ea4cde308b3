"""Tables of assets as layers for GIS and CAD: GeoPackage, GeoJSON, DXF. Same rows, same bytes."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import in_crs_unit

_COUNTERS: Final = (24, 92)
"""Places in a file of SQLite (bytes) of its number of changes, and of that for which its size holds: both agree."""
_COUNTED: Final = (1).to_bytes(4, "big")  # one change
_WRITTEN: Final = "2000-01-01T00:00:00.000Z"
"""Time of change that a GeoPackage states of its layers: equal tables give equal bytes."""
_DEGREE_DECIMALS: Final = 9
"""Decimals of degrees in GeoJSON: 0.1 mm."""
GEOMETRIES: Final = {"PointZ": "Point Z", "LineStringZ": "LineString Z", "PolygonZ": "Polygon Z"}
"""Types of geometries by their names in the schemas of assets, as GeoParquet and GDAL call them."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Assets of a kind."""

    name: str
    geometry: str
    """Type as the schema or GDAL names it."""
    rows: pa.Table
    """Plain columns."""
    shapes_m: npt.NDArray[Any]
    """(n,) geometries on the map (m)."""


def write_geopackage(path: Path, layers: Sequence[Layer], context: ProductContext) -> None:
    """Write a layer for each, in the CRS's own unit."""
    for number, one in enumerate(layers):
        _write(path, one, context, "GPKG", append=number > 0)
    with sqlite3.connect(path) as file:
        file.execute("UPDATE gpkg_contents SET last_change = ?", (_WRITTEN,))
    file.execute("VACUUM")
    file.close()
    with path.open("r+b") as content:  # GDAL writes in more or fewer steps, and SQLite counts them
        for place in _COUNTERS:
            content.seek(place)
            content.write(_COUNTED)


def write_geojson(path: Path, layer: Layer, context: ProductContext) -> None:
    """Write the features of a layer: by RFC 7946 in degrees of WGS 84, where the map has a CRS; heights stay as they
    are.
    """
    settings: dict[str, Any] = {"RFC7946": "YES"} if context.map.crs is not None else {}
    _write(path, layer, context, "GeoJSON", COORDINATE_PRECISION=_DEGREE_DECIMALS, **settings)


def write_flatgeobuf(path: Path, layer: Layer, context: ProductContext) -> None:
    """Write the features of a layer in the CRS's own unit, with an index by which programs fetch what they show."""
    _write(path, layer, context, "FlatGeobuf")


def write_dxf(path: Path, layers: Sequence[Layer], context: ProductContext) -> None:
    """Write a drawing in the CRS's own unit: a drawing layer for each, points as points, outlines as closed lines."""
    import pyogrio  # slow to import

    names: list[str] = []
    shapes: list[shapely.Geometry] = []
    for one in layers:
        for shape in in_crs_unit(one.shapes_m, context):
            lines = list(_lines(shape))
            shapes += lines
            names += [one.name] * len(lines)
    wkb = shapely.to_wkb(np.array([*shapes, None], object)[:-1], output_dimension=3)
    with _without_crs_warning():
        pyogrio.raw.write(
            path, wkb, field_data=[np.array(names, object)], fields=["Layer"], driver="DXF", geometry_type="Unknown"
        )


def _lines(shape: shapely.Geometry) -> Iterator[shapely.Geometry]:
    """Yields the lines that a drawing shows of a shape."""
    if shape.geom_type == "Polygon":
        yield from (shapely.LineString(ring) for ring in (shape.exterior, *shape.interiors))
    else:
        yield shape


def _write(
    path: Path, layer: Layer, context: ProductContext, driver: str, *, append: bool = False, **settings: Any
) -> None:
    import pyogrio  # slow to import

    shapes = shapely.to_wkb(in_crs_unit(layer.shapes_m, context), output_dimension=3)
    table = layer.rows.replace_schema_metadata(None).append_column("geometry", pa.array(shapes, pa.binary()))
    with _without_crs_warning():
        pyogrio.raw.write_arrow(
            table, path, layer=layer.name, driver=driver, geometry_name="geometry", crs=context.map.crs, append=append,
            geometry_type=GEOMETRIES.get(layer.geometry, layer.geometry), **settings,
        )  # fmt: skip


@contextmanager
def _without_crs_warning() -> Iterator[None]:
    """Suppress pyogrio's warning about a file without a CRS: a drawing, or of a local map."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*'crs' was not provided.*")
        yield
