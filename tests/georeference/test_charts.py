"""Charts against PROJ."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.crs import MapFrame, world_frame_of, world_from_geodetic
from roadscan.georeference.charts import BOX_M, charts_along


def chart_value(coefficients: np.ndarray, d: np.ndarray) -> np.ndarray:
    x, y, z = d.T
    terms = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    return (coefficients @ terms).T


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(["EPSG:32632", "EPSG:32756", "EPSG:6539", "EPSG:25833"]), st.integers(0, 2**31))
def test_chart_departs_from_proj_by_microns(crs: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = {"EPSG:32632": (9, 50), "EPSG:32756": (153, -30), "EPSG:6539": (-73.5, 40.7), "EPSG:25833": (15, 55)}[crs]
    world = world_frame_of(crs)
    here = world_from_geodetic(world, np.array([[centre[0] + rng.uniform(-2, 2), centre[1], rng.uniform(-50, 2500)]]))
    frame = MapFrame(crs=crs)
    charts = charts_along(frame, world, here)
    box = np.floor(here[0] / BOX_M).astype(int) - charts.lattice[1:].astype(int)
    index = charts.table[tuple(box)]
    direction = rng.normal(size=(200, 3))
    offsets = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(0, 300, (200, 1))
    exact = frame.map_from_world(world, charts.centres[index] + offsets)
    assert np.abs(chart_value(charts.coefficients[index], offsets) - exact).max() < 2e-6


def test_local_frame_is_its_own_chart() -> None:
    charts = charts_along(MapFrame(crs=None, local_name="x"), "local", np.array([[1e6, -2e6, 3.0]]))
    point = np.array([[12.5, -3.25, 99.0]])
    assert chart_value(charts.coefficients[0], point) == pytest.approx(point)
