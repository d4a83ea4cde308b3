"""GPX: tracks of receivers, phones and watches."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import QUALITIES, GnssReader, RawSolutions, StatedQuality, utc_clock
from roadscan.ingest.reading.poses import GeodeticPlacement
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects, options_of
from roadscan.ingest.reading.stamps import calendar_ns
from roadscan.ingest.reading.text_table import byte_pieces, head_of, is_number

CRS: Final = "EPSG:4979"
"""Latitude and longitude are of WGS 84 (GPX 1.1, element trkpt)."""
_PLACE: Final = {name: re.compile(rb"\b%b\s*=\s*[\"']([^\"']*)[\"']" % name.encode()) for name in ("lat", "lon")}
_ROOT: Final = re.compile(rb"<([\w.-]+:|)gpx\b")  # with the prefix of GPX's names, where they have one
_HIDDEN: Final = {b"<!--": b"-->", b"<![CDATA[": b"]]>"}  # starts and ends of what holds no elements
_HIDES: Final = re.compile(b"|".join(map(re.escape, _HIDDEN)))
_LONGEST_START: Final = max(map(len, _HIDDEN))
_FIXES: Final = {"none": "none", "2d": "none", "3d": "single", "dgps": "dgps", "pps": "pps"}
"""Quality by `fix` (GPX 1.1, type fixType): a 2D fix has no height."""
_ZONE: Final = re.compile(r"(?:Z|[+-]\d{2}:?\d{2})$")
_LONGEST: Final = 1 << 16  # bytes of a point; a longer one is damage


class _Patterns(NamedTuple):
    """What the elements of a document look like."""

    point: re.Pattern[bytes]
    start: re.Pattern[bytes]
    end: re.Pattern[bytes]
    child: dict[str, re.Pattern[bytes]]


@functools.lru_cache(maxsize=8)
def _patterns(prefix: bytes) -> _Patterns:
    """Return the patterns for the prefix of GPX's names, such as ``b"ns:"``; ``b""`` for none."""
    own = re.escape(prefix)
    start, end = rb"<%btrkpt\b" % own, rb"</%btrkpt\s*>" % own
    return _Patterns(
        re.compile(rb"%b([^>]*?)(?:/>|>((?:(?!%b).)*?)%b)" % (start, start, end), re.DOTALL),
        re.compile(start),
        re.compile(rb"</%btrkpt" % own),
        {
            name: re.compile(rb"<%b%b>\s*([^<]*?)\s*</%b%b>" % (own, name.encode(), own, name.encode()))
            for name in ("ele", "time", "fix", "sat", "hdop", "ageofdgpsdata")
        },
    )


class GpxOptions(Strict):
    """Settings of `gpx`."""

    quality: StatedQuality | None = None
    """Kind of the solutions whose points state no `fix`: "single" for phones, watches and portable receivers."""


class Gpx(LogFormat):
    """The track points (`trkpt`) of all tracks and segments, one after another.

    Time is UTC, latitude and longitude are of WGS 84 by the definition of GPX, unless crs states the datum of the
    receiver's corrections. It does not say whether `ele` counts from the ellipsoid or the geoid: state height. `fix`,
    `sat`, `hdop` and `ageofdgpsdata` are kept; GPX knows no σ and no attitude. A point without a time or an elevation
    is rejected. A record is a track point. Routes, waypoints and comments are not read.
    """

    name = "gpx"
    title = "GPX track: positions with their times"
    version = 2
    yields = ("gnss",)
    time = "UTC by its definition"
    options = GpxOptions

    def sniff(self, path: Path) -> bool:
        """True for a GPX document whose beginning holds a track point with a time."""
        head, patterns = _head(path) if path.is_file() else (b"", None)
        return patterns is not None and any(
            patterns.child["time"].search(one[2] or b"") for one in patterns.point.finditer(head)
        )

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and that points without a fix have a kind."""
        source.need_file()
        placement = _placement(source)
        utc_clock(source, "the times of GPX are UTC")
        head, patterns = _head(source.path)
        first = None if patterns is None else patterns.point.search(head)
        if patterns is None or first is None:
            raise FormatError("the beginning holds no track point", expected="<trkpt …>", file=source.path)
        is_stated = patterns.child["fix"].search(first[2] or b"") is not None
        if not is_stated and options_of(source, GpxOptions).quality is None:
            raise ConfigError(
                "the points do not say what kind of solution they are (fix)",
                expected='options.quality: "single" for phones, watches and portable receivers',
                file=source.path,
                missing=Missing("options.quality", choices=get_args(StatedQuality)),
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


def _head(path: Path) -> tuple[bytes, _Patterns | None]:
    """Return the beginning of a document, without what is hidden, and its patterns; None where it is no GPX."""
    head = b"".join(one for one in _visible([head_of(path)]) if not isinstance(one, Reject))
    root = _ROOT.search(head, 0, 4096)
    return head, None if root is None else _patterns(root[1])


def _visible(pieces: Iterable[bytes | Reject]) -> Iterator[bytes | Reject]:
    """Yield pieces with blanks in place of comments and CDATA: all other bytes keep their places."""
    held, end = b"", b""
    for piece in pieces:
        if isinstance(piece, Reject):
            yield piece
            continue
        text, at, shown = held + piece, 0, []
        while True:
            if end:
                close = text.find(end, at)
                until = close + len(end) if close >= 0 else max(at, len(text) - len(end) + 1)
                shown.append(b" " * (until - at))
                at, end, is_done = until, b"" if close >= 0 else end, close < 0
            else:
                found = _HIDES.search(text, at)
                until = found.start() if found else max(at, len(text) - _LONGEST_START + 1)
                shown.append(text[at:until])
                at, end, is_done = until, _HIDDEN[found[0]] if found else b"", found is None
            if is_done:
                break
        held = text[at:]
        yield b"".join(shown)
    yield Reject("the file ends inside a comment or CDATA section") if end else held


def _blocks(path: Path) -> Iterator[tuple[npt.NDArray[np.int64], list[dict[str, str]]] | Reject]:
    """Yield offsets (n,) and fields of track points block by block; a reject where the text is damaged."""
    patterns = _head(path)[1] or _patterns(b"")
    text, at = b"", 0
    for piece in _visible(byte_pieces(path)):
        if isinstance(piece, Reject):
            yield Reject(piece.reason, offset=at)
            continue
        text += piece
        found = list(patterns.point.finditer(text))
        end = found[-1].end() if found else 0
        seen = (len(pattern.findall(text, 0, end)) for pattern in (patterns.start, patterns.end))
        damaged = max(seen) - len(found)
        if damaged > 0:
            yield Reject("a track point is not closed, or not opened", offset=at, records=damaged)
        if found:
            fields = [_fields(one, patterns.child) for one in found]
            yield at + np.array([one.start() for one in found], np.int64), fields
        keep = end or max(0, len(text) - _LONGEST)
        text, at = text[keep:], at + keep
    if unclosed := len(patterns.start.findall(text)):
        yield Reject("the file ends inside a track point", offset=at, records=unclosed)


def _fields(point: re.Match[bytes], child: dict[str, re.Pattern[bytes]]) -> dict[str, str]:
    """Return the texts of a point's attributes and children, "" where they are missing."""
    places = {name: pattern.search(point[1]) for name, pattern in _PLACE.items()}
    children = {name: pattern.search(point[2] or b"") for name, pattern in child.items()}
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
