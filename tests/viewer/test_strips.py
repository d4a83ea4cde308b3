"""Strips of a road of 3 km in the page: little is fetched at first, and all values where people look closely."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from roadscan.site.document import json_bytes
from tests.viewer.conftest import FolderSite, go_to
from tests.viewer.street import EAST_M, NORTH_M
from tests.viewer.test_large import served

LONG_M = 3000
STEP_M = 0.25
BINS = 300
PIECE_M = 250
QUANTITY = "rut_depth_left_mm"


def value_at(station_m: float) -> float:
    """Depth of the rut: waves of 40 m, and one peak at 1,234.5 m."""
    return 5.0 + 2.0 * math.sin(station_m / 40.0 * 2.0 * math.pi) + (20.0 if abs(station_m - 1234.5) < 0.1 else 0.0)


def series(places: list[float]) -> dict[str, Any]:
    """Values of cross-sections."""
    values = [value_at(one) for one in places]
    sigma = [0.125] * len(places)
    return {
        "quantity": QUANTITY, "extent": "cross_section", "from_m": places, "to_m": places, "value": values,
        "sigma": sigma, "share": [None] * len(places), "reason": [None] * len(places),
    }  # fmt: skip


def stations(first_m: float, last_m: float) -> list[float]:
    """Stations of cross-sections from one place to before another."""
    return [first_m + k * STEP_M for k in range(round((last_m - first_m) / STEP_M))]


def binned() -> dict[str, Any]:
    """The bins of the whole lane."""
    long_m = LONG_M / BINS
    own = [[value_at(s) for s in stations(k * long_m, (k + 1) * long_m)] for k in range(BINS)]
    none = [None] * BINS
    return {
        "quantity": QUANTITY, "extent": "cross_section", "from_m": [k * long_m for k in range(BINS)],
        "to_m": [(k + 1) * long_m for k in range(BINS)], "value": [sum(one) / len(one) for one in own],
        "low": list(map(min, own)), "high": list(map(max, own)), "sigma": none, "share": none, "reason": none,
    }  # fmt: skip


@pytest.fixture
def long_address(street: Path, tmp_path: Path) -> Iterator[str]:
    """The street's page with a lane of 3 km."""
    site = tmp_path / "site"
    shutil.copytree(street, site, ignore=shutil.ignore_patterns("clouds", "pictures", "strips", "meshes"))
    survey = json.loads((site / "survey.json").read_text())
    survey |= dict.fromkeys(("clouds", "pictures", "meshes", "edits"))
    (site / "survey.json").write_bytes(json_bytes(survey))
    pieces = [
        {"from_m": first, "to_m": first + PIECE_M, "url": f"strips/0/{first}.json"}
        for first in range(0, LONG_M, PIECE_M)
    ]
    lane = {"lane_id": 0, "survey": "street", "road": "road1", "name": None, "lane": "1", "direction": "forward"}
    ends = {"station_m": [0.0, float(LONG_M)], "bounds_m": [EAST_M, NORTH_M, EAST_M + LONG_M, NORTH_M]}
    quantity = {"name": QUANTITY, "title": "rut depth left", "unit": "mm", "meaning": ""}
    index = {
        "lanes": [lane | ends | {"url": "strips/0.json", "pieces": pieces, "cross_sections": []}],
        "quantities": [quantity],
        "panels": [{"title": "Rut", "quantities": [QUANTITY]}],
    }
    (site / "strips/0").mkdir(parents=True)
    (site / "strips/index.json").write_bytes(json_bytes(index))
    line = {
        "station_m": [0.0, LONG_M],
        "easting_m": [EAST_M, EAST_M + LONG_M],
        "northing_m": [NORTH_M, NORTH_M],
    }
    (site / "strips/0.json").write_bytes(json_bytes(lane | {"line": line, "series": [binned()]}))
    for one in pieces:
        held = {"series": [series(stations(one["from_m"], one["to_m"]))]}
        (site / one["url"]).write_bytes(json_bytes(one | held))
    yield from served(FolderSite(site))


@pytest.mark.slow
def test_a_long_lane_is_fetched_in_full_where_people_look(open_page: Any, long_address: str) -> None:
    with open_page(long_address) as watched:
        asked: list[str] = []
        watched.page.on("request", lambda one: asked.append(one.url.removeprefix(long_address)))
        page = watched.open(f"{long_address}#views=map,strips")
        page.locator(".strips .panel canvas").first.wait_for()
        assert [one for one in asked if one.startswith("strips/")] == ["strips/index.json", "strips/0.json"]
        # From far away a bin is told as what it is, and the peak is in its range.
        go_to(page, "lane=0&station=1234.5")
        read = page.locator(".reads .number")
        read.wait_for()
        assert f" to {value_at(1234.5):.4f}" in read.inner_text() and "in 10.0" in read.inner_text()
        # Zoom in by dragging over some 240 m around the cursor.
        over = page.locator(".strips .u-over")
        over.hover()  # waits until it moves no more
        plot = over.bounding_box()
        middle = plot["x"] + plot["width"] * 1234.5 / LONG_M
        reach, height = plot["width"] * 120.0 / LONG_M, plot["y"] + plot["height"] / 2
        page.mouse.move(middle - reach, height)
        page.mouse.down()
        page.mouse.move(middle + reach, height, steps=4)
        page.mouse.up()
        page.wait_for_selector('.strips[data-waiting="0"]')
        own = [one for one in asked if one.startswith("strips/0/")]
        assert sorted(own) == ["strips/0/1000.json", "strips/0/1250.json"]
        go_to(page, "lane=0&station=1234.52")
        page.locator(".strips-head", has_text="1 234.52 m".replace(" ", "\u202f", 1)).wait_for()
        told = read.inner_text()
        assert float(told.split("±")[0]) == pytest.approx(value_at(1234.5), abs=1e-3)
        assert told.split("±")[1].strip() == "0.13" and "in 10" not in told
