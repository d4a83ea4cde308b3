"""Writes a table with lines as a GeoPackage; the same rows give the same bytes."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any, Final

import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import in_crs_unit

_WRITTEN: Final = "2000-01-01T00:00:00.000Z"
"""Date of change that a GeoPackage has to state: constant, so that equal tables give equal bytes."""


def write_layer(path: Path, table: pa.Table, shapes_m: npt.NDArray[Any], context: ProductContext) -> None:
    """Write rows with their lines (n,) on the map (m) as one layer, named as the file, in the CRS's unit."""
    import pyogrio  # slow to import

    shapes = in_crs_unit(shapes_m, context)
    frame = table.to_pandas()
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapes),
        field_data=[frame[name].to_numpy() for name in frame.columns],
        fields=list(frame.columns),
        layer=path.stem,
        driver="GPKG",
        geometry_type="LineString",
        crs=context.map.crs,
    )
    with sqlite3.connect(path) as file:
        file.execute("UPDATE gpkg_contents SET last_change = ?", (_WRITTEN,))
    file.close()
