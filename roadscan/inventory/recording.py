"""Recording of what a run found: which assets are known, which were not seen, and what stands on what."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.core.errors import SchemaError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, leap_seconds_at_gps, utc_from_gps_ns
from roadscan.inventory.found_distresses import NOT_KNOWN, Visibility
from roadscan.inventory.identity import Known, matched, new_ids
from roadscan.inventory.settings import Matching
from roadscan.inventory.state import Assets, State, live_commits, state_at
from roadscan.inventory.values import iso_column
from roadscan.store.asset_schema import GEOMETRY, asset_kind_names, asset_schema, asset_table, evidence_table
from roadscan.store.asset_truth import AssetTruth, Commit, Draft

_EPOCH: Final = "first_epoch_gps_ns"


@dataclass(frozen=True, eq=False)
class Found:
    """The findings of a run."""

    tables: Mapping[str, pa.Table]
    """By kind, columns as `asset_schema(kind).arrow()`; an absent kind was not searched for."""
    key: str
    """Digest of the tables, so that they are recorded once."""
    source: str
    """Survey and stage."""
    epoch: str | None = None
    """Name of the survey's epoch; the day (UTC) of the first return where it is None."""
    began_gps_ns: int = 0
    """GPS time at which the survey began, used if it found nothing at all; 0 where it is not known."""


@dataclass(frozen=True)
class Rules:
    """Rules for recognising assets."""

    visibility: Visibility
    matching: Matching = field(default_factory=Matching)
    unit_m: float = 1.0
    """Metres of a unit of the map."""


def record(truth: AssetTruth, found: Found, rules: Rules, who: str = "roadscan", why: str = "") -> Commit | None:
    """Returns the commit that records what a run found, None if recorded already; call it within `truth.alone()`.

    Raises
    ------
    SchemaError
        where a table is not that of its kind.
    """
    tables = {kind: _checked(kind, found.tables[kind]) for kind in asset_kind_names() if kind in found.tables}
    began = min((int(np.min(t[_EPOCH].to_numpy())) for t in tables.values() if t.num_rows), default=found.began_gps_ns)
    epoch = found.epoch or (utc_from_gps_ns(began).date().isoformat() if began else "no returns")
    known = [c for c in live_commits(truth.commits) if c.kind == "found" and c.epoch == epoch]
    if known and known[-1].run == found.key:
        return None
    rows = _Recording(state_at(truth, with_undone=True), tables, rules, epoch, is_again=bool(known)).rows()
    draft = Draft("found", who, why, found.source, epoch=epoch, epoch_gps_ns=began, run=found.key)
    return truth.append(draft, rows)


def _checked(kind: str, table: pa.Table) -> pa.Table:
    schema = asset_schema(kind).arrow()
    missing = [name for name in schema.names if name not in table.column_names]
    if missing:
        raise SchemaError(
            f"the table of found assets '{asset_schema(kind).table}' has no column '{missing[0]}'",
            expected=", ".join(schema.names),
            change="run the stage `assets` of this version again",
        )
    try:
        rows = table.select(schema.names).cast(schema)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError) as error:
        raise SchemaError(f"the table of found assets '{asset_schema(kind).table}': {error}") from error
    place = rows.schema.get_field_index(GEOMETRY)
    rows = rows.set_column(place, rows.schema.field(place), iso_column(rows[GEOMETRY]))
    return rows.sort_by([("object", "ascending"), ("easting_m", "ascending"), ("northing_m", "ascending")])


