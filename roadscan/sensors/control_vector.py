"""Control points as a point layer: GeoJSON or GeoPackage."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyogrio
import pyproj
import shapely

from roadscan.model.crs import LOCAL_WORLD, crs_from_text
from roadscan.model.errors import ConfigError, CrsError, FormatError, RoadscanError, nearest
from roadscan.model.strict import Strict
from roadscan.sensors.base import Item, LogFormat, LogHeader, LogSource
from roadscan.sensors.columns import UNITS
from roadscan.sensors.control import ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.sensors.records import options_of

Float64 = npt.NDArray[np.float64]

BATCH_FEATURES: Final = 4_096
_SQLITE: Final = b"SQLite format 3\x00"
_GEOPACKAGE_IDS: Final = (b"GPKG", b"GP10", b"GP11")


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

    The layer's own CRS has to be the stated one (horizontally); a layer that names none is taken
    in the stated one. GeoJSON without a `crs` member is in longitude and latitude of WGS 84.
    """

    name = "control_vector"
    title = "Ground control and check points as GeoJSON or GeoPackage points"
    yields = ("control_points",)
    time = "holds no time"
    options = ControlVectorOptions

    def sniff(self, path: Path) -> bool:
        """True for a GeoPackage, and for GeoJSON with point features."""
        try:
            with path.open("rb") as stream:
                head = stream.read(1 << 14)
        except OSError:
            return False
        if head.startswith(_SQLITE):
            return head[68:72] in _GEOPACKAGE_IDS
        features = re.search(rb'"type"\s*:\s*"FeatureCollection"', head)
        return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{") and features is not None and b'"Point"' in head

    def header(self, source: LogSource) -> LogHeader:
        """Check layer, attributes, CRS, heights and roles."""
        plan = _plan(source)
        return LogHeader({"crs": plan.frame.crs, "height": plan.frame.height, "layer": plan.layer})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points; a feature without a name, a point or a height is rejected."""
        plan = _plan(source)
        reader = ControlReader(plan.frame)
        first = 0
        for batch in _batches(source.path, plan):
            yield from reader.items(_raw(batch, plan, first))
            first += batch.num_rows


@dataclass(frozen=True)
class _Plan:
    """How one layer is read."""

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
    with _gdal(source.path):
        layers = [str(layer[0]) for layer in pyogrio.list_layers(source.path)]
        layer = _layer_of(layers, options.layer, source.path)
        info: dict[str, Any] = pyogrio.read_info(source.path, layer=layer)
    _check_crs(info["crs"], frame, source.path)
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


def _layer_of(layers: list[str], stated: str | None, file: Path) -> str:
    if stated is not None and stated not in layers:
        raise ConfigError(
            f"there is no layer '{stated}'{nearest(stated, layers)}",
            expected="one of: " + ", ".join(layers),
            file=file,
        )
    if stated is None and len(layers) != 1:
        raise ConfigError(
            f"the file has {len(layers)} layers",
            expected="options.layer, one of: " + ", ".join(layers),
            file=file,
        )
    return stated or layers[0]


def _check_crs(found: str | None, frame: ControlFrame, file: Path) -> None:
    """Refuse a layer whose own CRS is another than the stated one."""
    if found is None:
        return
    own = crs_from_text(found)
    horizontal = own.sub_crs_list[0] if own.is_compound else own
    if frame.crs == LOCAL_WORLD:
        agree = horizontal.is_engineering
    else:
        agree = _flat(horizontal).equals(_flat(crs_from_text(frame.crs)), ignore_axis_order=True)
    if not agree:
        raise CrsError(
            f"the layer's CRS is {own.name}, the survey file states '{frame.crs}'",
            expected="one CRS",
            change="state the layer's CRS, or correct the layer",
            file=file,
        )


def _flat(crs: pyproj.CRS) -> pyproj.CRS:
    return crs.to_2d() if crs.is_geographic or crs.is_projected else crs


def _batches(path: Path, plan: _Plan) -> Iterator[pa.RecordBatch]:
    with ExitStack() as stack:
        with _gdal(path):
            opened = pyogrio.open_arrow(path, layer=plan.layer, batch_size=BATCH_FEATURES, use_pyarrow=True)
            reader = stack.enter_context(opened)[1]
        while True:
            with _gdal(path):
                batch = next(reader, None)
            if batch is None:
                return
            yield batch


@contextmanager
def _gdal(path: Path) -> Iterator[None]:
    """GDAL's complaints about the file as a FormatError; its warnings are not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except RoadscanError:
            raise
        except (RuntimeError, ValueError, OSError, pa.ArrowException) as error:
            raise FormatError(
                f"GDAL cannot read the file: {error}", expected="GeoJSON or GeoPackage points", file=path
            ) from error


def _raw(batch: pa.RecordBatch, plan: _Plan, first: int) -> RawControl:
    size = batch.num_rows
    options = plan.options

    def words(attribute: str, otherwise: str) -> list[str]:
        if attribute not in plan.attributes:
            return [otherwise] * size
        return [_word(value) or otherwise for value in _values(batch.column(attribute))]

    def number(attribute: str) -> Float64:
        if attribute not in plan.attributes:
            return np.full(size, np.nan)
        return np.array([_number(v) for v in _values(batch.column(attribute))], dtype=np.float64)

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
    """x, y, z (3, n) of the point geometries, NaN for anything else and for a missing z."""
    name = geometry if geometry in batch.schema.names else "wkb_geometry"
    shapes = shapely.from_wkb(batch.column(name).to_numpy(zero_copy_only=False), on_invalid="ignore")
    points = np.where(shapely.get_type_id(shapes) == shapely.GeometryType.POINT, shapes, None)
    return np.stack([shapely.get_x(points), shapely.get_y(points), shapely.get_z(points)])


def _values(column: pa.Array) -> list[Any]:
    """Values of an attribute; text as bytes, since GDAL does not check that it is UTF-8."""
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        column = column.cast(pa.large_binary())
    values: list[Any] = column.to_pylist()
    return values


def _word(value: Any) -> str:
    """Text of an attribute, "" where it is missing; U+FFFD stands for bytes that are no text."""
    if value is None:
        return ""
    return (value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)).strip()


def _number(value: Any) -> float:
    """Number of an attribute, NaN where it is missing or none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
