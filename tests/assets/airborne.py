"""Points from the air as returns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import Returns


def airborne(points: npt.NDArray[np.float64]) -> Returns:
    """Points (n, 3) as returns of a sensor that stood nowhere known."""
    n = len(points)
    none, ones = np.full(n, np.nan), np.ones(n, np.uint8)
    x, y, z = (np.ascontiguousarray(c) for c in points.T)
    light, epoch, laser = np.zeros(n, np.float32), np.zeros(n, np.int64), np.zeros(n, np.uint16)
    return Returns((0.0, 0.0), x, y, z, light, epoch, laser, ones, laser, ones, ones, none, none, none)
