"""The road's surface from its description: one function, used by the sensors and by the truth."""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from roadscan.simulate import kernels
from roadscan.simulate.kernels import NODE_STEP_M, RoadArrays
from roadscan.simulate.scene import Element, Road, Scene

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

RIDE_WAVELENGTH_M = 10.0
"""Shorter waves do not move the vehicle: its tyres and springs take them."""


class Surface:
    """Height and intensity of the road, known everywhere on it.

    The reference line has a curvature that is linear between nodes each 0.5 m. Its height is the sum of grade and
    waves, held as quintic polynomials that agree with it in value, slope and curvature at the nodes (within
    1 µm for waves of 2 m). On it lie crown, verge, ruts, and potholes or cracks, all functions of station and offset.

    Parameters
    ----------
    scene : the scene.
    ride : True for the smooth surface that guides the vehicle: long waves, crown and verge only.
    """

    def __init__(self, scene: Scene, *, ride: bool = False) -> None:
        road = scene.road
        self.origin_enh_m = np.array([scene.map.easting_m, scene.map.northing_m, scene.map.height_m])
        """Map coordinates that `arrays` count from."""
        before = math.ceil(road.lead_m / NODE_STEP_M)
        after = math.ceil((scene.length_m + road.lead_m) / NODE_STEP_M)
        station: Float64 = NODE_STEP_M * np.arange(-before, after + 1, dtype=np.float64)
        line = _reference_line(road, station, math.radians(scene.map.azimuth_deg))
        defects, ranges = _by_node(np.zeros((0, 7)) if ride else _defects(road, scene.length_m), station)
        self.arrays = RoadArrays(
            nodes=np.concatenate([line, _profile(road, station, ride), station[:, None], ranges], axis=1),
            section=_section(road, ride),
            defects=defects,
            paint=_paint(road),
        )
        self._nodes: cKDTree | None = None

    def height_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        """Ellipsoidal height at map points (any shape, m); NaN where there is no road or verge."""
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        height = self._survey(easting_m, northing_m)[:, 0] + self.origin_enh_m[2]
        return np.asarray(height.reshape(shape))

    def intensity(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        """Intensity at map points (any shape), digital numbers of a profiler."""
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        return self._survey(easting_m, northing_m)[:, 4].reshape(shape)

    def station_offset_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Station and offset (right positive) of map points (any shape, m)."""
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        found = self._survey(easting_m, northing_m)
        return found[:, 1].reshape(shape), found[:, 2].reshape(shape)

    def place(self, station_m: npt.ArrayLike, offset_m: npt.ArrayLike) -> tuple[Float64, Float64, Float64]:
        """Easting, northing (m) and grid heading (rad) at stations and offsets (any shape)."""
        station, offset = np.broadcast_arrays(np.asarray(station_m, np.float64), np.asarray(offset_m, np.float64))
        out = np.empty((station.size, 3))
        kernels.place(self.arrays, np.ascontiguousarray(station.ravel()), np.ascontiguousarray(offset.ravel()), out)
        e, n, heading = (out[:, i].reshape(station.shape) for i in range(3))
        return e + self.origin_enh_m[0], n + self.origin_enh_m[1], heading

    def points_at(self, station_m: Float64, offset_m: Float64) -> Float64:
        """Map coordinates (n, 3) on the surface without defects at stations and offsets (n,)."""
        e, n, _ = self.place(station_m, offset_m)
        height = np.empty(station_m.size)
        kernels.heights_along(self.arrays, station_m, offset_m, height)
        return np.stack([e, n, height + self.origin_enh_m[2]], axis=-1)

    def nearest_node(self, easting_m: Float64, northing_m: Float64) -> Int64:
        """Node of the reference line nearest to map points (n,)."""
        if self._nodes is None:
            self._nodes = cKDTree(self.arrays.nodes[:, :2])
        points = np.stack([easting_m - self.origin_enh_m[0], northing_m - self.origin_enh_m[1]], axis=-1)
        found: Int64 = np.asarray(self._nodes.query(points)[1], dtype=np.int64)
        return found

    def _survey(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        e, n = np.broadcast_arrays(np.asarray(easting_m, np.float64), np.asarray(northing_m, np.float64))
        e, n = e.ravel(), n.ravel()
        out = np.empty((e.size, 5))
        kernels.survey_points(
            self.arrays, e - self.origin_enh_m[0], n - self.origin_enh_m[1], self.nearest_node(e, n), out
        )
        return out


def _table(rows: list[list[float]], columns: int) -> Float64:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _section(road: Road, ride: bool) -> Float64:
    """Cross section as :class:`RoadArrays` holds it; no ruts in the smooth surface."""
    rounding = min(0.25, road.verge_width_m / 2)
    fall = road.verge_slope - road.cross_slope
    shape = [road.cross_slope, road.crown_rounding_m, road.half_width_m, fall, rounding, road.edge_m]
    ruts = [] if ride else [[r.offset_m, 2.0 / r.width_m, r.depth_m] for r in road.ruts]
    return np.append(shape, _table(ruts, 3))


def _paint(road: Road) -> Float64:
    """Intensities and markings as :class:`RoadArrays` holds them."""
    shades = road.brightness
    rows = [[shades.asphalt, shades.marking, shades.defect, shades.verge]]
    for line in road.markings:
        broken = line.dash_m > 0.0 and line.gap_m > 0.0
        rows.append([line.offset_m, line.width_m / 2, line.dash_m, line.dash_m + line.gap_m if broken else 0.0])
    return _table(rows, 4)


def _reference_line(road: Road, station: Float64, azimuth_rad: float) -> Float64:
    """(n, 6) plan of the reference line, by Gauss–Legendre quadrature of the exact clothoids between nodes."""
    curvature = _curvature(road.alignment, station)
    rate = np.append(np.diff(curvature), 0.0) / NODE_STEP_M
    turned = np.append(0.0, np.cumsum((curvature[:-1] + curvature[1:]) / 2 * NODE_STEP_M))
    zero = int(np.flatnonzero(station == 0.0)[0])
    heading = azimuth_rad + turned - turned[zero]
    knots, weights = np.polynomial.legendre.leggauss(6)
    u = (knots + 1) / 2 * NODE_STEP_M
    inside = heading[:, None] + curvature[:, None] * u + rate[:, None] * u**2 / 2
    steps_e = np.sin(inside) @ weights * NODE_STEP_M / 2
    steps_n = np.cos(inside) @ weights * NODE_STEP_M / 2
    easting = np.append(0.0, np.cumsum(steps_e[:-1]))
    northing = np.append(0.0, np.cumsum(steps_n[:-1]))
    easting, northing = easting - easting[zero], northing - northing[zero]
    return np.stack([easting, northing, np.sin(heading), np.cos(heading), curvature, rate], axis=-1)


def _curvature(alignment: list[Element], station: Float64) -> Float64:
    """Curvature (1/m, right positive) at stations; the pieces follow one another for ever, both ways."""
    fixed = [0.0 if e.radius_m is None else 1.0 / e.radius_m for e in alignment]
    ends = np.cumsum([e.length_m for e in alignment])
    starts = ends - [e.length_m for e in alignment]
    inside = np.mod(station, ends[-1])
    piece = np.minimum(np.searchsorted(ends, inside, side="right"), len(alignment) - 1)
    share = (inside - starts[piece]) / (ends - starts)[piece]
    before = np.array([fixed[i - 1] for i in range(len(alignment))])
    after = np.array([fixed[(i + 1) % len(alignment)] for i in range(len(alignment))])
    spiral = np.array([e.kind == "spiral" for e in alignment])
    curvature: Float64 = np.where(
        spiral[piece], before[piece] + share * (after[piece] - before[piece]), np.array(fixed)[piece]
    )
    return curvature


def _profile(road: Road, station: Float64, ride: bool) -> Float64:
    """(n, 6) quintic coefficients of the reference line's height from each node to the next."""
    value, slope, bend = road.grade * station, np.full_like(station, road.grade), np.zeros_like(station)
    for wave in road.waves:
        if ride and wave.wavelength_m < RIDE_WAVELENGTH_M:
            continue
        k = 2 * math.pi / wave.wavelength_m
        phase = k * station + math.radians(wave.phase_deg)
        value = value + wave.amplitude_m * np.sin(phase)
        slope = slope + wave.amplitude_m * k * np.cos(phase)
        bend = bend - wave.amplitude_m * k * k * np.sin(phase)
    h = NODE_STEP_M
    gap = value[1:] - (value[:-1] + slope[:-1] * h + bend[:-1] * h**2 / 2)
    lean = slope[1:] - (slope[:-1] + bend[:-1] * h)
    arch = bend[1:] - bend[:-1]
    out = np.zeros((station.size, 6))
    out[:, 0], out[:, 1], out[:, 2] = value, slope, bend / 2
    out[:-1, 3] = (10 * gap / h - 4 * lean + arch * h / 2) / h**2
    out[:-1, 4] = (-15 * gap / h + 7 * lean - arch * h) / h**3
    out[:-1, 5] = (6 * gap / h - 3 * lean + arch * h / 2) / h**4
    return out


def _defects(road: Road, length_m: float) -> Float64:
    """(m, 7) potholes and pieces of cracks, see :class:`RoadArrays`."""
    rows = [[0.0, p.depth_m, 1.0 / p.radius_m, p.station_m, p.offset_m, 0.0, 0.0] for p in road.potholes]
    for crack in road.cracks:
        rows += [
            [1.0, crack.depth_m, 2.0 / crack.width_m, s0, o0, s1, o1]
            for (s0, o0), (s1, o1) in itertools.pairwise(crack.points_m)
            if (s0, o0) != (s1, o1)
        ]
    once = _table(rows, 7)
    if road.repeat_m <= 0.0 or not rows:
        return once
    shifts = road.repeat_m * np.arange(math.ceil(length_m / road.repeat_m))
    again = np.repeat(once[None], shifts.size, axis=0)
    again[:, :, 3] += shifts[:, None]
    again[:, :, 5] += np.where(once[:, 0] == 1.0, shifts[:, None], 0.0)
    return again.reshape(-1, 7)


def _by_node(defects: Float64, station: Float64) -> tuple[Float64, Float64]:
    """Defects in the order of the half metres they reach into, and for each node its first and end row (n, 2)."""
    reach = 1.0 / defects[:, 2]
    other_end = np.where(defects[:, 0] == 1.0, defects[:, 5], defects[:, 3])
    low = np.minimum(defects[:, 3], other_end) - reach
    high = np.maximum(defects[:, 3], other_end) + reach
    first = np.clip(np.floor((low - station[0]) / NODE_STEP_M).astype(np.int64), 0, station.size - 1)
    last = np.clip(np.floor((high - station[0]) / NODE_STEP_M).astype(np.int64), 0, station.size - 1)
    count = last - first + 1
    items = np.repeat(np.arange(len(defects)), count)
    nodes = np.repeat(first, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    order = np.lexsort((items, nodes))
    edges = np.searchsorted(nodes[order], np.arange(station.size + 1))
    return defects[items[order]], np.stack([edges[:-1], edges[1:]], axis=-1).astype(np.float64)
