"""Road centre lines: any vector layer that GDAL reads (shapefile, GeoPackage, GeoJSON, zipped TIGER/Line).

A line feature is a road; its vertices are brought into the survey's map. The width of the road is

1. what an attribute says (`options.width_column`, with `options.width_unit`), else
2. its number of lanes times `options.lane_width_m`, else
3. that of its class: `options.class_widths_m`, and for the MTFCC of TIGER/Line the table :data:`TIGER_ROADS`,

and unknown otherwise. TIGER/Line itself holds neither widths nor lanes: "the attribute data holds the type of the
road which would provide a fair idea about the width of the road" (Sairam, Nagarajan, Ornitz 2016, 3.3.1, whose filter
keeps a buffer about that width; see ``roadscan.georeference.plan.road``).
"""

from __future__ import annotations

import re
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj
import shapely
from pydantic import Field
from pyproj.exceptions import ProjError

from roadscan.compute.array_types import Bool, Float64
from roadscan.core.crs import LOCAL_WORLD, MapFrame, crs_from_text, world_from_geodetic
from roadscan.core.errors import ConfigError, CrsError, FormatError, nearest
from roadscan.core.strict import Strict
from roadscan.formats.vectors.vector_layer import (
    LINE_KINDS,
    attribute_values,
    check_archive,
    chosen_layer,
    feature_batches,
    flat_crs,
    gdal_faults,
    geopackage_kinds,
    is_geopackage,
    layer_info,
    layer_names,
    number_of,
    shapes_of,
    unread_features,
    word_of,
)
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Provisional, Reject, Rows
from roadscan.ingest.reading.records import GRID_MAX_M, NO_TEXT, Sieve, options_of

_EXPECTED: Final = "a layer of lines"
_SHAPE_CODE: Final = 9994  # magic number of a shapefile
_SHAPE_LINES: Final = frozenset({3, 13, 23})  # shape types of lines
_SIDECARS: Final = (".shx", ".dbf", ".prj", ".cpg")
_WIDEST_M: Final = 500.0  # larger widths are refused
_MOST_LANES: Final = 100  # larger numbers of lanes are ignored
_KNOWN_IDS: Final = ("LINEARID", "TLID", "id", "line_id")
_KNOWN_NAMES: Final = ("FULLNAME", "name", "NAME")
_KNOWN_CLASSES: Final = ("MTFCC", "class", "CLASS", "highway")
_KNOWN_LANES: Final = ("lanes", "LANES")


@dataclass(frozen=True)
class RoadClass:
    """A class of roads and its common width."""

    title: str
    lanes: int
    lane_m: float
    shoulders_m: float = 0.0

    @property
    def width_m(self) -> float:
        """Width of lanes and shoulders together (m)."""
        return round(self.lanes * self.lane_m + self.shoulders_m, 3)


TIGER_ROADS: Final[dict[str, RoadClass]] = {
    "S1100": RoadClass("primary road", 3, 3.6, 4.2),
    "S1200": RoadClass("secondary road", 4, 3.6, 4.8),
    "S1400": RoadClass("local neighbourhood road, rural road, city street", 2, 3.6, 1.2),
    "S1500": RoadClass("vehicular trail (four-wheel drive)", 1, 3.6),
    "S1630": RoadClass("ramp", 1, 3.6, 3.6),
    "S1640": RoadClass("service drive, usually along a limited-access highway", 2, 3.6, 1.2),
    "S1710": RoadClass("walkway", 1, 1.5),
    "S1720": RoadClass("stairway", 1, 1.5),
    "S1730": RoadClass("alley", 2, 2.7),
    "S1740": RoadClass("private road for service vehicles", 2, 2.7),
    "S1780": RoadClass("parking-lot road", 2, 3.6),
    "S1820": RoadClass("bicycle path", 2, 1.5),
}
"""Road classes of TIGER/Line by MAF/TIGER feature class code (MTFCC), with common widths.

Classes: U.S. Census Bureau, *MAF/TIGER Feature Class Code Definitions* (TIGER/Line technical documentation, appendix
F). Number of lanes: from those definitions (S1200 "one or more lanes of traffic in each direction", S1400 "usually a
single lane of traffic in each direction"); a limited-access highway (S1100) has a line for each of its roadways.
Widths of lanes (3.6 m; 2.7 m on local roads at least; 1.5 m for a path) and of both shoulders together (freeway
1.2 + 3.0 m, ramp 1.2 + 2.4 m, arterial 2 × 2.4 m, local 2 × 0.6 m) lie within the ranges of FHWA, *Mitigation
Strategies for Design Exceptions* (FHWA-SA-07-011, 2007), chapter 3. A particular road may differ by a factor of two:
state `class_widths_m` or an attribute where widths are known."""


