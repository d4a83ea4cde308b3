"""Evidence: returns of a square and its halo → its scene → pieces of each kind, classified points, bare earth."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.assets.files.squares import classified_points, write_bare_earth, write_classified
from roadscan.assets.green.cells import ground_cells
from roadscan.assets.ground.bare_earth import within
from roadscan.assets.intensity import calibrated_scene
from roadscan.assets.kind import AssetKind, Evidence, Marked, asset_kinds
from roadscan.assets.scene import Scene, Statistics
from roadscan.assets.settings import GroundSettings
from roadscan.assets.tasks.gains import Shared
from roadscan.assets.tasks.load_returns import LoadedSquare, ReturnsTask, load_squares, scene_of
from roadscan.assets.tasks.plan import AssetPlan
from roadscan.assets.visibility import CELL_M, passes_in_sight, screens_of
from roadscan.core.errors import SchemaError
from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.run.engine.compute import reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.run.stage import WORKER_BASE_BYTES
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, publish_file
from roadscan.tiles.tasks.tile_plan import Block
from roadscan.tiles.tasks.tiles import TaskResult

EVIDENCE: Final = "asset_evidence"
"""Manifest name of the pieces of a kind in a square."""
CLASSIFIED: Final = "classified_points"
BARE_EARTH: Final = "bare_earth"
SCREENS: Final = "asset_screens"
"""Manifest name of the occluders of views."""
GROUND: Final = "asset_ground"
"""Manifest name of the cells of the ground that pictures may show."""
VISIBILITY: Final = "asset_visibility"
"""Cells of a square, and how many passes had them in sight."""


def evidence_unit(kind: str, square: TileId) -> str:
    """Returns the name of a kind's evidence of a square in the manifest."""
    return f"{kind}/{square}"


@dataclass(frozen=True)
class SquareWork:
    """Outputs that are due of a square; empty keys mean that none is due."""

    square: TileId
    kinds: tuple[tuple[str, str], ...]
    """Names of the kinds whose evidence is due, with its key."""
    beside: Mapping[str, str]
    """Other outputs that are due: the key of each, by its name in the manifest."""


@dataclass(frozen=True)
class EvidenceTask:
    """Some neighbouring squares to be searched. Sent to workers: it carries no data."""

    load: ReturnsTask
    work: tuple[SquareWork, ...]
    together: tuple[tuple[TileId, ...], ...]
    """Its squares by scene; those of a scene that are not due are loaded with them."""
    kinds: tuple[tuple[str, Strict], ...]
    """All kinds of the survey with their settings: the classes of points come from all of them."""
    ground: GroundSettings
    shared: Shared | None
    """Gains of the intensity, and statistics of the survey."""
    context: ProductContext

    @property
    def block(self) -> Block:
        """Returns the squares."""
        return Block(tuple(one.square for one in self.work))

    @property
    def store(self) -> Store:
        """Returns the store of the survey."""
        return self.load.readings.store


def due_squares(
    plan: AssetPlan, manifest: Manifest, shared: Shared | None, forced: Sequence[TileId] = ()
) -> list[SquareWork]:
    """Returns the missing or stale outputs of each square, and all of those that are forced."""
    told = "" if shared is None else shared.key
    kind_keys = {one.name: key_of(one.evidence_key(), told) for one in plan.kinds}
    code = key_of(code_digest("roadscan.assets.tasks.evidence:find_evidence"), told)
    anew = set(forced)
    found: list[SquareWork] = []
    for square, key in plan.keys.items():
        unit = str(square)
        keys = {name: key_of(own, key) for name, own in kind_keys.items()}
        beside = {VISIBILITY: key_of(code, key)}
        if plan.config.classified:
            beside[CLASSIFIED] = key_of(code, key, sorted(keys.items()), plan.context.survey_id)
        if plan.config.bare_earth:
            beside[BARE_EARTH] = key_of(code, key, plan.context.survey_id)
        if plan.wants_pictures:
            beside |= {name: key_of(code, key, name) for name in (SCREENS, GROUND)}
        if square not in anew:
            keys = {n: k for n, k in keys.items() if not manifest.is_current(EVIDENCE, evidence_unit(n, square), k)}
            beside = {name: k for name, k in beside.items() if not manifest.is_current(name, unit, k)}
        if keys or beside:
            found.append(SquareWork(square, tuple(keys.items()), beside))
    return found


def evidence_tasks(
    plan: AssetPlan, due: Sequence[SquareWork], shared: Shared | None, workers: int = 1
) -> list[EvidenceTask]:
    """Returns tasks over the squares of which anything is due."""
    blocks: dict[int, list[TileId]] = {}
    number = {one: k for k, block in enumerate(plan.blocks([one.square for one in due], workers)) for one in block}
    first = {plan.together[square]: k for square, k in reversed(number.items())}
    for one in due:  # what one scene holds is searched by one task
        blocks.setdefault(first[plan.together[one.square]], []).append(one.square)
    return [_task(plan, due, shared, tuple(squares)) for _, squares in sorted(blocks.items())]


