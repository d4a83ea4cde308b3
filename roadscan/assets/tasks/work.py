"""Work of the stage `assets`: existing evidence, objects and files compared with those that are wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from roadscan.assets.tasks.evidence import (
    BARE_EARTH,
    CLASSIFIED,
    EVIDENCE,
    GROUND,
    SCREENS,
    VISIBILITY,
    SquareWork,
    due_squares,
    evidence_unit,
)
from roadscan.assets.tasks.gains import GAINS, SAMPLES, STATISTICS, GainsPlan, current_gains, plan_gains
from roadscan.assets.tasks.objects import GREEN, GREY_EDGES, OBJECTS, PAINTED, Cluster, JoinTask, plan_joins
from roadscan.assets.tasks.picture_work import CUT_OUTS, SEEN
from roadscan.assets.tasks.plan import AssetPlan, plan_assets
from roadscan.assets.tasks.sections import SECTIONS
from roadscan.assets.tasks.tables import TABLES
from roadscan.core.grid import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.tiles.tasks.tile_plan import tiles_of
from roadscan.tiles.tasks.wanted_products import chosen_tiles

MADE = (
    SAMPLES, GAINS, STATISTICS, EVIDENCE, CLASSIFIED, BARE_EARTH, SCREENS, GROUND, GREEN, PAINTED, GREY_EDGES,
    VISIBILITY, OBJECTS, SEEN, CUT_OUTS, TABLES, SECTIONS,
)  # fmt: skip
"""Names of all outputs in the manifest."""


@dataclass(frozen=True)
class AssetsWork:
    """Work that is due, as far as known before earlier steps are done."""

    plan: AssetPlan | None = None
    """None where no assets are asked for."""
    gains: GainsPlan = field(default_factory=lambda: GainsPlan(()))
    samples: Sequence[tuple[TileId, str]] = ()
    """Samples of intensity that are due."""
    gains_due: bool = False
    squares: Sequence[SquareWork] = ()
    """Squares of which anything is due."""
    gone: Sequence[OutputRecord] = field(default=())
    """Outputs of squares and kinds that are no longer due."""

    @property
    def evidence_due(self) -> int:
        """Returns how many outputs of squares are due."""
        return len(self.samples) + sum(len(one.kinds) + len(one.beside) for one in self.squares)


def plan_evidence(session: Session) -> AssetsWork:
    """Returns the difference of existing and wanted evidence; with a selection of tiles, of their squares."""
    manifest = session.manifest
    if not session.survey.has("assets"):
        return AssetsWork(gone=manifest.beside(set(MADE), ()))
    plan = plan_assets(plan_of(session), footprints_of(session))
    gains = plan_gains(plan)
    samples, held = gains.due(manifest), current_gains(gains, manifest)
    forced: list[TileId] = []
    if session.selection is not None:
        chosen = chosen_tiles(
            session.selection, tiles_of(session), footprints_of(session), plan_of(session).ground.grid
        )
        forced = sorted({plan.grid.of_tile(t) for t in chosen} & set(plan.keys))
        near = plan.near(chosen)
        due = [one for one in due_squares(plan, manifest, held, forced) if one.square in near]
    else:
        due = due_squares(plan, manifest, held)
    gone = _gone(plan, gains, manifest)
    return AssetsWork(plan, gains, samples, bool(gains.samples) and held is None, due, gone)


def _gone(plan: AssetPlan, gains: GainsPlan, manifest: Manifest) -> list[OutputRecord]:
    config, kinds = plan.config, [one.name for one in plan.kinds]
    units = {str(square) for square in plan.keys}
    evidence = {evidence_unit(name, square) for name in kinds for square in plan.keys}
    objects = {unit for unit in manifest.of(OBJECTS) if unit.partition("/")[0] in kinds}
    return [
        *manifest.beside({SAMPLES}, gains.units()),
        *manifest.beside({GAINS, STATISTICS} - set(gains.tables if gains.samples else ()), ()),
        *manifest.beside({EVIDENCE}, evidence),
        *manifest.beside({CLASSIFIED}, units if config.classified else ()),
        *manifest.beside({BARE_EARTH}, units if config.bare_earth else ()),
        *manifest.beside({SCREENS, GROUND, GREEN, PAINTED, GREY_EDGES}, units if plan.wants_pictures else ()),
        *manifest.beside({VISIBILITY}, units),
        *manifest.beside({OBJECTS}, objects),
        *manifest.beside({TABLES}, _files(plan)),
        *manifest.beside({SECTIONS} if config.cross_sections is None else set(), ()),
    ]


def _files(plan: AssetPlan) -> set[str]:
    """Returns names of the tables and files that the survey asks for."""
    exports = plan.config.exports
    tables = {one.schema.table for one in plan.kinds}
    names = {f"{table}.parquet" for table in tables}
    names |= {f"assets.{kind}" for kind in ("gpkg", "dxf") if kind in exports}
    return names | ({f"{table}.geojson" for table in tables} if "geojson" in exports else set())


def due_joins(plan: AssetPlan, manifest: Manifest) -> list[JoinTask]:
    """Returns clusters of all kinds whose objects are missing or stale, as far as known before others are joined."""
    clusters: dict[str, list[Cluster]] = {}
    return [
        task
        for wanted in plan.kinds
        for task in plan_joins(plan.survey.store, plan.grid, wanted, manifest, clusters).due(manifest)
    ]
