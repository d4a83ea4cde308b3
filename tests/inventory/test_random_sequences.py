"""Random sequences of edits by two persons, reprocessings, new epochs, undone runs and killed programs: none is lost.

In the nightly tests on a GeoPackage and on PostGIS programs die by kill −9; in memory they stop at one of their writes.
"""

from __future__ import annotations

import copy
import datetime as dt
import json
import math
import os
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from roadscan.inventory.conflicts import conflicts_of
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.state import State, commit_at, live_commits, state_at
from tests.inventory.dying import Death, Job, Killed, Programs, Work, inventory_of, programs
from tests.inventory.edited_homes import KINDS, InDatabase, InFile, Memory
from tests.inventory.postgres import server
from tests.inventory.streets import CRS, EAST, NORTH, SPRING, asset, found

COUNT = 8
LEAST_MOVE_M = 1e-3
"""A shorter move is no edit: places that differ by 0.1 mm are the same one (`comparing._STEP`)."""
TELLS = 20
"""Sequences between two lines of output."""


DEATHS = st.runner().flatmap(lambda street: street.deaths)


class Street(RuleBasedStateMachine):
    """A street, its inventory, and a person; what the person did is written down beside."""

    deaths: Any = st.none() | st.integers(0, 8)
    """When a program dies: at which of its writes, or after how much processor time (s)."""
    tally: Counter[str] = Counter()

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        Death.left = None
        self.home = self.new_home()
        self.number = 0
        self.year = 0
        self.truth_poles = {n: (20.0 * n, 4.0) for n in range(COUNT)}
        self.names: dict[int, str] = {}
        self.pulled: dict[tuple[str, str], Any] = {}
        """Values that a pull took in, by asset and attribute."""
        self.copy: Any = None
        """Copy of the home that another person has."""
        self.waits: set[tuple[tuple[str, str], Any]] = set()
        """Values that met others which were in force, until they are in force themselves."""
        self.drawn_at: list[tuple[float, float]] = []
        self.days: list[tuple[int, dict[str, Any]]] = []
        self.checked = 0
        self.is_edited = False

    def new_home(self) -> Any:
        return Memory()

    def inventory(self) -> Inventory:
        return inventory_of(self.folder, self.opened())

    def opened(self) -> Any:
        """The home as another program opens it."""
        return self.home

    def copied(self) -> Any:
        """A copy of the home, which another person takes along; None where it has none."""
        return copy.deepcopy(self.home)

    def teardown(self) -> None:
        """At the end of a sequence all is taken in, and each remembered day is asked for."""
        Death.left = None
        self.publish(None)
        self.all_is_well()
        truth = self.inventory().truth
        for commit, values in self.days:
            assert values_of(state_at(truth, commit_at(truth, truth.commits[commit - 1].at))) == values
        state = state_at(truth)
        self.tally.update(
            sequences=1, commits=state.commit, days=len(self.days), pulled=len(self.pulled), drawn=len(self.drawn_at),
            in_force=len(state.edits.in_force), waiting=sum(map(len, state.edits.waiting.values())),
        )  # fmt: skip
        self.close()
        shutil.rmtree(self.folder, ignore_errors=True)
        if self.tally["sequences"] % TELLS == 0:
            self.tell()

    def close(self) -> None:
        """Look at what is left over of the home, and remove it."""

    @classmethod
    def tell(cls) -> None:
        """Print what has happened so far; the nightly tests take long."""
        tally = cls.tally
        stable = tally["stable"] / max(tally["asked"], 1)
        sys.stdout.write(f"{cls.__name__}: {dict(tally)}, ids stable {stable:.4%}\n")
        sys.stdout.flush()

    # --- what a program does

    def attempt(self, work: Work, dies: float | None) -> None:
        """Do something; where it dies of it, do it again as another program would."""
        if dies is not None:
            is_killed = self.dies(work, dies)
            if not is_killed:
                return
            self.tally["killed"] += 1
            state_at(self.inventory().truth)  # whole at any instant
        work.do(self.inventory())

    def dies(self, work: Work, dies: float) -> bool:
        """Whether a program died of a work that it was given."""
        Death.left = int(dies)
        try:
            work.do(self.inventory())
        except Killed:
            return True
        finally:
            Death.left = None
        return False

    def rows(self, noise: float, seen: set[int], height: float) -> list[dict[str, Any]]:
        random = np.random.default_rng(self.number)
        when = SPRING + dt.timedelta(days=365 * self.year)
        rows = []
        for n, (x, y) in sorted(self.truth_poles.items()):
            if n in seen:
                dx, dy = random.normal(0, noise, 2)
                rows.append(asset("pole", (x + dx, y + dy, 100.0), when=when, asset_height_m=height + 0.1 * n))
                rows.append(asset("sign", (x + dx, y + dy + 0.1, 102.5), when=when, width_m=0.6))
        return rows

    @initialize()
    def begin(self) -> None:
        self.process(seen=set(range(COUNT)), noise=0.02, height=5.0, dies=None)
        self.publish(dies=None)
        self.take_a_copy()

    @rule(
        seen=st.sets(st.integers(0, COUNT - 1), min_size=COUNT - 3, max_size=COUNT),
        noise=st.sampled_from([0.0, 0.02, 0.05]), height=st.sampled_from([5.0, 5.02, 6.5]),
        dies=DEATHS,
    )  # fmt: skip
    def process(self, seen: set[int], noise: float, height: float, dies: float | None) -> None:
        """The same drives again, with other parameters."""
        self.number += 1
        given = found(self.rows(noise, seen, height), f"year-{self.year}", KINDS)
        before = {n: self.names.get(n) for n in seen}
        self.attempt(Work(given), dies)
        state = state_at(self.inventory().truth)
        for n in seen:
            x, y = self.truth_poles[n]
            now = nearest_pole(state, x, y)
            if before[n] is not None:
                self.tally["asked"] += 1
                self.tally["stable"] += now == before[n]
            self.names[n] = now

    @rule(
        seen=st.sets(st.integers(0, COUNT - 1), min_size=COUNT - 2, max_size=COUNT),
        dies=DEATHS,
    )
    def new_epoch(self, seen: set[int], dies: float | None) -> None:
        """A survey a year later."""
        self.year += 1
        self.process(seen=seen, noise=0.02, height=5.0, dies=dies)

    @rule(dies=DEATHS)
    def publish(self, dies: float | None) -> None:
        self.note_edits()
        self.attempt(Work(publish=True), dies)
        self.seen_in_home = self.values_of_home()

    @precondition(lambda self: self.is_edited)
    @rule(dies=DEATHS)
    def pull(self, dies: float | None) -> None:
        self.note_edits()
        self.attempt(Work(), dies)
        self.seen_in_home = self.values_of_home()

    @rule(data=st.data())
    def undo_a_run(self, data: st.DataObject) -> None:
        inventory = self.inventory()
        runs = [c for c in live_commits(inventory.truth.commits) if c.kind == "found"]
        if len(runs) > 1:
            inventory.undo(data.draw(st.sampled_from(runs)).number)

    @precondition(lambda self: self.checked not in [number for number, _ in self.days])
    @rule()
    def remember_the_day(self) -> None:
        truth = self.inventory().truth
        self.days.append((len(truth.commits), values_of(state_at(truth))))

    # --- what a person does

    @rule(kind=st.sampled_from(KINDS), at=st.integers(0, 50), condition=st.integers(1, 10), n=st.integers(0, 10**6))
    def edit_attributes(self, kind: str, at: int, condition: int, n: int) -> None:
        rows = self.home_rows(kind)
        if rows:
            self.home.edit(kind, at % len(rows), condition=condition, comments=f"seen {n}")
            self.is_edited = True

    @rule(at=st.integers(0, 50), height=st.sampled_from([3.0, 4.0, 9.0]))
    def edit_height(self, at: int, height: float) -> None:
        rows = self.home_rows("pole")
        if rows:
            self.home.edit("pole", at % len(rows), asset_height_m=height)
            self.is_edited = True

    @rule(at=st.integers(0, 50), dx=st.floats(-0.3, 0.3), dy=st.floats(-0.3, 0.3))
    def move(self, at: int, dx: float, dy: float) -> None:
        rows = self.home_rows("pole")
        if rows and math.hypot(dx, dy) > LEAST_MOVE_M:
            place = shapely.from_wkb(rows[at % len(rows)]["geometry"])
            moved = shapely.Point(place.x + dx, place.y + dy, place.z)
            self.home.edit("pole", at % len(rows), geometry=shapely.to_wkb(moved, flavor="iso"))
            self.is_edited = True

    @rule(at=st.integers(0, 50))
    def delete(self, at: int) -> None:
        rows = self.home_rows("sign")
        if len(rows) > 3:
            self.home.delete("sign", at % len(rows))
            self.is_edited = True

    @rule(slot=st.integers(0, 40), n=st.integers(0, 10**6))
    def draw(self, slot: int, n: int) -> None:
        place = (10.0 + 20.0 * (slot % COUNT), -8.0 - 2.0 * (slot // COUNT))
        if place not in self.drawn_at:
            self.drawn_at.append(place)
            point = shapely.Point(EAST + place[0], NORTH + place[1], 100.0)
            self.home.draw("pole", shapely.to_wkb(point, flavor="iso"), comments=f"drawn {n}")
            self.is_edited = True

    # --- what another person does with a copy

    @rule()
    def take_a_copy(self) -> None:
        self.copy = self.copied()

    @precondition(lambda self: self.copy is not None)
    @rule(at=st.integers(0, 50), height=st.sampled_from([2.0, 4.0, 8.0]))
    def edit_the_copy(self, at: int, height: float) -> None:
        rows = self.copy.shown("pole").to_pylist()
        at %= len(rows)
        if rows[at]["asset_id"] is None or rows[at]["asset_height_m"] == height:
            return
        key = rows[at]["asset_id"], "asset_height_m"
        self.copy.edit("pole", at, asset_height_m=height)
        edits = self.inventory().pull(home=self.copy, who="max", confirm=("all",)).edits
        self.tally["copied"] += len(edits)
        row = state_at(self.inventory().truth).row(key[0])
        assert row is not None, key
        if row["asset_height_m"] == height:
            self.pulled[key] = height
        else:
            self.waits.add((key, height))

    # --- what has to hold

    def home_rows(self, kind: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self.home.shown(kind).to_pylist()
        return rows

    def values_of_home(self) -> dict[tuple[str, str], Any]:
        editable = ("condition", "comments", "asset_height_m", "geometry")
        return {
            (row["asset_id"], name): row[name]
            for kind in KINDS
            for row in self.home_rows(kind)
            if row["asset_id"] is not None
            for name in editable
            if name in row
        }

    def note_edits(self) -> None:
        """Write down what the person has changed since the home was read or written last."""
        self.is_edited = False
        if not hasattr(self, "seen_in_home"):
            return
        now = self.values_of_home()
        for key, value in now.items():
            if value != self.seen_in_home.get(key):
                self.pulled[key] = value
        for asset_id, name in self.seen_in_home:
            if (asset_id, name) not in now and name == "comments":
                self.pulled[asset_id, "status"] = "rejected"

    @invariant()
    def all_is_well(self) -> None:
        """Looked at after each commit."""
        truth = self.inventory().truth
        if len(truth.commits) == self.checked:
            return
        self.checked = len(truth.commits)
        state = state_at(truth)
        self.no_edit_is_lost(state)
        self.each_asset_is_there_once(state)

    def no_edit_is_lost(self, state: State) -> None:
        waiting = {(key, json.loads(e.new or "null")) for key, es in state.edits.waiting.items() for e in es}
        for (asset_id, name), value in self.pulled.items():
            row = state.row(asset_id)
            assert row is not None, asset_id
            shown = value.hex() if isinstance(value, bytes) else value
            assert row[name] == value or ((asset_id, name), shown) in waiting, (asset_id, name, value, row[name])
        conflicts = {
            ((c.asset_id, c.attribute), json.loads(c.other or "null"))
            for c in conflicts_of(state)
            if c.reason == "edit"
        }
        for (asset_id, name), value in set(self.waits):
            row = state.row(asset_id)
            assert row is not None, asset_id
            if row[name] == value:
                self.waits.remove(((asset_id, name), value))
            else:
                assert ((asset_id, name), value) in conflicts, (asset_id, name, value, row[name])

    def each_asset_is_there_once(self, state: State) -> None:
        for kind, assets in state.assets.items():
            assert len(set(assets.ids)) == assets.ids.size, kind
        if "pole" not in state.assets:
            return
        poles = state.assets["pole"]
        places = shapely.get_coordinates(poles.shapes)
        for n, (x, y) in self.truth_poles.items():
            near = np.hypot(places[:, 0] - EAST - x, places[:, 1] - NORTH - y) < 1.0
            assert near.sum() <= 1, (n, poles.ids[near])
        for x, y in self.drawn_at:
            near = np.hypot(places[:, 0] - EAST - x, places[:, 1] - NORTH - y) < 0.6
            assert near.sum() <= 1, (x, y, poles.ids[near])


def nearest_pole(state: State, x: float, y: float) -> str:
    """Id of the pole that stands at a place of the street."""
    assets = state.assets["pole"]
    evidence = (
        assets.evidence["easting_m"].to_numpy(zero_copy_only=False),
        assets.evidence["northing_m"].to_numpy(zero_copy_only=False),
    )
    away = np.hypot(evidence[0] - EAST - x, evidence[1] - NORTH - y)
    return str(assets.ids[int(np.nanargmin(away))])


def values_of(state: State) -> dict[str, Any]:
    """All values of a state."""
    return {kind: assets.rows.to_pydict() for kind, assets in state.assets.items()}


def run(machine: type[Street], sequences: int, steps: int) -> Counter[str]:
    """Run sequences; what happened in them."""
    machine.tally = Counter()
    chosen = settings(
        max_examples=sequences, stateful_step_count=steps, deadline=None,
        suppress_health_check=list(HealthCheck), phases=(Phase.explicit, Phase.generate),
    )  # fmt: skip
    run_state_machine_as_test(machine, settings=chosen)
    tally = machine.tally
    machine.tell()
    assert tally["stable"] >= 0.995 * tally["asked"]
    return tally


@pytest.mark.slow
def test_no_sequence_loses_an_edit() -> None:
    run(Street, sequences=8, steps=14)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_no_sequence_of_two_hundred_loses_an_edit() -> None:
    run(Street, sequences=200, steps=30)


class StreetOfPrograms(Street):
    """The same with a real home, on which programs work that are killed."""

    deaths = st.none() | st.integers(0, 8) | st.floats(0.0, 0.3)
    started: Programs

    def opened(self) -> Any:
        return copy.copy(self.home)

    def dies(self, work: Work, dies: float) -> bool:
        at = (dies, None) if isinstance(dies, int) else (None, dies)
        return self.started.run(Job(self.folder, self.opened(), work, *at))


class StreetInFile(StreetOfPrograms):
    """The same with a GeoPackage."""

    def new_home(self) -> InFile:
        return InFile(self.folder / "inventory.gpkg", CRS, KINDS)

    def copied(self) -> InFile:
        shutil.copy(self.home.file, self.folder / "copy.gpkg")
        return InFile(self.folder / "copy.gpkg", CRS, KINDS)

    def close(self) -> None:
        assert {f.name for f in self.folder.iterdir()} <= {"store", "inventory.gpkg", "inventory.qgs", "copy.gpkg"}


class StreetInDatabase(StreetOfPrograms):
    """The same with PostGIS."""

    address: str

    def new_home(self) -> InDatabase:
        return InDatabase(self.address, f"s{self.folder.name.lower().replace('-', '_')}", 32632, KINDS)

    def copied(self) -> None:
        return None

    def close(self) -> None:
        self.home.drop()


SEQUENCES = int(os.environ.get("ROADSCAN_SEQUENCES", "200"))


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_no_sequence_loses_an_edit_of_a_geopackage() -> None:
    with programs() as StreetInFile.started:
        tally = run(StreetInFile, SEQUENCES, steps=20)
    assert tally["killed"] > 0.1 * SEQUENCES


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_no_sequence_loses_an_edit_of_postgis() -> None:
    pytest.importorskip("psycopg")
    with server() as StreetInDatabase.address, programs() as StreetInDatabase.started:
        tally = run(StreetInDatabase, SEQUENCES, steps=20)
    assert tally["killed"] > 0.1 * SEQUENCES
