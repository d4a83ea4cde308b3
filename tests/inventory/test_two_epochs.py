"""Two surveys of a street on which the test itself added, removed, moved and hid things."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.visibility import PASSES
from roadscan.core.errors import ConfigError, SchemaError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.grid import TileId
from roadscan.inventory.found_distresses import VisibilityGrid, VisibilityOfSquares
from roadscan.inventory.home import FaultyEditsError
from roadscan.inventory.identity import new_ids
from roadscan.inventory.recording import Found
from tests.inventory import qgis_edits as person
from tests.inventory.streets import AUTUMN, EAST, NORTH, SPRING, Everywhere, asset, found, inventory, poles

COUNT = 400


class Town:
    """Poles and signs along both sides of a road, and what became of each."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.kinds = ["pole" if n % 2 else "sign" for n in range(COUNT)]
        self.places = np.column_stack([
            np.arange(COUNT) * 4.0 + self.random.uniform(-1, 1, COUNT),
            np.where(np.arange(COUNT) % 4 < 2, 5.0, -5.0) + self.random.uniform(-0.5, 0.5, COUNT),
        ])  # fmt: skip
        self.sizes = self.random.uniform(0.4, 6.0, COUNT)
        fate = self.random.permutation(COUNT)
        self.removed, self.moved = set(fate[:25].tolist()), set(fate[25:50].tolist())
        self.hidden, self.added = set(fate[50:80].tolist()), set(fate[80:105].tolist())
        turn = self.random.uniform(0, 2 * np.pi, COUNT)
        self.shift = np.column_stack([np.cos(turn), np.sin(turn)]) * self.random.uniform(0.3, 1.5, (COUNT, 1))

    def survey(self, when: dt.datetime) -> list[dict[str, Any]]:
        """What a survey finds: each place with its σ, a lost asset now and then."""
        is_second = when == AUTUMN
        rows = []
        for n in range(COUNT):
            if n in (self.removed | self.hidden if is_second else self.added):
                continue
            x, y = self.places[n] + (self.shift[n] if is_second and n in self.moved else 0.0)
            x, y = np.array([x, y]) + self.random.normal(0, 0.02, 2)
            size = {"pole": "asset_height_m", "sign": "width_m"}[self.kinds[n]]
            value = float(self.sizes[n] + self.random.normal(0, 0.02))
            rows.append(asset(self.kinds[n], (x, y, 100.0), when=when, **{size: value}))
        return rows


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_changes_of_the_road_are_found_and_what_is_hidden_is_never_gone(seed: int, tmp_path: Path) -> None:
    town = Town(seed)
    street = inventory(tmp_path, Everywhere(hidden=[tuple(town.places[n]) for n in town.hidden]))
    street.record(found(town.survey(SPRING)))
    first = {kind: street.assets(kind) for kind in ("pole", "sign")}
    street.record(found(town.survey(AUTUMN)))
    changes = street.changes()
    assert changes is not None
    assert changes.unseen == len(town.hidden)
    told: dict[str, set[int]] = {"appeared": set(), "gone": set(), "moved": set()}
    for one in changes.changes:
        frame = first[one.kind] if one.change == "gone" or one.change == "moved" else street.assets(one.kind)
        row = frame[frame["asset_id"] == one.asset_id].iloc[0]
        place = np.array([row["easting_m"] - EAST, row["northing_m"] - NORTH])
        told[one.change].add(int(np.argmin(np.hypot(*(town.places - place).T))))
    for change, truth in (("appeared", town.added), ("gone", town.removed), ("moved", town.moved)):
        right = len(told[change] & truth)
        f1 = 2 * right / (len(told[change]) + len(truth))
        assert f1 >= 0.95, (change, f1, sorted(told[change] ^ truth))
    assert not told["gone"] & town.hidden
    moved = [c for c in changes.changes if c.change == "moved"]
    assert all(c.significance > 3 and c.distance_m > 0.2 for c in moved)


def test_ids_stay_when_the_same_drives_are_processed_again(tmp_path: Path) -> None:
    town = Town(4)
    street = inventory(tmp_path, Everywhere())
    street.record(found(town.survey(SPRING), "spring"))
    before = {one for kind in ("pole", "sign") for one in street.assets(kind)["asset_id"]}
    for _ in range(3):
        street.record(found(town.survey(SPRING), "spring"))
    after = {one for kind in ("pole", "sign") for one in street.assets(kind)["asset_id"]}
    assert len(before & after) / len(before) >= 0.995
    assert len(after) == len(before)


