"""``las``: the points of a tile as LAS 1.4 or LAZ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.gpstime import ADJUSTED_OFFSET_S, NS_PER_S
from roadscan.core.grid import QUANTA_PER_M, TileGrid
from roadscan.core.strict import Strict
from roadscan.georeference.cloud import TilePoints
from roadscan.store.codecs.las import ONE_OF_ONE, Layout, check_points, write_points
from roadscan.tiles.product import Cells, ProductContext, Tile, TileProduct

if TYPE_CHECKING:
    import laspy


_INT32_MAX: Final = 2**31 - 1  # Largest stored coordinate.


@dataclass(frozen=True)
class Axis:
    """One coordinate as LAS stores it: value = stored · scale + offset, in the CRS's unit."""

    stored: npt.NDArray[np.int32]
    scale: float
    offset: float
    error_max_m: float
    """Largest difference between a point and what a reader gets back (m)."""


Axes = tuple[Axis, Axis, Axis]


def axis(quanta: npt.NDArray[Any], corner_quanta: int, scale_m: float, unit_m: float, product: str) -> Axis:
    """Return an axis that stores `quanta` (n,) from `corner_quanta`; offsets are whole units, shared by all tiles.

    Raises :class:`ConfigError` where the scale is too fine for 32 bits.
    """
    unit_quanta = QUANTA_PER_M * unit_m
    scale = _scale(scale_m, unit_m)
    offset = float(math.floor(corner_quanta / unit_quanta))
    steps = np.rint((quanta + (corner_quanta - offset * unit_quanta)) / (unit_quanta * scale))
    if steps.size and np.abs(steps).max() > _INT32_MAX:
        raise ConfigError(f"{product}.scale_m = {scale_m:g} is too fine for these coordinates", change="make it larger")
    true_m = (quanta.astype(np.float64) + corner_quanta) / QUANTA_PER_M
    error_m = np.abs((steps * scale + offset) * unit_m - true_m)
    return Axis(steps.astype(np.int32), scale, offset, float(error_m.max(initial=0.0)))


def rounding_errors(axes: Axes) -> dict[str, float]:
    """Return the largest rounding error of each coordinate (m), rounded to nanometres."""
    return {name: round(one.error_max_m, 9) for name, one in zip("xyz", axes, strict=True)}


def set_coordinates(record: Any, axes: Axes) -> None:
    """Fill the three coordinates of a point record."""
    for name, one in zip("XYZ", axes, strict=True):
        record[name] = one.stored


def _scale(scale_m: float, unit_m: float) -> float:
    if unit_m == 1.0:
        return scale_m
    exponent = math.floor(math.log10(scale_m / unit_m))
    leading = scale_m / unit_m / 10.0**exponent
    step = max(digit for digit in (1, 2, 5) if digit <= leading or digit == 1)
    return float(f"{step}e{exponent}")


_SCAN_ANGLE_STEP_DEG: Final = 0.006  # Step of the scan angle in LAS 1.4.

_FLAG_BITS: Final = {
    "scan_direction_flag": 1,
    "edge_of_flight_line": 2,
    "synthetic": 4,
    "key_point": 8,
    "withheld": 16,
    "overlap": 32,
}
"""LAS dimension by bit of the column ``flags``."""

_AS_RECORDED: Final = ("return_number", "number_of_returns", "user_data", "red", "green", "blue")
_HANDLED: Final = (*_AS_RECORDED, "flags", "scan_angle_deg")
_RENAMED: Final = {"point_source_id": "recorded_source_id"}


class LasOptions(Strict):
    """Settings of the point files."""

    compress: bool = True
    """Write LAZ; otherwise LAS."""
    scale_m: float = Field(default=1e-4, ge=1e-5, le=0.1)
    """Step of the stored coordinates (m). In a CRS in feet the next finer of 1, 2 or 5 × 10ⁿ feet is taken."""
    spacing_m: float | None = Field(default=None, ge=1e-3)
    """Thin the points out to one in each square of this edge (m), which divides the tile's edge: the point
    at the lower median of the square's heights. What covers less than half of a square's points, such as
    loose aggregate or a crack, is not reported. All points are kept where this is left out."""


