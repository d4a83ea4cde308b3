"""Work on pictures of assets: objects by square, the pictures that may show them, and tasks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.pictures.reader import ColourReader, picture_readers
from roadscan.assets.settings import AssetPicturesSettings, picture_rule
from roadscan.assets.tasks.evidence import SCREENS
from roadscan.assets.tasks.objects import OBJECTS
from roadscan.assets.tasks.plan import AssetPlan
from roadscan.assets.tiling import AssetGrid
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.grid import Bounds, TileId
from roadscan.pictures.placed import Pictures, plan_pictures
from roadscan.run.code_reach import code_digest, name_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import bytes_digest, file_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.store import Store

SEEN: Final = "asset_pictures"
"""Manifest name of what pictures show of a kind's objects in a square."""
CUT_OUTS: Final = "asset_cut_outs"
"""Manifest name of the files that were cut out."""
_BEYOND_M: Final = 10.0
"""Objects reach this far (m) beyond the square of their place."""


@dataclass(frozen=True)
class SquareObjects:
    """Objects of a kind whose place lies in a square."""

    kind: str
    square: TileId
    box: Bounds
    """Box of all that pictures must show of them."""
    objects: tuple[OutputRecord, ...]
    """Files that contain them, among others."""
    key: str = ""

    @property
    def unit(self) -> str:
        """Returns its name in the manifest."""
        return f"{self.kind}/{self.square}"


@dataclass(frozen=True)
class PictureTask:
    """Objects of some neighbouring squares to be searched in pictures. Sent to workers: it carries no picture."""

    store: Store
    grid: AssetGrid
    work: tuple[SquareObjects, ...]
    pictures: Pictures
    screens: tuple[tuple[TileId, OutputRecord], ...]
    """Occluders in these squares and around them."""
    settings: AssetPicturesSettings
    recogniser: Path | None

    @property
    def units(self) -> tuple[str, ...]:
        """Returns their names."""
        return tuple(one.unit for one in self.work)

    def singly(self) -> list[PictureTask]:
        """Returns a task for each."""
        return [
            PictureTask(self.store, self.grid, (w,), self.pictures, self.screens, self.settings, self.recogniser)
            for w in self.work
        ]


@dataclass(frozen=True)
class PicturePlan:
    """Work to be done on pictures."""

    work: tuple[SquareObjects, ...] = ()
    pictures: Pictures | None = None
    notes: tuple[str, ...] = field(default=())
    """Notes on why nothing is searched, or what is left out."""

    def due(self, manifest: Manifest) -> list[SquareObjects]:
        """Returns what is missing or stale, with the files of cut-outs."""
        return [one for one in self.work if not _is_current(one, manifest)]

    def gone(self, manifest: Manifest) -> list[OutputRecord]:
        """Returns outputs of squares and objects that no longer exist."""
        held = manifest.of(SEEN)
        files = {unit for one in self.work if one.unit in held for unit in cut_outs_of(held[one.unit])}
        return [*manifest.beside({SEEN}, {one.unit for one in self.work}), *manifest.beside({CUT_OUTS}, files)]

    def records(self, kind: str, manifest: Manifest) -> tuple[OutputRecord, ...]:
        """Returns the records of a kind, by square."""
        held = manifest.of(SEEN)
        return tuple(held[one.unit] for one in self.work if one.kind == kind and one.unit in held)

    def unreadable(self, manifest: Manifest) -> list[str]:
        """Returns names of pictures that could not be read, each with the reason where that is known."""
        held = manifest.of(SEEN)
        records = (held[one.unit] for one in self.work if one.unit in held)
        return sorted({str(name) for r in records for name in r.figures().get("unreadable", ())})


def cut_outs_of(record: OutputRecord) -> list[str]:
    """Returns units of the files of cut-outs of a record's objects."""
    return [str(name) for name in record.figures().get("cut_outs", ())]


def _is_current(one: SquareObjects, manifest: Manifest) -> bool:
    record = manifest.get(SEEN, one.unit)
    if record is None or not manifest.is_current(SEEN, one.unit, one.key):
        return False
    return all(manifest.is_current(CUT_OUTS, unit, one.key) for unit in cut_outs_of(record))


