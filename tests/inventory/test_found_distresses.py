"""What a run found of cracks and potholes becomes rows of the inventory, at the height of the simulated road."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import shapely

from roadscan.distress.products.cracks import COLUMNS as CRACKS
from roadscan.distress.products.potholes import COLUMNS as POTHOLES
from roadscan.georeference.plan.plan import plan_of
from roadscan.inventory.found_distresses import Ground, found_distresses
from roadscan.inventory.of_survey import found_assets, open_inventory
from roadscan.run.session import Session
from roadscan.simulate.truth import load
from roadscan.site.material import Material
from roadscan.site.parts.vectors import site_layers
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.schema import table_schema
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.wanted_products import product_context
from tests.surveys import Simulated

pytestmark = pytest.mark.slow


@pytest.fixture
def session(finished: Simulated, tmp_path: Path) -> Session:
    """A survey of 14 m of road with two cracks and a pothole; it was searched for ravelling in vain."""
    made = Session.open(finished.copy_with_store_to(tmp_path / "survey").survey_file)
    ground, size = Ground(made), product_context(plan_of(made)).grid.size_m
    tiles = [map(int, r.unit.split("_")) for r in made.manifest.of("tile").values() if r.path]
    places = [(c * size + e, r * size + n) for c, r in tiles for e in (2.0, 5.0, 8.0) for n in (2.0, 5.0, 8.0)]
    around = np.array([(0.0, 0.0), (0.5, 0.0), (0.4, 0.8)])
    middle = np.mean(places, axis=0)
    places.sort(key=lambda one: np.hypot(*(one - middle)))
    x, y = next(one for one in places if ground.is_surveyed(around + one).all())
    cracks = [shapely.MultiLineString([[(x + 0.3 * k + s, y) for s in (0.0, 0.1, 0.2)]]) for k in range(2)]
    rows = [{f.name: "" if f.type == "string" else 0 for f in CRACKS} | {"type": "transverse"} for _ in cracks]
    rows[0] |= {"width_mean_m": 0.004, "length_m": 0.2}
    rows[1] |= {"width_mean_m": float("nan"), "length_m": 0.2}
    put(made, "cracks", pa.Table.from_pylist(rows, CRACKS), cracks)
    hole = {f.name: "" if f.type == "string" else 0 for f in POTHOLES} | {"depth_max_m": 0.06}
    put(made, "potholes", pa.Table.from_pylist([hole], POTHOLES), [shapely.box(x, y + 0.5, x + 0.4, y + 0.8)])
    made.manifest.add([OutputRecord("ravelling_patches", "main/1/00000", "k", "", 0, "")])
    return made


def put(session: Session, name: str, rows: pa.Table, shapes: Sequence[Any]) -> None:
    """Write a table of distresses as the product of its name does."""
    path = f"{table_schema(name).location}/{name}.parquet"
    with session.store.scratch() as folder:
        kinds = sorted({one.geom_type for one in shapes})
        write_geo_table(folder / name, rows, "line", np.array(shapes, object), kinds, product_context(plan_of(session)))
        session.store.publish(folder / name, path)
    content = session.store.read_bytes(path)
    session.manifest.add([OutputRecord(name, f"{name}.parquet", "k", path, len(content), bytes_digest(content))])


def test_rows_have_heights_accuracy_epochs_and_severity(session: Session) -> None:
    truth = load(session.survey.folder)
    held = {one.kind: one.rows for one in found_distresses(session)}
    assert {kind: rows.num_rows for kind, rows in held.items()} == {"crack": 2, "pothole": 1, "ravelling_patch": 0}
    for kind in ("crack", "pothole"):
        xyz = shapely.get_coordinates(shapely.from_wkb(held[kind]["geometry"].to_numpy()), include_z=True)
        assert np.abs(xyz[:, 2] - truth.height_m(xyz[:, 0], xyz[:, 1])).max() < 0.02
    rows = held["crack"].to_pylist()
    assert [r["severity"] for r in rows] == ["low", None]
    assert held["pothole"]["severity"].to_pylist() == ["high"]
    assert rows[0]["road"] is not None and rows[0]["station_m"] is not None
    first, last = (rows[0][f"{name}_epoch_gps_ns"] for name in ("first", "last"))
    passes = plan_of(session).passes
    assert min(p.start_gps_ns for p in passes) <= first < last <= max(p.end_gps_ns for p in passes)
    assert 0.0 < rows[0]["sigma_horizontal_m"] < 0.1 and rows[0]["probability"] is None


def test_the_page_shows_them_from_the_inventory_once_that_holds_them(session: Session) -> None:
    def shown() -> dict[str, str]:
        return {one.name: one.group for one in site_layers(Material(session))[0] if one.group == "distress"}

    assert shown() == {"cracks": "distress", "potholes": "distress"}
    inventory = open_inventory(session)
    assert inventory.publish().assets == 3
    assert shown() == {"asset_cracks": "distress", "asset_potholes": "distress"}
    (layer,) = (one for one in site_layers(Material(session))[0] if one.name == "asset_cracks")
    assert [style.by for style in layer.styles] == ["type", "severity", "width_mean_m", "status"]
    assert inventory.publish().recorded is None  # the same run says nothing new


def test_a_crack_that_is_gone_is_missing_where_the_ground_was_measured(session: Session) -> None:
    inventory = open_inventory(session)
    inventory.publish()
    known = found_assets(session)
    assert known is not None
    put(session, "cracks", CRACKS.empty_table(), [])
    inventory.record()
    rows = inventory.state().assets["crack"].rows
    assert rows["status"].to_pylist() == ["missing", "missing"]
    assert min(rows["passes_expected"].to_pylist()) >= 1
