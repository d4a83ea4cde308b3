"""Queries a store with DuckDB: every table as a view, and time spans that only touch their partitions."""

from __future__ import annotations

import contextlib
import re
import tempfile
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias

import duckdb
import pyarrow as pa

from roadscan.core.errors import AnswerError, RoadscanError, StoreError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, leap_second_steps
from roadscan.store.asset_schema import ASSET_FOLDER, asset_tables
from roadscan.store.logs import log_of, read_log_records, table_of
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql_files import PROTOCOL, OpenedFiles, StoreFiles, url
from roadscan.store.readings.packed_returns import PACKED, beams_query, returns_query
from roadscan.store.schema import table_locations, table_schema
from roadscan.store.store import Store
from roadscan.store.verified import faults_of_opened, recorded_files

PER_TILE = ("cells", "overviews")
_MISTAKES = (duckdb.CatalogException, duckdb.BinderException, duckdb.ParserException)
"""Errors of the statement."""
ALWAYS = ("rejects",)
"""Tables that exist before they have a row: an empty table of rejects is an answer, too."""
_LATE: Final = {
    "INTERRUPT Error": duckdb.InterruptException,
    "Out of Memory Error": duckdb.OutOfMemoryException,
    "Permission Error": duckdb.PermissionException,
}
"""DuckDB's errors by the beginning of their messages, for those that come while an answer is fetched."""
_MISSING = re.compile(r"Table (?:Function )?with name \"?(?P<name>\w+)\"? does not exist")
"""DuckDB's message for a missing table or table macro."""
_CONFINED = (
    "SET temp_directory = ''",
    f"SET allowed_directories = ['{PROTOCOL}://']",
    "SET enable_external_access = false",
    "SET disabled_filesystems = 'LocalFileSystem'",
    "SET allow_persistent_secrets = false",
    "SET lock_configuration = true",
)
"""What leaves a statement nothing but the store's files and memory, in the order that DuckDB takes them. The last one
keeps a statement from taking one of them back.
"""
_NO_EXTENSIONS = (
    "SET autoinstall_known_extensions = false",
    "SET allow_community_extensions = false",
    "SET python_enable_replacements = false",
    "SET enable_external_file_cache = false",
)
"""Settings that prevent downloads, confined or not; files are opened when they are used."""
_MEMORY_SHARE: Final = "40%"
"""DuckDB's default is 80 %, which leaves no room for an answer beside it, nor for a run on the same machine."""
_SPILT: Final = 4
"""An unconfined statement may write so many times its memory to a temporary folder, which ends with it."""
_BATCH_ROWS: Final = 100_000
"""Rows of an answer that are fetched at once."""
_ONLY_NAMES: Final[dict[str, str | bool | int | float | list[str]]] = {
    "enable_external_access": False,
    "python_enable_replacements": False,
    "threads": 1,
}
"""A connection that reads the names of a statement's tables, and no file."""
_WAY_OUT_OF_STORE = "`--unconfined` (in Python `unconfined=True`) lets a statement reach other files"

ShownLogs: TypeAlias = Iterable[str] | Callable[[], Iterable[str]] | None
"""Keys of the logs to show, or what finds them where a statement reads a table of logs; None: all in the store."""


@dataclass(frozen=True)
class Limits:
    """What one statement may take; it ends with an error where that does not suffice."""

    time_s: float = 600.0
    """Longest time (s); 0: any. The slowest of docs/queries.md takes 2 s on a survey of 20 km."""
    memory_bytes: int | None = None
    """Most memory of DuckDB, and as much again for the answer (bytes); None: `_MEMORY_SHARE` of the machine's each."""

    def memory_words(self) -> str:
        """Return the memory as DuckDB's settings take it."""
        return _MEMORY_SHARE if self.memory_bytes is None else f"{self.memory_bytes}B"


@dataclass(frozen=True)
class Opened:
    """A connection, and the sources of its views."""

    connection: duckdb.DuckDBPyConnection
    files: OpenedFiles
    """The files that it opens."""
    faults: Callable[[], list[AnswerError]]
    """Returns the faults of those that were opened."""
    shut: dict[str, StoreError]
    """Tables whose files cannot be opened, and why."""


