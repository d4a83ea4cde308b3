"""Comparison of a home's rows with those it had when it was published or last read: what people changed.

Rows are identified by their id. A row without id that has the number and the geometry, or the number and all values,
of a row otherwise missing is that row, and so is a point with its number within 50 mm of it; any other was just drawn.
A number alone identifies no row: it is reused.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.core.witness import Finding, Witness
from roadscan.inventory.conflicts import conflicts_of
from roadscan.inventory.edits import REJECTED, Edit, Folded, named
from roadscan.inventory.home import FID, Author, Content, Decision, EditFault, FaultyEditsError
from roadscan.inventory.identity import new_ids
from roadscan.inventory.state import State
from roadscan.inventory.values import decoded, encoded
from roadscan.store.asset_schema import GEOMETRY, asset_kind_names, asset_schema, asset_table, evidence_table

_STEP: Final = 1e-4
"""Tolerance of coordinates (map units): products round to 0.1 mm, and a detour through another CRS costs less."""
SAME_PLACE_M: Final = 0.05
"""Two points of a kind do not stand so close to each other (m): the second is the first, or its double."""


class Change(NamedTuple):
    """A value that differs from the published one."""

    kind: str
    asset_id: str
    attribute: str
    old: Any
    new: Any
    record: str
    fid: int


@dataclass(eq=False)
class Changes:
    """All differences, and the rows that could not be identified."""

    changed: list[Change] = field(default_factory=list)
    drawn: list[Change] = field(default_factory=list)
    """New assets with their geometries; their other values are among `changed`."""
    deleted: list[tuple[str, str]] = field(default_factory=list)
    """Kind and id of each deleted asset."""
    faults: list[EditFault] = field(default_factory=list)
    rows: dict[str, pa.Table] = field(default_factory=dict)
    """Rows of the home by kind, each with its id."""
    before: dict[str, pa.Table] = field(default_factory=dict)
    """Rows that they were compared with."""


def published_table(content: Content) -> pa.Table:
    """Returns the rows of all kinds in one table, for storage."""
    parts = []
    schema = pa.schema([pa.field(FID, pa.int64()), *evidence_table()])
    for kind, rows in sorted(content.rows.items()):
        own: dict[str, Any] = {name: rows[name] for name in rows.column_names}
        own["kind"] = pa.array([kind] * rows.num_rows, pa.string())
        arrays = [own.get(f.name, pa.nulls(rows.num_rows, f.type)) for f in schema]
        parts.append(pa.table(dict(zip(schema.names, arrays, strict=True))).cast(_nullable(schema)))
    return pa.concat_tables(parts) if parts else _nullable(schema).empty_table()


def published_rows(table: pa.Table) -> dict[str, pa.Table]:
    """Returns the same rows by kind; columns unknown to this version are dropped, missing ones are null."""
    rows = {}
    for kind in pc.unique(table["kind"]).to_pylist():
        own = table.filter(pc.equal(table["kind"], kind))
        schema = pa.schema([pa.field(FID, pa.int64()), *asset_table(kind)])
        arrays = [own[f.name] if f.name in own.column_names else pa.nulls(own.num_rows, f.type) for f in schema]
        rows[kind] = pa.table(dict(zip(schema.names, arrays, strict=True))).cast(schema)
    return rows


def _nullable(schema: pa.Schema) -> pa.Schema:
    return pa.schema([f.with_nullable(True) for f in schema])


def compared(content: Content, base: Mapping[str, pa.Table], token: str, unit_m: float) -> Changes:
    """Returns the differences between a home, on a map in units of so many metres, and the rows under `token`."""
    changes = Changes()
    homes = {str(one): kind for kind, rows in base.items() for one in rows["asset_id"].to_pylist()}
    for kind in asset_kind_names():
        rows, before = content.rows.get(kind), base.get(kind)
        if rows is None:
            continue
        if before is None:
            before = rows.slice(0, 0)
        changes.before[kind] = before
        _compare_kind(_Side(kind, rows, before, token, homes, unit_m), changes)
    return changes


class _Side(NamedTuple):
    kind: str
    rows: pa.Table
    before: pa.Table
    token: str
    homes: Mapping[str, str]
    unit_m: float


def _compare_kind(side: _Side, changes: Changes) -> None:
    kind, table = side.kind, asset_schema(side.kind).table
    ids = [one or None for one in side.rows["asset_id"].to_pylist()]
    fids = side.rows[FID].to_pylist()
    place = {one: at for at, one in enumerate(side.before["asset_id"].to_pylist())}
    bad: set[int] = set()
    seen: dict[str, int] = {}
    for at, one in enumerate(ids):
        if one is None:
            continue
        if one in seen:
            bad |= {at, seen[one]}
            reason = f"the id stands in two rows (fid {fids[seen[one]]} and {fids[at]}): empty it in the copy"
            changes.faults.append(EditFault(table, one, reason))
        elif one not in place:
            bad.add(at)
            there = side.homes.get(one)
            reason = f"the id belongs to the layer {asset_schema(there).table}" if there else "the id is not known"
            changes.faults.append(EditFault(table, one, f"{reason}: leave it empty for a new asset"))
        seen.setdefault(one, at)
    for at, one in _recovered(side, ids, place).items():
        ids[at] = one
        seen[one] = at
    drawn = [at for at, one in enumerate(ids) if one is None]
    names = [f"{side.token}/{_hex(side.rows[GEOMETRY][at].as_py())}" for at in drawn]
    for at, one in zip(drawn, new_ids(kind, names, set(side.homes)), strict=True):
        ids[at] = one
        changes.drawn += _drawn(side, at, one)
        changes.changed += _values_of(side, at, one)
    changes.deleted += [(kind, one) for one in place if one not in seen]
    at_rows = [at for at, one in enumerate(ids) if one in place and at not in bad]
    changes.changed += _differences(side, at_rows, [place[ids[at]] for at in at_rows], ids)
    column = side.rows.schema.get_field_index("asset_id")
    changes.rows[kind] = side.rows.set_column(column, "asset_id", pa.array(ids, pa.string()))


def _recovered(side: _Side, ids: list[str | None], place: Mapping[str, int]) -> dict[int, str]:
    """Returns ids of rows that lost theirs, or never got one since they were first read."""
    if None not in ids:
        return {}
    present = {one for one in ids if one is not None}
    by_fid = {
        fid: one for one, fid in zip(side.before["asset_id"].to_pylist(), side.before[FID].to_pylist(), strict=True)
    }
    found: dict[int, str] = {}
    names = [n for n in side.before.column_names if n not in (FID, "asset_id", GEOMETRY)]
    for at, one in enumerate(ids):
        candidate = by_fid.get(side.rows[FID][at].as_py())
        if one is not None or candidate is None or candidate in present:
            continue
        row, before = side.rows.slice(at, 1), side.before.slice(place[candidate], 1)
        places = row[GEOMETRY][0].as_py(), before[GEOMETRY][0].as_py()
        if (
            same_place(*places)
            or _near(*places, side.unit_m)
            or all(_plain(row[n][0].as_py()) == _plain(before[n][0].as_py()) for n in names)
        ):
            found[at] = candidate
            present.add(candidate)
    return found


def _drawn(side: _Side, at: int, one: str) -> Iterator[Change]:
    fid = side.rows[FID][at].as_py()
    yield Change(side.kind, one, GEOMETRY, None, side.rows[GEOMETRY][at].as_py(), f"fid {fid}", fid)


def _values_of(side: _Side, at: int, one: str) -> Iterator[Change]:
    row = side.rows.slice(at, 1)
    fid = row[FID][0].as_py()
    for name in side.rows.column_names:
        value = _plain(row[name][0].as_py())
        if name not in (FID, "asset_id", GEOMETRY) and value is not None:
            yield Change(side.kind, one, name, None, value, f"fid {fid}", fid)


def _differences(side: _Side, rows: list[int], before: list[int], ids: list[str | None]) -> Iterator[Change]:
    now, then = side.rows.take(pa.array(rows, pa.int64())), side.before.take(pa.array(before, pa.int64()))
    fids = now[FID].to_pylist()
    for name in side.before.column_names:
        if name in (FID, "asset_id"):
            continue
        for at in _differing(now[name], then[name]):
            old, new = _plain(then[name][at].as_py()), _plain(now[name][at].as_py())
            if old != new and not (name == GEOMETRY and same_place(old, new)):
                one = str(ids[rows[at]])
                yield Change(side.kind, one, name, old, new, one, fids[at])


def _differing(now: pa.ChunkedArray, then: pa.ChunkedArray) -> npt.NDArray[np.int64]:
    """Returns the rows of which one value is null and the other is not, or whose values differ."""
    same = pc.fill_null(pc.equal(now, then), False)
    neither = pc.and_(pc.is_null(now), pc.is_null(then))
    return np.flatnonzero(~np.asarray(pc.or_(same, neither)))


def same_place(one: bytes | None, other: bytes | None) -> bool:
    """Returns True for geometries whose vertices agree within the tolerance, as after a detour through another CRS."""
    if one is None or other is None or one == other:
        return one == other
    first, second = shapely.from_wkb(one), shapely.from_wkb(other)
    return bool(shapely.equals_exact(first, second, tolerance=_STEP)) and _same_heights(first, second)


def _near(one: bytes | None, other: bytes | None, unit_m: float) -> bool:
    """Returns True for two points at one place, seen from above."""
    if one is None or other is None:
        return False
    first, second = shapely.from_wkb(one), shapely.from_wkb(other)
    return first.geom_type == second.geom_type == "Point" and bool(
        unit_m * shapely.distance(first, second) <= SAME_PLACE_M
    )


def _same_heights(first: Any, second: Any) -> bool:
    if first.has_z != second.has_z:
        return False
    one, other = (shapely.get_coordinates(shape, include_z=True)[:, 2] for shape in (first, second))
    return bool(np.allclose(one, other, rtol=0.0, atol=_STEP, equal_nan=True))


def _plain(value: Any) -> Any:
    """Returns a value in normal form: an empty text and NaN are None."""
    if value == "" or (isinstance(value, float) and math.isnan(value)):
        return None
    return value


def _hex(geometry: bytes | None) -> str:
    return "" if geometry is None else geometry.hex()


CLOCK_OF_EDITS: Final = Witness(
    name="clock_of_edits",
    input="inventory edits",
    fault="The clock of the computer on which a person edited is wrong.",
    asks="the instants of the commit that was shown and of the pull",
    does="the edit is taken in and dated by the pull; `pull` says so",
    told=("findings",),
)
_CLOCKS: Final = dt.timedelta(minutes=5)
"""Greatest difference of unsynchronised clocks: more would confuse the order of edits."""


@dataclass(frozen=True)
class Pulling:
    """What the edits of one pull have in common."""

    base: State
    """The state that was published."""
    now: State
    who: str
    why: str
    source: str
    authors: Mapping[tuple[str, str, str], Author]
    at: str


def new_edits(changes: Changes, decisions: Sequence[Decision], pulling: Pulling) -> tuple[list[Edit], list[EditFault]]:
    """Returns edits that the truth does not have yet, one a value; and decisions refused because they contradict one
    another or a value that was written meanwhile, or nothing is there to choose.
    """
    made = {e.key: e for e in _changed(changes, pulling) if not _is_held(e, pulling)}
    faults = []
    for key, own in _open(decisions, pulling).items():
        try:
            edit = _decided(key, own, made.get(key), pulling)
        except ValueError as error:
            faults.append(EditFault("conflicts", f"{key[0]}, {key[1]}", str(error)))
            continue
        made[edit.key] = edit
    return [named(edit) for edit in made.values()], faults


def _is_held(edit: Edit, pulling: Pulling) -> bool:
    """Returns True if the truth says so already, or the edit restores what was found before another's edit."""
    edits: Folded = pulling.now.edits
    return edits.holds(edit)


