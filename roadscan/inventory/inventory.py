"""The inventory as a whole: the operations of the command line and of Python."""

from __future__ import annotations

import datetime as dt
import getpass
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.errors import ConfigError, nearest
from roadscan.core.extras import needed
from roadscan.core.gpstime import now_utc
from roadscan.core.witness import Finding
from roadscan.inventory.changes import EpochChanges, Event, epoch_changes, history_of
from roadscan.inventory.checks import faults_of
from roadscan.inventory.comparing import (
    Changes,
    Pulling,
    clocked,
    compared,
    new_edits,
    published_rows,
    published_table,
    refuse,
)
from roadscan.inventory.conflicts import Conflict, conflict_rows, conflicts_of
from roadscan.inventory.diff import Differences, differences
from roadscan.inventory.edits import Edit, edit_rows
from roadscan.inventory.home import FID, Author, Content, EditFault, Home, HomeError, Mark, Sheet
from roadscan.inventory.homes.page_edits import EditOutcome, PageDocument, PageEdits
from roadscan.inventory.qgis import Raster, Source, project_text
from roadscan.inventory.recording import Found, Rules, record
from roadscan.inventory.state import State, commit_at, live_commits, state_at
from roadscan.store.asset_schema import asset_kind_names, asset_schema, asset_table
from roadscan.store.asset_truth import AssetTruth, Commit, Draft
from roadscan.store.digest import bytes_digest

if TYPE_CHECKING:
    import pandas as pd

When = str | dt.date | int | None
"""A day (UTC, its end), an instant with zone, or the number of a commit; today where it is None."""


@dataclass(frozen=True)
class Published:
    """The state that a home shows now."""

    home: str
    commit: int
    assets: int
    conflicts: int
    recorded: Commit | None
    """The commit that recorded what the newest run found; None if that was recorded already."""


@dataclass(frozen=True)
class Pulled:
    """The result of a pull from a home."""

    home: str
    commit: int | None
    """None where nothing was new."""
    edits: tuple[Edit, ...]
    refused: tuple[EditFault, ...]
    """Rows that were not accepted, if only sound ones were asked for."""
    conflicts: int
    findings: tuple[Finding, ...] = ()
    """Findings on the accepted edits."""


@dataclass(frozen=True)
class Status:
    """The state of the inventory, its home and pending changes."""

    commits: int
    assets: Mapping[str, Mapping[str, int]]
    """Number of assets by kind and status."""
    conflicts: int
    epochs: Sequence[str]
    home: str
    published: int | None
    """Commit that the home shows; None before it was published."""
    to_pull: int
    """Values that were changed in the home and not pulled."""
    to_publish: int
    """Commits since the home was published."""