class _Recording:
    """The rows of one commit of evidence."""

    def __init__(
        self, state: State, tables: Mapping[str, pa.Table], rules: Rules, epoch: str, *, is_again: bool
    ) -> None:
        self.state = state
        self.tables = tables
        self.rules = rules
        self.epoch = epoch
        self.is_again = is_again

    def rows(self) -> pa.Table:
        """Returns the rows of all kinds, in the order of the table."""
        seen: dict[str, pa.Table] = {}
        unseen: list[pa.Table] = []
        taken = set(self.state.kind_of)
        for kind, table in self.tables.items():
            assets = self.state.assets.get(kind) or _none(kind)
            expected = self._expected(kind, assets)
            known = Known(assets.evidence, assets.rows, expected > 0)
            match = matched(kind, known, table, self.rules.matching, self.rules.unit_m)
            ids, valid_from = self._identified(kind, table, assets, match, taken)
            seen[kind] = self._evidence(kind, table, ids, valid_from)
            left = np.setdiff1d(np.arange(assets.rows.num_rows), match[match >= 0])
            left = left[[str(one) not in self.state.orphans for one in assets.ids[left]]] if left.size else left
            unseen.append(_unseen(kind, assets.ids[left], expected[left]))
        placed = self._placed(seen)
        rejected = self.state.edits.rejected
        standing = {kind: one.without(rejected) for kind, one in placed.items()} if rejected else placed
        for kind, rows in list(seen.items()):
            parents = pa.array(parents_of(kind, {**standing, kind: placed[kind]})[: rows.num_rows], pa.string())
            at = rows.schema.get_field_index("parent")
            seen[kind] = rows.set_column(at, rows.schema.field(at), parents)
        parts = [_wide(kind, rows, 1) for kind, rows in seen.items()] + unseen
        if not parts:
            return evidence_table().empty_table()
        return pa.concat_tables(parts).sort_by([("kind", "ascending"), ("asset_id", "ascending")])

    def _expected(self, kind: str, assets: Assets) -> npt.NDArray[np.int64]:
        """Returns passes that should have seen each known asset; of a reprocessed epoch at least those that did."""
        table = assets.evidence
        count = table.num_rows
        columns = [
            np.asarray(table[name].to_numpy(zero_copy_only=False), dtype=float)
            for name in ("easting_m", "northing_m", "height_m")
        ]
        places = np.column_stack(columns) if count else np.empty((0, 3))
        has_place = np.isfinite(places).all(axis=1)
        expected = np.full(count, NOT_KNOWN, dtype=np.int64)
        expected[has_place] = self.rules.visibility.expected_passes(kind, places[has_place])
        if self.is_again:
            saw = np.array([p or 0 for p in table["passes"].to_pylist()], dtype=np.int64)
            same = np.array([s == self.epoch for s in table["source"].to_pylist()], dtype=bool)
            expected = np.where(same, np.maximum(expected, saw), expected)
        return expected

    def _identified(
        self, kind: str, table: pa.Table, assets: Assets, match: npt.NDArray[np.int64], taken: set[str]
    ) -> tuple[list[str], list[dt.date]]:
        names = table["object"].to_pylist()
        fresh = [at for at in range(table.num_rows) if match[at] < 0]
        made = dict(zip(fresh, new_ids(kind, [f"{names[at]}/{self.epoch}" for at in fresh], taken), strict=True))
        taken.update(made.values())
        ids = [made[at] if at in made else str(assets.ids[match[at]]) for at in range(table.num_rows)]
        held = assets.evidence["valid_from"].to_pylist()
        days = _days(table[_EPOCH].to_numpy())
        firsts = [held[match[at]] if match[at] >= 0 else None for at in range(table.num_rows)]
        return ids, [min(day, first or day) for day, first in zip(days, firsts, strict=True)]

    def _evidence(self, kind: str, table: pa.Table, ids: list[str], valid_from: list[dt.date]) -> pa.Table:
        count = table.num_rows
        columns: dict[str, Any] = {name: table[name] for name in table.column_names}
        columns |= {
            "asset_id": pa.array(ids, pa.string()),
            "status": pa.array(["found"] * count, pa.string()),
            "valid_from": pa.array(valid_from, pa.date32()),
            "source": pa.array([self.epoch] * count, pa.string()),
            "passes_expected": table["passes"],
        }
        schema = asset_table(kind)
        arrays = [columns.get(f.name, pa.nulls(count, f.type)) for f in schema]
        return pa.table(dict(zip(schema.names, arrays, strict=True))).cast(schema)

    def _placed(self, seen: Mapping[str, pa.Table]) -> dict[str, AssetPlaces]:
        """Returns assets of all kinds: those that were just found first, then the other known ones."""
        placed: dict[str, AssetPlaces] = {}
        for kind in {*seen, *self.state.assets}:
            ids: list[Any] = []
            shapes: list[Any] = []
            if kind in seen:
                ids += seen[kind]["asset_id"].to_pylist()
                shapes += list(shapely.from_wkb(seen[kind][GEOMETRY].to_numpy(zero_copy_only=False)))
            assets = self.state.assets.get(kind)
            if assets is not None:
                found = set(ids)
                others = [at for at, one in enumerate(assets.ids) if str(one) not in found]
                ids += [str(assets.ids[at]) for at in others]
                shapes += [assets.shapes[at] for at in others]
            array = np.array(shapes, dtype=object)
            if self.rules.unit_m != 1.0:
                array = shapely.transform(array, lambda xy: xy * self.rules.unit_m)
            placed[kind] = AssetPlaces(np.array(ids, dtype=str), array)
        return placed


