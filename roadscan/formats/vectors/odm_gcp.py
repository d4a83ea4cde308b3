"""Ground control of OpenDroneMap: gcp_list.txt."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np
import pyproj
from pydantic import Field
from pyproj.exceptions import CRSError as ProjCrsError

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.vectors.control import BY_HAND, ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.formats.vectors.picture_points import RawPoints, point_items
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import options_of
from roadscan.ingest.reading.text_table import head_of, is_number, line_blocks

_UTM: Final = re.compile(r"WGS84 UTM (\d{1,2})([NS])", re.IGNORECASE)
_FEWEST: Final = 6  # words of a line: easting, northing, height, x and y in the picture, and the picture
_NO_NUMBER: Final = "nan"  # a height that is not stated, in lower case


class OdmGcpOptions(Strict):
    """Settings of `odm_gcp`."""

    later: ClassVar[frozenset[str]] = frozenset({"height_unit"})

    role: Role | None = None
    """Role of all points: "gcp" or "check". Has to be stated."""
    height_unit: Literal["m", "ft", "ft_us"] | None = None
    """Unit of heights (ft_us: US survey foot). Has to be stated where eastings are in feet; else it is the metre."""


class OdmGcp(LogFormat):
    """A line with the CRS; then a line for each picture of a point: x, y, z, column, row, picture, name.

    The CRS is an EPSG code, a PROJ string or ``WGS84 UTM 32N``, as OpenDroneMap has it; x is easting or longitude. A
    point without a name is called by its number among the points of other coordinates. Its places in pictures are read
    by `odm_picture_points`. A point whose height is NaN is rejected. The file does not say whether heights are
    ellipsoidal, nor their unit where the CRS counts in feet: state both.
    """

    name = "odm_gcp"
    title = "OpenDroneMap ground control (gcp_list.txt): a CRS, then a line for each picture of a point"
    version = 2
    yields = ("control_points",)
    time = "holds no time"
    options = OdmGcpOptions

    def sniff(self, path: Path) -> bool:
        """True if the first line is a CRS and the second one a point in a picture."""
        lines = (
            head_of(path, 1 << 12).decode("utf-8", "replace").lstrip("\ufeff").splitlines() if path.is_file() else []
        )
        rows = [line.split() for line in lines[1:-1] or lines[1:] if line.strip()]
        return bool(rows) and _is_row(rows[0]) and _crs(lines[0].strip()) is not None

    @staticmethod
    def need_list(path: Path) -> None:
        """Refuse a file whose first line is no CRS."""
        _first_crs(path)

    def header(self, source: LogSource) -> LogHeader:
        """Check CRS, heights and roles."""
        frame = _frame(source)
        _height_unit_m(source, frame)
        return LogHeader({"crs": frame.crs, "height": frame.height})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points; a line that is none is rejected."""
        frame, role = _frame(source), options_of(source, OdmGcpOptions).role
        reader, unit_m = ControlReader(frame), _height_unit_m(source, frame)
        points: dict[str, tuple[int, int, tuple[float, ...]]] = {}
        for row in odm_rows(source.path):
            if isinstance(row, Reject):
                yield row
                continue
            if math.isnan(row.place[2]):
                yield Reject("the height of the point is not stated (NaN)", row.record, row.offset)
                continue
            record, offset, name, place = row.record, row.offset, row.point, row.place
            if points.setdefault(name, (record, offset, place))[2] != place:
                yield Reject("a point of this name has other coordinates above", record, offset)
        if points:
            yield from reader.items(_raw(points, (frame.horizontal_scale, frame.horizontal_scale, unit_m), role or ""))
        yield from reader.findings()


@dataclass(frozen=True)
class OdmRow:
    """A point in a picture."""

    record: int
    offset: int
    point: str
    place: tuple[float, float, float]
    """x, y, z as the file has them; z is NaN where it is not stated."""
    u_px: float
    v_px: float
    picture: str


def odm_rows(path: Path) -> Iterator[OdmRow | Reject]:
    """Yield the lines of a list with the names that its points have; a line that is none as a reject."""
    known: dict[tuple[str, ...], str] = {}
    for record, line in enumerate(_lines(path)):
        if isinstance(line, Reject):
            yield replace(line, record=record)
            continue
        offset, words = line
        if not _is_row(words):
            yield Reject("the line is not x, y, z, column, row and picture of a point", record, offset)
            continue
        x, y, z, u, v = (float(word) for word in words[:5])
        key = tuple(words[:3]) if math.isnan(z) else (repr(x), repr(y), repr(z))
        # a height that is not stated is no place: such a point takes no number away from those that have one
        numbered = f"gcp_{len(known) + 1}" if not math.isnan(z) else f"gcp_without_height_{x!r}_{y!r}"
        name = words[6] if len(words) > _FEWEST else known.get(key, numbered)
        if not math.isnan(z):
            known.setdefault(key, name)
        yield OdmRow(record, offset, name, (x, y, z), u, v, words[5])


def _lines(path: Path) -> Iterator[tuple[int, list[str]] | Reject]:
    """Yield offset and words of each line below that of the CRS, without blank ones and comments."""
    is_first = True
    for start, data in line_blocks(path):
        if isinstance(data, Reject):
            yield replace(data, offset=start)
            continue
        ends = start + np.cumsum([0, *(len(line) for line in data.splitlines(keepends=True))])
        for offset, line in zip(ends.tolist(), data.splitlines(), strict=False):
            words = line.decode("utf-8", "replace").split()
            if words and not is_first and not words[0].startswith("#"):
                yield offset, words
            is_first = is_first and not words