class Stores(Protocol):
    """Several stores that one statement reaches (:class:`roadscan.store.query.sql_fleet.FleetStores`)."""

    def with_views(self, connection: duckdb.DuckDBPyConnection, damaged: list[StoreError] | None) -> Opened:
        """Add the views of their tables to a connection."""
        ...


@dataclass(frozen=True)
class Tables:
    """The files of a store's tables, by table: names in statements."""

    of_logs: dict[str, list[str]]
    """Tables of rows of logs; Hive columns come with each row."""
    made: dict[str, list[str]]
    """Tables that a run made."""
    outputs: pa.Table
    """Records of all outputs."""
    recorded: pa.Table
    """Records of all files."""


def connect(
    store: Store,
    logs: Iterable[str] | None = None,
    damaged: list[StoreError] | None = None,
    *,
    unconfined: bool = False,
    limits: Limits = Limits(),
) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with one view per table and, for tables in time, one macro per table.

    ``returns`` is the whole table; ``returns_between(first_gps_ns, last_gps_ns)`` opens only the files of
    the partitions that hold the span. Hive columns run, sensor, log and gps_bin_s come with each row.
    ``tiles``, ``cells``, ``overviews``, ``cracks``, ``potholes``, ``regions``, ``footprints``, ``outputs`` are there
    once a run has made them, as are the tables of assets (``poles`` …),
    ``clocks``, ``mountings`` and ``corrections`` once they were estimated. `logs` are the keys of the logs to
    show, all in the store where left out. What is damaged is an error, or joins `damaged` and is not shown.
    The macro ``utc(epoch_gps_ns)`` gives the UTC instant of a GPS epoch.

    Statements reach the store's files, as ``store://survey=<id>/…``, and memory. They write no file and read no other,
    unless the connection is `unconfined`. Extensions are never fetched. Of the `limits` that of memory holds for each
    statement of the connection; answers and time are the caller's.
    """
    return _opened(store, logs, damaged, unconfined, limits).connection


def _opened(
    store: Store | Stores,
    logs: ShownLogs,
    damaged: list[StoreError] | None,
    unconfined: bool,
    limits: Limits,
    statement: str | None = None,
) -> Opened:
    connection = duckdb.connect()
    try:
        if isinstance(store, Store):
            tables = None if statement is None else _made_tables_of(store, statement, damaged)
            opened = _with_views(connection, store, tables or tables_of(store, logs, damaged), damaged)
        else:
            opened = store.with_views(connection, damaged)
        connection.execute(f"SET memory_limit = '{limits.memory_words()}'")
        connection.execute(f"SET max_temp_directory_size = '{_SPILT * _memory_bytes(connection)}B'")
        for setting in (*_NO_EXTENSIONS, *(() if unconfined else _CONFINED)):
            connection.execute(setting)
    except BaseException:
        connection.close()
        raise
    opened.files.forget()  # a view reads the first file of its table
    return opened


def tables_of(store: Store, logs: ShownLogs, damaged: list[StoreError] | None) -> Tables:
    """Return the files of a store's tables; `logs` are the keys of those to show, all where None."""
    of_logs: dict[str, list[str]] = {}
    wanted = None if logs is None else set(logs() if callable(logs) else logs)
    records = read_log_records(store, damaged=damaged)
    for record in records:
        if wanted is not None and record.key not in wanted:
            continue  # replaced by a newer version of the log, or no longer listed
        for file in (file for own in record.tables.values() for file in own):
            of_logs.setdefault(table_of(file.path), []).append(url(store, file.path))
    manifest = Manifest(store, damaged)
    return Tables(of_logs, _made_files(store), manifest.table(), recorded_files(store, records, manifest))