def _changed(changes: Changes, pulling: Pulling) -> Iterator[Edit]:
    for change in changes.drawn:
        yield _edit(pulling, change.kind, change.asset_id, GEOMETRY, ("create", None, change.new), change.fid)
    for change in changes.changed:
        yield _edit(
            pulling, change.kind, change.asset_id, change.attribute, ("set", change.old, change.new), change.fid
        )
    for kind, one in changes.deleted:
        row = pulling.base.row(one) or pulling.now.row(one) or {}
        yield _edit(pulling, kind, one, "status", ("set", row.get("status"), "rejected"), None)


def _edit(
    pulling: Pulling, kind: str, asset_id: str, attribute: str, change: tuple[str, Any, Any], fid: int | None
) -> Edit:
    action, old, new = change
    names = [(*row, name) for row in ((kind, asset_id), (kind, f"fid {fid}")) for name in (attribute, "")]
    author = next((pulling.authors[name] for name in names if name in pulling.authors), None)
    who, at, why = author if author is not None else ("", "", "")
    evidence = (pulling.base.row(asset_id, evidence=True) or {}).get(attribute)
    return Edit(
        "", 0, asset_id, kind, attribute, action, None if old is None else encoded(old), encoded(new),
        None if evidence is None else encoded(evidence), pulling.base.commit, who or pulling.who, at or pulling.at,
        why or pulling.why, pulling.source,
    )  # fmt: skip


