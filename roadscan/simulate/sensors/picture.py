"""Renders what a camera sees of a scene: a ray through each pixel, sunlight and shadows, more rays at edges.

With a rolling shutter each row has its own pose. Where surfaces have a random brightness, shadows are cast for each
second pixel of each second row, and for the others and for further rays where those around them do not agree.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from roadscan.compute.array_types import Bool, Float32, Float64, Int32, Int64
from roadscan.simulate.caster import Hits, Pattern, World, ray_key
from roadscan.simulate.drive import Drive
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Camera
from roadscan.simulate.sensors.colours import SKY, Albedos, Tints
from roadscan.simulate.sensors.colours import Seen as SeenPlaces
from roadscan.simulate.sensors.lens import Lens, Sphere

FloatArray = TypeVar("FloatArray", Float32, Float64)

EYE: Final = np.eye(3)
"""Axes frd: x ahead along the optical axis, y right, z down."""
_RAYS_AT_ONCE: Final = 1 << 17  # rays cast together
_NEAREST_M: Final = 0.05  # nearer things are not met
_KEYS_A_PICTURE: Final = 1 << 32  # random keys reserved for a picture
_EVENLY_NS: Final = 2_000_000
"""Longest time (ns) within which the camera moves evenly while rows are exposed: turning at 30 degrees a second its
axes are off by 10⁻⁶ in between."""
_DIM: Final = 1e-12  # a pixel sees nothing that would be closer together

SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = 150.0, 42.0
"""Azimuth and elevation of the sun (degrees), in every scene and at any time."""
_AMBIENT: Final = 0.45
"""Share of ambient light; fully sunlit surfaces also get the rest."""
_LIT_GROUND: Final = _AMBIENT + (1.0 - _AMBIENT) * math.sin(math.radians(SUN_ELEVATION_DEG))  # light
_SHADOWS_WITHIN_M: Final = 40.0  # farther things cast no shadows
_OFF_SURFACE_M: Final = 0.02
"""Distance from the surface at which rays to the sun start (m), so that it does not stop them itself."""

_GLASS: Final = 58.0  # tone of glass
_HORIZON, _ZENITH, _LAND = 226.0, 168.0, 142.0
"""Tones of the sky, and of the land beyond the verge, which has no surface."""
_HAZE_M: Final = 300.0  # distance at which haze leaves e⁻¹ of the contrast
_LIT, _DARK, _MIXED = 0, 1, 2  # states of pixels in the sun
_EDGE: Final = 16.0
"""Difference of neighbouring pixels from which a pixel gets more rays."""
_INSIDE_PX: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # further rays
_CROSS: Final = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.bool_)  # a pixel and its four neighbours
_AROUND: Final = tuple((i, j) for i in (0, -1, 1) for j in (0, -1, 1))  # offsets of a pixel's neighbours


@dataclass(frozen=True)
class Studio:
    """A camera of the rig with what its pictures of a world need; made once for a pass."""

    world: World
    name: str
    camera: Camera
    tints: Tints | None = None
    """Colours of the world; grey values where left out."""
    albedos: Albedos | None = None
    """Random brightness of surfaces; even where left out."""

    @classmethod
    def of(cls, world: World, name: str = "camera") -> Studio:
        """Return the studio of one of the scene's cameras."""
        camera = world.scene.cameras.get(name, world.scene.camera)
        albedos = Albedos(world)
        return cls(world, name, camera, Tints(world) if camera.colour else None, albedos if albedos.on else None)


