"""Coloured points: the points of some tiles, the best looks at each, and the files of the tiles."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.colours.depth import normals_of
from roadscan.colours.painting import PaintRule, Places, paint
from roadscan.colours.settings import ColoursConfig
from roadscan.colours.tasks.plan import ColourPlan, jsonable
from roadscan.colours.tasks.share import PictureShare, Shares
from roadscan.core.gpstime import NS_PER_S, utc_from_gps_ns
from roadscan.core.grid import QUANTUM_M, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import OutputRecord
from roadscan.tiles.product import publish_file
from roadscan.tiles.products.las import LasOptions, write_las
from roadscan.tiles.tasks.tile_plan import Block, TileTask, cut_blocks
from roadscan.tiles.tasks.tile_points import load_points
from roadscan.tiles.tasks.tiles import TaskResult

POINTS: Final = "coloured_points"
_LOOKS: Final = 8
"""Looks of which the median is taken: farther ones blur."""
_AT_ONCE: Final = 1_500_000  # Points coloured at a time.
_ORIGIN_M: Final = np.zeros(3)
"""Points count from the map's origin, so that no colour depends on which tiles are coloured together."""
_EIGHT_TO_SIXTEEN_BITS: Final = 257  # LAS stores colours with 16 bits.
_SEEN_BY: Final = "pictures"
"""Extra dimension of the files: of how many pictures a colour is the median, 0 without a colour."""


@dataclass(frozen=True)
class PointsTask:
    """Some tiles whose points get colours. Sent to workers: it holds no data."""

    readings: TileTask
    keys: tuple[tuple[TileId, str], ...]
    share: PictureShare
    rule: PaintRule

    @property
    def block(self) -> Block:
        """Returns the tiles."""
        return self.readings.block


@dataclass(frozen=True)
class PointsPlan:
    """Files of coloured points that should be there."""

    plan: ColourPlan
    shares: Shares
    keys: dict[TileId, str]

    def tasks(self, chosen: Sequence[TileId]) -> list[PointsTask]:
        """Returns tasks over some tiles, in blocks of neighbours."""
        tiles, config = self.plan.tiles.tiles, self.plan.config
        readings = {t: int(tiles.readings[tiles.number[t]]) for t in chosen}
        edge = self.plan.survey.survey.config.tiles.block_tiles
        return [self._task(b) for b in cut_blocks(readings, edge, config.max_block_readings)]

    def singly(self, chosen: Sequence[TileId]) -> list[PointsTask]:
        """Returns a task for each tile."""
        return [self._task(Block((tile,))) for tile in chosen]

    def _task(self, block: Block) -> PointsTask:
        boxes = [self.plan.bounds(t) for t in block.tiles]
        share = self.shares.near(boxes, self.plan.config.reach_m)
        keys = tuple((t, self.keys[t]) for t in block.tiles)
        return PointsTask(self.plan.tiles.task(block), keys, share, paint_rule(self.plan.config))


def plan_points(plan: ColourPlan, shares: Shares) -> PointsPlan:
    """Returns the files that should be there, as far as it is known what pictures show."""
    if not plan.config.points:
        return PointsPlan(plan, shares, {})
    common = key_of(
        code_digest("roadscan.colours.tasks.points:colour_points"), jsonable(plan.config), plan.context.survey_id,
        plan.context.map,
    )  # fmt: skip
    keys = {}
    for tile, key in zip(plan.tiles.tiles.ids, plan.tiles.tiles.keys, strict=True):
        share = shares.near([plan.bounds(tile)], plan.config.reach_m)
        keys[tile] = key_of(common, key, share.key())
    return PointsPlan(plan, shares, keys)


def paint_rule(config: ColoursConfig) -> PaintRule:
    """Returns which looks at points count."""
    return PaintRule(
        config.reach_m, config.border_px, config.grazing_deg, round(config.moment_s * NS_PER_S),
        round(config.seconds * NS_PER_S), _LOOKS,
    )  # fmt: skip


def colour_points(task: PointsTask) -> TaskResult:
    """Colour the points of a task's tiles and write them (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    keys, store = dict(task.keys), task.readings.store
    held: list[tuple[TilePoints, Places]] = []
    with store.scratch() as folder:

        def finish() -> None:
            if not held:
                return
            try:
                records.extend(_written(task, held, keys, folder))
            except Exception as error:  # noqa: BLE001  some tiles' fault must not stop the others
                failures.extend((str(points.tile), reason_of(error)) for points, _ in held)
                damaged.add(damaged_file(error))
            held.clear()

        for tile, points in load_points(task.readings):
            if tile not in keys:
                continue
            if held and sum(len(p) for p, _ in held) + len(points) > _AT_ONCE:
                finish()
            held.append((points, _places(points, task)))
        finish()
    done = {record.unit for record in records} | {unit for unit, _ in failures}
    empty = json.dumps({"points": 0, "coloured": 0})
    records += [OutputRecord(POINTS, str(t), key, "", 0, "", empty) for t, key in task.keys if str(t) not in done]
    return TaskResult.of(records, failures, damaged)


def _places(points: TilePoints, task: PointsTask) -> Places:
    own = np.stack([points.x_quanta, points.y_quanta, points.height_quanta], axis=-1) * QUANTUM_M
    normal = normals_of(own)
    corner = np.array([points.tile.column, points.tile.row, 0.0]) * task.readings.ground.grid.size_m
    return Places(own + corner, normal, points.epoch_gps_ns)


def _written(
    task: PointsTask, held: Sequence[tuple[TilePoints, Places]], keys: dict[TileId, str], folder: Path
) -> Iterator[OutputRecord]:
    looks = paint(task.share.palette(task.readings.store), [p for _, p in held], _ORIGIN_M, task.rule)
    for (points, _), own in zip(held, looks, strict=True):
        colour, count = own.sure_medians()
        seen = int(np.count_nonzero(count))
        context = replace(task.readings.context, date=utc_from_gps_ns(int(points.epoch_gps_ns.min())).date())
        figures: dict[str, Any] = {"points": len(points), "coloured": seen}
        facts = {"survey": context.survey_id, "tile": str(points.tile), "height": context.map.height, **figures}
        path = folder / "coloured.laz"
        write_las(path, _coloured(points, colour, count), LasOptions(), context, facts, {},
                  {_SEEN_BY: "of a colour's median, 0: none"})  # fmt: skip
        yield publish_file(
            task.readings.store, path, f"products/{POINTS}/{points.tile}.laz", POINTS, str(points.tile),
            keys[points.tile], json.dumps(figures),
        )  # fmt: skip


def _coloured(points: TilePoints, colour: npt.NDArray[np.uint8], count: npt.NDArray[np.uint8]) -> TilePoints:
    wide = colour.astype(np.uint16) * np.uint16(_EIGHT_TO_SIXTEEN_BITS)
    channels = {name: np.ascontiguousarray(wide[:, k]) for k, name in enumerate(("red", "green", "blue"))}
    return replace(points, extra={**points.extra, **channels, _SEEN_BY: count})
