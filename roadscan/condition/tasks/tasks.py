"""Runs tasks that make several files each, and selects the tiles beside a piece of a road."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
import shapely

from roadscan.condition.road_line import RoadLine
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.run.engine.compute import Compute, reason_of
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.tasks.tiles import TaskResult


class Splittable(Protocol):
    """A task over some units."""

    @property
    def units(self) -> tuple[str, ...]:
        """Return the names of its units."""

    def singly(self) -> list[Self]:
        """Return a task for each unit."""


T = TypeVar("T", bound=Splittable)


class RoadPiece(Protocol):
    """A piece of a road."""

    @property
    def unit(self) -> str:
        """Its name in the manifest."""


P = TypeVar("P", bound=RoadPiece)
S = TypeVar("S", bound=Strict)


@dataclass(frozen=True, eq=False)
class PieceTask(Generic[P, S]):
    """Pieces of roads, with settings for their computation. Sent to workers: it holds no data."""

    store: Store
    grid: TileGrid
    context: ProductContext
    settings: S
    pieces: tuple[P, ...]

    @property
    def units(self) -> tuple[str, ...]:
        """Names of the pieces."""
        return tuple(p.unit for p in self.pieces)

    def singly(self) -> list[Self]:
        """Return a task for each piece."""
        return [replace(self, pieces=(one,)) for one in self.pieces]


def run_units(
    function: Callable[[T], TaskResult],
    tasks: Sequence[T],
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None],
) -> list[tuple[str, str]]:
    """Run all tasks and store their records; return units that failed, with the reason."""
    total = sum(len(task.units) for task in tasks)
    failures: list[tuple[str, str]] = []
    again: list[T] = []
    finished = 0
    report(0, total)

    def rounds() -> Iterator[Sequence[T]]:
        yield tasks
        if again:
            yield again

    for some in rounds():
        for done in compute.map(function, some):
            if done.result is not None:
                manifest.add_packed(done.result.records)
                manifest.doubt_files(done.result.damaged)
                failures += done.result.failures
            elif len(done.task.units) > 1:
                again += done.task.singly()
                continue
            else:
                failures.append((done.task.units[0], reason_of(done.error)))
            finished += len(done.task.units)
            report(finished, total)
    manifest.settle()
    return failures


def tiles_beside(line: RoadLine, from_m: float, to_m: float, away_m: float, grid: TileGrid) -> list[TileId]:
    """Return tiles within a distance of a line between two stations, by row and column."""
    station = np.arange(from_m, to_m + 1.0)
    return tiles_of(shapely.LineString(line.places(station, 0.0)[:, :2]).buffer(away_m), grid)


def tiles_of(strip: shapely.Polygon, grid: TileGrid) -> list[TileId]:
    """Return tiles that a strip meets, by row and column."""
    boxes = [(t, grid.bounds(t)) for t in grid.tiles_in(Bounds(*strip.bounds))]
    shapes = [shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m) for _, b in boxes]
    return [t for (t, _), shape in zip(boxes, shapes, strict=True) if strip.intersects(shape)]
