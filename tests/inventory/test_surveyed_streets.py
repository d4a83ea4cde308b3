"""Two surveys of a street, simulated and processed: the inventory compares what the stage finds of poles and signs."""

from __future__ import annotations

import os
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import geopandas
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import roadscan
from roadscan.core.errors import DamagedError
from roadscan.demo.demo import (
    AUTUMN,
    SPRING,
    STAGES,
    HandEdit,
    compare_epochs,
    edit_by_hand,
    prepare_street,
    street,
)
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.of_survey import FOUND, found_assets
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.simulate.surface import Surface
from roadscan.store.asset_schema import asset_schema
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.survey.run import run_stages
from tests.inventory.streets import AUTUMN as IN_AUTUMN
from tests.inventory.streets import found, poles

SURVEY = """
id = "street"
rig = {{}}
[map]
crs = "EPSG:32632"
[[runs]]
id = "drive"
logs = [{{ path = "drive.csv" }}]
[inventory]
store = "../inventory"
name = "street"
epoch = "{}"
home = "../inventory.gpkg"
"""


@pytest.mark.slow
def test_the_demo_tells_of_two_epochs_and_of_the_edit_between(tmp_path: Path) -> None:
    epochs = {SPRING: poles(), AUTUMN: [*poles(5, when=IN_AUTUMN), *poles(1, when=IN_AUTUMN, station_m=-1.0)][:5]}
    files = {}
    for epoch, rows in epochs.items():
        files[epoch] = tmp_path / epoch / "SURVEY.toml"
        folder = files[epoch].parent / "store" / "survey=street" / FOUND
        folder.mkdir(parents=True)
        files[epoch].write_text(SURVEY.format(epoch))
        for kind, table in found(rows).tables.items():
            pq.write_table(table, folder / f"{asset_schema(kind).table}.parquet")
    edit = edit_by_hand(files[SPRING])
    assert (edit.attribute, edit.found, edit.given) == ("asset_height_m", 5.0, 3.0)
    for _ in range(2):  # the demo may be run again
        lines = compare_epochs(files[AUTUMN], edit)
        assert lines[0].endswith("6 assets of 2026-spring and 2026-autumn")
        assert any(line.startswith("not in sight  1 asset") for line in lines)
        assert lines[-1] == (
            f"hand edit     {edit.asset_id}: asset_height_m 3.00, in force; found 5.00 before it and 5.00 since"
        )
        assert edit_by_hand(files[AUTUMN]) == HandEdit(edit.asset_id, "asset_height_m", 5.0, 3.0)


def test_found_assets_that_are_damaged_are_refused(tmp_path: Path) -> None:
    """A flipped bit in a footer reads as another table: rows are taken in as their record says, or not at all."""
    survey_file = tmp_path / "SURVEY.toml"
    survey_file.write_text(SURVEY.format(SPRING))
    session = Session.open(survey_file)
    for kind, table in found(poles()).tables.items():
        path = f"{FOUND}/{asset_schema(kind).table}.parquet"
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        content = sink.getvalue().to_pybytes()
        session.store.write_bytes(path, content)
        digest = bytes_digest(content)
        session.manifest.add([OutputRecord("assets", path, "key", path, len(content), digest)])
    assert found_assets(session) is not None
    session.store.write_bytes(path, content.replace(b"station_m", b"station_l"))
    with pytest.raises(DamagedError, match="not as it was recorded"):
        found_assets(Session.open(survey_file))
    session.store.remove(path)
    with pytest.raises(DamagedError, match="missing from the store"):
        found_assets(Session.open(survey_file))


def processed(survey_file: Path) -> Inventory:
    survey = roadscan.open_survey(survey_file)
    run_stages(survey.session, [stage_named(name) for name in STAGES])
    inventory = survey.inventory
    inventory.publish()
    return inventory


@pytest.mark.nightly
@pytest.mark.timeout(1200)
def test_the_demos_street(tmp_path: Path) -> None:
    files = [prepare_street(tmp_path, epoch, lambda _: None) for epoch in (SPRING, AUTUMN)]
    processed(files[0])
    edit = edit_by_hand(files[0])
    inventory = processed(files[1])
    assert compare_epochs(files[1], edit)[-1].startswith(
        f"hand edit     {edit.asset_id}: asset_height_m 3.00, in force"
    )
    changes = inventory.changes()
    assert changes is not None and changes.unseen == 1  # what the hoarding hides
    told = Counter((c.kind, c.change) for c in changes.changes if c.change != "changed")
    # a new sign stands on a new pole
    assert told == {("pole", "appeared"): 1, ("sign", "appeared"): 1, ("pole", "gone"): 1, ("pole", "moved"): 1}
    assert all(c.passes_expected == 1 for c in changes.changes if c.change == "gone")


class Thing(NamedTuple):
    """A pole or a sign, and where it stands in each of the two epochs (station and offset); None where it does not."""

    kind: str
    spring: tuple[float, float] | None
    autumn: tuple[float, float] | None
    is_hidden: bool = False
    """In autumn something stands before it."""


STREETS = 6
LENGTH_M = 70.0
FATES = ("removed", "added", "moved", "hidden", "stays", "stays", "stays", "stays")
CHANGES = ("appeared", "gone", "moved")


def things(seed: int) -> list[Thing]:
    """Poles on the right of the street and signs on its left, every eight metres or so, some of which change."""
    random = np.random.default_rng(seed)
    made = []
    for kind, offset_m in (("pole", 7.5), ("sign", -7.2)):
        stations = np.arange(6.0, LENGTH_M - 4.0, 8.0)
        fates = random.permutation(np.resize(FATES, stations.size))
        for station, fate in zip(stations + random.uniform(-1.0, 1.0, stations.size), fates, strict=True):
            place = float(station), offset_m + float(random.uniform(-0.3, 0.3))
            turn, far = random.uniform(0, 2 * np.pi), random.uniform(0.6, 1.4)
            shift = place[0] + far * float(np.cos(turn)), place[1] + far * float(np.sin(turn))
            made.append(
                Thing(
                    kind, None if fate == "added" else place,
                    None if fate == "removed" else shift if fate == "moved" else place, fate == "hidden",
                )
            )  # fmt: skip
    return made


