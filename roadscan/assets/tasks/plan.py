"""Plan of the search for assets: squares that a sensor with a wide view saw, their keys, and tasks over them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from roadscan.assets.kind import AssetKind, asset_kinds
from roadscan.assets.make_scene import CLASSES_REACH_M
from roadscan.assets.settings import AssetsConfig, picture_rule
from roadscan.assets.tasks.load_returns import ReturnsTask
from roadscan.assets.tasks.recognition import check_recognition
from roadscan.assets.tiling import AssetGrid, Halos
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.georeference.plan.road import centre_lines_key
from roadscan.georeference.sources import ReadingSource, geometry_of
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.pictures.placed import rule_cameras
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.store.asset_schema import AssetSchema, asset_schema
from roadscan.store.digest import bytes_digest
from roadscan.tiles.product import ProductContext
from roadscan.tiles.tasks.tile_plan import Block, PlannedTiles, TilePlan, cut_blocks, plan_tiles
from roadscan.tiles.tasks.wanted_products import product_context


@dataclass(frozen=True)
class WantedKind:
    """A kind of assets and what determines its evidence and its objects, beside the returns."""

    kind: AssetKind
    options: Strict

    @property
    def name(self) -> str:
        """Returns its name."""
        return self.kind.name

    @property
    def schema(self) -> AssetSchema:
        """Returns its schema."""
        return asset_schema(self.kind.name)

    def evidence_key(self) -> str:
        """Returns the key of what determines its evidence."""
        code = code_digest("roadscan.assets.tasks.evidence:find_evidence", name_of(type(self.kind)))
        return key_of(self.name, code, self.options.model_dump(mode="json"))

    def objects_key(self) -> str:
        """Returns the key of what determines its objects."""
        code = code_digest("roadscan.assets.tasks.objects:join_objects", name_of(type(self.kind)))
        columns = [[c.name, c.type] for c in self.schema.columns]
        return key_of(self.name, code, self.options.model_dump(mode="json"), columns)


def wanted_kinds(config: AssetsConfig) -> tuple[WantedKind, ...]:
    """Returns the requested kinds and those that they need, each after those that it names.

    Raises
    ------
    ConfigError
        for a kind that does not exist, settings that it does not have, or kinds that wait for one another.
    """
    known = asset_kinds()
    for name in (*(config.kinds or ()), *config.options):
        if name not in known:
            raise ConfigError(
                f"[assets] names the unknown kind '{name}'{nearest(name, known)}",
                expected="one of: " + ", ".join(known),
            )
    waiting = dict.fromkeys(sorted(known) if config.kinds is None else config.kinds)
    for name in list(waiting):
        waiting.update(dict.fromkeys(_needed(name, known)))
    ordered: list[str] = []
    while waiting:
        ready = sorted(name for name in waiting if all(n in ordered or n not in known for n in known[name].after))
        if not ready:
            raise ConfigError(f"these kinds wait for one another: {', '.join(sorted(waiting))}")
        ordered.append(ready[0])
        del waiting[ready[0]]
    return tuple(WantedKind(known[name], _options(known[name], config)) for name in ordered)


def _needed(name: str, known: dict[str, AssetKind]) -> list[str]:
    """Returns all kinds that a kind uses, directly or not, as far as they exist."""
    found: list[str] = []
    waiting = [name]
    while waiting:
        for one in known[waiting.pop()].after:
            if one in known and one not in found:
                found.append(one)
                waiting.append(one)
    return found


def _options(kind: AssetKind, config: AssetsConfig) -> Strict:
    try:
        return kind.options.parse(config.options.get(kind.name, {}))
    except ConfigError as error:
        raise ConfigError(
            f"[assets.options.{kind.name}] {error.arrived}", expected=error.expected, change=error.change
        ) from error


_SCENE_SQUARES: Final = 4
"""Edge of the largest block of squares that are searched in one scene."""
_BLOCK_SQUARES: Final = 16
"""Edge of the largest block of squares of one task: a lidar sees 100 m to both sides, and row groups that
touch several blocks are read for each."""


@dataclass(frozen=True)
class AssetPlan:
    """Squares of a survey, and what is sought in them."""

    survey: SurveyPlan
    config: AssetsConfig
    grid: AssetGrid
    tiles: TilePlan
    """The survey's tiles that the chosen sensors may have seen."""
    sensors: tuple[str, ...]
    ways: tuple[tuple[str, TrajectorySource], ...]
    leading: tuple[ReadingSource, ...]
    """Of each run the sensor whose places are its drive."""
    kinds: tuple[WantedKind, ...]
    common: str
    """Key of what all squares share."""
    keys: Mapping[TileId, str]
    """Key of what was seen in each square, by row and column."""
    readings: Mapping[TileId, int]
    """Approximate number of returns in each square."""
    together: Mapping[TileId, tuple[TileId, ...]]
    """The squares of one scene, by each of them."""

    @property
    def context(self) -> ProductContext:
        """Returns what files need to know of the survey."""
        return self.tiles.context

    @property
    def wants_pictures(self) -> bool:
        """Returns whether pictures of assets are wanted, and the rig has a camera for them."""
        settings = self.config.pictures
        cameras = [one for one in self.survey.survey.rig.sensors.values() if one.kind == "camera"]
        return settings.on and bool(settings.cameras or any(one.interior is not None for one in cameras))

    def blocks(self, squares: Sequence[TileId], workers: int = 1) -> list[tuple[TileId, ...]]:
        """Returns batches of neighbouring squares, bounded by memory and by squares per worker."""
        readings = {square: self.readings[square] for square in squares}
        edge = _BLOCK_SQUARES
        blocks = cut_squares(readings, edge, self.config.max_block_returns)
        while edge > 1 and workers > 1 and len(blocks) < 2 * workers:
            edge //= 2
            blocks = cut_squares(readings, edge, self.config.max_block_returns)
        return blocks

    def load(self, squares: tuple[TileId, ...], grid: AssetGrid | None = None) -> ReturnsTask:
        """Returns the sources of the returns of some squares, of another grid where one is given."""
        grid, known = grid or self.grid, self.tiles.tiles.number
        under = dict.fromkeys(t for square in squares for t in grid.tiles_under(square) if t in known)
        own = tuple(sorted(under, key=lambda t: (t.row, t.column)))
        widths = _divergences(self.survey.survey, self.sensors)
        return ReturnsTask(grid, squares, self.tiles.task(Block(own)), self.sensors, widths, self.ways, self.leading)

    def near(self, chosen: Sequence[TileId]) -> set[TileId]:
        """Returns squares that see one of some of the survey's tiles, in themselves or in their halo."""
        near = set(chosen)
        found = {square for square in self.keys if not near.isdisjoint(self.grid.tiles_under(square))}
        return {square for one in found for square in self.together[one]}


