"""Edits: what people changed, and which edits are in force.

Merging goes value by value. An edit is in force from its commit on, whatever later evidence says. If its author had
not seen the value that another edit has since put in force, it waits among the conflicts: neither is dropped.
neither is dropped.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import pyarrow as pa

from roadscan.inventory.values import encoded
from roadscan.store.asset_truth import AssetTruth, Commit
from roadscan.store.digest import bytes_digest
from roadscan.store.schema import table_schema

REJECTED: Final = encoded("rejected")
"""The status of a rejected asset, as edits encode it."""


class Edit(NamedTuple):
    """One change; `schemas/asset_edits.toml` says what each field is."""

    edit: str
    commit: int
    asset_id: str
    kind: str
    attribute: str
    action: str
    old: str | None
    new: str | None
    evidence: str | None
    base_commit: int
    who: str
    made_at: str
    why: str
    source: str
    settles: str | None = None

    @property
    def key(self) -> tuple[str, str]:
        """Returns the key of the value that it changes."""
        return self.asset_id, self.attribute


def named(edit: Edit) -> Edit:
    """Returns the edit with its name: a digest of its content, of the state it was made on and of its place."""
    said = (
        edit.asset_id, edit.attribute, edit.action, edit.old, edit.new, edit.base_commit, edit.who, edit.made_at,
        *([edit.settles] if edit.settles else []),
    )  # fmt: skip
    return edit._replace(edit=bytes_digest(repr(said).encode()).rpartition(":")[2][:16])


def edit_rows(edits: Sequence[Edit]) -> pa.Table:
    """Returns edits as rows of the table `asset_edits`."""
    ordered = sorted(edits, key=lambda e: (e.asset_id, e.attribute))
    return pa.Table.from_pylist([e._asdict() for e in ordered], table_schema("asset_edits").arrow())


def read_edits(truth: AssetTruth, commits: Iterable[Commit]) -> list[Edit]:
    """Returns the edits of some commits, in order."""
    return [
        Edit(**row)
        for commit in commits
        if commit.kind == "edits"
        for row in truth.rows(commit).select(list(Edit._fields)).to_pylist()
    ]


@dataclass
class Folded:
    """The result of applying a sequence of edits."""

    in_force: dict[tuple[str, str], Edit] = field(default_factory=dict)
    waiting: dict[tuple[str, str], list[Edit]] = field(default_factory=lambda: defaultdict(list))
    """Edits that conflict with one in force which their author had not seen, until a decision settles them."""
    created: dict[str, Edit] = field(default_factory=dict)
    """By asset: the edit that drew it, whatever happened to it since."""
    settled: set[str] = field(default_factory=set)
    """Names of edits whose conflicts a decision settled."""

    def take(self, edit: Edit) -> None:
        """Apply one more edit."""
        if edit.action == "create":
            self.created.setdefault(edit.asset_id, edit)
        known = self.in_force.get(edit.key)
        blind = known is not None and known.new not in (edit.old, edit.new)
        if blind and edit.action != "withdraw":
            self.waiting[edit.key].append(edit)
            return
        if edit.action == "withdraw":
            self.in_force.pop(edit.key, None)
        else:
            self.in_force[edit.key] = edit
        settled = (edit.settles or "").split(",")
        self.settled.update(settled)
        left = [e for e in self.waiting.pop(edit.key, []) if e.edit not in settled and e.new != edit.new]
        if left:
            self.waiting[edit.key] = left

    @property
    def rejected(self) -> list[str]:
        """Returns ids of the assets that people rejected."""
        return [asset for (asset, name), edit in self.in_force.items() if (name, edit.new) == ("status", REJECTED)]

    def holds(self, edit: Edit) -> bool:
        """Returns True if the edit says nothing new: its value is in force, or waits already."""
        known = self.in_force.get(edit.key)
        if edit.action == "withdraw":
            return known is None
        if known is not None and known.new == edit.new:
            return True
        return any(e.new == edit.new and e.old == edit.old for e in self.waiting.get(edit.key, ()))


def folded(edits: Iterable[Edit]) -> Folded:
    """Returns the edits in force, and those that wait, after a sequence of commits."""
    state = Folded()
    for edit in edits:
        state.take(edit)
    return state
