"""Kerbs: steps beside the road, traced along it, with their height and type."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import scipy.ndimage
import scipy.spatial
import shapely
from pydantic import Field

from roadscan.assets import classes
from roadscan.assets.edges.find import free_edges
from roadscan.assets.edges.line_pieces import LINE_PIECES, Line, columns_of, cut_at, dense, joined_lines, pieces_table
from roadscan.assets.edges.profiles import REACH_M
from roadscan.assets.edges.steps import HeightRaster, raster_of
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import scatter_about, way_along
from roadscan.core.extras import cv2
from roadscan.core.strict import Strict

SLOPED_FACE_M = 0.12
"""A kerb with a wider face (m) is sloped."""
_FACE_NODES, _LEAST_NODES = 31, 4  # Nodes of the median of faces; least nodes of a run of one type.
_ALIKE_M = 3.0
"""Steps this far apart (m) differ independently: the length of two kerbstones and their settlement."""
_COMMON_M = 0.004
"""1 σ (m) of a step that its sides do not show: unevenness as long as its window."""
FACE_REACH_M = 0.15
"""Returns this near to the line (m), between the foot and the top of the step, belong to the kerb."""


class KerbOptions(Strict):
    """Settings of kerbs."""

    least_probability: float = Field(default=0.5, ge=0.0, le=1.0)
    """Less probable lines are left out; parts of an edge that are rather none than a kerb are cut off in any case."""
    least_length_m: float = Field(default=2.0, ge=0.5)
    """Shorter lines are left out (m)."""
    dropped_m: float = Field(default=0.05, gt=0.0, le=0.2)
    """Where the step is lower than this, and less than half of its line's, the kerb is dropped (m)."""


class Kerb(AssetKind):
    """Kerbs: the line in the middle of the face, at the height of its upper edge; the higher side lies to its right."""

    name: ClassVar[str] = "kerb"
    title: ClassVar[str] = "kerbs: steps beside the road"
    curve: ClassVar[str] = "products"
    options: ClassVar[type[Strict]] = KerbOptions
    piece_schema: ClassVar[pa.Schema] = LINE_PIECES
    reach_m: ClassVar[float] = REACH_M

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns parts of the scene's steps within its tile."""
        raster = raster_of(scene)
        parts = [part for edge in free_edges(scene) for part in cut_at(columns_of(edge), scene.tile)]
        return Evidence(pieces_table(parts, scene, raster), _marked([p.nodes for p in parts], scene, raster))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields lines joined across tiles, a kerb for each run of one type."""
        settings: KerbOptions = options
        for line in joined_lines(pieces):
            if line.length_m < settings.least_length_m or line.probability < settings.least_probability:
                continue
            types = types_along(line, settings.dropped_m)
            begin = 0
            for name, run in itertools.groupby(types):
                end = begin + sum(1 for _ in run)
                # Runs share the node between them, so that the kerb has no gap.
                yield _kerb(line, slice(begin, min(end + 1, len(types))), str(name))
                begin = end


def types_along(line: Line, dropped_m: float) -> list[str]:
    """Returns the type (n,) of a kerb at each node: a run shorter than 1.5 m takes that of the nodes before it."""
    step, face = line.column("step_m"), line.column("face_m")
    known = np.isfinite(step) & (line.column("seen") > 0.5)
    if not known.any():
        return ["upright"] * len(step)
    at = np.flatnonzero(known)
    index = np.arange(len(step))
    height = np.interp(index, at, scipy.ndimage.median_filter(step[at], 3, mode="nearest"))
    width = np.interp(index, at, scipy.ndimage.median_filter(face[at], _FACE_NODES, mode="nearest"))
    usual = float(np.percentile(step[at], 75))
    dropped = (height < dropped_m) & (height < 0.5 * usual)
    found = np.where(dropped, "dropped", np.where(width > SLOPED_FACE_M, "sloped", "upright")).tolist()
    runs = [(str(name), len(list(run))) for name, run in itertools.groupby(found)]
    usable = [name for name, length in runs if length >= _LEAST_NODES]
    types: list[str] = []
    last = usable[0] if usable else max(runs, key=lambda run: run[1])[0]
    for name, length in runs:
        last = name if length >= _LEAST_NODES else last
        types += [last] * length
    return types


def _kerb(line: Line, rows: slice, name: str) -> AssetObject:
    """Returns a kerb of one type; returns and epochs are the share and the span of its line's."""
    nodes = Line(line.nodes[rows], line.seen_by, line.names)
    step, sigma = nodes.column("step_m"), nodes.column("sigma_step_m")
    known = np.isfinite(step)
    share = len(nodes.nodes) / len(line.nodes)
    attributes: dict[str, Any] = {"type": name, "length_m": nodes.length_m}
    if known.any():
        attributes["step_m"] = float(np.median(step[known]))
    sigma_height = _sigma_step_m(step[known], sigma[known], nodes.length_m) if known.any() else 0.05
    return AssetObject(
        geometry=shapely.LineString(nodes.nodes[:, :3]),
        sigma_horizontal_m=float(np.median(nodes.column("sigma_m"))),
        sigma_height_m=sigma_height,
        probability=nodes.probability,
        returns=round(line.seen_by.returns * share),
        passes=len(line.seen_by.passes),
        first_epoch_gps_ns=line.seen_by.first_epoch_gps_ns,
        last_epoch_gps_ns=line.seen_by.last_epoch_gps_ns,
        attributes=attributes,
        sigma_size_m=sigma_height if known.any() else None,
    )


