"""Conflicts: values on which a person and the evidence, or two persons, disagree. A person decides each of them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from roadscan.inventory.edits import REJECTED, Edit
from roadscan.inventory.state import State, reference_points
from roadscan.inventory.values import decoded, encoded, sigmas_apart
from roadscan.store.asset_schema import GEOMETRY, asset_schema

CONFLICT_COLUMNS: Final = (
    "asset_id", "layer", "attribute", "reason", "in_force", "other", "base", "sigmas", "who", "edit", "pictures",
)  # fmt: skip
"""Columns of the layer in which people see conflicts."""
DECISION: Final = "decision"
"""The column in which people write their decision."""
SIGNIFICANT: Final = 3.0
"""Values that differ by at least this many σ disagree."""

_TYPES: Final = {"sigmas": pa.float64(), "geometry": pa.binary()}


class Conflict(NamedTuple):
    """One disagreement about a value of an asset."""

    asset_id: str
    kind: str
    attribute: str
    reason: str
    """`evidence`: what was found has changed since the edit; `edit`: another person's edit waits; `rejected`: one
    rejected the asset, or its parent, while another edited it; `undone`: the run that found the edited asset, or the
    pull that drew it, was undone."""
    edit: str
    """Name of the waiting edit, or of the one in force."""
    in_force: str | None
    """Value in force, as JSON."""
    other: str | None
    """Value of the evidence, or of the waiting edit."""
    base: str | None
    """Value from which both started."""
    sigmas: float | None
    """Difference of the two in σ; null where that has no meaning."""
    who: str


def conflicts_of(state: State) -> list[Conflict]:
    """Returns all conflicts of a state, by asset and attribute."""
    found = [one for edit in state.edits.in_force.values() if (one := _with_evidence(state, edit)) is not None]
    for key, waiting in state.edits.waiting.items():
        known = state.edits.in_force.get(key)
        found += [_with_edit(state, edit, known) for edit in waiting]
    found += _rejected_while_edited(state) + _on_rejected_parents(state)
    found += [
        Conflict(e.asset_id, e.kind, e.attribute, "undone", e.edit, e.new, None, e.evidence, None, e.who)
        for e in state.edits.in_force.values()
        if e.asset_id in state.orphans and not e.settles and (e.attribute, e.new) != ("status", REJECTED)
    ]
    return sorted(found, key=lambda c: (c.asset_id, c.attribute, c.reason, c.edit))


def _with_evidence(state: State, edit: Edit) -> Conflict | None:
    """Returns conflicts where evidence differs by over 3 σ from an edit, and from the evidence its author had seen."""
    row = state.row(edit.asset_id, evidence=True)
    if row is None or row["source"] is None or edit.asset_id in state.orphans:
        return None
    now, given, base = (
        row.get(edit.attribute),
        decoded(edit.kind, edit.attribute, edit.new),
        decoded(edit.kind, edit.attribute, edit.evidence),
    )
    if now is None or (edit.attribute == "status" and (given, now) == ("rejected", "missing")):
        return None
    away, moved = (sigmas_apart(edit.kind, edit.attribute, now, one, row, state.units_m) for one in (given, base))
    if away <= SIGNIFICANT or moved <= SIGNIFICANT:
        return None
    sigmas = away if math.isfinite(away) else None
    return Conflict(
        edit.asset_id, edit.kind, edit.attribute, "evidence", edit.edit, edit.new, encoded(now), edit.evidence, sigmas,
        edit.who,
    )  # fmt: skip


def _with_edit(state: State, waiting: Edit, known: Edit | None) -> Conflict:
    in_force = known.new if known is not None else encoded((state.row(waiting.asset_id) or {}).get(waiting.attribute))
    return Conflict(
        waiting.asset_id, waiting.kind, waiting.attribute, "edit", waiting.edit, in_force, waiting.new, waiting.old,
        None, waiting.who,
    )  # fmt: skip


def _rejected_while_edited(state: State) -> list[Conflict]:
    """Returns conflicts of edits on rejected assets where neither person had seen what the other did."""
    rejected = {e.asset_id: e for e in state.edits.in_force.values() if e.attribute == "status" and e.new == REJECTED}
    if not rejected:
        return []
    return [
        Conflict(
            e.asset_id, e.kind, e.attribute, "rejected", e.edit, rejected[e.asset_id].new, e.new, e.old, None, e.who
        )
        for e in state.edits.in_force.values()
        if e.attribute != "status"
        and (r := rejected.get(e.asset_id)) is not None
        and e.commit != r.commit
        and max(e.commit, r.commit) > min(e.commit, r.commit) > max(e.base_commit, r.base_commit)
    ]


def _on_rejected_parents(state: State) -> list[Conflict]:
    """Returns conflicts of parents that people assigned and that people rejected, until they are decided."""
    rejected = set(state.edits.rejected)
    return [
        Conflict(e.asset_id, e.kind, e.attribute, "rejected", e.edit, e.new, None, e.evidence, None, e.who)
        for e in state.edits.in_force.values()
        if e.attribute == "parent" and not e.settles and e.asset_id not in rejected
        if decoded(e.kind, e.attribute, e.new) in rejected
    ]


def conflict_rows(state: State, conflicts: list[Conflict]) -> pa.Table:
    """Returns the conflicts as a layer at the places of their assets, with an empty `decision`."""
    rows = []
    for one in conflicts:
        row: dict[str, Any] = state.row(one.asset_id) or {}
        place = None
        if row.get(GEOMETRY) is not None:
            points = reference_points(np.asarray(shapely.from_wkb([row[GEOMETRY]])))
            place = shapely.to_wkb(shapely.Point(points[0]), flavor="iso")
        values = {name: value_shown(one, name) for name in ("in_force", "other", "base")}
        layer = asset_schema(one.kind).table
        named = {"layer": layer, "pictures": pictures_of(row), DECISION: None, GEOMETRY: place}
        rows.append(one._asdict() | values | named)
    names = [*CONFLICT_COLUMNS, DECISION, GEOMETRY]
    schema = pa.schema([pa.field(name, _TYPES.get(name, pa.string())) for name in names])
    return pa.Table.from_pylist([{name: row[name] for name in names} for row in rows], schema)


def pictures_of(row: Mapping[str, Any]) -> str | None:
    """Returns the files of the pictures that show an asset, one a line, the best first; None where no picture is named.

    Parameters
    ----------
    row : the asset; its column `pictures`, where its kind has one, is a list in JSON whose entries name their `file`.
    """
    told = row.get("pictures")
    files = [one["file"] for one in json.loads(told)] if told else []
    return "\n".join(files) or None


def value_shown(conflict: Conflict, name: str) -> str | None:
    """Returns a value of a conflict (`in_force`, `other`, `base`) as readable text: geometries as WKT, to the mm."""
    value = decoded(conflict.kind, conflict.attribute, getattr(conflict, name))
    if isinstance(value, bytes):
        return str(shapely.to_wkt(shapely.from_wkb(value), rounding_precision=3))
    return None if value is None else str(value)