@dataclass
class Inventory:
    """An inventory in its store, with the home in which people edit it."""

    truth: AssetTruth
    home: Home
    name: str
    rules: Rules
    found: Callable[[], Found | None] = field(default=lambda: None)
    """Returns what the newest run found; None where there is nothing."""
    crs: str | None = None
    rasters: Callable[[Path], Sequence[Raster]] = field(default=lambda folder: ())
    """Products shown behind the assets in QGIS, for a project file in a folder."""

    def state(self, as_of: When = None) -> State:
        """Returns the state of the inventory at a time."""
        self.truth.renew()
        return state_at(self.truth, commit_at(self.truth, as_of))

    def record(self, found: Found | None = None, who: str | None = None, why: str = "") -> Commit | None:
        """Record what a run found, by default the newest; None if that is recorded already."""
        given = found or self.found()
        if given is None:
            return None
        with self.truth.alone():
            return record(self.truth, given, self.rules, who or getpass.getuser(), why)

    def publish(self, *, discard: bool = False) -> Published:
        """Record what the newest run found, then show today's state in the home.

        Raises
        ------
        HomeError
            where the home holds changes that were not pulled, unless they are to be discarded; or cannot be written.
        """
        with self.truth.alone():
            mark = self.home.mark()
            self._check_own(mark)
            if mark is not None and not discard:
                self._check_pulled()
            given = self.found()
            recorded = None if given is None else record(self.truth, given, self.rules, getpass.getuser())
            state = state_at(self.truth)
            conflicts = conflicts_of(state)
            content = shown_content(state)
            at = self.truth.commits[-1].at if self.truth.commits else "1980-01-06T00:00:00Z"
            token = self._token("publish", state.commit, mark)
            self.truth.keep_published(token, published_table(content))
            self.home.write(content, self._sheets(state, conflicts), Mark(self.name, token, "", state.commit, at))
            self._write_project()
        assets = sum(rows.num_rows for rows in content.rows.values())
        return Published(self.home.name, state.commit, assets, len(conflicts), recorded)

    def _token(self, step: str, commit: int, mark: Mark | None) -> str:
        """Returns the name of the rows that a home has after a step; those of an interrupted pull keep their name."""
        said = f"{step}/{self.name}/{self.home.name}/{commit}/{mark.token if mark else ''}"
        return f"{commit:06d}-{bytes_digest(said.encode()).rpartition(':')[2][:16]}"

    def _sheets(self, state: State, conflicts: list[Conflict]) -> list[Sheet]:
        sheets = [Sheet("conflicts", "Conflicts", conflict_rows(state, conflicts))]
        found = epoch_changes(self.truth, None, None, self.rules.unit_m) or EpochChanges("", "", (), 0)
        sheets.append(
            Sheet("changes", f"Changes {found.before} to {found.after}" if found.before else "Changes", found.layer())
        )
        return sheets

    def pull(
        self, *, home: Home | None = None, who: str | None = None, why: str = "", sound: bool = False,
        confirm: Collection[str] = (),
    ) -> Pulled:  # fmt: skip
        """Take in what people changed in a home.

        Parameters
        ----------
        home : by default the survey's home, else a copy of it.
        who, why : of edits whose home does not record them.
        sound : take in sound rows where others are faulty; else nothing is taken in then.
        confirm : ids of assets (`fid N` of drawn ones) whose unlikely places or sizes are right, and names of layers
            whose deletions are; `all` stands for each.

        Raises
        ------
        FaultyEditsError
            where rows are faulty; it lists all of them.
        HomeError
            where the home is not one of this inventory, lacks a table or column, or cannot be written.
        """
        place = home or self.home
        with self.truth.alone():
            mark, changes, content = self._changes(place)
            now = state_at(self.truth)
            odd = {(fault.table, fault.record) for fault in content.faults}
            judged = faults_of(changes, now, self.rules.unit_m, {*confirm, *content.confirmed})
            faults = [*content.faults, *(one for one in judged if (one.table, one.record) not in odd)]
            taken = _without(changes, faults)
            base = now if mark.commit == now.commit else state_at(self.truth, mark.commit)
            authors, findings = self._authors(content, mark, pulled_at := now_utc())
            pulling = Pulling(base, now, who or getpass.getuser(), why, place.name, authors, pulled_at)
            edits, undecided = new_edits(taken, content.decisions, pulling)
            faults += undecided
            if faults and not sound:
                raise refuse(faults, place.name)
            commit = self._append(place, mark, edits, _as_read(changes, faults), why)
        waiting = len(conflicts_of(state_at(self.truth))) if commit is not None else len(conflicts_of(now))
        return Pulled(place.name, commit, tuple(edits), tuple(faults), waiting, findings)

    def _authors(
        self, content: Content, mark: Mark, now: str
    ) -> tuple[Mapping[tuple[str, str, str], Author], tuple[Finding, ...]]:
        shown_at = self.truth.commits[mark.commit - 1].at if mark.commit else ""
        if not shown_at:
            return content.authors, ()
        authors, findings = clocked(content.authors, shown_at, now)
        return authors, tuple(findings)

    def pull_page(
        self, document: PageDocument, *, who: str | None = None, why: str = "", sound: bool = False,
        confirm: Collection[str] = (),
    ) -> tuple[Pulled, list[EditOutcome]]:  # fmt: skip
        """Take in edits made in the page of a survey; returns the outcome of each of them as well.

        Parameters
        ----------
        who, why : of edits of which the document does not tell; sound, confirm : as :meth:`pull`.

        Raises
        ------
        FaultyEditsError
            where edits are faulty; it lists all of them.
        HomeError
            where the page showed another inventory, or a commit that this one does not have.
        """
        commit = document.edits.commit
        self._check_own(document.mark, document)
        self.truth.renew()
        if commit > len(self.truth.commits):
            raise HomeError(
                f"the page showed commit {commit}, and the inventory has {len(self.truth.commits)}",
                change="publish the page again, and make the edits there",
                file=document.name,
            )
        home = PageEdits(document, shown_content(self.state(commit)).rows)
        pulled = self.pull(home=home, who=who, why=why, sound=sound, confirm=confirm)
        return pulled, home.outcomes(pulled.edits, pulled.refused, self.conflicts())

    def _append(self, place: Home, mark: Mark, edits: list[Edit], rows: Content, why: str) -> int | None:
        """Commit edits and mark the home, in steps that may be interrupted after any of them.

        The home first stores the token that it will get; once a commit has that token, it counts as given.
        """
        if not edits:
            return None
        number = len(self.truth.commits) + 1
        token = self._token("pull", number, mark)
        place.note(mark._replace(pending=token))
        if place.made_of is None:
            self.truth.keep_published(token, published_table(rows))
        who = edits[0].who if len({e.who for e in edits}) == 1 else "several"
        stamped = [edit._replace(commit=number) for edit in edits]
        commit = self.truth.append(Draft("edits", who, why, place.name, run=token), edit_rows(stamped))
        place.note(mark._replace(token=token, pending=""))
        return commit.number

    def _changes(self, place: Home) -> tuple[Mark, Changes, Content]:
        """Returns the rows from which a home was made, and the differences in it."""
        mark = place.mark()
        if mark is None:
            raise HomeError("nothing was published there yet", change="`roadscan inventory publish`", file=place.name)
        self._check_own(mark, place)
        if mark.pending and any(c.run == mark.pending for c in self.truth.commits):
            mark = mark._replace(token=mark.pending, pending="")
        base = None if place.made_of is not None else self.truth.published(mark.token)
        if (base is None and place.made_of is None) or mark.commit > len(self.truth.commits):
            raise HomeError(
                "it was published from another store, or from one that was lost",
                change="publish to a new file, and bring over what was edited by hand",
                file=place.name,
            )
        content = place.read()
        rows = place.made_of if place.made_of is not None else published_rows(base)
        lost = [asset_schema(kind).table for kind, held in rows.items() if held.num_rows and kind not in content.rows]
        if lost:
            raise HomeError(
                f"the layer '{lost[0]}' is missing",
                change="undo its deletion, or pull from a copy: an emptied layer would say that all are gone",
                file=place.name,
            )
        return mark, compared(content, rows, mark.token or f"commit {mark.commit}", self.rules.unit_m), content

    def _write_project(self) -> None:
        """Write the QGIS project file if there is none yet: people arrange it to their liking."""
        file = self.home.project_file
        if file is None or file.exists():
            return
        kinds = asset_kind_names()
        text = project_text(
            f"Inventory {self.name}", kinds, lambda table: Source(*self.home.layer_address(table)), self.crs,
            self.rasters(file.parent),
        )  # fmt: skip
        try:
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise HomeError(f"the project file cannot be written: {error.strerror}", file=file) from error

    def _check_own(self, mark: Mark | None, place: Home | PageDocument | None = None) -> None:
        if mark is not None and mark.inventory != self.name:
            raise HomeError(
                f"it is the home of the inventory '{mark.inventory}'",
                expected=f"'{self.name}'",
                file=(place or self.home).name,
            )

    def _check_pulled(self) -> None:
        count = self._to_pull()
        if count:
            raise HomeError(
                f"it holds {count} changes that were not pulled",
                change="`roadscan inventory pull` first, or `publish --discard` to drop them",
                file=self.home.name,
            )

    def _to_pull(self) -> int:
        mark, changes, content = self._changes(self.home)
        now = state_at(self.truth)
        pulling = Pulling(state_at(self.truth, mark.commit), now, "", "", "", {}, now_utc())
        edits, undecided = new_edits(changes, content.decisions, pulling)
        return len(edits) + len(undecided) + len(changes.faults) + len(content.faults)

    def status(self) -> Status:
        """Returns the status, and what a pull and a publication would do."""
        state = self.state()
        mark = self.home.mark()
        assets = {
            kind: {one["values"]: one["counts"] for one in pc.value_counts(own.rows["status"]).to_pylist()}
            for kind, own in state.assets.items()
        }
        epochs = sorted({c.epoch for c in live_commits(self.truth.commits) if c.kind == "found"})
        return Status(
            state.commit, assets, len(conflicts_of(state)), epochs, self.home.name, mark.commit if mark else None,
            self._to_pull() if mark else 0, state.commit - (mark.commit if mark else 0),
        )  # fmt: skip

    def conflicts(self, as_of: When = None) -> list[Conflict]:
        """Returns the values on which people and evidence, or two persons, disagree."""
        return conflicts_of(self.state(as_of))

    def diff(self, before: When, after: When = None) -> Differences:
        """Returns the differences between two times: assets that came or went, and single values; as named tuples."""
        return differences(self.state(before), self.state(after))

    def changes(self, before: str | None = None, after: str | None = None) -> EpochChanges | None:
        """Returns the changes on the road between two survey epochs, by default the last two."""
        self.truth.renew()
        return epoch_changes(self.truth, before, after, self.rules.unit_m)

    def history(self, asset_id: str) -> list[Event]:
        """Returns all findings and edits of an asset, in the order of the commits.

        Raises
        ------
        ConfigError
            where there is no such asset.
        """
        self.truth.renew()
        events = history_of(self.truth, asset_id)
        if not events:
            known = list(self.state().kind_of)
            raise ConfigError(f"there is no asset '{asset_id}'{nearest(asset_id, known)}")
        return events

    def assets(self, kind: str, as_of: When = None) -> pd.DataFrame:
        """Assets of a kind as a GeoDataFrame in the map's CRS, by id."""
        geopandas: Any = needed("geopandas", "a GeoDataFrame")
        schema = asset_schema(kind)
        own = self.state(as_of).assets.get(kind)
        rows = asset_table(schema.kind).empty_table() if own is None else own.rows
        frame = rows.to_pandas()
        frame["geometry"] = geopandas.GeoSeries.from_wkb(frame["geometry"], crs=self.crs)
        result: pd.DataFrame = geopandas.GeoDataFrame(frame, geometry="geometry", crs=self.crs)
        return result

    def undo(self, commit: int, who: str | None = None, why: str = "") -> Commit:
        """Undo a commit of a run or of edits, or undo an undoing; the truth keeps both.

        Raises
        ------
        ConfigError
            where there is no such commit, or it is undone.
        """
        with self.truth.alone():
            commits = self.truth.commits
            if not 1 <= commit <= len(commits):
                raise ConfigError(f"commit {commit}", expected=f"1 to {len(commits)}")
            undone = {c.undoes for c in _undoing(commits)}
            if commit in undone:
                raise ConfigError(f"commit {commit} is undone already", change="undo the commit that undid it instead")
            return self.truth.append(Draft("undo", who or getpass.getuser(), why, "", undoes=commit))

    def export(self, file: Path, form: str, as_of: When = None) -> int:
        """Write the inventory at a time as gpkg, geojson, csv or dxf; returns the number of assets.

        Raises
        ------
        ConfigError
            where the form is unknown.
        """
        from roadscan.inventory.diff import export

        return export(self.state(as_of), file, form, self.crs)