def cut_squares(readings: Mapping[TileId, int], edge: int, max_readings: int) -> list[tuple[TileId, ...]]:
    """Returns blocks of at most `edge`² squares and about so many readings: one where all squares fit into one.

    Blocks lie on a lattice through the map's origin, where a survey on a local map begins: cut there, its returns would
    be read and placed four times.
    """
    fits = sum(readings.values()) <= max_readings
    spans = [max(at) - min(at) + 1 for at in zip(*readings, strict=True)]
    if readings and fits and max(spans) <= edge:
        return [tuple(sorted(readings, key=lambda one: (one.row, one.column)))]
    return [block.tiles for block in cut_blocks(readings, edge, max_readings)]


def plan_assets(plan: SurveyPlan, footprints: FootprintRanges) -> AssetPlan:
    """Returns the plan over the squares that the used sensors may have seen.

    Raises
    ------
    ConfigError
        where the survey's settings of assets do not fit it.
    """
    config = AssetsConfig.stated(plan.survey)
    if config is None:
        raise ConfigError("the survey file has no section [assets]")
    grid = asset_grid(plan.survey, config)
    chosen = sorted({source.sensor for source, _ in plan.sources if is_looked_at(source, config)})
    ways = _ways(plan, config)
    common = key_of(
        chosen, config.ground.model_dump(mode="json"), centre_lines_key(plan.centre_lines),
        [[w.world, [f.digest for f in w.files], _corrections(plan, run)] for run, w in ways],
        [str(width) for width in _divergences(plan.survey, chosen)],
    )  # fmt: skip
    leading = _leading(plan, config)
    own = _looked_at(footprints, config, leading)
    tiles = plan_tiles(own, replace(plan, tile_key=common))
    held = TilePlan(plan, own, tiles, (), product_context(plan))
    readings = readings_of(grid, tiles)
    own_keys = {square: square_key(common, grid, square, tiles) for square in readings}
    scenes = cut_squares(readings, _SCENE_SQUARES, config.max_scene_returns)
    together = {square: squares for squares in scenes for square in squares}
    keys = {square: key_of([own_keys[one] for one in together[square]]) for square in readings}
    return AssetPlan(
        plan, config, grid, held, tuple(chosen), ways, leading, wanted_kinds(config), common, keys, readings, together
    )


def readings_of(grid: AssetGrid, tiles: PlannedTiles) -> dict[TileId, int]:
    """Returns the approximate number of returns in each square that holds any, by row and column."""
    found: dict[TileId, int] = {}
    for tile, count in zip(tiles.ids, tiles.readings, strict=True):
        square = grid.of_tile(tile)
        found[square] = found.get(square, 0) + int(count)
    return dict(sorted(found.items(), key=lambda one: (one[0].row, one[0].column)))


def square_key(common: str, grid: AssetGrid, square: TileId, tiles: PlannedTiles) -> str:
    """Returns the key of what was seen in a square and its halos."""
    under = [t for t in grid.tiles_under(square) if t in tiles.number]
    return key_of(common, grid, [(str(t), tiles.keys[tiles.number[t]]) for t in under])


