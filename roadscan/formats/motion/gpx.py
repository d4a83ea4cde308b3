"""GPX: tracks of receivers, phones and watches."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import QUALITIES, GnssReader, RawSolutions, utc_clock
from roadscan.ingest.reading.poses import GeodeticPlacement
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects, options_of
from roadscan.ingest.reading.stamps import calendar_ns
from roadscan.ingest.reading.text_table import byte_pieces, head_of, is_number

Float64 = npt.NDArray[np.float64]

CRS: Final = "EPSG:4979"
"""Latitude and longitude are of WGS 84 (GPX 1.1, element trkpt)."""
_POINT: Final = re.compile(rb"<trkpt\b([^>]*?)(?:/>|>((?:(?!<trkpt).)*?)</trkpt\s*>)", re.DOTALL)
_START: Final = b"<trkpt"
_PLACE: Final = {name: re.compile(rb"\b%b\s*=\s*[\"']([^\"']*)[\"']" % name.encode()) for name in ("lat", "lon")}
_CHILD: Final = {
    name: re.compile(rb"<%b>\s*([^<]*?)\s*</%b>" % (name.encode(), name.encode()))
    for name in ("ele", "time", "fix", "sat", "hdop", "ageofdgpsdata")
}
_FIXES: Final = {"none": "none", "2d": "none", "3d": "single", "dgps": "dgps", "pps": "pps"}
"""Quality by `fix` (GPX 1.1, type fixType): a 2D fix has no height."""
_ZONE: Final = re.compile(r"(?:Z|[+-]\d{2}:?\d{2})$")
_LONGEST: Final = 1 << 16  # bytes of a point; a longer one is damage


class GpxOptions(Strict):
    """Settings of `gpx`."""

    quality: Literal["single", "sbas", "dgps", "float", "fixed", "ppp"] | None = None
    """Kind of the solutions whose points state no `fix`: "single" for phones, watches and portable receivers."""


class Gpx(LogFormat):
    """The track points (`trkpt`) of all tracks and segments, one after another.

    Time is UTC, latitude and longitude are of WGS 84 by the definition of GPX, unless crs states the datum of the
    receiver's corrections. It does not say whether `ele` counts from the ellipsoid or the geoid: state height. `fix`,
    `sat`, `hdop` and `ageofdgpsdata` are kept; GPX knows no σ and no attitude. A point without a time or an elevation
    is rejected. A record is a track point. Routes and waypoints are not read.
    """

    name = "gpx"
    title = "GPX track: positions with their times"
    yields = ("gnss",)
    time = "UTC by its definition"
    options = GpxOptions

    def sniff(self, path: Path) -> bool:
        """True for a GPX document whose beginning holds a track point with a time."""
        head = head_of(path) if path.is_file() else b""
        return b"<gpx" in head[:4096] and any(_CHILD["time"].search(m[2] or b"") for m in _POINT.finditer(head))

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and that points without a fix have a kind."""
        source.need_file()
        placement = _placement(source)
        utc_clock(source, "the times of GPX are UTC")
        first = _POINT.search(head_of(source.path))
        if first is None:
            raise FormatError("the beginning holds no track point", expected="<trkpt …>", file=source.path)
        is_stated = _CHILD["fix"].search(first[2] or b"") is not None
        if not is_stated and options_of(source, GpxOptions).quality is None:
            raise ConfigError(
                "the points do not say what kind of solution they are (fix)",
                expected='options.quality: "single" for phones, watches and portable receivers',
                file=source.path,
                missing=Missing("options.quality", choices=("single", "sbas", "dgps", "float", "fixed", "ppp")),
            )
        return LogHeader({"world_frame": placement.world})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a point that is none is rejected."""
        reader = GnssReader(source, _placement(source))
        epochs = EpochReader(utc_clock(source, "the times of GPX are UTC"), source.path)
        otherwise = options_of(source, GpxOptions).quality or "none"
        first = 0
        for block in _blocks(source.path):
            if isinstance(block, Reject):
                yield Reject(block.reason, first, block.offset)
                first += 1
                continue
            offsets, points = block
            records = first + np.arange(len(points), dtype=np.int64)
            first += len(points)
            sieve = Sieve(len(points))
            sieve.drop(np.array([not point["time"] for point in points]), "the point has no time")
            words = [point["time"] if _ZONE.search(point["time"]) else point["time"] + "Z" for point in points]
            stamps = epochs.epochs(calendar_ns(words, sieve, zoned=True), sieve, records)
            raw = RawSolutions(
                records, offsets, stamps, _position(points), _quality(points, otherwise), _columns(points)
            )
            rejects = []
            for item in reader.items(raw, sieve):
                if isinstance(item, Reject):
                    rejects.append(item)
                else:
                    yield item
            yield from few_rejects(rejects)


def _blocks(path: Path) -> Iterator[tuple[npt.NDArray[np.int64], list[dict[str, str]]] | Reject]:
    """Yield offsets (n,) and fields of track points block by block; a reject where the text is damaged."""
    text, at = b"", 0
    for piece in byte_pieces(path):
        if isinstance(piece, Reject):
            yield Reject(piece.reason, offset=at)
            continue
        text += piece
        found = list(_POINT.finditer(text))
        end = found[-1].end() if found else 0
        damaged = max(text.count(_START, 0, end), text.count(b"</trkpt", 0, end)) - len(found)
        if damaged > 0:
            yield Reject("a track point is not closed, or not opened", offset=at, records=damaged)
        if found:
            yield at + np.array([m.start() for m in found], np.int64), [_fields(m) for m in found]
        keep = end or max(0, len(text) - _LONGEST)
        text, at = text[keep:], at + keep
    if _START in text:
        yield Reject("the file ends inside a track point", offset=at, records=text.count(_START))


def _fields(point: re.Match[bytes]) -> dict[str, str]:
    """Return the texts of a point's attributes and children, "" where they are missing."""
    places = {name: pattern.search(point[1]) for name, pattern in _PLACE.items()}
    children = {name: pattern.search(point[2] or b"") for name, pattern in _CHILD.items()}
    found = places | children
    return {name: "" if one is None else one[1].decode("utf-8", "replace") for name, one in found.items()}


def _number(points: list[dict[str, str]], name: str) -> Float64:
    words = (point[name] for point in points)
    return np.array([float(word) if is_number(word) else np.nan for word in words], dtype=np.float64)


def _position(points: list[dict[str, str]]) -> Float64:
    """Return longitude and latitude (rad), elevation (m), (3, n)."""
    return np.stack([np.radians(_number(points, "lon")), np.radians(_number(points, "lat")), _number(points, "ele")])


def _quality(points: list[dict[str, str]], otherwise: str) -> npt.NDArray[np.int64]:
    """Return (n,) indices of `QUALITIES`."""
    names = (_FIXES.get(point["fix"], "none") if point["fix"] else otherwise for point in points)
    return np.array([QUALITIES.index(name) for name in names], dtype=np.int64)


def _columns(points: list[dict[str, str]]) -> dict[str, Float64]:
    return {
        "satellites": _number(points, "sat"),
        "hdop": _number(points, "hdop"),
        "age_s": _number(points, "ageofdgpsdata"),
    }


def _placement(source: LogSource) -> GeodeticPlacement:
    crs = source.crs or source.defaults.crs or CRS
    return GeodeticPlacement(crs, source.need_height(), source.geoid, source.path)