def _undoing(commits: Sequence[Commit]) -> list[Commit]:
    """Returns the undoings in force."""
    undone: set[int] = set()
    counted = []
    for commit in reversed(commits):
        if commit.kind == "undo" and commit.number not in undone:
            undone.add(commit.undoes)
            counted.append(commit)
    return counted


def shown_content(state: State) -> Content:
    """Returns a state as homes show it: without rejected assets, numbered."""
    rows = {}
    for kind, assets in state.assets.items():
        own = assets.rows.filter(pc.not_equal(assets.rows["status"], "rejected"))
        fids = pa.array(np.arange(1, own.num_rows + 1), pa.int64())
        rows[kind] = own.add_column(0, FID, fids)
    return Content(rows)


def _without(changes: Changes, faults: Sequence[EditFault]) -> Changes:
    """Returns changes without those of faulty rows."""
    bad = _bad(faults)
    return Changes(
        [c for c in changes.changed if (asset_schema(c.kind).table, c.record) not in bad],
        [c for c in changes.drawn if (asset_schema(c.kind).table, c.record) not in bad],
        [(kind, one) for kind, one in changes.deleted if not _all_deletions_of(kind) & bad],
    )


def _all_deletions_of(kind: str) -> set[tuple[str, str]]:
    """Returns the record that a fault of a layer's deletions has: the layer's name."""
    table = asset_schema(kind).table
    return {(table, table)}


def _bad(faults: Sequence[EditFault]) -> set[tuple[str, str]]:
    return {(fault.table, fault.record) for fault in faults}


def _as_read(changes: Changes, faults: Sequence[EditFault]) -> Content:
    """Returns rows as read, with their ids; refused rows keep their former values, to be compared again."""
    bad = _bad(faults)
    rows = {}
    for kind, own in changes.rows.items():
        table, before = asset_schema(kind).table, changes.before[kind]
        ids = own["asset_id"].to_pylist()
        keep = [
            (table, one) not in bad and (table, f"fid {fid}") not in bad
            for one, fid in zip(ids, own[FID].to_pylist(), strict=True)
        ]
        again = [one for one, is_kept in zip(ids, keep, strict=True) if not is_kept]
        if _all_deletions_of(kind) & bad:
            again += [one for other, one in changes.deleted if other == kind]
        refused = pa.array(again, pa.string())
        former = before.filter(pc.is_in(before["asset_id"], value_set=refused))
        rows[kind] = pa.concat_tables([own.filter(pa.array(keep, pa.bool_())), former])
    return Content(rows)


__all__ = ["Inventory", "Published", "Pulled", "Status", "When"]