def _made_files(store: Store, names: Collection[str] | None = None) -> dict[str, list[str]]:
    """Return the URLs of the files of each table that a run made, or of those tables among `names` alone."""
    places = {name: place for name, place in table_locations().items() if names is None or name in names}
    made_of = {name: store.files(folder, ".parquet") for name, folder in places.items()}
    kinds = [name for name in asset_tables() if names is None or name in names]
    assets = store.files(ASSET_FOLDER, ".parquet") if kinds else []
    made_of |= {name: [path] for name in kinds if (path := f"{ASSET_FOLDER}/{name}.parquet") in assets}
    return {name: [url(store, f) for f in found] for name, found in made_of.items() if found}


def _made_tables_of(store: Store, statement: str, damaged: list[StoreError] | None) -> Tables | None:
    """Return the tables that a statement reads where a run made all of them; None where it reads others.

    A statement of cells needs neither the logs of the survey file nor the views of 20 other tables.
    """
    if "duckdb_" in statement.lower():  # duckdb_views() and its like list all tables, and are no table themselves
        return None
    try:
        with duckdb.connect(config=_ONLY_NAMES) as connection:
            names = connection.get_table_names(statement)
    except duckdb.Error:  # a table macro, a fault of the statement: reported by the connection that has all views
        return None
    made = _made_files(store, names)
    if not made or made.keys() != names:
        return None
    manifest = Manifest(store, damaged)
    return Tables({}, made, manifest.table(), recorded_files(store, [], manifest))


def statements_of(of_logs: Mapping[str, list[str]]) -> dict[str, str]:
    """Return what reads each table of logs, by its name: packed returns are rows of `returns` as well.

    of_logs : URLs of files by the form of their rows.
    """
    found = {form: rows_of(urls, hive=True) for form, urls in of_logs.items()}
    if PACKED in of_logs:
        one_a_log = {log_of(one): one for one in of_logs[PACKED]}
        found["beams"] = beams_query(_listed(one_a_log.values()))
        others = f"{found['returns']} UNION ALL BY NAME " if "returns" in of_logs else ""
        own = returns_query(packed=f"({found[PACKED]})", beams=f"({found['beams']})")
        found["returns"] = f"{others}({own})"
    return found


def _with_views(
    connection: duckdb.DuckDBPyConnection, store: Store, tables: Tables, damaged: list[StoreError] | None
) -> Opened:
    own_files = StoreFiles(store)
    connection.register_filesystem(own_files)
    add_utc(connection)
    shut: dict[str, StoreError] = {}
    for table, rows in statements_of(tables.of_logs).items():
        fault = add_view(connection, own_files, table, rows, damaged)
        if fault is not None:
            shut[table] = fault
        else:
            add_span_macro(connection, table)
    for table in ALWAYS:
        if table not in tables.of_logs:
            connection.register(table, table_schema(table).arrow().empty_table())
    if tables.outputs.num_rows:  # except its files: a later record replaces an earlier one
        connection.register("outputs", tables.outputs)
    for name, urls in tables.made.items():
        if fault := add_view(connection, own_files, name, rows_of(urls, filename=name in PER_TILE), damaged):
            shut[name] = fault
    return Opened(connection, own_files, lambda: faults_of_opened(store, own_files.opened, tables.recorded), shut)


def add_span_macro(connection: duckdb.DuckDBPyConnection, table: str) -> None:
    """Add ``TABLE_between(first_gps_ns, last_gps_ns)`` of a table that has partitions in time."""
    partition_s = table_schema(table).partition_s
    if partition_s is not None:
        connection.execute(
            f"CREATE MACRO {table}_between(first_gps_ns, last_gps_ns) AS TABLE SELECT * FROM {table} "
            f"WHERE gps_bin_s BETWEEN first_gps_ns // 1000000000 // {partition_s} * {partition_s} "
            "AND last_gps_ns // 1000000000 "
            "AND epoch_gps_ns BETWEEN first_gps_ns AND last_gps_ns"
        )