def scene(town: list[Thing], epoch: str, seed: int) -> Scene:
    """The demo's street, longer and with other things on it."""
    is_autumn = epoch == AUTUMN
    placed = [(t.kind, t.autumn if is_autumn else t.spring) for t in town]
    sizes: dict[str, dict[str, Any]] = {"pole": {"height_m": 3.2, "diameter_m": 0.12}, "sign": {}}
    rows = {
        kind: [{"station_m": p[0], "offset_m": p[1], **sizes[kind]} for k, p in placed if k == kind and p is not None]
        for kind in sizes
    }
    hoardings = [
        {"station_m": t.autumn[0], "offset_m": float(np.sign(t.autumn[1])) * 6.0, "length_m": 7.5, "width_m": 0.3,
         "height_m": 3.8}
        for t in town if is_autumn and t.is_hidden and t.autumn is not None
    ]  # fmt: skip
    return street(epoch).changed(
        length_m=LENGTH_M, seed=2 * seed + is_autumn,
        road={"alignment": [{"kind": "straight", "length_m": 600.0}]},
        roadside={"poles": rows["pole"], "signs": rows["sign"], "boxes": hoardings},
    )  # fmt: skip


def prepare_survey(folder: Path, made: Scene, epoch: str) -> Path:
    survey_file = folder / epoch / "SURVEY.toml"
    simulate(made, survey_file.parent)
    settings = SURVEY[SURVEY.index("[inventory]") :].format(epoch)
    with survey_file.open("a", encoding="utf-8") as file:
        file.write(
            f'\n[assets]\nkinds = ["pole", "sign"]\nexports = []\nclassified = false\nbare_earth = false\n{settings}'
        )
    return survey_file


class Told(NamedTuple):
    """Changes of a street by kind and thing, as they are and as the inventory tells them."""

    wanted: Counter[tuple[str, int]]
    found: Counter[tuple[str, int]]

    def right(self) -> int:
        """How many are told as they are."""
        return (self.wanted & self.found).total()

    def f1(self) -> float:
        return 2.0 * self.right() / max(self.wanted.total() + self.found.total(), 1)


def surveyed_twice(folder: Path, seed: int) -> dict[str, Told]:
    """What the inventory tells of a street, by change."""
    town = things(seed)
    spring = processed(prepare_survey(folder, scene(town, SPRING, seed), SPRING))
    first = {kind: spring.assets(kind) for kind in ("pole", "sign")}
    autumn = processed(prepare_survey(folder, scene(town, AUTUMN, seed), AUTUMN))
    changes = autumn.changes()
    assert changes is not None
    surface = Surface(scene(town, AUTUMN, seed))
    fates: dict[str, list[int]] = {
        "appeared": [n for n, t in enumerate(town) if t.spring is None],
        "gone": [n for n, t in enumerate(town) if t.autumn is None],
        "moved": [n for n, t in enumerate(town) if t.spring and t.autumn and t.spring != t.autumn],
    }
    # a sign stands on a pole of its own
    told = {
        c: Told(Counter((kind, n) for n in fates[c] for kind in {"pole", town[n].kind}), Counter()) for c in CHANGES
    }
    for one in changes.changes:
        if one.change in told:
            frame = autumn.assets(one.kind) if one.change == "appeared" else first[one.kind]
            which = nearest(frame, one.asset_id, town, surface, now=one.change == "appeared")
            told[one.change].found[one.kind, which] += 1
    hidden = {n for n, t in enumerate(town) if t.is_hidden}
    assert not hidden & {n for _, n in told["gone"].found}, (seed, hidden)
    assert len(hidden) >= 2 and changes.unseen >= len(hidden)
    return told


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_what_was_added_removed_and_moved_is_found_and_what_is_hidden_is_never_gone(tmp_path: Path) -> None:
    counts: dict[str, Counter[str]] = {change: Counter() for change in CHANGES}
    for seed in range(1, int(os.environ.get("ROADSCAN_STREETS", STREETS)) + 1):
        folder = tmp_path / str(seed)
        for change, told in surveyed_twice(folder, seed).items():
            missed, false = told.wanted - told.found, told.found - told.wanted
            sys.stdout.write(
                f"street {seed}, {change}: F1 {told.f1():.3f}, missed {dict(missed)}, false {dict(false)}\n"
            )
            sys.stdout.flush()
            counts[change].update(right=told.right(), all=told.wanted.total() + told.found.total())
        shutil.rmtree(folder)
    f1 = {change: 2.0 * count["right"] / count["all"] for change, count in counts.items()}
    sys.stdout.write(f"all streets: {f1}\n")
    assert min(f1.values()) >= 0.95, f1


def nearest(frame: geopandas.GeoDataFrame, asset_id: str, town: list[Thing], surface: Surface, *, now: bool) -> int:
    """The thing that an asset is, -1 where none stands within a metre of it."""
    row: pd.Series = frame.set_index("asset_id").loc[asset_id]
    at = surface.station_offset_m(np.array([row["easting_m"]]), np.array([row["northing_m"]]))
    places = [(t.autumn if now else t.spring) or (np.inf, np.inf) for t in town]
    away = np.hypot(*(np.array(places).T - np.array(at).reshape(2, 1)))
    return int(np.argmin(away)) if away.min() <= 1.0 else -1