def _open(decisions: Sequence[Decision], pulling: Pulling) -> dict[tuple[str, str], list[Decision]]:
    """Returns decisions by asset and attribute, without those that were settled since."""
    found: dict[tuple[str, str], list[Decision]] = {}
    standing: set[tuple[str, str, str]] | None = None
    for one in decisions:
        key = (one.asset_id, one.attribute)
        known = pulling.now.edits.in_force.get(key)
        names = [e.edit for e in (*pulling.now.edits.waiting.get(key, ()), *([known] if known else []))]
        if one.edit not in names or one.asset_id not in pulling.now.kind_of:
            continue
        if one.edit in pulling.now.edits.settled:  # its edit is in force still: the asset, or its parent, came back
            if standing is None:
                standing = {(c.asset_id, c.attribute, c.edit) for c in conflicts_of(pulling.now)}
            if one[:3] in standing:
                found.setdefault(key, []).append(one)
        else:
            found.setdefault(key, []).append(one)
    return found


def _decided(key: tuple[str, str], decisions: Sequence[Decision], written: Edit | None, pulling: Pulling) -> Edit:
    """Returns the edit that settles conflicts of a value; it has seen all that is in the truth today.

    Parameters
    ----------
    written : a value that the person wrote beside the decisions.

    Raises
    ------
    ValueError
        where they contradict one another or that value, or nothing is there to choose.
    """
    known = pulling.now.edits.in_force.get(key)
    waiting = {e.edit: e for e in pulling.now.edits.waiting.get(key, ())}
    settles = ",".join(sorted(one.edit for one in decisions))
    ruling = {(one.choice, one.edit if one.choice == "other" else "") for one in decisions if one.choice != "edit"}
    if len(ruling) > 1 or (ruling and written is not None):
        what = "the decisions contradict one another" if written is None else "a decision contradicts the value written"
        raise ValueError(f"{what}: one value is expected, `edit` for what the row of the asset says")
    if written is not None:
        return written._replace(settles=settles)
    choice, edit = ruling.pop() if ruling else ("edit", decisions[0].edit)
    if choice == "other" and edit not in waiting:
        rejection = _rejection(key, known, pulling)
        if rejection is None:
            raise ValueError("the decision is 'other', and no other edit waits: edit or evidence is expected")
        key, known, choice = rejection.key, rejection, "evidence"  # whoever edited it holds: the asset is back
    evidence = (pulling.now.row(key[0], evidence=True) or {}).get(key[1])
    old = known.new if known is not None else None
    if choice == "other":
        new: str | None = waiting[edit].new
    else:
        new = old if choice == "edit" and known is not None else encoded(evidence)
    action = "withdraw" if choice == "evidence" or (known is None and choice == "edit") else "set"
    return Edit(
        "", 0, key[0], pulling.now.kind_of[key[0]], key[1], action, old, new,
        None if evidence is None else encoded(evidence), pulling.now.commit, pulling.who, pulling.at,
        pulling.why or f"conflict settled: {choice}", pulling.source, settles,
    )  # fmt: skip