def query(
    store: Store | Stores,
    statement: str,
    logs: ShownLogs = None,
    damaged: list[StoreError] | None = None,
    *,
    unconfined: bool = False,
    limits: Limits = Limits(),
) -> pa.Table:
    """Run one SQL statement over the store's views (:func:`connect`).

    The files that it opens are verified against their records if they changed since the last verification. One that is
    damaged is an error, or joins `damaged` (as :class:`AnswerError`), and the answer is given.

    Raises
    ------
    RoadscanError
        where the statement fails, or takes more time or memory than the `limits` allow.
    """
    opened = _opened(store, logs, damaged, unconfined, limits, statement)
    with opened.connection as connection, tempfile.TemporaryDirectory(prefix="roadscan-sql-") as folder:
        if unconfined:
            connection.execute(f"SET temp_directory = '{folder}'")
        _refuse_to_fetch(connection, statement)
        try:
            with _interrupted_after(connection, limits.time_s):
                answer = _answer(connection, statement)
        except duckdb.InterruptException:
            raise _too_long(limits) from None
        except duckdb.Error as error:
            if damaged is not None:
                damaged += opened.faults()
                fault = opened.shut.get((missing_table(error) or "").removesuffix("_between"))
                if fault is not None:  # the table was made, and cannot be shown
                    damaged.remove(fault)
                    raise fault from None
            raise _in_words(error, opened.files) from error
    faults = opened.faults()
    if faults and damaged is None:
        raise faults[0]
    if damaged is not None:
        damaged += faults
    return answer


def _answer(connection: duckdb.DuckDBPyConnection, statement: str) -> pa.Table:
    """Return the answer to a statement; RoadscanError where it is larger than the memory that DuckDB may take."""
    most = _memory_bytes(connection)
    relation = connection.sql(statement)
    if relation is None:
        return pa.table({})
    reader = relation.to_arrow_reader(_BATCH_ROWS)
    parts, held = [], 0
    for part in _batches(reader):
        parts.append(part)
        held += part.nbytes
        if held > most:
            raise RoadscanError(
                f"the answer is larger than {most / 1e9:.2g} GB, after {sum(p.num_rows for p in parts):,} rows",
                change="ask for less at once (a LIMIT, a span of time), or give it more with --memory",
            )
    return pa.Table.from_batches(parts, reader.schema)


def _batches(reader: pa.RecordBatchReader) -> Iterator[pa.RecordBatch]:
    """Yield the batches of an answer; raise DuckDB's error where Arrow reports one as OSError."""
    try:
        yield from reader
    except OSError as error:
        kind = next((kind for name, kind in _LATE.items() if name in str(error)), duckdb.Error)
        raise kind(str(error)) from error


@contextlib.contextmanager
def _interrupted_after(connection: duckdb.DuckDBPyConnection, time_s: float) -> Iterator[None]:
    """Interrupt what a connection does after a time (s), unless that is 0."""
    alarm = threading.Timer(time_s, connection.interrupt)
    alarm.daemon = True
    if time_s:
        alarm.start()
    try:
        yield
    finally:
        alarm.cancel()


def _too_long(limits: Limits) -> RoadscanError:
    return RoadscanError(
        f"the query was stopped after {limits.time_s:g} s",
        change="ask for less at once (the macros TABLE_between open only the files of a span of time), or give it more "
        "time with --timeout",
    )


