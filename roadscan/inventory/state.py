"""The inventory as it was after any commit: evidence with edits applied.

Of each asset the evidence of the newest survey epoch that saw it counts, of an epoch that was processed several times
the newest processing. Then edits in force replace single values.
"""

from __future__ import annotations

import datetime as dt
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.core.errors import ConfigError
from roadscan.inventory.edits import Edit, Folded, folded, read_edits
from roadscan.inventory.values import decoded
from roadscan.store.asset_schema import GEOMETRY, asset_kind_names, asset_table
from roadscan.store.asset_truth import AssetTruth, Commit

_OF_THE_PLACE: Final = ("station_m", "offset_m", "lane")
"""Columns that were measured at the place of the evidence; unknown if a person moved the asset."""


@dataclass(frozen=True, eq=False)
class Assets:
    """Assets of a kind, by ascending id."""

    kind: str
    rows: pa.Table
    """With edits, as people see them."""
    evidence: pa.Table
    """As found: the same assets in the same order; all but the id is null where there is no evidence."""

    @cached_property
    def ids(self) -> npt.NDArray[Any]:
        """Returns ids of the assets, ascending."""
        return np.asarray(self.rows["asset_id"].to_numpy(zero_copy_only=False), dtype=str)

    def place(self, asset_id: str) -> int | None:
        """Returns the row of an asset; None where there is none."""
        at = int(np.searchsorted(self.ids, asset_id))
        return at if at < self.ids.size and self.ids[at] == asset_id else None

    @cached_property
    def shapes(self) -> npt.NDArray[Any]:
        """Returns geometries as people see them, in the map's unit."""
        return np.asarray(shapely.from_wkb(self.rows[GEOMETRY].to_numpy(zero_copy_only=False)))


@dataclass(frozen=True, eq=False)
class State:
    """The inventory after a commit."""

    commit: int
    assets: Mapping[str, Assets]
    """By kind; only kinds with assets."""
    edits: Folded
    orphans: frozenset[str]
    """Edited assets whose evidence or drawing was undone; they keep their evidence and have status missing."""
    units_m: tuple[float, float] = (1.0, 1.0)
    """Metres in a unit of the map: of its coordinates, and of its heights."""

    @cached_property
    def kind_of(self) -> dict[str, str]:
        """Returns the kind of each asset."""
        return {str(one): kind for kind, assets in self.assets.items() for one in assets.ids}

    def row(self, asset_id: str, *, evidence: bool = False) -> dict[str, Any] | None:
        """Returns an asset as people see it, or as it was found; None where there is none."""
        kind = self.kind_of.get(asset_id)
        at = None if kind is None else self.assets[kind].place(asset_id)
        if kind is None or at is None:
            return None
        table = self.assets[kind].evidence if evidence else self.assets[kind].rows
        found: dict[str, Any] = table.slice(at, 1).to_pylist()[0]
        return found


def live_commits(commits: Sequence[Commit]) -> list[Commit]:
    """Returns commits that are not undone; an undoing that was undone itself does not count."""
    undone: set[int] = set()
    for commit in reversed(commits):
        if commit.kind == "undo" and commit.number not in undone:
            undone.add(commit.undoes)
    return [c for c in commits if c.number not in undone and c.kind != "undo"]


def state_at(truth: AssetTruth, number: int | None = None, *, with_undone: bool = False) -> State:
    """Returns the inventory after commit `number`, by default today's.

    Parameters
    ----------
    with_undone : whether assets count that only undone runs have found. They are recognised when found again.

    Raises
    ------
    DamagedError
        where rows of the truth are damaged.
    """
    commits = truth.commits[: len(truth.commits) if number is None else number]
    live = live_commits(commits)
    edits = folded(read_edits(truth, live))
    found, status = _evidence(truth, _newest_first([c for c in live if c.kind == "found"]))
    edited = {asset for asset, _ in edits.in_force} - edits.created.keys()
    counted = {c.number for c in live}
    undone = [c for c in commits if c.kind != "undo" and c.number not in counted]
    orphans: set[str] = set()
    if undone:
        lost = edited - (set() if found is None else set(found["asset_id"].to_pylist()))
        runs = _newest_first([c for c in undone if c.kind == "found"])
        found, orphans = _with_lost(truth, runs, found, None if with_undone else lost)
        drawn = {e.asset_id: e for e in read_edits(truth, undone) if e.action == "create"}
        edits.created.update({one: drawn[one] for one in drawn.keys() & (lost - orphans)})
        orphans |= drawn.keys() & lost
        status |= dict.fromkeys(orphans, ("missing", None))
    assets = _by_kind(found, status, edits, truth.units_m)
    return State(len(commits), assets, edits, frozenset(orphans), truth.units_m)


