"""Conversion of a home's changes to edits: the former value, the evidence at that time, the author."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from roadscan.core.witness import Finding, Witness
from roadscan.inventory.comparing import Changes
from roadscan.inventory.conflicts import conflicts_of
from roadscan.inventory.edits import REJECTED, Edit, Folded, named
from roadscan.inventory.home import Author, Decision, EditFault, FaultyEditsError
from roadscan.inventory.state import State
from roadscan.inventory.values import decoded, encoded
from roadscan.store.inventory_schema import GEOMETRY

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