def _memory_bytes(connection: duckdb.DuckDBPyConnection) -> int:
    """Return the memory that DuckDB may take (bytes), of its own words such as ``9.3 GiB``."""
    ((words,),) = connection.execute("SELECT current_setting('memory_limit')").fetchall()
    number, unit = str(words).split()
    return int(float(number) * 1024 ** ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB").index(unit))


def _in_words(error: duckdb.Error, files: OpenedFiles) -> RoadscanError:
    """Return a statement's error, or its denied access, as an error of roadscan."""
    if files.refused:
        return RoadscanError(f"the query was refused: {files.refused[-1]}", change=_WAY_OUT_OF_STORE)
    text = _reason(error) if str(error).startswith("Traceback") else str(error)
    if isinstance(error, duckdb.PermissionException) or "has been locked" in text:
        return RoadscanError(
            f"the query was refused: {text.splitlines()[0]}",
            expected=f"the views, and files of the store as {PROTOCOL}://survey=…",
            change=_WAY_OUT_OF_STORE,
        )
    change = "if a file is damaged, `roadscan verify` finds it and says what to do"
    if isinstance(error, _MISTAKES):
        change = "`roadscan sql 'SHOW TABLES'` lists what there is"
    if isinstance(error, duckdb.OutOfMemoryException):
        change = (
            "ask for less at once, or give it more with --memory; with `--unconfined`, what does not fit into memory "
            "goes to a temporary folder"
        )
    return RoadscanError(f"the query failed: {text}", change=change)


def _refuse_to_fetch(connection: duckdb.DuckDBPyConnection, statement: str) -> None:
    """Raise RoadscanError where a statement would install an extension: code from the network."""
    try:
        parts = connection.extract_statements(statement)
        words = [part.query.split(None, 1)[0].lower() for part in parts if part.type == duckdb.StatementType.LOAD]
        fetches = any(word != "load" for word in words)
    except duckdb.Error:
        return  # DuckDB reports what is wrong with it
    except ValueError:  # a kind that DuckDB's Python module does not know yet: UPDATE EXTENSIONS
        fetches = True
    if fetches:
        raise RoadscanError(
            "the query was refused: it fetches an extension",
            expected="a question to what is here",
            change="install the extension with DuckDB itself, then LOAD it with `--unconfined`",
        )


def missing_table(error: BaseException | None) -> str | None:
    """Return the missing table or macro that a failed query named; None where it failed otherwise."""
    if not isinstance(error, duckdb.CatalogException):
        return None
    found = _MISSING.search(str(error))
    return None if found is None else found["name"]


def add_utc(connection: duckdb.DuckDBPyConnection) -> None:
    """Add ``utc(epoch_gps_ns)``: the UTC instant of a GPS epoch, with its zone, truncated to microseconds."""
    steps = sorted(leap_second_steps(), reverse=True)
    leaps = " ".join(f"WHEN epoch_gps_ns >= {first}000000000 THEN {count}" for first, count in steps)
    micros = f"epoch_gps_ns::BIGINT // 1000 + ({GPS_EPOCH_UNIX_S} - CASE {leaps} ELSE 0 END)::BIGINT * 1000000"
    connection.execute("SET TimeZone = 'UTC'")
    connection.execute(f"CREATE MACRO utc(epoch_gps_ns) AS make_timestamptz({micros})")


def rows_of(urls: list[str], *, hive: bool = False, filename: bool = False) -> str:
    """Return the statement that reads all rows of some files."""
    options = "hive_partitioning = true, hive_types_autocast = true" if hive else "hive_partitioning = false"
    if filename:
        options += ", filename = true"
    return f"SELECT * FROM read_parquet({_listed(urls)}, {options})"


def add_view(
    connection: duckdb.DuckDBPyConnection,
    files: OpenedFiles,
    name: str,
    rows: str,
    damaged: list[StoreError] | None,
) -> StoreError | None:
    """Create a view of what a statement reads; where that fails, add the error to `damaged` and return it."""
    files.forget()
    try:
        connection.execute(f"CREATE VIEW {name} AS {rows}")
    except duckdb.Error as error:
        fault = StoreError(
            f"table '{name}' cannot be opened: {_reason(error)}",
            change="`roadscan verify` finds damaged files and says what to do",
            file=files.last(),
        )
        if damaged is None:
            raise fault from error
        damaged.append(fault)
        return fault
    return None


def _listed(urls: Iterable[str]) -> str:
    """Return a list of files as SQL."""
    return "[" + ", ".join("'" + u.replace("'", "''") + "'" for u in sorted(urls)) + "]"


def _reason(error: duckdb.Error) -> str:
    """Return an error's message in one line; for a fault in a file's reader, DuckDB prefixes its call path."""
    lines = str(error).splitlines()
    if lines[0].startswith("Traceback"):
        return next((line for line in lines[1:] if line and not line.startswith(" ")), lines[0])
    return lines[0]