class RoadLinesOptions(Strict):
    """Settings of a layer of road centre lines."""

    layer: str | None = None
    """Layer, where the file has more than one."""
    id_column: str | None = None
    """Attribute with the line's id; LINEARID, TLID or id where left out, and there is one."""
    name_column: str | None = None
    """Attribute with the road's name; FULLNAME or name where left out."""
    class_column: str | None = None
    """Attribute with the road's class; MTFCC, class or highway where left out."""
    lanes_column: str | None = None
    """Attribute with the number of lanes of the line; lanes where left out."""
    lane_width_m: float = Field(default=3.6, gt=0, le=10)
    """Width of a lane (m), for lines with a number of lanes; 3.6 m (12 feet) is common in the U.S. (FHWA)."""
    width_column: str | None = None
    """Attribute with the width of the road."""
    width_unit: str = "m"
    """Unit of the widths: m, mm, cm, km, ft or ft_us."""
    class_widths_m: dict[str, Annotated[float, Field(gt=0, le=_WIDEST_M, allow_inf_nan=False)]] = {}
    """Width of the roads of a class (m) by class, such as { S1100 = 22.0 }; stands above the table for TIGER/Line."""
    measure_from_column: str | None = None
    """Attribute with the measure (milepost) at a line's first vertex, in the layer's unit; for the reference lines
    of `[condition]`."""
    measure_to_column: str | None = None
    """Attribute with the measure at its last vertex."""


class RoadLines(LogFormat):
    """A line feature a road, with its class and width.

    The layer's CRS has to be the stated one (horizontally); a layer that names none is taken in the stated one,
    and none need be stated for a layer that names its own. Lines are drawn to metres, so the best known change of datum
    is taken, however exact. Parts of a multi-part line become rows; heights are left out.
    """

    name: ClassVar[str] = "road_lines"
    title: ClassVar[str] = (
        "Road centre lines: a line layer as shapefile (TIGER/Line, zipped too), GeoPackage or GeoJSON"
    )
    yields: ClassVar[tuple[str, ...]] = ("road_lines",)
    time: ClassVar[str] = "holds no time"
    options: ClassVar[type[RoadLinesOptions]] = RoadLinesOptions
    needs_map: ClassVar[bool] = True
    provisional: ClassVar[tuple[Provisional, ...]] = tuple(
        Provisional(crs=crs) for crs in ("EPSG:4269", "EPSG:4326", "EPSG:4258")
    )

    def sniff(self, path: Path) -> bool:
        """True for a shapefile of lines, zipped too, a GeoPackage with lines, and GeoJSON with lines and no points."""
        try:
            with path.open("rb") as stream:
                head = stream.read(1 << 14)
        except OSError:
            return False
        if head.startswith(b"PK\x03\x04"):
            return _is_zipped_shapefile(path)
        if is_geopackage(head):
            return bool(geopackage_kinds(path) & LINE_KINDS)
        features = re.search(rb'"type"\s*:\s*"FeatureCollection"', head) is not None
        is_json = head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
        has_lines = re.search(rb'"type"\s*:\s*"(Multi)?LineString"', head) is not None
        return _is_line_shapefile(head) or (is_json and features and has_lines and b'"Point"' not in head)

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the files beside a shapefile with its attributes and CRS."""
        return sidecars(path)

    def header(self, source: LogSource) -> LogHeader:
        """Return layer, CRS and the source of the widths."""
        layer = LineLayer.of(source.path, options_of(source, RoadLinesOptions), source.crs, source.defaults.crs)
        _place(layer, source)
        columns = {name: column for name, column in layer.columns.items() if column is not None}
        return LogHeader({"layer": layer.name, "crs": layer.crs, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream lines; a feature without a line is rejected."""
        layer = LineLayer.of(source.path, options_of(source, RoadLinesOptions), source.crs, source.defaults.crs)
        for item in read_lines(layer, _place(layer, source)):
            if isinstance(item, Reject):
                yield item
            else:
                yield from _rows(item)


