"""Homes of an inventory whose rows a test changes as a person would: in memory, a GeoPackage, PostGIS."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pyarrow as pa
import shapely

from roadscan.inventory.home import Content, Home, Mark, Sheet
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.homes.postgis import PostGis
from roadscan.store.asset_schema import asset_schema, asset_table
from tests.inventory import qgis_edits as person

KINDS = ("pole", "sign")


class Memory(Home):
    """A home without a file."""

    def __init__(self, name: str = "memory") -> None:
        self._name = name
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self.marks: list[Mark] = []

    @property
    def name(self) -> str:
        return self._name

    def mark(self) -> Mark | None:
        return self.marks[-1] if self.marks else None

    def read(self) -> Content:
        return Content({k: self.shown(k) for k in KINDS})

    def shown(self, kind: str) -> pa.Table:
        """Rows of a kind."""
        schema = pa.schema([pa.field("fid", pa.int64()), *asset_table(kind)])
        return pa.Table.from_pylist(self.rows.get(kind, []), schema)

    def write(self, content: Content, sheets: list[Sheet], mark: Mark) -> None:
        self.rows = {k: content.rows[k].to_pylist() if k in content.rows else [] for k in KINDS}
        self.marks.append(mark)

    def note(self, mark: Mark) -> None:
        self.marks.append(mark)

    def edit(self, kind: str, at: int, **values: Any) -> None:
        self.rows[kind][at] |= values

    def delete(self, kind: str, at: int) -> None:
        del self.rows[kind][at]

    def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
        fid = 1 + max(
            (r["fid"] for r in self.rows[kind]), default=0
        )  # the highest number is given again, as SQLite does
        row = dict.fromkeys(asset_table(kind).names) | {"fid": fid, "geometry": geometry} | values
        self.rows[kind].append(row)


class InFile(GeoPackage):
    """A GeoPackage that a person edits through OGR."""

    def shown(self, kind: str) -> pa.Table:
        """Rows of a kind."""
        return self._read_layer(kind, asset_schema(kind).table)

    def edit(self, kind: str, at: int, **values: Any) -> None:
        values = {n: shapely.from_wkb(v) if n == "geometry" else v for n, v in values.items()}
        table = asset_schema(kind).table
        frame = person.layer(self.file, table)
        for name, value in values.items():
            if name == "geometry":
                shapes = list(frame.geometry)
                shapes[at] = value
                frame = frame.set_geometry(shapes, crs=frame.crs)
            else:
                column = frame[name].astype(object)
                column.iloc[at] = value
                frame[name] = column if isinstance(value, str) else pd.to_numeric(column)
        person.replace(self.file, table, frame, asset_schema(kind).geometry_words)

    def delete(self, kind: str, at: int) -> None:
        table = asset_schema(kind).table
        frame = person.layer(self.file, table)
        person.replace(self.file, table, frame.drop(frame.index[at]), asset_schema(kind).geometry_words)

    def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
        person.draw(self.file, asset_schema(kind).table, shapely.from_wkb(geometry), **values)


class InDatabase(PostGis):
    """Tables that a person edits by SQL."""

    def shown(self, kind: str) -> pa.Table:
        """Rows of a kind."""
        with self._transaction() as cursor:
            return self._read_table(cursor, kind)

    def _do(self, statement: str, values: list[Any]) -> None:
        import psycopg

        with psycopg.connect(self._address) as connection:
            connection.execute(statement, values)

    def _value(self, name: str, value: Any) -> tuple[str, Any]:
        if name == "geometry":
            return f"ST_SetSRID(ST_GeomFromWKB(%s), {self.srid})", value
        return "%s", value

    def _row(self, kind: str, at: int) -> int:
        return int(self.shown(kind)["fid"][at].as_py())

    def edit(self, kind: str, at: int, **values: Any) -> None:
        given = {("geom" if n == "geometry" else n): self._value(n, v) for n, v in values.items()}
        sets = ", ".join(f"{n} = {form}" for n, (form, _) in given.items())
        table = f"{self.schema}.{asset_schema(kind).table}"
        self._do(f"UPDATE {table} SET {sets} WHERE fid = %s", [*(v for _, v in given.values()), self._row(kind, at)])

    def delete(self, kind: str, at: int) -> None:
        self._do(f"DELETE FROM {self.schema}.{asset_schema(kind).table} WHERE fid = %s", [self._row(kind, at)])

    def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
        form, value = self._value("geometry", geometry)
        table = f"{self.schema}.{asset_schema(kind).table}"
        self._do(f"INSERT INTO {table} (geom, comments) VALUES ({form}, %s)", [value, values["comments"]])

    def drop(self) -> None:
        """Drop the schema and its roles."""
        from roadscan.inventory.homes.postgis import ROLES

        self._do(f"DROP SCHEMA IF EXISTS {self.schema} CASCADE", [])
        for role in ROLES:
            self._do(f"DROP ROLE IF EXISTS {self.schema}_{role}", [])
