"""Trajectories that Applanix's POSPac exports as text (its POS Export Utility)."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

from roadscan.formats.trajectories.office_text import Cell, OfficeTrajectory, Preamble

_NAMES: Final = re.compile(r"\s*TIME\s*,.*\bROLL\s*,\s*PITCH\s*,\s*HEADING\b")
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
_SAID: Final = re.compile(
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
        at = next((k for k, line in enumerate(lines) if _NAMES.match(line)), None)
        if at is None:
            return None
        below = next((k for k, line in enumerate(lines[at + 1 : at + 4], at + 1) if "time in" in line), at)
        prose = lines[below].strip().strip("()") if below > at else ""
        found = {name: re.search(f"{words}(?=[,)]|$)", prose, re.IGNORECASE) for name, words in _UNIT_PROSE.items()}
        units = {name: one[1].strip(",") for name, one in found.items() if one is not None}
        cells = [Cell(name, units.get(_LIKE.get(name, name), "")) for name in map(str.strip, lines[at].split(","))]
        first = next((line for line in lines[below + 1 :] if line.strip()), "")
        said = {one[1]: one[2].strip(" ;:") for line in lines[:at] if (one := _SAID.match(line))}
        return Preamble(cells, below + 1, "," if "," in first else " ", said, _date_of(lines[:at]))


def _date_of(lines: Sequence[str]) -> dt.date | None:
    found = next((one for line in lines if (one := _DATE.match(line))), None)
    try:
        return None if found is None else dt.date(*(int(part) for part in found.groups()))
    except ValueError:
        return None
