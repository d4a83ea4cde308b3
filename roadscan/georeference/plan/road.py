"""Road of a plan: the centre lines that limit points to it, and the sensors whose profiles are segmented.

The layer of centre lines is read once a process and widened line by line.
The extent kept beside a centre line is half the road's width and a margin "in order to accommodate the roadside
landscape, pavement and other features of interest" (Sairam, Nagarajan, Ornitz 2016, 3.3.1).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64
from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.rig import Mounting
from roadscan.core.settings.segmentation import RoadSegmentation
from roadscan.core.survey import Survey
from roadscan.formats.vectors.road_lines import (
    LineLayer,
    Lines,
    Place,
    RoadLines,
    RoadLinesOptions,
    place_in_map,
    read_lines,
    sidecars,
)
from roadscan.georeference.sources import CentreLines, ReadingSource
from roadscan.ingest.reading.format import Reject
from roadscan.store.digest import file_digest

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class CentreLineBuffer:
    """The area within a distance of centre lines."""

    lines: npt.NDArray[np.object_]
    """(n,) Shapely lines, easting and northing (m)."""
    half_widths_m: Float64
    """(n,) distance from each line that is kept."""

    def keeps(self, easting_m: Float64, northing_m: Float64, box_m: Box) -> Bool:
        """Return which points (n,) of one tile lie in the area; `box_m` is the tile's west, south, east, north edge.

        The rounding of ends and corners departs from a circle by less than 0.13 % of the half width (16 chords a
        quarter). Only lines near the tile are widened, so the cost does not grow with the layer.
        """
        tile = shapely.box(*box_m)
        near = np.sort(self._tree.query(tile))
        if not near.size:
            return np.zeros(easting_m.size, dtype=bool)
        area = shapely.union_all(shapely.buffer(self.lines[near], self.half_widths_m[near], quad_segs=16))
        if area.contains(tile):
            return np.ones(easting_m.size, dtype=bool)
        part = area.intersection(tile)
        shapely.prepare(part)
        inside: Bool = shapely.intersects_xy(part, easting_m, northing_m)
        return inside

    @cached_property
    def _tree(self) -> shapely.STRtree:
        """Spatial index of the boxes of the widened lines."""
        bounds = shapely.bounds(self.lines) + self.half_widths_m[:, None] * np.array([-1.0, -1.0, 1.0, 1.0])
        return shapely.STRtree(shapely.box(*bounds.T))


BUFFER: Final = "buffer"
CLASS: Final = "class"


def centre_lines_of(survey: Survey) -> CentreLines | None:
    """Return what the survey file states; None where points are not limited to centre lines."""
    stated = survey.config.filters
    if stated.centre_line is None:
        return None
    path = survey.resolve(stated.centre_line)
    if not path.is_file():
        raise ConfigError("the centre-line layer does not exist", change="check filters.centre_line", file=path)
    options = dict(stated.centre_line_options)
    if stated.centre_line_width not in {BUFFER, CLASS}:
        options["width_column"] = stated.centre_line_width
    return CentreLines(
        path=path,
        digests=tuple(file_digest(file) for file in (path, *sidecars(path))),
        crs=stated.centre_line_crs,
        width=stated.centre_line_width,
        buffer_m=stated.centre_line_buffer_m,
        margin_m=stated.centre_line_margin_m,
        options=RoadLinesOptions.parse(options, file=path).model_dump_json(),
    )


def centre_lines_key(lines: CentreLines | None) -> list[object] | None:
    """Return the key of all that changes tiles, None without a layer; the place of the file changes none."""
    if lines is None:
        return None
    return [RoadLines.version, lines.digests, lines.crs, lines.width, lines.buffer_m, lines.margin_m, lines.options]


@functools.lru_cache(maxsize=2)
def load_buffer(stated: CentreLines, frame: MapFrame) -> CentreLineBuffer:
    """Read the lines and determine the distance kept beside each.

    Raises
    ------
    FormatError, ConfigError, CrsError
        if the layer cannot be read as stated, if it has no line, or if a feature cannot be used: points along it would
        be removed silently.
    """
    options = RoadLinesOptions.model_validate_json(stated.options)
    layer = LineLayer.of(stated.path, options, stated.crs)
    if stated.width == CLASS and not layer.says_widths:
        raise ConfigError(
            "the layer of centre lines has no attribute with the road's class, lanes or width",
            expected='such as MTFCC, for filters.centre_line_width = "class"',
            change='name it in filters.centre_line_options, or keep "buffer"',
            file=stated.path,
        )
    parts = _all_lines(layer, place_in_map(layer.crs, frame, stated.path), stated)
    if not parts:
        raise ConfigError("the layer has no centre lines", expected="at least one line", file=stated.path)
    return CentreLineBuffer(
        np.concatenate([part.shapes for part in parts]), np.concatenate([_half_widths_m(p, stated) for p in parts])
    )


def _all_lines(layer: LineLayer, place: Place, stated: CentreLines) -> list[Lines]:
    """Return every line of the layer; unused attributes are not read, so an invalid one causes no error."""
    needed: set[str] = set() if stated.width == BUFFER else {"class", "lanes", "width"}
    plain = replace(layer, columns={what: name if what in needed else None for what, name in layer.columns.items()})
    parts: list[Lines] = []
    for item in read_lines(plain, place, need_widths=False):
        if isinstance(item, Reject):
            raise ConfigError(
                f"feature {item.record} of the centre lines (counted from 0) cannot be used: {item.reason}",
                expected="a line that lies in the map; without it, the road along it would be cut away",
                change="mend the feature, or take it out of the layer",
                file=stated.path,
            )
        parts.append(item)
    return parts


def _half_widths_m(lines: Lines, stated: CentreLines) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the distance (n,) kept beside each line (m)."""
    if stated.width == BUFFER:
        return np.full(lines.width_m.size, stated.buffer_m)
    own = lines.width_m / 2 + stated.margin_m
    return np.where(np.isnan(own), stated.buffer_m, own)


