"""Cells that are counted straight from the readings are those of the points, to the bit."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

import roadscan.tiles.tasks.tile_cells as tile_cells
from roadscan.core.errors import RunError
from roadscan.core.survey import Survey
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Session
from roadscan.simulate import simulate
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.status import survey_status
from roadscan.tiles.accumulator import Accumulator
from tests.surveys import Simulated, outputs, small_scene

WITHOUT_POINTS = ["geotiff", "tile_table"]


@pytest.fixture(scope="module")
def counted(finished: Simulated) -> Store:
    finished.run("store-counted", products__make=WITHOUT_POINTS)
    return finished.store("store-counted")


def of(store: Store, *tops: str) -> dict[str, bytes]:
    return {path: content for path, content in outputs(store).items() if path.startswith(tops)}


def test_cells_without_points_are_those_of_points(finished: Simulated, counted: Store) -> None:
    tops = ("tiles/cells", "tiles/overviews", "tiles/geotiff", "products/tile_table")
    one, other = of(finished.store(), *tops), of(counted, *tops)
    assert one
    assert sorted(one) == sorted(other)
    assert [path for path in one if one[path] != other[path]] == []


def test_fates_are_those_of_points(finished: Simulated, counted: Store) -> None:
    survey = Survey.load(finished.survey_file)
    by_points = survey_status(Session(survey, finished.store())).readings
    assert by_points
    assert sum(by_points.values()) == sum(
        pq.read_metadata(finished.store().path(file.path)).num_rows * (200 if "/scans/" in f"/{file.path}" else 1)
        for record in read_log_records(finished.store())
        for table in ("scans", "returns")
        for file in record.tables.get(table, ())
    )
    assert survey_status(Session(survey, counted)).readings == by_points


@pytest.mark.slow
def test_neither_blocks_nor_workers_change_a_byte(finished: Simulated, counted: Store) -> None:
    finished.run("store-counted-1", products__make=WITHOUT_POINTS, tiles__block_tiles=1)
    assert outputs(finished.store("store-counted-1")) == outputs(counted)
    with compute_on(2) as compute:
        finished.run("store-counted-2", compute, products__make=WITHOUT_POINTS)
        finished.run("store-2", compute)
    assert outputs(finished.store("store-counted-2")) == outputs(counted)
    assert outputs(finished.store("store-2")) == outputs(finished.store())


def test_cells_that_do_not_fit_are_made_in_parts(
    finished: Simulated, counted: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    dropped = []

    class Tight(Accumulator):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments, most_bytes=12 << 20)

        def drop(self) -> None:
            dropped.append(1)
            super().drop()

    monkeypatch.setattr(tile_cells, "Accumulator", Tight)
    monkeypatch.setattr(tile_cells, "_pool", lambda: None)
    finished.run("store-counted-tight", products__make=WITHOUT_POINTS)
    assert dropped
    assert outputs(finished.store("store-counted-tight")) == outputs(counted)


def test_a_damaged_row_group_costs_the_tiles_that_it_touches(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    copy.run(products__make=WITHOUT_POINTS)
    whole = outputs(copy.store())
    store = copy.store()
    file = next(p for p in store.files("tables/scans", ".parquet"))
    path = Path(store.path(file))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    manifest = Manifest(store)
    manifest.forget("tile", list(manifest.of("tile")))
    with pytest.raises(RunError, match=r"cannot be read|damaged") as error:
        copy.run(products__make=WITHOUT_POINTS)
    lost = [r.unit for r in Manifest(store).of("tile").values()]
    assert 0 < len(lost) < len([p for p in whole if p.startswith("tiles/cells")])
    assert path.name in str(error.value)


@pytest.mark.slow
def test_a_turning_mirror(tmp_path: Path) -> None:
    scene = small_scene(sick={"on": True}, profilers={"on": False}, lidar={"on": False})
    survey = Simulated(simulate(scene, tmp_path).survey_file)
    survey.run("points", products__make=["las", "geotiff"])
    survey.run("cells", products__make=["geotiff"])
    one, other = of(survey.store("points"), "tiles/cells"), of(survey.store("cells"), "tiles/cells")
    assert one and one == other
