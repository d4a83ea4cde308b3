"""Streets drawn with beds of plants beside them, like the two whole streets of `asset_streets` and unlike them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.asset_streets import motorway, town
from roadscan.simulate import Scene


def town_with_beds(seed: int, length_m: float = 64.0) -> Scene:
    """A straight town street, driven once or twice: beds 0.15–0.6 m high behind both kerbs, trees, parked cars."""
    random = np.random.default_rng([seed, 101])
    between, street = random.uniform, town()
    beds = _beds(between, 5.6, (1.2, 3.0), (8.0, 14.0), (5.0, 14.0), (1.8, 4.0), (4.0, 10.0), (0.15, 0.6), length_m)
    road = street.road.model_dump() | {
        "alignment": [{"kind": "straight", "length_m": 300.0}], "lead_m": 60.0, "verge_slope": between(-0.03, 0.05),
        "humps": [], "roughness": {"iso_class": str(random.choice(["A", "B", "C"]))},
    }  # fmt: skip
    for kerb in road["kerbs"]:
        kerb["height_m"] = between(0.06, 0.15)
        kerb["ramps"] = [{"station_m": between(10.0, 50.0), "length_m": between(3.0, 5.0)}]
    away = between(11.0, 12.0)
    beside = street.roadside.model_dump() | {
        "plantings": beds, "overheads": [], "signals": [], "signs": [],
        "facades": [{"offset_m": -away - 1.6, "start_m": -40.0, "end_m": between(25.0, 45.0), "height_m": 10.0}],
        "fences": [{"offset_m": away + 1.0, "start_m": between(20.0, 40.0), "end_m": 200.0, "height_m": 1.5}],
        "trees": [{"station_m": between(0.0, 6.0), "offset_m": between(6.5, 8.0), "every_m": between(11.0, 16.0),
                   "count": 5, "height_m": 8.0, "trunk_m": 0.3, "crown_m": 4.0}],
        "parked_cars": [
            {"station_m": between(3.0, 8.0), "offset_m": 4.25, "every_m": between(6.2, 12.0), "count": 5},
            {"station_m": between(3.0, 10.0), "offset_m": -4.25, "heading_deg": 180.0, "every_m": between(7.0, 14.0),
             "count": 4, "shade": 120.0},
        ],
        "poles": [{"station_m": between(20.0, 40.0), "offset_m": 5.7, "every_m": 1.6, "count": 4, "height_m": 0.9,
                   "diameter_m": 0.11}],
        "lamp_posts": [{"station_m": between(0.0, 8.0), "offset_m": -5.9, "every_m": 25.0, "count": 3,
                        "height_m": 7.0}],
    }  # fmt: skip
    passes: list[dict[str, Any]] = [{"lane": 2}, {"lane": 1, "direction": "backward"}]
    return street.changed(
        id=f"beds-town-{seed}", seed=7000 + seed, length_m=length_m,
        passes=passes if random.random() < 0.5 else passes[:1], road=road, roadside=beside,
        vehicle={"speed_m_per_s": between(7.0, 12.0), "standstill_s": 0.0},
        noise=street.noise.model_dump() | {"lidar_range_m": between(0.008, 0.02)},
    )  # fmt: skip


def town_partly_driven_twice(seed: int) -> Scene:
    """The same town street, 150 m long and driven once, 44 m of it a second time; trajectories are 70 mm off (1 σ)."""
    street = town_with_beds(seed)
    again = {"station_m": 10.0, "offset_m": -1.6, "pieces": [{"length_m": 44.0}]}
    passes: list[dict[str, Any]] = [{"lane": 2}, {"lane": 2, "route": again}]
    noise = street.noise.model_dump() | {"pass_step_m": 0.07, "position_m": 0.0, "attitude_deg": 0.0}
    return street.changed(id=f"beds-twice-{seed}", length_m=150.0, passes=passes, noise=noise)


def motorway_with_beds(seed: int, length_m: float = 80.0) -> Scene:
    """A straight motorway, driven in one or two lanes: beds 0.3–0.8 m high behind both guardrails, in their shade."""
    random = np.random.default_rng([seed, 102])
    between, street = random.uniform, motorway()
    beds = _beds(between, 9.4, (0.5, 1.2), (6.0, 12.0), (10.0, 30.0), (1.8, 3.5), (5.0, 15.0), (0.3, 0.8), length_m)
    road = street.road.model_dump() | {
        "alignment": [{"kind": "straight", "length_m": 300.0}], "cross_slopes": [], "joints": [], "cracks": [],
        "patches": [], "verge_width_m": 6.5, "roughness": {"iri_m_per_km": between(1.0, 2.2)},
    }  # fmt: skip
    beside = street.roadside.model_dump() | {
        "plantings": beds, "overheads": [], "boxes": [],
        "trees": [{"station_m": -30.0, "offset_m": 14.5, "every_m": between(12.0, 20.0), "count": 12, "height_m": 12.0,
                   "crown_m": 4.0}],
    }  # fmt: skip
    two = random.random() < 0.5
    return street.changed(
        id=f"beds-motorway-{seed}", seed=8000 + seed, length_m=length_m,
        passes=[{"lane": 1}, {"lane": 3}] if two else [{"lane": int(random.integers(1, 4))}], road=road,
        roadside=beside, vehicle={"speed_m_per_s": between(18.0, 28.0)},
        noise=street.noise.model_dump() | {"lidar_range_m": between(0.008, 0.02)},
    )  # fmt: skip


_Span = tuple[float, float]


def _beds(
    between: Callable[[float, float], float], near_m: float, beside_m: _Span, first_m: _Span, long_m: _Span,
    wide_m: _Span, apart_m: _Span, high_m: _Span, length_m: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return beds one after the other on both sides; lengths (m) are drawn between two, offsets count from `near_m`."""
    beds = []
    for side in (-1.0, 1.0):
        station = between(*first_m)
        while station < length_m - 7.0:
            long, wide = between(*long_m), between(*wide_m)
            beds.append({
                "station_m": station + long / 2, "offset_m": side * (near_m + between(*beside_m) + wide / 2),
                "length_m": long, "width_m": wide, "height_m": between(*high_m), "tuft_m": between(0.25, 0.65),
                "density": between(0.5, 0.9),
            })  # fmt: skip
            station += long + between(*apart_m)
    return beds
