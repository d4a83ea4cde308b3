"""Green ground, paint and grey edges of squares, from all pictures that show them: the plan, and the work."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from roadscan.assets.green.areas import GREEN_CELLS, MARGIN_CELLS, Sums, green_rows, mosaic_of
from roadscan.assets.green.cells import CELL_M, GROUND_CELLS
from roadscan.assets.green.colours import REACH_M, Elsewhere, Ground, PlacedGround, ground_of, looked_at
from roadscan.assets.scene import Box
from roadscan.assets.settings import picture_rule
from roadscan.assets.tasks.evidence import EVIDENCE, GROUND, SCREENS
from roadscan.assets.tasks.objects import GREEN, GREY_EDGES, PAINTED, read_as
from roadscan.assets.tasks.pictures import hidden_cells
from roadscan.assets.tasks.plan import AssetPlan
from roadscan.assets.tiling import AssetGrid
from roadscan.assets.visibility import SCREENS as SCREEN_ROWS
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.grid import Bounds, TileId
from roadscan.pictures.colours import ColourSource
from roadscan.pictures.placed import Pictures, plan_pictures
from roadscan.run.engine.compute import reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, publish_table, recorded_table
from roadscan.store.store import Store
from roadscan.tiles.tasks.tiles import TaskResult

if TYPE_CHECKING:
    from roadscan.assets.tasks.pictured_paint import Window

_MARGIN_M: Final = MARGIN_CELLS * CELL_M
_AROUND_M: Final = _MARGIN_M + 2.0 * REACH_M + 1.0
"""Ground this far around a square (m) tells the light of the pictures that show it."""


class Wanted(NamedTuple):
    """What the kinds of a survey ask of pictures of the ground."""

    green: bool
    paint: bool
    edges: bool

    @classmethod
    def of(cls, plan: AssetPlan) -> Wanted:
        """Returns what the kinds of a plan ask for."""
        kinds = [one.kind for one in plan.kinds] if plan.wants_pictures else []
        return cls(
            any(one.sees_green for one in kinds), any(one.sees_paint for one in kinds),
            any(one.sees_grey_edges for one in kinds),
        )  # fmt: skip


@dataclass(frozen=True)
class GreenTask:
    """Some squares whose ground is looked at in pictures. Sent to workers: it carries no picture."""

    store: Store
    grid: AssetGrid
    work: tuple[tuple[TileId, str], ...]
    """Squares, and their keys."""
    ground: tuple[tuple[TileId, OutputRecord], ...]
    """Cells of the ground in them and around them."""
    screens: tuple[tuple[TileId, OutputRecord], ...]
    paint: tuple[tuple[TileId, OutputRecord], ...]
    """Pieces of lines and markings in them and around them."""
    pictures: Pictures
    wanted: Wanted

    @property
    def units(self) -> tuple[str, ...]:
        """Returns the names of its squares."""
        return tuple(str(square) for square, _ in self.work)

    def singly(self) -> list[GreenTask]:
        """Returns a task for each square."""
        return [replace(self, work=(one,)) for one in self.work]


@dataclass(frozen=True)
class GreenPlan:
    """Squares whose ground pictures show."""

    keys: Mapping[TileId, str] = field(default_factory=dict)
    pictures: Pictures | None = None

    def due(self, manifest: Manifest) -> list[TileId]:
        """Returns those that are missing or stale."""
        return [
            square
            for square, key in self.keys.items()
            if not all(manifest.is_current(name, str(square), key) for name in (GREEN, PAINTED, GREY_EDGES))
        ]

    def elsewhere(self, manifest: Manifest) -> list[str]:
        """Returns the names of the pictures that do not lie where their times and poses say."""
        details = (record.detail for unit, record in manifest.of(GREEN).items() if TileId.parse(unit) in self.keys)
        return sorted({name for detail in details for name in json.loads(detail).get("elsewhere", ())})

    def gone(self, manifest: Manifest) -> list[OutputRecord]:
        """Returns outputs of squares that no picture shows any more."""
        return manifest.beside({GREEN, PAINTED, GREY_EDGES}, {str(square) for square in self.keys})


def plan_green(plan: AssetPlan, manifest: Manifest) -> GreenPlan:
    """Returns the squares whose ground is to be looked at; none without pictures or a kind that asks for them."""
    wanted = Wanted.of(plan)
    if not any(wanted):
        return GreenPlan()
    try:
        pictures = plan_pictures(plan.survey, replace(picture_rule(plan.config.pictures), reach_m=REACH_M))
    except (ConfigError, RunError):  # the search for pictures of objects says why
        return GreenPlan()
    ground, screens, paint = _held(manifest, GROUND), _held(manifest, SCREENS), _paint(plan, manifest)
    code = code_digest("roadscan.assets.tasks.green:find_green")
    keys = {}
    for square in ground:
        near = pictures.near(_box(plan.grid, square))
        if len(near):
            read = [[r.digest for _, r in _around(plan.grid, square, some)] for some in (ground, screens)]
            read.append([record.digest for _, record in _paint_around(plan.grid, square, paint)])
            keys[square] = key_of(code, near.key(), read, plan.grid.edge_m, *wanted)
    return GreenPlan(keys, pictures)


def green_tasks(plan: AssetPlan, green: GreenPlan, manifest: Manifest, workers: int = 1) -> list[GreenTask]:
    """Returns tasks over neighbouring squares, which share pictures."""
    if green.pictures is None:
        return []
    ground, screens, paint = _held(manifest, GROUND), _held(manifest, SCREENS), _paint(plan, manifest)
    tasks = []
    for squares in plan.blocks(green.due(manifest), workers):
        read = [{s: r for square in squares for s, r in _around(plan.grid, square, some)} for some in (ground, screens)]
        near = green.pictures.near(*(_box(plan.grid, square) for square in squares))
        tasks.append(
            GreenTask(plan.survey.store, plan.grid, tuple((s, green.keys[s]) for s in squares),
                      tuple(read[0].items()), tuple(read[1].items()),
                      tuple(dict.fromkeys(one for s in squares for one in _paint_around(plan.grid, s, paint))), near,
                      Wanted.of(plan))
        )  # fmt: skip
    return tasks


def _held(manifest: Manifest, name: str) -> dict[TileId, OutputRecord]:
    found = {TileId.parse(unit): record for unit, record in manifest.of(name).items() if record.path}
    return dict(sorted(found.items(), key=lambda one: (one[0].row, one[0].column)))


def _paint(plan: AssetPlan, manifest: Manifest) -> list[tuple[TileId, OutputRecord]]:
    """Returns pieces of lines and markings that the lidar found, by kind and square."""
    kinds, found = {one.name for one in plan.kinds if one.kind.sees_paint}, []
    for unit, record in sorted(manifest.of(EVIDENCE).items()):
        kind, _, square = unit.partition("/")
        if record.path and kind in kinds:
            found.append((TileId.parse(square), record))
    return found


def _paint_around(
    grid: AssetGrid, square: TileId, paint: Sequence[tuple[TileId, OutputRecord]]
) -> Sequence[tuple[TileId, OutputRecord]]:
    rings = math.ceil(_MARGIN_M / grid.edge_m)
    return [one for one in paint if max(abs(one[0].column - square.column), abs(one[0].row - square.row)) <= rings]


def _box(grid: AssetGrid, square: TileId, beyond_m: float = _MARGIN_M) -> Bounds:
    own = grid.squares.bounds(square)
    return Bounds(own.easting_min_m - beyond_m, own.northing_min_m - beyond_m, own.easting_max_m + beyond_m,
                  own.northing_max_m + beyond_m)  # fmt: skip


def _around(grid: AssetGrid, square: TileId, held: Mapping[TileId, OutputRecord]) -> list[tuple[TileId, OutputRecord]]:
    """Returns what is held of a square and of those that its pictures may show."""
    rings = math.ceil(_AROUND_M / grid.edge_m)
    names = (TileId(square.column + c, square.row + r) for r in range(-rings, rings + 1)
             for c in range(-rings, rings + 1))  # fmt: skip
    return [(name, held[name]) for name in names if name in held]


def find_green(task: GreenTask) -> TaskResult:
    """Look at the ground of a task's squares, and write the planted cells and the paint (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    source = ColourSource(task.pictures)
    ground = {square: read_as(task.store, record, GROUND_CELLS) for square, record in task.ground}
    screens = {square: recorded_table(task.store, record) for square, record in task.screens}
    for square, key in task.work:
        try:
            green, painted, edges, counts = _found(task, square, ground, screens, source)
            records.append(_record(task, square, key, GREEN, green, {"cells": green.num_rows, **counts}))
            records.append(_record(task, square, key, PAINTED, painted, {"pieces": painted.num_rows}))
            records.append(_record(task, square, key, GREY_EDGES, edges, {"pieces": edges.num_rows}))
        except Exception as error:  # noqa: BLE001  one square's fault must not stop the others
            failures.append((str(square), reason_of(error)))
    return TaskResult.of(records, failures)


