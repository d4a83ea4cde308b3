"""Text that office software exports: Inertial Explorer, GrafNav, Qinertia and POSPac."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Final, get_args

import numpy as np

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.trajectories.office_text import (
    Cell,
    OfficeTrajectory,
    Preamble,
    aligned_units,
    position_of,
    stamps_of,
)
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, GnssReader, RawSolutions, StatedQuality
from roadscan.ingest.reading.poses import North
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.text_table import text_blocks

_PROGRAM: Final = re.compile(r"Program:\s+(Inertial Explorer|GrafNav|Waypoint)")
_UNITS: Final = re.compile(r"\((sec|deg|m|weeks|\+/-D M S|D-M-S|MDY|DMY|YMD|HMS|m/s)\)", re.IGNORECASE)
_SAID: Final = re.compile(r"(Project|Program|Profile|Source|Datum|UTC Offset):\s+(\S.*)")
_OWN_NAMES: Final = re.compile(r"\b(H-Ell|H-MSL|GPSTime|CorrTime|UTCTime)\b")  # of exports without a preamble
_SCALING: Final = re.compile(r"\s*(Position|Attitude):\s+(\d+(?:\.\d+)?)")


class InertialExplorer(OfficeTrajectory):
    """A preamble, a line of names, a line of units, a line a pose; blanks or commas between the columns.

    Time is the columns Week and GPSTime (or CorrTime); or a date with GPSTime, in seconds of the week or of the day;
    or UTCDate with UTCTime as hh:mm:ss. GPSTime alone asks for the week. Positions are Latitude and Longitude in
    degrees, or in degrees, minutes and seconds; or Easting and Northing, for a projected CRS. H-Ell is ellipsoidal,
    H-MSL orthometric. Attitude is Roll, Pitch, and Heading or Azimuth of the vehicle frame (x right, y forward, z up).
    SDNorth, SDEast, SDHeight, RollSD, PitchSD and HdngSD are σ, divided by the scale that the preamble states. The
    datum that the preamble names is shown; state it as crs.
    """

    name = "inertial_explorer"
    title = "Waypoint Inertial Explorer export (text): position, attitude, σ and velocity in columns of any order"
    time = "GPS week and seconds, or a date; GPSTime alone needs clock.system = gps_week_seconds and its week"
    vocabulary: ClassVar[Mapping[str, str]] = {
        "week": "week", "gpstime": "week_s", "corrtime": "week_s", "date": "date", "gpsdate": "date",
        "utcdate": "utc_date", "utctime": "utc_time",
        "latitude": "latitude", "longitude": "longitude", "easting": "easting", "northing": "northing",
        "h-ell": "height_ellipsoidal", "h-msl": "height_orthometric", "h-ortho": "height_orthometric",
        "roll": "roll", "pitch": "pitch", "heading": "heading", "azimuth": "heading",
        "sdnorth": "sigma_north", "sdeast": "sigma_east", "sdheight": "sigma_down", "sdup": "sigma_down",
        "rollsd": "sigma_roll", "pitchsd": "sigma_pitch", "hdngsd": "sigma_heading", "azimuthsd": "sigma_heading",
        "vnorth": "velocity_north", "veast": "velocity_east", "vup": "velocity_up",
    }  # fmt: skip

    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return names and units of the two lines above the first pose, and what the preamble says."""
        units = next((k for k, line in enumerate(lines) if len(_UNITS.findall(line)) >= 3), 0)
        if not units or not (any(map(_PROGRAM.match, lines[:units])) or _OWN_NAMES.search(lines[units - 1])):
            return None
        names, below = lines[units - 1], lines[units]
        is_commas = names.count(",") >= 3
        cells = _split(names, below) if is_commas else aligned_units(names, below)
        said = {found[1]: found[2].strip() for line in lines[:units] if (found := _SAID.match(line))}
        scaling = {one[1]: float(one[2]) for line in lines[:units] if (one := _SCALING.match(line))}
        scales = {"length": scaling.get("Position") or 1.0, "angle": scaling.get("Attitude") or 1.0}
        return Preamble(cells, units + 1, "," if is_commas else " ", said, sigma_scale=scales)


def _split(names: str, units: str) -> list[Cell]:
    parts = [unit.strip().strip("()") for unit in units.split(",")]
    columns = [name.strip() for name in names.split(",")]
    return [Cell(name, unit) for name, unit in zip(columns, parts + [""] * len(columns), strict=False)]


_NAMES: Final = {"roll", "pitch", "yaw", "latitude", "longitude"}
_QINERTIA_SAID: Final = re.compile(r"[#\s]*([A-Z][\w ]{2,30}):\s+(\S.*)")
_SAID_MOST: Final = 12  # statements of a preamble that are kept