class Las(TileProduct):
    """LAS 1.4 with point format 6 (7 where the points have colours), usually compressed to LAZ.

    The CRS is stated as WKT, coordinates are in its unit, time is adjusted standard GPS time, and
    point_source_id is the pass; what a vendor's program recorded otherwise comes back unchanged (its own
    source numbers as the extra dimension ``recorded_source_id``). A variable-length record of the user
    ``roadscan`` holds JSON: survey, tile, thinning, the largest rounding errors, and a digest of the points.

    A point that is kept when the others are thinned out is a recorded one, with its position, time and
    pass; of several at the median height it is the first one recorded.

    With `filters.keep_marked` the points that filters leave out follow the others, withheld, in the classes 7, 18 and
    64 to 71 (see there); thinned-out files do not hold them.
    """

    name: ClassVar[str] = "las"
    title: ClassVar[str] = "points of a tile (LAS 1.4 or LAZ), for CAD and point-cloud programs"
    suffix: ClassVar[str] = ".laz"
    version: ClassVar[int] = 3
    options: ClassVar[type[Strict]] = LasOptions
    default_cells: ClassVar[Cells] = "coarse"
    needs_points: ClassVar[bool] = True

    def suffix_for(self, options: Strict) -> str:
        """``.laz`` or ``.las``."""
        return ".laz" if cast(LasOptions, options).compress else ".las"

    def check_options(self, options: Strict, context: ProductContext) -> None:
        """Raise an error for a spacing that does not divide the tile."""
        spacing_m = cast(LasOptions, options).spacing_m
        if spacing_m is not None:
            _squares_per_edge(spacing_m, context.grid)

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's points."""
        settings = cast(LasOptions, options)
        points = _points_of(tile, settings, context)
        axes = _axes(points, settings.scale_m, context)
        layout = _layout(points, axes, context)
        records = _record(points, axes, layout.header).array
        facts = _facts(points, tile, axes, settings, context)
        write_points(path, layout, [one.offset for one in axes], records, facts, context.date, settings.compress)

    def check(self, path: Path) -> None:
        """Decode every point and compare number, box and digest with what the header states."""
        check_points(path)


def write_las(
    path: Path,
    points: TilePoints,
    options: LasOptions,
    context: ProductContext,
    facts: Mapping[str, Any],
    class_names: Mapping[int, str],
    meanings: Mapping[str, str] | None = None,
) -> None:
    """Write points (one or more) of a tile of the context's grid, as :class:`Las` does.

    Parameters
    ----------
    facts : what the record of the user ``roadscan`` states beside the rounding errors.
    class_names : names of classes that the file holds in its Classification Lookup, up to 15 letters each.
    meanings : what extra dimensions say, by name, up to 31 letters; others are as recorded.
    """
    axes = _axes(points, options.scale_m, context)
    layout = _layout(points, axes, context)
    further = tuple((name, kind, (meanings or {}).get(name, told)) for name, kind, told in layout.further)
    layout = replace(layout, further=further, class_names=tuple(sorted(class_names.items())))
    records = _record(points, axes, layout.header).array
    stated = {
        **facts, "rounding_error_max_m": rounding_errors(axes), "gps_time_step_ns": _gps_time_step_ns(points)
    }  # fmt: skip
    write_points(path, layout, [one.offset for one in axes], records, stated, context.date, options.compress)


def _points_of(tile: Tile, options: LasOptions, context: ProductContext) -> TilePoints:
    """Return the points to write: thinned, or all followed by filtered points, where they are kept."""
    if tile.points is None:
        raise StoreError(f"tile {tile.cells.tile} came without its points", expected="points, which the product needs")
    if options.spacing_m is not None:
        return thin_out(tile.points, options.spacing_m, context.grid)
    return tile.points if tile.marked is None else tile.points.and_then(tile.marked)


