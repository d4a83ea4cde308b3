"""Poses that the Boreas data set exports from Applanix POSPac."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, FormatError, Missing, nearest
from roadscan.core.frames import ENU_FROM_NED, quaternion_from_rotation
from roadscan.core.gpstime import Clock
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import (
    North,
    Placement,
    PoseReader,
    RawPoses,
    body_quaternion,
    check_rph,
    level_placement,
    quaternion_about,
    quaternion_product,
)
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.text_table import (
    Kind,
    TextLayout,
    TextOptions,
    number_stamp_kind,
    sniff_layout,
    text_blocks,
    text_layout,
)

STAMP: Final = "GPSTime"
POSITION: Final = ("easting", "northing", "altitude")
ATTITUDE: Final = ("roll", "pitch", "heading")
VELOCITY: Final = ("vel_east", "vel_north", "vel_up")

_NED_FROM_ENU: Final = quaternion_from_rotation(ENU_FROM_NED.T)


class PospacOptions(TextOptions):
    """Settings of `pospac`."""

    axes: str | None = None
    """Where x, y, z of the posed sensor point on the vehicle, such as frd, flu or rfu. Has to be stated."""
    heading: North = "grid"
    """North that the heading is counted from: "grid", as in the published files, or "true"."""


class Pospac(LogFormat):
    """A line a pose: GPSTime, easting, northing, altitude, velocity, roll, pitch, heading, rates.

    Angles are radians and rotate as pyboreas has it: east-north-up from sensor = Rx(−roll) ·
    Ry(−pitch) · Rz(−heading), so heading is clockwise from north for a sensor whose y axis points
    forward. The published poses bear it out: with this order the radar lies (0.000, 0.000, 0.210) m
    from the lidar in the lidar's frame, its direction within 0.13° RMS over the drive; with
    Rz · Ry · Rx the direction spreads over 2°.

    Positions are on the grid (the published latitudes and longitudes of the route lie on the driven
    line, within a lane), and north is the grid's: on straight road the car moves within 0.2° of its
    forward axis, where counting from true north would make it 0.9° for a meridian convergence of
    1.06°.
    """

    name = "pospac"
    title = "POSPac poses as CSV, as the Boreas data set exports them (GPSTime, easting, northing, …)"
    yields = ("trajectory",)
    time = (
        "integers: state clock.system (the published files count UTC from 1970: unix_utc) and "
        "clock.unit (us; some files are in ns)"
    )
    options = PospacOptions

    def sniff(self, path: Path) -> bool:
        """True if the columns carry the data set's names."""
        layout = sniff_layout(path)
        return layout is not None and {STAMP, *POSITION, *VELOCITY, *ATTITUDE} <= set(layout.names)

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS and axes."""
        plan = _plan(source)
        return LogHeader({"world_frame": plan.placement.world, "axes": plan.axes})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that cannot be read is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            roll, pitch, heading = (block.number(name) for name in ATTITUDE)
            check_rph(roll, pitch, heading, sieve)
            with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
                enu_from_sensor = _enu_from_sensor(roll, pitch, heading)
            ned_from_body = quaternion_product(
                _NED_FROM_ENU, quaternion_product(enu_from_sensor, plan.sensor_from_body)
            )
            position = np.stack([block.number(name) for name in POSITION])
            raw = RawPoses(block.records, block.offsets, block.stamps(STAMP), position, ned_from_body, {})
            yield from reader.items(raw, sieve)


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    kinds: dict[str, Kind]
    clock: Clock
    placement: Placement
    axes: str
    sensor_from_body: Float64


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, PospacOptions)
    layout = text_layout(source.path, options)
    names = (STAMP, *POSITION, *ATTITUDE)
    missing = [name for name in names if name not in layout.names]
    if missing:
        raise FormatError(
            f"there is no column '{missing[0]}'{nearest(missing[0], layout.names)}",
            expected="columns " + ", ".join(names),
            file=source.path,
        )
    kinds: dict[str, Kind] = dict.fromkeys(names, "number")
    clock = source.need_clock("unix_utc", unit="us")
    kinds[STAMP] = number_stamp_kind(source.path, layout, STAMP, clock.unit)
    return _Plan(
        layout=layout,
        kinds=kinds,
        clock=clock,
        placement=_placement(source, options),
        axes=options.axes or "",
        sensor_from_body=body_quaternion(options.axes, source.path),
    )


def _placement(source: LogSource, options: PospacOptions) -> Placement:
    crs = source.need_crs("EPSG:32617")
    if crs != LOCAL_WORLD and not crs_from_text(crs).is_projected:
        raise ConfigError(
            f"the log's positions are easting and northing, its crs '{crs}' is not projected",
            expected='the projected CRS of the export, such as "EPSG:32617"',
            file=source.path,
            missing=Missing("crs", "EPSG:32617"),
        )
    return level_placement(source, options.heading)


def _enu_from_sensor(roll_rad: Float64, pitch_rad: Float64, heading_rad: Float64) -> Float64:
    """Return (4, n) east-north-up from sensor: Rx(−roll) · Ry(−pitch) · Rz(−heading)."""
    about_x, about_y = quaternion_about("x", -roll_rad), quaternion_about("y", -pitch_rad)
    return quaternion_product(quaternion_product(about_x, about_y), quaternion_about("z", -heading_rad))
