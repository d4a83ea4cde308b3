"""Converts GNSS solutions of logs to the columns of the `gnss` table.

As with poses, everything is *component first*: positions are (3, n). Errors are stated in the local
level, north-east-down; covariances of logs that count up are negated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text, geodetic_from_world, world_frame_of
from roadscan.core.errors import ConfigError, CrsError, Missing, TimeSystemError
from roadscan.core.gpstime import WEEKS_A_ROLLOVER, Clock, TimeSystem
from roadscan.ingest.reading.format import Item, LogSource
from roadscan.ingest.reading.poses import BlockPlacer, Placement, WorldPlacement, block_rows, check_sigmas
from roadscan.ingest.reading.records import Sieve

QUALITIES: Final = (
    "none", "fixed", "float", "sbas", "dgps", "ppp", "pps", "single", "dead_reckoning", "manual", "simulated",
)  # fmt: skip
"""Kinds of solutions (column `quality`); a quality is stored as its index in this list."""
StatedQuality: TypeAlias = Literal["single", "sbas", "dgps", "float", "fixed", "ppp"]
"""Kinds that a setting may state where a log says none."""
NO_POSITION: Final = 0  # index of `none`
UNKNOWN_QUALITY: Final = -1  # a kind that is not in `QUALITIES`

VELOCITY_MAX_M_PER_S: Final = 1e4
"""A larger velocity is damage."""

_ANGLES: Final = ("course_deg", "heading_deg", "roll_deg", "pitch_deg")


@dataclass(frozen=True)
class RawSolutions:
    """A block of solutions."""

    records: Int64
    """(n,) record numbers."""
    offsets: Int64
    """(n,) byte offsets."""
    epochs: Int64
    """(n,) GPS nanoseconds."""
    position: Float64
    """(3, n) in the units of the log's :class:`Placement`; ignored where there is none."""
    quality: Int64
    """(n,) indices of :data:`QUALITIES`; `NO_POSITION` where the epoch has no position."""
    columns: dict[str, Float64]
    """Further columns of `gnss` by name, (n,) with NaN where missing."""


def utc_clock(source: LogSource, says: str) -> Clock:
    """Return the clock of a log whose times are always UTC, in ns, whether stated or not.

    says : why they are UTC.

    Raises
    ------
    TimeSystemError
        where the survey file states another time system.
    """
    stated = source.clock
    if stated is not None and stated.system is not TimeSystem.UNIX_UTC:
        raise TimeSystemError(
            f"{says}, the clock says {stated.system}",
            expected='clock.system = "unix_utc", or no clock',
            file=source.path,
            missing=Missing("clock", {"system": "unix_utc"}),
        )
    return replace(stated or Clock(TimeSystem.UNIX_UTC), unit="ns")


def gps_clock(source: LogSource, says: str, week: int | None = None) -> Clock:
    """Return the clock of a log that states week and seconds of GPS time, in ns since 1980, whether stated or not.

    Parameters
    ----------
    says : what states them, in words.
    week : GPS week of the first record, where known.

    Raises
    ------
    TimeSystemError
        where the survey file states another time system, or another week.
    """
    stated = source.clock
    if stated is not None and stated.system not in (TimeSystem.GPS, TimeSystem.GPS_WEEK):
        raise TimeSystemError(
            f"{says} GPS time, the clock says {stated.system}",
            expected='clock.system = "gps", or no clock',
            file=source.path,
            missing=Missing("clock", {"system": "gps"}),
        )
    is_weekly = stated is not None and stated.system is TimeSystem.GPS_WEEK and stated.week != 0
    if stated is not None and is_weekly and week is not None and (stated.first_week() - week) % WEEKS_A_ROLLOVER:
        raise TimeSystemError(
            f"the log begins in GPS week {week}, its clock says week {stated.first_week()}",
            expected="one GPS week",
            change="leave the clock out",
            file=source.path,
            missing=Missing("clock", {"system": "gps"}),
        )
    return replace(stated or Clock(TimeSystem.GPS), system=TimeSystem.GPS, unit="ns", week=None, date=None)


