"""Records of outputs as rows of tables: each finished file with its key; the last record of an output is valid."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic_core import from_json

from roadscan.store.digest import UNREADABLE, check_seal, sealed_parquet, without_seal

RECORDS: Final = pa.schema(
    [
        ("product", pa.string()),
        ("unit", pa.string()),
        ("key", pa.string()),
        ("path", pa.string()),
        ("bytes", pa.int64()),
        ("digest", pa.string()),
        ("detail", pa.string()),
    ]
)

_GROUP_ROWS: Final = 8192
"""Rows of a row group, which a damaged page loses at most."""

Row: TypeAlias = tuple[str, str, str, str, int, str, str]


class OutputRecord(NamedTuple):
    """One finished file (or a finished unit without a file, where `path` is empty). A network has millions."""

    product: str
    """Product, or 'footprints', or 'tile' for the tile as a whole."""
    unit: str
    """Tile id, output name, or log key."""
    key: str
    """Hash of its inputs, relevant configuration and code; empty where the output is deleted."""
    path: str
    """Relative to the survey's root."""
    bytes: int
    digest: str
    """BLAKE3-128 of the file."""
    detail: str = ""
    """JSON with figures for later stages."""

    def figures(self) -> dict[str, Any]:
        """Return the detail as values."""
        return figures_in(self.detail)


def figures_in(detail: str) -> dict[str, Any]:
    """Return a record's detail as values; ValueError where it is no JSON."""
    return dict(from_json(detail)) if detail else {}  # a third of the time of Python's own


def table_of(records: Sequence[Row]) -> pa.Table:
    """Return records as a table."""
    columns = list(zip(*records, strict=True)) or [()] * len(RECORDS)
    return pa.Table.from_arrays([pa.array(c, f.type) for c, f in zip(columns, RECORDS, strict=True)], schema=RECORDS)


def rows_of(table: pa.Table) -> list[Row]:
    """Return the rows of a table as plain tuples, because Python's collector scans named ones again and again."""
    return list(zip(*(table.column(f.name).to_pylist() for f in RECORDS), strict=True))


@dataclass(frozen=True)
class Packed:
    """Records as the Parquet file that the manifest stores: made by a worker, written by its run."""

    content: bytes
    rows: int

    @classmethod
    def of(cls, table: pa.Table, compression: str = "none") -> Packed:
        """Return a packed table of records; compression, for long storage, takes twice the time."""
        content = sealed_parquet(
            table, row_group_size=_GROUP_ROWS, compression=compression, use_dictionary=["product"],
            write_statistics=False,
        )  # fmt: skip
        return cls(content, table.num_rows)

    def table(self) -> pa.Table:
        """Return the records."""
        return unpacked(self.content)


def unpacked(content: bytes) -> pa.Table:
    """Return the records of such a file; read by this thread alone, as :meth:`Store.read_table` does.

    Raises
    ------
    ValueError
        where its seal does not hold.
    """
    check_seal(content)
    file = _opened(content)
    groups = (file.read_row_group(k, use_threads=False) for k in range(file.num_row_groups))  # less memory than at once
    return without_seal(pa.concat_tables([file.schema_arrow.empty_table(), *groups]))


def sound_rows(content: bytes) -> tuple[pa.Table, str]:
    """Return the records of such a file without damaged row groups, and what is wrong with these ("" for nothing)."""
    try:
        return unpacked(content).cast(RECORDS), ""
    except UNREADABLE as error:
        reason = str(error)
    sound, groups = [RECORDS.empty_table()], 0
    with contextlib.suppress(*UNREADABLE):
        file = _opened(content)
        groups = file.num_row_groups
        for group in range(groups):
            with contextlib.suppress(*UNREADABLE):
                sound.append(file.read_row_group(group, use_threads=False).cast(RECORDS))
    if len(sound) > groups:  # the pages hold, so the damage is in the footer, which says what they mean
        return RECORDS.empty_table(), reason
    return pa.concat_tables(sound), reason


def _opened(content: bytes) -> pq.ParquetFile:
    return pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)


def latest(table: pa.Table, *, forgotten: bool = False) -> tuple[pa.Table, list[str]]:
    """Return the last row of each product and unit, sorted by both; and the files that a later record replaced.

    Parameters
    ----------
    table : records in the order in which they were made.
    forgotten : keep the rows that forget a record.
    """
    if not forgotten and _is_latest(table):
        return table, []
    table = table.combine_chunks()
    place = _places(table)
    order = np.argsort(place, kind="stable")
    again = place[order[1:]] == place[order[:-1]]
    known = pc.not_equal(table.column("key"), "").to_numpy()
    moved = _moved(table, order, again, known) if again.any() else []
    last = order[np.append(~again, np.ones(min(order.size, 1), bool))]
    return table.take(pa.array(last if forgotten else last[known[last]])), moved


def _is_latest(table: pa.Table) -> bool:
    """Return whether records stand by product and unit, each once and none forgotten, as they are compacted."""
    before, after = ([rows.column(name) for name in ("product", "unit")] for rows in (table[:-1], table[1:]))
    within = pc.and_(pc.equal(before[0], after[0]), pc.less(before[1], after[1]))
    ordered = pc.all(pc.or_(pc.less(before[0], after[0]), within)).as_py()
    return ordered is not False and not pc.any(pc.equal(table.column("key"), "")).as_py()


def _places(table: pa.Table) -> npt.NDArray[np.int64]:
    """Return (rows,) numbers that order the rows by product and unit."""
    (product, _), (unit, units) = (_ranks(table.column(name)) for name in ("product", "unit"))
    return product * units + unit


def _ranks(column: pa.ChunkedArray) -> tuple[npt.NDArray[np.int64], int]:
    """Return the rank (rows,) of each text among the distinct ones, and their number."""
    coded = _codes(column)
    rank = np.empty(len(coded.dictionary), np.int64)
    rank[pc.array_sort_indices(coded.dictionary).to_numpy()] = np.arange(rank.size)
    return rank[coded.indices.to_numpy()], rank.size


def _codes(column: pa.ChunkedArray) -> pa.DictionaryArray:
    """Return a column as indices of its distinct texts."""
    return column.combine_chunks().dictionary_encode()


def _moved(
    table: pa.Table, order: npt.NDArray[np.int64], again: npt.NDArray[np.bool_], known: npt.NDArray[np.bool_]
) -> list[str]:
    """Return files that the output's next record replaces by another, and that no later record names again."""
    path = _codes(table.column("path"))
    code = path.indices.to_numpy()[order]
    nowhere = pc.index(path.dictionary, "").as_py()
    last = np.zeros(len(path.dictionary), np.int64)
    np.maximum.at(last, code, np.arange(code.size))
    at = np.flatnonzero(again & (code[1:] != code[:-1]) & (code[:-1] != nowhere) & known[order[1:]])
    at = at[last[code[at]] == at]
    return list(path.dictionary.take(pa.array(code[at])).to_pylist())
