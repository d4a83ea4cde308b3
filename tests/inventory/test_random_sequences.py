"""Random sequences of edits, reprocessings, new epochs, undone runs and killed programs: no edit is ever lost."""

from __future__ import annotations

import datetime as dt
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import shapely
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from roadscan.inventory.home import Content, Home, Mark, Sheet
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.recording import Rules
from roadscan.inventory.state import State, live_commits, state_at
from roadscan.model.settings.inventory import Matching
from roadscan.tables.asset_schema import asset_schema
from roadscan.tables.asset_truth import AssetTruth
from roadscan.tables.inventory_schema import asset_table
from roadscan.tables.store import Store
from tests.inventory import qgis_edits as person
from tests.inventory.postgres import server
from tests.inventory.streets import CRS, EAST, NORTH, SPRING, Everywhere, asset, found

KINDS = ("pole", "sign")
COUNT = 8


class Killed(BaseException):
    """A program ends at once: nothing that it had planned to do is done."""


class DyingStore(Store):
    """A store whose program dies at one of its writes: before it, or when the bytes lie in a scratch file."""

    left: int | None = None

    def write_bytes(self, relative: str, content: bytes, *, lasting: bool = True) -> None:
        DyingStore._step()
        super().write_bytes(relative, content, lasting=lasting)
        DyingStore._step()

    @classmethod
    def _step(cls) -> None:
        if cls.left is not None:
            cls.left -= 1
            if cls.left < 0:
                raise Killed


class DyingHome(Home):
    """A home whose program dies before or after it writes to it."""

    def __init__(self, inner: Home) -> None:
        self.inner = inner

    @property
    def name(self) -> str:
        return self.inner.name

    def mark(self) -> Mark | None:
        return self.inner.mark()

    def read(self) -> Content:
        return self.inner.read()

    def write(self, content: Content, sheets: Any, mark: Mark) -> None:
        DyingStore._step()
        self.inner.write(content, sheets, mark)
        DyingStore._step()

    def note(self, mark: Mark) -> None:
        DyingStore._step()
        self.inner.note(mark)
        DyingStore._step()


class Memory(Home):
    """A home without a file, whose rows a test changes as a person would."""

    def __init__(self, name: str = "memory") -> None:
        self._name = name
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self.marks: list[Mark] = []
        self.next_fid = 1

    @property
    def name(self) -> str:
        return self._name

    def mark(self) -> Mark | None:
        return self.marks[-1] if self.marks else None

    def read(self) -> Content:
        return Content({k: self._table(k) for k in KINDS})

    def _table(self, kind: str) -> pa.Table:
        schema = pa.schema([pa.field("fid", pa.int64()), *asset_table(kind)])
        return pa.Table.from_pylist(self.rows.get(kind, []), schema)

    def write(self, content: Content, sheets: list[Sheet], mark: Mark) -> None:
        self.rows = {k: content.rows[k].to_pylist() if k in content.rows else [] for k in KINDS}
        self.marks.append(mark)

    def note(self, mark: Mark) -> None:
        self.marks.append(mark)

    def edit(self, kind: str, at: int, **values: Any) -> None:
        self.rows[kind][at] |= values

    def delete(self, kind: str, at: int) -> None:
        del self.rows[kind][at]

    def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
        fid = 1 + max(
            (r["fid"] for r in self.rows[kind]), default=0
        )  # the highest number is given again, as SQLite does
        row = dict.fromkeys(asset_table(kind).names) | {"fid": fid, "geometry": geometry} | values
        self.rows[kind].append(row)


