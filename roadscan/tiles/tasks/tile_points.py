"""Loads the points of a task's tiles, for products, filters and clouds that need single points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import QUANTUM_M, TileId
from roadscan.georeference.cloud import TilePoints, canonical_order, fill_of
from roadscan.georeference.place import EXTRA_COLUMNS, Georeferenced, Window, passes_of
from roadscan.georeference.plan.road import CentreLineBuffer, load_buffer
from roadscan.georeference.reading_counts import ReadingCounts
from roadscan.georeference.road_profiles import KEPT, LAS_CLASSES, OFF_CENTRE_LINE, WITHHELD_FLAG
from roadscan.georeference.sources import Georeferencer, MapSettings, RawSlice, ReadingSource
from roadscan.poses.trajectory import Trajectory
from roadscan.tiles.cells import TileEvidence
from roadscan.tiles.tasks.tile_plan import TileTask


@dataclass(frozen=True)
class LoadedTile:
    """Points of a tile."""

    tile: TileId
    points: TilePoints | None
    """Points that passed all filters; None without any."""
    marked: TilePoints | None
    """Points that a filter leaves out; None without any, or where the survey does not keep them."""
    evidence: TileEvidence | None
    """Evidence of the poses that georeferenced the points; None without any."""


def load_points(task: TileTask) -> Iterator[tuple[TileId, TilePoints]]:
    """Yield the points of every tile of block and halo that has any: filtered, in canonical order, tile by tile."""
    for loaded in load_tiles(task, ReadingCounts()):
        if loaded.points is not None:
            yield loaded.tile, loaded.points


def load_tiles(task: TileTask, fates: ReadingCounts) -> Iterator[LoadedTile]:
    """Yield the same as :func:`load_points`, with filtered points where the survey keeps them marked."""
    box = task.block.box()
    buffer = None if task.centre_lines is None else load_buffer(task.centre_lines, task.ground.map)
    parts = _Parts()
    placer = Georeferencer(task.store, task.ground, task.slices)
    owners = {(s, k): tile for s, k, tile in task.owned}
    for number, one in enumerate(task.slices):
        own = [p for p in task.passes if p.run == one.source.run]
        for owner, piece in _by_owner(one, [owners.get((number, k)) for k in range(len(one.groups))]):
            for _, placed in placer.place(piece, Window(*box)):
                if owner is not None and one.source.table != "cloud":
                    fates.add(owner, one.file, placed.fates)
                if placed.epoch_gps_ns.size:
                    passes = passes_of(placed.epoch_gps_ns, own)
                    parts.add(one.source, placed, passes, placer.trajectory(one.source))
    if not parts.placed:
        return
    joined = parts.join()
    width = box[2] - box[0]
    local = (joined.tiles[:, 1] - box[1]) * width + (joined.tiles[:, 0] - box[0])
    ends = np.cumsum(np.bincount(local, minlength=width * (box[3] - box[1])))
    kind = np.uint16 if ends.size <= 1 << 16 else np.uint32  # 16 bits, for a radix sort
    order = np.argsort(local.astype(kind), kind="stable").astype(np.int32)
    del local
    for tile in sorted(task.block.with_halo(), key=lambda t: (t.row, t.column)):
        index = (tile.row - box[1]) * width + (tile.column - box[0])
        rows = order[ends[index - 1] if index else 0 : ends[index]]
        rows = rows[joined.passes[rows] > 0]
        if rows.size:
            yield _loaded(tile, rows, joined, buffer, task.ground)


def _by_owner(one: RawSlice, owners: Sequence[TileId | None]) -> Iterator[tuple[TileId | None, RawSlice]]:
    """Yield pieces of a slice whose groups are reported by the same tile, or by none of the task."""
    start = 0
    for end in range(1, len(owners) + 1):
        if end == len(owners) or owners[end] != owners[start]:
            share = one.bytes * (end - start) // len(owners)
            yield owners[start], RawSlice(one.source, one.file, one.groups[start:end], one.spans, share)
            start = end


def _loaded(
    tile: TileId,
    rows: npt.NDArray[np.int32],
    joined: _Joined,
    buffer: CentreLineBuffer | None,
    ground: MapSettings,
) -> LoadedTile:
    """Return the points of a tile at `rows` of the block, filtered points separately."""
    near = None if buffer is None else near_lines(tile, joined.quanta[rows], buffer, ground)
    if joined.classes is None:
        rows = rows if near is None else rows[near]
        return LoadedTile(tile, joined.tile(tile, rows) if rows.size else None, None, joined.evidence(rows))
    classes = joined.classes[rows]
    if near is not None:
        classes[(classes == KEPT) & ~near] = OFF_CENTRE_LINE
    kept, left = rows[classes == KEPT], rows[classes != KEPT]
    marked = joined.tile(tile, left, LAS_CLASSES[classes[classes != KEPT]]) if left.size else None
    return LoadedTile(tile, joined.tile(tile, kept) if kept.size else None, marked, joined.evidence(kept))


class _Parts:
    """Collects the georeferenced readings of a block, with their pass and source."""

    def __init__(self) -> None:
        self.placed: list[Georeferenced] = []
        self._passes: list[npt.NDArray[np.uint16]] = []
        self._sources: list[npt.NDArray[np.uint16]] = []
        self._numbers: dict[str, int] = {}
        self._profiles: list[bool] = []
        self.trajectories: list[Trajectory | None] = []

    def add(
        self,
        source: ReadingSource,
        placed: Georeferenced,
        passes: npt.NDArray[np.uint16],
        trajectory: Trajectory | None,
    ) -> None:
        """Add a chunk of one source; sources are numbered as they come."""
        number = self._numbers.setdefault(source.key, len(self._numbers))
        if number == len(self._profiles):
            self._profiles.append(source.table == "scans")
            self.trajectories.append(trajectory)
        self.placed.append(placed)
        self._passes.append(passes)
        self._sources.append(np.full(passes.size, number, np.uint16))

    def join(self) -> _Joined:
        """Join all chunks into one set of arrays; the chunks are freed, so that memory has each point once."""
        placed, self.placed = self.placed, []
        extra = {c: v for c in EXTRA_COLUMNS if (v := _joined_extra(placed, c)) is not None}
        lacking = {c: _lacks(placed, c) for c in extra if any(c not in p.extra for p in placed)}
        columns: dict[str, npt.NDArray[Any]] = {}
        for name in ("tiles", "quanta", "epoch_gps_ns", "intensity", "classification"):
            columns[name] = np.concatenate([getattr(p, name) for p in placed])
        marks = [p.classes for p in placed if p.classes is not None]
        classes = np.concatenate(marks) if marks else None
        placed.clear()
        return _Joined(
            passes=np.concatenate(self._passes),
            sources=np.concatenate(self._sources),
            profiles=np.array(self._profiles),
            trajectories=self.trajectories,
            extra=extra,
            lacking=lacking,
            classes=classes,
            **columns,
        )


@dataclass(frozen=True)
class _Joined:
    """Georeferenced readings of a block, in the order they were loaded."""

    tiles: npt.NDArray[np.int32]
    quanta: npt.NDArray[np.int32]
    epoch_gps_ns: npt.NDArray[np.int64]
    intensity: npt.NDArray[np.uint16]
    classification: npt.NDArray[np.uint8]
    passes: npt.NDArray[np.uint16]
    sources: npt.NDArray[np.uint16]
    profiles: npt.NDArray[np.bool_]
    """(sources,) True for scans."""
    trajectories: Sequence[Trajectory | None]
    """Trajectory of each source; None for clouds."""
    extra: dict[str, npt.NDArray[Any]]
    lacking: dict[str, npt.NDArray[np.bool_]]
    """(n,) True for points without a recorded value, for columns that some points lack."""
    classes: npt.NDArray[np.uint8] | None
    """(n,) class of each reading, where filtered readings are included."""

    def evidence(self, rows: npt.NDArray[np.integer[Any]]) -> TileEvidence | None:
        """Return the epochs of the points at `rows`, and the σ of their poses; None without any."""
        if rows.size == 0:
            return None
        sources, epochs = self.sources[rows], self.epoch_gps_ns[rows]
        sigma = np.full(2, -1.0)
        for number in np.flatnonzero(np.bincount(sources)).tolist():
            trajectory = self.trajectories[number]
            if trajectory is None:
                sigma[:] = np.inf
                continue
            ends = trajectory.epochs_gps_ns
            interval = np.searchsorted(ends, epochs[sources == number], side="right") - 1
            held = np.flatnonzero(np.bincount(np.clip(interval, 0, ends.size - 2)))
            sigma = np.maximum(sigma, trajectory.interval_sigmas_m()[held].max(axis=0))
        return TileEvidence(int(epochs.min()), int(epochs.max()), float(sigma[0]), float(sigma[1]))

    def tile(
        self,
        tile: TileId,
        rows: npt.NDArray[np.integer[Any]],
        marks: npt.NDArray[np.uint8] | None = None,
    ) -> TilePoints:
        """Return the points of one tile, in canonical order; with `marks` (n,), their classes, they are withheld."""
        sources = self.sources[rows]
        # A tile has the columns of its points, whatever else was loaded with it.
        extra = {c: v for c, v in self.extra.items() if c not in self.lacking or not self.lacking[c][rows].all()}
        content = [*extra.values(), self.quanta, self.intensity, self.classification]
        order = canonical_order(
            sources, self.epoch_gps_ns[rows], self.profiles[sources], lambda: [c[rows] for c in content]
        )
        if order is not None:
            rows = rows[order]
            marks = None if marks is None else marks[order]
        recorded = {c: v[rows] for c, v in extra.items()}
        if marks is not None:
            recorded["flags"] = recorded.get("flags", np.zeros(rows.size, np.uint8)) | np.uint8(WITHHELD_FLAG)
        quanta = self.quanta[rows]
        return TilePoints(
            tile=tile,
            x_quanta=np.ascontiguousarray(quanta[:, 0]),
            y_quanta=np.ascontiguousarray(quanta[:, 1]),
            height_quanta=np.ascontiguousarray(quanta[:, 2]),
            epoch_gps_ns=self.epoch_gps_ns[rows],
            intensity=self.intensity[rows],
            classification=self.classification[rows] if marks is None else marks,
            pass_id=self.passes[rows],
            extra=recorded,
        )


def _joined_extra(parts: list[Georeferenced], column: str) -> npt.NDArray[Any] | None:
    known = [p.extra[column] for p in parts if column in p.extra]
    if not known:
        return None
    kind = known[0].dtype
    return np.concatenate([p.extra.get(column, fill_of(column, p.epoch_gps_ns.size, kind)) for p in parts])


def _lacks(parts: list[Georeferenced], column: str) -> npt.NDArray[np.bool_]:
    return np.concatenate([np.full(p.epoch_gps_ns.size, column not in p.extra) for p in parts])


def near_lines(
    tile: TileId, quanta: npt.NDArray[np.int32], buffer: CentreLineBuffer, ground: MapSettings
) -> npt.NDArray[np.bool_]:
    """Return which points (n, …) of a tile lie near the centre lines; `quanta` from the tile's corner."""
    b = ground.grid.bounds(tile)
    easting = b.easting_min_m + quanta[:, 0].astype(np.float64) * QUANTUM_M
    northing = b.northing_min_m + quanta[:, 1].astype(np.float64) * QUANTUM_M
    return buffer.keeps(easting, northing, (b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m))
