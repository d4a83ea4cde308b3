"""How many passes should have seen a place."""

from __future__ import annotations

from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.model.errors import SchemaError

NOT_KNOWN: Final = -1


class Visibility(Protocol):
    """What a survey tells of the passes that had a place in sight."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """(n,) passes that should have seen assets of a kind, -1 where that is not known.

        Parameters
        ----------
        places_m : (n, 3) easting, northing, height of their reference points in the map (m).
        """


class Unknown:
    """A survey that does not tell."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """-1 everywhere."""
        return np.full(len(places_m), NOT_KNOWN, dtype=np.int64)


class VisibilityGrid:
    """Passes by cell of a grid of the map; places in no cell were seen by none.

    Parameters
    ----------
    cells : columns `column`, `row` (whole numbers: easting and northing of the cell's south-west corner divided by its
        edge), `passes`; a cell names the passes that had it in sight. With a column `kind`, rows count for that kind
        alone, those with null for all kinds that no row names.
    edge_m : edge of a cell.

    Raises
    ------
    SchemaError
        where a column is missing.
    """

    def __init__(self, cells: pa.Table, edge_m: float) -> None:
        missing = [name for name in ("column", "row", "passes") if name not in cells.column_names]
        if missing:
            raise SchemaError(f"the table of visibility has no column '{missing[0]}'", expected="column, row, passes")
        self.edge_m = edge_m
        kinds = cells["kind"].to_pylist() if "kind" in cells.column_names else [None] * cells.num_rows
        self._passes: dict[str | None, dict[tuple[int, int], int]] = {}
        columns: list[list[Any]] = [cells[name].to_pylist() for name in ("column", "row", "passes")]
        for kind, column, row, passes in zip(kinds, *columns, strict=True):
            self._passes.setdefault(kind, {})[column, row] = passes

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Passes of the cells that the places lie in."""
        cells = self._passes.get(kind, self._passes.get(None, {}))
        keys = np.floor(places_m[:, :2] / self.edge_m).astype(np.int64).tolist()
        return np.array([cells.get((column, row), 0) for column, row in keys], dtype=np.int64)
