"""Number of passes that should have seen a place."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.visibility import BANDS_M, PASSES
from roadscan.core.errors import SchemaError
from roadscan.core.ids import TileId
from roadscan.store.asset_schema import asset_schema

NOT_KNOWN: Final = -1  # Passes where it is not known how many there were.
_HELD_SQUARES: Final = 4096
"""Squares kept in memory, some 50 kB each."""
_EDGE: Final = b"edge_m"


class Visibility(Protocol):
    """Passes of a survey that had places in sight."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes (n,) that should have seen assets of a kind, -1 where that is not known.

        Parameters
        ----------
        places_m : (n, 3) easting, northing, height of their reference points in the map (m).
        """


class Unknown:
    """A survey without such figures."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns -1 everywhere."""
        return np.full(len(places_m), NOT_KNOWN, dtype=np.int64)


class VisibilityGrid:
    """Passes by cell of a grid of the map and height above the ground; places in no cell were seen by none.

    A point asset reaches upwards: it was in sight if the band of its place was, or the band above. Of lines
    and areas the place itself counts.

    Parameters
    ----------
    cells : columns as the table `asset_visibility` has them; its metadata `edge_m` states the edge of a cell (m).

    Raises
    ------
    SchemaError
        where a column is missing, or the edge is not stated.
    """

    def __init__(self, cells: pa.Table) -> None:
        wanted = ("column", "row", "ground_height_m", *PASSES)
        missing = [name for name in wanted if name not in cells.column_names]
        edge = (cells.schema.metadata or {}).get(_EDGE)
        if missing or edge is None:
            lacks = f"has no column '{missing[0]}'" if missing else "does not state the edge of its cells (`edge_m`)"
            raise SchemaError(f"the table of visibility {lacks}", expected=", ".join(wanted))
        self.edge_m = float(edge)
        keys = _keys(*(np.asarray(cells[name].to_numpy(), np.int64) for name in ("column", "row")))
        order = np.argsort(keys)
        self._keys = keys[order]
        self._ground_m = cells["ground_height_m"].to_numpy()[order]
        passes = np.stack([np.asarray(cells[name].to_numpy(), np.int32) for name in PASSES], axis=1)
        self._passes = passes[order]

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes of the cells in which the places lie."""
        out = np.zeros(len(places_m), dtype=np.int64)
        cell = np.floor(places_m[:, :2] / self.edge_m).astype(np.int64)
        keys = _keys(cell[:, 0], cell[:, 1])
        at = np.minimum(np.searchsorted(self._keys, keys), max(self._keys.size - 1, 0))
        held = np.flatnonzero(self._keys[at] == keys) if self._keys.size else np.zeros(0, np.int64)
        at = at[held]
        above_m = places_m[held, 2] - self._ground_m[at]
        band = np.clip(np.searchsorted(BANDS_M, above_m, side="right") - 1, 0, len(PASSES) - 1)
        out[held] = self._passes[at, band]
        if asset_schema(kind).geometry == "PointZ":
            over = np.minimum(band + 1, len(PASSES) - 1)
            out[held] = np.maximum(out[held], self._passes[at, over])
        return out


class VisibilityOfSquares:
    """Passes of a survey whose squares are read one by one, on demand.

    Parameters
    ----------
    edge_m : edge of the squares (m).
    read : returns the cells of a square; None where no sensor looked there.
    """

    def __init__(self, edge_m: float, read: Callable[[TileId], pa.Table | None]) -> None:
        self._edge_m = edge_m

        @lru_cache(_HELD_SQUARES)
        def grid(square: TileId) -> VisibilityGrid | None:
            cells = read(square)
            return None if cells is None else VisibilityGrid(cells)

        self._grid = grid

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes of the cells in which the places lie; none where no sensor looked."""
        out = np.zeros(len(places_m), dtype=np.int64)
        of_place = np.floor(places_m[:, :2] / self._edge_m).astype(np.int64)
        squares, number = np.unique(of_place, axis=0, return_inverse=True)
        order = np.argsort(number.reshape(-1), kind="stable")
        ends = np.searchsorted(number.reshape(-1)[order], np.arange(len(squares) + 1))
        for at, (column, row) in enumerate(squares.tolist()):
            own = order[ends[at] : ends[at + 1]]
            grid = self._grid(TileId(column, row))
            if grid is not None:
                out[own] = grid.expected_passes(kind, places_m[own])
        return out


def _keys(column: npt.NDArray[np.int64], row: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Returns one number for each cell."""
    return np.asarray((row << 32) + column)