def picture(studio: Studio, drive: Drive, epoch_gps_ns: int, number: int) -> Float32:
    """Values (height, width) or (height, width, 3) of an exposure without noise: 0 … 255 and beyond, where a sensor
    saturates; of a camera with colours the last axis is red, green, blue.

    number : of the exposure in its pass, from 0; it changes which rays the gaps of trees and fences let through.
    """
    eye = _Eye(studio, drive, epoch_gps_ns, number)
    camera = studio.camera
    rows, columns = np.indices((camera.height_px, camera.width_px), dtype=np.float32)
    seen = eye.look(columns.ravel(), rows.ravel())
    shape = (camera.height_px, camera.width_px)
    plane = _planes(seen, shape)
    steps = None if studio.albedos is None else _steps(seen, shape, camera.focal_px)
    tone, plain = eye.tones(seen, plane, steps, shape)
    grey = plain.reshape(*shape, -1).mean(axis=-1)
    around: dict[str, Any] = {"size": 3} if studio.albedos is None else {"footprint": _CROSS}
    edges = np.flatnonzero((maximum_filter(grey, **around) - minimum_filter(grey, **around) > _EDGE).ravel())
    if edges.size:
        tone[edges] = _closer(eye, seen, plane, steps, edges, shape, _inside(studio, drive, number, edges.size))
    return tone.reshape(*shape, *tone.shape[1:])


@dataclass(frozen=True)
class _Seen:
    """Results of n rays."""

    ray: Float32
    """(n, 3) in the camera's axes."""
    range_m: Float32
    """(n,) NaN: nothing, or glass."""
    shade: Float32
    """(n,) intensity; NaN: nothing, or glass."""
    object_id: Int32
    """(n,) 0: the road, −1: nothing."""
    is_glass: Bool
    """(n,)"""
    row_px: Float32
    """(n,) row of the picture."""
    column_px: Float32
    """(n,) column of the picture."""
    tint: Float32 | None = None
    """(n, 3) shares of red, green, blue."""
    place_m: Float64 | None = None
    """(n, 3) from the scene's origin; None where surfaces are even."""
    body: Int32 | None = None
    """(n,) body met; likewise."""
    hits: Hits | None = None
    """Hits of some of the rays, for what moved; likewise."""

    @property
    def point_m(self) -> Float32:
        """Return (n, 3) points in the camera's axes; NaN where nothing was met."""
        return np.asarray(self.ray * self.range_m[:, None])


@dataclass(frozen=True)
class _Steps:
    """Steps (n, 3) in the map from what each pixel sees to what the next one of its row, and of its column, sees."""

    across_m: Float64
    down_m: Float64


