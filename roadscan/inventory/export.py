"""Export of the inventory to files of other programs: GeoPackage, GeoJSON, CSV, DXF."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, StoreError, nearest
from roadscan.inventory.state import State
from roadscan.store.asset_schema import asset_kind_names, asset_schema
from roadscan.store.csv import write_csv
from roadscan.store.inventory_schema import GEOMETRY, asset_table

_FORMULA: Final = re.compile(r"^[=@+\-\t\r\n＝＋－＠]")
"""Texts that a spreadsheet may run, all that OWASP names (CSV Injection); a leading quote makes them text."""


def export(state: State, file: Path, form: str, crs: str | None) -> int:
    """Write a state without its rejected assets; returns the number of assets.

    Raises
    ------
    ConfigError
        where the form is unknown, or GeoJSON is asked of a local map.
    StoreError
        where the file cannot be written.
    """
    if form not in _WRITERS:
        raise ConfigError(f"--as {form}{nearest(form, _WRITERS)}", expected=", ".join(_WRITERS))
    kinds = {
        kind: state.assets[kind].rows.filter(pc.not_equal(state.assets[kind].rows["status"], "rejected"))
        for kind in asset_kind_names()
        if kind in state.assets
    }
    scratch = file.with_name(f".{os.getpid()}-{file.name}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        _WRITERS[form](scratch, kinds, crs)
        scratch.replace(file)
    except OSError as error:
        raise StoreError(f"the file cannot be written: {error.strerror or error}", file=file) from error
    finally:
        scratch.unlink(missing_ok=True)
    return sum(rows.num_rows for rows in kinds.values())


def _gpkg(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    import pyogrio

    for kind in asset_kind_names():
        schema = asset_schema(kind)
        pyogrio.write_arrow(
            kinds.get(kind, asset_table(kind).empty_table()), file, layer=schema.table, driver="GPKG", append=False,
            geometry_name=GEOMETRY, geometry_type=schema.geometry_words, crs=crs,
        )  # fmt: skip


def _geojson(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Write all kinds in one collection, WGS 84 as RFC 7946 demands; columns keep the map's coordinates."""
    import pyogrio

    if crs is None:
        raise ConfigError(
            "the map has no CRS", expected="gpkg, csv or dxf", change="GeoJSON is in WGS 84 by its standard"
        )
    rows = _together(kinds)
    turn = _to_wgs84(crs)
    shapes = shapely.transform(_shapes(rows), turn, include_z=True)
    place = rows.schema.get_field_index(GEOMETRY)
    rows = rows.set_column(place, GEOMETRY, pa.array(shapely.to_wkb(shapes, flavor="iso"), pa.binary()))
    pyogrio.write_arrow(
        rows, file, driver="GeoJSON", append=False, geometry_name=GEOMETRY, geometry_type="Unknown", crs="EPSG:4326",
        layer_options={"RFC7946": "YES", "COORDINATE_PRECISION": "9"}, layer="assets",
    )  # fmt: skip


def _to_wgs84(crs: str) -> Callable[[Any], Any]:
    from pyproj import Transformer

    transformer = Transformer.from_crs(crs_from_text(crs).to_2d(), "EPSG:4326", always_xy=True)

    def turn(points: Any) -> Any:
        longitude, latitude = transformer.transform(points[:, 0], points[:, 1])
        return np.column_stack([longitude, latitude, points[:, 2]])

    return turn


def _csv(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Write all kinds in one table, geometry as WKT; texts that a spreadsheet would run get a leading quote."""
    rows = _together(kinds)
    wkt = pa.array(shapely.to_wkt(_shapes(rows), rounding_precision=4), pa.string())
    rows = rows.set_column(rows.schema.get_field_index(GEOMETRY), GEOMETRY, wkt)
    for at, field in enumerate(rows.schema):
        if pa.types.is_string(field.type):
            rows = rows.set_column(
                at, field, pa.array([_harmless(v) for v in rows[field.name].to_pylist()], pa.string())
            )
    out = io.BytesIO()
    write_csv(rows, out)
    file.write_bytes(out.getvalue())


def _harmless(text: str | None) -> str | None:
    return f"'{text}" if text is not None and _FORMULA.match(text) else text


def _dxf(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Geometries with their heights, a layer a kind."""
    import pyogrio

    layers = [asset_schema(kind).table for kind, rows in kinds.items() for _ in range(rows.num_rows)]
    shapes = _together(kinds)[GEOMETRY].to_numpy(zero_copy_only=False)
    pyogrio.raw.write(
        file, shapes, [np.array(layers, object)], ["Layer"], driver="DXF", layer="entities", crs=crs,
        geometry_type="Unknown",
    )  # fmt: skip


def _together(kinds: dict[str, pa.Table]) -> pa.Table:
    """Returns all kinds in one table with a column for the kind; columns that a kind lacks are null."""
    named = [
        rows.add_column(0, "kind", pa.array([kind] * rows.num_rows, pa.string())).replace_schema_metadata(None)
        for kind, rows in kinds.items()
    ]
    plain = [t.cast(pa.schema([f.remove_metadata() for f in t.schema])) for t in named]
    if not plain:
        return pa.table({"kind": pa.array([], pa.string()), GEOMETRY: pa.array([], pa.binary())})
    rows = pa.concat_tables(plain, promote_options="default")
    return rows.select([n for n in rows.column_names if n != GEOMETRY] + [GEOMETRY])


def _shapes(rows: pa.Table) -> Any:
    return np.asarray(shapely.from_wkb(rows[GEOMETRY].to_numpy(zero_copy_only=False)))


_WRITERS: Final[dict[str, Callable[[Path, dict[str, pa.Table], str | None], None]]] = {
    "gpkg": _gpkg, "geojson": _geojson, "csv": _csv, "dxf": _dxf,
}  # fmt: skip
