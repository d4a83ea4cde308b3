"""Medians: raised strips between two edges whose higher sides face each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets.edges.beside import BESIDE_PIECES, pieces_beside
from roadscan.assets.edges.line_pieces import Strip, joined_lines, polygon_of, sigma_width_m, strips_of
from roadscan.assets.edges.profiles import REACH_M
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.core.strict import Strict

SAME_SHARE = 0.3
"""Two polygons that share this much of the smaller one are one median, found from both of its edges."""


class MedianOptions(Strict):
    """Settings of medians."""

    least_width_m: float = Field(default=0.3, gt=0.0)
    """Narrower strips are left out (m)."""
    least_length_m: float = Field(default=3.0, gt=0.0)
    """Shorter ones are left out (m)."""
    least_probability: float = Field(default=0.5, ge=0.0, le=1.0)
    """Those behind a line whose evidence says less of a kerb are left out."""


class Median(AssetKind):
    """Medians: polygons between two kerbs, at most 7 m wide."""

    name: ClassVar[str] = "median"
    title: ClassVar[str] = "medians: raised strips between two kerbs"
    curve: ClassVar[str] = "products"
    options: ClassVar[type[Strict]] = MedianOptions
    reach_m: ClassVar[float] = REACH_M
    piece_schema: ClassVar[pa.Schema] = BESIDE_PIECES

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns the scene's edges within its tile, and at each node the surface behind it."""
        return Evidence(pieces_beside(scene))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields runs of a joined line with a surface behind it that ends at an edge down, each median once."""
        settings: MedianOptions = options
        found: list[shapely.Polygon] = []
        for line in joined_lines(pieces):
            probability = line.probability
            if probability < settings.least_probability:
                continue
            usable = line.column("ends_down") > 0.5
            for strip in strips_of(line, usable, settings.least_width_m, settings.least_length_m):
                polygon = polygon_of(strip)
                if polygon is None or any(_same(polygon, other) for other in found):
                    continue
                found.append(polygon)
                yield _median(strip, polygon, probability)


def _same(a: shapely.Polygon, b: shapely.Polygon) -> bool:
    """Returns whether two polygons overlap so far that they are one median."""
    if not a.intersects(b):
        return False
    return float(a.intersection(b).area) > SAME_SHARE * min(float(a.area), float(b.area))


def _length_m(polygon: shapely.Polygon, width_m: float) -> float:
    """Returns the length of a polygon of this width, also of a bent one and of one whose kerb goes round it.

    Rounded ends take area off: so it is as long as its outline at least.
    """
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))
    return max(float(polygon.area) / width_m, float(np.hypot(*np.diff(corners, axis=0).T).max()))


def _median(strip: Strip, polygon: shapely.Polygon, probability: float) -> AssetObject:
    seen_by = strip.line.seen_by
    attributes = {
        "width_m": float(np.mean(strip.width_m)),
        "asset_height_m": strip.mean(strip.column("step_m")),
        "length_m": _length_m(polygon, float(np.mean(strip.width_m))),
    }
    return AssetObject(
        geometry=polygon,
        sigma_horizontal_m=sigma_width_m(strip),
        sigma_height_m=0.01,
        probability=probability,
        returns=seen_by.returns,
        passes=len(seen_by.passes),
        first_epoch_gps_ns=seen_by.first_epoch_gps_ns,
        last_epoch_gps_ns=seen_by.last_epoch_gps_ns,
        attributes={name: value for name, value in attributes.items() if value is not None},
        sigma_size_m=sigma_width_m(strip),
    )