def plan_asset_pictures(plan: AssetPlan, manifest: Manifest) -> PicturePlan:
    """Returns objects and the pictures that may show them; none where the survey has no pictures."""
    if not plan.wants_pictures:
        return PicturePlan()
    settings = plan.config.pictures
    try:
        pictures = plan_pictures(plan.survey, picture_rule(settings))
    except (ConfigError, RunError) as error:
        if settings.cameras or settings.recogniser is not None or settings.text:
            raise
        return PicturePlan(notes=(f"assets name no pictures: {error}",))
    screens = {TileId.parse(unit): record for unit, record in manifest.of(SCREENS).items() if record.path}
    said = settings.model_dump(mode="json", exclude={"recogniser"})
    model = "" if settings.recogniser is None else file_digest(plan.survey.survey.resolve(settings.recogniser))
    near: dict[Bounds, str] = {}
    work = []
    for wanted in plan.kinds:
        reader = picture_readers().get(wanted.name)
        code = code_digest(
            "roadscan.assets.tasks.pictures:find_pictures", *(() if reader is None else (name_of(type(reader)),))
        )
        for one, content in _objects(plan, wanted.name, manifest, reaches=isinstance(reader, ColourReader)):
            if one.box not in near:
                near[one.box] = pictures.near(one.box).key()
            hides = [r.digest for _, r in around(one.square, screens, plan.grid, settings.reach_m)]
            key = key_of(code, said, model, content, near[one.box], hides, plan.grid.edge_m)
            work.append(SquareObjects(one.kind, one.square, one.box, one.objects, key))
    return PicturePlan(tuple(work), pictures, pictures.notes)


def picture_tasks(
    plan: AssetPlan, pictures: Pictures, due: Sequence[SquareObjects], manifest: Manifest, workers: int = 1
) -> list[PictureTask]:
    """Returns tasks over neighbouring squares, which share pictures."""
    settings, survey = plan.config.pictures, plan.survey.survey
    screens = {TileId.parse(unit): record for unit, record in manifest.of(SCREENS).items() if record.path}
    model = None if settings.recogniser is None else survey.resolve(settings.recogniser)
    tasks = []
    for squares in plan.blocks(sorted({one.square for one in due}, key=lambda t: (t.row, t.column)), workers):
        chosen = set(squares)
        own = tuple(one for one in due if one.square in chosen)
        hides = {s: r for square in squares for s, r in around(square, screens, plan.grid, settings.reach_m)}
        near = pictures.near(*(one.box for one in own))
        tasks.append(
            PictureTask(plan.survey.store, plan.grid, own, near, tuple(sorted(hides.items(), key=lambda h: h[0])),
                        settings, model)
        )  # fmt: skip
    return tasks


def around(
    square: TileId, screens: dict[TileId, OutputRecord], grid: AssetGrid, reach_m: float
) -> list[tuple[TileId, OutputRecord]]:
    """Returns occluders in a square and in those within reach of it, by row and column."""
    rings = math.ceil((reach_m + _BEYOND_M) / grid.edge_m)
    steps = range(-rings, rings + 1)
    names = (TileId(square.column + c, square.row + r) for r in steps for c in steps)
    return [(name, screens[name]) for name in names if name in screens]


def _objects(
    plan: AssetPlan, kind: str, manifest: Manifest, *, reaches: bool
) -> list[tuple[SquareObjects, str]]:  # fmt: skip
    """Returns objects of a kind by the square of their place, each with a digest of all that is known of them.

    reaches : the whole of a line or area is searched, not its place alone.
    """
    held = [r for unit, r in sorted(manifest.of(OBJECTS).items()) if unit.startswith(f"{kind}/") and r.path]
    parts: dict[TileId, list[tuple[OutputRecord, pa.Table]]] = {}
    for record in held:
        rows = recorded_table(plan.survey.store, record)
        for square, own in rows_by_square(rows, plan.grid):
            parts.setdefault(square, []).append((record, own))
    found = []
    for square in sorted(parts, key=lambda t: (t.row, t.column)):
        rows = pa.concat_tables([own for _, own in parts[square]])
        own = plan.grid.squares.bounds(square)
        box = Bounds(
            own.easting_min_m - _BEYOND_M, own.northing_min_m - _BEYOND_M,
            own.easting_max_m + _BEYOND_M, own.northing_max_m + _BEYOND_M,
        )  # fmt: skip
        if reaches:
            west, south, east, north = shapely.total_bounds(shapely.from_wkb(rows["geometry"].to_numpy())).tolist()
            box = Bounds(west - _BEYOND_M, south - _BEYOND_M, east + _BEYOND_M, north + _BEYOND_M)
        records = tuple(record for record, _ in parts[square])
        found.append((SquareObjects(kind, square, box, records), _digest(rows)))
    return found


def rows_by_square(rows: pa.Table, grid: AssetGrid) -> list[tuple[TileId, pa.Table]]:
    """Returns rows of objects by the square of their place, in the order of the rows."""
    places = np.column_stack([rows["easting_m"].to_numpy(), rows["northing_m"].to_numpy()])
    number = np.floor(places / grid.edge_m).astype(np.int64)
    squares, owner = np.unique(number, axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    return [
        (TileId(int(column), int(row)), rows.take(pa.array(np.flatnonzero(owner == n))))
        for n, (column, row) in enumerate(squares.tolist())
    ]


def _digest(rows: pa.Table) -> str:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema) as stream:
        stream.write_table(rows.combine_chunks())
    return bytes_digest(sink.getvalue().to_pybytes())
