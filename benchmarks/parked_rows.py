"""Streets between rows of parked cars and vans, drawn at random: bumper to bumper or apart, before fronts and fences.

All that stands in line with a row looks like it: a mesh, pickets, panels, a wall or a front stand close behind it, or
nothing does. Scanners, mountings, speeds, passes and errors are those of hard streets.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from benchmarks.hard_streets import SCANNERS, survey_of_hard_street
from roadscan.simulate import Scene
from roadscan.simulate.scene.roadside import Roadside

_LENGTH_M, _LEAD_M = 40.0, 20.0
_LENGTHS_M: Final = {"car": 4.4, "van": 5.4}


def street_of_parked_rows(seed: int) -> Scene:
    """Return the street of a seed; five that follow one another are seen by five scanners."""
    random = np.random.default_rng([seed, 99])
    side: dict[str, list[Any]] = {kind: [] for kind in Roadside.model_fields}
    vans, gap_m, parked_m = float(random.choice([0.0, 0.1, 0.3])), random.uniform(0.5, 2.6), random.uniform(4.0, 4.4)
    for sign in (1.0, -1.0):
        side["vehicles"] += _row(random, sign, parked_m, vans, gap_m)
    behind = str(random.choice(["facade", "fence", "fence", "wall", "nothing"]))
    for sign in (1.0, -1.0):
        ends = {"start_m": -_LEAD_M, "end_m": _LENGTH_M + _LEAD_M}
        near_m = sign * random.uniform(5.4, 6.5)
        if behind in ("facade", "fence"):
            side["facades"].append({**ends, "offset_m": sign * 9.0, "height_m": 10.0})
        if behind == "fence":
            style = str(random.choice(["panels", "mesh", "pickets"]))
            side["fences"].append({**ends, "offset_m": near_m, "height_m": random.uniform(0.9, 1.8), "style": style})
        if behind == "wall":
            side["walls"].append({**ends, "offset_m": near_m, "height_m": random.uniform(0.6, 1.8)})
    nothing: dict[str, list[Any]] = {
        k: [] for k in ("humps", "patches", "potholes", "grades", "crosswalks", "stop_bars")
    }
    road = {"alignment": [{"kind": "straight", "length_m": 200.0}], "grade": 0.0,
            "kerbs": [{"side": one, "height_m": 0.12} for one in ("left", "right")]}  # fmt: skip
    return Scene.load("urban_street").changed(
        id=f"rows-{seed}", title=f"rows of parked cars, {behind}", seed=7000 + seed, length_m=_LENGTH_M, roadside=side,
        road=nothing | road, **survey_of_hard_street(random, "town", _LENGTH_M, SCANNERS[seed % len(SCANNERS)]),
    )  # fmt: skip


def _row(random: np.random.Generator, sign: float, offset_m: float, vans: float, gap_m: float) -> list[dict[str, Any]]:
    """Return the vehicles of a row; one of twelve places is free, one of five vehicles stands the other way round."""
    out: list[dict[str, Any]] = []
    station_m = -_LEAD_M
    while station_m < _LENGTH_M + _LEAD_M:
        what = "van" if random.random() < vans else "car"
        is_there, turned_deg = random.random() > 1 / 12, 180.0 * (random.random() < 0.2)
        if is_there:
            out.append({
                "what": what, "station_m": station_m + _LENGTHS_M[what] / 2.0,
                "offset_m": sign * (offset_m + random.normal(0.0, 0.06)), "form": int(random.integers(0, 60)),
                "heading_deg": (0.0 if sign > 0 else 180.0) + random.normal(0.0, 1.0) + turned_deg,
            })  # fmt: skip
        station_m += _LENGTHS_M[what] + random.uniform(0.25, 0.25 + gap_m)
    return out