def asset_grid(survey: Survey, config: AssetsConfig) -> AssetGrid:
    """Returns the squares of a survey."""
    return grid_of(survey, config.tile_m, halos_of(config))


def grid_of(survey: Survey, edge_m: float, halos: Halos) -> AssetGrid:
    """Returns squares whose edge is the least multiple of the survey's tiles that is no shorter than `edge_m`."""
    tiles = survey.config.tiles
    per_edge = max(1, math.ceil(edge_m / tiles.size_m - 1e-9))
    return AssetGrid(TileGrid(tiles.size_m, tiles.cell_m), per_edge, halos)


def halos_of(config: AssetsConfig) -> Halos:
    """Returns how far a search looks beyond its square: what a kind reads depends on what is around, and that on bare
    earth, which depends on the ground around.
    """
    scene_m = max((one.kind.reach_m for one in wanted_kinds(config)), default=0.0)
    classes_m = scene_m + CLASSES_REACH_M
    return Halos(scene_m, classes_m, classes_m + config.ground.depends_on_m)


def is_looked_at(source: ReadingSource, config: AssetsConfig) -> bool:
    """Returns whether assets are sought in a source's readings."""
    if config.sensors is not None:
        return source.sensor in config.sensors
    geometry = geometry_of(source)
    return geometry is None or geometry.kind == "polar"


def check_assets(survey: Survey) -> None:
    """Raise :class:`ConfigError` where the section [assets] names what does not exist; reads nothing."""
    config = AssetsConfig.stated(survey)
    if config is None:
        return
    wanted_kinds(config)
    pictures = config.pictures
    check_recognition(pictures, None if pictures.recogniser is None else survey.resolve(pictures.recogniser))
    if pictures.on and pictures.cameras:
        rule_cameras(survey.rig, picture_rule(pictures))
    named = {log.sensor for run in survey.config.runs for log in run.logs if log.sensor is not None}
    known = sorted({*survey.rig.sensors, *named, "cloud"})
    for name in config.sensors or ():
        if name not in known:
            raise ConfigError(
                f"assets.sensors names the unknown sensor '{name}'{nearest(name, known)}",
                expected="a sensor of the rig: " + ", ".join(known),
            )


def _leading(plan: SurveyPlan, config: AssetsConfig) -> tuple[ReadingSource, ...]:
    """Returns of each run the first of its used sources, by the sensor's name."""
    used = [source for source, _ in plan.sources if is_looked_at(source, config)]
    ordered = sorted(used, key=lambda s: (s.run, s.sensor, s.table, s.key), reverse=True)
    return tuple({one.run: one for one in ordered}.values())


def _looked_at(footprints: FootprintRanges, config: AssetsConfig, leading: Sequence[ReadingSource]) -> FootprintRanges:
    """Returns footprints of the used sources; of their profiles also those that are not road.

    Their keys tell the mounting of their run's leading sensor too, which may have no readings there.
    """
    held = np.array([is_looked_at(one.source, config) for one in footprints.slices], bool)
    rows = held[footprints.slice_index] if held.size else np.zeros(0, bool)
    mounted = {one.run: asdict(one.adjusted_mountings) for one in leading}
    slices = tuple(
        replace(one, source=replace(one.source, road=None, key=key_of(one.source.key, mounted.get(one.source.run))))
        for one in footprints.slices
    )
    return FootprintRanges(
        footprints.tile_column[rows], footprints.tile_row[rows], footprints.slice_index[rows],
        footprints.first_group[rows], footprints.last_group[rows], footprints.readings[rows],
        footprints.first_epoch_gps_ns[rows], footprints.last_epoch_gps_ns[rows], slices,
    )  # fmt: skip


def _ways(plan: SurveyPlan, config: AssetsConfig) -> tuple[tuple[str, TrajectorySource], ...]:
    """Returns trajectories of the runs of clouds, where they have one: they give the place of the sensor."""
    runs = sorted({s.run for s, _ in plan.sources if s.table == "cloud" and is_looked_at(s, config)})
    held = {r.run for r in plan.records if r.tables.get("trajectory")}
    return tuple((run, trajectory_source(run, plan.records)) for run in runs if run in held)


def _divergences(survey: Survey, sensors: Sequence[str]) -> tuple[float, ...]:
    """Returns the full angles of the beams of some sensors (degrees), NaN where they are not known."""
    stated = [
        survey.rig.sensors[name].beam_divergence_deg() if name in survey.rig.sensors else None for name in sensors
    ]
    return tuple(float("nan") if one is None else one for one in stated)


def _corrections(plan: SurveyPlan, run: str) -> str:
    own, mounted = plan.corrections.by_run.get(run), plan.corrections.mountings
    if own is None and not mounted:
        return ""
    arrays = [] if own is None else [own.epochs_gps_ns, own.north_east_down_m, own.roll_pitch_heading_rad]
    arrays += [mounted[sensor].values for sensor in sorted(mounted)]
    return bytes_digest(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays))
