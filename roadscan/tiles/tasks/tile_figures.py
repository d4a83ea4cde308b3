"""Figures in the records of all tiles, read once for all that ask, and whether passes agree on a place's height."""

from __future__ import annotations

import hashlib
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.core.grid import TileId
from roadscan.core.witness import Finding, Witness
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.georeference.reading_counts import LogCounts
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.records import figures_in
from roadscan.tiles.product import TileSummary
from roadscan.tiles.tasks.tile_plan import APART_FIGURE, TILE

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

_LEAST_M: Final = 0.02
"""Least reported difference: passes of a good mapping system in one datum agree better."""
_SCATTERS: Final = 5.0  # A reported difference exceeds the scatter this many times.
_MOST_TOLD: Final = 8  # Most differences that are reported.


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


_OF_SUMMARY = tuple(TileSummary.__dataclass_fields__)[1:]  # All but the first, the tile.


class Summaries(Mapping[TileId, TileSummary]):
    """Figures of tiles, made of their records when they are asked for: as objects they take 80 MB of 100,000 tiles."""

    def __init__(self, details: pa.ChunkedArray) -> None:
        self._details = details
        self._rows: dict[TileId, int] = {}
        self.points = array("q")
        """Readings of each tile."""

    def add(self, tile: TileId, row: int, points: int) -> None:
        """Add a tile with a point, whose figures stand in a row of the details."""
        self._rows[tile] = row
        self.points.append(points)

    def __getitem__(self, tile: TileId) -> TileSummary:
        return _summary(tile, figures_in(self._details[self._rows[tile]].as_py()))

    def __iter__(self) -> Iterator[TileId]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, tile: object) -> bool:
        return tile in self._rows


@dataclass(frozen=True)
class TileFigures:
    """What the records of a survey's tiles say."""

    counts: LogCounts
    """Readings by log and outcome."""
    apart: list[tuple[str, str, int, float, float]]
    """Pairs of passes that differ in a tile, as :func:`apart_in_tile` found them."""
    summaries: Summaries
    """Figures of each tile that has a point."""
    contents: dict[TileId, str]
    """Digest of what the record of each tile that has a file says, but for its key."""


def tile_figures(manifest: Manifest) -> TileFigures:
    """Return what the records of the tiles say; they are read once until they change."""
    return manifest.found(_read)


def reading_counts(manifest: Manifest) -> LogCounts:
    """Return the readings of a survey by log and outcome, from the records of footprints and tiles."""
    return LogCounts(manifest.of(FOOTPRINTS).values()) + tile_figures(manifest).counts


def _read(manifest: Manifest) -> TileFigures:
    found = TileFigures(LogCounts(), [], Summaries(manifest.own(TILE).column("detail")), {})
    for row, told in enumerate(manifest.column(TILE, "unit", "path", "digest", "detail")):
        unit, path, digest, detail = told
        figures = figures_in(detail)
        found.counts.add(unit, figures.get("fates", {}))
        found.apart.extend(map(tuple, figures.get(APART_FIGURE, ())))
        if not path:
            continue
        tile = TileId.parse(unit)
        found.contents[tile] = hashlib.blake2b("\0".join((unit, digest, detail)).encode(), digest_size=8).hexdigest()
        if figures.get("points"):
            found.summaries.add(tile, row, figures["points"])
    return found


def summary_of(record: OutputRecord) -> TileSummary | None:
    """Return figures of a finished tile; None where it has no point."""
    figures = record.figures()
    return _summary(TileId.parse(record.unit), figures) if figures.get("points") else None


def _summary(tile: TileId, figures: Mapping[str, Any]) -> TileSummary:
    told = {name: figures[name] for name in _OF_SUMMARY if name in figures}
    return TileSummary(tile=tile, **(told | {"passes": tuple(told["passes"])}))