def _found(
    task: GreenTask,
    square: TileId,
    ground: Mapping[TileId, pa.Table],
    screens: Mapping[TileId, pa.Table],
    source: ColourSource,
) -> tuple[pa.Table, pa.Table, pa.Table, dict[str, Any]]:
    """Returns a square's planted cells, paint and grey edges, and how many pictures show them or lie elsewhere."""
    from roadscan.assets.paint.brightness import BrightSums, brightness_in
    from roadscan.assets.tasks.pictured_edges import GREY_EDGES as EDGES
    from roadscan.assets.tasks.pictured_edges import grey_edges
    from roadscan.assets.tasks.pictured_paint import PAINTED as PAINTED_PIECES
    from roadscan.assets.tasks.pictured_paint import pictured_paint

    held, wanted = dict(task.ground), task.wanted
    rows = pa.concat_tables([ground[name] for name, _ in _around(task.grid, square, held)])
    cells, rows = ground_of(rows, _box(task.grid, square, _AROUND_M))
    hides = [screens[name] for name, _ in _around(task.grid, square, dict(task.screens))]
    near = task.pictures.near(_box(task.grid, square))
    sums, bright = Sums(len(cells.column)), BrightSums(len(cells.column))
    shown_by, elsewhere = 0, list[str]()
    placed = PlacedGround.of(cells, near)
    voxels = pa.concat_tables([SCREEN_ROWS.empty_table(), *hides])
    for number in range(len(near)):
        picture = source.picture(near, number)
        if picture is None:
            continue
        hidden = functools.partial(hidden_cells, near, number, screens=voxels)
        look = looked_at(picture, near, number, placed, hidden)
        if isinstance(look, Elsewhere):
            elsewhere.append(near.name(number))
        elif look is not None:
            if wanted.green or wanted.edges:
                sums.add(look, int(bytes_digest(near.name(number).encode())[-1], 16) & 1)
            if wanted.paint or wanted.edges:
                bright.add(look.cells, brightness_in(look.colour, look.shown, look.cells, cells), look.pixel_m)
            shown_by += 1
    known = [recorded_table(task.store, record) for _, record in _paint_around(task.grid, square, task.paint)]
    window, box = _window(task.grid, square, cells, rows, known)
    green, painted, edges = GREEN_CELLS.empty_table(), PAINTED_PIECES.empty_table(), EDGES.empty_table()
    if wanted.green or wanted.edges:
        mosaic = mosaic_of(sums, window.cell, window.at, window.shape, cells.drive_m[window.cell])
    if wanted.green:
        first = round(window.corner_m[1] / CELL_M), round(window.corner_m[0] / CELL_M)
        inner = _box(task.grid, square, 0.0)
        green = green_rows(
            mosaic, first, rows, (inner.easting_min_m, inner.northing_min_m, inner.easting_max_m, inner.northing_max_m)
        )
    if wanted.paint:
        painted = pictured_paint(bright, window, box)
    if wanted.edges:
        edges = grey_edges(bright, window, box, mosaic.green)
    return green, painted, edges, {"pictures": shown_by, "elsewhere": elsewhere}


