"""Salvages the sound rows of a damaged file whose log cannot be read again, and lists what is lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import StoreError, may_pass
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.store.digest import UNREADABLE, checked_json, parse_checked
from roadscan.store.logs import DataFile, data_file
from roadscan.store.readings.packed_returns import stored_schema
from roadscan.store.store import Store
from roadscan.store.writer import describe, write_parquet

_LOST: Final = "manifest/lost.json"


@dataclass(frozen=True)
class Lost:
    """Rows of a log that the store has lost."""

    log: str
    """Key of the log."""
    table: str
    file: DataFile
    """The file as it was when undamaged."""
    rows: int
    spans: tuple[tuple[int, int], ...]
    """First and last epoch (GPS ns) of each lost part; empty for tables without epochs."""
    aside: str
    """Path of the damaged file that was set aside; empty where it was missing."""
    accepted: bool = False
    """True once the user accepted that the store continues without them."""

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        told = {"file": self.file.path, "table": self.table, "rows": self.rows, "accepted": self.accepted}
        return {**told, "told": self.told}

    def __str__(self) -> str:
        """Return in words what is lost."""
        kept = f"; the damaged file is kept ({self.aside})" if self.aside else ""
        agreed = " (accepted)" if self.accepted else ""
        rows = f"{self.rows:,} of {self.file.rows:,} rows are lost{agreed}"
        return f"{self.file.path}: {rows}{_between(self.spans)}{kept}"

    @property
    def told(self) -> str:
        """Return the same, with what can be done about it."""
        accept = "" if self.accepted else ", or accept that they are gone: `roadscan verify --accept-losses`"
        return f"{self}; put the log back and repeat `roadscan verify --repair`{accept}"


def _between(spans: Sequence[tuple[int, int]]) -> str:
    if not spans:
        return ""
    first, last = min(s[0] for s in spans), max(s[1] for s in spans)
    return f", {iso_from_gps_ns(first)} to {iso_from_gps_ns(last)}"


def salvaged(
    store: Store, table: str, file: DataFile, to: Path
) -> tuple[DataFile | None, int, tuple[tuple[int, int], ...]]:
    """Write the sound row groups of a damaged file to a local one.

    Returns
    -------
    kept : record entry of the local file; None where no row group is sound.
    lost, spans : rows that are lost, and the epochs (GPS ns) of each row group that is.

    Damage beside the rows (in the footer, say) loses none: the same rows make the same bytes, which the recorded digest
    confirms.
    """
    groups = _sound_groups(store, table, file)
    gone = [number for number, group in enumerate(groups) if group is None]
    sound = [group for group in groups if group is not None]
    if not sound:
        return None, file.rows, tuple(file.group_spans)
    rows = pa.concat_tables(sound)
    schema = stored_schema(table, rows.schema.names)
    if not schema.holds:
        rows = rows.replace_schema_metadata(None)  # the footer has a separate checksum
    write_parquet(to, rows, schema)
    kept = describe(to, file.path)
    spans = tuple(file.group_spans[number] for number in gone) if file.group_spans else ()
    return kept, sum(file.group_rows[number] for number in gone), spans


def _sound_groups(store: Store, table: str, file: DataFile) -> list[pa.Table | None]:
    """Return each row group as a table, None where it is damaged."""
    none: list[pa.Table | None] = [None] * len(file.group_rows)
    try:
        opened = pq.ParquetFile(pa.BufferReader(store.read_bytes(file.path)), page_checksum_verification=True)
        if opened.num_row_groups != len(none):
            return none
    except (*UNREADABLE, StoreError) as error:
        if may_pass(error):  # the rows are not lost because a place does not answer
            raise
        return none
    return [_sound_group(opened, number, table, file) for number in range(len(none))]


def _sound_group(opened: pq.ParquetFile, number: int, table: str, file: DataFile) -> pa.Table | None:
    """Return a row group with valid page checksums whose columns, rows and epochs are as recorded; else None."""
    try:
        rows = opened.read_row_group(number, use_threads=False)
        rows.validate(full=True)
    except UNREADABLE:
        return None
    known = {column.name for column in stored_schema(table, rows.schema.names).columns}
    if not known <= set(rows.schema.names) or rows.num_rows != file.group_rows[number]:
        return None
    if file.group_spans:
        epochs = rows.column("epoch_gps_ns").to_numpy()
        if (int(np.min(epochs)), int(np.max(epochs))) != tuple(file.group_spans[number]):
            return None
    return rows


def read_lost(store: Store) -> list[Lost]:
    """Return rows that were lost and not read again; none where the list is damaged (the damaged files are kept)."""
    if not store.exists(_LOST):
        return []
    try:
        return list(map(_parsed, parse_checked(store.read_bytes(_LOST))["lost"]))
    except (StoreError, ValueError, KeyError, TypeError):
        return []


def write_lost(store: Store, lost: Sequence[Lost]) -> None:
    """Replace the list."""
    if lost or store.exists(_LOST):
        store.write_bytes(_LOST, checked_json({"lost": list(map(_values, lost))}))


def _values(one: Lost) -> dict[str, Any]:
    """Return what :func:`_parsed` reads."""
    spans = [list(span) for span in one.spans]
    return {f.name: getattr(one, f.name) for f in dataclasses.fields(one)} | {
        "file": one.file.as_json(),
        "spans": spans,
    }


def _parsed(raw: dict[str, Any]) -> Lost:
    spans: Iterator[tuple[int, int]] = ((int(first), int(last)) for first, last in raw["spans"])
    return Lost(**{**raw, "file": data_file(raw["file"]), "spans": tuple(spans)})
