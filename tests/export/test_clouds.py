"""Surveys of vendors' clouds alone: the same bytes whatever is computed together, and no height that is none."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from roadscan.core.errors import RunError
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import outputs


def write_cloud(path: Path, point_format: int, easting: np.ndarray, seconds: float, height: float = 50.0) -> None:
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, [easting.min(), 0, 0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las = laspy.LasData(header)
    las.x, las.y, las.z = easting, np.full(easting.size, 5.0), np.full(easting.size, height)
    las.gps_time = np.full(easting.size, seconds)
    if point_format == 7:
        las.red = np.arange(easting.size)
    las.write(path)


def run(folder: Path, logs: list[str], edge: int) -> Store:
    values = {
        "id": "cloud",
        "store": f"store-{edge}",
        "map": {"crs": "EPSG:32632"},
        "tiles": {"block_tiles": edge, "cell_m": 0.5},
        "defaults": {"height": "ellipsoidal"},
        "runs": [{"id": "r", "logs": [{"path": p, "format": "las", "crs": "EPSG:32632"} for p in logs]}],
    }
    survey = Survey.parse(values, folder=folder)
    store = Store(survey.store_url, "cloud")
    run_stages(Session(survey, store, Inline()), stages())
    return store


def test_what_else_is_in_a_block_changes_no_tile(tmp_path: Path) -> None:
    write_cloud(tmp_path / "colour.las", 7, np.array([1.0, 2.0, 12.0]), 200_000_000.0)
    write_cloud(tmp_path / "plain.las", 6, np.array([14.0, 16.0, 25.0]), 200_000_000.0)
    logs = ["colour.las", "plain.las"]
    alone, together = run(tmp_path, logs, 1), run(tmp_path, logs, 8)
    assert outputs(alone) == outputs(together)
    formats = {}
    for path in alone.files("tiles/las"):
        formats[Path(path).name.split(".")[0]] = laspy.read(alone.path(path)).header.point_format.id
    assert formats == {"0_0": 7, "1_0": 7, "2_0": 6}


@pytest.mark.parametrize("height", [-99_999.0, 30_000.0])
def test_a_height_that_is_none_is_counted_and_left_out(tmp_path: Path, height: float) -> None:
    write_cloud(tmp_path / "good.las", 6, np.array([1.0, 2.0]), 200_000_000.0)
    write_cloud(tmp_path / "bad.las", 6, np.array([3.0]), 200_000_001.0, height)
    with pytest.raises(RunError, match=r"1 unit failed: footprints bad\.las: not one of the 1 readings.*heights"):
        run(tmp_path, ["good.las", "bad.las"], 8)
    store = Store(str(tmp_path / "store-8"), "cloud")
    (path,) = store.files("tiles/las")
    assert np.array(laspy.read(store.path(path)).z).tolist() == [50.0, 50.0]
