"""A GeoPackage as the home of the inventory: one layer a kind, value lists, styles, and a table for its mark.

Layers are written and read through OGR alone: triggers of a layer's spatial index call functions that plain SQLite
lacks. A new state is written to a second file, which then replaces the first in one step.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import re
import sqlite3
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.core.crs import MapFrame
from roadscan.inventory.home import CHOICES, FID, Content, Decision, EditFault, Home, HomeError, Mark, Sheet
from roadscan.inventory.homes.added_tables import OddValue, into_map, keep_added, odd_values
from roadscan.inventory.qgis import add_styles
from roadscan.inventory.values import iso_wkb
from roadscan.store.asset_schema import (
    GEOMETRY,
    AssetColumn,
    asset_columns,
    asset_kind_names,
    asset_schema,
    asset_table,
)
from roadscan.store.holders import process_lives

MARKS: Final = "roadscan_inventory"
CONFLICTS: Final = "conflicts"
_VERSION: Final = {"VERSION": "1.3"}
"""Version of the standard; programs of today's stable Linux systems warn of newer ones."""
_WAIT_S: Final = 0.5
"""Wait for a lock (s): longer than another program's transaction for one edit."""
_FOREIGN: Final = "name another file, or move this one away"


class GeoPackage(Home):
    """A GeoPackage file with a layer for each kind of assets, or for some kinds only."""

    def __init__(
        self, file: Path, crs: str | None, kinds: Sequence[str] | None = None, frame: MapFrame | None = None
    ) -> None:
        """Take a file, the CRS of its layers, and the map's frame where that says more (heights, largest error)."""
        self.file = file
        self.crs = crs
        self.frame = frame or MapFrame(crs)
        self.kinds = tuple(asset_kind_names() if kinds is None else kinds)
        self._as_read: tuple[int, int] | None = None
        """Size and time of the file when its rows were read."""

    @property
    def name(self) -> str:
        """Returns the file's path."""
        return str(self.file)

    @property
    def project_file(self) -> Path:
        """Returns the path of the project file, beside the file."""
        return self.file.with_suffix(".qgs")

    def layer_address(self, table: str) -> tuple[str, str]:
        """Returns the layer of a table, relative to the project file."""
        return "ogr", f"./{self.file.name}|layername={table}"

    def mark(self) -> Mark | None:
        """Returns its last mark."""
        import pyogrio

        if not self.file.exists():
            return None
        self._check_not_locked(None)  # at once: OGR would wait five seconds at each of its attempts
        try:
            layers = {str(name) for name, _ in pyogrio.list_layers(self.file)}
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            self._check_not_locked(error)
            raise HomeError(
                f"the file is no GeoPackage that can be read: {error}", change=_FOREIGN, file=self.file
            ) from error
        if MARKS not in layers:
            raise HomeError(
                "the GeoPackage is that of another program",
                expected=f"one that `roadscan inventory publish` wrote, with its table '{MARKS}'",
                change=_FOREIGN,
                file=self.file,
            )
        _, table = self._layer_rows(MARKS)
        rows = table.to_pylist()
        if not rows:
            raise HomeError(f"the table '{MARKS}' is empty", change=_FOREIGN, file=self.file)
        last = rows[-1]
        return Mark(
            last["inventory"] or "", last["token"] or "", last["pending"] or "", last["commit"] or 0, last["at"] or ""
        )

    def read(self) -> Content:
        """Returns the rows of all layers."""
        import pyogrio

        layers = {str(name) for name, _ in pyogrio.list_layers(self.file)}
        rows: dict[str, pa.Table] = {}
        faults: list[EditFault] = []
        for kind in self.kinds:
            table = asset_schema(kind).table
            if table in layers:
                rows[kind] = self._read_layer(kind, table)
                faults += [EditFault(table, o.asset_id or f"fid {o.fid}", o.reason) for o in self._odd(kind, table)]
        content = Content(rows, self._decisions(layers), faults=tuple(faults))
        self._as_read = self._stamp()
        return content

    def _stamp(self) -> tuple[int, int] | None:
        if not self.file.exists():
            return None
        held = self.file.stat()
        return held.st_size, held.st_mtime_ns

    def _odd(self, kind: str, table: str) -> list[OddValue]:
        try:
            return odd_values(self.file, table, asset_table(kind))
        except sqlite3.Error as error:
            self._check_not_locked(error)
            raise HomeError(f"the layer '{table}' cannot be read: {error}", file=self.file) from error

    def _read_layer(self, kind: str, table: str) -> pa.Table:
        meta, found = self._layer_rows(table)
        if meta["geometry_name"] in found.column_names:
            at = found.column_names.index(meta["geometry_name"])
            found = found.rename_columns([GEOMETRY if n == at else name for n, name in enumerate(found.column_names)])
        schema = asset_table(kind)
        missing = [name for name in schema.names if name not in found.column_names]
        if missing:
            raise HomeError(
                f"the column '{missing[0]}' of the layer '{table}' is missing",
                expected=", ".join(schema.names),
                change="undo its deletion, or pull from a copy that has it",
                file=self.file,
            )
        added = [name for name in found.column_names if name not in (FID, *schema.names)]
        if added:
            raise HomeError(
                f"the column '{added[0]}' of the layer '{table}' does not belong to the inventory",
                change="keep what it says in `comments` and remove it: it would be lost",
                file=self.file,
            )
        shapes = shapely.from_wkb(found[GEOMETRY].to_numpy(zero_copy_only=False))
        placed = into_map(meta["crs"], self.frame, table, self.name)(np.asarray(shapes, dtype=object))
        plain = {field.name: self._cast(found[field.name], field, table) for field in schema if field.name != GEOMETRY}
        return pa.table({FID: found[FID].cast(pa.int64())} | plain | {GEOMETRY: pa.array(iso_wkb(placed), pa.binary())})

    def _cast(self, column: pa.ChunkedArray, field: pa.Field, table: str) -> pa.Array | pa.ChunkedArray:
        try:
            if pa.types.is_integer(field.type) and pa.types.is_floating(column.type):
                column = pc.trunc(column)  # a number that is not whole is a fault of its row
                return column.cast(field.type, safe=False)
            return column.cast(field.type)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise HomeError(
                f"the column '{field.name}' of the layer '{table}' is {column.type}: {error}",
                expected=str(field.type),
                file=self.file,
            ) from error

    def _decisions(self, layers: set[str]) -> list[Decision]:
        if CONFLICTS not in layers:
            return []
        _, table = self._layer_rows(CONFLICTS)
        if any(name not in table.column_names for name in (*Decision._fields[:3], "decision")):
            return []
        given = [row for row in table.to_pylist() if row["decision"]]
        odd = [row for row in given if row["decision"] not in CHOICES]
        if odd:
            raise HomeError(
                f"the decision '{odd[0]['decision']}' of a conflict is unknown",
                expected=", ".join(CHOICES),
                file=self.file,
                record=f"{CONFLICTS}, {odd[0]['asset_id']}, {odd[0]['attribute']}",
            )
        return [Decision(row["asset_id"], row["attribute"], row["edit"], row["decision"]) for row in given]

    def write(self, content: Content, sheets: Sequence[Sheet], mark: Mark) -> None:
        """Write all layers to a second file, which then replaces this one."""
        self._check_free()
        scratch = self.file.with_name(f".{self.file.stem}-{os.getpid()}.gpkg")
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with _dated(mark.at):
                self._write_layers(scratch, content.rows, sheets, mark)
            if self.file.exists():
                keep_added(self.file, scratch)
            with scratch.open("rb+") as stream:
                os.fsync(stream.fileno())
            self._check_unchanged()
            scratch.replace(self.file)
            self._as_read = None
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            self._clear()

    def _clear(self) -> None:
        """Remove temporary files of this program, also of crashed ones; one program writes at a time."""
        scratch = re.compile(rf"\.{re.escape(self.file.stem)}-(\d+)\.gpkg(-.*)?")
        for left in self.file.parent.glob(".*.gpkg*"):
            made = scratch.fullmatch(left.name)
            if made and (int(made[1]) == os.getpid() or not process_lives(int(made[1]))):
                left.unlink(missing_ok=True)

    def _write_layers(self, file: Path, rows: Mapping[str, pa.Table], sheets: Sequence[Sheet], mark: Mark) -> None:
        for kind in self.kinds:
            schema = asset_schema(kind)
            own = rows.get(kind, asset_table(kind).empty_table())
            table = own.select(asset_table(kind).names).cast(_file_schema(kind))
            self._layer(file, Sheet(schema.table, schema.title, table), schema.geometry_words, schema.meaning)
        for sheet in sheets:
            self._layer(file, sheet, "Point Z" if GEOMETRY in sheet.rows.column_names else None)
        self._layer(file, Sheet(MARKS, MARKS, _mark_rows(mark)), None, "Not to be edited: what this file was made of.")
        add_value_lists(file, self.kinds)
        add_styles(file, self.kinds, dt.datetime.fromisoformat(mark.at))

    def _layer(self, file: Path, sheet: Sheet, geometry: str | None, meaning: str = "") -> None:
        import pyogrio

        options = {"IDENTIFIER": sheet.title, "DESCRIPTION": meaning}
        if geometry is not None:
            options["GEOMETRY_NAME"] = "geom"
        try:
            pyogrio.write_arrow(
                sheet.rows, file, layer=sheet.name, driver="GPKG", append=False, geometry_type=geometry,
                geometry_name=None if geometry is None else GEOMETRY, crs=None if geometry is None else self.crs,
                layer_options=options, dataset_options=_VERSION if not file.exists() else None,
            )  # fmt: skip
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise self._unwritable(error) from error

    def note(self, mark: Mark) -> None:
        """Append a mark: one row, one transaction."""
        import pyogrio

        self._check_writable()
        try:
            pyogrio.write_arrow(_mark_rows(mark), self.file, layer=MARKS, driver="GPKG", append=True)
            self._as_read = None
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, RuntimeError) as error:
            self._check_not_locked(error)
            raise self._unwritable(error) from error

    def _check_unchanged(self) -> None:
        """Raise HomeError if somebody saved into the file since its rows were read."""
        if self._as_read is not None and self._stamp() != self._as_read:
            raise HomeError("it was edited in this moment", change="pull, and publish again", file=self.file)

    def _check_writable(self) -> None:
        """Raise HomeError for a file without write permission, which the system does not enforce for administrators."""
        if self.file.exists():
            mode = self.file.stat().st_mode
            if not mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH) or not os.access(self.file, os.W_OK):
                raise self._unwritable(PermissionError("it is read-only"))

    def _check_free(self) -> None:
        """Raise HomeError while another program has the file open with changes that are not in it yet."""
        self._check_writable()
        if not self.file.exists():
            return
        try:
            with contextlib.closing(sqlite3.connect(self.file, timeout=_WAIT_S, isolation_level=None)) as connection:
                if Path(f"{self.file}-wal").exists():
                    connection.execute("PRAGMA journal_mode = DELETE").fetchall()
                connection.execute("BEGIN IMMEDIATE")
                connection.execute("ROLLBACK")
        except sqlite3.DatabaseError as error:
            raise self._held_open(error) from error

    def _check_not_locked(self, cause: Exception | None) -> None:
        """Raise HomeError while another program has locked the file: the cause of a failed reading or writing."""
        try:
            with contextlib.closing(sqlite3.connect(self.file, timeout=_WAIT_S, isolation_level=None)) as connection:
                connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
                connection.execute("BEGIN IMMEDIATE")
                connection.execute("ROLLBACK")
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise self._held_open(error) from cause
        except sqlite3.DatabaseError:
            return  # not a database: the caller reports that

    def _held_open(self, error: Exception) -> HomeError:
        who = programs_with(self.file)
        return HomeError(
            f"another program has the GeoPackage open ({error})" + (f": {', '.join(who)}" if who else ""),
            change="save or undo the edits there and close it (in QGIS remove its layers or close the project), then "
            "try again; the file is as it was",
            file=self.file,
        )

    def _layer_rows(self, layer: str) -> tuple[dict[str, Any], pa.Table]:
        """Returns OGR's description of a layer, and its rows."""
        import pyogrio

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of heights and types that are checked here
                meta, table = pyogrio.read_arrow(self.file, layer=layer, return_fids=True)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            self._check_not_locked(error)
            raise HomeError(f"the layer '{layer}' cannot be read: {error}", file=self.file) from error
        return meta, table

    def _unwritable(self, error: Exception) -> HomeError:
        return HomeError(
            f"the GeoPackage cannot be written: {error}",
            change="see to its rights and its disk; it is as it was",
            file=self.file,
        )