def _raw(
    points: Mapping[str, tuple[int, int, tuple[float, ...]]], units: tuple[float, float, float], role: str
) -> RawControl:
    """Return the points; units : sizes of those of x, y, z (degrees or metres)."""
    records, offsets, places = zip(*points.values(), strict=True)
    missing = np.full(len(points), np.nan)
    return RawControl(
        records=np.array(records, np.int64),
        offsets=np.array(offsets, np.int64),
        names=list(points),
        roles=[role] * len(points),
        codes=[None] * len(points),
        coordinates=np.array(places).T * np.array(units)[:, None],
        sigma_horizontal_m=missing,
        sigma_height_m=missing,
    )


def _is_row(words: Sequence[str]) -> bool:
    """Return whether the words are those of a point; its height may be NaN."""
    numbers = [word for k, word in enumerate(words[:5]) if k != 2 or word.lower() != _NO_NUMBER]
    return len(words) >= _FEWEST and all(map(is_number, numbers)) and not is_number(words[5])


def _crs(text: str) -> str | None:
    """Return the CRS of a first line; None where it is none."""
    utm = _UTM.fullmatch(text)
    if utm is not None:
        return f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    if not text.upper().startswith(("EPSG:", "+PROJ=")):
        return None
    try:
        pyproj.CRS.from_user_input(text)
    except ProjCrsError:
        return None
    return text


def _height_unit_m(source: LogSource, frame: ControlFrame) -> float:
    """Return the size of the heights' unit (m): the CRS's, the stated one, or the metre where eastings are in metres.

    Raises
    ------
    ConfigError
        where nothing says it, or two say different ones.
    """
    stated, axes = options_of(source, OdmGcpOptions).height_unit, crs_from_text(frame.crs).axis_info
    unit_m = None if stated is None else UNITS["length"][stated]
    if len(axes) == 3:
        own_m = float(axes[2].unit_conversion_factor)
        if unit_m not in (None, own_m):
            raise ConfigError(
                f"options.height_unit = \"{stated}\", and the CRS '{frame.crs}' says another unit of heights",
                expected="one unit",
                change="leave options.height_unit out",
                file=source.path,
            )
        return own_m
    if unit_m is None and frame.kind == "projected" and frame.horizontal_scale != 1.0:
        raise ConfigError(
            f"the CRS '{frame.crs}' counts in {axes[0].unit_name}, and nothing says the unit of heights",
            file=source.path,
            missing=Missing("options.height_unit", choices=("m", "ft", "ft_us")),
        )
    return 1.0 if unit_m is None else unit_m


def _first_crs(path: Path) -> str:
    """Return the CRS of a list's first line."""
    first = next((line for line in head_of(path).decode("utf-8", "replace").lstrip("\ufeff").splitlines()), "")
    crs = _crs(first.strip())
    if crs is None:
        raise FormatError(
            f"the first line, '{first[:60]}', is no CRS", expected="such as EPSG:32632 or WGS84 UTM 32N", file=path
        )
    return crs


def _frame(source: LogSource) -> ControlFrame:
    source.need_file()
    crs = _first_crs(source.path)
    if source.crs is not None and not pyproj.CRS(source.crs).equals(pyproj.CRS(crs), ignore_axis_order=True):
        raise CrsError(
            f"the file's first line says {crs}, the survey file '{source.crs}'",
            expected="one CRS",
            file=source.path,
            missing=Missing("crs", crs),
        )
    need_role(False, options_of(source, OdmGcpOptions).role, source.path)
    return ControlFrame.of(replace(source, crs=crs))


class OdmPointsOptions(Strict):
    """Settings of `odm_picture_points`."""

    sigma_px: float | None = Field(default=None, gt=0.0)
    """1 σ of each coordinate of all points (pixels); not stated where left out."""


class OdmPoints(LogFormat):
    """Where the points of OpenDroneMap's list are in pictures: the columns of x and y in the picture of each line.

    Pixels count from the centre of the upper left one, as OpenSfM, which reads these lists, counts them. Points are
    named as `odm_gcp` names them, which reads their positions from the same file; so this format has to be stated. A
    point whose height is NaN is read: it needs none.
    """

    name = "odm_picture_points"
    title = "OpenDroneMap's places of control points in pictures (gcp_list.txt)"
    yields = ("picture_points",)
    time = "holds no time"
    options = OdmPointsOptions

    def sniff(self, path: Path) -> bool:
        """Never: the same file is `odm_gcp`, and the survey file says which part of it is meant."""
        return False

    def header(self, source: LogSource) -> LogHeader:
        """Check that it is such a list."""
        source.need_file()
        OdmGcp.need_list(source.path)
        return LogHeader({})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream measurements; a line that is none is rejected."""
        sigma = options_of(source, OdmPointsOptions).sigma_px
        for row in odm_rows(source.path):
            if isinstance(row, Reject):
                yield row
                continue
            yield from point_items(
                RawPoints(
                    np.array([row.record]), np.array([row.offset]), [None], [None], [row.picture], [row.point],
                    np.array([[row.u_px], [row.v_px]]), np.array([np.nan if sigma is None else sigma]), [BY_HAND],
                )
            )  # fmt: skip
