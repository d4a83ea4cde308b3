"""Control points as a point layer: GeoJSON or GeoPackage."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError, nearest
from roadscan.core.strict import Strict
from roadscan.formats.vectors.control import ControlFrame, ControlReader, RawControl, Role, need_role
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
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource
from roadscan.ingest.reading.records import options_of


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
