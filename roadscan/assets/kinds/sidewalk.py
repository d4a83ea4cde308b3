"""Sidewalks: smooth surfaces behind a kerb, up to a façade, a fence, plants, or another edge."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import scipy.ndimage
from pydantic import Field

from roadscan.assets.edges.beside import BESIDE_PIECES, pieces_beside
from roadscan.assets.edges.line_pieces import (
    MEDIAN_NODES,
    Strip,
    bridged,
    joined_lines,
    polygon_of,
    running_slope,
    sigma_width_m,
    strips_of,
)
from roadscan.assets.edges.profiles import REACH_M
from roadscan.assets.green.edges import ended_at_green
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.kinds.kerb import types_along
from roadscan.assets.scene import Scene
from roadscan.core.strict import Strict


class SidewalkOptions(Strict):
    """Settings of sidewalks."""

    least_width_m: float = Field(default=0.8, gt=0.0)
    """Narrower surfaces are no sidewalk (m)."""
    least_length_m: float = Field(default=3.0, gt=0.0)
    """Shorter ones are left out (m)."""
    least_probability: float = Field(default=0.5, ge=0.0, le=1.0)
    """Those behind a line whose evidence says less of a kerb are left out."""
    dropped_m: float = Field(default=0.05, gt=0.0, le=0.2)
    """A kerb lower than this, and less than half of its line's, is a ramp (m)."""


class Sidewalk(AssetKind):
    """Sidewalks: polygons from the kerb to the end of the surface behind it."""

    name: ClassVar[str] = "sidewalk"
    title: ClassVar[str] = "sidewalks: walkways behind a kerb"
    curve: ClassVar[str] = "products"
    options: ClassVar[type[Strict]] = SidewalkOptions
    piece_schema: ClassVar[pa.Schema] = BESIDE_PIECES
    reach_m: ClassVar[float] = REACH_M

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns the scene's edges within its tile, and at each node the surface behind it."""
        return Evidence(pieces_beside(scene))

    sees_green: ClassVar[bool] = True

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns pieces whose surfaces end where pictures show green ground."""
        return ended_at_green(pieces, shown)

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields runs of a joined line with a surface behind it that does not end at an edge down."""
        settings: SidewalkOptions = options
        for line in joined_lines(pieces):
            probability = line.probability
            if probability < settings.least_probability:
                continue
            ends_down = line.column("ends_down") >= 0.5
            # The ends of an island are longer than a surface is followed; both sides tell that it is a median.
            median = bridged(line, scipy.ndimage.median_filter(ends_down, MEDIAN_NODES, mode="nearest"))
            for strip in strips_of(line, ~ends_down, settings.least_width_m, settings.least_length_m, median):
                found = _sidewalk(strip, probability, settings)
                if found is not None:
                    yield found


def _sidewalk(strip: Strip, probability: float, settings: SidewalkOptions) -> AssetObject | None:
    polygon = polygon_of(strip)
    if polygon is None:
        return None
    seen_by, share = strip.line.seen_by, float(strip.known.mean())
    attributes = {
        "width_m": float(np.mean(strip.width_m)),
        "kerb_height_m": strip.mean(strip.column("step_m")),
        "length_m": strip.length_m,
        "ramp": "dropped" in types_along(strip.line, settings.dropped_m),
        "cross_slope": strip.mean(strip.column("slope")),
        "running_slope": running_slope(strip),
    }
    return AssetObject(
        geometry=polygon,
        sigma_horizontal_m=sigma_width_m(strip),
        sigma_height_m=0.01,
        probability=probability * (0.5 + 0.5 * share),
        returns=seen_by.returns,
        passes=len(seen_by.passes),
        first_epoch_gps_ns=seen_by.first_epoch_gps_ns,
        last_epoch_gps_ns=seen_by.last_epoch_gps_ns,
        attributes={name: value for name, value in attributes.items() if value is not None},
        sigma_size_m=sigma_width_m(strip),
    )
