"""Squares of any size give the same assets: what a run wrote of the labelled street, with only the cut changed."""

from __future__ import annotations

from pathlib import Path

import geopandas
import laspy
import numpy as np
import pytest
import shapely

from benchmarks.labelled_street import laid_out
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import changed

WHOLE_M = 200.0
"""Four squares of this edge hold the street, each with all that it reads."""
CLASSES_DIFFER = 5e-4
"""Share of the returns whose class a cut may change: surfaces and tracks of any length end where a scene does."""
POINTS = ("poles", "trees", "signals", "lighting", "delineators", "road_signs", "street_furniture")
AREAS = ("landscape_areas", "lane_lines", "road_markings")
EDGES = ("kerbs", "road_edges", "sidewalks")
TWIN_M = 0.01
"""Places of lines and outlines so near to one another (m) are the same."""


def cut(file: Path, tile_m: float, together: int = 0) -> tuple[np.ndarray, dict[str, geopandas.GeoDataFrame]]:
    """Place (mm) and class of all returns, and objects by table, as a run with squares of this edge writes them."""
    survey = changed(Survey.load(file), {"assets__tile_m": tile_m, "assets__max_scene_returns": together})
    store = Store(str(file.parent / f"store{tile_m:g}-{together}"), survey.config.id)
    run_stages(Session(survey, store, Inline()), [stage_named(n) for n in ("ingest", "footprints", "assets")])
    read = [laspy.read(store.path(path)) for path in store.files("products/classified_points")]
    rows = [np.column_stack([*(np.rint(1e3 * np.asarray(v)) for v in (r.x, r.y, r.z)), r.classification]) for r in read]
    joined = np.concatenate(rows).astype(np.int64)
    tables = {Path(p).stem: p for p in store.files("products/assets") if p.endswith(".parquet")}
    return joined[np.lexsort(joined.T[::-1])], {n: geopandas.read_parquet(store.path(p)) for n, p in tables.items()}


def twins(one: geopandas.GeoDataFrame, other: geopandas.GeoDataFrame) -> int:
    """How many objects of a table the other one has within 1 mm."""
    away = [min((shapely.hausdorff_distance(g, h) for h in other.geometry), default=9.0) for g in one.geometry]
    return int(np.count_nonzero(np.array(away) <= 1e-3))


def share_of_twins(one: geopandas.GeoDataFrame, other: geopandas.GeoDataFrame) -> float:
    """Share of the length of a table's lines and outlines that the other one has within 10 mm."""
    lines, others = ([g.exterior if g.geom_type == "Polygon" else g for g in table.geometry] for table in (one, other))
    places = [shapely.line_interpolate_point(line, np.arange(0.05, line.length, 0.1)) for line in lines]
    return float(np.mean(shapely.distance(np.concatenate(places), shapely.union_all(others)) <= TWIN_M))


@pytest.mark.nightly
def test_squares_of_any_edge_find_the_same_on_the_labelled_street(recordings: Path, tmp_path: Path) -> None:
    file = laid_out(recordings / "semantic_kitti_00", tmp_path, range(8))
    whole, objects = cut(file, WHOLE_M)
    for tile_m, together in ((40.0, 0), (60.0, 0), (80.0, 0), (120.0, 0), (80.0, 10**7)):
        classes, found = cut(file, tile_m, together)
        np.testing.assert_array_equal(classes[:, :3], whole[:, :3])
        assert np.mean(classes[:, 3] != whole[:, 3]) <= CLASSES_DIFFER, tile_m
        for table in (*AREAS, *POINTS):
            assert len(found[table]) == len(objects[table]) == twins(objects[table], found[table]), (tile_m, table)
        for table in EDGES:
            one, other = objects[table], found[table]
            assert len(one) == len(other), (tile_m, table)
            assert min(share_of_twins(one, other), share_of_twins(other, one)) >= 1.0, (tile_m, table)
