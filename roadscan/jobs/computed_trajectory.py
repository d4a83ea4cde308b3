"""A computed trajectory: rows of its tables, figures for its record, and a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.tables.schema import table_schema

Float64 = npt.NDArray[np.float64]
Rows = tuple[str, pa.RecordBatch]

NAVIGATION: Final = "navigation"
"""Sensor of the records of computed trajectories."""

_ROWS: Final = 1 << 18


@dataclass(frozen=True)
class Computed:
    """What came of computing a trajectory."""

    rows: Iterator[Rows]
    """Tables and rows."""
    attributes: dict[str, Any]
    """Of its record: the world frame, the logs it was made from, figures."""
    draw: Callable[[Path], None] | None = None
    """Writes a picture of it."""


class PlannedTrajectory(Protocol):
    """A trajectory to compute."""

    @property
    def run(self) -> str:
        """Run it belongs to."""

    @property
    def format(self) -> str:
        """What computes it: `smoother` or `spline`."""

    @property
    def key(self) -> str:
        """Hash of the logs, settings and code that it is made from."""

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Compute it."""


def trajectory_rows(
    epochs_gps_ns: npt.NDArray[np.int64],
    position_world_m: Float64,
    quaternion_world_from_body: Float64,
    sigma_ned_m: Float64,
    sigma_rph_rad: Float64,
) -> Iterator[Rows]:
    """Rows of the table ``trajectory``; σ that are NaN become nulls."""
    columns: dict[str, npt.NDArray[Any]] = {"epoch_gps_ns": epochs_gps_ns}
    columns |= {f"{a}_world_m": position_world_m[:, i] for i, a in enumerate("xyz")}
    columns |= {q: quaternion_world_from_body[:, i] for i, q in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {f"sigma_{a}_m": sigma_ned_m[:, i] for i, a in enumerate(("north", "east", "down"))}
    columns |= {f"sigma_{a}_deg": np.degrees(sigma_rph_rad[:, i]) for i, a in enumerate(("roll", "pitch", "heading"))}
    yield from table_rows("trajectory", columns)


def table_rows(table: str, columns: dict[str, npt.NDArray[Any]]) -> Iterator[Rows]:
    """Rows of a table in pieces; NaN become nulls."""
    schema = table_schema(table).arrow()
    for start in range(0, columns["epoch_gps_ns"].size, _ROWS):
        part = slice(start, start + _ROWS)
        arrays = {
            name: pa.array(values[part], from_pandas=True).cast(schema.field(name).type, safe=False)
            for name, values in columns.items()
        }
        yield table, pa.RecordBatch.from_pydict(arrays)
