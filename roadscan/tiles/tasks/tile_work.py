"""Compares existing with required tiles, to find the work of the stage `tiles`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from roadscan.core.ids import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.memory import BYTES_PER_READING, MOST_CELL_BYTES, WORKER_BASE_BYTES
from roadscan.run.session import Session
from roadscan.store.manifest import OutputRecord
from roadscan.tiles.tasks.selection import chosen_tiles
from roadscan.tiles.tasks.tile_files import tile_file_names
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE, TilePlan, TileTask, stale_tiles, tiles_of
from roadscan.tiles.tasks.wanted_products import product_context, wanted_tile_products


@dataclass(frozen=True)
class TileWork:
    """Work of the stage."""

    planned: TilePlan
    chosen: list[TileId]
    """Tiles to compute now."""
    gone: list[OutputRecord]
    """Files of tiles that no reading touches any more, and of products no longer wanted."""
    why: Mapping[TileId, str] = field(default_factory=dict)
    """Why each tile is due, unless tiles were chosen."""


def plan_tile_work(session: Session) -> TileWork:
    """Compare existing tiles with required ones."""
    plan, manifest, survey = plan_of(session), session.manifest, session.survey
    context = product_context(plan)
    wanted = tuple(wanted_tile_products(survey, context))
    tiles, footprints = tiles_of(session), footprints_of(session)
    why = {} if session.selection is not None else stale_tiles(tiles, wanted, manifest)
    chosen = list(why)
    if session.selection is not None:
        chosen = chosen_tiles(session.selection, tiles, footprints, plan.ground.grid)
    per_tile = tile_file_names()
    dropped = per_tile - tile_file_names({w.product.name for w in wanted})
    gone = manifest.beside({TILE, OVERVIEWS, *per_tile} - dropped, tiles.units)
    gone += manifest.beside(dropped, ())
    return TileWork(TilePlan(plan, footprints, tiles, wanted, context), chosen, gone, why)


def memory_of(tasks: Sequence[TileTask]) -> int:
    """Return the approximate memory (bytes) that a worker needs for the largest of some tasks."""
    largest = max((t.readings * BYTES_PER_READING if t.needs_points else MOST_CELL_BYTES for t in tasks), default=0)
    return WORKER_BASE_BYTES + largest if tasks else 0