_BYTES_PER_SCENE_RETURN: Final = 400
"""Measured memory of a worker per return of its largest scene (bytes)."""
_BYTES_PER_BLOCK_RETURN: Final = 30
"""Memory per return of all squares of a task, which stay placed while one scene after another is searched (bytes)."""


def memory_of(plan: AssetPlan, tasks: Sequence[EvidenceTask]) -> int:
    """Returns the approximate memory (bytes) that a worker needs for the largest of some tasks."""

    def returns(squares: Iterable[TileId]) -> int:
        return sum(plan.readings[one] for one in squares)

    largest = max(
        _BYTES_PER_BLOCK_RETURN * returns(task.load.squares)
        + _BYTES_PER_SCENE_RETURN * max(map(returns, task.together))
        for task in tasks
    )
    return WORKER_BASE_BYTES + largest


def singly(
    plan: AssetPlan, due: Sequence[SquareWork], shared: Shared | None, squares: Sequence[TileId]
) -> list[EvidenceTask]:
    """Returns a task for each square."""
    return [_task(plan, due, shared, (square,)) for square in squares]


def _task(
    plan: AssetPlan, due: Sequence[SquareWork], shared: Shared | None, squares: tuple[TileId, ...]
) -> EvidenceTask:
    chosen = set(squares)
    together = tuple(dict.fromkeys(plan.together[square] for square in squares))
    return EvidenceTask(
        plan.load(tuple(square for one in together for square in one)),
        tuple(one for one in due if one.square in chosen), together,
        tuple((one.name, one.options) for one in plan.kinds), plan.config.ground, shared, plan.context,
    )  # fmt: skip


