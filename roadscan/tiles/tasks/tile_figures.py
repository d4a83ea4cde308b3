"""Reads the figures in the records of all tiles, once for all that ask: a survey has a hundred thousand of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from roadscan.core.ids import TileId
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.georeference.reading_counts import LogCounts
from roadscan.store.manifest import Manifest
from roadscan.tiles.product import TileSummary
from roadscan.tiles.tasks.passes_apart import FIGURE as PASSES_APART
from roadscan.tiles.tasks.tile_plan import TILE

_OF_SUMMARY = tuple(TileSummary.__dataclass_fields__)[1:]


@dataclass(frozen=True)
class TileFigures:
    """What the records of a survey's tiles say."""

    counts: LogCounts
    """Readings by log and outcome."""
    apart: list[tuple[str, str, int, float, float]]
    """Pairs of passes that differ in a tile, as :func:`apart_in_tile` found them."""
    summaries: dict[TileId, TileSummary]
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
    found = TileFigures(LogCounts(), [], {}, {})
    for unit, path, digest, detail in manifest.column(TILE, "unit", "path", "digest", "detail"):
        figures: dict[str, Any] = json.loads(detail) if detail else {}
        found.counts.add(unit, figures.get("fates", {}))
        found.apart.extend(map(tuple, figures.get(PASSES_APART, ())))
        if not path:
            continue
        tile = TileId.parse(unit)
        told = "\0".join((unit, digest, detail)).encode()
        found.contents[tile] = hashlib.blake2b(told, digest_size=8).hexdigest()
        if (summary := summary_in(tile, figures)) is not None:
            found.summaries[tile] = summary
    return found


def summary_in(tile: TileId, figures: Mapping[str, Any]) -> TileSummary | None:
    """Return the summary of a tile, from the figures of its record; None where it has no point."""
    if not figures.get("points"):
        return None
    told = {name: figures[name] for name in _OF_SUMMARY if name in figures}
    return TileSummary(tile=tile, **(told | {"passes": tuple(told["passes"])}))
