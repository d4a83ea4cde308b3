"""Ground control of OpenSfM: ground_control_points.json."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field

from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.vectors.control import BY_HAND, ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.formats.vectors.picture_points import RawPoints, point_items
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.records import options_of
from roadscan.store.codecs.image_files import ImageError, image_size

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


_NO_SIZE: Final = "the picture's size is not known"


class OpensfmPointsOptions(Strict):
    """Settings of `opensfm_picture_points`."""

    pictures: Path | None = None
    """Folder of the pictures, relative to the file's: places are shares of a picture's size, which is read there."""
    size_px: tuple[int, int] | None = None
    """Width and height of all pictures (pixels), in place of the folder."""
    sigma_px: float | None = Field(default=None, gt=0.0)
    """1 σ of each coordinate of all points (pixels); not stated where left out."""


class OpensfmPoints(LogFormat):
    """Where the points of OpenSfM's `points` are in pictures: the `projection` of each of their `observations`.

    Projections are places from the picture's middle, in units of the larger of its width and height. Points without a
    position, and points in one picture only, are read as well: they tie pictures together, or wait for more. The
    points' positions are read by `opensfm_gcp` from the same file, so this format has to be stated.
    """

    name = "opensfm_picture_points"
    title = "OpenSfM's places of control points in pictures (ground_control_points.json)"
    yields = ("picture_points",)
    time = "holds no time"
    options = OpensfmPointsOptions

    def sniff(self, path: Path) -> bool:
        """Never: the same file is `opensfm_gcp`, and the survey file says which part of it is meant."""
        return False

    def header(self, source: LogSource) -> LogHeader:
        """Check that sizes of pictures can be known."""
        options = options_of(source, OpensfmPointsOptions)
        source.need_file()
        opensfm_points(source.path)
        if options.pictures is None and options.size_px is None:
            raise ConfigError(
                "places are shares of the pictures' size, and nothing says where the pictures are",
                expected="options.pictures, their folder; or options.size_px",
                file=source.path,
                missing=Missing("options.pictures", "images", is_example=True),
            )
        return LogHeader({})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream measurements, point by point; one without a place or a picture's size is rejected."""
        options = options_of(source, OpensfmPointsOptions)
        sizes = _Sizes(source.path, options)
        for record, point in enumerate(opensfm_points(source.path)):
            listed = point.get("observations")
            seen = [one for one in listed if isinstance(one, dict)] if isinstance(listed, list) else []
            if not seen:
                yield Reject("the point has no observations", record)
                continue
            placed = [_pixel(one, sizes) for one in seen]
            unknown = sum(place is None for place in placed)
            if unknown:
                yield Reject(f"{_NO_SIZE}, of {unknown} of the point's pictures", record)
            kept = [(one, place) for one, place in zip(seen, placed, strict=True) if place is not None]
            if kept:
                yield from point_items(_raw(record, point, kept, options))


class _Sizes:
    """Sizes of pictures, read once each."""

    def __init__(self, file: Path, options: OpensfmPointsOptions) -> None:
        self._folder = None if options.pictures is None else beside(file, options.pictures)
        self._known: dict[str, tuple[int, int] | None] = {}
        self._all = options.size_px

    def of(self, name: str) -> tuple[int, int] | None:
        """Return width and height of a picture; None where they are not known."""
        if self._all is not None or self._folder is None:
            return self._all
        if name not in self._known:
            inside = Path(name).name == name and name not in {"", ".", ".."}
            try:
                size = image_size(self._folder / name) if inside else None
            except (ImageError, OSError):
                size = None
            self._known[name] = None if size is None else (size.width_px, size.height_px)
        return self._known[name]


def _pixel(seen: dict[str, Any], sizes: _Sizes) -> tuple[float, float] | None:
    """Return u, v (pixels) of an observation, NaN where there is none; None where the picture's size is not known."""
    size = sizes.of(str(seen.get("shot_id", "")))
    if size is None:
        return None
    listed = seen.get("projection")
    pair = listed if isinstance(listed, list) and len(listed) == 2 else [None, None]
    larger = max(size)
    u, v = (larger * number_of(value) + 0.5 * (side - 1) for value, side in zip(pair, size, strict=True))
    return u, v


def _raw(
    record: int,
    point: dict[str, Any],
    kept: list[tuple[dict[str, Any], tuple[float, float]]],
    options: OpensfmPointsOptions,
) -> RawPoints:
    """Return the measurements of one point."""
    count = len(kept)
    sigma = np.nan if options.sigma_px is None else options.sigma_px
    return RawPoints(
        np.full(count, record, np.int64), np.full(count, -1, np.int64), [None] * count, [None] * count,
        [str(one.get("shot_id", "")) for one, _ in kept], [str(point.get("id", ""))] * count,
        np.array([place for _, place in kept]).T, np.full(count, sigma), [BY_HAND] * count,
    )  # fmt: skip