def find_evidence(task: EvidenceTask) -> TaskResult:
    """Search the squares of a task and write what is due of them (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    due = {one.square: one for one in task.work}
    store, grid = task.store, task.load.grid
    gains = None if task.shared is None else task.shared.read_gains(store)
    statistics = Statistics() if task.shared is None else task.shared.read_statistics(store)
    with store.scratch() as folder:
        for loaded in load_squares(task.load, task.together):
            own = [due[square] for square in loaded.squares if square in due]
            try:
                scenes = _scenes(task, loaded, gains, statistics) if len(loaded.returns) else None
            except Exception as error:  # noqa: BLE001  a scene's fault must not stop the others
                failures += [(str(work.square), reason_of(error)) for work in own]
                continue
            origin_m = loaded.returns.corner_m
            loaded = None  # type: ignore[assignment]  # noqa: PLW2901  frees its memory
            for work in own:
                search = _Search(task, work, folder)
                try:
                    if scenes is None:
                        records += search.nothing()
                    else:
                        tile = grid.box_from(origin_m, work.square)
                        records += search.records(*(scene.of_tile(tile) for scene in scenes))
                    failures += search.failures
                except Exception as error:  # noqa: BLE001  one square's fault must not stop the others
                    failures.append((str(work.square), reason_of(error)))
            scenes = None
    return TaskResult.of(records, failures)


def _scenes(task: EvidenceTask, loaded: LoadedSquare, gains: pa.Table | None, statistics: Statistics) -> list[Scene]:
    """Returns the scene of squares with recorded intensities, and with those that kinds look at."""
    scene = scene_of(task.load.grid, loaded, task.ground, statistics)
    return [scene, scene if gains is None else calibrated_scene(scene, gains)]


class _Search:
    """One square during its search, from its scene to files."""

    def __init__(self, task: EvidenceTask, work: SquareWork, folder: Path) -> None:
        self._task, self._work, self._folder = task, work, folder
        self.failures: list[tuple[str, str]] = []

    def records(self, scene: Scene, seen: Scene) -> Iterator[OutputRecord]:
        """Write what is due, kind by kind; `seen` has the intensities that kinds look at."""
        keys = dict(self._work.kinds)
        marked: list[Marked] = []
        for name, options in self._task.kinds:
            if name not in keys and CLASSIFIED not in self._work.beside:
                continue
            try:
                kind = asset_kinds()[name]
                found = kind.evidence(seen, options)
                if name in keys:
                    yield self._write_pieces(kind, found, keys[name])
                marked += found.marked
            except Exception as error:  # noqa: BLE001  one kind's fault must not stop the others
                self.failures.append((evidence_unit(name, self._work.square), reason_of(error)))
        writers = {
            BARE_EARTH: self._write_bare_earth, SCREENS: self._write_screens, GROUND: self._write_ground,
            VISIBILITY: self._write_visibility,
        }  # fmt: skip
        for product, write in writers.items():
            if product in self._work.beside:
                yield write(scene, self._work.beside[product])
        if CLASSIFIED in self._work.beside and not self.failures:
            yield self._write_classified(scene, marked, self._work.beside[CLASSIFIED])

    def nothing(self) -> Iterator[OutputRecord]:
        """Yields records of a square without returns: finished, and no file."""
        for name, key in self._work.kinds:
            yield OutputRecord(EVIDENCE, evidence_unit(name, self._work.square), key, "", 0, "", _told(0))
        for product, key in self._work.beside.items():
            yield OutputRecord(product, str(self._work.square), key, "", 0, "", _told(0))

    def _write_pieces(self, kind: AssetKind, found: Evidence, key: str) -> OutputRecord:
        unit = evidence_unit(kind.name, self._work.square)
        return self._write_rows(EVIDENCE, unit, key, conformed(found.pieces, kind), found.counts)

    def _write_rows(
        self, product: str, unit: str, key: str, rows: pa.Table, counts: Mapping[str, int] | None = None
    ) -> OutputRecord:
        """Write rows as the table of that name; without any there is no file. The record stores `counts`, too."""
        told = _told(rows.num_rows, **(counts or {}))
        if not rows.num_rows:
            return OutputRecord(product, unit, key, "", 0, "", told)
        path = self._folder / f"{product}.parquet"
        pq.write_table(rows, path, compression="zstd", write_page_checksum=True, version="2.6")
        target = f"tables/{product}/{unit}.parquet"
        return publish_file(self._task.store, path, target, product, unit, key, told)

    def _write_bare_earth(self, scene: Scene, key: str) -> OutputRecord:
        square = self._work.square
        model = within(scene.ground, scene.tile)
        known = 0 if model is None else int(np.count_nonzero(~np.isnan(model.height_m)))
        if model is None or not known:
            return OutputRecord(BARE_EARTH, str(square), key, "", 0, "", _told(0))
        path = self._folder / "bare_earth.tif"
        write_bare_earth(path, model, scene.returns.corner_m, self._task.context)
        detail = json.dumps({"cells": known, "seen": int(np.count_nonzero(model.seen))})
        target = f"products/{BARE_EARTH}/{square}.tif"
        return publish_file(self._task.store, path, target, BARE_EARTH, str(square), key, detail)

    def _write_screens(self, scene: Scene, key: str) -> OutputRecord:
        return self._write_rows(SCREENS, str(self._work.square), key, screens_of(scene))

    def _write_ground(self, scene: Scene, key: str) -> OutputRecord:
        return self._write_rows(GROUND, str(self._work.square), key, ground_cells(scene))

    def _write_visibility(self, scene: Scene, key: str) -> OutputRecord:
        unit, schema = str(self._work.square), table_schema(VISIBILITY)
        rows = visibility_rows(scene)
        if not rows.num_rows:
            return OutputRecord(VISIBILITY, unit, key, "", 0, "", _told(0))
        path = self._folder / "visibility.parquet"
        path.write_bytes(parquet_bytes(rows, schema))
        target = f"{schema.location}/{unit}.parquet"
        return publish_file(self._task.store, path, target, VISIBILITY, unit, key, _told(rows.num_rows))

    def _write_classified(self, scene: Scene, marked: Sequence[Marked], key: str) -> OutputRecord:
        square = self._work.square
        own = np.flatnonzero(scene.tile.holds(scene.returns.x_m, scene.returns.y_m))
        if not own.size:
            return OutputRecord(CLASSIFIED, str(square), key, "", 0, "", _told(0))
        classes = marked_classes(scene, marked)
        points = classified_points(scene.returns.at(own), classes[own], square, scene.tile)
        path = self._folder / "points.laz"
        write_classified(path, points, self._task.load.grid.squares, self._task.context)
        target = f"products/{CLASSIFIED}/{square}.laz"
        return publish_file(self._task.store, path, target, CLASSIFIED, str(square), key, _told(len(points)))


def visibility_rows(scene: Scene) -> pa.Table:
    """Cells that passes had in sight, as rows of the table `asset_visibility`; its metadata states their edge."""
    schema = table_schema(VISIBILITY).arrow()
    return passes_in_sight(scene).cast(schema).replace_schema_metadata({"edge_m": str(CELL_M)})


def marked_classes(scene: Scene, marked: Sequence[Marked]) -> npt.NDArray[np.uint8]:
    """Returns classes (n,) of the scene's returns, with those that kinds give to the returns of their pieces.

    A return that two kinds mark gets the class of the last one.
    """
    classes = scene.classes.copy()
    for one in marked:
        classes[one.rows] = one.code
    return classes


def conformed(pieces: pa.Table, kind: AssetKind) -> pa.Table:
    """Returns pieces in the kind's schema; SchemaError where they do not fit it."""
    if pieces.schema.names != kind.piece_schema.names:
        raise SchemaError(
            f"pieces of '{kind.name}' have the columns {', '.join(pieces.schema.names)}",
            expected=", ".join(kind.piece_schema.names),
        )
    return pieces.cast(kind.piece_schema)


def _told(count: int, **more: Any) -> str:
    return json.dumps({"count": count, **more})
