"""Tiny surveys for the tests of products, made without roadscan's own kernels."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.grid import LanePass, PassId, RunId, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.tiles.cells import CellValues, TileCells
from roadscan.tiles.product import ProductContext, Tile, TileSummary

Surface = Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.float64]]

START_GPS_NS = 1_461_000_000_123_456_789


@dataclass(frozen=True)
class Place:
    """A map and a tile of it, with what an outside program should make of them."""

    map: MapFrame
    tile: TileId
    unit_m: float
    height_unit_m: float
    height_unit: str


US_FOOT_M = 1200 / 3937

PLACES = {
    "utm_north": Place(MapFrame("EPSG:25832"), TileId(55_321, 602_011), 1.0, 1.0, "metre"),
    "utm_south": Place(MapFrame("EPSG:32734"), TileId(26_150, 624_377), 1.0, 1.0, "metre"),
    "us_feet": Place(MapFrame("EPSG:6539"), TileId(30_512, 6_133), US_FOOT_M, US_FOOT_M, "US survey foot"),
    "us_feet_heights_too": Place(
        MapFrame("EPSG:6539", height="orthometric", vertical_crs="EPSG:6360"),
        TileId(30_512, 6_133),
        US_FOOT_M,
        US_FOOT_M,
        "US survey foot",
    ),
    "local": Place(MapFrame(None, local_name="yard"), TileId(-3, 4), 1.0, 1.0, "metre"),
}


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest) -> Place:
    return PLACES[request.param]


@pytest.fixture(params=["us_feet_heights_too", "local"])
def far_apart_place(request: pytest.FixtureRequest) -> Place:
    """The two places that differ most: for tests in which the map matters little."""
    return PLACES[request.param]


@pytest.fixture
def places() -> dict[str, Place]:
    return PLACES


def below_zero(x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A road 1.5 m below zero with a step and a slope."""
    return -1.5 + 0.002 * np.mod(x_m, 100.0) - 0.001 * np.mod(y_m, 100.0) + 0.05 * (np.mod(x_m, 3.0) < 1.0)


class Workshop:
    """Makes contexts, points, cells and summaries."""

    def context(self, frame: MapFrame, cell_m: float = 0.5, size_m: float = 10.0) -> ProductContext:
        lane = LanePass(PassId(1), RunId("drive"), START_GPS_NS, START_GPS_NS + 10**12)
        return ProductContext("yard-7", "", frame, TileGrid(size_m, cell_m), (lane,), dt.date(2026, 4, 24))

    def points(
        self, tile: TileId, count: int = 2_000, surface: Surface = below_zero, noise_m: float = 0.004
    ) -> TilePoints:
        rng = np.random.default_rng(tile.column % 1000 * 7919 + tile.row % 1000)
        x, y = rng.integers(0, 1_000_000, (2, count), dtype=np.int32)
        x[:3], y[:3] = (0, 999_999, 5), (0, 999_999, 15)  # the tile's corners, and a tie of rounding
        at = tile.column * 10.0 + x / 1e5, tile.row * 10.0 + y / 1e5
        height_m = surface(*at) + rng.normal(0.0, noise_m, count)
        return TilePoints(
            tile=tile,
            x_quanta=x,
            y_quanta=y,
            height_quanta=np.rint(height_m * 1e5).astype(np.int32),
            epoch_gps_ns=START_GPS_NS + np.sort(rng.integers(0, 10**10, count)),
            intensity=rng.integers(0, 65_536, count).astype(np.uint16),
            classification=rng.integers(0, 65, count).astype(np.uint8),
            pass_id=rng.choice(np.array([1, 2, 40_000], dtype=np.uint16), count),
        )

    def cells(self, points: TilePoints, grid: TileGrid) -> TileCells:
        """Cells by pandas, after the rules of ``schemas/cells.toml``."""
        edge = round(grid.cell_m * 1e5)
        frame = pd.DataFrame(
            {
                "row": points.y_quanta // edge,
                "column": points.x_quanta // edge,
                "height": points.height_quanta / 1e5,
                "intensity": points.intensity.astype(float),
                "pass_id": points.pass_id,
            }
        )
        groups = frame.groupby(["row", "column"], sort=True)
        heights = groups["height"]
        passes = groups["pass_id"].agg(lambda ids: sorted(set(ids)))
        where = passes.index.to_frame()
        sizes = passes.map(len).to_numpy()
        return TileCells(
            tile=points.tile,
            cells_per_edge=grid.cells_per_edge,
            column=where["column"].to_numpy().astype(np.uint16),
            row=where["row"].to_numpy().astype(np.uint16),
            count=heights.size().to_numpy().astype(np.uint32),
            height_mean_m=heights.mean().to_numpy(),
            height_robust_m=heights.agg(_robust).to_numpy(),
            height_min_m=heights.min().to_numpy(),
            height_max_m=heights.max().to_numpy(),
            height_std_m=heights.std(ddof=0).to_numpy().astype(np.float32),
            intensity_mean=groups["intensity"].mean().to_numpy().astype(np.float32),
            pass_count=sizes.astype(np.uint16),
            pass_offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32),
            pass_ids=np.concatenate(passes.to_list()).astype(np.uint16),
        )

    def tile(self, tile: TileId, grid: TileGrid, **settings: Any) -> Tile:
        points = self.points(tile, **settings)
        return Tile(points, self.cells(points, grid))

    def summary(self, tile: Tile) -> TileSummary:
        points, cells = tile.points, tile.cells
        return TileSummary(
            tile=points.tile,
            points=len(points),
            cells=len(cells),
            height_min_m=float(cells.height_min_m.min()),
            height_mean_m=float(cells.height_robust_m.mean()),
            height_max_m=float(cells.height_max_m.max()),
            height_std_median_m=float(np.median(cells.height_std_m)),
            intensity_mean=float(points.intensity.mean()),
            passes=tuple(int(p) for p in np.unique(points.pass_id)),
            first_epoch_gps_ns=int(points.epoch_gps_ns.min()),
            last_epoch_gps_ns=int(points.epoch_gps_ns.max()),
        )

    def survey(self, tiles: Iterable[TileId], context: ProductContext, **settings: Any) -> SmallSurvey:
        return self.survey_of({t: self.tile(t, context.grid, **settings) for t in tiles}, context)

    def survey_of(self, tiles: dict[TileId, Tile], context: ProductContext) -> SmallSurvey:
        return SmallSurvey(context, tiles, self)


