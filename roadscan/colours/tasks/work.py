"""Work of the stage `colours`: what is there compared with what is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from roadscan.colours.settings import ColoursConfig
from roadscan.colours.tasks.depths import (
    GAINS,
    DepthTask,
    PictureGains,
    depth_task,
    plan_gains,
    read_gains,
    write_gains,
)
from roadscan.colours.tasks.orthophoto import (
    MOSAIC,
    ORTHOPHOTO,
    PICTURES_OF,
    UNIT,
    PhotoPlan,
    plan_mosaic,
    plan_photos,
    write_mosaic,
)
from roadscan.colours.tasks.plan import DEPTHS, ColourPlan, plan_colours
from roadscan.colours.tasks.points import POINTS, PointsPlan, plan_points
from roadscan.colours.tasks.share import Shares
from roadscan.core.grid import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session, found_once
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.tiles.tasks.tile_plan import tiles_of
from roadscan.tiles.tasks.wanted_products import chosen_tiles

MADE: Final = (DEPTHS, GAINS, POINTS, ORTHOPHOTO, PICTURES_OF, MOSAIC)
"""Names of all outputs in the manifest."""


@dataclass(frozen=True)
class ColourWork:
    """Work that is due, as far as known before earlier steps are done."""

    plan: ColourPlan | None = None
    """None where no colours are asked for."""
    depths_due: Sequence[DepthTask] = ()
    gains_due: int = 0
    points: PointsPlan | None = None
    points_due: Sequence[TileId] = ()
    photos: PhotoPlan | None = None
    photos_due: Sequence[TileId] = ()
    gains: PictureGains | None = None
    gone: Sequence[OutputRecord] = field(default=())
    """Outputs that are no longer wanted."""

    @property
    def unreadable(self) -> list[str]:
        """Returns the pictures that give no colour, with the reason."""
        if self.plan is None or self.gains is None:
            return []
        names = (self.plan.pictures.name(n) for n in range(len(self.plan.pictures)))
        return [f"{name}: {reason}" for name, reason in zip(names, self.gains.reason, strict=True) if reason]


@found_once
def colours_of(session: Session) -> ColourPlan | None:
    """Returns the plan of the survey's colours; None where it asks for none."""
    config = ColoursConfig.stated(session.survey)
    if config is None:
        return None
    return plan_colours(plan_of(session), footprints_of(session), tiles_of(session), config)


def plan_work(session: Session) -> ColourWork:
    """Returns the difference of existing and wanted outputs; with a selection of tiles, of those."""
    manifest, plan = session.manifest, colours_of(session)
    if plan is None:
        return ColourWork(gone=manifest.beside(set(MADE), ()))
    due = [one for one in plan.batches if not manifest.is_current(DEPTHS, one.unit, one.key)]
    tables = plan_gains(plan, manifest)
    gains = read_gains(plan, manifest, tables)
    gains_due = sum(not manifest.is_current(GAINS, one.run, one.key) for one in tables)
    shares = Shares(plan, manifest, gains)
    points, photos = plan_points(plan, shares), plan_photos(plan, shares, manifest)
    return ColourWork(
        plan, [depth_task(plan, one) for one in due], gains_due, points, _due(session, POINTS, points.keys), photos,
        _due(session, ORTHOPHOTO, photos.keys), gains, _gone(plan, points, photos, manifest),
    )  # fmt: skip


def make_mosaic(session: Session, plan: ColourPlan) -> None:
    """Write the mosaic of the orthophotos where it is missing or stale."""
    photo, manifest = plan.config.orthophoto, session.manifest
    if photo is None:
        return
    mosaic = plan_mosaic(manifest, plan.context, photo.cell_m)
    if not mosaic.tiles:
        manifest.remove(manifest.beside({MOSAIC}, ()))
    elif not manifest.is_current(MOSAIC, UNIT, mosaic.key):
        manifest.add([write_mosaic(session.store, mosaic, plan.context, photo.cell_m)])
    manifest.settle()


def _due(session: Session, product: str, keys: dict[TileId, str]) -> list[TileId]:
    """Returns the tiles whose output is missing or stale; with a selection, those that are chosen."""
    chosen = _selected(session, keys)
    if session.selection is not None:
        return chosen
    return [t for t in chosen if not session.manifest.is_current(product, str(t), keys[t])]


def make_gains(session: Session, plan: ColourPlan) -> None:
    """Write the gains of the runs whose table is missing or stale."""
    manifest = session.manifest
    for table in plan_gains(plan, manifest):
        if not manifest.is_current(GAINS, table.run, table.key):
            manifest.add([write_gains(session.store, table)])
    manifest.settle()


def _selected(session: Session, known: dict[TileId, str]) -> list[TileId]:
    if session.selection is None:
        return list(known)
    footprints, grid = footprints_of(session), plan_of(session).ground.grid
    chosen = set(chosen_tiles(session.selection, tiles_of(session), footprints, grid))
    return [t for t in known if t in chosen]


def _gone(plan: ColourPlan, points: PointsPlan, photos: PhotoPlan, manifest: Manifest) -> list[OutputRecord]:
    return [
        *manifest.beside({DEPTHS}, {one.unit for one in plan.batches}),
        *manifest.beside({GAINS}, {one.run for one in plan.batches}),
        *manifest.beside({POINTS}, set(map(str, points.keys))),
        *manifest.beside({ORTHOPHOTO, PICTURES_OF}, set(map(str, photos.keys))),
        *manifest.beside({MOSAIC} if not photos.keys else set(), ()),
    ]