def test_lines_and_areas_are_known_again_though_their_ends_differ(tmp_path: Path) -> None:
    def kerbs(shift: float, end: float) -> list[dict[str, Any]]:
        return [
            asset("kerb", *[(40.0 * n + x, 3.5 + shift, 100.0) for x in (0.0, 10.0, end)], step_m=0.12)
            for n in range(5)
        ] + [asset("sidewalk", *[(40.0 * n + x, y + shift, 100.1) for x, y in ((0, 4), (end, 4), (end, 6), (0, 6))])
             for n in range(5)]  # fmt: skip

    street = inventory(tmp_path, Everywhere(), kinds=("kerb", "sidewalk"))
    street.record(found(kerbs(0.0, 30.0), "spring", ()))
    before = {kind: list(street.assets(kind)["asset_id"]) for kind in ("kerb", "sidewalk")}
    street.record(found(kerbs(0.03, 26.0), "spring", ()))
    assert {kind: list(street.assets(kind)["asset_id"]) for kind in before} == before


def test_a_sign_hangs_on_its_pole_and_a_pole_stands_on_its_sidewalk(tmp_path: Path) -> None:
    street = inventory(tmp_path)
    walk = asset("sidewalk", (0, 3, 100), (200, 3, 100), (200, 6, 100), (0, 6, 100))
    street.record(found([*poles(3), walk, asset("sign", (20.1, 4.05, 102.5)), asset("sign", (70.0, 4.0, 102.5))]))
    pole = street.assets("pole").sort_values("station_m")
    (walk_id,) = street.assets("sidewalk")["asset_id"]
    assert set(pole["parent"]) == {walk_id}
    parents = list(street.assets("sign").sort_values("station_m")["parent"])
    assert parents[0] == pole["asset_id"].iloc[1] and pd.isna(parents[1])


def test_what_is_not_seen_says_how_many_passes_should_have(tmp_path: Path) -> None:
    cells = in_sight((40.0, 4.0, 3), (20.0, 4.0, 0))
    street = inventory(tmp_path, VisibilityGrid(cells))
    street.record(found(poles(), "spring"))
    ids = list(street.assets("pole").sort_values("station_m")["asset_id"])
    street.record(found(poles(1, when=AUTUMN), "autumn"))
    shown = street.assets("pole").set_index("asset_id")
    assert (shown.loc[ids[2], "status"], shown.loc[ids[2], "passes_expected"]) == ("missing", 3)
    assert (shown.loc[ids[1], "status"], shown.loc[ids[4], "status"]) == ("found", "found")
    told = [(e.what, e.why) for e in street.history(ids[2])]
    assert told == [("found", "epoch spring"), ("not seen", "epoch autumn; 3 passes should have")]