_LEAST_COSINE: Final = 0.5
"""Least cosine of the angles between a profile's normal and the driving direction, and between z and straight down."""


def road_of(settings: RoadSegmentation | None, sensor: str, table: str, mounting: Mounting) -> RoadSegmentation | None:
    """Return the segmentation settings for a sensor's readings of a table; None where they are not segmented.

    Raises
    ------
    ConfigError
        where the survey file names a sensor that has no profiles.
    """
    if settings is None:
        return None
    if settings.sensors is None:
        return settings if table == "scans" and looks_across(mounting) else None
    if sensor not in settings.sensors:
        return None
    if table != "scans":
        raise ConfigError(
            f"segmentation.sensors names '{sensor}', whose readings are {table}",
            expected="a sensor with profiles, rows of the table scans",
            change="take it out of the list",
        )
    return settings


def looks_across(mounting: Mounting) -> bool:
    """Return whether a sensor's profiles lie across the road and its z points down to it, each to less than 60°."""
    forward, _, down = mounting.body_from_sensor
    return abs(forward[0]) > _LEAST_COSINE and down[2] > _LEAST_COSINE


def check_road(settings: RoadSegmentation | None, sources: Sequence[ReadingSource]) -> None:
    """Raise ConfigError where the survey file requests segmentation and there is nothing to segment."""
    scans = any(source.table == "scans" for source in sources)  # none where the log of the only profiler is damaged
    if settings is None or not scans or any(source.road is not None for source in sources):
        return
    known = sorted({f"{source.sensor} ({source.table})" for source in sources})
    raise ConfigError(
        "[segmentation] finds no sensor whose profiles lie across the road: there is " + ", ".join(known),
        expected="scans of a sensor that looks down, its x along the driving direction",
        change="name sensors of scans in segmentation.sensors, or take the section out",
    )