def programs_with(file: Path) -> list[str]:
    """Returns name and number of each other program here that has a file open, as far as its user may see."""
    import psutil

    found = []
    for process in psutil.process_iter(["name"]):
        with contextlib.suppress(psutil.Error):
            if process.pid != os.getpid() and any(Path(one.path) == file.resolve() for one in process.open_files()):
                found.append(f"{process.info['name']} (process {process.pid})")
    return sorted(found)


def _file_schema(kind: str) -> pa.Schema:
    """Returns the kind's columns with the metadata that QGIS and others show: title, meaning."""
    fields = [
        pa.field(
            c.name,
            asset_table(kind).field(c.name).type,
            metadata={"GDAL:OGR:alternative_name": _title(kind, c.name), "GDAL:OGR:comment": c.meaning},
        )
        for c in asset_columns(kind)
    ]
    return pa.schema([*fields, asset_table(kind).field(GEOMETRY)])


def _title(kind: str, name: str) -> str:
    """Returns a column's title with its unit; GeoPackage demands titles that differ within a layer."""
    column = next(c for c in asset_columns(kind) if c.name == name)
    same = [c.name for c in asset_columns(kind) if c.title == column.title]
    return column.title if len(same) == 1 else f"{column.title} ({name})"


def _mark_rows(mark: Mark) -> pa.Table:
    types = {name: pa.int32() if name == "commit" else pa.string() for name in Mark._fields}
    return pa.table({name: pa.array([value], types[name]) for name, value in mark._asdict().items()})