def _place(layer: LineLayer, source: LogSource) -> Place:
    if source.map is None:
        raise ConfigError("road lines need the survey's map", expected="a map frame", file=source.path)
    return place_in_map(layer.crs, source.map, source.path)


def sidecars(path: Path) -> list[Path]:
    """Return the files that belong to a shapefile; none for other files."""
    if path.suffix.lower() != ".shp":
        return []
    beside = {p.suffix.lower(): p for p in sorted(path.parent.glob(f"{_literal(path.stem)}.*"))}
    return [beside[suffix] for suffix in _SIDECARS if suffix in beside]


def _literal(stem: str) -> str:
    return re.sub(r"([\[\]*?])", r"[\1]", stem)


def _is_line_shapefile(head: bytes) -> bool:
    return (
        len(head) >= 100
        and head[:4] == _SHAPE_CODE.to_bytes(4, "big")
        and struct.unpack_from("<ii", head, 28)[0] == 1000
        and struct.unpack_from("<i", head, 32)[0] in _SHAPE_LINES
    )


def _is_zipped_shapefile(path: Path) -> bool:
    """Return True for an archive whose first shapefile has lines. Never raises."""
    try:
        with zipfile.ZipFile(path) as archive:
            shapes = [name for name in archive.namelist()[:1000] if name.lower().endswith(".shp")]
            if not shapes:
                return False
            with archive.open(shapes[0]) as stream:
                return _is_line_shapefile(stream.read(100))
    except Exception:  # noqa: BLE001  damaged archives raise much, and it is no shapefile then
        return False


# --- the layer ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineLayer:
    """A layer of lines with its attributes."""

    path: Path
    name: str
    crs: str
    """CRS of its coordinates, or "local"."""
    geometry: str
    """Name of the geometry column in Arrow."""
    columns: dict[str, str | None]
    """Attribute with the id, name, class, lanes and width."""
    options: RoadLinesOptions

    @classmethod
    def of(
        cls, path: Path, options: RoadLinesOptions, stated_crs: str | None, default_crs: str | None = None
    ) -> LineLayer:
        """Open a layer and check it against what is stated.

        Raises
        ------
        FormatError, ConfigError, CrsError
            if GDAL cannot read it, if an attribute or unit is unknown, or if its CRS is unknown or another one.
        """
        if options.width_unit not in UNITS["length"]:
            raise ConfigError(
                f"width_unit '{options.width_unit}'", expected="one of: " + ", ".join(UNITS["length"]), file=path
            )
        if not path.exists():
            raise FormatError("the layer does not exist", change="check its path in the survey file", file=path)
        check_archive(path)
        with gdal_faults(path, _EXPECTED):
            name = chosen_layer(layer_names(path), options.layer, path)
            info = layer_info(path, name)
        names = tuple(str(field) for field in info["fields"])
        columns = {
            "id": _attribute(options.id_column, _KNOWN_IDS, names, path),
            "name": _attribute(options.name_column, _KNOWN_NAMES, names, path),
            "class": _attribute(options.class_column, _KNOWN_CLASSES, names, path),
            "lanes": _attribute(options.lanes_column, _KNOWN_LANES, names, path),
            "width": _attribute(options.width_column, (), names, path),
            "measure_from": _attribute(options.measure_from_column, (), names, path),
            "measure_to": _attribute(options.measure_to_column, (), names, path),
        }
        crs = layer_crs(info["crs"], stated_crs or (None if info["crs"] else default_crs), path)
        return cls(path, name, crs, str(info.get("geometry_name") or ""), columns, options)

    @property
    def says_widths(self) -> bool:
        """Return True where an attribute leads to widths."""
        return any(self.columns[name] is not None for name in ("width", "lanes", "class"))


