"""Survey products that are made from the files of surface products."""

from __future__ import annotations

import datetime as dt
from types import SimpleNamespace

import numpy as np
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.run.engine.compute import Inline
from roadscan.run.keys import name_of, reached_code
from roadscan.run.session import Session
from roadscan.simulate.truth import load
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.tiles.lane_direction import Drives
from roadscan.tiles.mosaics import products
from roadscan.tiles.mosaics.products import StoredTiles
from roadscan.tiles.product import ProductContext, product_named
from roadscan.tiles.tasks.wanted_products import wanted_products
from tests.surveys import changed

DAY = dt.date(2026, 4, 24)
SURFACE = {"method": "cells", "sigma_m": 0.0005}


def test_what_a_product_reads_is_made_with_it(simulated):
    survey = Survey.load(simulated.survey_file)
    make = {"make": ["cracks", "potholes", "pothole_pieces"], "options": {"crack_pieces": {"spur_m": 0.05}}}
    found = {p.name: o for p, o in wanted_products(changed(survey, {"surface": SURFACE, "products": make}))}
    assert list(found) == ["cracks", "potholes", "pothole_pieces", "crack_pieces"]
    assert found["crack_pieces"].spur_m == 0.05
    with pytest.raises(ConfigError, match="made of the reconstructed surface, and the survey has none"):
        wanted_products(changed(survey, {"products": make}))


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"make": ["las"], "options": {"las": {"spacing": 0.1}}}, r"\[products\.options\.las\] .*spacing"),
        ({"make": ["lass"]}, "lass"),
    ],
)
def test_wrong_products_are_told_before_a_log_is_read(simulated, tmp_path, values, told):
    survey = changed(Survey.load(simulated.survey_file), {"products": values})
    store = Store(str(tmp_path), survey.config.id)
    with pytest.raises(RoadscanError, match=told):
        run_stages(Session(survey, store, Inline()))
    assert not store.files("tables") + store.files("logs")


def test_files_of_tiles_are_read_from_the_store(simulated):
    store = simulated.store("store-distress")
    with store.scratch() as folder:
        (folder / "one").write_bytes(b"pieces")
        store.publish(folder / "one", "tiles/crack_pieces/3_4.parquet")
    record = OutputRecord("crack_pieces", "3_4", "key", "tiles/crack_pieces/3_4.parquet", 6, bytes_digest(b"pieces"))
    tiles = StoredTiles(store, (), (), ProductContext("s", "", MapFrame(None, "yard"), TileGrid(), (), DAY), (record,))
    assert tiles.file("crack_pieces", TileId(3, 4)) == b"pieces"
    assert tiles.file("crack_pieces", TileId(3, 5)) is None
    assert tiles.file("pothole_pieces", TileId(3, 4)) is None


def test_the_code_that_joins_pieces_belongs_to_the_keys_of_their_tables():
    for name, joiner in (
        ("cracks", "roadscan.distress.crack_network"),
        ("potholes", "roadscan.distress.potholes"),
    ):
        reached = {place.partition(":")[0] for place in reached_code([name_of(type(product_named(name)))])}
        assert joiner in reached
    assert not [m for m in reached_code([name_of(type(product_named("tile_table")))]) if "surfaces" in m]


def test_pieces_of_tiles_without_a_reading_are_joined_as_well(monkeypatch):
    context = ProductContext("s", "", MapFrame(None, "yard"), TileGrid(), (), DAY)
    own, bridged = TileId(3, 4), TileId(2, 4)
    files = [OutputRecord("pothole_pieces", str(t), "key", f"{t}.parquet", 6, "digest") for t in (own, bridged)]
    product = product_named("potholes")
    found = SimpleNamespace(summaries={own: SimpleNamespace(tile=own)}, contents={})
    monkeypatch.setattr(products, "tile_figures", lambda manifest: found)
    manifest = SimpleNamespace(of=lambda name: {r.unit: r for r in files if r.product == name})
    (planned,) = products._planned(product, product.options(), SimpleNamespace(store=None), context, manifest)
    assert planned.output.tiles == (bridged, own)
    assert {r.unit for r in planned.read} == {"2_4", "3_4"}


def test_lanes_run_as_the_vehicle_drove(finished):
    store = finished.store()
    drives = Drives.of(plan_survey(Survey.load(finished.survey_file), store))
    lanes = StoredTiles(store, (), (), ProductContext("s", "", drives.map, TileGrid(), (), DAY), (), drives).lanes()
    truth = load(finished.survey_file.parent)
    ahead = lanes.place_m + 0.1 * np.stack([np.sin(lanes.azimuth_rad), np.cos(lanes.azimuth_rad)], axis=-1)
    before, after = (np.stack(truth.station_offset_m(*p.T), axis=-1) for p in (lanes.place_m, ahead))
    step = after - before
    assert len(step) > 30 and set(np.sign(step[:, 0])) == {-1.0, 1.0}  # there and back
    assert np.degrees(np.abs(np.arctan(step[:, 1] / step[:, 0]))).max() < 3.0  # the driver steers
