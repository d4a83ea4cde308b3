"""Reads Parquet files that `list_table` wrote; any other content counts as damage."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.store.codecs.parquet import pages
from roadscan.store.codecs.parquet.page_file import DamageError, PageFile

Array = npt.NDArray[Any]


class ListTableFile(PageFile):
    """Columns of row groups."""

    def flat(self, name: str, values: Array) -> None:
        """Write a loaded column of non-null int64 to (n,) `values`."""
        data, at, end, _ = self.page(name, pages.PLAIN)
        if self._chunks[name].nullable or end - at != values.nbytes:
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        values[:] = data[at:end].view("<i8")

    def lists(self, name: str, values: Array) -> bool:
        """Write a loaded column of lists to (n, m) `values`; return False, without writing, where a list is null."""
        from roadscan.store.codecs.kernels.delta_packing import FAULTS, WHOLE, decode

        chunk = self._chunks[name]
        data, at, end, _ = self.page(name, pages.DELTA_BINARY_PACKED)
        rows, size = values.shape
        levels = pages.list_levels(rows, size, np.ones(rows, np.bool_) if chunk.nullable else None)
        begin = at + len(levels)
        if data[at:begin].tobytes() != levels:
            if chunk.nullable:
                return False
            raise DamageError(f"column '{name}' does not hold {rows} lists of {size} values")
        fault = decode(data, self.words, begin, end, values.reshape(-1))
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")
        return True
