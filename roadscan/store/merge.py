"""Merges sorted files of one partition in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.schema import TableSchema


def merged(paths: Sequence[Path], schema: TableSchema, rows: int) -> Iterator[pa.Table]:
    """Yield the rows of files that are each sorted by the schema, in common order; equal keys keep the files' order.

    Only the sort columns are in memory as a whole. Of each file, a piece of the result needs rows that follow one
    another, so just their row groups are read.

    Parameters
    ----------
    rows : rows of each table that is yielded; the last holds what remains.
    """
    files = [pq.ParquetFile(path) for path in paths]
    keys = [pa.concat_tables([f.read(columns=[name]) for f in files]).column(0).to_numpy() for name in schema.sort]
    order = np.lexsort(keys[::-1])
    starts = np.cumsum([0, *(f.metadata.num_rows for f in files)])
    for first in range(0, order.size, rows):
        chosen = order[first : first + rows]
        place = np.empty(chosen.size, np.int64)
        pieces: list[pa.Table] = []
        held = 0
        for file, low, high in zip(files, starts[:-1], starts[1:], strict=True):
            own = (chosen >= low) & (chosen < high)
            if not own.any():
                continue
            begin, end = int(chosen[own].min() - low), int(chosen[own].max() - low) + 1
            place[own] = chosen[own] - low - begin + held
            pieces.append(_rows(file, begin, end))
            held += end - begin
        table = pa.concat_tables(pieces)
        yield table if np.array_equal(place, np.arange(held)) else table.take(pa.array(place))


def _rows(file: pq.ParquetFile, begin: int, end: int) -> pa.Table:
    """Return rows [begin, end) of a file."""
    counts = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
    starts = np.cumsum([0, *counts])
    one = int(np.searchsorted(starts, begin, "right")) - 1
    other = int(np.searchsorted(starts, end, "left"))
    return file.read_row_groups(list(range(one, other))).slice(begin - int(starts[one]), end - begin)
