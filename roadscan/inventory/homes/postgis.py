"""A PostGIS database as the home of the inventory, for many people at once.

A publication is one transaction: others see the old state until it ends, also if it is interrupted.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import shapely

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.extras import needed
from roadscan.inventory.home import CHOICES, FID, Author, Content, Decision, Home, HomeError, Mark, Sheet
from roadscan.inventory.homes.added_tables import into_map
from roadscan.inventory.values import iso_wkb
from roadscan.store.asset_schema import (
    GEOMETRY,
    AssetColumn,
    AssetSchema,
    asset_columns,
    asset_kind_names,
    asset_schema,
    asset_table,
    kinds_by_table,
)

MARKS: Final = "roadscan_inventory"
_WAIT_MS: Final = 10_000  # Wait for a lock on the tables, at most (ms).
_TYPES: Final = {"geometry": "geometry", "sigmas": "double precision", "significance": "double precision",
                 "distance_m": "double precision", "passes_expected": "integer"}  # fmt: skip


class PostGis(Home):
    """A schema of a PostGIS database.

    Parameters
    ----------
    address : as libpq takes it; its password is told to nobody else.
    srid : EPSG number of the map; 0 for a local one.
    kinds : of assets that have a table each; all where they are left out.
    project : project file of QGIS that the first publication writes.
    frame : the map's frame; that of `srid` where it is left out.

    Raises
    ------
    ConfigError
        where the driver is missing, or the address is none.
    """

    def __init__(
        self, address: str, schema: str = "inventory", srid: int | None = None, kinds: Sequence[str] | None = None,
        project: Path | None = None, frame: MapFrame | None = None,
    ) -> None:  # fmt: skip
        psycopg: Any = needed("psycopg", "a home in PostGIS")
        try:
            self._parts = psycopg.conninfo.conninfo_to_dict(address)
        except psycopg.Error:
            raise ConfigError(
                "the address of the PostGIS database is none", expected="postgresql://user@host/database"
            ) from None
        self._address = address
        self.schema = schema
        self.srid = srid or 0
        self.kinds = tuple(asset_kind_names() if kinds is None else kinds)
        self._project = project
        self.frame = frame or MapFrame(f"EPSG:{srid}" if srid else None)
        self._seen: int | None = None
        """Last entry of the history when the rows were read."""

    @property
    def name(self) -> str:
        """Returns host, database and schema."""
        host, port = self._parts.get("host") or "local", self._parts.get("port")
        place = f"{host}:{port}" if port else host
        return f"postgis {place}/{self._parts.get('dbname') or ''} {self.schema}"

    @property
    def project_file(self) -> Path | None:
        """Returns the path that was given."""
        return self._project

    def layer_address(self, table: str) -> tuple[str, str]:
        """Returns the table without user and password: QGIS asks for them, or takes them from its store."""
        shown = " ".join(f"{k}='{self._parts[k]}'" for k in ("dbname", "host", "port") if self._parts.get(k))
        return "postgres", f'{shown} key=\'fid\' srid={self.srid} table="{self.schema}"."{table}" (geom)'

    @contextlib.contextmanager
    def _transaction(self, isolation: str = "REPEATABLE READ") -> Iterator[Any]:
        """Yields a cursor in a transaction that is committed as a whole; database errors are put into words."""
        import psycopg

        try:
            with psycopg.connect(self._address, connect_timeout=10) as connection, connection.cursor() as cursor:
                cursor.execute(f"SET TRANSACTION ISOLATION LEVEL {isolation}")
                cursor.execute(f"SET LOCAL lock_timeout = {_WAIT_MS}")
                yield cursor
        except psycopg.errors.LockNotAvailable as error:
            raise HomeError("others are changing the tables", change="try again in a minute", file=self.name) from error
        except psycopg.OperationalError as error:
            raise HomeError(
                f"the database does not answer, or the connection was lost: {self._told(error)}",
                change="see to its address and the network, and try again: it is as it was",
                file=self.name,
            ) from None
        except psycopg.Error as error:
            raise HomeError(f"the database refused: {self._told(error)}; it is as it was", file=self.name) from None

    def _told(self, error: Exception) -> str:
        text = " ".join(str(error).split())
        password = self._parts.get("password")
        return text.replace(str(password), "…") if password else text

    def mark(self) -> Mark | None:
        """Returns its last mark."""
        with self._transaction() as cursor:
            return self._mark(cursor)

    def _mark(self, cursor: Any) -> Mark | None:
        cursor.execute("SELECT to_regnamespace(%s) IS NOT NULL", [self.schema])
        if not cursor.fetchone()[0]:
            return None
        cursor.execute("SELECT to_regclass(%s) IS NOT NULL", [f"{self.schema}.{MARKS}"])
        if not cursor.fetchone()[0]:
            raise HomeError(
                f"the schema '{self.schema}' is that of another program",
                change="name another one (`inventory.schema_name`)",
                file=self.name,
            )
        cursor.execute(
            f'SELECT inventory, token, pending, "commit", at FROM {self.schema}.{MARKS} ORDER BY id DESC LIMIT 1'
        )
        row = cursor.fetchone()
        return None if row is None else Mark(*row)

    def read(self) -> Content:
        """Returns the rows of all tables at one instant, and who changed them since the last read."""
        with self._transaction() as cursor:
            held = self._held(cursor)
            rows = {kind: self._read_table(cursor, kind) for kind in self.kinds if kind in held}
            cursor.execute(f"SELECT coalesce(max(id), 0) FROM {self.schema}.history")
            self._seen = int(cursor.fetchone()[0])
            return Content(rows, self._decisions(cursor), self._authors(cursor))

    def _read_table(self, cursor: Any, kind: str) -> pa.Table:
        schema, table = asset_table(kind), asset_schema(kind).table
        self._check_columns(cursor, table, [n for n in schema.names if n != GEOMETRY])
        names = ", ".join(f'"{n}"' for n in schema.names if n != GEOMETRY)
        out = io.BytesIO()
        query = (
            f"COPY (SELECT fid, {names}, geom FROM {self.schema}.{table} ORDER BY fid) TO STDOUT (FORMAT csv, HEADER)"
        )
        with cursor.copy(query) as copy:
            for chunk in copy:
                out.write(chunk)
        types: dict[str, Any] = {f.name: f.type for f in schema if f.name != GEOMETRY} | {
            FID: pa.int64(),
            "geom": pa.string(),
        }
        out.seek(0)
        read = pyarrow.csv.read_csv(
            out,
            parse_options=pyarrow.csv.ParseOptions(newlines_in_values=True),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=types, null_values=[""], strings_can_be_null=True, quoted_strings_can_be_null=False,
                true_values=["t"], false_values=["f"],
            ),
        )  # fmt: skip
        shapes = shapely.from_wkb(np.asarray(read["geom"].to_pylist(), dtype=object))
        return pa.table(
            {FID: read[FID]}
            | {f.name: read[f.name] for f in schema if f.name != GEOMETRY}
            | {GEOMETRY: pa.array(iso_wkb(self._in_map(shapes, table)), pa.binary())}
        )

    def _in_map(self, shapes: npt.NDArray[Any], table: str) -> npt.NDArray[Any]:
        """Returns geometries in the map's CRS: a table whose column was altered may have another SRID."""
        stated = shapely.get_srid(shapes)
        out = shapes.copy()
        for srid in sorted(set(stated[~shapely.is_missing(shapes)].tolist()) - {self.srid}):
            of_it = (stated == srid) & ~shapely.is_missing(shapes)
            out[of_it] = into_map(f"EPSG:{srid}" if srid else None, self.frame, table, self.name)(shapes[of_it])
        return out

    def _as_owner(self, cursor: Any) -> None:
        """Switch to the role of the schema's owner, which all administrators have: only it replaces tables."""
        cursor.execute("SELECT nspowner::regrole::text FROM pg_namespace WHERE nspname = %s", [self.schema])
        cursor.execute(f"SET LOCAL ROLE {cursor.fetchone()[0]}")

    def _held(self, cursor: Any) -> set[str]:
        """Returns the kinds that have a table; a schema of an older version lacks those of newer kinds."""
        cursor.execute("SELECT tablename FROM pg_tables WHERE schemaname = %s", [self.schema])
        return {kinds_by_table()[table] for (table,) in cursor.fetchall() if table in kinds_by_table()}

    def _check_columns(self, cursor: Any, table: str, wanted: Sequence[str]) -> None:
        cursor.execute(
            "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s",
            [self.schema, table],
        )
        there = {name for (name,) in cursor.fetchall()}
        missing = [name for name in (*wanted, "fid", "geom") if name not in there]
        if missing:
            raise HomeError(f"the column '{missing[0]}' of the table '{table}' is missing", file=self.name)
        added = sorted(there - {*wanted, "fid", "geom"})
        if added:
            raise HomeError(f"the column '{added[0]}' of the table '{table}' does not belong to the inventory",
                            change="remove it: it would be lost", file=self.name)  # fmt: skip

    def _decisions(self, cursor: Any) -> list[Decision]:
        cursor.execute("SELECT to_regclass(%s) IS NOT NULL", [f"{self.schema}.conflicts"])
        if not cursor.fetchone()[0]:
            return []
        cursor.execute(f"SELECT asset_id, attribute, edit, decision FROM {self.schema}.conflicts WHERE decision <> ''")
        found = [Decision(*row) for row in cursor.fetchall()]
        for one in found:
            if one.choice not in CHOICES:
                raise HomeError(f"the decision '{one.choice}' of a conflict is unknown", expected=", ".join(CHOICES),
                                file=self.name)  # fmt: skip
        return found

    def _authors(self, cursor: Any) -> dict[tuple[str, str, str], Author]:
        cursor.execute(
            "SELECT layer, fid, asset_id, who, at, CASE WHEN action = 'DELETE' THEN ARRAY['status'] ELSE "
            "ARRAY(SELECT key FROM jsonb_each(new) WHERE old IS NULL OR old -> key IS DISTINCT FROM value) END "
            f"FROM {self.schema}.history "
            f"WHERE id > (SELECT coalesce(max(history_id), 0) FROM {self.schema}.{MARKS}) ORDER BY id"
        )
        found: dict[tuple[str, str, str], Author] = {}
        for layer, fid, asset_id, who, at, names in cursor.fetchall():
            kind = kinds_by_table().get(layer)
            if kind is not None:
                moment = at.astimezone(dt.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
                author = Author(who, moment)
                for name in names:
                    found[kind, asset_id or f"fid {fid}", GEOMETRY if name == "geom" else name] = author
        return found

    def write(self, content: Content, sheets: Sequence[Sheet], mark: Mark) -> None:
        """Replace all rows in one transaction."""
        with self._transaction("READ COMMITTED") as cursor:
            is_new = self._mark(cursor) is None
            if not is_new:
                self._as_owner(cursor)
            held = set() if is_new else self._held(cursor)
            missing = [kind for kind in self.kinds if kind not in held]
            for statement in statements(self.schema, self.srid, missing, is_new=is_new) if missing else ():
                cursor.execute(statement)
            tables = ", ".join(f"{self.schema}.{asset_schema(kind).table}" for kind in self.kinds)
            cursor.execute(f"LOCK TABLE {tables} IN ACCESS EXCLUSIVE MODE")
            cursor.execute(f"SELECT coalesce(max(id), 0) FROM {self.schema}.history")
            last = int(cursor.fetchone()[0])
            if self._seen is not None and last > self._seen:
                raise HomeError("it was edited in this moment", change="pull, and publish again", file=self.name)
            cursor.execute("SET LOCAL roadscan.publishing = 'yes'")
            cursor.execute(f"TRUNCATE {tables} RESTART IDENTITY")
            for kind in self.kinds:
                if kind in content.rows:
                    self._fill(cursor, kind, content.rows[kind])
            for sheet in sheets:
                self._sheet(cursor, sheet)
            self._note(cursor, mark, last)

    def _fill(self, cursor: Any, kind: str, rows: pa.Table) -> None:
        table = asset_schema(kind).table
        names = [n for n in rows.column_names if n != GEOMETRY]
        plain = rows.select(names).append_column("geom", self._hexadecimal(rows))
        self._copy(cursor, table, plain)
        cursor.execute(
            f"SELECT setval(pg_get_serial_sequence('{self.schema}.{table}', 'fid'), {rows.num_rows + 1}, false)"
        )

    def _hexadecimal(self, rows: pa.Table) -> pa.Array:
        shapes = shapely.set_srid(shapely.from_wkb(rows[GEOMETRY].to_numpy(zero_copy_only=False)), self.srid)
        return pa.array(shapely.to_wkb(shapes, hex=True, include_srid=True), pa.string())

    def _copy(self, cursor: Any, table: str, rows: pa.Table) -> None:
        out = io.BytesIO()
        pyarrow.csv.write_csv(rows, out, pyarrow.csv.WriteOptions(include_header=False))
        names = ", ".join(f'"{n}"' for n in rows.column_names)
        with cursor.copy(f"COPY {self.schema}.{table} ({names}) FROM STDIN (FORMAT csv)") as copy:
            copy.write(out.getbuffer())

    def _sheet(self, cursor: Any, sheet: Sheet) -> None:
        columns = ", ".join(
            f'"{n}" {_TYPES.get(n, "text")}' if n != GEOMETRY else f"geom geometry(PointZ, {self.srid})"
            for n in sheet.rows.column_names
        )
        place = f"{self.schema}.{sheet.name}"
        cursor.execute(f"DROP TABLE IF EXISTS {place}")
        cursor.execute(f"CREATE TABLE {place} (fid bigint GENERATED BY DEFAULT AS IDENTITY PRIMARY KEY, {columns})")
        cursor.execute(f"GRANT SELECT ON {place} TO {', '.join(f'{self.schema}_{role}' for role in ROLES)}")
        if "decision" in sheet.rows.column_names:
            cursor.execute(f"GRANT UPDATE (decision) ON {place} TO {self.schema}_editor")
        if sheet.rows.num_rows:
            plain = sheet.rows.drop_columns([GEOMETRY]).append_column("geom", self._hexadecimal(sheet.rows))
            self._copy(cursor, sheet.name, plain)

    def note(self, mark: Mark) -> None:
        """Append a mark; one that is no longer pending closes the history that was read."""
        with self._transaction("READ COMMITTED") as cursor:
            self._note(cursor, mark, 0 if mark.pending else self._seen or 0)

    def _note(self, cursor: Any, mark: Mark, history_id: int) -> None:
        cursor.execute(
            f'INSERT INTO {self.schema}.{MARKS} (inventory, token, pending, "commit", at, history_id) '
            "VALUES (%s, %s, %s, %s, %s, %s)",
            [*mark, history_id],
        )


_TYPES_OF_FIELDS: Final = {
    "bool": "boolean", "date": "date", "float64": "double precision", "int32": "integer", "int64": "bigint",
    "string": "text",
}  # fmt: skip
ROLES: Final = ("reader", "editor", "admin")

_HISTORY: Final = """
CREATE TABLE {s}.history (
  id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
  at timestamptz NOT NULL DEFAULT clock_timestamp(),
  who text NOT NULL DEFAULT session_user,
  layer text NOT NULL, action text NOT NULL, fid bigint, asset_id text, old jsonb, new jsonb);
CREATE FUNCTION {s}.note_change() RETURNS trigger LANGUAGE plpgsql
  SECURITY DEFINER SET search_path = pg_catalog, public AS $$
BEGIN
  IF current_setting('roadscan.publishing', true) = 'yes' AND pg_has_role(
    session_user, (SELECT nspowner FROM pg_namespace WHERE nspname = TG_TABLE_SCHEMA), 'MEMBER')
  THEN RETURN NULL; END IF;
  INSERT INTO {s}.history (layer, action, fid, asset_id, old, new) VALUES (
    TG_TABLE_NAME, TG_OP, coalesce(NEW.fid, OLD.fid), coalesce(OLD.asset_id, NEW.asset_id),
    CASE WHEN TG_OP <> 'INSERT' THEN to_jsonb(OLD) END, CASE WHEN TG_OP <> 'DELETE' THEN to_jsonb(NEW) END);
  RETURN NULL;
END $$;
CREATE TABLE {s}.roadscan_inventory (
  id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
  inventory text, token text, pending text, "commit" integer, at text, history_id bigint NOT NULL DEFAULT 0);
"""


def statements(schema: str, srid: int, kinds: Sequence[str], *, is_new: bool = True) -> Iterator[str]:
    """Yields statements that create the tables of a new schema, or missing ones in an existing schema.

    Names of the schema and of the kinds are validated: letters, digits, `_`.
    """
    if is_new:
        yield "CREATE EXTENSION IF NOT EXISTS postgis"
        for role in ROLES:
            yield (
                f"DO $$ BEGIN IF NOT EXISTS (SELECT FROM pg_roles WHERE rolname = '{schema}_{role}') THEN "
                f"CREATE ROLE {schema}_{role} NOLOGIN; END IF; END $$"
            )
        yield f"GRANT {schema}_admin TO CURRENT_USER"
        yield f"CREATE SCHEMA {schema} AUTHORIZATION {schema}_admin"
        yield f"SET LOCAL ROLE {schema}_admin"  # every administrator owns what is created
        yield _HISTORY.format(s=schema)
    for kind in kinds:
        yield from _kind(schema, kind, srid)
    yield from grants(schema, kinds)


def grants(schema: str, kinds: Sequence[str]) -> Iterator[str]:
    """Yields grants: readers look; editors change assets and decide conflicts; administrators do all."""
    names = ", ".join(f"{schema}_{role}" for role in ROLES)
    yield f"GRANT USAGE ON SCHEMA {schema} TO {names}"
    yield f"GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {names}"
    yield f"GRANT ALL ON ALL TABLES IN SCHEMA {schema} TO {schema}_admin"
    yield f"GRANT CREATE ON SCHEMA {schema} TO {schema}_admin"
    for kind in kinds:
        table = asset_schema(kind).table
        for name in (table, f"{table}_current"):
            yield f"GRANT INSERT, UPDATE, DELETE ON {schema}.{name} TO {schema}_editor"


def _kind(schema: str, kind: str, srid: int) -> Iterator[str]:
    own = asset_schema(kind)
    columns = ", ".join(_column(c) for c in asset_columns(kind))
    yield (
        f"CREATE TABLE {schema}.{own.table} (fid bigint GENERATED BY DEFAULT AS IDENTITY PRIMARY KEY, {columns}, "
        f"geom geometry({own.geometry}, {srid}))"
    )
    yield f"CREATE INDEX ON {schema}.{own.table} USING gist (geom)"
    yield f"CREATE INDEX ON {schema}.{own.table} (asset_id)"
    yield f"CREATE VIEW {schema}.{own.table}_current AS SELECT * FROM {schema}.{own.table} WHERE valid_to IS NULL"
    yield (
        f"CREATE TRIGGER note_change AFTER INSERT OR UPDATE OR DELETE ON {schema}.{own.table} "
        f"FOR EACH ROW EXECUTE FUNCTION {schema}.note_change()"
    )
    yield from _comments(schema, own, kind)


def _comments(schema: str, own: AssetSchema, kind: str) -> Iterator[str]:
    yield f"COMMENT ON TABLE {schema}.{own.table} IS {_text(own.meaning)}"
    for column in asset_columns(kind):
        yield f"COMMENT ON COLUMN {schema}.{own.table}.{column.name} IS {_text(f'{column.title}: {column.meaning}')}"


def _column(column: AssetColumn) -> str:
    name = f'"{column.name}"'
    checks = []
    if column.values:
        checks.append(f"{name} IN ({', '.join(_text(v) for v in column.values)})")
    if column.min is not None:
        checks.append(f"{name} >= {column.min:g}")
    if column.max is not None:
        checks.append(f"{name} <= {column.max:g}")
    check = f" CHECK ({' AND '.join(checks)})" if checks else ""
    return f"{name} {_TYPES_OF_FIELDS[column.type]}{check}"


def _text(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