def commit_at(truth: AssetTruth, when: str | dt.date | int | None) -> int:
    """Returns the number of the last commit at an instant, a day (UTC, its end) or by its number; 0 before the first.

    Raises
    ------
    ConfigError
        where `when` is none of them.
    """
    if when is None:
        return len(truth.commits)
    text = str(when).removeprefix("#")
    if text.isdigit() and len(text) < 8:
        if int(text) > len(truth.commits):
            raise ConfigError(f"commit {text}", expected=f"1 to {len(truth.commits)}")
        return int(text)
    try:
        moment = dt.datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(
            f"'{when}' is no date", expected="a day such as 2026-05-04, an instant with zone, or the number of a commit"
        ) from None
    if "T" not in text and " " not in text:
        moment = moment.replace(tzinfo=dt.UTC) + dt.timedelta(days=1) - dt.timedelta(microseconds=1)
    if moment.tzinfo is None:
        raise ConfigError(f"{when} has no zone", expected="UTC, such as 2026-05-04T09:30:00Z")
    return sum(dt.datetime.fromisoformat(c.at) <= moment for c in truth.commits)


def _newest_first(found: Sequence[Commit]) -> list[Commit]:
    """Returns commits of evidence by the epoch of their survey, then by their order, the newest first."""
    began: dict[str, int] = {}
    for commit in found:
        began.setdefault(commit.epoch, commit.epoch_gps_ns)
    return sorted(found, key=lambda c: (began[c.epoch], c.epoch, c.number), reverse=True)


def _evidence(truth: AssetTruth, commits: Sequence[Commit]) -> tuple[pa.Table | None, dict[str, Any]]:
    """Returns the evidence that counts; for assets that newer evidence did not see, status and passes expected."""
    parts: list[pa.Table] = []
    status: dict[str, tuple[str, int | None]] = {}
    for commit in commits:
        if parts and not _fresh(truth, commit, parts):
            continue
        rows = truth.rows(commit)
        seen = pc.equal(rows["seen"], 1)
        unseen = rows.filter(pc.invert(seen)).select(["asset_id", "status", "passes_expected"])
        known = _ids(parts) if unseen.num_rows and parts else set()
        for asset, state, expected in zip(*(c.to_pylist() for c in unseen.columns), strict=True):
            if asset not in known and asset not in status and state is not None:
                status[asset] = (state, expected)
        rows = rows.filter(seen)
        if parts:
            rows = rows.filter(pc.invert(pc.is_in(rows["asset_id"], value_set=_id_array(parts))))
        parts.append(rows)
    return (pa.concat_tables(parts) if parts else None), status


def _fresh(truth: AssetTruth, commit: Commit, parts: Sequence[pa.Table]) -> bool:
    """Returns True if a commit mentions an asset that the newer ones did not see."""
    ids = truth.rows(commit, ["asset_id"])["asset_id"]
    return not pc.all(pc.is_in(ids, value_set=_id_array(parts))).as_py()


def _id_array(parts: Sequence[pa.Table]) -> pa.Array:
    return pa.concat_arrays(
        [pa.array([], pa.string()), *(chunk for part in parts for chunk in part["asset_id"].chunks)]
    )


def _ids(parts: Sequence[pa.Table]) -> set[str]:
    return set(_id_array(parts).to_pylist())