def _sigma_step_m(step_m: Float64, sigma_m: Float64, length_m: float) -> float:
    """Returns 1 σ (m) of the median step of a kerb: that of its nodes, whose errors are common to neighbours, and what
    the steps differ along it: another survey sees other parts of it.
    """
    differs = 1.25 * scatter_about(step_m, float(np.median(step_m))) / math.sqrt(max(length_m / _ALIKE_M, 1.0))
    return math.hypot(float(np.nanmedian(sigma_m)), _COMMON_M, differs)


def _marked(parts: Sequence[Float64], scene: Scene, raster: HeightRaster) -> tuple[Marked, ...]:
    """Returns the numbers of the returns on the faces of kerbs."""
    if not parts:
        return ()
    places, levels = [], []
    for nodes in parts:
        x, y = dense(nodes[:, :2], 0.05)
        length = way_along(nodes)
        at = np.linspace(0.0, length[-1], len(x))
        step = np.where(np.isfinite(nodes[:, 3]), nodes[:, 3], 0.0)
        places.append(np.column_stack([x, y]))
        levels.append(np.column_stack([np.interp(at, length, nodes[:, 2]), np.interp(at, length, step)]))
    returns, level = scene.returns, np.concatenate(levels)
    near = _cells_near(np.concatenate(places), raster)
    rows = np.flatnonzero(raster.used & near[raster.cell])
    rows = rows[scene.tile.holds(returns.x_m[rows], returns.y_m[rows])]
    tree = scipy.spatial.cKDTree(np.concatenate(places))
    distance, at = tree.query(
        np.column_stack([returns.x_m[rows], returns.y_m[rows]]), distance_upper_bound=FACE_REACH_M
    )
    reached = np.isfinite(distance)
    rows, at = rows[reached], at[reached]
    above = returns.height_m[rows] - level[at, 0] + level[at, 1]
    on_face = (above > 0.01) & (above < level[at, 1] + 0.03)
    return (Marked(rows[on_face], classes.KERB),)


def _cells_near(places: Float64, raster: HeightRaster) -> Bool:
    """Returns a mask of flat cells (rows · columns + 1,) with all returns within reach of some places (k, 2)."""
    reach = math.ceil(FACE_REACH_M / raster.cell_m)
    near = np.zeros(raster.count.shape, np.uint8)
    near[raster.cells_of(places[:, 0], places[:, 1])] = 1
    around = cv2.dilate(near, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return np.append(around.ravel() > 0, False)
