"""A computed trajectory: rows of its tables, and figures for its record."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.store.schema import table_schema

Rows = tuple[str, pa.RecordBatch]


_ROWS: Final = 1 << 18  # Rows that are written at a time.


@dataclass(frozen=True)
class Computed:
    """A computed trajectory."""

    rows: Iterator[Rows]
    """Tables and rows."""
    attributes: dict[str, Any]
    """Attributes of its record: the world frame, the logs it was computed from, statistics."""


class PlannedTrajectory(Protocol):
    """A trajectory to compute."""

    @property
    def run(self) -> str:
        """Run it belongs to."""

    @property
    def format(self) -> str:
        """Name of the method: `smoother`, `spline` or `odometry`."""

    @property
    def key(self) -> str:
        """Hash of the logs, settings and code that determine it."""

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Compute it."""


def sigma_figures(sigma_ned_m: Float64) -> dict[str, float]:
    """Return median and largest σ (m) of a trajectory, horizontal and down, for its record; empty where not stated.

    sigma_ned_m : (n, 3), NaN where unknown.
    """
    known = sigma_ned_m[np.isfinite(sigma_ned_m).all(axis=1)]
    if not known.size:
        return {}
    found: dict[str, float] = {}
    for name, values in (("horizontal", np.hypot(known[:, 0], known[:, 1])), ("down", known[:, 2])):
        found |= {f"median_sigma_{name}_m": float(np.median(values)), f"largest_sigma_{name}_m": float(values.max())}
    return found


def trajectory_rows(
    epochs_gps_ns: npt.NDArray[np.int64],
    position_world_m: Float64,
    quaternion_world_from_body: Float64,
    sigma_ned_m: Float64,
    sigma_rph_rad: Float64,
) -> Iterator[Rows]:
    """Yield rows of the table ``trajectory``; σ that are NaN become nulls."""
    columns: dict[str, npt.NDArray[Any]] = {"epoch_gps_ns": epochs_gps_ns}
    columns |= {f"{a}_world_m": position_world_m[:, i] for i, a in enumerate("xyz")}
    columns |= {q: quaternion_world_from_body[:, i] for i, q in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {f"sigma_{a}_m": sigma_ned_m[:, i] for i, a in enumerate(("north", "east", "down"))}
    columns |= {f"sigma_{a}_deg": np.degrees(sigma_rph_rad[:, i]) for i, a in enumerate(("roll", "pitch", "heading"))}
    yield from table_rows("trajectory", columns)


def table_rows(table: str, columns: dict[str, npt.NDArray[Any]]) -> Iterator[Rows]:
    """Yield rows of a table in pieces; NaN become nulls."""
    schema = table_schema(table).arrow()
    for start in range(0, columns["epoch_gps_ns"].size, _ROWS):
        part = slice(start, start + _ROWS)
        arrays = {
            name: pa.array(values[part], from_pandas=True).cast(schema.field(name).type, safe=False)
            for name, values in columns.items()
        }
        yield table, pa.RecordBatch.from_pydict(arrays)