class GnssReader:
    """Converts the blocks of one log to rows of `gnss` and rejects."""

    def __init__(self, source: LogSource, placement: Placement) -> None:
        self._placement = placement
        self._placer = BlockPlacer(placement, source.path)

    def items(self, raw: RawSolutions, sieve: Sieve) -> Iterator[Item]:
        """Yield the rows of a block's sound solutions, then its rejects.

        Raises
        ------
        CrsError
            if the stated CRS fits no position of the log's first block.
        """
        _check(raw.columns, sieve)
        world = self._world(raw, sieve)
        if sieve.good.any():
            good = sieve.kept
            arrays = {"epoch_gps_ns": pa.array(raw.epochs[good])}
            arrays |= {f"{a}_world_m": pa.array(v[good], from_pandas=True) for a, v in zip("xyz", world, strict=True)}
            arrays["quality"] = pa.array(QUALITIES).take(pa.array(raw.quality[good]))
            for name, values in raw.columns.items():
                column = pa.array(values[good], from_pandas=True)  # NaN becomes null
                arrays[name] = column.cast(pa.uint8()) if name == "satellites" else column
            yield block_rows("gnss", arrays, raw.records[good], raw.offsets[good])
        yield from sieve.rejects(raw.records, raw.offsets)

    def _world(self, raw: RawSolutions, sieve: Sieve) -> Float64:
        """Return world positions (3, n), NaN where there is none."""
        world = np.full(raw.position.shape, np.nan)
        located = np.flatnonzero(sieve.good & (raw.quality != NO_POSITION))
        part = Sieve(located.size)
        position = raw.position[:, located]
        self._placement.check(position, part)
        level = np.zeros((4, located.size))
        level[0] = 1.0
        placed = self._placer.place(raw.records[located], position, level, part)
        if placed is not None:
            world[:, located[part.kept]] = placed[0]
        sieve.take_over(part, located)
        return world


def _check(columns: dict[str, Float64], sieve: Sieve) -> None:
    """Drop records with an impossible value."""
    check_sigmas({name: v for name, v in columns.items() if name.startswith("sigma_")}, sieve)
    for name, values in columns.items():
        if name == "satellites":
            whole = np.isnan(values) | ((values >= 0) & (values <= 255) & (values == np.floor(values)))
            sieve.drop(~whole, "number of satellites is not a whole number from 0 to 255")
        elif name.startswith("velocity_"):
            _limit(name, values, -VELOCITY_MAX_M_PER_S, VELOCITY_MAX_M_PER_S, sieve)
        elif name == "speed_m_per_s":
            _limit(name, values, 0.0, VELOCITY_MAX_M_PER_S, sieve)
        elif name in _ANGLES:
            _limit(name, values, -360.0, 360.0, sieve)
        elif not name.startswith("sigma_"):
            _limit(name, values, 0.0 if name in ("hdop", "ratio") else -1e9, 1e9, sieve)


def _limit(name: str, values: Float64, low: float, high: float, sieve: Sieve) -> None:
    with np.errstate(invalid="ignore"):
        sieve.drop(~(np.isnan(values) | ((values >= low) & (values <= high))), f"{name} is outside {low:g} to {high:g}")


def geocentric_placement(source: LogSource) -> WorldPlacement:
    """Return the placement of geocentric positions, in the datum of the stated geocentric or geographic CRS.

    Raises
    ------
    ConfigError
        if the CRS is not stated, or is local.
    CrsError
        if it is neither geocentric nor geographic.
    """
    crs = source.need_crs()
    if crs == LOCAL_WORLD:
        raise ConfigError(
            'crs = "local", but the log\'s positions are geocentric',
            expected='the datum of its base station, as "EPSG:4978" or "EPSG:4979"',
            file=source.path,
            missing=Missing("crs", "EPSG:4978"),
        )
    stated = crs_from_text(crs)
    if not (stated.is_geocentric or stated.is_geographic):
        raise CrsError(
            f"the log's positions are geocentric, its crs '{crs}' ({stated.name}) is not",
            expected='the datum of its base station, as "EPSG:4978" or "EPSG:4979"',
            file=source.path,
        )
    return WorldPlacement(world_frame_of(crs), source.path)


def signed_square(root: Float64) -> Float64:
    """Return the covariance of its signed square root, as RTKLIB writes it: sign(c) · √|c|."""
    return np.sign(root) * root * root + 0.0  # minus zero becomes zero


def ned_from_ecef(world: str, xyz_world_m: Float64) -> Float64:
    """Return (n, 3, 3) north-east-down from geocentric axes at positions (3, n). Groves (2013), eq. 2.150."""
    degrees = geodetic_from_world(world, xyz_world_m.T)
    longitude, latitude = np.radians(degrees[:, 0]), np.radians(degrees[:, 1])
    so, co, sa, ca = np.sin(longitude), np.cos(longitude), np.sin(latitude), np.cos(latitude)
    zero = np.zeros_like(so)
    rows = [[-sa * co, -sa * so, ca], [-so, co, zero], [-ca * co, -ca * so, -sa]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
