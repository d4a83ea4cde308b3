"""What is seen around the nodes of edges: the features of a judge of kerbs, which depend on no scanner and no site.

Heights of steps, their scatter, bends, ranges, densities and distances from the drive tell streets and scanners apart,
not kerbs; without them it judges unseen ones better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.spatial

from roadscan.assets.edges.find import Edge
from roadscan.assets.edges.profiles import NODE_M
from roadscan.assets.edges.raster import HeightRaster, raster_of
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64

_AROUND_NODES: Final = 7
"""Features are medians over this many nodes (3 m): an edge is what it is over a length, not at a point."""
_BESIDE_M: Final = 0.7  # Returns this near to a node (m) tell of its sides …
_FACE_M: Final = 0.08  # … unless they are nearer to the edge than this (m): those are on its face.
_STANDING_M: Final = (0.3, 2.0)
"""Heights above the ground (m) at which fences, walls and hedges are seen."""
_PLANTS_M: Final = (0.05, 0.3)  # Heights above the ground (m) of grass and of the lower parts of plants.
_LONG_M: Final = 12.0  # Longer edges (m) are alike: windows cut them anywhere.
_MOST_EVIDENCE: Final = 4.0  # Greatest evidence (σ) a metre that is told.
_MOST_RATIO: Final = 30.0  # Greatest significance that is told: more says no more.
_LEAST_SIGMA_M: Final = 0.004  # Error (m) of a step that the lines of its sides do not show.


def node_features(scene: Scene, edges: Sequence[Edge]) -> dict[str, Float64]:
    """Returns features (n,) by name of all nodes of some edges, one edge after the other; NaN where one is not known.

    The measured ones are medians over 3 m of an edge.
    """
    nodes = [edge.nodes for edge in edges]
    names = ("x_m", "y_m", "heading_x", "heading_y", "step_m", "sigma_step_m", "seen_low", "covered")
    x, y, ux, uy, step, sigma, seen_low, covered = (np.concatenate([getattr(n, k) for n in nodes]) for k in names)
    place = np.column_stack([x, y, ux, uy])
    measured = {
        "seen_low": seen_low, "covered": covered,
        "significance": np.minimum(step / np.hypot(sigma, _LEAST_SIGMA_M), _MOST_RATIO),
        "outward": _outward(scene, place), **_of_returns(scene, place),
    }  # fmt: skip
    ends = np.cumsum([len(n.x_m) for n in nodes])
    rows = [slice(end - len(n.x_m), end) for end, n in zip(ends, nodes, strict=True)]
    out = {name: np.concatenate([_running(column[k]) for k in rows]) for name, column in measured.items()}
    length_m, seen_m = (NODE_M * np.array([f(e.seen) for e in edges], np.float64) for f in (len, np.count_nonzero))
    evidence = np.array([e.evidence for e in edges]) / np.maximum(seen_m, NODE_M)
    of_edges = {"length_m": np.minimum(length_m, _LONG_M), "evidence": np.minimum(evidence, _MOST_EVIDENCE)}
    return out | {name: np.repeat(values, [len(n.x_m) for n in nodes]) for name, values in of_edges.items()}


def _running(values: Float64) -> Float64:
    """Returns the median (n,) of the known among the values around each; NaN where none is known."""
    half = _AROUND_NODES // 2
    held = np.lib.stride_tricks.sliding_window_view(np.pad(values, half, constant_values=np.nan), _AROUND_NODES)
    ordered, known = np.sort(held, axis=1), np.isfinite(held).sum(axis=1)  # NaN come last
    row = np.arange(len(values))
    low, high = (ordered[row, np.maximum(at, 0)] for at in ((known - 1) // 2, known - 1 - (known - 1) // 2))
    return np.where(known > 0, 0.5 * (low + high), np.nan)


def _of_returns(scene: Scene, place: Float64) -> dict[str, Float64]:
    """Shares of the returns on each side of the edges that stand above the ground and that show plants; how beams cross
    the edges: 0 at a right angle, as they meet the ring that a laser draws on the ground.
    """
    raster, returns, count = raster_of(scene), scene.returns, len(place)
    rows = np.flatnonzero(_near(place, raster)[np.maximum(raster.cell, 0)] & (raster.cell >= 0))
    away, owner = scipy.spatial.cKDTree(place[:, :2]).query(
        np.column_stack([returns.x_m[rows], returns.y_m[rows]]), distance_upper_bound=_BESIDE_M
    )
    rows, owner = rows[np.isfinite(away)], owner[np.isfinite(away)].astype(np.int64)
    x, y, ux, uy = place[owner].T
    across = (returns.x_m[rows] - x) * uy - (returns.y_m[rows] - y) * ux
    above = scene.above_ground_m[rows]

    def share(of: tuple[float, float], among: npt.NDArray[np.bool_]) -> Float64:
        number, held = (
            np.bincount(owner[k], minlength=count) for k in (among, among & (above > of[0]) & (above < of[1]))
        )
        return np.where(number > 0, held / np.maximum(number, 1), np.nan)

    sides = {"high": across > _FACE_M, "low": across < -_FACE_M}
    dx, dy = returns.x_m[rows] - returns.sensor_x_m[rows], returns.y_m[rows] - returns.sensor_y_m[rows]
    on_ground = raster.used[rows] & (sides["high"] | sides["low"])
    crossing = np.abs(dx * ux + dy * uy) / np.maximum(np.hypot(dx, dy), 1e-9)
    number = np.bincount(owner[on_ground], minlength=count)
    total = np.bincount(owner[on_ground], crossing[on_ground], minlength=count)
    return {
        **{f"{name}_{side}": share(of, own) for name, of in (("stands", _STANDING_M), ("grows", _PLANTS_M))
           for side, own in sides.items()},
        "crossing": np.where(number > 0, total / np.maximum(number, 1), np.nan),
    }  # fmt: skip


def _near(place: Float64, raster: HeightRaster) -> npt.NDArray[np.bool_]:
    """Returns a mask of flat cells that come near to nodes."""
    mark = np.zeros(raster.count.shape, np.bool_)
    mark[raster.cells_of(place[:, 0], place[:, 1])] = True
    away = scipy.ndimage.distance_transform_edt(~mark) * raster.cell_m
    return np.asarray(away.ravel() <= _BESIDE_M + raster.cell_m)


def _outward(scene: Scene, place: Float64) -> Float64:
    """Returns the sine (n,) by which the higher side lies away from the nearest place of the drive."""
    drive = scene.drive_xyh_m
    if not len(drive):
        return np.full(len(place), np.nan)
    away, at = scipy.spatial.cKDTree(drive[:, :2]).query(place[:, :2])
    x, y, ux, uy = place.T
    return np.asarray(((x - drive[at, 0]) * uy - (y - drive[at, 1]) * ux) / np.maximum(away, 1e-9))
