"""Streets along walls with gaps, drawn at random: blocks, boards and fronts let sight lines through in places.

They look like fences where the gaps are narrow and follow one another. Scanners, mountings, speeds, passes and errors
are those of hard streets.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.hard_streets import SCANNERS, survey_of_hard_street
from roadscan.simulate import Scene
from roadscan.simulate.scene.roadside import Roadside

_LENGTH_M, _LEAD_M = 30.0, 15.0
_PARTS_M, _GAPS_M = (0.6, 4.0), (0.1, 1.0)
"""Lengths of the walls between gaps, and of the gaps: a door is 0.9 m wide."""


def street_of_gapped_walls(seed: int) -> Scene:
    """Return the street of a seed; five that follow one another are seen by five scanners."""
    random = np.random.default_rng([seed, 137])
    side: dict[str, list[Any]] = {kind: [] for kind in Roadside.model_fields}
    for sign in (1.0, -1.0):
        offset_m, high_m = random.uniform(4.5, 8.0), random.uniform(0.6, 2.2)
        part_m, gap_m, thick_m = random.uniform(*_PARTS_M), random.uniform(*_GAPS_M), random.uniform(0.03, 0.3)
        for start_m in np.arange(-_LEAD_M, _LENGTH_M + _LEAD_M, part_m + gap_m).tolist():
            side["walls"].append({"start_m": start_m, "end_m": start_m + part_m, "offset_m": sign * offset_m,
                                  "height_m": high_m, "thickness_m": thick_m})  # fmt: skip
        if random.random() < 0.6:
            side["facades"].append({"start_m": -_LEAD_M, "end_m": _LENGTH_M + _LEAD_M, "height_m": 10.0,
                                    "offset_m": sign * (offset_m + random.uniform(1.5, 8.0))})  # fmt: skip
    nothing: dict[str, list[Any]] = {
        k: [] for k in ("humps", "patches", "potholes", "grades", "crosswalks", "stop_bars")
    }
    road = {"alignment": [{"kind": "straight", "length_m": 200.0}], "grade": 0.0,
            "kerbs": [{"side": one, "height_m": 0.12} for one in ("left", "right")]}  # fmt: skip
    return Scene.load("urban_street").changed(
        id=f"gaps-{seed}", title="walls with gaps", seed=8000 + seed, length_m=_LENGTH_M, roadside=side,
        road=nothing | road, **survey_of_hard_street(random, "town", _LENGTH_M, SCANNERS[seed % len(SCANNERS)]),
    )  # fmt: skip
