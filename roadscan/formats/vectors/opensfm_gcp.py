"""Ground control of OpenSfM: ground_control_points.json."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.core.errors import FormatError
from roadscan.core.strict import Strict
from roadscan.formats.vectors.control import ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import options_of

_CRS: Final = "EPSG:4326"  # positions are latitude and longitude of WGS 84 (OpenSfM, "Ground Control Points")
_LARGEST: Final = 64 << 20  # bytes; a control file is some kilobytes
_SNIFFED: Final = 1 << 12  # bytes from which the format is recognised


class OpensfmGcpOptions(Strict):
    """Settings of `opensfm_gcp`."""

    role: Role | None = None
    """Role of all points: "gcp" or "check". Has to be stated."""


class OpensfmGcp(LogFormat):
    """An object with `points`, each with an `id`, a `position` (latitude, longitude, altitude) and `observations`.

    Positions are degrees of WGS 84 (EPSG:4326), unless crs states the datum of those who measured them. The file does
    not say whether altitudes are ellipsoidal: state it. A point without a position, which OpenSfM allows, is rejected;
    places in pictures are read by `opensfm_picture_points`.
    """

    name = "opensfm_gcp"
    title = "OpenSfM ground control (ground_control_points.json)"
    yields = ("control_points",)
    time = "holds no time"
    options = OpensfmGcpOptions

    def sniff(self, path: Path) -> bool:
        """True for a JSON object with points that are observed in pictures."""
        try:
            with path.open("rb") as stream:
                head = stream.read(_SNIFFED)
        except OSError:
            return False
        return head.lstrip().startswith(b"{") and all(
            word in head for word in (b'"points"', b'"observations"', b'"shot_id"', b'"projection"')
        )

    def header(self, source: LogSource) -> LogHeader:
        """Check CRS, heights and roles."""
        frame = _frame(source)
        return LogHeader({"crs": frame.crs, "height": frame.height})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points; one without a position is rejected."""
        frame, points = _frame(source), opensfm_points(source.path)
        reader = ControlReader(frame)
        placed = {record: place for record, point in enumerate(points) if (place := _place(point)) is not None}
        for record in range(len(points)):
            if record not in placed:
                yield Reject("the point has no position", record)
        if placed:
            missing = np.full(len(placed), np.nan)
            yield from reader.items(
                RawControl(
                    records=np.array(list(placed), np.int64),
                    offsets=np.full(len(placed), -1, np.int64),
                    names=[str(points[record].get("id", "")) for record in placed],
                    roles=[options_of(source, OpensfmGcpOptions).role or ""] * len(placed),
                    codes=[None] * len(placed),
                    coordinates=np.array(list(placed.values())).T,
                    sigma_horizontal_m=missing,
                    sigma_height_m=missing,
                )
            )
        yield from reader.findings()


def _frame(source: LogSource) -> ControlFrame:
    source.need_file()
    need_role(False, options_of(source, OpensfmGcpOptions).role, source.path)
    return ControlFrame.of(replace(source, crs=source.crs or source.defaults.crs or _CRS))


def opensfm_points(path: Path) -> list[dict[str, Any]]:
    """Return the points of a file as JSON objects; what is no object becomes an empty one."""
    try:
        if path.stat().st_size > _LARGEST:
            raise FormatError(f"the file is larger than {_LARGEST:,} bytes", expected="control points", file=path)
        content = json.loads(path.read_bytes())
    except (ValueError, OSError, RecursionError) as error:
        raise FormatError(f"not valid JSON: {str(error)[:100]}", expected="an object with points", file=path) from error
    points = content.get("points") if isinstance(content, dict) else None
    if not isinstance(points, list):
        raise FormatError("the file has no list of points", expected='{"points": [ … ]}', file=path)
    return [point if isinstance(point, dict) else {} for point in points]


def _place(point: dict[str, Any]) -> tuple[float, float, float] | None:
    """Return longitude, latitude (degrees) and altitude (m) of a point, NaN for what is no number; None without any."""
    position = point.get("position")
    if not isinstance(position, dict) or position.get("has_altitude") is False:
        return None
    longitude, latitude, altitude = (number_of(position.get(name)) for name in ("longitude", "latitude", "altitude"))
    return longitude, latitude, altitude


def number_of(value: Any) -> float:
    """Return a JSON number, NaN for anything else."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
    return float(value) if is_number else math.nan
