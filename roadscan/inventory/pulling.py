"""Edits of a home's changes: what each value was, what the evidence said, who changed it."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from roadscan.inventory.comparing import Changes
from roadscan.inventory.edits import Edit, Folded, named
from roadscan.inventory.home import Author, Decision, FaultyEditsError
from roadscan.inventory.state import State
from roadscan.inventory.values import encoded
from roadscan.model.errors import ConfigError
from roadscan.tables.inventory_schema import GEOMETRY

_REJECTED: Final = encoded("rejected")


@dataclass(frozen=True)
class Pulling:
    """What edits of one pull have in common."""

    base: State
    """The state that was published."""
    now: State
    who: str
    why: str
    source: str
    authors: dict[tuple[str, str], Author]
    at: str


def new_edits(changes: Changes, decisions: Sequence[Decision], pulling: Pulling) -> list[Edit]:
    """Edits that the truth does not hold yet, one a value."""
    decided = list(_decided(decisions, pulling))
    settled = {edit.key for edit in decided}
    made = decided + [e for e in _changed(changes, pulling) if e.key not in settled and not _is_held(e, pulling)]
    unique = {edit.key: named(edit) for edit in made}
    return list(unique.values())


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
    author = pulling.authors.get((kind, asset_id)) or pulling.authors.get((kind, f"fid {fid}"))
    who, at, why = author if author is not None else ("", "", "")
    evidence = (pulling.base.row(asset_id, evidence=True) or {}).get(attribute)
    return Edit(
        "", 0, asset_id, kind, attribute, action, None if old is None else encoded(old), encoded(new),
        None if evidence is None else encoded(evidence), pulling.base.commit, who or pulling.who, at or pulling.at,
        why or pulling.why, pulling.source,
    )  # fmt: skip


def _decided(decisions: Sequence[Decision], pulling: Pulling) -> Iterator[Edit]:
    """Edits that settle conflicts; they know all that is in the truth today."""
    for one in decisions:
        key = (one.asset_id, one.attribute)
        known = pulling.now.edits.in_force.get(key)
        waiting = {e.edit: e for e in pulling.now.edits.waiting.get(key, ())}
        if one.edit not in waiting and (known is None or known.edit != one.edit):
            continue  # it was settled since
        kind = pulling.now.kind_of.get(one.asset_id)
        if kind is None:
            continue
        evidence = (pulling.now.row(one.asset_id, evidence=True) or {}).get(one.attribute)
        if one.choice == "other" and one.edit not in waiting:
            raise ConfigError(
                "the decision is 'other', and no other edit waits",
                expected="edit or evidence",
                record=f"conflicts, {one.asset_id}, {one.attribute}",
            )
        old = known.new if known is not None else None
        if one.choice == "other":
            new: str | None = waiting[one.edit].new
        else:
            new = old if one.choice == "edit" and known is not None else encoded(evidence)
        action = "withdraw" if one.choice == "evidence" or (known is None and one.choice == "edit") else "set"
        yield Edit(
            "", 0, one.asset_id, kind, one.attribute, action, old, new, None if evidence is None else encoded(evidence),
            pulling.now.commit, pulling.who, pulling.at, pulling.why or f"conflict settled: {one.choice}",
            pulling.source,
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
