"""Checks whether passes over one place agree on its height, from points, also where no pose can be adjusted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from roadscan.compute.robust import scatter_about
from roadscan.core.grid import QUANTUM_M, LanePass, TileGrid
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.cloud import TilePoints

PASSES_APART: Final = Witness(
    "passes_apart",
    input="passes",
    fault="Two passes of one road lie at different heights: another vertical datum, geoid or antenna height, or poses "
    "that drifted.",
    asks="mean heights of cells that both saw, where tiles are made of points (clouds, and products of points)",
    does="cells hold the mean of both; passes that differ by more than 20 mm and five times the scatter of the "
    "differences are named with the difference and its σ",
    told=("findings",),
)

FIGURE: Final = "passes_apart"
"""Name of the figure in a tile's record."""
_MOST_PASSES: Final = 6
"""Most passes of a tile that are compared, those with the most points."""
_LEAST_CELLS: Final = 20  # Least number of cells that both passes saw.
_LEAST_M: Final = 0.02
"""Least reported difference: passes of a good mapping system in one datum agree better."""
_SCATTERS: Final = 5.0  # A reported difference exceeds the scatter this many times.
_MOST_TOLD: Final = 8  # Most differences that are reported.


def apart_in_tile(points: TilePoints, grid: TileGrid, passes: Sequence[LanePass]) -> list[list[Any]]:
    """Return for each two passes of a tile: both in words, number of common cells, median difference of their mean
    heights (m) and its scatter (m, 1 σ of a cell).
    """
    ids, counts = np.unique(points.pass_id, return_counts=True)
    if ids.size < 2:
        return []
    ids = np.sort(ids[np.argsort(-counts, kind="stable")[:_MOST_PASSES]])
    across = int(points.x_quanta.max()) // grid.cell_quanta + 1
    cell = points.y_quanta.astype(np.int64) // grid.cell_quanta * across + points.x_quanta // grid.cell_quanta
    size = int(cell.max()) + 1
    datum = int(points.height_quanta[0])
    means = np.full((ids.size, size), np.nan)
    for k, one in enumerate(ids.tolist()):
        own = points.pass_id == one
        count = np.bincount(cell[own], minlength=size)
        total = np.bincount(cell[own], (points.height_quanta[own] - datum).astype(np.float64), minlength=size)
        means[k, count > 0] = total[count > 0] / count[count > 0] * QUANTUM_M
    words = {int(p.pass_id): f"run '{p.run}' (pass {p.pass_id})" for p in passes}
    found: list[list[Any]] = []
    for a, b in zip(*np.triu_indices(ids.size, 1), strict=True):
        off = means[b] - means[a]
        off = off[np.isfinite(off)]
        if off.size >= _LEAST_CELLS:
            middle = float(np.median(off))
            scatter = scatter_about(off, middle)
            names = [words.get(int(ids[k]), f"pass {ids[k]}") for k in (a, b)]
            found.append([*names, int(off.size), round(middle, 6), round(scatter, 6)])
    return found


def apart_findings(told: Iterable[tuple[str, str, int, float, float]]) -> list[Finding]:
    """Return passes that differ by far more than their noise, from the figures of all tiles; the largest first."""
    pairs: dict[tuple[str, str], list[tuple[int, float, float]]] = defaultdict(list)
    for one, other, count, away_m, spread_m in told:
        pairs[one, other].append((count, away_m, spread_m))
    found: list[tuple[float, Finding]] = []
    for (one, other), figures in pairs.items():
        cells, off_m, scatter_m = np.array(figures).T
        wrong = np.abs(off_m) > np.maximum(_LEAST_M, _SCATTERS * scatter_m)
        if 2 * cells[wrong].sum() <= cells.sum():
            continue
        weights = cells[wrong] / cells[wrong].sum()
        mean_m = float(weights @ off_m[wrong])
        within_m2 = float(weights**2 @ (scatter_m[wrong] ** 2 / cells[wrong]))
        between_m2 = float(weights @ (off_m[wrong] - mean_m) ** 2) / max(1, int(wrong.sum()) - 1)
        sigma_mm = 1e3 * float(np.sqrt(within_m2 + between_m2))
        text = (
            f"its heights are {1e3 * mean_m:+,.1f} mm (σ {sigma_mm:.1f} mm) off those of {one} in "
            f"{int(cells[wrong].sum()):,} cells that both saw, in which the differences scatter by "
            f"{1e3 * float(weights @ scatter_m[wrong]):.1f} mm; all are used, and cells hold the mean of both"
        )
        found.append((abs(mean_m), PASSES_APART.finds(other, text)))
    found.sort(key=lambda one: -one[0])
    return [finding for _, finding in found[:_MOST_TOLD]]
