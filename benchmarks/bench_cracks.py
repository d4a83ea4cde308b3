"""Cracks and potholes: what is found of cracks of known width and depth by size of the cells, and how fast.

Cells are the medians of a profiler's readings, 1 mm apart both ways (noise σ 0.3 mm, 0.05 % impulses, 2 % dropouts),
and their lowest, of the simulator's road with texture (mean profile depth 0.8 mm), unevenness of class C, ruts and
cross slope. Once more with σ 0.5 mm, 2 % impulses and 5 % dropouts, and with a fifth of the readings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.timing import Figure, thread_seconds
from roadscan.distress.crack_network import Crack, join_cracks
from roadscan.distress.crack_response import LINE_HALF, flank_cells
from roadscan.distress.cracks import crack_pieces
from roadscan.distress.potholes import join_potholes, pothole_pieces
from roadscan.distress.settings import CrackDetection, CrackJoining, PotholeDetection, PotholeJoining
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.surface.heights import HeightWindow, LowestReadings
from roadscan.surface.settings import SurfaceSmoothing
from roadscan.surface.smoothing import smooth_surface

SEEDS = (1, 2, 3)
READING_M, SIGMA_M = 0.001, 0.0003
CLASSES_M = (
    (0.003, 0.005),
    (0.005, 0.003),
    (0.005, 0.008),
    (0.004, 0.010),
    (0.010, 0.010),
    (0.020, 0.020),
    (0.020, 0.030),
)
CELLS_M = (0.005, 0.0025, 0.002)
BENT = [[(10.05, 0.62), (10.4, 0.95), (10.7, 1.0), (11.2, 1.3)], [(10.5, 0.97), (10.45, 1.6)]]
ROAD: dict[str, Any] = {
    "roughness": {"iso_class": "C"},
    "texture": {"mpd_mm": 0.8},
    "cross_slope": 0.03,
    "ruts": [{"offset_m": 0.9}],
}
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Faults:
    """What is wrong with readings."""

    sigma_m: float = SIGMA_M
    impulses: float = 0.0005
    """Share that is wrong by up to 3 cm."""
    dropouts: float = 0.02
    name: str = ""


CLEAN, MANY, FEW = (
    Faults(),
    Faults(0.0005, 0.02, 0.05, ", 2 % impulses"),
    Faults(dropouts=0.8, name=", 5 readings a cell"),
)


@dataclass(frozen=True)
class Seen:
    """A patch as a profiler sees it, and its scene."""

    window: HeightWindow
    scene: Scene

    def on_map(self, lines: Sequence[Sequence[tuple[float, float]]]) -> Any:
        """Lines of stations and offsets on the map, as far as a window shows them."""
        east, north = self.scene.map.easting_m, self.scene.map.northing_m
        w = self.window
        edge = 1 + LINE_HALF + 3 * flank_cells(CrackDetection(), w.cell_m)[-1]
        low = w.map_m(edge, edge)
        high = w.map_m(*(n - edge for n in w.raw_m.shape))
        whole = shapely.MultiLineString([[(east + o, north + s) for s, o in one] for one in lines])
        return shapely.intersection(whole, shapely.box(*low, *high))


def figures(_: Path) -> Iterator[Figure]:
    """Cracks by class and cell, a net, clean roads, potholes, speed."""
    for cell_m in CELLS_M:
        for width_m, depth_m in CLASSES_M:
            yield from quality(cell_m, width_m, depth_m, CLEAN)
    for faults in (MANY, FEW):
        for width_m, depth_m in CLASSES_M[1:]:
            yield from quality(CELLS_M[0], width_m, depth_m, faults)
    yield from net()
    yield from clean()
    yield from potholes()
    yield from speed()


def seen(
    road: dict[str, Any],
    cell_m: float,
    size_m: tuple[float, float],
    seed: int,
    reading_m: float = READING_M,
    faults: Faults = CLEAN,
    change: Callable[[Float64, Float64, Float64], Float64] | None = None,
) -> Seen:
    """A patch from station 10 and offset 0.5 on: medians of readings, their lowest; then smoothed.

    change : what becomes of heights at these offsets and stations; all (rows, columns) of readings.
    """
    scene = Scene(seed=seed).changed(map={"azimuth_deg": 0.0}, road={**ROAD, **road})
    surface = Surface(scene)
    per = round(cell_m / reading_m)
    rows, columns = (round(s / cell_m) for s in size_m)
    first_row, first_column = (round(v / cell_m) for v in (scene.map.northing_m + 10.0, scene.map.easting_m + 0.5))
    east = (first_column + (np.arange(columns * per) + 0.5) / per) * cell_m
    rng = np.random.default_rng(seed)
    raw, drop, count = np.empty((rows, columns)), np.empty((rows, columns)), np.zeros((rows, columns), np.uint16)
    for a in range(0, rows, 100):
        b = min(a + 100, rows)
        north = (first_row + a + (np.arange((b - a) * per) + 0.5) / per) * cell_m
        height = surface.height_m(*np.broadcast_arrays(east[None], north[:, None]))
        height += rng.normal(0.0, faults.sigma_m, height.shape)
        height += np.where(rng.random(height.shape) < faults.impulses, rng.uniform(-0.03, 0.03, height.shape), 0.0)
        height[rng.random(height.shape) < faults.dropouts] = np.nan
        if change is not None:
            places = np.broadcast_arrays((east - scene.map.easting_m)[None], (north - scene.map.northing_m)[:, None])
            height = change(*places, height)
        cells = height.reshape(b - a, per, columns, per).swapaxes(1, 2).reshape(b - a, columns, -1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            raw[a:b] = np.nanmedian(cells, axis=2)
            drop[a:b] = raw[a:b] - np.nanmin(cells, axis=2)
        count[a:b] = (~np.isnan(cells)).sum(axis=2)
    smooth = smooth_surface(raw, SurfaceSmoothing(sigma_m=faults.sigma_m))
    lowest = LowestReadings(drop.astype(np.float32), count)
    window = HeightWindow(raw, smooth, cell_m, faults.sigma_m, first_row, first_column, lowest=lowest)
    return Seen(window, scene)


def cracks_of(one: Seen) -> list[Crack]:
    return join_cracks(crack_pieces(one.window, CrackDetection()), 0.0, one.window.cell_m, CrackJoining())


def scores(found: Sequence[Crack], truth: Any, cell_m: float) -> tuple[float, float]:
    """Precision and recall of places along the lines, a cell apart, 2 cells of tolerance."""
    if not found:
        return 1.0, 0.0
    lines = shapely.union_all([c.line for c in found])
    every = lambda of: [one.interpolate(s) for one in shapely.get_parts(of) for s in np.arange(0, one.length, cell_m)]  # noqa: E731
    near = [shapely.distance(every(a), b) <= 2 * cell_m for a, b in ((lines, truth), (truth, lines))]
    return float(near[0].mean()), float(near[1].mean())


def quality(cell_m: float, width_m: float, depth_m: float, faults: Faults) -> Iterator[Figure]:
    cracks = [{"points_m": line, "width_m": width_m, "depth_m": depth_m} for line in BENT]
    rows = []
    for seed in SEEDS:
        one = seen({"cracks": cracks}, cell_m, (1.0, 1.0), seed, faults=faults)
        found, truth = cracks_of(one), one.on_map(BENT)
        if not found:
            rows.append((1.0, 0.0, np.nan, np.nan, 0.0))
            continue
        length = sum(c.length_m for c in found)
        mean = [sum(getattr(c, n) * c.length_m for c in found) / length for n in ("depth_mean_m", "width_mean_m")]
        rows.append((*scores(found, truth, cell_m), *mean, length / truth.length))
    precision, recall, *_, length = np.mean(rows, axis=0)
    depth, width = (np.mean([r[k] for r in rows if r[1] > 0.0]) for k in (2, 3))
    what = f"{cell_m * 1e3:g} mm cells{faults.name}, crack {width_m * 1e3:g} × {depth_m * 1e3:g} mm"
    yield Figure(f"{what}: precision", precision, "", None, "bar: 0.95")
    yield Figure(
        f"{what}: recall", recall, "", None, f"bar: 0.95; least of {len(rows)} seeds {min(r[1] for r in rows):.3f}"
    )
    yield Figure(f"{what}: mean depth", depth * 1e3, "mm", depth_m * 1e3, "truth (bar: 10 %)")
    yield Figure(f"{what}: width at half depth", width * 1e3, "mm", 541.2 * width_m, "truth (bar: 2 cells)")
    yield Figure(f"{what}: length over true length", length, "")


def net() -> Iterator[Figure]:
    field = {"station_m": 11.0, "offset_m": 1.3, "length_m": 1.2, "width_m": 0.8}
    for cell_m in (0.005, 0.0025):
        found = cracks_of(seen({"alligators": [field]}, cell_m, (2.0, 1.6), 1))
        largest = max(found, key=lambda c: c.length_m)
        what = f"net of 5 × 8 mm cracks, {cell_m * 1e3:g} mm cells: pieces of {largest.kind}"
        yield Figure(what, len(found), "", 1, f"one net; {largest.polygons} polygons in the largest")


def clean() -> Iterator[Figure]:
    stains = {
        "stains": [{"station_m": 12.0 + 9 * k, "offset_m": 1.2} for k in range(10)],
        "tyre_marks": [{"points_m": [(20.0, 0.9), (60.0, 1.0), (100.0, 0.95)]}],
    }
    for mpd_mm in (0.8, 1.5):
        road = {**stains, "texture": {"mpd_mm": mpd_mm}}
        found = cracks_of(seen(road, 0.005, (100.0, 1.5), 4, 0.0025))
        yield Figure(f"100 m without a crack, texture {mpd_mm} mm, stains", len(found), "cracks", None, "bar: 0")


def potholes() -> Iterator[Figure]:
    """Volumes of holes in the open and where a kerb of 12 cm meets their rim; then a clean road."""
    kerb = {"lane_width_m": 2.9, "kerbs": [{"side": "right", "height_m": 0.12}]}
    for radius_m, depth_m in ((0.08, 0.03), (0.2, 0.05), (0.3, 0.04), (0.5, 0.05), (0.75, 0.05), (0.75, 0.08)):
        for road, offset_m in (({}, 1.7), (kerb, 2.9 - radius_m)):
            hole = {"station_m": 12.0, "offset_m": offset_m, "radius_m": radius_m, "depth_m": depth_m}
            one = seen({"potholes": [hole], **road}, 0.005, (4.0, 4.0), 1, 0.0025)
            found = join_potholes(pothole_pieces(one.window, PotholeDetection()), PotholeJoining())
            volume = sum(p.volume_m3 for p in found)
            what = f"pothole of {radius_m * 2e3:g} × {depth_m * 1e3:g} mm{' at a kerb' if road else ''}"
            true = np.pi * radius_m**2 * depth_m * 8 / 15 * 1e3
            yield Figure(f"{what}: volume ({len(found)} found)", volume * 1e3, "l", true, "truth, to its rim")
    for iso_class in "CD":
        one = seen({"roughness": {"iso_class": iso_class}}, 0.01, (100.0, 3.0), 4, 0.01)
        found = join_potholes(pothole_pieces(one.window, PotholeDetection()), PotholeJoining())
        yield Figure(f"100 m without a pothole, class {iso_class}", len(found), "potholes", 0, "truth")


def speed() -> Iterator[Figure]:
    rng = np.random.default_rng(1)
    raw = 500.0 + rng.normal(0.0, SIGMA_M, (1600, 1600))
    raw[:, 400::400] -= 0.006
    window = HeightWindow(raw, raw, 0.005, SIGMA_M, 0, 0, 200)
    for what, work in (
        ("pieces of cracks", lambda: crack_pieces(window, CrackDetection())),
        ("pieces of potholes", lambda: pothole_pieces(window, PotholeDetection())),
    ):
        yield Figure(f"{what}, halo counted", raw.size / thread_seconds(work, 2) / 1e6, "M cells/s of a core")