def _rejection(key: tuple[str, str], known: Edit | None, pulling: Pulling) -> Edit | None:
    """Returns the edit in force that rejected an asset, or its assigned parent; None where neither was rejected."""
    in_force = pulling.now.edits.in_force
    ids = [key[0]]
    if known is not None and known.attribute == "parent":
        ids.append(decoded(known.kind, known.attribute, known.new))
    rejections = (in_force.get((one, "status")) for one in ids)
    return next((one for one in rejections if one is not None and one.new == REJECTED), None)


def refuse(faults: Sequence[EditFault], home: str) -> FaultyEditsError:
    """Returns the error that names all faulty rows of a home."""
    listed = "; ".join(str(fault) for fault in faults[:20])
    more = f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
    asked = [fault.record for fault in faults if fault.is_question]
    what = f"{len(faults)} rows are faulty:" if len(asked) < len(faults) else "is this right?"
    way = ["mend these rows and pull again, or take the others in alone (`--sound`)"]
    if asked:
        way.append(f"`--confirm '{asked[0]}'` takes in what is right as it stands (`--confirm all`: each)")
    error = FaultyEditsError(f"nothing was taken in: {what} {listed}{more}", change="; ".join(way), file=home)
    error.faults = tuple(faults)
    return error


def clocked(
    authors: Mapping[tuple[str, str, str], Author], shown_at: str, now: str
) -> tuple[dict[tuple[str, str, str], Author], list[Finding]]:
    """Returns authors without impossible instants (before the commit that was shown, or after now), and findings.

    Parameters
    ----------
    shown_at, now : instants (UTC): of the commit whose state was edited, and of the pull.
    """
    first, last = dt.datetime.fromisoformat(shown_at) - _CLOCKS, dt.datetime.fromisoformat(now) + _CLOCKS
    kept, odd = dict(authors), set()
    for name, author in authors.items():
        if author.at and not first <= _instant(author.at) <= last:
            kept[name] = author._replace(at="")
            odd.add((author.who, author.at))
    return kept, [
        CLOCK_OF_EDITS.finds(
            who or "an edit",
            f"it is dated {at}, and its state was shown at {shown_at} and is pulled at {now}: the clock of that "
            "computer is wrong. The edit is dated by the pull.",
        )
        for who, at in sorted(odd)
    ]


def _instant(text: str) -> dt.datetime:
    moment = dt.datetime.fromisoformat(text)
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=dt.UTC)
