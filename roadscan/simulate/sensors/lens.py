"""A camera's lens: a pinhole with Brown–Conrady distortion, in OpenCV's parameters; and a picture of 360°."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.simulate.scene import Camera

_STEPS: Final = 30  # most steps of Newton's method
_WITHIN: Final = 1e-10  # error at which they end


@dataclass(frozen=True)
class Sphere:
    """A picture of all directions: even steps of longitude to the right and of latitude downwards."""

    width_px: int
    height_px: int

    def rays(self, column_px: npt.ArrayLike, row_px: npt.ArrayLike) -> Float64:
        """Return unit vectors (n, 3: ahead, right, down) of places (n,) in the picture; its middle looks ahead."""
        turn = 2.0 * np.pi * ((np.asarray(column_px, np.float64) + 0.5) / self.width_px - 0.5)
        dip = np.pi * ((np.asarray(row_px, np.float64) + 0.5) / self.height_px - 0.5)
        return np.stack([np.cos(dip) * np.cos(turn), np.cos(dip) * np.sin(turn), np.sin(dip)], axis=-1)


@dataclass(frozen=True)
class Lens:
    """Interior orientation: pixel = focal · distorted (x, y) + principal, with (x, y) = (right, down) / ahead."""

    focal_px: float
    principal_px: tuple[float, float]
    """From the centre of the upper left pixel."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3."""

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Return the lens of a scene's camera; its principal point is the picture's middle unless stated."""
        middle = ((camera.width_px - 1) / 2, (camera.height_px - 1) / 2)
        return cls(camera.focal_px, camera.principal_px or middle, camera.distortion)

    def rays(self, column_px: npt.ArrayLike, row_px: npt.ArrayLike) -> Float64:
        """Return unit vectors (n, 3: ahead along the optical axis, right, down) of places (n,) in the picture.

        Raises
        ------
        ConfigError
            where a place has no ray: the distortion folds the picture over before it.
        """
        u = (np.asarray(column_px, np.float64) - self.principal_px[0]) / self.focal_px
        v = (np.asarray(row_px, np.float64) - self.principal_px[1]) / self.focal_px
        x, y = self._straightened(u, v)
        ray = np.stack([np.ones_like(x), x, y], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def _straightened(self, u: Float64, v: Float64) -> tuple[Float64, Float64]:
        """Return undistorted coordinates by Newton's method from the picture's middle outwards."""
        x, y = u.copy(), v.copy()
        for _ in range(_STEPS):
            bent_x, bent_y, xx, xy, yy = self._bent(x, y)
            wrong_x, wrong_y = bent_x - u, bent_y - v
            if max(np.abs(wrong_x).max(initial=0.0), np.abs(wrong_y).max(initial=0.0)) < _WITHIN:
                if (xx * yy - xy * xy > 0.0).all() and (xx + yy > 0.0).all():
                    return x, y
                break
            area = xx * yy - xy * xy
            x, y = x - (yy * wrong_x - xy * wrong_y) / area, y - (xx * wrong_y - xy * wrong_x) / area
        raise ConfigError(
            f"camera.distortion {list(self.distortion)} folds the picture over inside its borders",
            expected="a distortion whose image radius grows up to the picture's corners",
            change="reduce the coefficients, or the picture's size",
        )

    def _bent(self, x: Float64, y: Float64) -> tuple[Float64, Float64, Float64, Float64, Float64]:
        """Return distorted coordinates (Brown 1971; OpenCV's signs), and derivatives: xx, xy = yx, yy."""
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