def _window(
    grid: AssetGrid, square: TileId, cells: Ground, rows: pa.Table, paint: Sequence[pa.Table]
) -> tuple[Window, Box]:
    """Returns a square with its margin, and the square's box in it."""
    from roadscan.assets.tasks.pictured_paint import Known, Window

    box = _box(grid, square)
    first = round(box.northing_min_m / CELL_M), round(box.easting_min_m / CELL_M)
    shape = round(box.northing_max_m / CELL_M) - first[0], round(box.easting_max_m / CELL_M) - first[1]
    row, column = cells.row - first[0], cells.column - first[1]
    inside = np.flatnonzero((row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1]))
    corner_m = box.easting_min_m, box.northing_min_m
    known = Known.of(paint, corner_m)
    inner = Box(_MARGIN_M, _MARGIN_M, _MARGIN_M + grid.edge_m, _MARGIN_M + grid.edge_m)
    return Window(inside, (row[inside], column[inside]), shape, cells, rows, corner_m, known), inner


def _record(
    task: GreenTask, square: TileId, key: str, name: str, rows: pa.Table, counts: Mapping[str, Any]
) -> OutputRecord:
    detail = json.dumps(counts)
    if not rows.num_rows:
        return OutputRecord(name, str(square), key, "", 0, "", detail)
    return publish_table(task.store, rows, name, str(square), key, detail)
