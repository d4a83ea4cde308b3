"""The grid: tiles and cells of the map."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, NewType, Self, TypeVar

from roadscan.core.errors import ConfigError

RunId = NewType("RunId", str)
"""One recorded drive, from switching on to switching off."""

ALL_RUNS: Final = "*"
"""Matches every run in values that apply to a sensor: its mounting, its clock."""

_Held = TypeVar("_Held")


def of_run(held: Mapping[tuple[str, str], _Held], run: str, sensor: str) -> _Held | None:
    """Return the value for a sensor in a run from values by run and sensor: the run's, else that of all runs."""
    return held.get((run, sensor)) or held.get((ALL_RUNS, sensor))


PassId = NewType("PassId", int)
"""Number of one traverse of a lane, 1–65,535; the `point_source_id` of LAS."""


@dataclass(frozen=True, order=True)
class LanePass:
    """One traverse of a lane by one run."""

    pass_id: PassId
    run: RunId
    start_gps_ns: int
    """First epoch (inclusive)."""
    end_gps_ns: int
    """Last epoch (exclusive)."""
    lane: str = ""
    direction: str = ""

    def __post_init__(self) -> None:
        if not 1 <= self.pass_id <= 65_535:
            raise ConfigError(f"pass id {self.pass_id}", expected="a number from 1 to 65535")
        if self.end_gps_ns <= self.start_gps_ns:
            raise ConfigError(f"pass {self.pass_id} ends before it starts", change="swap its start and end")


_TILE = re.compile(r"^(-?\d+)[_,](-?\d+)$")


class TileId(NamedTuple):
    """A tile of the survey's grid: column counts east, row counts north. A network has millions.

    The tile covers easting [column, column + 1) · size and northing [row, row + 1) · size.
    """

    column: int
    row: int

    def __str__(self) -> str:
        return f"{self.column}_{self.row}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``"62342_484882"`` (or with a comma)."""
        found = _TILE.match(text.strip())
        if found is None:
            raise ConfigError(f"tile '{text}'", expected="COLUMN_ROW, such as 62342_484882")
        return cls(int(found[1]), int(found[2]))


QUANTUM_M: Final = 1e-5
"""Point coordinates are whole multiples of this (10 µm), so that sums are exact and independent of order."""
QUANTA_PER_M: Final = 100_000
"""Coordinate quanta in a metre."""
ENOUGH: Final = 4
"""Readings that a cell should contain: with fewer, the median cannot exclude an outlier."""
LARGEST_M: Final = 1.0
"""Largest cell that is proposed (m)."""


@dataclass(frozen=True)
class Bounds:
    """A box in the map frame (metres), lower edges inclusive, upper exclusive."""

    easting_min_m: float
    northing_min_m: float
    easting_max_m: float
    northing_max_m: float

    def meets(self, other: Bounds) -> bool:
        """Return whether two boxes overlap."""
        return (
            self.easting_min_m < other.easting_max_m
            and other.easting_min_m < self.easting_max_m
            and self.northing_min_m < other.northing_max_m
            and other.northing_min_m < self.northing_max_m
        )


@dataclass(frozen=True)
class TileGrid:
    """Square tiles of the map, each cut into square cells, anchored at the map's origin."""

    size_m: float = 10.0
    cell_m: float = 0.05

    def __post_init__(self) -> None:
        if abs(self.size_m * QUANTA_PER_M - self.size_quanta) > 1e-6:
            raise ConfigError(f"tile size {self.size_m} m", expected="a whole number of 10 µm")
        if self.size_quanta % self.cells_per_edge:
            raise ConfigError(f"cell {self.cell_m} m", expected="a cell edge of whole 10 µm that divides the tile")

    @property
    def size_quanta(self) -> int:
        """Edge of a tile in quanta."""
        return round(self.size_m * QUANTA_PER_M)

    @property
    def cells_per_edge(self) -> int:
        """Cells along a tile's edge."""
        return round(self.size_m / self.cell_m)

    @property
    def cell_quanta(self) -> int:
        """Edge of a cell in quanta."""
        return self.size_quanta // self.cells_per_edge

    def tile_at(self, easting_m: float, northing_m: float) -> TileId:
        """Return the tile that contains a position (m)."""
        return TileId(
            math.floor(easting_m * QUANTA_PER_M) // self.size_quanta,
            math.floor(northing_m * QUANTA_PER_M) // self.size_quanta,
        )

    def bounds(self, tile: TileId) -> Bounds:
        """Box of a tile (m)."""
        e, n = tile.column * self.size_m, tile.row * self.size_m
        return Bounds(e, n, e + self.size_m, n + self.size_m)

    def tiles_in(self, box: Bounds) -> list[TileId]:
        """Return the tiles that overlap a box, by row and column."""
        first = self.tile_at(box.easting_min_m, box.northing_min_m)
        end_column = math.ceil(box.easting_max_m / self.size_m)
        end_row = math.ceil(box.northing_max_m / self.size_m)
        return [TileId(c, r) for r in range(first.row, end_row) for c in range(first.column, end_column)]
