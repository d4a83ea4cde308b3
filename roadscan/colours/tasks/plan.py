"""Plan of the stage `colours`: pictures in batches, tiles that they may show, and the keys of both."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.colours.depth import DepthRule
from roadscan.colours.settings import ColoursConfig
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import Bounds, TileId
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.pictures.placed import Pictures, plan_pictures, rule_cameras
from roadscan.pictures.views import PictureRule
from roadscan.run.keys import code_digest, key_of
from roadscan.tiles.product import ProductContext
from roadscan.tiles.tasks.tile_plan import Block, PlannedTiles, TilePlan, TileTask, plan_tiles
from roadscan.tiles.tasks.wanted_products import product_context

DEPTHS: Final = "picture_depths"
"""Manifest name of what the pictures of a batch show."""
_BATCH_NS: Final = 4 * NS_PER_S
"""Pictures of a run are taken together by this interval of time (ns), which begins at the origin of GPS time."""
_BEYOND: Final = 1.25
"""Points so far away (in reaches) still tell what is at an edge, or has moved."""
_ANY_ANGLE_DEG: Final = -90.0  # Least angle of a ray below the horizon: any (degrees).


@dataclass(frozen=True)
class Batch:
    """Pictures of a run within some seconds, and what tells what they show."""

    unit: str
    run: str
    pictures: Pictures
    tiles: TilePlan
    """The tiles around, with the row groups of the same run at that time."""
    key: str

    def task(self) -> TileTask:
        """Returns the sources of the points around."""
        return self.tiles.task(Block(self.tiles.tiles.ids))


@dataclass(frozen=True)
class ColourPlan:
    """Pictures of a survey, and the tiles that get their colours."""

    survey: SurveyPlan
    config: ColoursConfig
    pictures: Pictures
    batches: tuple[Batch, ...]
    batch_of: npt.NDArray[np.int64]
    """(n,) batch of each picture."""
    tiles: TilePlan
    """All tiles of the survey."""

    @property
    def context(self) -> ProductContext:
        """Returns what files need to know of the survey."""
        return self.tiles.context

    @property
    def rule(self) -> DepthRule:
        """Returns how depth images are made."""
        return depth_rule(self.config)

    def bounds(self, tile: TileId) -> Bounds:
        """Returns the box of a tile on the map (m)."""
        return self.survey.ground.grid.bounds(tile)


def depth_rule(config: ColoursConfig) -> DepthRule:
    """Returns how depth images are made, by the settings."""
    return DepthRule(round(config.moment_s * NS_PER_S), config.grazing_deg, config.edge_px)


def picture_rule(config: ColoursConfig) -> PictureRule:
    """Returns which pictures give colours."""
    return PictureRule(tuple(config.cameras), config.reach_m, _ANY_ANGLE_DEG, config.border_px)


def check_cameras(survey: Survey, config: ColoursConfig) -> None:
    """Raise :class:`ConfigError` where no camera of the rig fits the settings, or they do not fit the tiles."""
    try:
        rule_cameras(survey.rig, picture_rule(config))
    except ConfigError as error:
        change = error.change if error.change and "chessboard" in error.change else "add it, or leave out [colours]"
        raise ConfigError(f"[colours] {error.arrived}", expected=error.expected, change=change) from error
    photo, size_m = config.orthophoto, survey.config.tiles.size_m
    for name, edge_m in () if photo is None else (("cell_m", photo.cell_m), ("ground_m", photo.ground_m)):
        if abs(round(size_m / edge_m) * edge_m - size_m) > 1e-9:
            raise ConfigError(
                f"colours.orthophoto.{name} = {edge_m:g} does not divide the tile's edge of {size_m:g} m",
                expected="an edge of which a tile holds a whole number",
            )


def plan_colours(
    plan: SurveyPlan, footprints: FootprintRanges, tiles: PlannedTiles, config: ColoursConfig
) -> ColourPlan:
    """Returns the plan of a survey's colours; reads the poses of the pictures.

    Raises
    ------
    RunError
        where no picture is in the store, or none has a pose.
    """
    try:
        pictures = plan_pictures(plan, picture_rule(config))
    except RunError as error:
        change = "list a log of pictures with stamps in the survey file, or leave out [colours]"
        raise RunError(f"[colours] {error.arrived}", expected=error.expected, change=change) from error
    context = product_context(plan)
    groups, batch_of = _grouped(pictures)
    common = key_of(
        code_digest("roadscan.colours.tasks.depths:write_depths"), config.reach_m, config.seconds,
        depth_rule(config), config.border_px,
    )  # fmt: skip
    around = _Around(footprints, plan, config)
    batches = []
    for run, number, rows in groups:
        own = pictures.chosen(rows)
        held = around.tiles(run, own, context, common)
        near = sorted(zip(map(str, held.tiles.ids), held.tiles.keys, strict=True))
        batches.append(Batch(f"{run}/{number}", run, own, held, key_of(common, own.key(), near)))
    whole = TilePlan(plan, footprints, tiles, (), context)
    return ColourPlan(plan, config, pictures, tuple(batches), batch_of, whole)


def _grouped(pictures: Pictures) -> tuple[list[tuple[str, int, npt.NDArray[np.int64]]], npt.NDArray[np.int64]]:
    """Returns run, number and rows of each batch, and the batch (n,) of each picture."""
    runs = np.array([one.run for one in pictures.logs])[pictures.log]
    number = pictures.epochs_gps_ns // _BATCH_NS
    order = np.lexsort((np.arange(number.size), number, runs))
    new = np.flatnonzero(np.append(True, (runs[order][1:] != runs[order][:-1]) | (np.diff(number[order]) != 0)))
    batch_of = np.empty(number.size, np.int64)
    groups: list[tuple[str, int, npt.NDArray[np.int64]]] = []
    for first, end in itertools.pairwise([*new.tolist(), number.size]):
        rows = order[first:end]
        batch_of[rows] = len(groups)
        groups.append((str(runs[rows[0]]), int(number[rows[0]]), rows))
    return groups, batch_of


class _Around:
    """Footprints of a survey, asked for what was seen around some pictures at their time."""

    def __init__(self, footprints: FootprintRanges, plan: SurveyPlan, config: ColoursConfig) -> None:
        self._f, self._plan, self._config = footprints, plan, config
        runs = np.array([one.source.run for one in footprints.slices])
        of_row = runs[footprints.slice_index] if runs.size else runs
        self._rows = {run: np.flatnonzero(of_row == run) for run in np.unique(of_row).tolist()}
        # What does not belong to the road hides things, too.
        self._slices = tuple(replace(one, source=replace(one.source, road=None)) for one in footprints.slices)

    def tiles(self, run: str, pictures: Pictures, context: ProductContext, common: str) -> TilePlan:
        """Returns the tiles within reach of some pictures of a run, with the row groups of their time alone."""
        f, plan = self._f, self._plan
        beyond_ns = round(self._config.seconds * NS_PER_S)
        first, last = pictures.epochs_gps_ns[0] - beyond_ns, pictures.epochs_gps_ns[-1] + beyond_ns
        rows = self._rows.get(run, np.zeros(0, np.int64))
        rows = rows[(f.first_epoch_gps_ns[rows] <= last) & (f.last_epoch_gps_ns[rows] >= first)]
        size_m = plan.ground.grid.size_m
        low = np.stack([f.tile_column[rows], f.tile_row[rows]], axis=-1) * size_m
        place, reach = pictures.place_m[:, None], _BEYOND * pictures.reach_m[:, None]
        away = np.maximum(np.maximum(low - place, place - low - size_m), 0.0)
        rows = rows[(np.hypot(away[..., 0], away[..., 1]) <= reach).any(axis=0)]
        own = FootprintRanges(
            f.tile_column[rows], f.tile_row[rows], f.slice_index[rows], f.first_group[rows], f.last_group[rows],
            f.readings[rows], f.first_epoch_gps_ns[rows], f.last_epoch_gps_ns[rows], self._slices,
        )  # fmt: skip
        return TilePlan(plan, own, plan_tiles(own, replace(plan, tile_key=common)), (), context)


def reach_beyond_m(config: ColoursConfig) -> float:
    """Returns how far points tell what a picture shows (m)."""
    return _BEYOND * config.reach_m


def within(pictures: Pictures, reach_m: float) -> Pictures:
    """Returns the same pictures with a shorter reach (m)."""
    share = reach_m / pictures.rule.reach_m
    return pictures if share >= 1.0 else replace(pictures, reach_m=pictures.reach_m * share)


def numbers_near(plan: ColourPlan, boxes: Sequence[Bounds], reach_m: float) -> npt.NDArray[np.int64]:
    """Returns the pictures, by number, that may show a point in one of some boxes of the map."""
    return within(plan.pictures, reach_m).numbers_near(*boxes)


def jsonable(config: ColoursConfig) -> Mapping[str, Any]:
    """Returns the settings that change colours, for keys."""
    return config.model_dump(mode="json", exclude={"points", "orthophoto", "max_block_readings"})
