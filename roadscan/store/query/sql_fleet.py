"""Queries the tables of many surveys at once: each row with the survey that it is of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import duckdb
import pyarrow as pa
from fsspec import AbstractFileSystem

from roadscan.core.errors import AnswerError, RoadscanError, StoreError
from roadscan.store.query.sql import (
    ALWAYS,
    PER_TILE,
    Opened,
    Tables,
    add_span_macro,
    add_utc,
    add_view,
    rows_of,
    statements_of,
    tables_of,
)
from roadscan.store.query.sql_files import PROTOCOL, StoreFiles
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.verified import faults_of_opened


class Member(NamedTuple):
    """A survey of a fleet."""

    store: Store
    logs: frozenset[str] | None
    """Keys of the logs to show, all in the store where None."""


class FleetStores:
    """The stores of a fleet, and tables beside theirs."""

    def __init__(self, members: Sequence[Member], beside: Mapping[str, pa.Table]) -> None:
        """`beside`: tables of the fleet itself, by name."""
        self._members, self._beside = members, beside

    def with_views(self, connection: duckdb.DuckDBPyConnection, damaged: list[StoreError] | None) -> Opened:
        """Add a view for each table that a survey has: the rows of all, with the column `survey` before the others.

        Columns are joined by name; one that a survey lacks is null there.
        """
        files = FleetFiles([member.store for member in self._members])
        connection.register_filesystem(files)
        add_utc(connection)
        tables = [_tables(member, damaged) for member in self._members]
        shut: dict[str, StoreError] = {}
        logs = [statements_of(one.of_logs) for one in tables]
        known = {name for one in logs for name in one}
        rows = [
            {name: rows_of(urls, filename=name in PER_TILE) for name, urls in one.made.items()} | of_files
            for one, of_files in zip(tables, logs, strict=True)
        ]
        for name in dict.fromkeys(name for one in rows for name in one):
            parts = [
                _part(connection, member.store, one[name])
                for member, one in zip(self._members, rows, strict=True)
                if name in one
            ]
            fault = add_view(connection, files, name, " UNION ALL BY NAME ".join(parts), damaged)
            if fault is not None:
                shut[name] = fault
            elif name in known:
                add_span_macro(connection, name)
        for name, table in self._beside.items():
            connection.register(name, table)
        for name in ALWAYS:
            if name not in known:
                connection.register(name, table_schema(name).arrow().empty_table())
        outputs = [
            one.outputs.add_column(0, "survey", pa.array([member.store.survey_id] * one.outputs.num_rows, pa.string()))
            for member, one in zip(self._members, tables, strict=True)
            if one.outputs.num_rows
        ]
        if outputs:
            connection.register("outputs", pa.concat_tables(outputs))

        def faults() -> list[AnswerError]:
            return [
                fault
                for member, one in zip(self._members, tables, strict=True)
                if (opened := files.of(member.store).opened)
                for fault in faults_of_opened(member.store, opened, one.recorded)
            ]

        return Opened(connection, files, faults, shut)


class FleetFiles(AbstractFileSystem):  # type: ignore[misc]
    """The files of several surveys as ``store://survey=<id>/…``; each is confined as by :class:`StoreFiles`."""

    protocol = PROTOCOL
    cachable = False
    root_marker = ""

    def __init__(self, stores: Sequence[Store]) -> None:
        super().__init__()
        self._of = {f"survey={store.survey_id}": StoreFiles(store) for store in stores}
        self._outside: list[str] = []
        self._last: StoreFiles | None = None

    @property
    def refused(self) -> list[str]:
        """Denied requests, in words."""
        return [*self._outside, *(words for one in self._of.values() for words in one.refused)]

    def last(self) -> str | None:
        """Return the file that was opened last."""
        return None if self._last is None else self._last.last()

    def forget(self) -> None:
        """Count no file as opened by now."""
        for one in self._of.values():
            one.forget()

    def of(self, store: Store) -> StoreFiles:
        """Return the files of one store."""
        return self._of[f"survey={store.survey_id}"]

    def open(self, path: str, mode: str = "rb", **more: Any) -> Any:
        """Return a file's bytes; PermissionError for any other mode and for files outside."""
        self._last = self._holder(path)
        return self._last.open(path, mode, **more)

    def info(self, path: str, **more: Any) -> dict[str, Any]:
        """Return name, size and kind of a file or folder."""
        return self._holder(path).info(path, **more)

    def modified(self, path: str) -> Any:
        """Return the time of the last change."""
        return self._holder(path).modified(path)

    def ls(self, path: str, detail: bool = True, **more: Any) -> list[Any]:
        """Return the entries of a folder."""
        return self._holder(path).ls(path, detail, **more)

    def glob(self, path: str, maxdepth: int | None = None, **more: Any) -> list[Any]:
        """Return the files that match a pattern within one survey."""
        return self._holder(path).glob(path, maxdepth, **more)

    def _holder(self, path: str) -> StoreFiles:
        top = path.removeprefix(f"{PROTOCOL}://").partition("/")[0]
        if top not in self._of:
            words = f"{path} is no file of the fleet: its files are {PROTOCOL}://survey=…/…"
            self._outside.append(words)
            raise PermissionError(words)
        return self._of[top]


def _tables(member: Member, damaged: list[StoreError] | None) -> Tables:
    try:
        return tables_of(member.store, member.logs, damaged)
    except RoadscanError as error:
        fault = StoreError(f"the survey '{member.store.survey_id}' cannot be opened: {error}")
        if damaged is None:
            raise fault from error
        damaged.append(fault)
        nothing = pa.table({})
        return Tables({}, {}, nothing, nothing)


def _part(connection: duckdb.DuckDBPyConnection, store: Store, rows: str) -> str:
    """Return the statement that reads a survey's rows of a table.

    Geometries lose the CRS in their type, or surveys on different maps would not fit into one table: `fleet.map_crs`
    says which it is.
    """
    name = store.survey_id.replace("'", "''")
    try:
        columns = connection.execute(f"DESCRIBE {rows}").fetchall()
    except duckdb.Error:
        columns = []  # the view says what is wrong
    shapes = [f'CAST("{one}" AS GEOMETRY) AS "{one}"' for one, kind, *_ in columns if kind.startswith("GEOMETRY")]
    others = f" REPLACE ({', '.join(shapes)})" if shapes else ""
    # The folder of the store is a column too, which may look like a number.
    without = " EXCLUDE (survey)" if "survey" in {one for one, *_ in columns} else ""
    return f"(SELECT '{name}' AS survey, *{without}{others} FROM ({rows}))"
