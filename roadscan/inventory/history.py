"""The history of one asset."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pyarrow.compute as pc

from roadscan.inventory.state import live_commits
from roadscan.store.asset_truth import AssetTruth, Commit


class Event(NamedTuple):
    """One event in an asset's history."""

    commit: int
    at: str
    who: str
    what: str
    """`found`, `not seen`, `edited`, `drawn`, `withdrawn` or `undone`."""
    attribute: str
    old: str | None
    """As JSON; so is `new`."""
    new: str | None
    why: str


def history_of(truth: AssetTruth, asset_id: str) -> list[Event]:
    """Returns the events of an asset, in the order of the commits."""
    counted = {c.number for c in live_commits(truth.commits)}
    touched: set[int] = set()
    events: list[Event] = []
    for commit in truth.commits:
        if commit.kind == "undo":
            if commit.undoes in touched:
                touched.add(commit.number)
                events.append(
                    Event(commit.number, commit.at, commit.who, "undone", "", str(commit.undoes), None, commit.why)
                )
            continue
        own = list(_events(truth, commit, asset_id))
        if own:
            touched.add(commit.number)
        events += [e if commit.number in counted else e._replace(why=f"{e.why} (undone)".strip()) for e in own]
    return events


def _events(truth: AssetTruth, commit: Commit, asset_id: str) -> Iterator[Event]:
    rows = truth.rows(commit)
    for row in rows.filter(pc.equal(rows["asset_id"], asset_id)).to_pylist():
        if commit.kind == "found" and row["seen"]:
            where = f"{row['easting_m']:.3f} {row['northing_m']:.3f} {row['height_m']:.3f}"
            yield Event(commit.number, commit.at, commit.who, "found", "", None, where, f"epoch {commit.epoch}")
        elif commit.kind == "found":
            expected = row["passes_expected"]
            told = "not known how many passes should have" if expected is None else f"{expected} passes should have"
            yield Event(
                commit.number, commit.at, commit.who, "not seen", "", None, None, f"epoch {commit.epoch}; {told}"
            )
        else:
            what = {"create": "drawn", "set": "edited", "withdraw": "withdrawn"}[row["action"]]
            values = (row["attribute"], row["old"], row["new"], row["why"])
            yield Event(commit.number, row["made_at"], row["who"], what, *values)