@contextlib.contextmanager
def _dated(at: str) -> Iterator[None]:
    """Make OGR write our instant instead of its clock's: same state, same bytes."""
    import pyogrio

    moment = dt.datetime.fromisoformat(at).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    options = {"OGR_CURRENT_DATE": moment, "OGR_SQLITE_SYNCHRONOUS": "OFF"}  # fsync follows once for the whole file
    pyogrio.set_gdal_config_options(options)
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(options))


_RANGE: Final = "INSERT INTO gpkg_data_column_constraints VALUES (?, 'range', NULL, ?, 1, ?, 1, NULL)"
_VALUE: Final = "INSERT INTO gpkg_data_column_constraints VALUES (?, 'enum', ?, NULL, NULL, NULL, NULL, NULL)"
_USE: Final = "UPDATE gpkg_data_columns SET constraint_name = ? WHERE table_name = ? AND column_name = ?"


def add_value_lists(file: Path, kinds: Sequence[str]) -> None:
    """Add those of some kinds to a file that OGR has just written and that nobody else uses yet.

    The extension's tables contain no features, so no trigger of a spatial index is called.
    """
    known: set[tuple[str, tuple[str, ...], float | None, float | None]] = set()
    with contextlib.closing(sqlite3.connect(file)) as connection, connection:
        for kind in kinds:
            for column in asset_columns(kind):
                name = constraint_name(kind, column)
                if name is None:
                    continue
                content = (name, column.values, column.min, column.max)
                if content not in known:
                    known.add(content)
                    _add(connection, name, column)
                connection.execute(_USE, (name, asset_schema(kind).table, column.name))


def constraint_name(kind: str, column: AssetColumn) -> str | None:
    """Returns the name of a column's value list or range, which all kinds share; None where it has none."""
    prefix = f"{kind}_" if column in asset_schema(kind).own else ""
    if column.values or (column.min is not None and column.max is not None):
        return f"{prefix}{column.name}"
    return None


def _add(connection: sqlite3.Connection, name: str, column: AssetColumn) -> None:
    if column.values:
        connection.executemany(_VALUE, [(name, value) for value in column.values])
    else:
        connection.execute(_RANGE, (name, column.min, column.max))
