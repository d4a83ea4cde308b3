"""Trajectories that SBG Systems' Qinertia exports as text."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

from roadscan.formats.trajectories.office_text import Cell, OfficeTrajectory, Preamble

_NAMES: Final = {"roll", "pitch", "yaw", "latitude", "longitude"}
_SAID: Final = re.compile(r"[#\s]*([A-Z][\w ]{2,30}):\s+(\S.*)")
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
                said = {one[1]: one[2].strip() for above in lines[:at] if (one := _SAID.match(above))}
                return Preamble(cells, at + 1 + is_units, delimiter, dict(list(said.items())[:_SAID_MOST]))
        return None


def _cells(line: str, delimiter: str) -> list[str]:
    return [word.strip(' ()[]#"') for word in line.split(delimiter)]