def thin_out(points: TilePoints, spacing_m: float, grid: TileGrid) -> TilePoints:
    """Return one point in each square of `spacing_m`: the one at the lower median of the square's heights.

    The squares are counted from the tile's south-west corner. Of several points at the median height the
    first in canonical order is kept; the kept points stay in canonical order.
    """
    per_edge = _squares_per_edge(spacing_m, grid)
    edge = grid.size_quanta // per_edge
    square = (points.y_quanta // edge).astype(np.int64) * per_edge + points.x_quanta // edge
    order = np.lexsort((points.height_quanta, square))  # stable, so equal heights stay in canonical order
    square, height = square[order], points.height_quanta[order]
    new_square = np.diff(square, prepend=-1) != 0
    first_of_height = np.flatnonzero(new_square | (np.diff(height, prepend=0) != 0))
    start = np.flatnonzero(new_square)
    size = np.diff(start, append=square.size)
    median = start + (size - 1) // 2
    first_at_median = first_of_height[np.searchsorted(first_of_height, median, side="right") - 1]
    return _selected(points, np.sort(order[first_at_median]))


def _squares_per_edge(spacing_m: float, grid: TileGrid) -> int:
    squares = round(grid.size_m / spacing_m)
    if squares < 1 or abs(squares * spacing_m - grid.size_m) > 1e-9 or grid.size_quanta % squares:
        raise ConfigError(
            f"las.spacing_m = {spacing_m:g}",
            expected=f"a spacing of whole 10 µm that divides the tile's edge of {grid.size_m:g} m",
            change="choose for example 0.1",
        )
    return squares


def _selected(points: TilePoints, kept: Int64) -> TilePoints:
    return replace(
        points,
        **{
            name: getattr(points, name)[kept]
            for name in (
                "x_quanta",
                "y_quanta",
                "height_quanta",
                "epoch_gps_ns",
                "intensity",
                "classification",
                "pass_id",
            )
        },
        extra={name: values[kept] for name, values in points.extra.items()},
    )


def _axes(points: TilePoints, scale_m: float, context: ProductContext) -> Axes:
    size, frame = context.grid.size_quanta, context.map
    horizontal_m, vertical_m = frame.horizontal_unit_m, frame.vertical_unit_m
    return (
        axis(points.x_quanta, points.tile.column * size, scale_m, horizontal_m, Las.name),
        axis(points.y_quanta, points.tile.row * size, scale_m, horizontal_m, Las.name),
        axis(points.height_quanta, 0, scale_m, vertical_m, Las.name),
    )


def _layout(points: TilePoints, axes: Axes, context: ProductContext) -> Layout:
    further = tuple((_RENAMED.get(c, c), points.extra[c].dtype.str, "as recorded") for c in _further(points))
    kind = 7 if "red" in points.extra else 6
    return Layout(kind, further, tuple(one.scale for one in axes), context.map, Las.name)


def _further(points: TilePoints) -> list[str]:
    """Return recorded columns that LAS has no dimension for."""
    return sorted(name for name in points.extra if name not in _HANDLED)


def _record(points: TilePoints, axes: Axes, header: laspy.LasHeader) -> Any:
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    set_coordinates(record, axes)
    fill_record(record, points)
    for column in _further(points):
        record[_RENAMED.get(column, column)] = points.extra[column]
    return record


def fill_record(record: Any, points: TilePoints) -> None:
    """Fill the dimensions of LAS except coordinates: those that all points have, and those that a vendor recorded."""
    record["intensity"] = points.intensity
    record["classification"] = points.classification
    record["point_source_id"] = points.pass_id
    record["gps_time"] = adjusted_gps_s(points.epoch_gps_ns)
    record.array["bit_fields"] = ONE_OF_ONE
    extra = points.extra
    for name in _AS_RECORDED:
        if name in extra:
            record[name] = extra[name]
    if "scan_angle_deg" in extra:
        steps = np.rint(np.nan_to_num(extra["scan_angle_deg"].astype(np.float64)) / _SCAN_ANGLE_STEP_DEG)
        record["scan_angle"] = np.clip(steps, -30_000, 30_000).astype(np.int16)
    if "flags" in extra:
        for name, bit in _FLAG_BITS.items():
            record[name] = (extra["flags"] & bit) != 0


def adjusted_gps_s(epoch_gps_ns: Int64) -> Float64:
    """Return adjusted standard GPS time (s): the double nearest to GPS seconds minus 1e9 (LAS 1.4 R15, 2.4)."""
    since_ns = epoch_gps_ns - ADJUSTED_OFFSET_S * NS_PER_S
    whole = np.sign(since_ns) * (np.abs(since_ns) // NS_PER_S)  # towards zero, so that the parts have the same sign
    time_s: Float64 = whole + (since_ns - whole * NS_PER_S) / NS_PER_S
    return time_s


def _gps_time_step_ns(points: TilePoints) -> float:
    """Return the spacing of doubles at the last epoch (ns): twice the largest rounding error of time."""
    last = adjusted_gps_s(points.epoch_gps_ns.max(keepdims=True))
    return round(float(np.spacing(np.abs(last))[0]) * NS_PER_S, 3)


def _facts(points: TilePoints, tile: Tile, axes: Axes, options: LasOptions, context: ProductContext) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "survey": context.survey_id,
        "tile": str(points.tile),
        "height": context.map.height,
        "points_of_tile": int(tile.cells.count.sum()),
        "spacing_m": options.spacing_m,
        "rounding_error_max_m": rounding_errors(axes),
        "gps_time_step_ns": _gps_time_step_ns(points),
    }
    if tile.marked is not None and options.spacing_m is None:
        facts["marked_points"] = len(tile.marked)
    return facts


SCALE_M: Final = 1e-4
"""Step of the stored coordinates (m)."""
PRODUCT: Final = "publish"

_PLAIN, _COLOURED = 6, 7  # LAS point formats without and with colours.


class Lattice(NamedTuple):
    """Parameters that all records of a cloud share."""

    map: MapFrame
    grid: TileGrid
    offsets: tuple[float, float, float]
    """Origin of the stored coordinates, in whole units of the CRS."""


def layout_of(frame: MapFrame, *, coloured: bool) -> Layout:
    """Return the layout of the records: point format 6, or 7 with colours; no further dimensions."""
    empty = np.zeros(0, np.int32)
    units = (frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m)
    scales = tuple(axis(empty, 0, SCALE_M, unit_m, PRODUCT).scale for unit_m in units)
    return Layout(_COLOURED if coloured else _PLAIN, (), scales, frame, PRODUCT)


def records_of(points: TilePoints, lattice: Lattice) -> npt.NDArray[np.void]:
    """Return (n,) records of format 7 of a tile's points; without colours these are black."""
    import laspy

    size, frame = lattice.grid.size_quanta, lattice.map
    units = (frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m)
    corners = (points.tile.column * size, points.tile.row * size, 0)
    quanta = (points.x_quanta, points.y_quanta, points.height_quanta)
    axes = [axis(q, c, SCALE_M, u, PRODUCT) for q, c, u in zip(quanta, corners, units, strict=True)]
    record: Any = laspy.ScaleAwarePointRecord.zeros(len(points), header=layout_of(frame, coloured=True).header)
    set_coordinates(record, (axes[0], axes[1], axes[2]))
    for name, one, offset in zip("XYZ", axes, lattice.offsets, strict=True):
        record[name] += np.int32(round((one.offset - offset) / one.scale))
    fill_record(record, points)
    held: npt.NDArray[np.void] = record.array
    return held


def picked(records: npt.NDArray[np.void], numbers: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.void]:
    """Return some records (n,) by number; as rows of bytes they are copied six times as fast as field by field."""
    rows = np.ascontiguousarray(records).view(np.uint8).reshape(records.size, -1)
    return np.take(rows, numbers, axis=0).view(records.dtype).ravel()


def without_colours(records: npt.NDArray[np.void], plain: np.dtype[np.void]) -> npt.NDArray[np.void]:
    """Return records of format 7 as format 6, which has the same first fields."""
    kept = np.ascontiguousarray(records).view(np.uint8).reshape(records.size, -1)[:, : plain.itemsize]
    return np.ascontiguousarray(kept).view(plain).ravel()
