"""Renders what a camera sees of a scene: a ray through each pixel, sunlight and shadows, more rays at edges."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from roadscan.simulate.caster import Hits, Pattern, World, ray_key
from roadscan.simulate.drive import Drive
from roadscan.simulate.scene import Camera
from roadscan.simulate.sensors.colours import SKY, Tints
from roadscan.simulate.sensors.lens import Lens, Sphere

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

EYE: Final = np.eye(3)
"""Axes frd: x ahead along the optical axis, y right, z down."""
_RAYS_AT_ONCE: Final = 1 << 17  # rays cast together
_NEAREST_M: Final = 0.05  # nearer things are not met
_KEYS_A_PICTURE: Final = 1 << 32  # random keys reserved for a picture

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
_EDGE: Final = 16.0
"""Difference of neighbouring pixels from which a pixel gets more rays."""
_INSIDE_PX: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # further rays
_AROUND: Final = tuple((i, j) for i in (0, -1, 1) for j in (0, -1, 1))  # offsets of a pixel's neighbours


def picture(world: World, drive: Drive, epoch_gps_ns: int, number: int, tints: Tints | None = None) -> Float32:
    """Values (height, width) or (height, width, 3) of an exposure without noise: 0 … 255 and beyond, where a sensor
    saturates.

    number : of the exposure in its pass, from 0; it changes which rays the gaps of trees and fences let through.
    tints : colours of the world; grey values where left out. With them the last axis is red, green, blue.
    """
    eye = _Eye(world, drive, epoch_gps_ns, number, tints)
    camera = world.scene.camera
    rows, columns = np.indices((camera.height_px, camera.width_px), dtype=np.float32)
    seen = eye.look(columns.ravel(), rows.ravel())
    shape = (camera.height_px, camera.width_px)
    plane = _planes(seen, shape)
    tone = eye.tones(seen, plane)
    grey = tone.reshape(*shape, -1).mean(axis=-1)
    edges = np.flatnonzero((maximum_filter(grey, 3) - minimum_filter(grey, 3) > _EDGE).ravel())
    if edges.size:
        tone[edges] = _closer(eye, seen, plane, edges, shape)
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
    is_glass: Flags
    """(n,)"""
    tint: Float32 | None = None
    """(n, 3) shares of red, green, blue."""

    @property
    def point_m(self) -> Float32:
        """Return (n, 3) points in the camera's axes; NaN where nothing was met."""
        return np.asarray(self.ray * self.range_m[:, None])


class _Eye:
    """A camera at the instant of an exposure, which takes no time."""

    def __init__(self, world: World, drive: Drive, epoch_gps_ns: int, number: int, tints: Tints | None) -> None:
        self._world = world
        self._tints = tints
        self._drive = drive
        self._camera: Camera = world.scene.camera
        around = self._camera.model == "equirectangular"
        sphere = Sphere(self._camera.width_px, self._camera.height_px)
        self._lens: Lens | Sphere = sphere if around else Lens.of(self._camera)
        self._epoch = np.full((1, 1, 2), epoch_gps_ns, np.int64)
        self._key = ray_key(world.scene, drive, "camera") + number * _KEYS_A_PICTURE
        at, rotation = drive.poses(np.array([epoch_gps_ns])).sensor(self._camera.mount, EYE)
        level = rotation[0].T @ drive.earth.ecef_from_level(at).as_matrix()[0]
        a, e = math.radians(SUN_AZIMUTH_DEG), math.radians(SUN_ELEVATION_DEG)
        north_east_down = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), -math.sin(e)])
        self.sun: Float64 = level @ north_east_down
        """(3,) direction to the sun, in the camera's axes."""
        self.down: Float64 = level[:, 2]
        """(3,) downwards."""

    def look(self, column_px: Float32, row_px: Float32) -> _Seen:
        """Cast rays through places (n,) of the picture."""
        parts = []
        for begin in range(0, column_px.size, _RAYS_AT_ONCE):
            part = slice(begin, begin + _RAYS_AT_ONCE)
            ray = self._lens.rays(column_px[part], row_px[part])
            hits = self._cast(ray, np.zeros_like(ray), self._camera.range_max_m)
            shade = hits.intensity[0]
            glass = np.isnan(shade) & np.isfinite(hits.enh_m[0, :, 0])
            tint = np.zeros((len(ray), 3)) if self._tints is None else self._tints.of(hits)
            parts.append((ray, hits.range_m[0], shade, hits.object_id[0], glass, tint))
        ray, range_m, shade, object_id, glass, tint = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        single = np.float32
        shares = None if self._tints is None else tint.astype(single)
        return _Seen(ray.astype(single), range_m.astype(single), shade.astype(single), object_id, glass, shares)

    def tones(self, seen: _Seen, plane: Float32) -> Float32:
        """Return values (n,) or (n, 3) of rays that met surfaces with normals (n, 3; NaN: unknown)."""
        up = -seen.ray @ self.down.astype(np.float32)
        sky = np.where(up >= 0.0, _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(np.maximum(up, 0.0)), _LAND)
        light = self._light(seen, plane)
        near = np.exp(-np.nan_to_num(seen.range_m) / _HAZE_M)
        if seen.tint is not None:
            return _coloured(seen, light, near, sky)
        tone = np.where(np.isnan(seen.shade), sky, seen.shade * light * near + _HORIZON * (1.0 - near))
        out: Float32 = np.where(seen.is_glass, _GLASS, tone).astype(np.float32)
        return out

    def _light(self, seen: _Seen, plane: Float32) -> Float32:
        """Return light (n,) as a share of that of level ground in the sun."""
        facing = np.nan_to_num(plane @ self.sun.astype(np.float32), nan=math.sin(math.radians(SUN_ELEVATION_DEG)))
        sunny = np.flatnonzero((facing > 0.0) & np.isfinite(seen.range_m))
        direct = np.zeros(facing.size)
        direct[sunny] = facing[sunny]
        for begin in range(0, sunny.size, _RAYS_AT_ONCE):
            part = sunny[begin : begin + _RAYS_AT_ONCE]
            start = seen.ray[part] * (seen.range_m[part] - _OFF_SURFACE_M)[:, None]
            hits = self._cast(np.broadcast_to(self.sun, start.shape), start.astype(np.float64), _SHADOWS_WITHIN_M)
            direct[part[hits.object_id[0] >= 0]] = 0.0
        light: Float32 = ((_AMBIENT + (1.0 - _AMBIENT) * direct) / _LIT_GROUND).astype(np.float32)
        return light

    def _cast(self, ray: Float64, start_m: Float64, reach_m: float) -> Hits:
        count = len(ray)
        pattern = Pattern(
            np.ascontiguousarray(start_m), np.zeros(count, np.int64), np.zeros(count), 0.0, (_NEAREST_M, reach_m)
        )
        direction = np.ascontiguousarray(ray)[None]
        key, self._key = self._key, self._key + count
        return self._world.cast(self._drive, self._camera.mount, EYE, self._epoch, direction, pattern, key)


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


def _step(point: Float32, object_id: Int32, axis: int) -> Float32:
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


def _closer(eye: _Eye, seen: _Seen, plane: Float32, edges: npt.NDArray[np.int64], shape: tuple[int, int]) -> Float32:
    """Return values (n,) or (n, 3) of pixels with several things in them: the mean of four rays through each."""
    row, column = (a.astype(np.float32) for a in np.unravel_index(edges, shape))
    inside = [eye.look(column + x, row + y) for x, y in _INSIDE_PX]
    tones = (eye.tones(one, _plane_beside(one, seen, plane, edges, shape)) for one in inside)
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