def _attribute(stated: str | None, known: tuple[str, ...], names: tuple[str, ...], path: Path) -> str | None:
    if stated is None:
        return next((name for name in known if name in names), None)
    if stated not in names:
        raise ConfigError(
            f"the layer has no attribute '{stated}'{nearest(stated, names)}",
            expected="one of: " + (", ".join(names) or "it has none"),
            file=path,
        )
    return stated


def layer_crs(found: str | None, stated: str | None, path: Path) -> str:
    """Return the CRS of a layer: its own, or the stated one; the two have to agree."""
    if found is None:
        if stated is None:
            raise CrsError(
                "neither the layer nor the survey file says which CRS the lines are in",
                expected='a CRS, such as "EPSG:4269" for TIGER/Line, or "local"',
                file=path,
            )
        return stated
    own = flat_crs(crs_from_text(found))
    if stated is not None:
        agree = own.is_engineering if stated == LOCAL_WORLD else _same(own, flat_crs(crs_from_text(stated)))
        if not agree:
            raise CrsError(
                f"the layer's CRS is {own.name}, the survey file states '{stated}'",
                expected="one CRS",
                change="state the layer's CRS or none, or correct the layer",
                file=path,
            )
        return stated
    if own.is_engineering:
        return LOCAL_WORLD
    return found


def _same(one: pyproj.CRS, other: pyproj.CRS) -> bool:
    authority = one.to_authority(min_confidence=90)
    known = authority is not None and authority == other.to_authority(min_confidence=90)
    return known or one.equals(other, ignore_axis_order=True)


# --- into the map ------------------------------------------------------------------------------------

Place = Callable[[Float64], Float64]
"""Transforms coordinates (n, 2) of a layer to easting and northing in the map (m); not finite where impossible."""


