"""A section of road as a lidar sees it, with patches whose outlines are known; nothing of it comes from roadscan."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely.affinity import affine_transform

ORIGIN = (512_345.6, 5_401_234.5)
DENSE, THIN = 880.66, 142.18
"""Points to a square metre that the paper states for the sides of its sections."""


@dataclass
class Section:
    """30 m wide, 10 m long; x along the road from 0 to 10, y to the left from -15 to 15."""

    heading_rad: float = np.radians(127.0)
    patches: list[shapely.Polygon] = field(default_factory=list)
    """On the section."""
    markings: bool = True
    cars: list[tuple[float, float, float]] = field(default_factory=list)
    """x and y of the rear right corner, intensity of the paint."""
    dense: float = DENSE
    thin: float = THIN
    patch_intensity: float = 60.0
    patch_depth_m: float = 0.008
    patch_sigma_m: float = 0.004
    sensor_y_m: float | None = None
    """Where the sensor drove, 2.2 m above the road, for intensities that fall with range and incidence."""
    seed: int = 1

    def points(self) -> tuple[np.ndarray, ...]:
        """Easting, northing, height, intensity, and places on the section (n, 2)."""
        rng = np.random.default_rng(self.seed)
        parts = []
        for low, high, density in ((-15.0, 0.0, self.thin), (0.0, 15.0, self.dense)):
            many = rng.poisson(density * 150.0)
            parts.append(np.column_stack([rng.uniform(0, 10, many), rng.uniform(low, high, many)]))
        xy = np.concatenate(parts)
        x, y = xy.T
        height = 31.0 + 0.06 * x - 0.025 * np.abs(y) + rng.normal(0, 0.002, x.size)
        grain = 1 + 0.05 * np.sin(2.1 * x + 1.3 * y) * np.sin(1.7 * y - 0.6 * x)
        grey = 100.0 * grain
        if self.markings:
            paint = ((np.abs(y - 3.5) < 0.06) | (np.abs(y + 3.5) < 0.06)) & (rng.uniform(size=x.size) < 0.6)
            paint |= (np.abs(y) < 0.08) & (np.mod(x, 4.0) < 2.0)
            grey = np.where(paint, 190.0, grey)
        for patch in self.patches:
            inside = shapely.contains_xy(patch, x, y)
            grey = np.where(inside, self.patch_intensity * grain, grey)
            height = height - inside * (self.patch_depth_m + rng.normal(0, self.patch_sigma_m, x.size))
        grey = grey + rng.normal(0, 9.0, x.size)
        if self.sensor_y_m is not None:
            grey = 100.0 * grey * self.falloff(y)
        xyz = np.column_stack([x, y, height])
        for car in self.cars:
            xyz, grey = self._park(car, xyz, grey, rng)
        grey = np.clip(np.rint(grey), 0, 65535)
        e, n = self.on_map(xyz[:, 0], xyz[:, 1])
        return e, n, xyz[:, 2], grey, xyz[:, :2]

    def falloff(self, y: np.ndarray) -> np.ndarray:
        """What range and incidence leave of an intensity at 5 m and a right angle."""
        reach = np.hypot(y - self.sensor_y_m, 2.2)
        return (5.0 / reach) ** 2 * (2.2 / reach)

    def _park(self, car, xyz, grey, rng):
        """A car: no road below it nor in its shadow to the right; a roof, a bonnet, and its left side."""
        x0, y0, paint = car
        x, y = xyz[:, 0], xyz[:, 1]
        below = (x > x0) & (x < x0 + 4.5) & (y > y0) & (y < y0 + 1.8)
        shadow = (x > x0) & (x < x0 + 4.5) & (y > y0 - 1.0) & (y <= y0)
        road = 31.0 + 0.06 * x - 0.025 * np.abs(y)
        body = np.where(np.abs(x - x0 - 2.6) < 1.4, 1.45, 0.95) + rng.normal(0, 0.01, x.size)
        xyz[below, 2] = (road + body)[below]
        grey = np.where(below, paint + rng.normal(0, 4.0, x.size), grey)
        many = 2500
        side = np.column_stack([rng.uniform(x0, x0 + 4.5, many), np.full(many, y0 + 1.8) + rng.normal(0, 0.01, many)])
        up = rng.uniform(0.15, 0.95, many)
        level = 31.0 + 0.06 * side[:, 0] - 0.025 * np.abs(side[:, 1])
        xyz = np.concatenate([xyz[~shadow], np.column_stack([side, level + up])])
        return xyz, np.concatenate([grey[~shadow], paint + rng.normal(0, 4.0, many)])

    def on_map(self, x, y):
        """Easting and northing: the heading is clockwise from north."""
        sin, cos = np.sin(self.heading_rad), np.cos(self.heading_rad)
        return ORIGIN[0] + x * sin - y * cos, ORIGIN[1] + x * cos + y * sin

    def patch_on_map(self, patch: shapely.Polygon) -> shapely.Polygon:
        """The outline of a patch."""
        sin, cos = np.sin(self.heading_rad), np.cos(self.heading_rad)
        return affine_transform(patch, [sin, -cos, cos, sin, *ORIGIN])


TRENCH = shapely.box(4.0, 2.0, 4.7, 12.0)
"""A utility cut across the dense side."""
SQUARE = shapely.box(7.5, 6.0, 8.0, 6.5)
"""A quarter of a square metre on the dense side."""
PATCH = shapely.box(1.0, 9.0, 2.4, 10.2)
SLANTED = shapely.affinity.rotate(shapely.box(7.0, 9.5, 8.5, 10.1), 30)
FAR_SQUARE = shapely.box(6.0, -7.5, 6.5, -7.0)
"""The same on the thin side."""
FAR_PATCH = shapely.box(2.0, -11.0, 4.0, -9.5)
ALL = [TRENCH, SQUARE, PATCH, SLANTED, FAR_SQUARE, FAR_PATCH]
