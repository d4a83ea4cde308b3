"""DuckDB over a store: every table as a view, and spans of time that touch only their partitions."""

from __future__ import annotations

from collections.abc import Iterable

import duckdb
import pyarrow as pa

from roadscan.model.errors import RoadscanError, StoreError
from roadscan.tables.logs import DataFile, read_log_records
from roadscan.tables.manifest import Manifest
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store

_HELD_WHOLE = ("footprints", "regions", "clocks", "clock_residuals", "corrections", "mountings")
"""Tables without partitions."""
_DISTRESS = ("cracks", "potholes")
_PER_TILE = ("cells", "overviews")
_MISTAKES = (duckdb.CatalogException, duckdb.BinderException, duckdb.ParserException)
"""Errors of the statement."""
_ALWAYS = ("rejects",)
"""Tables that answer even before they have a row: no rejects is news too."""
_HIVE = {"survey": "VARCHAR", "run": "VARCHAR", "sensor": "VARCHAR", "log": "VARCHAR", "gps_bin_s": "BIGINT"}
"""Columns that a file's folders name."""


def connect(
    store: Store, logs: Iterable[str] | None = None, damaged: list[StoreError] | None = None
) -> duckdb.DuckDBPyConnection:
    """A DuckDB connection with one view a table and, for tables in time, one macro a table.

    ``returns`` is the whole table; ``returns_between(first_gps_ns, last_gps_ns)`` opens only the files of
    the partitions that hold the span. Hive columns run, sensor, log and gps_bin_s come with each row.
    ``tiles``, ``cells``, ``overviews``, ``cracks``, ``potholes``, ``regions``, ``footprints``, ``outputs`` are there
    once a run has made them,
    ``clocks``, ``mountings`` and ``corrections`` once they were estimated. `logs` are the keys of the logs to
    show, all in the store where left out. What is damaged is an error, or joins `damaged` and is not shown.
    """
    connection = duckdb.connect()
    if not store.is_folder:
        connection.register_filesystem(store.fs)
    files: dict[str, list[DataFile]] = {}
    wanted = None if logs is None else set(logs)
    for record in read_log_records(store, damaged=damaged):
        if wanted is not None and record.key not in wanted:
            continue  # replaced by a newer version of the log, or no longer listed
        for table, own in record.tables.items():
            files.setdefault(table, []).extend(own)
    for table, held in files.items():
        partition_s = table_schema(table).partition_s
        hive = _hive_columns(store, partition_s is not None)
        there = _view(connection, table, [_url(store, f.path) for f in held], damaged, hive=hive)
        if there and partition_s is not None:
            connection.execute(
                f"CREATE MACRO {table}_between(first_gps_ns, last_gps_ns) AS TABLE SELECT * FROM {table} "
                f"WHERE gps_bin_s BETWEEN first_gps_ns // 1000000000 // {partition_s} * {partition_s} "
                "AND last_gps_ns // 1000000000 "
                "AND epoch_gps_ns BETWEEN first_gps_ns AND last_gps_ns"
            )
    for table in _ALWAYS:
        if table not in files:
            connection.register(table, table_schema(table).arrow().empty_table())
    made = Manifest(store, damaged).table()  # not its files: a later record replaces an earlier one
    if made.num_rows:
        connection.register("outputs", made)
    places = {name: f"tables/{name}" for name in _HELD_WHOLE}
    places |= {"cells": "tiles/cells", "overviews": "tiles/overviews", "tiles": "products/tile_table"}
    places |= {name: f"products/{name}" for name in _DISTRESS}
    for name, folder in places.items():
        found = store.files(folder, ".parquet")
        if found:
            _view(connection, name, [_url(store, f) for f in found], damaged, filename=name in _PER_TILE)
    return connection


def query(
    store: Store, statement: str, logs: Iterable[str] | None = None, damaged: list[StoreError] | None = None
) -> pa.Table:
    """Run one SQL statement over the store's views."""
    with connect(store, logs, damaged) as connection:
        try:
            relation = connection.sql(statement)
            return pa.table({}) if relation is None else relation.to_arrow_table()
        except duckdb.Error as error:
            change = "`roadscan sql 'SHOW TABLES'` lists what there is"
            if not isinstance(error, _MISTAKES):
                change = "if a file is damaged, `roadscan verify` finds it and says what to do"
            raise RoadscanError(f"the query failed: {error}", change=change) from error


def _view(
    connection: duckdb.DuckDBPyConnection,
    name: str,
    urls: list[str],
    damaged: list[StoreError] | None,
    *,
    hive: str = "",
    filename: bool = False,
) -> bool:
    """Show files as a table; False where that cannot be, and `damaged` is told why."""
    listed = ", ".join("'" + u.replace("'", "''") + "'" for u in sorted(urls))
    options = "hive_partitioning = true, hive_types_autocast = true" if hive else "hive_partitioning = false"
    if filename or "filename" in hive:
        options += ", filename = true"
    try:
        connection.execute(f"CREATE VIEW {name} AS SELECT {hive or '*'} FROM read_parquet([{listed}], {options})")
    except duckdb.Error as error:
        fault = StoreError(
            f"table '{name}' cannot be opened: {str(error).splitlines()[0]}",
            change="`roadscan verify` finds damaged files and says what to do",
        )
        if damaged is None:
            raise fault from error
        damaged.append(fault)
        return False
    return True


def _hive_columns(store: Store, in_time: bool) -> str:
    """What a view of a table with partitions selects: DuckDB takes a column from the first folder that names it, which
    may stand above the store. Then the last one is asked, and partitions are not left out by their names.
    """
    above = {folder.split("=")[0] for folder in store.root.split("/")[:-1] if "=" in folder}
    if not above & _HIVE.keys():
        return "*"
    columns = {name: kind for name, kind in _HIVE.items() if in_time or name != "gps_bin_s"}
    own = (f"regexp_extract(filename, '.*/{name}=([^/]*)/', 1)::{kind} AS {name}" for name, kind in columns.items())
    return f"* EXCLUDE (filename) REPLACE ({', '.join(own)})"


def _url(store: Store, path: str) -> str:
    return store.path(path) if store.is_folder else store.fs.unstrip_protocol(store.path(path))