def place_in_map(crs: str, frame: MapFrame, path: Path) -> Place:
    """Return the transformation of a layer's coordinates to the map; heights are ignored.

    Raises
    ------
    CrsError
        if there is no way from one to the other.
    """
    if crs == LOCAL_WORLD:
        return lambda xy: frame.map_from_world(LOCAL_WORLD, np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    anchor = frame.anchor
    if frame.crs is None and anchor is None:
        raise CrsError(
            f"the lines are in '{crs_from_text(crs).name}', the map is a local frame without an anchor",
            expected="map.local.anchor, which ties the local frame to the Earth",
            file=path,
        )
    target = anchor.crs if frame.crs is None and anchor is not None else str(frame.crs)
    try:
        transformer = pyproj.Transformer.from_crs(
            flat_crs(crs_from_text(crs)), flat_crs(crs_from_text(target)), always_xy=True
        )
    except ProjError as error:
        raise CrsError(f"the lines cannot be brought from {crs} to {target}: {error}", file=path) from error

    def place(xy: Float64) -> Float64:
        placed = np.stack(transformer.transform(*xy.T), axis=-1)
        if frame.crs is not None or anchor is None:
            return np.asarray(placed * frame.horizontal_unit_m)
        out = np.full_like(placed, np.nan)
        good = np.flatnonzero(np.isfinite(placed.sum(axis=1)))
        geodetic = np.column_stack([placed[good], np.full(good.size, anchor.height_m)])
        out[good] = frame.map_from_world(anchor.world, world_from_geodetic(anchor.world, geodetic))[:, :2]
        return out

    return place


# --- lines -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lines:
    """Lines in the map."""

    records: npt.NDArray[np.int64]
    """(n,) number of each line's feature."""
    ids: list[str]
    parts: npt.NDArray[np.int32]
    names: list[str | None]
    classes: list[str | None]
    lanes: list[int | None]
    width_m: Float64
    """(n,) NaN where unknown."""
    width_from: list[str | None]
    shapes: npt.NDArray[np.object_]
    """(n,) Shapely lines, easting and northing (m)."""
    measures: Float64
    """(n, 2) measures at the feature's ends, NaN where the layer states none or the feature has several parts."""


def read_lines(layer: LineLayer, place: Place, *, need_widths: bool = True) -> Iterator[Lines | Reject]:
    """Yield a layer's lines in the map; features without a line are rejected.

    Parameters
    ----------
    need_widths : features whose width cannot be that of a road are rejected too; otherwise their width is unknown.
    """
    first = 0
    columns = [name for name in layer.columns.values() if name is not None]
    for batch in feature_batches(layer.path, layer.name, _EXPECTED, columns=list(dict.fromkeys(columns))):
        yield from _lines(batch, layer, place, first, need_widths)
        first += batch.num_rows
    yield from unread_features(layer.path, first)


def _lines(
    batch: pa.RecordBatch, layer: LineLayer, place: Place, first: int, need_widths: bool
) -> Iterator[Lines | Reject]:
    sieve = Sieve(batch.num_rows)
    shapes = _shapes(batch, layer, sieve)
    parts, feature = shapely.get_parts(shapes, return_index=True)
    full = ~shapely.is_empty(parts)
    parts, feature = parts[full], feature[full]
    placed, sound = _placed(parts, place)
    lost = np.zeros(batch.num_rows, dtype=bool)
    lost[feature[~sound]] = True
    sieve.drop(lost, "a vertex has no place in the map")
    words = _Words.of(batch, layer)
    sieve.drop(words.damaged, "an attribute is not UTF-8 text")
    width, origin, odd = _widths(words, layer.options)
    if need_widths:
        sieve.drop(odd, f"the width is outside 0 to {_WIDEST_M:g} m")
    yield from sieve.rejects(first + np.arange(batch.num_rows), np.full(batch.num_rows, -1))
    kept = sieve.good[feature]
    chosen = feature[kept]
    if chosen.size:
        numbers = np.arange(feature.size) - np.searchsorted(feature, feature)
        rows = chosen.tolist()
        whole = np.bincount(feature, minlength=batch.num_rows) == 1
        yield Lines(
            records=first + chosen,
            ids=[words.ids[i] or str(first + i) for i in rows],
            parts=numbers[kept].astype(np.int32),
            names=[words.names[i] or None for i in rows],
            classes=[words.classes[i] or None for i in rows],
            lanes=[words.lanes[i] for i in rows],
            width_m=width[chosen],
            width_from=[origin[i] for i in rows],
            shapes=placed[kept],
            measures=np.where(whole[:, None], words.measures, np.nan)[chosen],
        )


def _shapes(batch: pa.RecordBatch, layer: LineLayer, sieve: Sieve) -> npt.NDArray[np.object_]:
    """Return geometries (n,) of the features, empty where there is no line."""
    shapes = shapely.force_2d(shapes_of(batch, layer.geometry))
    kinds = shapely.get_type_id(shapes)
    lines = np.isin(kinds, (shapely.GeometryType.LINESTRING, shapely.GeometryType.MULTILINESTRING))
    lines &= ~shapely.is_empty(shapes)
    sieve.drop(~lines, "the feature has no line")
    out: npt.NDArray[np.object_] = np.where(lines, shapes, shapely.MultiLineString())
    return out


def _placed(parts: npt.NDArray[np.object_], place: Place) -> tuple[npt.NDArray[np.object_], Bool]:
    """Return lines (m,) in the map, and which of them could be transformed."""
    xy, line = shapely.get_coordinates(parts, return_index=True)
    sound = np.ones(parts.size, dtype=bool)
    if not parts.size:
        return parts, sound
    with np.errstate(invalid="ignore", over="ignore"):
        out = place(xy)
        x, y = np.abs(out).T
    finite = (x <= GRID_MAX_M) & (y <= GRID_MAX_M)  # False with a NaN
    sound[line[~finite]] = False
    return shapely.linestrings(np.where(finite[:, None], out, 0.0), indices=line), sound


@dataclass(frozen=True)
class _Words:
    """Attributes of a batch of features, (n,) each."""

    ids: list[str]
    names: list[str]
    classes: list[str]
    lanes: list[int | None]
    widths: Float64
    measures: Float64
    """(n, 2)"""
    damaged: Bool
    """True where bytes are no text."""

    @classmethod
    def of(cls, batch: pa.RecordBatch, layer: LineLayer) -> _Words:
        def values(what: str) -> list[Any]:
            name = layer.columns[what]
            return [None] * batch.num_rows if name is None else attribute_values(batch, name)

        ids, names, classes = ([word_of(v) for v in values(what)] for what in ("id", "name", "class"))
        lanes = [number_of(v) for v in values("lanes")]
        return cls(
            ids=ids,
            names=names,
            classes=classes,
            lanes=[int(n) if 0 < n <= _MOST_LANES else None for n in lanes],
            widths=np.array([number_of(v) for v in values("width")], dtype=np.float64),
            measures=np.column_stack([[number_of(v) for v in values(f"measure_{end}")] for end in ("from", "to")]),
            damaged=np.array(
                [NO_TEXT in "".join(three) for three in zip(ids, names, classes, strict=True)], dtype=bool
            ),
        )


def _widths(words: _Words, options: RoadLinesOptions) -> tuple[Float64, list[str | None], Bool]:
    """Return width (n,) of each feature's road (m), NaN where unknown, its source, and whether it is impossible."""
    stated = words.widths * UNITS["length"][options.width_unit]
    odd = (stated < 0) | (stated > _WIDEST_M)
    out = np.full(stated.size, np.nan)
    origin: list[str | None] = [None] * stated.size
    for i, (width, lanes, kind) in enumerate(zip(stated.tolist(), words.lanes, words.classes, strict=True)):
        by_class = class_width_m(kind, options)
        if odd[i]:
            continue
        if width > 0:
            out[i], origin[i] = width, "width"
        elif lanes:
            out[i], origin[i] = lanes * options.lane_width_m, "lanes"
        elif by_class is not None:
            out[i], origin[i] = by_class, "class"
    return out, origin, odd


def class_width_m(kind: str, options: RoadLinesOptions) -> float | None:
    """Return the width (m) of the roads of a class, None where it is unknown."""
    if kind in options.class_widths_m:
        return options.class_widths_m[kind]
    known = TIGER_ROADS.get(kind)
    return None if known is None else known.width_m


def _rows(lines: Lines) -> Iterator[Rows]:
    xy, line = shapely.get_coordinates(lines.shapes, return_index=True)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(line, minlength=lines.shapes.size))]).astype(np.int32)
    columns = {
        "line_id": pa.array(lines.ids, pa.string()),
        "part": pa.array(lines.parts),
        "name": pa.array(lines.names, pa.string()),
        "class": pa.array(lines.classes, pa.string()),
        "lanes": pa.array(lines.lanes, pa.int32()),
        "width_m": pa.array(lines.width_m, from_pandas=True),
        "width_from": pa.array(lines.width_from, pa.string()),
    }
    element = pa.field("element", pa.float64(), nullable=False)
    for name, values in (("easting_m", xy[:, 0]), ("northing_m", xy[:, 1])):
        columns[name] = pa.ListArray.from_arrays(offsets, np.ascontiguousarray(values), type=pa.list_(element))
    yield Rows("road_lines", pa.record_batch(columns), first_record=int(lines.records[0]))
