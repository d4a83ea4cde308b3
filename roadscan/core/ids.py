"""Identifiers: runs, passes, tiles."""

from __future__ import annotations

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
