"""The road's surface from its description: one function, used by the sensors and by the truth.

Macrotexture of a pavement as a periodic height field with a given mean profile depth.

Random stones: a band of wavelengths around the grain size, its peaks worn flat by traffic. The mean profile depth is
that of ISO 13473-1:2019 on profiles along the field.
"""

from __future__ import annotations

import functools
import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.simulate import features, noise
from roadscan.simulate.kernels import road as kernels
from roadscan.simulate.kernels.road import NODE_STEP_M, RoadArrays
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Scene
from roadscan.simulate.scene.road import CrossSlope, Element, Kerb, Road

RIDE_WAVELENGTH_M = 10.0
"""Wavelength below which waves do not move the vehicle, because its tyres and springs absorb them (m)."""


class Surface:
    """Height and intensity of the road, defined everywhere on it.

    The reference line has a curvature that is linear between nodes each 0.5 m. Its height is the sum of grades and
    waves, stored as quintic polynomials that agree with it in value, slope and curvature at the nodes (within
    1 µm for waves of 2 m). On it lie cross-section, humps, ruts, unevenness, patches, and potholes, cracks or joints,
    all functions of station and offset; and the texture, which only the profilers see.

    Parameters
    ----------
    scene : the scene.
    ride : True for the smooth surface that guides the vehicle: long waves, humps and cross-section only.
    """

    def __init__(self, scene: Scene, *, ride: bool = False) -> None:
        road = scene.road
        self.origin_enh_m = np.array([scene.map.easting_m, scene.map.northing_m, scene.map.height_m])
        """Map coordinates of the origin of `arrays`."""
        before = math.ceil(road.lead_m / NODE_STEP_M)
        after = math.ceil((scene.length_m + road.lead_m) / NODE_STEP_M)
        station: Float64 = NODE_STEP_M * np.arange(-before, after + 1, dtype=np.float64)
        worn = features.of_road(road, scene.seed, float(station[0]), float(station[-1]), scene.length_m, smooth=ride)
        defects, defect_ranges = features.by_node(worn.defects, worn.defect_reach_m, station)
        patches, patch_ranges = features.by_node(worn.patches, worn.patch_reach_m, station)
        items, item_ranges = features.by_node(worn.items, worn.item_reach_m, station)
        humps, hump_ranges = features.by_node(*features.humps(road), station)
        line = _reference_line(road, station, math.radians(scene.map.azimuth_deg))
        height = _profile(road, station, ride)
        columns = [line, height, station[:, None], defect_ranges, patch_ranges, item_ranges]
        columns += [_sides(road, station), hump_ranges]
        tracks, first_m = _tracks(scene, station, ride)
        textured = road.texture is not None and not ride
        self.arrays = RoadArrays(
            nodes=np.ascontiguousarray(np.concatenate(columns, axis=1)),
            section=_section(road, tracks, first_m, textured, scene.seed, ride),
            defects=defects,
            patches=patches,
            lines=features.lines(road),
            humps=humps,
            items=items,
            tracks=tracks,
            texture=_texture(road, scene.seed) if textured else np.zeros((0, 0), np.float32),
        )
        self._nodes: cKDTree | None = None

    def height_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike, *, texture: bool = True) -> Float64:
        """Return the ellipsoidal height at map points (any shape, m); NaN where there is no road or verge.

        texture : False leaves the macrotexture out, as wide beams do.
        """
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        found = self._survey(easting_m, northing_m)
        height = found[:, 0] + self.origin_enh_m[2]
        if texture:
            height = height + found[:, 5]
        return np.asarray(height.reshape(shape))

    def intensity(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        """Return the intensity at map points (any shape), digital numbers of a profiler."""
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        return self._survey(easting_m, northing_m)[:, 4].reshape(shape)

    def station_offset_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Return station and offset (right positive) of map points (any shape, m)."""
        shape = np.broadcast_shapes(np.shape(easting_m), np.shape(northing_m))
        found = self._survey(easting_m, northing_m)
        return found[:, 1].reshape(shape), found[:, 2].reshape(shape)

    def place(self, station_m: npt.ArrayLike, offset_m: npt.ArrayLike) -> tuple[Float64, Float64, Float64]:
        """Return easting, northing (m) and grid heading (rad) at stations and offsets (any shape)."""
        station, offset = np.broadcast_arrays(np.asarray(station_m, np.float64), np.asarray(offset_m, np.float64))
        out = np.empty((station.size, 3))
        kernels.place(self.arrays, np.ascontiguousarray(station.ravel()), np.ascontiguousarray(offset.ravel()), out)
        e, n, heading = (out[:, i].reshape(station.shape) for i in range(3))
        return e + self.origin_enh_m[0], n + self.origin_enh_m[1], heading

    def points_at(self, station_m: Float64, offset_m: Float64) -> Float64:
        """Return map points (n, 3) on the surface without defects and texture, at stations and offsets (n,)."""
        e, n, _ = self.place(station_m, offset_m)
        height = np.empty(station_m.size)
        kernels.heights_along(self.arrays, station_m, offset_m, height)
        return np.stack([e, n, height + self.origin_enh_m[2]], axis=-1)

    def nearest_node(self, easting_m: Float64, northing_m: Float64) -> Int64:
        """Return the node of the reference line nearest to each map point (n,)."""
        if self._nodes is None:
            self._nodes = cKDTree(self.arrays.nodes[:, :2])
        points = np.stack([easting_m - self.origin_enh_m[0], northing_m - self.origin_enh_m[1]], axis=-1)
        found: Int64 = np.asarray(self._nodes.query(points)[1], dtype=np.int64)
        return found

    def _survey(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        e, n = np.broadcast_arrays(np.asarray(easting_m, np.float64), np.asarray(northing_m, np.float64))
        e, n = e.ravel(), n.ravel()
        out = np.empty((e.size, 6))
        kernels.survey_points(
            self.arrays, e - self.origin_enh_m[0], n - self.origin_enh_m[1], self.nearest_node(e, n), out
        )
        return out


def _section(road: Road, tracks: Float64, first_m: float, textured: bool, seed: int, ride: bool) -> Float64:
    """Return constants and ruts as in :class:`RoadArrays`; no ruts in the smooth surface."""
    shades = road.brightness
    shoulder = road.shoulder_width_m / 2 if road.shoulder_width_m > 0.0 else 0.25
    offsets = noise.track_offsets_m(road)
    contrast = 0.0
    if textured and road.texture is not None:
        contrast = road.texture.contrast / float(_texture(road, seed).std())
    constants = np.zeros(kernels.RUTS)
    constants[kernels.CROWN] = road.crown_rounding_m
    constants[kernels.LANES_EDGE] = road.half_width_m
    constants[kernels.SHOULDER_SLOPE] = road.shoulder_slope
    constants[kernels.PAVED_EDGE] = road.paved_m
    constants[kernels.VERGE_SLOPE] = road.verge_slope
    constants[kernels.ROUNDING] = min(0.25, road.verge_width_m / 2, shoulder)
    constants[kernels.SURFACE_EDGE] = road.edge_m
    constants[kernels.KERB_FACE] = road.kerbs[0].face_m if road.kerbs else 0.02
    constants[kernels.TRACK_FIRST] = offsets[0]
    constants[kernels.TRACK_PER_M] = 1.0 / float(offsets[1] - offsets[0])
    constants[kernels.TRACK_STATION] = first_m
    constants[kernels.TRACK_STATION_PER_M] = 1.0 / noise.STEP_M
    constants[kernels.TEXTURE_PER_M] = 1.0 / CELL_M
    constants[kernels.CONTRAST] = contrast
    constants[kernels.ASPHALT : kernels.KERB + 1] = [
        shades.asphalt, shades.marking, shades.defect, shades.shoulder, shades.verge, shades.kerb,
    ]  # fmt: skip
    if road.grass is not None:
        grass = [road.grass.height_m, road.grass.from_m, road.grass.shade]
        constants[kernels.GRASS : kernels.GRASS_SHADE + 1] = grass
    else:
        constants[kernels.GRASS_FROM], constants[kernels.GRASS_SHADE] = np.inf, shades.verge
    phases = stream(seed, 0, "ruts").uniform(0, 2 * math.pi, len(road.ruts))
    ruts = [
        [r.offset_m, 2.0 / r.width_m, r.depth_m, r.variation, 2 * math.pi / r.variation_m, phase]
        for r, phase in zip(road.ruts, phases, strict=True)
    ]
    return np.append(constants, [] if ride else np.array(ruts, dtype=np.float64).ravel())


def _texture(road: Road, seed: int) -> npt.NDArray[np.float32]:
    settings = road.texture
    return np.zeros((0, 0), np.float32) if settings is None else texture_field(settings.mpd_mm, settings.grain_mm, seed)


def _tracks(scene: Scene, station: Float64, ride: bool) -> tuple[Float64, float]:
    """Return unevenness (t, s), and the station of its first sample; only its long waves in the smooth surface."""
    step = noise.STEP_M
    first = float(station[0]) - 3 * step
    fine: Float64 = first + step * np.arange(math.ceil((float(station[-1]) - first) / step) + 4, dtype=np.float64)
    waves = np.zeros(fine.size)
    for wave in scene.road.waves:
        waves += wave.amplitude_m * np.sin(2 * math.pi / wave.wavelength_m * fine + math.radians(wave.phase_deg))
    found = noise.tracks(scene.road, fine, waves, stream(scene.seed, 0, "roughness"))
    if ride and found.size:
        # Half of the amplitude of waves of RIDE_WAVELENGTH_M remains.
        sigma_m = RIDE_WAVELENGTH_M * math.sqrt(math.log(2.0) / 2.0) / math.pi
        found = gaussian_filter1d(found, sigma_m / step, axis=1, mode="nearest")
        found = np.repeat(found.mean(axis=0, keepdims=True), found.shape[0], axis=0)
    return np.ascontiguousarray(found), first


def _reference_line(road: Road, station: Float64, azimuth_rad: float) -> Float64:
    """Return (n, 6) plan of the reference line, by Gauss–Legendre quadrature of the exact clothoids between nodes."""
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
    """Return curvature (1/m, right positive) at stations; the pieces repeat without end in both directions."""
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


def _sides(road: Road, station: Float64) -> Float64:
    """Return (n, 8) falls and kerb heights at the nodes, each with its change per metre up to the next node."""
    slopes = road.cross_slopes or [CrossSlope(station_m=0.0, left=road.cross_slope, right=road.cross_slope)]
    at = [s.station_m for s in slopes]
    kerbs = {kerb.side: kerb for kerb in road.kerbs}
    values = [
        np.interp(station, at, [s.left for s in slopes]),
        np.interp(station, at, [s.right for s in slopes]),
        _kerb_height(kerbs.get("left"), station),
        _kerb_height(kerbs.get("right"), station),
    ]
    return np.stack([a for v in values for a in (v, np.append(np.diff(v), 0.0) / NODE_STEP_M)], axis=-1)


def _kerb_height(kerb: Kerb | None, station: Float64) -> Float64:
    if kerb is None:
        return np.zeros(station.size)
    height = np.full(station.size, kerb.height_m)
    for ramp in kerb.ramps:
        # From node to node, so that no straight line between nodes cuts into the low part.
        low = math.floor((ramp.station_m - ramp.length_m / 2) / NODE_STEP_M + 1e-6) * NODE_STEP_M
        high = math.ceil((ramp.station_m + ramp.length_m / 2) / NODE_STEP_M - 1e-6) * NODE_STEP_M
        beyond = np.maximum(low - station, station - high) / ramp.transition_m
        height = np.minimum(height, ramp.height_m + (kerb.height_m - ramp.height_m) * np.clip(beyond, 0.0, 1.0))
    return height


def _profile(road: Road, station: Float64, ride: bool) -> Float64:
    """Return (n, 6) quintic coefficients of the reference line's height from each node to the next."""
    value, slope, bend = road.grade * station, np.full_like(station, road.grade), np.zeros_like(station)
    grade = road.grade
    for change in road.grades:
        x = np.clip(station - change.station_m + change.curve_m / 2, 0.0, change.curve_m)
        beyond = np.maximum(station - change.station_m - change.curve_m / 2, 0.0)
        step = change.grade - grade
        value = value + step * (x * x / (2 * change.curve_m) + beyond)
        slope = slope + step * x / change.curve_m
        bend = bend + step / change.curve_m * ((x > 0) & (beyond == 0.0))
        grade = change.grade
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


CELLS: Final = 1024
"""Cells along an edge of the field, a power of two."""
CELL_M: Final = 0.001  # edge of a cell
_BAND: Final = 0.55
"""Width of the band, as standard deviation of ln(wavelength)."""
_WORN_SIGMA: Final = 0.5
"""Height of peaks, in standard deviations, above which they are worn down …"""
_WORN_SHARE: Final = 0.25
"""… to this share of their excess."""
_FINE_PER_CELL: Final = 2  # samples in a step of the profile
_BASE_MM: Final = 100.0  # segment of the mean profile depth (ISO 13473-1)
_LOW_PASS_MM: Final = 2.4  # cut-off wavelength of the low-pass (ISO 13473-1)


@functools.lru_cache(maxsize=4)
def texture_field(mpd_mm: float, grain_mm: float, seed: int) -> Float32:
    """Return heights (c, c) in metres over station and offset, periodic, mean 0, with the given mean profile depth."""
    rng = stream(seed, 0, "texture")
    frequency = np.fft.fftfreq(CELLS, CELL_M * 1e3)
    f = np.hypot(frequency[:, None], np.fft.rfftfreq(CELLS, CELL_M * 1e3)[None])
    f[0, 0] = 1e-9
    # A band in wavelength, as an area density: amplitude² · f² is a bell in ln f.
    amplitude = np.exp(-((np.log(f * grain_mm) / _BAND) ** 2) / 4) / f
    amplitude[0, 0] = 0.0
    raw = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((CELLS, CELLS))) * amplitude, s=(CELLS, CELLS))
    raw /= raw.std()
    worn = np.minimum(raw, _WORN_SIGMA) + _WORN_SHARE * np.maximum(raw - _WORN_SIGMA, 0.0)
    worn -= worn.mean()
    depth = float(np.mean([mean_profile_depth_mm(line, 1.0) for line in worn[:: CELLS // 64]]))
    field: Float32 = (worn * (mpd_mm / depth) * 1e-3).astype(np.float32)
    return field


def mean_profile_depth_mm(height_mm: Float64, step_mm: float) -> float:
    """Return the mean profile depth (mm), ISO 13473-1:2019: 100 mm segments, slope removed, mean of both peaks.

    height_mm : (s,) heights at even steps of `step_mm`. The low-pass of 2.4 mm is a Gaussian here.
    """
    fine = np.interp(
        np.arange(0.0, (height_mm.size - 1) * step_mm, step_mm / _FINE_PER_CELL),
        step_mm * np.arange(height_mm.size),
        height_mm,
    )
    sigma_mm = _LOW_PASS_MM * np.sqrt(np.log(2.0) / 2.0) / np.pi
    smooth = gaussian_filter1d(fine, sigma_mm / (step_mm / _FINE_PER_CELL))
    size = round(_BASE_MM / (step_mm / _FINE_PER_CELL))
    segments = smooth[: smooth.size // size * size].reshape(-1, size)
    x = np.linspace(-1.0, 1.0, size)
    slopes = (segments @ x) / (x @ x)
    level = segments - segments.mean(axis=1, keepdims=True) - slopes[:, None] * x
    halves = level.reshape(-1, 2, size // 2).max(axis=2)
    return float(halves.mean())