@dataclass
class CellsInMemory:
    """Cells for products over many tiles, and a count of how often each tile was asked for."""

    tiles: dict[TileId, Tile]
    loads: dict[TileId, int]

    def __call__(self, tile: TileId) -> TileCells | None:
        if tile not in self.tiles:
            return None
        self.loads[tile] += 1
        return self.tiles[tile].cells

    def values(self, tile: TileId, name: str) -> CellValues | None:
        cells = self(tile)
        return (
            None if cells is None else CellValues(cells.cells_per_edge, cells.column, cells.row, getattr(cells, name))
        )


@dataclass
class SmallSurvey:
    """Tiles in memory, and a count of how often each was asked for."""

    context: ProductContext
    tiles: dict[TileId, Tile]
    workshop: Workshop

    def __post_init__(self) -> None:
        self.loads: dict[TileId, int] = dict.fromkeys(self.tiles, 0)

    @property
    def load_cells(self) -> CellsInMemory:
        return CellsInMemory(self.tiles, self.loads)

    @property
    def summaries(self) -> list[TileSummary]:
        return [self.workshop.summary(one) for one in self.tiles.values()]

    def values(self, name: str, unit_m: float = 1.0) -> dict[tuple[int, int], float]:
        """One value a cell by (column, row) counted over the whole map."""
        found: dict[tuple[int, int], float] = {}
        for tile, one in self.tiles.items():
            n = one.cells.cells_per_edge
            for column, row, value in zip(one.cells.column, one.cells.row, getattr(one.cells, name), strict=True):
                found[tile.column * n + int(column), tile.row * n + int(row)] = float(value) / unit_m
        return found


def _robust(heights: pd.Series[float]) -> float:
    """Mean within 3 · 1.4826 · MAD (at least 1 mm) of the lower median."""
    ordered = np.sort(heights.to_numpy())
    median = ordered[(ordered.size - 1) // 2]
    off = np.abs(ordered - median)
    mad = np.sort(off)[(off.size - 1) // 2]
    return float(ordered[off <= max(3 * 1.4826 * mad, 0.001)].mean())


@pytest.fixture(scope="session")
def workshop() -> Workshop:
    return Workshop()


@pytest.fixture(scope="session")
def damage() -> Callable[[bytes], list[tuple[str, bytes]]]:
    """Copies of a file's bytes with faults: cut short, and single bits flipped all over it."""

    def copies(good: bytes) -> list[tuple[str, bytes]]:
        rng = np.random.default_rng(7)
        found = [("half", good[: len(good) // 2]), ("last byte", good[:-1]), ("empty", b"")]
        for at in np.sort(rng.choice(len(good), 40, replace=False)):
            bad = bytearray(good)
            bad[at] ^= 1 << int(rng.integers(0, 8))
            found.append((f"bit in byte {at}", bytes(bad)))
        return found

    return copies
