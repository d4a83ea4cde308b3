"""Survey products that are made from the files of surface products."""

from __future__ import annotations

import datetime as dt

import pytest

from roadscan.jobs.products import StoredTiles, wanted_products
from roadscan.model.crs import MapFrame
from roadscan.model.errors import ConfigError
from roadscan.model.ids import TileId
from roadscan.model.survey import Survey
from roadscan.products.base import ProductContext
from roadscan.tables.manifest import OutputRecord
from roadscan.tiles.grid import TileGrid
from tests.jobs.conftest import changed

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


def test_files_of_tiles_are_read_from_the_store(simulated):
    store = simulated.store("store-distress")
    with store.scratch() as folder:
        (folder / "one").write_bytes(b"pieces")
        store.publish(folder / "one", "tiles/crack_pieces/3_4.parquet")
    record = OutputRecord("crack_pieces", "3_4", "key", "tiles/crack_pieces/3_4.parquet", 6, "digest")
    tiles = StoredTiles(store, (), (), ProductContext("s", "", MapFrame(None, "yard"), TileGrid(), (), DAY), (record,))
    assert tiles.file("crack_pieces", TileId(3, 4)) == b"pieces"
    assert tiles.file("crack_pieces", TileId(3, 5)) is None
    assert tiles.file("pothole_pieces", TileId(3, 4)) is None
