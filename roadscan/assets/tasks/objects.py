"""Objects: pieces of neighbouring squares, joined kind after kind; only changed clusters are joined again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import pyarrow as pa

from roadscan.assets.kind import AssetObject, asset_kinds, objects_of_table, table_of_objects
from roadscan.assets.probabilities import curve_named
from roadscan.assets.tasks.evidence import EVIDENCE
from roadscan.assets.tasks.plan import WantedKind
from roadscan.assets.tiling import AssetGrid
from roadscan.core.errors import RunError
from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import key_of
from roadscan.store.asset_schema import asset_schema
from roadscan.store.manifest import Manifest, OutputRecord, publish_table, recorded_table
from roadscan.store.store import Store
from roadscan.tiles.tasks.tiles import TaskResult

OBJECTS: Final = "asset_objects"
GREEN: Final = "asset_green"
"""Manifest name of the planted cells of a square that pictures tell."""
PAINTED: Final = "asset_painted"
"""Manifest name of the paint of a square that pictures show."""
GREY_EDGES: Final = "asset_grey_edges"
"""Manifest name of the edges between grey surfaces of a square that pictures show."""


@dataclass(frozen=True)
class Cluster:
    """Squares that touch one another and contain pieces of a kind: an object lies within one cluster."""

    kind: str
    squares: tuple[TileId, ...]
    """By row and column."""

    @property
    def unit(self) -> str:
        """Returns its name in the manifest."""
        return f"{self.kind}/{self.squares[0]}"

    def meets(self, squares: set[TileId]) -> bool:
        """Returns whether one of its squares is among others."""
        return not squares.isdisjoint(self.squares)

    def near(self) -> set[TileId]:
        """Returns its squares and those around them."""
        around = (-1, 0, 1)
        return {TileId(s.column + c, s.row + r) for s in self.squares for c in around for r in around}


@dataclass(frozen=True)
class JoinTask:
    """A cluster of pieces to be joined. Sent to workers: it carries no data."""

    store: Store
    grid: AssetGrid
    cluster: Cluster
    options: Strict
    pieces: tuple[OutputRecord, ...]
    """Evidence of its squares, in their order."""
    others: tuple[tuple[str, tuple[OutputRecord, ...]], ...]
    """Objects of other kinds near it, which this one uses."""
    key: str
    pictured: tuple[OutputRecord, ...] = ()
    """Green ground or paint of its squares in pictures, for kinds that use it."""
    edges: tuple[OutputRecord, ...] = ()
    """Edges between grey surfaces of its squares in pictures, likewise."""

    @property
    def units(self) -> tuple[str, ...]:
        """Returns its one unit."""
        return (self.cluster.unit,)

    def singly(self) -> list[JoinTask]:
        """Returns itself: it cannot be divided."""
        return [self]


@dataclass(frozen=True)
class JoinPlan:
    """Clusters of a kind."""

    tasks: tuple[JoinTask, ...] = ()
    gone: tuple[OutputRecord, ...] = field(default=())
    """Objects of clusters that no longer exist."""

    def due(self, manifest: Manifest) -> list[JoinTask]:
        """Returns those that are missing or stale."""
        return [t for t in self.tasks if not manifest.is_current(OBJECTS, t.cluster.unit, t.key)]


def plan_joins(
    store: Store, grid: AssetGrid, wanted: WantedKind, manifest: Manifest, clusters: dict[str, list[Cluster]]
) -> JoinPlan:
    """Returns clusters of a kind, from the existing evidence; they are added to `clusters`, those of former kinds."""
    held = {
        TileId.parse(r.unit.partition("/")[2]): r
        for r in manifest.of(EVIDENCE).values()
        if r.path and r.unit.startswith(f"{wanted.name}/")
    }
    looked = {GREEN} if wanted.kind.sees_green else {PAINTED} if wanted.kind.sees_paint else set[str]()
    shown_of = {TileId.parse(u): r for name in looked for u, r in manifest.of(name).items() if r.path}
    grey = manifest.of(GREY_EDGES).items() if wanted.kind.sees_grey_edges else ()
    edges_of = {TileId.parse(u): r for u, r in grey if r.path}
    squares = clustered({**held, **shown_of, **edges_of})
    own = clusters[wanted.name] = [Cluster(wanted.name, some) for some in squares]
    objects, code = manifest.of(OBJECTS), wanted.objects_key()
    tasks = []
    for cluster in own:
        near = cluster.near()
        others = tuple(
            (
                name,
                tuple(objects[c.unit] for c in clusters[name] if c.unit in objects and c.meets(near)),
            )
            for name in wanted.kind.after
            if name in clusters
        )
        pieces = tuple(held[square] for square in cluster.squares if square in held)
        seen = tuple(shown_of[square] for square in cluster.squares if square in shown_of)
        read = [[name, [(r.unit, r.digest) for r in records]] for name, records in others]
        edges = tuple(edges_of[square] for square in cluster.squares if square in edges_of)
        shown = [[(r.unit, r.digest) for r in some] for some in (seen, edges) if some]
        key = key_of(code, grid.edge_m, [(r.unit, r.digest) for r in pieces], read, *shown)
        tasks.append(JoinTask(store, grid, cluster, wanted.options, pieces, others, key, seen, edges))
    units = {cluster.unit for cluster in own}
    gone = tuple(r for u, r in objects.items() if u.startswith(f"{wanted.name}/") and u not in units)
    return JoinPlan(tuple(tasks), gone)


def clustered(squares: Mapping[TileId, object]) -> list[tuple[TileId, ...]]:
    """Returns clusters of squares that touch, also at a corner; each cluster and all of them by row and column."""
    waiting = dict.fromkeys(sorted(squares, key=lambda t: (t.row, t.column)))
    found: list[tuple[TileId, ...]] = []
    while waiting:
        first = next(iter(waiting))
        del waiting[first]
        own, front = [first], [first]
        while front:
            at = front.pop()
            for one in _around(at):
                if one in waiting:
                    del waiting[one]
                    own.append(one)
                    front.append(one)
        found.append(tuple(sorted(own, key=lambda t: (t.row, t.column))))
    return found


def _around(square: TileId) -> Iterator[TileId]:
    for c in (-1, 0, 1):
        for r in (-1, 0, 1):
            if c or r:
                yield TileId(square.column + c, square.row + r)


def join_objects(task: JoinTask) -> TaskResult:
    """Join the pieces of a cluster and write its objects (runs on a worker)."""
    try:
        return TaskResult.of([_joined(task)])
    except Exception as error:  # noqa: BLE001  one cluster's fault must not stop the others
        return TaskResult.of((), [(task.cluster.unit, reason_of(error))], {damaged_file(error)})


def _joined(task: JoinTask) -> OutputRecord:
    name = task.cluster.kind
    kind, schema = asset_kinds()[name], asset_schema(name).arrow()
    wanted = kind.piece_schema
    pieces = pa.concat_tables([wanted.empty_table(), *(read_as(task.store, r, wanted) for r in task.pieces)])
    pieces = kind.joined(pieces)
    if task.pictured:
        pieces = kind.with_pictures(pieces, pa.concat_tables([recorded_table(task.store, r) for r in task.pictured]))
    if task.edges:
        pieces = kind.with_grey_edges(pieces, pa.concat_tables([recorded_table(task.store, r) for r in task.edges]))
    near = task.cluster.near()
    others = {other: _near(task, records, near) for other, records in task.others}
    curve = curve_named(kind.curve)
    found = [
        replace(one, probability=curve.stated(one.probability))
        for one in kind.objects(pieces.combine_chunks(), task.options, others)
    ]
    rows = table_of_objects(name, found, schema)
    unit = task.cluster.unit
    if not rows.num_rows:
        return OutputRecord(OBJECTS, unit, task.key, "", 0, "", '{"objects": 0}')
    return publish_table(task.store, rows, OBJECTS, unit, task.key, f'{{"objects": {rows.num_rows}}}')


def _near(task: JoinTask, records: Sequence[OutputRecord], near: set[TileId]) -> list[AssetObject]:
    """Returns objects of another kind whose place lies in the cluster or in the squares around it."""
    found: list[AssetObject] = []
    for record in records:
        rows = recorded_table(task.store, record) if record.path else None
        if rows is None:
            continue
        places = zip(rows["easting_m"].to_pylist(), rows["northing_m"].to_pylist(), strict=True)
        held = [task.grid.squares.tile_at(e, n) in near for e, n in places]
        found += objects_of_table(rows.filter(pa.array(held, pa.bool_())))
    return found


def read_as(store: Store, record: OutputRecord, schema: pa.Schema) -> pa.Table:
    """Returns the table of a record; RunError where another version of roadscan wrote it with other columns."""
    table = recorded_table(store, record)
    missing = [name for name in schema.names if name not in table.column_names]
    if missing:
        raise RunError(
            f"{record.product} of {record.unit} was written by another version of roadscan, without the column "
            f"{missing[0]}; run the survey once without a selection of tiles"
        )
    return table
