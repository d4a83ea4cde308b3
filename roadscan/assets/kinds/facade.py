"""Façades: solid upright surfaces that rise to 3 m, or above what scanners saw."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely

from roadscan.assets import classes
from roadscan.assets.kind import AssetObject
from roadscan.assets.scene import Scene
from roadscan.assets.upright.facades import beside, outline
from roadscan.assets.upright.lines import Chain
from roadscan.assets.upright.surfaces import SurfaceKind, as_object


class Facade(SurfaceKind):
    """Façades, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`), with their outline."""

    name = "facade"
    title = "Façade"
    curve = "surfaces"
    code = classes.BUILDING

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns on the surface, in its recesses and on its balconies."""
        return beside(scene, rows)

    def made(self, chain: Chain) -> AssetObject:
        """Returns the object of a chain: its outline, upright."""
        polygon = outline(chain)
        shown = np.isfinite(chain.values["high_m"])
        heights = (chain.values["high_m"] - chain.values["low_m"])[shown]
        way = chain.xy_m[-1] - chain.xy_m[0]
        normal = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-9)
        to_sensor = np.array(chain.sensor_xy_m) - chain.xy_m.mean(axis=0)
        normal = normal if float(normal @ to_sensor) > 0.0 else -normal
        values = {
            "asset_height_m": float(np.nanmax(chain.values["high_m"] - chain.values["ground_m"])),
            "length_m": chain.length_m,
            "area_m2": float(chain.values["length_m"][shown] @ heights),
            "facing_deg": math.degrees(math.atan2(float(normal[0]), float(normal[1]))) % 360.0,
        }
        return as_object(chain, shapely.Polygon(polygon), values)
