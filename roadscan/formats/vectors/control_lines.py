"""Surveyed lines, paint and kerbs: a line layer (GeoJSON, GeoPackage), or text with a line a vertex."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow as pa
import shapely

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError, RoadscanError, nearest
from roadscan.core.strict import Strict
from roadscan.formats.vectors.control import SIGMA_MAX_M, ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.formats.vectors.control_csv import GEODETIC, GRID, HEIGHT, LOCAL, SIGMAS, units_of
from roadscan.formats.vectors.vector_layer import (
    LINE_KINDS,
    attribute_values,
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
from roadscan.ingest.reading.columns import UNITS, ColumnOption, Quantity, find_columns
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import NO_TEXT, Sieve, options_of
from roadscan.ingest.reading.text_table import Kind, TextOptions, sniff_layout, text_blocks, text_layout


class ControlVectorOptions(Strict):
    """Settings of `control_vector`."""

    layer: str | None = None
    """Layer, where the file has more than one."""
    name: str = "name"
    """Attribute with the point's name."""
    code: str = "code"
    """Attribute with the feature code; may be absent."""
    role_attribute: str = "role"
    """Attribute with the role, gcp or check; may be absent."""
    role: Role | None = None
    """Role of all points where the layer has no attribute for it."""
    height: str | None = None
    """Attribute with the height; without it, the height is the z of the point."""
    height_unit: str = "m"
    """Unit of the heights: m, mm, cm, km, ft or ft_us."""
    sigma_horizontal: str = "sigma_horizontal_m"
    """Attribute with 1 σ of easting and of northing in metres; may be absent."""
    sigma_height: str = "sigma_height_m"
    """Attribute with 1 σ of the height in metres; may be absent."""