def _with_lost(
    truth: AssetTruth, undone: Sequence[Commit], found: pa.Table | None, wanted: set[str] | None
) -> tuple[pa.Table | None, set[str]]:
    """Returns evidence with that of assets which only undone commits saw (all, or wanted ones); and which these are."""
    kept: set[str] = set()
    for commit in undone:
        rows = truth.rows(commit)
        mask = pc.equal(rows["seen"], 1)
        if found is not None:
            mask = pc.and_(mask, pc.invert(pc.is_in(rows["asset_id"], value_set=_id_array([found]))))
        if wanted is not None:
            mask = pc.and_(mask, pc.is_in(rows["asset_id"], value_set=pa.array(sorted(wanted), pa.string())))
        rows = rows.filter(mask)
        kept |= set(rows["asset_id"].to_pylist())
        found = rows if found is None else pa.concat_tables([found, rows])
    return found, kept


def _by_kind(
    found: pa.Table | None, status: Mapping[str, tuple[str, int | None]], edits: Folded, units_m: tuple[float, float]
) -> dict[str, Assets]:
    changes: dict[str, list[Edit]] = defaultdict(list)
    for edit in edits.in_force.values():
        changes[edit.kind].append(edit)
    drawn: dict[str, list[str]] = defaultdict(list)
    for edit in edits.created.values():
        drawn[edit.kind].append(edit.asset_id)
    assets: dict[str, Assets] = {}
    present = set() if found is None else set(pc.unique(found["kind"]).to_pylist())
    for kind in asset_kind_names():
        if kind not in present and kind not in drawn:
            continue
        schema = asset_table(kind)
        evidence = schema.empty_table()
        if found is not None and kind in present:
            evidence = found.filter(pc.equal(found["kind"], kind)).select(schema.names).cast(schema)
        known = set(evidence["asset_id"].to_pylist()) if kind in drawn else set()
        own = sorted(set(drawn[kind]) - known) if kind in drawn else []
        blank = pa.Table.from_pylist([{"asset_id": one} for one in own], schema)
        evidence = pa.concat_tables([evidence, blank]).sort_by("asset_id").combine_chunks()
        evidence = _with_status(evidence, status)
        own_edits = changes.get(kind, []) + _drawn_again(evidence, edits, drawn.get(kind, ()))
        rows = _as_drawn(
            _edited(kind, evidence, own_edits, units_m), [edits.created[one] for one in sorted(drawn.get(kind, ()))]
        )
        assets[kind] = Assets(kind, rows, evidence)
    return _without_rejected_parents(assets, edits)


def _without_rejected_parents(assets: dict[str, Assets], edits: Folded) -> dict[str, Assets]:
    """Returns assets without parents that people rejected; a parent that a person assigned stays."""
    rejected = pa.array(edits.rejected, pa.string())
    if not len(rejected):
        return assets
    for kind, own in assets.items():
        lost = np.flatnonzero(np.asarray(pc.is_in(own.rows["parent"], value_set=rejected)))
        places = [int(at) for at in lost if (str(own.ids[at]), "parent") not in edits.in_force]
        assets[kind] = replace(own, rows=_replaced(own.rows, "parent", places, [None] * len(places)))
    return assets


def _with_status(rows: pa.Table, status: Mapping[str, tuple[str, int | None]]) -> pa.Table:
    if not status:
        return rows
    ids = rows["asset_id"].to_pylist()
    places = [at for at, one in enumerate(ids) if one in status]
    rows = _replaced(rows, "status", places, [status[ids[at]][0] for at in places])
    return _replaced(rows, "passes_expected", places, [status[ids[at]][1] for at in places])


def _edited(kind: str, evidence: pa.Table, edits: Iterable[Edit], units_m: tuple[float, float]) -> pa.Table:
    """Returns rows with the values that people gave."""
    by_attribute: dict[str, list[Edit]] = defaultdict(list)
    for edit in edits:
        by_attribute[edit.attribute].append(edit)
    if not by_attribute:
        return evidence
    ids = np.asarray(evidence["asset_id"].to_numpy(zero_copy_only=False), dtype=str)
    rows = evidence
    moved = _places(ids, by_attribute.get(GEOMETRY, ()))
    for name in _OF_THE_PLACE if moved else ():
        rows = _replaced(rows, name, moved, [None] * len(moved))
    for attribute in sorted(by_attribute):
        own = sorted(by_attribute[attribute], key=lambda e: e.asset_id)
        places = _places(ids, own)
        rows = _replaced(rows, attribute, places, [decoded(kind, attribute, e.new) for e in own if _is_in(ids, e)])
    return _at_their_places(rows, moved, units_m)


