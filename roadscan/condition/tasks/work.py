"""Compares existing lines, stretches and values with required ones, to find the work of the stage `condition`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from roadscan.condition.road_line import Roads
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.tasks.lines import LANES, LINES, current_lines, lines_key, load_roads
from roadscan.condition.tasks.pictures import PICTURES, PictureTask, due_pictures, plan_pictures
from roadscan.condition.tasks.ravelling import RAVELLING, RAVELLING_PICTURES, PatchTask, due_patches, plan_patches
from roadscan.condition.tasks.road_edges import SURFACES, EdgePiece, due_edges, plan_edges, stated_surface
from roadscan.condition.tasks.roughness_regions import (
    REGION_PICTURES,
    REGION_SECTIONS,
    REGIONS,
    Piece,
    due_pieces,
    plan_pieces,
)
from roadscan.condition.tasks.sections import SECTIONS, TILES, SectionFiles, due_files, due_tiles, plan_sections
from roadscan.condition.tasks.stretches import (
    EDGES,
    OF_STRETCHES,
    SURFACE_FILES,
    Stretch,
    due_stretches,
    plan_stretches,
)
from roadscan.condition.tasks.values import VALUES, Group, GroupTask, due_groups, plan_groups
from roadscan.core.grid import TileId
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.store.manifest import OutputRecord
from roadscan.tiles.tasks.tile_plan import TILE
from roadscan.tiles.tasks.wanted_products import product_context

MADE = (
    LINES, LANES, *OF_STRETCHES, EDGES, SURFACES, VALUES, SECTIONS, TILES, PICTURES, RAVELLING, RAVELLING_PICTURES,
    REGIONS, REGION_SECTIONS, REGION_PICTURES,
)  # fmt: skip
"""Names of all outputs in the manifest."""


@dataclass(frozen=True)
class ConditionWork:
    """Work of the stage, as far as it is known before its earlier parts are done."""

    lines_key: str = ""
    lines_due: bool = False
    stretches: Sequence[Stretch] = ()
    due_stretches: Sequence[Stretch] = ()
    groups: Sequence[Group] = ()
    due_groups: Sequence[Group] = ()
    files: SectionFiles | None = None
    due_files: Sequence[str] = ()
    due_tiles: str = ""
    """Key of the table by tile where it is missing or stale."""
    due_pictures: Sequence[PictureTask] = ()
    patches: Sequence[PatchTask] = ()
    """Groups of sections whose ravelled patches are written."""
    due_patches: Sequence[PatchTask] = ()
    edges: Sequence[EdgePiece] = ()
    """Pieces of roads whose edges are due."""
    due_edges: Sequence[EdgePiece] = ()
    pieces: Sequence[Piece] = ()
    """Pieces of roads whose roughness regions are due."""
    due_pieces: Sequence[Piece] = ()
    gone: Sequence[OutputRecord] = field(default=())
    """Outputs that are no longer due."""

    @property
    def values_due(self) -> int:
        """Number of indices of groups that are due."""
        return sum(len(one.indices) for one in self.due_groups)


def plan_condition(session: Session) -> ConditionWork:
    """Compare existing outputs with required ones; what waits for the lines is not known yet."""
    config, manifest = ConditionConfig.stated(session.survey), session.manifest
    if config is None:
        return ConditionWork(gone=manifest.beside(set(MADE), ()))
    key = lines_key(plan_of(session), config)
    if not current_lines(manifest, key):
        return ConditionWork(lines_key=key, lines_due=True)
    return _along_lines(session, config, key)


def _along_lines(session: Session, config: ConditionConfig, key: str) -> ConditionWork:
    plan, manifest = plan_of(session), session.manifest
    context = product_context(plan)
    roads: Roads = load_roads(session.store, manifest, context)
    made = manifest.of(TILE if config.heights == "cells" else SURFACE_FILES)
    tiles = {TileId.parse(unit): r for unit, r in made.items() if r.path}
    settings, grid = config.sections(), plan.ground.grid
    stretches = plan_stretches(roads, tiles, grid, settings)
    measured = {TileId.parse(r.unit): r for r in manifest.of(TILE).values() if r.path}
    stated = stated_surface(plan, config.road_edges)
    edges = plan_edges(roads, measured, grid, config.road_edges, stated)
    groups = plan_groups(roads, manifest, settings, grid.cell_m, with_edges=config.road_edges is not None)
    units = [one.unit(name) for one in groups for name, _ in one.indices]
    tasks = [GroupTask(session.store, settings, grid.cell_m, context, one) for one in groups]
    pictures = plan_pictures(tasks, manifest)
    patches = plan_patches(tasks)
    files = plan_sections(session.store, manifest, roads, units, context)
    pieces = plan_pieces(roads, measured, grid, config.roughness_regions)
    gone = [
        *manifest.beside(set(OF_STRETCHES), {s.unit for s in stretches}),
        *manifest.beside({RAVELLING, RAVELLING_PICTURES}, {unit for one in patches for unit in one.units}),
        *manifest.beside({EDGES, SURFACES}, {one.unit for one in edges}),
        *manifest.beside({VALUES}, set(units)),
        *manifest.beside({PICTURES}, {one.unit for one in pictures}),
        *manifest.beside({REGIONS, REGION_SECTIONS, REGION_PICTURES}, {one.unit for one in pieces}),
    ]
    return ConditionWork(
        key, False, stretches, due_stretches(stretches, manifest), groups, due_groups(groups, manifest), files,
        due_files(files, manifest), due_tiles(files, manifest), due_pictures(pictures, manifest), patches,
        due_patches(patches, manifest), edges, due_edges(edges, manifest), pieces, due_pieces(pieces, manifest), gone,
    )  # fmt: skip