def _days(epoch_gps_ns: npt.NDArray[np.int64]) -> list[dt.date]:
    """Returns the days (UTC) of epochs."""
    gps_s = epoch_gps_ns // NS_PER_S
    unix_s = gps_s + GPS_EPOCH_UNIX_S - leap_seconds_at_gps(gps_s)
    days: list[dt.date] = unix_s.astype("datetime64[s]").astype("datetime64[D]").tolist()
    return days


def _none(kind: str) -> Assets:
    return Assets(kind, asset_table(kind).empty_table(), asset_table(kind).empty_table())


def _wide(kind: str, rows: pa.Table, seen: int) -> pa.Table:
    """Returns rows of a kind as rows of the table `assets_found`."""
    schema, count = evidence_table(), rows.num_rows
    own: dict[str, Any] = {name: rows[name] for name in rows.column_names}
    own |= {
        "commit": pa.array([0] * count, pa.int32()),
        "kind": pa.array([kind] * count, pa.string()),
        "seen": pa.array([seen] * count, pa.uint8()),
    }
    arrays = [own.get(f.name, pa.nulls(count, f.type)) for f in schema]
    return pa.table(dict(zip(schema.names, arrays, strict=True))).cast(schema)


def _unseen(kind: str, ids: npt.NDArray[Any], expected: npt.NDArray[np.int64]) -> pa.Table:
    """Returns rows of assets that the run did not find; without a status unless it should have seen them."""
    rows = pa.table(
        {
            "asset_id": pa.array([str(one) for one in ids], pa.string()),
            "status": pa.array(["missing" if n > 0 else None for n in expected], pa.string()),
            "passes_expected": pa.array([int(n) if n >= 0 else None for n in expected], pa.int32()),
        }
    )
    return _wide(kind, rows, 0)


_REACH_M: Final = 1.0
"""Greatest horizontal distance (m) of a point or line to its parent."""


class AssetPlaces(NamedTuple):
    """Assets of a kind with their places, in metres of the map."""

    ids: npt.NDArray[Any]
    shapes: npt.NDArray[Any]

    def without(self, ids: Sequence[str]) -> AssetPlaces:
        """Returns the same without some of them."""
        keep = ~np.isin(self.ids, ids)
        return AssetPlaces(self.ids[keep], self.shapes[keep])


def parents_of(kind: str, placed: Mapping[str, AssetPlaces]) -> list[str | None]:
    """Returns the id of the parent of each asset of a kind, None where none is within 1 m of it.

    The kind that the schema names first wins, then the nearest asset, then the lower id.
    with the lower id.
    """
    children = placed[kind]
    found: list[str | None] = [None] * len(children.ids)
    if not len(children.ids):
        return found
    points = shapely.force_2d(children.shapes)
    for name in asset_schema(kind).parents:
        parents = placed.get(name)
        open_rows = np.array([at for at, one in enumerate(found) if one is None], dtype=np.int64)
        if parents is None or not len(parents.ids) or not open_rows.size:
            continue
        there = shapely.force_2d(parents.shapes)
        left, right = shapely.STRtree(there).query(points[open_rows], predicate="dwithin", distance=_REACH_M)
        distance = shapely.distance(points[open_rows][left], there[right])
        order = np.lexsort((parents.ids[right], distance, left))
        first = np.flatnonzero(np.diff(left[order], prepend=-1))
        for at in order[first]:
            found[int(open_rows[left[at]])] = str(parents.ids[right[at]])
    return found