def _drawn_again(evidence: pa.Table, edits: Folded, drawn: Sequence[str]) -> list[Edit]:
    """Returns edits that drew assets whose place neither a later edit nor evidence gives."""
    if not drawn:
        return []
    placed = set(evidence.filter(pc.is_valid(evidence[GEOMETRY]))["asset_id"].to_pylist())
    return [edits.created[one] for one in drawn if one not in placed and (one, GEOMETRY) not in edits.in_force]


def _as_drawn(rows: pa.Table, drawn: Sequence[Edit]) -> pa.Table:
    """Returns rows in which drawn assets are confirmed and name who drew them, where nothing else does."""
    if not drawn:
        return rows
    ids = np.asarray(rows["asset_id"].to_numpy(zero_copy_only=False), dtype=str)
    places = _places(ids, drawn)
    said = {"status": ["confirmed"] * len(drawn), "source": [f"drawn by {e.who}" for e in drawn]}
    for name, values in said.items():
        held = rows[name].to_pylist()
        missing = [(at, value) for at, value in zip(places, values, strict=True) if held[at] is None]
        rows = _replaced(rows, name, [at for at, _ in missing], [value for _, value in missing])
    return rows


def _at_their_places(rows: pa.Table, moved: Sequence[int], units_m: tuple[float, float]) -> pa.Table:
    """Returns reference points of moved assets, from their geometry."""
    if not moved:
        return rows
    shapes = shapely.from_wkb(rows[GEOMETRY].take(pa.array(moved)).to_numpy(zero_copy_only=False))
    points = reference_points(np.asarray(shapes)) * (units_m[0], *units_m)
    for column, name in enumerate(("easting_m", "northing_m", "height_m")):
        rows = _replaced(rows, name, moved, points[:, column].tolist())
    return rows


def reference_points(shapes: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Returns reference points (n, 3): a point, the middle of a line, else a point on or in it at its mean height."""
    is_line = shapely.get_type_id(shapes) == shapely.GeometryType.LINESTRING
    points = shapely.point_on_surface(shapely.force_2d(shapes))
    points[is_line] = shapely.line_interpolate_point(shapes[is_line], 0.5, normalized=True)
    xyz, number = shapely.get_coordinates(shapes, include_z=True, return_index=True)
    mean = np.bincount(number, xyz[:, 2], len(shapes)) / shapely.get_num_coordinates(shapes)
    heights = np.where(is_line, shapely.get_z(points), mean)
    return np.column_stack([shapely.get_x(points), shapely.get_y(points), heights])


def _is_in(ids: npt.NDArray[Any], edit: Edit) -> bool:
    at = int(np.searchsorted(ids, edit.asset_id))
    return at < ids.size and bool(ids[at] == edit.asset_id)


def _places(ids: npt.NDArray[Any], edits: Iterable[Edit]) -> list[int]:
    wanted = sorted(e.asset_id for e in edits if _is_in(ids, e))
    return [int(at) for at in np.searchsorted(ids, wanted)] if wanted else []


def _replaced(rows: pa.Table, name: str, places: Sequence[int], values: Sequence[Any]) -> pa.Table:
    """Returns rows with other values of a column at some positions, which ascend."""
    if not places:
        return rows
    at = rows.schema.get_field_index(name)
    field = rows.schema.field(at)
    mask = np.zeros(rows.num_rows, dtype=bool)
    mask[list(places)] = True
    column = rows[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], field.type)
    changed = pc.replace_with_mask(column, pa.array(mask), pa.array(values, field.type))
    return rows.set_column(at, field, changed)