class ControlVector(LogFormat):
    """A feature a point: a point geometry with z, and the attributes name, code, role and σ.

    The layer's CRS has to be the stated one (horizontally); a layer that names none is taken
    in the stated one. GeoJSON without a `crs` member is in longitude and latitude of WGS 84.
    """

    name = "control_vector"
    title = "Ground control and check points as GeoJSON or GeoPackage points"
    yields = ("control_points",)
    time = "holds no time"
    options = ControlVectorOptions

    def sniff(self, path: Path) -> bool:
        """True for a GeoPackage, unless it holds lines alone, and for GeoJSON with point features."""
        try:
            with path.open("rb") as stream:
                head = stream.read(1 << 14)
        except OSError:
            return False
        if is_geopackage(head):
            kinds = geopackage_kinds(path)
            return not kinds or bool(kinds - LINE_KINDS)
        features = re.search(rb'"type"\s*:\s*"FeatureCollection"', head)
        return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{") and features is not None and b'"Point"' in head

    def header(self, source: LogSource) -> LogHeader:
        """Check layer, attributes, CRS, heights and roles."""
        source.need_file()
        plan = _plan(source)
        return LogHeader({"crs": plan.frame.crs, "height": plan.frame.height, "layer": plan.layer})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points; a feature without a name, a point or a height is rejected."""
        plan = _plan(source)
        reader = ControlReader(plan.frame)
        first = 0
        for batch in feature_batches(source.path, plan.layer):
            yield from reader.items(_raw(batch, plan, first))
            first += batch.num_rows
        yield from reader.findings()
        yield from unread_features(source.path, first)


@dataclass(frozen=True)
class _Plan:
    """How a layer is read."""

    layer: str
    attributes: tuple[str, ...]
    geometry: str
    """Name of the geometry column in Arrow; "" for the default."""
    height_scale: float
    frame: ControlFrame
    options: ControlVectorOptions


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, ControlVectorOptions)
    if options.height_unit not in UNITS["length"]:
        raise ConfigError(
            f"height_unit '{options.height_unit}'", expected="one of: " + ", ".join(UNITS["length"]), file=source.path
        )
    frame = ControlFrame.of(source)
    with gdal_faults(source.path):
        layers = layer_names(source.path)
        layer = chosen_layer(layers, options.layer, source.path)
        info = layer_info(source.path, layer)
    check_crs(info["crs"], frame, source.path)
    attributes = tuple(str(field) for field in info["fields"])
    for wanted in (options.name, options.height):
        if wanted is not None and wanted not in attributes:
            raise FormatError(
                f"layer '{layer}' has no attribute '{wanted}'{nearest(wanted, attributes)}",
                expected="one of: " + (", ".join(attributes) or "it has none"),
                file=source.path,
            )
    need_role(options.role_attribute in attributes, options.role, source.path)
    return _Plan(
        layer=layer,
        attributes=attributes,
        geometry=str(info.get("geometry_name") or ""),
        height_scale=UNITS["length"][options.height_unit],
        frame=frame,
        options=options,
    )


def check_crs(found: str | None, frame: ControlFrame, file: Path) -> None:
    """Refuse a layer whose CRS differs from the stated one."""
    if found is None:
        return
    own = crs_from_text(found)
    horizontal = own.sub_crs_list[0] if own.is_compound else own
    if frame.crs == LOCAL_WORLD:
        agree = horizontal.is_engineering
    else:
        agree = flat_crs(horizontal).equals(flat_crs(crs_from_text(frame.crs)), ignore_axis_order=True)
    if not agree:
        raise CrsError(
            f"the layer's CRS is {own.name}, the survey file states '{frame.crs}'",
            expected="one CRS",
            change="state the layer's CRS, or correct the layer",
            file=file,
        )


def _raw(batch: pa.RecordBatch, plan: _Plan, first: int) -> RawControl:
    size = batch.num_rows
    options = plan.options

    def words(attribute: str, otherwise: str) -> list[str]:
        if attribute not in plan.attributes:
            return [otherwise] * size
        return [word_of(value) or otherwise for value in attribute_values(batch, attribute)]

    def number(attribute: str) -> Float64:
        if attribute not in plan.attributes:
            return np.full(size, np.nan)
        return np.array([number_of(v) for v in attribute_values(batch, attribute)], dtype=np.float64)

    points = _points(batch, plan.geometry)
    height = points[2] if options.height is None else number(options.height)
    return RawControl(
        records=np.arange(first, first + size, dtype=np.int64),
        offsets=np.full(size, -1, dtype=np.int64),
        names=words(options.name, ""),
        roles=words(options.role_attribute, options.role or ""),
        codes=[word or None for word in words(options.code, "")],
        coordinates=np.stack([*(points[:2] * plan.frame.horizontal_scale), height * plan.height_scale]),
        sigma_horizontal_m=number(options.sigma_horizontal),
        sigma_height_m=number(options.sigma_height),
    )


def _points(batch: pa.RecordBatch, geometry: str) -> Float64:
    """Return x, y, z (3, n) of the point geometries, NaN for anything else and for a missing z."""
    shapes = shapes_of(batch, geometry)
    is_place = (shapely.get_type_id(shapes) == shapely.GeometryType.POINT) & ~shapely.is_empty(shapes)
    points = shapes.copy()
    points[~is_place] = None
    return np.stack([shapely.get_x(points), shapely.get_y(points), shapely.get_z(points)])


LineKind = Literal["paint", "kerb"]
_KINDS: Final = ("paint", "kerb")
_ROLES: Final = ("gcp", "check")
_LINE: Final = Quantity("line", "text", ("name", "id", "line_id"))
_WORDS: Final = (Quantity("kind", "text", optional=True), Quantity("role", "text", optional=True))


class ControlLinesOptions(TextOptions):
    """Settings of `control_lines`."""

    kind: LineKind | None = None
    """What the lines are ("paint" or "kerb") where the file has no attribute or column `kind`."""
    role: Role = "gcp"
    """Role of the lines where the file has no attribute or column `role`."""
    layer: str | None = None
    """Layer, where the file has more than one."""
    name: str = "name"
    """Attribute of a layer with the line's name; the feature's number where it has none."""
    columns: dict[str, ColumnOption] = {}
    """Of text: which column holds which quantity, where its name does not say so: line, kind, role; longitude,
    latitude, or easting, northing; height; sigma_horizontal, sigma_height."""


@dataclass(frozen=True)
class _Line:
    """A line as the file writes it."""

    record: int
    name: str
    kind: str
    role: str
    coordinates: Float64
    """(3, v) longitude and latitude (°), or easting and northing (m); height (m) or NaN."""
    sigma_horizontal_m: float
    sigma_height_m: float


class ControlLines(LogFormat):
    """A line feature, or the text rows of one name, a surveyed line; heights may be left out.

    State `format = "control_lines"`: lines of roads look the same. Of a layer the attributes `kind`, `role`,
    `sigma_horizontal_m` and `sigma_height_m` are read; text has the columns of `control_csv`, and `line` for the name.
    """

    name = "control_lines"
    title = "Surveyed lines (paint, kerbs) as GeoJSON, GeoPackage or CSV"
    yields = ("control_lines",)
    time = "holds no time"
    options = ControlLinesOptions
    needs_map = True

    def sniff(self, path: Path) -> bool:
        """False: lines of roads look the same, so the survey file states the format."""
        return False

    def header(self, source: LogSource) -> LogHeader:
        """Check layer or columns, CRS and heights."""
        frame, options = ControlFrame.of(source), options_of(source, ControlLinesOptions)
        first = next(_lines(source, frame, options), None)
        if first is None:
            raise FormatError("there is no line", expected="lines of two vertices or more", file=source.path)
        return LogHeader({"crs": frame.crs, "height": frame.height})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream lines; one without a kind, or with a vertex that has no place, is rejected."""
        frame, options = ControlFrame.of(source), options_of(source, ControlLinesOptions)
        for one in _lines(source, frame, options):
            yield one if isinstance(one, Reject) else _item(one, frame)


def _item(line: _Line, frame: ControlFrame) -> Item:
    why = _why_not(line)
    known = np.isfinite(line.coordinates[2]).all()
    coordinates = line.coordinates if known else np.stack([*line.coordinates[:2], np.zeros(line.coordinates.shape[1])])
    sieve = Sieve(coordinates.shape[1])
    frame.check(coordinates, sieve)
    if not why and not sieve.good.all():
        why = "a vertex lies outside of what its CRS allows"
    if not why:
        try:
            placed = frame.to_map(coordinates)
        except RoadscanError as error:
            why = error.arrived
    if why:
        return Reject(why, line.record)
    batch = pa.record_batch({
        "name": pa.array([line.name]), "kind": pa.array([line.kind]), "role": pa.array([line.role]),
        **{name: pa.array([row.tolist()], pa.list_(pa.field("element", pa.float64(), nullable=False)))
           for name, row in zip(("easting_m", "northing_m"), placed, strict=False)},
        "height_m": pa.array([placed[2].tolist() if known else []],
                             pa.list_(pa.field("element", pa.float64(), nullable=False))),
        "sigma_horizontal_m": pa.array([line.sigma_horizontal_m], pa.float64(), from_pandas=True),
        "sigma_height_m": pa.array([line.sigma_height_m], pa.float64(), from_pandas=True),
    })  # fmt: skip
    return Rows("control_lines", batch, first_record=line.record)


def _why_not(line: _Line) -> str:
    """Return why a line is invalid; "" for a valid one."""
    sigmas = np.array([line.sigma_horizontal_m, line.sigma_height_m])
    tests = (
        (line.coordinates.shape[1] < 2, "the line has fewer than two vertices"),
        (NO_TEXT in line.name, "the name is not UTF-8 text"),
        (line.kind not in _KINDS, "kind is neither 'paint' nor 'kerb'"),
        (line.role not in _ROLES, "role is neither 'gcp' nor 'check'"),
        (bool(((sigmas < 0) | (sigmas > SIGMA_MAX_M)).any()), f"a σ is outside 0 to {SIGMA_MAX_M:g} m"),
    )
    return next((why for failed, why in tests if failed), "")


def _lines(source: LogSource, frame: ControlFrame, options: ControlLinesOptions) -> Iterator[_Line | Reject]:
    if sniff_layout(source.path) is not None and source.path.suffix.lower() not in {".geojson", ".json"}:
        yield from _of_text(source, frame, options)
    else:
        yield from _of_layer(source, frame, options)


def _of_layer(source: LogSource, frame: ControlFrame, options: ControlLinesOptions) -> Iterator[_Line | Reject]:
    """Yield lines of a layer; parts of a feature are lines of one name."""
    with gdal_faults(source.path, "a layer of lines"):
        layer = chosen_layer(layer_names(source.path), options.layer, source.path)
        info = layer_info(source.path, layer)
    check_crs(info["crs"], frame, source.path)
    attributes, first = tuple(str(field) for field in info["fields"]), 0
    if "kind" not in attributes and options.kind is None:
        raise _no_kind(source.path)
    for batch in feature_batches(source.path, layer, "a layer of lines"):

        def values(name: str, batch: pa.RecordBatch = batch) -> list[object]:
            return attribute_values(batch, name) if name in attributes else [None] * batch.num_rows

        rows = zip(
            shapes_of(batch, str(info.get("geometry_name") or "")), values(options.name), values("kind"),
            values("role"), values("sigma_horizontal_m"), values("sigma_height_m"), strict=True,
        )  # fmt: skip
        for record, (shape, name, kind, role, across, upright) in enumerate(rows, first):
            parts = [p for p in shapely.get_parts(shape) if p.geom_type == "LineString" and not p.is_empty]
            if not parts:
                yield Reject("the feature has no line", record)
            for part in parts:
                xyz = shapely.get_coordinates(part, include_z=True).T
                xyz = np.stack([*(xyz[:2] * frame.horizontal_scale), xyz[2]])
                words = word_of(name) or f"{source.path.stem} {record}", word_of(kind) or options.kind or ""
                yield _Line(record, *words, word_of(role) or options.role, xyz, number_of(across), number_of(upright))
        first += batch.num_rows
    yield from unread_features(source.path, first)


def _of_text(source: LogSource, frame: ControlFrame, options: ControlLinesOptions) -> Iterator[_Line | Reject]:
    """Yield lines of text rows, in the order in which their names first occur."""
    layout = text_layout(source.path, options)
    position = {"local": (*LOCAL, HEIGHT), "projected": (*GRID, HEIGHT), "geographic": (*GEODETIC, HEIGHT)}
    *place, height = position[frame.kind]
    upright = replace(height, optional=True)
    quantities = (_LINE, *_WORDS, *place, upright, *SIGMAS)
    columns = find_columns(quantities, layout.names, options.columns, source.path, units_of(frame))
    if "kind" not in columns and options.kind is None:
        raise _no_kind(source.path)
    words = {"line", "kind", "role"}
    kinds: dict[str, Kind] = {c.column: "text" if q in words else "number" for q, c in columns.items()}
    found: dict[str, list[tuple[int, str, str, list[float]]]] = {}
    wanted = [*(q.name for q in place), height.name, "sigma_horizontal", "sigma_height"]
    turned = 180.0 / math.pi if frame.kind == "geographic" else 1.0
    for block in text_blocks(source.path, layout, kinds):
        if isinstance(block, Reject):
            yield block
            continue
        size = block.records.size
        numbers = [
            block.number(columns[name].column) * columns[name].scale if name in columns else np.full(size, np.nan)
            for name in wanted
        ]
        table = np.stack([numbers[0] * turned, numbers[1] * turned, *numbers[2:]], axis=-1).tolist()
        texts = [block.text(columns[w].column) if w in columns else [""] * size for w in ("line", "kind", "role")]
        for record, row, name, kind, role in zip(block.records.tolist(), table, *texts, strict=True):
            found.setdefault(name or "", []).append((record, kind or "", role or "", row))
    for name, vertices in found.items():
        record, kind, role, first = vertices[0]
        coordinates = np.array([row[:3] for *_, row in vertices]).T
        yield _Line(record, name, kind or options.kind or "", role or options.role, coordinates, first[3], first[4])


def _no_kind(path: Path) -> ConfigError:
    return ConfigError(
        "nothing says whether the lines are paint or kerbs",
        expected="an attribute or column 'kind' with paint or kerb, or options.kind", file=path,
    )  # fmt: skip