def in_sight(*places: tuple[float, float, int], ground_m: float = 100.0) -> pa.Table:
    """Cells at places from the corner of the street that so many passes had in sight, above 0.5 m."""
    cells = {
        "column": [int((EAST + x) // 0.5) for x, _, _ in places],
        "row": [int((NORTH + y) // 0.5) for _, y, _ in places],
    }
    values = {name: [0 if name == "passes_ground" else n for _, _, n in places] for name in PASSES}
    table = pa.table({**cells, "ground_height_m": [ground_m] * len(places), **values})
    return table.replace_schema_metadata({"edge_m": "0.5"})


def test_passes_are_those_of_the_place_and_its_height() -> None:
    grid = VisibilityGrid(in_sight((40.0, 4.0, 3), (20.0, 4.0, 2)))
    places = np.array(
        [[40.2, 4.4, 100.0], [40.2, 4.4, 102.0], [39.9, 4.4, 100.0], [20.0, 4.0, 130.0], [20.0, 4.0, 99.0]]
    )
    places[:, :2] += EAST, NORTH
    assert grid.expected_passes("pole", places).tolist() == [3, 3, 0, 2, 2]  # a pole reaches up to where it is seen
    assert grid.expected_passes("kerb", places).tolist() == [0, 3, 0, 2, 0]
    with pytest.raises(SchemaError, match="has no column 'passes_high'"):
        VisibilityGrid(in_sight((0.0, 0.0, 1)).drop_columns(["passes_high"]))
    with pytest.raises(SchemaError, match="does not state the edge of its cells"):
        VisibilityGrid(in_sight((0.0, 0.0, 1)).replace_schema_metadata(None))


def test_squares_are_read_once_and_only_where_places_lie() -> None:
    asked: list[tuple[int, int]] = []

    def read(square: TileId) -> pa.Table | None:
        asked.append(square)
        return in_sight((10.0, 4.0, 3), (50.0, 4.0, 2)) if square.column == int(EAST // 40) else None

    town = VisibilityOfSquares(40.0, read)
    places = np.array([[50.0, 4.0, 101.0], [EAST, NORTH, 0.0], [10.0, 4.0, 101.0]])
    places[:, :2] += EAST, NORTH
    first = town.expected_passes("pole", places)
    assert first.tolist() == [0, 0, 3]  # the second square is none, though a table of the first names its cell
    assert np.array_equal(town.expected_passes("pole", places[::-1]), first[::-1])
    assert len(asked) == len(set(asked)) == 3


def test_the_older_survey_is_processed_again_and_what_appeared_has_appeared_all_the_same(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles(3), "spring"))
    street.publish()
    person.draw(tmp_path / "inventory.gpkg", "poles", shapely.Point(EAST + 100, NORTH + 4, 105.0))
    street.pull()  # a person knew the sixth, so it did not appear
    street.record(found([*poles(4, when=AUTUMN), *poles(6, when=AUTUMN)[5:]], "autumn"))
    for diameter_m in (0.1, 0.11):
        street.record(found(poles(3, diameter_m=diameter_m), "spring"))
        (change,) = [c for c in street.changes().changes if c.change != "changed"]
        assert (change.change, shapely.from_wkb(change.geometry).x) == ("appeared", EAST + 60)


@pytest.mark.parametrize("epoch", ["spring", "autumn"])
def test_a_run_that_finds_nothing_at_all_says_that_all_are_missing(epoch: str, tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles(), "spring"))
    street.record(replace(found([], epoch), began_gps_ns=gps_ns_from_utc(AUTUMN)))
    assert set(street.assets("pole")["status"]) == {"missing"}
    if epoch == "autumn":
        assert Counter(c.change for c in street.changes().changes) == {"gone": 6}


def test_a_map_in_feet(tmp_path: Path) -> None:
    foot_m = 1200 / 3937
    street = inventory(tmp_path, Everywhere())
    street.truth.units_m, street.rules = (foot_m, foot_m), replace(street.rules, unit_m=foot_m)

    def in_feet(shift_m: float) -> list[dict[str, Any]]:
        rows = [asset("pole", (20.0 * n + shift_m, 4.0, 100.0)) for n in range(3)]
        shapes = shapely.transform(
            shapely.from_wkb([r["geometry"] for r in rows]), lambda p: p / foot_m, include_z=True
        )
        return [row | {"geometry": one} for row, one in zip(rows, shapely.to_wkb(shapes), strict=True)]

    street.record(found(in_feet(0.0)))
    street.publish()
    file, first = tmp_path / "inventory.gpkg", street.assets("pole").iloc[0]
    place = first["geometry"]
    person.edit(file, "poles", first["asset_id"], geometry=shapely.Point(place.x + 1.0, place.y, place.z))
    person.draw(file, "poles", shapely.Point(place.x + 40.0, place.y + 40.0, 0.0))
    with pytest.raises(FaultyEditsError, match=r"its height is 0, and assets around it stand at 100\.0"):
        street.pull()
    street.pull(sound=True)
    row = street.state().row(first["asset_id"])
    assert row is not None and row["easting_m"] == pytest.approx(first["easting_m"] + foot_m, abs=1e-6)
    street.record(found(in_feet(0.5)))
    (conflict,) = street.conflicts()
    assert conflict.sigmas == pytest.approx((0.5 - foot_m) / 0.02, rel=1e-3)


def test_a_bad_run_is_undone_and_each_day_is_as_it_was(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles(), "spring"))
    good = street.assets("pole")
    street.record(found([asset("pole", (7.0 * n, -3.0, 100.0)) for n in range(40)], "spring"))
    assert len(street.assets("pole")) == 46
    street.undo(2, why="wrong parameters")
    assert street.assets("pole").equals(good)
    assert len(street.assets("pole", as_of=2)) == 46
    assert street.assets("pole", as_of=1).equals(good)
    day = street.truth.commits[0].at[:10]
    assert len(street.assets("pole", as_of=day)) == len(good)
    assert len(street.assets("pole", as_of="2001-01-01")) == 0
    assert Counter(d.change for d in street.diff(2)) == {"removed": 40, "changed": 6}  # six were said to be missing
    with pytest.raises(ConfigError, match="commit 2 is undone already"):
        street.undo(2)
    street.undo(3)
    assert len(street.assets("pole")) == 46
    with pytest.raises(ConfigError, match="is no date"):
        street.state("yesterday")


def test_a_table_without_a_column_is_named_before_anything_is_written(tmp_path: Path) -> None:
    street = inventory(tmp_path)
    whole = found(poles())
    tables = {**whole.tables, "pole": whole.tables["pole"].drop_columns(["sigma_height_m"])}
    with pytest.raises(SchemaError, match="'poles' has no column 'sigma_height_m'"):
        street.record(Found(tables, "key", "street"))
    assert street.truth.commits == ()


def test_ids_do_not_repeat() -> None:
    made = new_ids("pole", ["a", "a", "b"], set())
    assert len(set(made)) == 3
    assert made == new_ids("pole", ["a", "a", "b"], set())
    assert not set(new_ids("pole", ["a"], set(made))) & set(made)
