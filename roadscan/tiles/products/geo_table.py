"""Tables with a geometry: GeoParquet 1.1 (OGC), same rows, same bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import StoreError
from roadscan.tiles.product import ProductContext

_ROW_GROUP_ROWS: Final = 65_536  # Rows in a row group.


def write_geo_table(
    path: Path,
    columns: pa.Table,
    geometry: str,
    shapes_m: npt.NDArray[Any],
    kinds: list[str],
    context: ProductContext,
    *,
    counterclockwise: bool = False,
    more: Mapping[str, tuple[npt.NDArray[Any], list[str]]] | None = None,
) -> None:
    """Write rows with their geometry, in the CRS's unit; a geometry that is None is null.

    Parameters
    ----------
    columns : the plain columns; geometry : name of the geometry's column.
    shapes_m : (n,) shapely geometries on the map (m); kinds : their types, such as ``["Polygon"]``.
    counterclockwise : whether the outer rings of all polygons run that way, which the file then states.
    more : further geometries by name, each with its types.
    """
    table, about = columns, {}
    for name, (own_m, own_kinds) in {geometry: (shapes_m, kinds), **(more or {})}.items():
        shapes = in_crs_unit(own_m, context)
        known = ~shapely.is_missing(shapes)
        field = pa.field(name, pa.binary(), nullable=not known.all())
        table = table.append_column(field, pa.array(shapely.to_wkb(shapes), pa.binary()))
        about[name] = {"encoding": "WKB", "geometry_types": own_kinds, "crs": _crs(context), "edges": "planar"}
        if counterclockwise:
            about[name]["orientation"] = "counterclockwise"
        if known.any():
            about[name]["bbox"] = [float(v) for v in shapely.total_bounds(shapes)]
    whole = {"version": "1.1.0", "primary_column": geometry, "columns": about}
    table = table.replace_schema_metadata({"geo": json.dumps(whole, sort_keys=True)})
    pq.write_table(
        table, path, compression="zstd", row_group_size=_ROW_GROUP_ROWS, write_page_checksum=True, version="2.6"
    )


def read_geo_table(content: bytes, context: ProductContext) -> tuple[pa.Table, npt.NDArray[Any]]:
    """Return plain columns, and geometries on the map (m)."""
    table = pq.ParquetFile(pa.BufferReader(content)).read(use_threads=False)  # in this thread: see Store.read_table
    name = json.loads(table.schema.metadata[b"geo"])["primary_column"]
    shapes = shapely.from_wkb(table[name].to_numpy())
    return table.drop_columns([name]), _changed(shapes, context, np.multiply)


def in_crs_unit(shapes_m: npt.NDArray[Any], context: ProductContext) -> npt.NDArray[Any]:
    """Return geometries (n,), given on the map (m), in the CRS's unit; heights in that of its heights."""
    return _changed(shapes_m, context, np.divide)


def _changed(shapes: npt.NDArray[Any], context: ProductContext, how: np.ufunc) -> npt.NDArray[Any]:
    units = [context.map.horizontal_unit_m] * 2
    with_heights = bool(shapely.has_z(shapes).any())
    units += [context.map.vertical_unit_m] if with_heights else []
    if units == [1.0] * len(units):
        return shapes
    changed: npt.NDArray[Any] = shapely.transform(shapes, lambda xyz: how(xyz, units), include_z=with_heights)
    return changed


def check_geo_table(path: Path, columns: pa.Schema) -> None:
    """Decode every column, page checksums included, and every geometry; raise :class:`StoreError` otherwise."""
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
        metadata = json.loads((table.schema.metadata or {})[b"geo"])
        shapes = shapely.from_wkb(table[metadata["primary_column"]].to_numpy())
    except (OSError, pa.ArrowException, KeyError, ValueError, shapely.errors.ShapelyError) as error:
        raise StoreError(f"the table cannot be read: {error}", change="make it again", file=path) from error
    missing = [name for name in columns.names if name not in table.column_names]
    if missing:
        raise StoreError(f"the table lacks '{missing[0]}'", change="make it again", file=path)
    if not bool(np.all(shapely.is_valid(shapes))):
        raise StoreError("a geometry of the table is not valid", change="make it again", file=path)


def _crs(context: ProductContext) -> Any:
    return None if context.map.crs is None else crs_from_text(context.map.crs).to_json_dict()