class Qinertia(OfficeTrajectory):
    """A preamble, a line of names, a line of units, a line a pose; tabs, semicolons or commas between the columns.

    Time is UTC Date with UTC Time as hh:mm:ss, or GPS Week with GPS Time of the week; GPS Time alone asks for the week.
    Positions are Latitude and Longitude in degrees. Altitude Ellipsoid is ellipsoidal, Altitude MSL orthometric.
    Attitude is Roll, Pitch and Yaw of the vehicle frame (x forward, y right, z down; yaw from true north). The Std.
    columns are σ. The datum is that of the base stations: state it as crs.
    """

    name = "qinertia"
    title = "SBG Qinertia export (text): position, attitude, velocity and σ"
    time = "UTC date and time of day, or GPS week and seconds; GPS Time alone needs gps_week_seconds and its week"
    vocabulary: ClassVar[Mapping[str, str]] = {
        "utc date": "utc_date", "utc time": "utc_time",
        "gps week": "week", "gps time": "week_s", "gps tow": "week_s", "gps time of week": "week_s",
        "latitude": "latitude", "longitude": "longitude", "easting": "easting", "northing": "northing",
        "altitude ellipsoid": "height_ellipsoidal", "altitude msl": "height_orthometric",
        "roll": "roll", "pitch": "pitch", "yaw": "heading", "heading": "heading",
        "latitude std.": "sigma_north", "longitude std.": "sigma_east", "altitude std.": "sigma_down",
        "roll std.": "sigma_roll", "pitch std.": "sigma_pitch", "yaw std.": "sigma_heading",
        "north velocity": "velocity_north", "east velocity": "velocity_east", "down velocity": "velocity_down",
    }  # fmt: skip

    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return names and units of the two lines above the first pose."""
        for at, line in enumerate(lines[:-1]):
            delimiter = max("\t;,", key=line.count)
            names = _cells(line, delimiter)
            if {name.lower() for name in names} >= _NAMES:
                units = _cells(lines[at + 1], delimiter)
                is_units = len(units) == len(names) and not any(unit[-1:].isdigit() for unit in units)
                cells = [Cell(*pair) for pair in zip(names, units if is_units else [""] * len(names), strict=True)]
                said = {one[1]: one[2].strip() for above in lines[:at] if (one := _QINERTIA_SAID.match(above))}
                return Preamble(cells, at + 1 + is_units, delimiter, dict(list(said.items())[:_SAID_MOST]))
        return None


def _cells(line: str, delimiter: str) -> list[str]:
    return [word.strip(' ()[]#"') for word in line.split(delimiter)]


_POSPAC_HEADER: Final = re.compile(r"\s*TIME\s*,.*\bROLL\s*,\s*PITCH\s*,\s*HEADING\b")
_UNIT_PROSE: Final = {
    "TIME": r"time in (\S+)",
    "EASTING": r"position in (\S+)",
    "LATITUDE": r"lat, long in (\S+)",
    "ROLL": r"orientation angles(?: and SD)? in (\S+)",
    "EAST VELOCITY": r"velocity in (\S+)",
    "EAST SD": r"position SD in (\S+)",
}
"""Words of the line of units, by the first of the columns that they are about."""
_LIKE: Final = {
    "NORTHING": "EASTING", "ELLIPSOID HEIGHT": "EASTING", "ORTHOMETRIC HEIGHT": "EASTING", "LONGITUDE": "LATITUDE",
    "PITCH": "ROLL", "HEADING": "ROLL", "ROLL SD": "ROLL", "PITCH SD": "ROLL", "HEADING SD": "ROLL",
    "NORTH VELOCITY": "EAST VELOCITY", "UP VELOCITY": "EAST VELOCITY", "NORTH SD": "EAST SD", "HEIGHT SD": "EAST SD",
}  # fmt: skip
_DATE: Final = re.compile(r"\s*Date of Mission:\s*(\d{4})-(\d\d)-(\d\d)")
_POSPAC_SAID: Final = re.compile(
    r"\s*(Date of Mission|Mapping frame datum|POSPROC SBET file|Boresight values|Lever arm values):?\s+(.*)"
)


class PospacText(OfficeTrajectory):
    """A preamble, a line of names (TIME, DISTANCE, EASTING, …), a line of units in words, a line a pose.

    TIME is seconds of the GPS week, whose week the clock states; the date of the mission is proposed. A file that was
    exported in UTC seconds needs a clock with offset_s, the leap seconds of its day. Positions are LATITUDE and
    LONGITUDE, or EASTING and NORTHING for the projected CRS of the export; ELLIPSOID HEIGHT is ellipsoidal. Attitude is
    ROLL, PITCH and HEADING in degrees (x forward, y right, z down; heading from true north unless the export was set
    to count from the grid's). The SD columns are σ. The boresight and lever arm that the preamble names are applied
    already, and are shown.
    """

    name = "pospac_text"
    title = "POSPac export (text of the POS Export Utility): position, attitude, velocity and σ"
    time = 'seconds of the GPS week: state clock = { system = "gps_week_seconds", date = … }'
    vocabulary: ClassVar[Mapping[str, str]] = {
        "time": "week_s", "easting": "easting", "northing": "northing", "latitude": "latitude",
        "longitude": "longitude",
        "ellipsoid height": "height_ellipsoidal", "orthometric height": "height_orthometric",
        "roll": "roll", "pitch": "pitch", "heading": "heading",
        "east velocity": "velocity_east", "north velocity": "velocity_north", "up velocity": "velocity_up",
        "east sd": "sigma_east", "north sd": "sigma_north", "height sd": "sigma_down",
        "roll sd": "sigma_roll", "pitch sd": "sigma_pitch", "heading sd": "sigma_heading",
    }  # fmt: skip

    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return the columns, with the units that the prose below their names states."""
        at = next((k for k, line in enumerate(lines) if _POSPAC_HEADER.match(line)), None)
        if at is None:
            return None
        below = next((k for k, line in enumerate(lines[at + 1 : at + 4], at + 1) if "time in" in line), at)
        prose = lines[below].strip().strip("()") if below > at else ""
        found = {name: re.search(f"{words}(?=[,)]|$)", prose, re.IGNORECASE) for name, words in _UNIT_PROSE.items()}
        units = {name: one[1].strip(",") for name, one in found.items() if one is not None}
        cells = [Cell(name, units.get(_LIKE.get(name, name), "")) for name in map(str.strip, lines[at].split(","))]
        first = next((line for line in lines[below + 1 :] if line.strip()), "")
        said = {one[1]: one[2].strip(" ;:") for line in lines[:at] if (one := _POSPAC_SAID.match(line))}
        return Preamble(cells, below + 1, "," if "," in first else " ", said, _date_of(lines[:at]))


def _date_of(lines: Sequence[str]) -> dt.date | None:
    found = next((one for line in lines if (one := _DATE.match(line))), None)
    try:
        return None if found is None else dt.date(*(int(part) for part in found.groups()))
    except ValueError:
        return None


_QUALITIES: Final = {1: "fixed", 2: "float", 3: "float", 4: "float", 5: "dgps", 6: "single"}
"""Quality by the column Q (Waypoint 8.90 user manual, "Quality Number": 1 fixed integer … 6 coarse acquisition)."""


class GrafNavOptions(Strict):
    """Settings of `grafnav`."""

    quality: StatedQuality | None = None
    """Kind of the solutions, where no column Q says it."""


class GrafNav(OfficeTrajectory):
    """A preamble, a line of names, a line of units, a line a position; columns and times as in `inertial_explorer`.

    Q is the kind of the solution: 1 fixed, 2 to 4 float, 5 dgps, 6 single. Exports with roll, pitch and heading are
    trajectories (`inertial_explorer`).
    """

    name = "grafnav"
    title = "Waypoint GrafNav export (text): positions without attitude, σ and quality in columns of any order"
    yields = ("gnss",)
    time = InertialExplorer.time
    options = GrafNavOptions
    attitude: ClassVar[tuple[str, ...]] = ()
    vocabulary: ClassVar[Mapping[str, str]] = {**InertialExplorer.vocabulary, "q": "quality"}

    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return what stands above the first position, as that of Inertial Explorer's exports."""
        return InertialExplorer().preamble(lines)

    def sniff(self, path: Path) -> bool:
        """True if the preamble is Waypoint's and names positions, and no attitude."""
        return super().sniff(path) and not InertialExplorer().sniff(path)

    def north(self, source: LogSource) -> North | None:
        """Return grid north on a grid: positions have no heading."""
        crs = source.need_crs()
        return "grid" if crs != "local" and crs_from_text(crs).is_projected else None

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS, heights and the kind of the solutions."""
        header = super().header(source)
        if "quality" not in header.attributes["columns"] and options_of(source, GrafNavOptions).quality is None:
            raise ConfigError(
                "no column Q says what kind of solution the positions are",
                expected="options.quality",
                file=source.path,
                missing=Missing("options.quality", choices=get_args(StatedQuality)),
            )
        return header

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a line that cannot be read is rejected."""
        plan = self.plan(source)
        reader = GnssReader(source, plan.placement)
        epochs = EpochReader(plan.clock, source.path)
        codes = np.array([QUALITIES.index(_QUALITIES.get(k, "none")) for k in range(max(_QUALITIES) + 1)])
        stated = options_of(source, GrafNavOptions).quality
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = epochs.epochs(stamps_of(block, plan, sieve), sieve, block.records)
            position, sigmas = position_of(block, plan, sieve)
            if "quality" in plan.columns:
                said = block.number(plan.columns["quality"].words[0])
                known = np.isin(said, list(_QUALITIES))
                sieve.drop(~known, "the kind of the solution (Q) is unknown")
                quality = np.where(known, codes[np.where(known, said, 0).astype(np.int64)], NO_POSITION)
            else:
                quality = np.full(block.records.size, QUALITIES.index(stated or "none"))
            columns = {name: values for name, values in sigmas.items() if name.endswith("_m")}
            yield from reader.items(
                RawSolutions(block.records, block.offsets, stamps, position, quality.astype(np.int64), columns), sieve
            )