class Street(RuleBasedStateMachine):
    """A street, its inventory, and a person; what the person did is written down beside."""

    new_home: Callable[[Path], Any] = staticmethod(lambda folder: Memory())

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        DyingStore.left = None
        self.home = self.new_home(self.folder)
        self.number = 0
        self.year = 0
        self.truth_poles = {n: (20.0 * n, 4.0) for n in range(COUNT)}
        self.names: dict[int, str] = {}
        self.pulled: dict[tuple[str, str], Any] = {}
        """Values that a pull took in, by asset and attribute."""
        self.drawn_at: list[tuple[float, float]] = []
        self.days: list[tuple[int, dict[str, Any]]] = []
        self.stable = self.asked = self.checked = 0

    def inventory(self) -> Inventory:
        truth = AssetTruth(DyingStore(str(self.folder / "store"), "street"))
        return Inventory(truth, DyingHome(self.home), "street", Rules(Everywhere(), Matching()))

    def teardown(self) -> None:
        DyingStore.left = None
        assert self.asked == 0 or self.stable / self.asked >= 0.995
        shutil.rmtree(self.folder, ignore_errors=True)

    # --- what a program does

    def attempt(self, work: Callable[[Inventory], Any], dies_at: int | None) -> bool:
        """Do something, die at one of its writes, and do it again as another program would."""
        DyingStore.left = dies_at
        try:
            work(self.inventory())
            return True
        except Killed:
            DyingStore.left = None
            state_at(self.inventory().truth)  # whole at any instant
            work(self.inventory())
            return True
        finally:
            DyingStore.left = None

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
        self.process(seen=set(range(COUNT)), noise=0.02, height=5.0, dies_at=None)
        self.publish(dies_at=None)

    @rule(
        seen=st.sets(st.integers(0, COUNT - 1), min_size=COUNT - 3, max_size=COUNT),
        noise=st.sampled_from([0.0, 0.02, 0.05]), height=st.sampled_from([5.0, 5.02, 6.5]),
        dies_at=st.none() | st.integers(0, 5),
    )  # fmt: skip
    def process(self, seen: set[int], noise: float, height: float, dies_at: int | None) -> None:
        """The same drives again, with other parameters."""
        self.number += 1
        given = found(self.rows(noise, seen, height), f"year-{self.year}", KINDS)
        before = {n: self.names.get(n) for n in seen}
        self.attempt(lambda i: i.record(given), dies_at)
        state = state_at(self.inventory().truth)
        for n in seen:
            x, y = self.truth_poles[n]
            now = nearest_pole(state, x, y)
            if before[n] is not None:
                self.asked += 1
                self.stable += now == before[n]
            self.names[n] = now

    @rule(
        seen=st.sets(st.integers(0, COUNT - 1), min_size=COUNT - 2, max_size=COUNT),
        dies_at=st.none() | st.integers(0, 5),
    )
    def new_epoch(self, seen: set[int], dies_at: int | None) -> None:
        """A survey a year later."""
        self.year += 1
        self.process(seen=seen, noise=0.02, height=5.0, dies_at=dies_at)

    @rule(dies_at=st.none() | st.integers(0, 8))
    def publish(self, dies_at: int | None) -> None:
        def pull_and_publish(i: Inventory) -> None:
            i.pull(who="eva") if i.home.mark() else None
            i.publish()

        self.note_edits()
        self.attempt(pull_and_publish, dies_at)
        self.seen_in_home = self.values_of_home()

    @rule(dies_at=st.none() | st.integers(0, 8))
    def pull(self, dies_at: int | None) -> None:
        self.note_edits()
        self.attempt(lambda i: i.pull(who="eva"), dies_at)
        self.seen_in_home = self.values_of_home()

    @rule(data=st.data())
    def undo_a_run(self, data: st.DataObject) -> None:
        inventory = self.inventory()
        runs = [c for c in live_commits(inventory.truth.commits) if c.kind == "found"]
        if len(runs) > 1:
            inventory.undo(data.draw(st.sampled_from(runs)).number)

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

    @rule(at=st.integers(0, 50), height=st.sampled_from([3.0, 4.0, 9.0]))
    def edit_height(self, at: int, height: float) -> None:
        rows = self.home_rows("pole")
        if rows:
            self.home.edit("pole", at % len(rows), asset_height_m=height)

    @rule(at=st.integers(0, 50), dx=st.floats(-0.3, 0.3), dy=st.floats(-0.3, 0.3))
    def move(self, at: int, dx: float, dy: float) -> None:
        rows = self.home_rows("pole")
        if rows:
            place = shapely.from_wkb(rows[at % len(rows)]["geometry"])
            moved = shapely.Point(place.x + dx, place.y + dy, place.z)
            self.home.edit("pole", at % len(rows), geometry=shapely.to_wkb(moved, flavor="iso"))

    @rule(at=st.integers(0, 50))
    def delete(self, at: int) -> None:
        rows = self.home_rows("sign")
        if len(rows) > 3:
            self.home.delete("sign", at % len(rows))

    @rule(slot=st.integers(0, 40), n=st.integers(0, 10**6))
    def draw(self, slot: int, n: int) -> None:
        place = (10.0 + 20.0 * (slot % COUNT), -8.0 - 2.0 * (slot // COUNT))
        if place not in self.drawn_at:
            self.drawn_at.append(place)
            point = shapely.Point(EAST + place[0], NORTH + place[1], 100.0)
            self.home.draw("pole", shapely.to_wkb(point, flavor="iso"), comments=f"drawn {n}")

    # --- what has to hold

    def home_rows(self, kind: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self.home.read().rows[kind].to_pylist()
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
        for commit, values in self.days[-2:]:
            assert values_of(state_at(truth, commit)) == values

    def no_edit_is_lost(self, state: State) -> None:
        waiting = {(key, json.loads(e.new or "null")) for key, es in state.edits.waiting.items() for e in es}
        for (asset_id, name), value in self.pulled.items():
            row = state.row(asset_id)
            assert row is not None, asset_id
            shown = value.hex() if isinstance(value, bytes) else value
            assert row[name] == value or ((asset_id, name), shown) in waiting, (asset_id, name, value, row[name])

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


def run(machine: type[Street], sequences: int, steps: int) -> None:
    chosen = settings(
        max_examples=sequences, stateful_step_count=steps, deadline=None,
        suppress_health_check=list(HealthCheck), phases=(Phase.explicit, Phase.generate),
    )  # fmt: skip
    run_state_machine_as_test(machine, settings=chosen)


def test_no_sequence_loses_an_edit() -> None:
    run(Street, sequences=8, steps=14)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_no_sequence_of_two_hundred_loses_an_edit() -> None:
    run(Street, sequences=200, steps=30)


class InFile(GeoPackage):
    """A GeoPackage that a person edits through OGR."""

    def edit(self, kind: str, at: int, **values: Any) -> None:
        values = {n: shapely.from_wkb(v) if n == "geometry" else v for n, v in values.items()}
        table = asset_schema(kind).table
        frame = person.layer(self.file, table)
        for name, value in values.items():
            if name == "geometry":
                shapes = list(frame.geometry)
                shapes[at] = value
                frame = frame.set_geometry(shapes, crs=frame.crs)
            else:
                column = frame[name].astype(object)
                column.iloc[at] = value
                frame[name] = column if isinstance(value, str) else pd.to_numeric(column)
        person.replace(self.file, table, frame)

    def delete(self, kind: str, at: int) -> None:
        table = asset_schema(kind).table
        frame = person.layer(self.file, table)
        person.replace(self.file, table, frame.drop(frame.index[at]))

    def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
        person.draw(self.file, asset_schema(kind).table, shapely.from_wkb(geometry), **values)


class StreetInFile(Street):
    """The same with a real file."""

    new_home = staticmethod(lambda folder: InFile(folder / "inventory.gpkg", CRS, KINDS))


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_no_sequence_loses_an_edit_of_a_geopackage() -> None:
    run(StreetInFile, sequences=int(os.environ.get("ROADSCAN_SEQUENCES", "200")), steps=20)


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_no_sequence_loses_an_edit_of_postgis() -> None:
    psycopg = pytest.importorskip("psycopg")
    from roadscan.inventory.homes.postgis import PostGis

    class InDatabase(PostGis):
        """Tables that a person edits by SQL."""

        def _do(self, statement: str, values: list[Any]) -> None:
            with psycopg.connect(self._address) as connection:
                connection.execute(statement, values)

        def _value(self, name: str, value: Any) -> tuple[str, Any]:
            if name == "geometry":
                return "ST_SetSRID(ST_GeomFromWKB(%s), 32632)", value
            return "%s", value

        def _row(self, kind: str, at: int) -> int:
            return int(self.read().rows[kind]["fid"][at].as_py())

        def edit(self, kind: str, at: int, **values: Any) -> None:
            given = {("geom" if n == "geometry" else n): self._value(n, v) for n, v in values.items()}
            sets = ", ".join(f"{n} = {form}" for n, (form, _) in given.items())
            table = f"{self.schema}.{asset_schema(kind).table}"
            self._do(
                f"UPDATE {table} SET {sets} WHERE fid = %s", [*(v for _, v in given.values()), self._row(kind, at)]
            )

        def delete(self, kind: str, at: int) -> None:
            self._do(f"DELETE FROM {self.schema}.{asset_schema(kind).table} WHERE fid = %s", [self._row(kind, at)])

        def draw(self, kind: str, geometry: bytes, **values: Any) -> None:
            form, value = self._value("geometry", geometry)
            table = f"{self.schema}.{asset_schema(kind).table}"
            self._do(f"INSERT INTO {table} (geom, comments) VALUES ({form}, %s)", [value, values["comments"]])

    with server() as address:

        class StreetInDatabase(Street):
            """The same with a server."""

            @staticmethod
            def new_home(folder: Path) -> Any:
                return InDatabase(address, f"s{folder.name.lower().replace('-', '_')}", 32632)

        run(StreetInDatabase, sequences=int(os.environ.get("ROADSCAN_SEQUENCES", "200")), steps=20)