class _Eye:
    """A camera during an exposure: all rows at one instant, or each later than the one above."""

    def __init__(self, studio: Studio, drive: Drive, epoch_gps_ns: int, number: int) -> None:
        self._studio = studio
        self._drive = drive
        self._camera: Camera = studio.camera
        around = self._camera.model == "equirectangular"
        sphere = Sphere(self._camera.width_px, self._camera.height_px)
        self._lens: Lens | Sphere = sphere if around else Lens.of(self._camera)
        self._shutter = _Shutter(self._camera, epoch_gps_ns)
        self._key = ray_key(studio.world.scene, drive, studio.name) + number * _KEYS_A_PICTURE
        at, rotation = drive.poses(np.array([epoch_gps_ns])).sensor(self._camera.mount, EYE)
        level = rotation[0].T @ drive.earth.ecef_from_level(at).as_matrix()[0]
        a, e = math.radians(SUN_AZIMUTH_DEG), math.radians(SUN_ELEVATION_DEG)
        north_east_down = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), -math.sin(e)])
        self.sun: Float64 = level @ north_east_down
        """(3,) direction to the sun, in the camera's axes."""
        self.down: Float64 = level[:, 2]
        """(3,) downwards."""
        self._states: npt.NDArray[np.int8] | None = None
        """(h, w) whether pixels and those around them are lit or dark, once the picture's rays were cast."""
        self._suns = self.sun[None, None] + np.zeros((len(self._shutter.epochs), 2, 1))
        if self._shutter.rolls:
            ends = drive.poses(self._shutter.epochs.ravel()).sensor(self._camera.mount, EYE)[1]
            self._suns = (ends.transpose(0, 2, 1) @ (rotation[0] @ self.sun)).reshape(-1, 2, 3)

    def look(self, column_px: Float32, row_px: Float32) -> _Seen:
        """Cast rays through places (n,) of the picture."""
        parts, places, bodies, hits = [], [], [], None
        origin = self._studio.world.surface.origin_enh_m
        for begin in range(0, column_px.size, _RAYS_AT_ONCE):
            part = slice(begin, begin + _RAYS_AT_ONCE)
            ray = self._lens.rays(column_px[part], row_px[part])
            hits = self._cast(ray, np.zeros_like(ray), self._camera.range_max_m, row_px[part])
            shade = hits.intensity[0]
            glass = np.isnan(shade) & np.isfinite(hits.enh_m[0, :, 0])
            tint = np.zeros((len(ray), 3)) if self._studio.tints is None else self._studio.tints.of(hits)
            parts.append((ray, hits.range_m[0], shade, hits.object_id[0], glass, tint))
            if self._studio.albedos is not None and hits.body is not None:
                places.append(hits.enh_m[0] - origin)
                bodies.append(hits.body[0])
        ray, range_m, shade, object_id, glass, tint = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        single = np.float32
        seen = _Seen(
            ray.astype(single), range_m.astype(single), shade.astype(single), object_id, glass, row_px, column_px
        )
        if self._studio.tints is not None:
            seen = replace(seen, tint=tint.astype(single))
        if places:
            seen = replace(seen, place_m=np.concatenate(places), body=np.concatenate(bodies), hits=hits)
        return seen

    def tones(
        self, seen: _Seen, plane: Float32, steps: _Steps | None, shape: tuple[int, int] | None
    ) -> tuple[Float32, Float32]:
        """Return values (n,) or (n, 3) of rays that met surfaces with normals (n, 3; NaN: unknown); with the random
        brightness of surfaces, and without.

        shape : of the picture whose pixels the rays are, where they are all of them.
        """
        up = -seen.ray @ self.down.astype(np.float32)
        sky = np.where(up >= 0.0, _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(np.maximum(up, 0.0)), _LAND)
        even = self._studio.albedos is None
        light = self._light(seen, plane, None if even else shape, None if even else seen.column_px)
        near = np.exp(-np.nan_to_num(seen.range_m) / _HAZE_M)
        plain = _lit(seen, light, near, sky)
        if steps is None:
            return plain, plain
        return _lit(seen, light * self._factors(seen, steps), near, sky), plain

    def _factors(self, seen: _Seen, steps: _Steps) -> Float32:
        """Return factors (n,) of the surfaces' random brightness."""
        albedos, hits = self._studio.albedos, seen.hits
        if albedos is None or hits is None or hits.movers is None or seen.place_m is None or seen.body is None:
            return np.ones(len(seen.shade), np.float32)
        epochs = self._shutter.epochs_of(seen.row_px)
        return albedos.factors(
            SeenPlaces(
                seen.place_m, steps.across_m, steps.down_m, seen.object_id, seen.body, seen.shade, epochs,
                hits.movers, hits.slots_from_gps_ns,
            )
        )  # fmt: skip

    def _light(self, seen: _Seen, plane: Float32, shape: tuple[int, int] | None, column_px: Float32 | None) -> Float32:
        """Return light (n,) as a share of that of level ground in the sun."""
        sun = self._sun_of(seen.row_px)
        cosine = plane @ sun.astype(np.float32) if sun.ndim == 1 else np.einsum("ij,ij->i", plane, sun)
        facing = np.nan_to_num(cosine, nan=math.sin(math.radians(SUN_ELEVATION_DEG)))
        is_sunny = (facing > 0.0) & np.isfinite(seen.range_m)
        direct = np.where(is_sunny, facing, 0.0).astype(np.float64)
        if shape is not None:
            shadow = self._thinned_shadows(seen, is_sunny, shape)
            self._states = _around_states(is_sunny, shadow, shape)
        elif self._states is None or column_px is None:
            shadow = self._shadows(seen, np.flatnonzero(is_sunny))
        else:
            last = np.array(self._states.shape) - 1
            row, column = (
                np.minimum(np.rint(a).astype(np.int64), end)
                for a, end in zip((seen.row_px, column_px), last.tolist(), strict=True)
            )
            state = self._states[row, column]
            asked = self._shadows(seen, np.flatnonzero(is_sunny & (state == _MIXED)))
            shadow = np.concatenate([asked, np.flatnonzero(is_sunny & (state == _DARK))])
        direct[shadow] = 0.0
        light: Float32 = ((_AMBIENT + (1.0 - _AMBIENT) * direct) / _LIT_GROUND).astype(np.float32)
        return light

    def _shadows(self, seen: _Seen, pixels: Int64) -> Int64:
        """Return those of some pixels from which something hides the sun."""
        found = []
        for begin in range(0, pixels.size, _RAYS_AT_ONCE):
            part = pixels[begin : begin + _RAYS_AT_ONCE]
            start = seen.ray[part] * (seen.range_m[part] - _OFF_SURFACE_M)[:, None]
            sun = np.broadcast_to(self._sun_of(seen.row_px[part]), start.shape)
            hits = self._cast(sun, start.astype(np.float64), _SHADOWS_WITHIN_M, seen.row_px[part])
            found.append(part[hits.object_id[0] >= 0])
        return np.concatenate([np.zeros(0, np.int64), *found])

    def _thinned_shadows(self, seen: _Seen, is_sunny: Bool, shape: tuple[int, int]) -> Int64:
        """Return the pixels from which something hides the sun, casting where it may change from pixel to pixel."""
        row, column = np.indices(shape)
        is_first = (row % 2 == 0) & (column % 2 == 0)
        dark = np.zeros(shape, np.int8)
        dark.ravel()[self._shadows(seen, np.flatnonzero(is_first.ravel() & is_sunny))] = 1
        state = np.where(is_sunny.reshape(shape), dark, -1) + 4 * seen.object_id.reshape(shape).astype(np.int64)
        first = state[::2, ::2]
        agree = np.ones(shape, np.bool_)
        known = first[np.minimum(row // 2, first.shape[0] - 1), np.minimum(column // 2, first.shape[1] - 1)]
        for i, j in ((0, 1), (1, 0), (1, 1)):
            beside = first[
                np.minimum((row + i * (row % 2)) // 2, first.shape[0] - 1),
                np.minimum((column + j * (column % 2)) // 2, first.shape[1] - 1),
            ]
            agree &= beside == known
        lit = 4 * seen.object_id.reshape(shape).astype(np.int64)
        agree &= (known == lit) | (known == lit + 1)
        open_ = np.flatnonzero((~agree & ~is_first).ravel() & is_sunny)
        taken = (agree & ~is_first & (known == lit + 1)).ravel() & is_sunny
        dark.ravel()[taken] = 1
        dark.ravel()[self._shadows(seen, open_)] = 1
        return np.flatnonzero(dark)

    def _sun_of(self, row_px: Float32) -> Float64:
        """Return directions (n, 3) to the sun of places in rows (n,); one (3,) where all rows are exposed at once."""
        if not self._shutter.rolls:
            return self.sun
        interval, share = self._shutter.at(row_px)
        first, last = self._suns[interval, 0], self._suns[interval, 1]
        return np.asarray(first + share[:, None] * (last - first))

    def _cast(self, ray: Float64, start_m: Float64, reach_m: float, row_px: Float32) -> Hits:
        count = len(ray)
        interval, share = self._shutter.at(row_px)
        pattern = Pattern(np.ascontiguousarray(start_m), interval, share, 0.0, (_NEAREST_M, reach_m))
        direction = np.ascontiguousarray(ray)[None]
        key, self._key = self._key, self._key + count
        epochs = self._shutter.epochs[None]
        return self._studio.world.cast(self._drive, self._camera.mount, EYE, epochs, direction, pattern, key)


class _Shutter:
    """When the rows of a picture are exposed."""

    def __init__(self, camera: Camera, epoch_gps_ns: int) -> None:
        line_ns = camera.line_time_us * 1e3
        self.rolls = line_ns > 0.0
        self._first_row = -0.5
        span = line_ns * camera.height_px
        count = max(math.ceil(span / _EVENLY_NS), 1)
        first = (self._first_row - camera.stamped_row_px) * line_ns
        borders = epoch_gps_ns + np.rint(first + span / count * np.arange(count + 1)).astype(np.int64)
        self.epochs: Int64 = np.stack([borders[:-1], borders[1:]], axis=-1)
        """(k, 2) beginning and end of the intervals within which the camera moves evenly."""
        self._rows = camera.height_px / count

    def at(self, row_px: Float32) -> tuple[Int64, Float64]:
        """Return interval and share of its length (n,) of places in rows (n,)."""
        if not self.rolls:
            return np.zeros(row_px.size, np.int64), np.zeros(row_px.size)
        past = (row_px.astype(np.float64) - self._first_row) / self._rows
        interval = np.clip(past.astype(np.int64), 0, len(self.epochs) - 1)
        return interval, past - interval

    def epochs_of(self, row_px: Float32) -> Int64:
        """Return when places in rows (n,) are exposed (ns)."""
        interval, share = self.at(row_px)
        first, last = self.epochs[interval, 0], self.epochs[interval, 1]
        return np.asarray(first + np.rint(share * (last - first)).astype(np.int64))


def _around_states(is_sunny: Bool, shadow: Int64, shape: tuple[int, int]) -> npt.NDArray[np.int8]:
    """Return whether all that faces the sun in a pixel (h, w) and those around it is lit, or is dark; else mixed."""
    dark = np.zeros(is_sunny.size, np.bool_)
    dark[shadow] = True
    is_dark = maximum_filter((is_sunny & dark).reshape(shape), 3)
    is_lit = maximum_filter((is_sunny & ~dark).reshape(shape), 3)
    return np.where(is_dark == is_lit, _MIXED, np.where(is_dark, _DARK, _LIT)).astype(np.int8)


def _lit(seen: _Seen, light: Float32, near: Float32, sky: Float64) -> Float32:
    """Return values (n,) or (n, 3) of hits in a light (n,), at a nearness (n,) of 1 … 0, before a sky (n,)."""
    if seen.tint is not None:
        return _coloured(seen, light, near, sky)
    tone = np.where(np.isnan(seen.shade), sky, seen.shade * light * near + _HORIZON * (1.0 - near))
    return np.where(seen.is_glass, _GLASS, tone).astype(np.float32)


def _coloured(seen: _Seen, light: Float32, near: Float32, sky: Float64) -> Float32:
    """Return values (n, 3) of hits in a light (n,), at a nearness (n,) of 1 … 0, before a sky (n,)."""
    tint = seen.tint if seen.tint is not None else np.ones((len(light), 3), np.float32)
    shade = np.nan_to_num(seen.shade)
    lit = (shade * light * near)[:, None] * tint + (_HORIZON * (1.0 - near))[:, None] * SKY
    out = np.where(np.isnan(seen.shade)[:, None], sky[:, None] * SKY, lit)
    return np.asarray(np.where(seen.is_glass[:, None], _GLASS, out), np.float32)


def _planes(seen: _Seen, shape: tuple[int, int]) -> Float32:
    """Return normals (n, 3) towards the camera of the surfaces in the pixels, by their neighbours; NaN for no hit."""
    point = seen.point_m.reshape(*shape, 3)
    object_id = seen.object_id.reshape(shape)
    normal = np.cross(_step(point, object_id, 1), _step(point, object_id, 0)).reshape(-1, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    away = np.einsum("ij,ij->i", normal, seen.ray) > 0.0
    normal[away] *= -1.0
    out: Float32 = normal.astype(np.float32)
    return out


def _steps(seen: _Seen, shape: tuple[int, int], focal_px: float) -> _Steps:
    """Return the steps from pixel to pixel; what has no neighbour on its object gets steps as if seen from before."""
    place = np.zeros((len(seen.ray), 3)) if seen.place_m is None else seen.place_m
    grid, object_id = place.reshape(*shape, 3), seen.object_id.reshape(shape)
    across, down = (_step(grid, object_id, axis).reshape(-1, 3) for axis in (1, 0))
    size = np.nan_to_num(seen.range_m / np.float32(focal_px), nan=_DIM)
    for step, axis in ((across, 0), (down, 2)):
        alone = np.isnan(step[:, 0])
        step[alone] = 0.0
        step[alone, axis] = size[alone]
    return _Steps(across, down)


def _step(point: FloatArray, object_id: Int32, axis: int) -> FloatArray:
    """Return the step from each pixel (h, w, 3) to its nearer neighbour along an axis with the same object."""
    ahead = np.full_like(point, np.nan)
    inner, outer = ([slice(None)] * 2 for _ in range(2))
    inner[axis], outer[axis] = slice(None, -1), slice(1, None)
    first, second = tuple(inner), tuple(outer)
    difference = point[second] - point[first]
    difference[object_id[second] != object_id[first]] = np.nan
    ahead[first] = difference
    behind = np.full_like(point, np.nan)
    behind[second] = difference
    size = np.nan_to_num(np.stack([np.linalg.norm(ahead, axis=-1), np.linalg.norm(behind, axis=-1)]), nan=np.inf)
    return np.where((size[0] <= size[1])[..., None], ahead, behind)


def _inside(studio: Studio, drive: Drive, number: int, count: int) -> Float32:
    """Return places (4, n, 2) of further rays within n pixels: fixed ones; where surfaces have a random brightness, one
    at random in each quarter, so that an edge along a row or a column is not rounded to a quarter of a pixel.
    """
    middle = np.array(_INSIDE_PX, np.float32)[:, None]
    if studio.albedos is None:
        return np.repeat(middle, count, axis=1)
    rng = stream(studio.world.scene.seed, drive.number, f"{studio.name} further rays", number)
    shift = rng.random((len(_INSIDE_PX), count, 2), dtype=np.float32) - np.float32(0.5)
    return np.asarray(middle + np.float32(0.5) * shift)


def _closer(
    eye: _Eye,
    seen: _Seen,
    plane: Float32,
    steps: _Steps | None,
    edges: Int64,
    shape: tuple[int, int],
    inside_px: Float32,
) -> Float32:
    """Return values (n,) or (n, 3) of pixels with several things in them: the mean of four rays through each."""
    row, column = (a.astype(np.float32) for a in np.unravel_index(edges, shape))
    inside = [eye.look(column + places[:, 0], row + places[:, 1]) for places in inside_px]
    at = None if steps is None else _Steps(steps.across_m[edges], steps.down_m[edges])
    tones = (eye.tones(one, _plane_beside(one, seen, plane, edges, shape), at, None)[0] for one in inside)
    mean: Float32 = functools.reduce(np.add, tones) / np.float32(len(inside))
    return mean


def _plane_beside(
    one: _Seen, seen: _Seen, plane: Float32, pixels: npt.NDArray[np.int64], shape: tuple[int, int]
) -> Float32:
    """Return normals (n, 3) at points within pixels: that of the adjacent pixel whose plane is nearest to each."""
    row, column = np.unravel_index(pixels, shape)
    best = np.full(pixels.size, np.inf, np.float32)
    out = np.full((pixels.size, 3), np.nan, np.float32)
    point = one.point_m
    for i, j in _AROUND:
        beside = np.clip(row + i, 0, shape[0] - 1) * shape[1] + np.clip(column + j, 0, shape[1] - 1)
        normal = plane[beside]
        gap = np.abs(np.einsum("ij,ij->i", normal, point - seen.ray[beside] * seen.range_m[beside, None]))
        nearer = (gap < best) & (one.object_id == seen.object_id[beside])
        best[nearer], out[nearer] = gap[nearer], normal[nearer]
    return out
