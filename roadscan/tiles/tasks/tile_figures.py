"""Reads the figures in the records of all tiles, once for all that ask: a survey has a hundred thousand of them."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from roadscan.core.grid import TileId
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.georeference.reading_counts import LogCounts
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.records import figures_in
from roadscan.tiles.product import TileSummary
from roadscan.tiles.tasks.passes_apart import FIGURE as PASSES_APART
from roadscan.tiles.tasks.tile_plan import TILE

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
        found.apart.extend(map(tuple, figures.get(PASSES_APART, ())))
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
