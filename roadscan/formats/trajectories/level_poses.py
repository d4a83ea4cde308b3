"""Shared parts of text and Parquet logs of poses with roll, pitch and heading in named columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.ingest.reading.columns import Found, Quantity
from roadscan.ingest.reading.poses import RawPoses, check_rph, ned_from_rph
from roadscan.ingest.reading.records import Sieve

GEODETIC: Final = (
    Quantity("longitude", "angle", ("lon", "lng")),
    Quantity("latitude", "angle", ("lat",)),
    Quantity("height", "length", ("altitude", "alt", "elevation", "h-ell", "ellipsoidal_height")),
)
GRID: Final = (
    Quantity("easting", "length"),
    Quantity("northing", "length"),
    Quantity("height", "length", ("altitude", "alt", "elevation", "h-ell", "ellipsoidal_height")),
)
LOCAL: Final = (
    Quantity("easting", "length", ("x",)),
    Quantity("northing", "length", ("y",)),
    Quantity("height", "length", ("z", "altitude", "alt")),
)
ATTITUDE: Final = (Quantity("roll", "angle"), Quantity("pitch", "angle"), Quantity("heading", "angle"))
SIGMAS: Final = (
    Quantity("sigma_north", "length", ("sigma_northing",), optional=True),
    Quantity("sigma_east", "length", ("sigma_easting",), optional=True),
    Quantity("sigma_down", "length", ("sigma_height", "sigma_up"), optional=True),
)
ANGLE_SIGMAS: Final = tuple(Quantity(f"sigma_{q.name}", "angle", optional=True) for q in ATTITUDE)


VELOCITIES: Final = (
    Quantity("velocity_north", "speed", ("vn", "v_north"), optional=True),
    Quantity("velocity_east", "speed", ("ve", "v_east"), optional=True),
    Quantity("velocity_down", "speed", ("vd", "v_down"), optional=True),
    Quantity("velocity_up", "speed", ("vu", "v_up"), optional=True),
)


def position_of(crs: str) -> tuple[Quantity, ...]:
    """Return the three quantities of a position in a CRS, two horizontal ones first."""
    if crs == LOCAL_WORLD:
        return LOCAL
    return GRID if crs_from_text(crs).is_projected else GEODETIC


def pose_quantities(crs: str) -> tuple[Quantity, ...]:
    """Return all quantities of a pose in a CRS except its time: position, attitude, their σ, and velocity."""
    return (*position_of(crs), *ATTITUDE, *SIGMAS, *ANGLE_SIGMAS, *VELOCITIES)


@dataclass(frozen=True)
class Records:
    """Places of a block's records in their log."""

    numbers: Int64
    """(n,) record numbers."""
    offsets: Int64
    """(n,) byte offsets, −1 where there are none."""
    stamps: npt.NDArray[np.generic]
    """(n,) time stamps."""


def level_poses(
    records: Records, crs: str, columns: Mapping[str, Found], number: Callable[[str], Float64], sieve: Sieve
) -> RawPoses:
    """Return the poses of a block; a record with an impossible attitude is dropped from `sieve`.

    Parameters
    ----------
    columns : column of each quantity that the log has, by quantity.
    number : gives the values (n,) of a column, NaN where one is missing.
    """

    def quantity(name: str) -> Float64:
        found = columns[name]
        with np.errstate(over="ignore"):
            return number(found.column) * found.scale

    def velocity() -> Float64 | None:
        north, east, down, up = (quantity(q.name) if q.name in columns else None for q in VELOCITIES)
        down = -up if down is None and up is not None else down
        if north is None or east is None:
            return None
        return np.stack([north, east, np.full_like(north, np.nan) if down is None else down])

    roll, pitch, heading = (quantity(q.name) for q in ATTITUDE)
    check_rph(roll, pitch, heading, sieve)
    with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
        attitude = ned_from_rph(roll, pitch, heading)
    return RawPoses(
        records=records.numbers,
        offsets=records.offsets,
        stamps=records.stamps,
        position=np.stack([quantity(q.name) for q in position_of(crs)]),
        attitude=attitude,
        sigmas={f"{q.name}_m": quantity(q.name) for q in SIGMAS if q.name in columns}
        | {f"{q.name}_deg": np.degrees(quantity(q.name)) for q in ANGLE_SIGMAS if q.name in columns},
        velocity=velocity(),
    )
