"""Surveyed lines, paint and kerbs: a line layer (GeoJSON, GeoPackage), or text with a line a vertex."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow as pa
import shapely

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, FormatError, RoadscanError
from roadscan.formats.vectors.control import NO_TEXT, SIGMA_MAX_M, ControlFrame, Role
from roadscan.formats.vectors.control_csv import GEODETIC, GRID, HEIGHT, LOCAL, SIGMAS, units_of
from roadscan.formats.vectors.control_vector import check_crs
from roadscan.formats.vectors.vector_layer import (
    attribute_values,
    chosen_layer,
    feature_batches,
    gdal_faults,
    layer_info,
    layer_names,
    number_of,
    shapes_of,
    unread_features,
    word_of,
)
from roadscan.ingest.reading.columns import ColumnOption, Quantity, find_columns
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.text_table import Kind, TextOptions, sniff_layout, text_blocks, text_layout

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
