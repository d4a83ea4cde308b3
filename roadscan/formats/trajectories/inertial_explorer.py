"""Trajectories that NovAtel's Waypoint Inertial Explorer exports as text."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

from roadscan.formats.trajectories.office_text import Cell, OfficeTrajectory, Preamble, aligned_units

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
