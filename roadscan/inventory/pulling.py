"""Edits of a home's changes: what each value was, what the evidence said, who changed it."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roadscan.inventory.comparing import Changes
from roadscan.inventory.edits import REJECTED, Edit, Folded, named
from roadscan.inventory.home import Author, Decision, FaultyEditsError
from roadscan.inventory.state import State
from roadscan.inventory.values import encoded
from roadscan.model.errors import ConfigError
from roadscan.tables.inventory_schema import GEOMETRY


@dataclass(frozen=True)
class Pulling:
    """What edits of one pull have in common."""

    base: State
    """The state that was published."""
    now: State
    who: str
    why: str
    source: str
    authors: Mapping[tuple[str, str, str], Author]
    at: str


def new_edits(changes: Changes, decisions: Sequence[Decision], pulling: Pulling) -> list[Edit]:
    """Edits that the truth does not hold yet, one a value.

    Raises
    ------
    ConfigError
        where decisions on a value contradict one another, or a value that was written meanwhile.
    """
    made = {e.key: e for e in _changed(changes, pulling) if not _is_held(e, pulling)}
    for key, own in _open(decisions, pulling).items():
        edit = _decided(key, own, made.get(key), pulling)
        made[edit.key] = edit
    return [named(edit) for edit in made.values()]


def _is_held(edit: Edit, pulling: Pulling) -> bool:
    """True if the truth says so already, or the edit gives back what was found before another's edit."""
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
    """Decisions by asset and attribute; those that were settled since are left out."""
    found: dict[tuple[str, str], list[Decision]] = {}
    for one in decisions:
        key = (one.asset_id, one.attribute)
        known = pulling.now.edits.in_force.get(key)
        names = [e.edit for e in (*pulling.now.edits.waiting.get(key, ()), *([known] if known else []))]
        if one.edit in names and one.asset_id in pulling.now.kind_of:
            found.setdefault(key, []).append(one)
    return found


def _decided(key: tuple[str, str], decisions: Sequence[Decision], written: Edit | None, pulling: Pulling) -> Edit:
    """The edit that settles conflicts of a value; it knows all that is in the truth today.

    Parameters
    ----------
    written : a value that the person wrote beside the decisions.
    """
    known = pulling.now.edits.in_force.get(key)
    waiting = {e.edit: e for e in pulling.now.edits.waiting.get(key, ())}
    record = f"conflicts, {key[0]}, {key[1]}"
    settles = ",".join(sorted(one.edit for one in decisions))
    ruling = {(one.choice, one.edit if one.choice == "other" else "") for one in decisions if one.choice != "edit"}
    if len(ruling) > 1 or (ruling and written is not None):
        raise ConfigError(
            "the decisions contradict one another" if written is None else "a decision contradicts the value written",
            expected="one value: `edit` for what the row of the asset says",
            record=record,
        )
    if written is not None:
        return written._replace(settles=settles)
    choice, edit = ruling.pop() if ruling else ("edit", decisions[0].edit)
    rejection = pulling.now.edits.in_force.get((key[0], "status"))
    if choice == "other" and edit not in waiting and rejection is not None and rejection.new == REJECTED:
        key, known, choice = rejection.key, rejection, "evidence"  # whoever edited it holds: the asset is back
    if choice == "other" and edit not in waiting:
        raise ConfigError(
            "the decision is 'other', and no other edit waits", expected="edit or evidence", record=record
        )
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


def now_utc() -> str:
    """Today's instant (UTC), ISO 8601 to the second."""
    return dt.datetime.now(dt.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def refuse(faults: Sequence[Any], home: str) -> FaultyEditsError:
    """The error that names all faulty rows of a home."""
    listed = "; ".join(str(fault) for fault in faults[:20])
    more = f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
    error = FaultyEditsError(
        f"nothing was taken in: {len(faults)} rows are faulty: {listed}{more}",
        change="mend these rows and pull again, or take the others in alone (`--sound`)",
        file=home,
    )
    error.faults = tuple(faults)
    return error
