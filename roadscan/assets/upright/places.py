"""Index of the returns of a scene by their place, seen from above."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.assets import classes
from roadscan.assets.kernels.buckets import count_buckets, fill_buckets
from roadscan.assets.memory import once_a_scene
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.slices import usable
from roadscan.compute.array_types import Float64, Int64

_CELL_M: Final = 1.0  # Edge of a cell (m).


@dataclass(frozen=True, eq=False)
class Places:
    """Returns that may belong to something upright, sorted by cells of a metre."""

    window: Box
    returns: Returns
    """Those of the scene, which is not referenced: the cache would keep it in memory."""
    rows: Int64
    x_m: Float64
    """Places of these rows."""
    y_m: Float64
    starts: Int64
    shape: tuple[int, int]

    def within(self, x_m: float, y_m: float, reach_m: float) -> Int64:
        """Returns the returns within reach of a place, seen from above, in order of their number."""
        window = self.window
        u, v = (x_m - window.x_min_m) / _CELL_M, (y_m - window.y_min_m) / _CELL_M
        reach = reach_m / _CELL_M
        first, last = max(int(u - reach), 0), min(int(u + reach), self.shape[1] - 1)
        parts = [np.zeros(0, np.int64)]
        for row in range(max(int(v - reach), 0), min(int(v + reach), self.shape[0] - 1) + 1):
            if last >= first:
                begin = row * self.shape[1]
                some = slice(self.starts[begin + first], self.starts[begin + last + 1])
                near = (self.x_m[some] - x_m) ** 2 + (self.y_m[some] - y_m) ** 2 <= reach_m**2
                parts.append(self.rows[some][near])
        return np.sort(np.concatenate(parts))


@once_a_scene
def places_of(scene: Scene) -> Places:
    """Returns the index of a scene's returns without ground, vehicles, people and noise."""
    window, returns = scene.window, scene.returns
    rows = int(np.ceil((window.y_max_m - window.y_min_m) / _CELL_M - 1e-9))
    columns = int(np.ceil((window.x_max_m - window.x_min_m) / _CELL_M - 1e-9))
    corner = np.array([window.x_min_m, window.y_min_m])
    counted = usable(scene)
    starts = np.zeros(rows * columns + 1, np.int64)
    count_buckets(returns.x_m, returns.y_m, counted, corner, _CELL_M, (rows, columns), starts)
    order = np.empty(int(starts[-1]), np.int64)
    fill_buckets(returns.x_m, returns.y_m, counted, corner, _CELL_M, (rows, columns), starts.copy(), order)
    return Places(window, returns, order, returns.x_m[order], returns.y_m[order], starts, (rows, columns))


@once_a_scene
def ground_light(scene: Scene) -> float:
    """Returns the median intensity of the ground of the survey; infinite where there is none."""
    light = scene.statistics.known("ground_light")
    if light is not None:
        return light
    ground = (scene.classes == classes.GROUND) | (scene.classes == classes.ROAD)
    return float(np.median(scene.returns.intensity[ground])) if ground.any() else float("inf")
