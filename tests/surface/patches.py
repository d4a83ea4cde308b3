"""Patches of road with known cracks, sampled into cells as a sensor's readings would be.

The surface is the simulator's: grade, cross slope, unevenness of class A, and cracks. A cell holds the surface's mean
over its area, as the readings of a profiler or the footprint of a SICK beam do; then noise, impulses, dropouts.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter

from roadscan.simulate.kernels.road import survey_points
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Sensor:
    """Cells and errors of a sensor."""

    name: str
    cell_m: tuple[float, float]
    """Extent of a cell along and across the road."""
    sigma_m: float
    impulse_m: float
    """Impulses are a tenth of this to all of it, up or down."""


PROFILER_5, PROFILER_2, PROFILER_1 = (Sensor(f"profiler, {n} mm", (n / 1e3,) * 2, 0.0005, 0.03) for n in (5, 2, 1))
SICK = Sensor("SICK, 3 × 1 cm", (0.03, 0.01), 0.006, 0.2)
IMPULSES, DROPOUTS = 0.02, 0.05
CLASSES_M = ((0.003, 0.005), (0.003, 0.03), (0.006, 0.01), (0.01, 0.02), (0.02, 0.005), (0.02, 0.03))
"""Width and depth of cracks."""
_STATION_M, _OFFSET_M = 10.0, 0.5


@dataclass(frozen=True)
class Patch:
    """A patch with its truth; all arrays (rows, columns), rows along the road."""

    sensor: Sensor
    truth_m: Float64
    crack_m: Float64
    """Depth of the crack in a cell, mean over its area."""
    measured_m: Float64
    """NaN where the sensor saw nothing."""
    impulse: Bool


def cracked(sensor: Sensor, cells: int, classes: tuple[tuple[float, float], ...], seed: int = 3) -> Patch:
    """A square of cells with a crack of each class (width, depth, m), side by side; each bends twice."""
    length, width = cells * sensor.cell_m[0], cells * sensor.cell_m[1]
    lane = width / len(classes)
    bends = ((-0.05, 0.25), (0.35, 0.4), (0.7, 0.7), (1.05, 0.75))
    cracks = [
        {
            "points_m": [(_STATION_M + s * length, _OFFSET_M + (k + o) * lane) for s, o in bends],
            "width_m": w,
            "depth_m": d,
        }
        for k, (w, d) in enumerate(classes)
    ]
    return measured(sensor, *sampled(sensor, cells, cracks), seed)


def across(sensor: Sensor, cells: int, width_m: float, depth_m: float, seed: int = 3) -> Patch:
    """The same with one crack across the road."""
    length, width = cells * sensor.cell_m[0], cells * sensor.cell_m[1]
    ends = ((0.42, -0.05), (0.5, 0.5), (0.52, 1.05))
    points = [(_STATION_M + s * length, _OFFSET_M + o * width) for s, o in ends]
    crack = {"points_m": points, "width_m": width_m, "depth_m": depth_m}
    return measured(sensor, *sampled(sensor, cells, [crack]), seed)


def sampled(sensor: Sensor, cells: int, cracks: list[dict[str, Any]], fine: int = 4) -> tuple[Float64, Float64]:
    """Height and crack depth of each cell, means over fine × fine places."""
    scene = Scene(seed=5).changed(
        map={"azimuth_deg": 0.0}, road={"cracks": cracks, "roughness": {"iso_class": "A"}, "cross_slope": 0.025}
    )
    surface = Surface(scene)
    place = (np.arange(cells * fine) + 0.5) / fine
    north = scene.map.northing_m + _STATION_M + place * sensor.cell_m[0]
    east = scene.map.easting_m + _OFFSET_M + place * sensor.cell_m[1]
    easting, northing = np.broadcast_arrays(east[None, :], north[:, None])
    height = surface.height_m(easting, northing)
    depth = defect_depth_m(surface, easting, northing)
    height, depth = (a.reshape(cells, fine, cells, fine).mean(axis=(1, 3)) for a in (height, depth))
    return height, depth


def defect_depth_m(surface: Surface, easting_m: Float64, northing_m: Float64) -> Float64:
    """Return the depth of the pothole, crack or joint at map points (any shape, m); 0 where there is none."""
    east, north = easting_m.ravel(), northing_m.ravel()
    out = np.empty((east.size, 6))
    local = (east - surface.origin_enh_m[0], north - surface.origin_enh_m[1])
    survey_points(surface.arrays, *local, surface.nearest_node(east, north), out)
    return out[:, 3].reshape(easting_m.shape)


def measured(sensor: Sensor, truth_m: Float64, crack_m: Float64, seed: int) -> Patch:
    """The patch with the sensor's errors."""
    rng = np.random.default_rng(seed)
    height = truth_m + rng.normal(0.0, sensor.sigma_m, truth_m.shape)
    impulse = rng.random(truth_m.shape) < IMPULSES
    size = rng.uniform(0.1, 1.0, truth_m.shape) * rng.choice([-1.0, 1.0], truth_m.shape) * sensor.impulse_m
    height += np.where(impulse, size, 0.0)
    height[rng.random(truth_m.shape) < DROPOUTS] = np.nan
    return Patch(sensor, truth_m, crack_m, height, impulse)


def median_9(height_m: Float64) -> Float64:
    """Median of 9 × 9 cells, those without a height left out."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(height_m, 4, constant_values=np.nan), (9, 9))
    found = np.empty(height_m.shape)
    for i in range(height_m.shape[0]):
        found[i] = np.nanmedian(windows[i].reshape(height_m.shape[1], 81), axis=1)
    return np.where(np.isnan(height_m), np.nan, found)


def rms_m(patch: Patch, height_m: Float64, where: Bool | None = None) -> float:
    """Root mean square of the error where something was measured."""
    error = (height_m - patch.truth_m)[True if where is None else where]
    return float(np.sqrt(np.nanmean(error**2)))


def depth_bias(patch: Patch, height_m: Float64) -> float:
    """Mean depth found over the mean true one, less 1, in cells over half as deep as the deepest of their crack."""
    core = patch.crack_m > 0.5 * _deepest(patch)
    ground = patch.truth_m + patch.crack_m
    seen = core & ~np.isnan(height_m)
    return float((ground - height_m)[seen].mean() / patch.crack_m[seen].mean() - 1.0)


def width_change_cells(patch: Patch, height_m: Float64) -> float:
    """Mean width at half depth found, less the true one, in cells; for a patch with one crack from end to end."""
    half = 0.5 * patch.crack_m.max()
    seen = ~np.isnan(height_m)
    found = (patch.truth_m + patch.crack_m - height_m > half) & (_deepest(patch) > 0) & seen
    return float((found.sum() - ((patch.crack_m > half) & seen).sum()) / max(patch.crack_m.shape) / seen.mean())


@functools.lru_cache(maxsize=8)
def _near(crack: bytes, shape: tuple[int, int]) -> Float64:
    deepest: Float64 = maximum_filter(np.frombuffer(crack).reshape(shape), 9)
    return deepest


def _deepest(patch: Patch) -> Float64:
    """Greatest depth within four cells."""
    return _near(patch.crack_m.tobytes(), patch.crack_m.shape)
