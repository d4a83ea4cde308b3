"""Short streets drawn at random, each unlike the others: what stands on them, how large, how bright, how noisy."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from roadscan.simulate import Scene

LENGTH_M: Final = 36.0
_OFF: Final = {key: {"on": False} for key in ("profilers", "sick", "camera", "imu", "gnss", "encoder")}


def drawn_street(seed: int) -> Scene:
    """A street of a drawn kind: town, suburb or country road, driven once at 30 to 60 km/h."""
    random = np.random.default_rng([seed, 23])
    is_town = bool(random.random() < 0.5)
    paved = 3.25 + (2.0 if is_town else 0.75)
    near = paved + 0.7
    speed = float(random.uniform(8.5, 16.5))
    noise_m = float(random.uniform(0.008, 0.022))
    kerb = [{"side": side, "height_m": float(random.uniform(0.06, 0.15)),
             "ramps": [{"station_m": float(random.uniform(8, LENGTH_M - 8)), "length_m": 3.5}]}
            for side in ("left", "right") if is_town or random.random() < 0.3]  # fmt: skip
    return Scene.load("urban_street").changed(
        id=f"drawn-{seed}", seed=1000 + seed, length_m=LENGTH_M,
        passes=[{"lane": int(random.integers(1, 3)), "direction": "forward"}],
        vehicle={"speed_m_per_s": speed, "standstill_s": 0.0},
        lidar={"range_max_m": 36.0},
        noise={"lidar_range_m": noise_m, "intensity": float(random.uniform(3, 9)), "position_m": 0.0,
               "attitude_deg": 0.0},
        road={
            "alignment": [{"kind": "straight", "length_m": 300.0}], "lead_m": 60.0, "kerbs": kerb,
            "shoulder_width_m": paved - 3.25, "verge_width_m": 11.0,
            "verge_slope": float(random.uniform(-0.03, 0.08)), "humps": [], "crosswalks": _crossing(random),
            "stop_bars": [], "alligators": [], "cracks": [], "potholes": [], "patches": [], "stains": [],
            "tyre_marks": [],
            "brightness": {"marking": float(random.uniform(125, 200))},
            "markings": [{"offset_m": 0.0, "width_m": 0.12, "dash_m": 3.0, "gap_m": float(random.uniform(3, 6))},
                         {"offset_m": 3.1, "width_m": 0.12}, {"offset_m": -3.1, "width_m": 0.12}],
        },
        roadside=_roadside(random, is_town, near), **_OFF,
    )  # fmt: skip


def street_of_signs(seed: int, *, divergence_deg: float = 0.0) -> Scene:
    """A country road of 48 m with five signs: 0.4 to 4 m, 3 to 15 m beside the drive or above it, 30 to 90 km/h."""
    random = np.random.default_rng([seed, 77])
    speed = float(random.uniform(30, 90)) / 3.6
    signs = [_large_or_small(random, station) for station in np.arange(6.0, 44.0, 9.0)]
    return Scene.load("urban_street").changed(
        id=f"signs-{seed}", seed=500 + seed, length_m=48.0,
        passes=[{"lane": n + 1, "direction": "forward"} for n in range(int(random.integers(1, 3)))],
        vehicle={"speed_m_per_s": speed, "standstill_s": 0.0},
        lidar={"range_max_m": 36.0, "divergence_deg": divergence_deg},
        noise={"lidar_range_m": float(random.uniform(0.008, 0.022)), "intensity": 5.0, "position_m": 0.0,
               "attitude_deg": 0.0},
        road={
            "alignment": [{"kind": "straight", "length_m": 300.0}], "lead_m": 70.0, "kerbs": [],
            "verge_width_m": 18.0, "verge_slope": float(random.uniform(-0.03, 0.05)), "humps": [], "crosswalks": [],
            "stop_bars": [], "alligators": [], "cracks": [], "potholes": [], "patches": [], "stains": [],
            "tyre_marks": [], "markings": [],
        },
        roadside={
            **{kind: [] for kind in Scene.load("urban_street").roadside.model_dump()}, "signs": signs,
            "facades": [{"offset_m": -20.0, "start_m": -20.0, "end_m": 70.0, "height_m": 8.0}] * (seed % 2),
        },
        **_OFF,
    )  # fmt: skip


FURNITURE: Final = (
    "cabinet", "bin", "litter_bin", "bench", "hydrant", "bus_shelter", "planter", "letter_box", "parking_meter",
    "sandwich_board", "bollard", "advertising_column",
)  # fmt: skip


def street_of_furniture(seed: int) -> Scene:
    """A drawn street with 16 pieces of furniture beside it, seen by one of three lidars."""
    random = np.random.default_rng([seed, 41])
    street = drawn_street(seed)
    near = street.road.paved_m + 0.6
    pieces = [
        {"what": str(random.choice(FURNITURE)), "station_m": float(station + random.uniform(-0.7, 0.7)),
         "offset_m": float(side * (near + random.uniform(0.2, 2.4))), "scale": float(random.uniform(0.75, 1.3)),
         "heading_deg": float(random.choice([0.0, 90.0, 180.0]) + random.uniform(-10, 10)),
         "shade": float(random.uniform(25, 255))}
        for station in np.arange(2.5, LENGTH_M - 1.0, 4.4) for side in (-1.0, 1.0)
    ]  # fmt: skip
    held = street.roadside.model_dump() | {"furniture": pieces, "signs": [], "boxes": []}
    lidar = street.lidar.model_dump() | {"model": str(random.choice(["HDL-32E", "VLP-16", "HDL-64E"]))}
    return street.changed(id=f"furniture-{seed}", roadside=held, lidar=lidar, bag={"on": True})


def _between(random: np.random.Generator) -> Callable[[float, float], float]:
    """Draws of numbers between two."""
    return lambda low, high: float(random.uniform(low, high))


def street_of_covers(seed: int) -> Scene:
    """A drawn street with covers in its lanes, drains at its kerbs and wires over it, seen by one of four lidars."""
    random = np.random.default_rng([seed, 43])
    street = drawn_street(seed)
    paved = street.road.paved_m
    between = _between(random)

    def wire(station: float, to_station: float, offset: float, to_offset: float, height: float) -> dict[str, float]:
        return {"station_m": station, "to_station_m": to_station, "offset_m": offset, "to_offset_m": to_offset,
                "height_m": height, "to_height_m": height + between(-0.5, 0.5), "sag_m": between(0.05, 0.7),
                "diameter_m": between(0.01, 0.04)}  # fmt: skip

    covers: list[dict[str, Any]] = []
    for station in np.arange(2.0, LENGTH_M - 1.0, 3.3):
        size = between(0.5, 0.8)
        covers.append({"station_m": station + between(-1, 1), "offset_m": between(-paved + 0.6, paved - 0.6),
                       "length_m": size, "width_m": size, "height_m": between(0.002, 0.006),
                       "shade": between(30, 180)})  # fmt: skip
    covers += [
        {"what": "drain", "station_m": station + between(-1.2, 1.2), "shade": between(15, 70),
         "offset_m": float(random.choice([-1.0, 1.0])) * (paved - between(0.25, 0.45)),
         "length_m": between(0.4, 0.6), "width_m": between(0.25, 0.4)}
        for station in np.arange(3.0, LENGTH_M - 1.0, 4.1)
    ]  # fmt: skip
    side, height = float(random.choice([-1.0, 1.0])), between(5.2, 8.0)
    beside, stations = side * (paved + between(0.5, 1.5)), [between(-8, 0), between(18, 26), between(44, 52)]
    wires = [
        wire(start, end, beside, beside, height - 0.4 * number)
        for start, end in itertools.pairwise(stations)
        for number in range(int(random.integers(1, 4)))
    ]
    wires += [wire(s, s + between(-3, 3), beside, -side * (paved + between(1, 5)), height) for s in stations[:2]]
    poles = [{"station_m": s, "offset_m": beside, "height_m": height + 0.3} for s in stations]
    held = street.roadside.model_dump()
    held |= {"covers": covers, "wires": wires, "poles": [*held["poles"], *poles]}
    lidar = street.lidar.model_dump() | {"model": str(random.choice(["HDL-32E", "VLP-16", "HDL-64E", "OS1-128"]))}
    return street.changed(id=f"covers-{seed}", roadside=held, lidar=lidar, bag={"on": True})


def street_of_lookalikes(seed: int) -> Scene:
    """A street of covers and wires with what is like them: stains, potholes, arms of signals and lamps, bridges."""
    random = np.random.default_rng([seed, 47])
    street = street_of_covers(seed)
    paved = street.road.paved_m
    between = _between(random)

    def somewhere() -> dict[str, float]:
        return {"station_m": between(0.0, LENGTH_M), "offset_m": between(-paved + 0.4, paved - 0.4)}

    stains = [
        somewhere() | {"length_m": between(0.3, 1.2), "width_m": between(0.25, 0.8), "shade": between(12.0, 45.0)}
        for _ in range(8)
    ]
    potholes = [somewhere() | {"radius_m": between(0.15, 0.5), "depth_m": between(0.015, 0.08)} for _ in range(5)]
    signals, lamps = [], []
    for station in np.arange(4.0, LENGTH_M, 9.0):
        side = float(random.choice([-1.0, 1.0]))
        signals.append(
            {
                "station_m": station,
                "offset_m": side * (paved + between(0.4, 1.2)),
                "height_m": between(4.8, 7.0),
                "arm_m": between(1.5, 6.0),
                "diameter_m": between(0.1, 0.2),
            }
        )
        lamps.append({"station_m": station + 4.5, "offset_m": -side * (paved + between(0.4, 1.5)),
                      "height_m": between(4.5, 9.0), "arm_m": between(0.8, 3.0), "diameter_m": between(0.08, 0.2),
                      "is_double": bool(random.random() < 0.5)})  # fmt: skip
    bridge = {"station_m": between(8.0, LENGTH_M - 8.0), "offset_m": 0.0, "length_m": between(1.5, 4.0),
              "width_m": 2.0 * paved + 4.0, "clearance_m": between(4.5, 6.0),
              "thickness_m": between(0.3, 0.8)}  # fmt: skip
    held = street.roadside.model_dump()
    held |= {"signals": signals, "lamp_posts": lamps, "overheads": [bridge] if random.random() < 0.3 else []}
    road = street.road.model_dump() | {"stains": stains, "potholes": potholes}
    return street.changed(id=f"lookalikes-{seed}", roadside=held, road=road)


def street_of_shafts(seed: int, *, lamp_arm_m: float = 3.0) -> Scene:
    """A drawn street with posts, lamps, signals and trees, before fronts and balconies too, at 25 to 95 km/h.

    lamp_arm_m : arms of lamps are no longer.
    """
    random = np.random.default_rng([seed, 53])
    street = drawn_street(seed)
    near = street.road.paved_m
    between = _between(random)

    held = street.roadside.model_dump() | {"trees": [], "lamp_posts": [], "signals": []}
    for station in np.arange(1.0, LENGTH_M, 3.2):
        for side in (-1.0, 1.0):
            what = str(random.choice(["trees", "trees", "lamp_posts", "signals", "poles", "none"]))
            place = {"station_m": float(station) + between(-0.8, 0.8), "offset_m": side * (near + between(0.4, 2.5))}
            if what == "trees":
                height = between(3.5, 13.0)
                held[what].append(place | {
                    "offset_m": side * (near + between(0.8, 8.0)), "height_m": height, "trunk_m": between(0.1, 0.5),
                    "crown_m": min(between(1.5, 6.0), 0.8 * height), "density": between(0.3, 0.9),
                    "lean_deg": between(0.0, 8.0), "crown_from_m": between(1.2, 0.6 * height),
                })  # fmt: skip
            elif what == "lamp_posts":
                held[what].append(place | {
                    "height_m": between(4.0, 9.0), "diameter_m": between(0.08, 0.24), "arm_m": between(0.5, lamp_arm_m),
                    "is_double": bool(random.random() < 0.3),
                })  # fmt: skip
            elif what == "signals":
                arm = between(1.5, 6.0) if random.random() < 0.4 else 0.0
                held[what].append(place | {
                    "height_m": between(4.8, 7.0) if arm else between(2.7, 3.8), "arm_m": arm,
                    "diameter_m": between(0.08, 0.2), "faces": str(random.choice(["forward", "backward"])),
                })  # fmt: skip
            elif what == "poles":
                held[what].append(place | {"height_m": between(0.7, 9.0), "diameter_m": between(0.05, 0.35)})
    for front in held["facades"]:
        side, away = float(np.sign(front["offset_m"])), abs(front["offset_m"])
        for station in np.arange(2.0, LENGTH_M, 6.0):
            at = float(station) + between(-1.0, 1.0)
            held["furniture"].append({"what": "balcony", "station_m": at, "offset_m": side * (away - 0.6),
                                      "scale": between(0.7, 1.4), "shade": between(50, 170)})  # fmt: skip
            held["poles"].append({"station_m": at + between(-0.8, 0.8), "offset_m": side * (away - between(0.5, 1.6)),
                                  "height_m": between(2.4, 4.5), "diameter_m": between(0.05, 0.2)})  # fmt: skip
    lidar = street.lidar.model_dump() | {"model": str(random.choice(["HDL-32E", "HDL-32E", "VLP-16", "VLP-16"]))}
    speed = between(7.0, 14.0) if random.random() < 0.6 else between(16.0, 26.0)
    vehicle = street.vehicle.model_dump() | {"speed_m_per_s": speed}
    return street.changed(id=f"shafts-{seed}", roadside=held, lidar=lidar, vehicle=vehicle, bag={"on": True})


def street_of_plates(seed: int) -> Scene:
    """A drawn street with signs of all sizes and what is like them: fronts with windows and boards, vans, lorries."""
    random = np.random.default_rng([seed, 59])
    street = drawn_street(seed)
    paved = street.road.paved_m
    between = _between(random)

    kinds = ("signs", "facades", "parked_cars", "furniture", "fences")
    things = street.roadside.model_dump() | {kind: [] for kind in kinds}
    for side in (-1.0, 1.0):
        away = paved + between(2.0, 7.0)
        if random.random() < 0.8:
            for start in np.arange(-20.0, LENGTH_M + 20.0, 14.0).tolist():
                window, front, end = between(0.7, 2.2), away + between(0.0, 1.0), start + between(9.0, 14.0)
                things["facades"].append({
                    "offset_m": side * front, "start_m": start, "end_m": end,
                    "height_m": between(3.5, 13.0), "storey_m": between(2.8, 3.6), "window_m": window,
                    "bay_m": window + between(0.5, 2.5), "glass": between(0.3, 0.9), "depth_m": 6.0,
                    "shade": between(90.0, 200.0),
                })  # fmt: skip
                for what, before in (("shop_sign", 0.08), ("hanging_sign", 0.5), ("balcony", 0.6), ("door", 0.06)):
                    things["furniture"].append({
                        "what": what, "station_m": between(start + 1.0, end - 1.0), "offset_m": side * (front - before),
                        "scale": between(0.7, 1.4), "shade": between(60.0, 255.0),
                    })  # fmt: skip
        for station in np.arange(2.0, LENGTH_M, 5.0):
            sign = _large_or_small(random, float(station))
            sign["offset_m"] = side * (paved + between(0.3, 1.8) + sign["width_m"] / 2.0)
            sign |= {"clearance_m": between(1.6, 3.2), "shade": between(140.0, 255.0)}
            what = str(random.choice(["sign", "sign", "sign", "billboard", "van", "lorry"]))
            if what == "sign":
                things["signs"].append(sign)
            elif what == "billboard":
                things["furniture"].append({
                    "what": what, "station_m": float(station), "offset_m": side * (paved + between(0.6, 2.0)),
                    "scale": between(0.75, 1.3), "shade": between(25.0, 255.0),
                    "heading_deg": float(random.choice([0.0, 90.0])) + between(-8.0, 8.0),
                })  # fmt: skip
            else:
                things["vehicles"].append({
                    "what": what, "station_m": float(station), "offset_m": side * (paved - 1.0),
                    "heading_deg": between(-4.0, 4.0) + 180.0 * float(random.random() < 0.5),
                    "form": int(random.integers(0, 60)), "glass": between(0.3, 0.7), "shade": between(20.0, 240.0),
                })  # fmt: skip
    things["moving_cars"] = [{
        "what": str(random.choice(["van", "lorry"])), "station_m": between(-10.0, 20.0),
        "speed_m_per_s": between(5.0, 9.0), "offset_m": 1.6, "form": int(random.integers(0, 60)),
        "shade": between(20.0, 240.0),
    }]  # fmt: skip
    model = str(random.choice(["HDL-32E", "HDL-32E", "VLP-16", "OS1-128", "XT32"]))
    lidar = street.lidar.model_dump() | {"model": model, "divergence_deg": "data sheet"}
    return street.changed(id=f"plates-{seed}", roadside=things, lidar=lidar, bag={"on": model == "VLP-16"})


SYMBOLS: Final = ("ahead", "left", "right", "ahead_left", "ahead_right", "triangle", "diamond", "bicycle")


def street_of_symbols(seed: int) -> Scene:
    """A drawn street with symbols in both lanes, some worn, and raised markers, seen by one of four lidars."""
    random = np.random.default_rng([seed, 53])
    street = drawn_street(seed)
    between = _between(random)

    symbols = []
    for station, offset in itertools.product(np.arange(3.0, LENGTH_M - 2.0, 6.5), (-1.55, 1.55)):
        shape = str(random.choice(SYMBOLS))
        length = between(1.8, 3.0) if shape == "bicycle" else between(2.5, 5.0)
        width = {"ahead": 0.75, "diamond": 1.2, "bicycle": 1.4}.get(shape, 1.5) * between(0.8, 1.3)
        symbols.append({
            "station_m": float(station) + between(-0.5, 0.5), "offset_m": offset + between(-0.2, 0.2), "shape": shape,
            "facing": str(random.choice(["forward", "backward"])), "length_m": length, "width_m": width,
            "line_m": between(0.12, 0.25), "worn": between(0.0, 0.3),
            "head_m": length * between(0.2, 0.35) if shape == "ahead" else between(0.4, 0.8),
        })  # fmt: skip
    markers = [
        {"station_m": float(station), "offset_m": offset, "length_m": 0.11, "width_m": 0.11, "height_m": 0.018,
         "shade": between(190.0, 255.0), "edge_m": 0.01}
        for station in np.arange(1.5, LENGTH_M, 3.0) for offset in (-0.4, 3.5)
    ]  # fmt: skip
    road = street.road.model_dump() | {"symbols": symbols, "patches": markers, "crosswalks": []}
    lidar = street.lidar.model_dump() | {"model": str(random.choice(["HDL-32E", "VLP-16", "HDL-64E", "OS1-128"]))}
    return street.changed(id=f"symbols-{seed}", road=road, lidar=lidar, bag={"on": True})


def _large_or_small(random: np.random.Generator, station_m: float) -> dict[str, Any]:
    shape = str(random.choice(["rectangle", "rectangle", "rectangle", "round", "octagon", "diamond", "triangle"]))
    wide = tall = float(np.exp(random.uniform(np.log(0.5), np.log(1.5))))
    if shape == "rectangle":
        wide = float(np.exp(random.uniform(np.log(0.4), np.log(4.0))))
        tall = float(np.clip(wide * np.exp(random.uniform(-0.7, 0.4)), 0.4, 3.0))
    is_above = bool(random.random() < 0.15)
    beside = float(random.choice([-1, 1]) * (3.0 + wide / 2 + random.uniform(0, 12)))
    return {
        "station_m": station_m + float(random.uniform(-2, 2)), "shape": shape, "width_m": wide, "height_m": tall,
        "offset_m": float(random.uniform(-1.5, 1.5)) if is_above else beside,
        "clearance_m": float(random.uniform(4.8, 5.5) if is_above else random.uniform(1.8, 3.2)),
        "shade": float(random.uniform(180, 255)), "faces": "backward" if random.random() < 0.7 else "forward",
    }  # fmt: skip


def _crossing(random: np.random.Generator) -> list[dict[str, Any]]:
    if random.random() < 0.5:
        return []
    return [{"station_m": float(random.uniform(10, LENGTH_M - 10)), "from_m": -3.0, "to_m": 3.0}]


def _roadside(random: np.random.Generator, is_town: bool, near: float) -> dict[str, Any]:
    """Things of each kind, as they come on such a street."""

    def places(most: int, offset: tuple[float, float]) -> list[dict[str, Any]]:
        count = int(random.integers(0, most + 1))
        stations = random.permutation(np.arange(3.0, LENGTH_M - 2.0, 3.4))[:count]
        sides = random.choice([-1.0, 1.0], count)
        stations = stations + random.uniform(-0.8, 0.8, count)
        offsets = sides * (near + random.uniform(*offset, count))
        return [{"station_m": float(s), "offset_m": float(o)} for s, o in zip(stations, offsets, strict=True)]

    shapes = ("round", "rectangle", "triangle", "octagon", "diamond")
    far = near + float(random.uniform(3.0, 5.0))
    sides = [-1.0, 1.0]
    walls = [s for s in sides if random.random() < (0.7 if is_town else 0.2)]
    fences = [s for s in sides if s not in walls and random.random() < 0.5]
    rails = [] if is_town else [s for s in sides if random.random() < 0.5]
    return {
        "signs": [p | {"shape": str(random.choice(shapes)), "width_m": float(random.uniform(0.5, 0.9)),
                       "height_m": float(random.uniform(0.5, 0.9)), "clearance_m": float(random.uniform(1.8, 2.6)),
                       "shade": float(random.uniform(150, 255)),
                       "faces": str(random.choice(["forward", "backward"]))} for p in places(4, (0.0, 1.5))],
        "poles": [
            *[p | {"height_m": float(random.uniform(2.0, 7.0)), "diameter_m": float(random.uniform(0.06, 0.3))}
              for p in places(4, (0.0, 3.0))],
            *[p | {"height_m": float(random.uniform(0.6, 1.2)), "diameter_m": float(random.uniform(0.06, 0.16))}
              for p in places(5, (-0.4, 0.4))],
        ],
        "lamp_posts": [p | {"height_m": float(random.uniform(4.5, 8.0)), "arm_m": float(random.uniform(1.0, 2.5))}
                       for p in places(2, (0.0, 1.0))],
        "signals": places(2 if is_town else 0, (0.0, 0.5)),
        "trees": [p | {"height_m": float(random.uniform(5.0, 10.0)), "crown_m": float(random.uniform(2.5, 5.0)),
                       "trunk_m": float(random.uniform(0.15, 0.5)), "density": float(random.uniform(0.4, 0.9))}
                  for p in places(4, (1.0, 3.5))],
        "parked_cars": [{"station_m": float(s), "offset_m": (near + 3.25) / 2 - 0.2, "heading_deg": 0.0}
                        for s in np.arange(6.0, LENGTH_M, 7.0) if is_town and random.random() < 0.3],
        "moving_cars": [],
        "facades": [{"offset_m": s * far, "start_m": -40.0, "end_m": LENGTH_M + 40.0,
                     "height_m": float(random.uniform(5, 14))} for s in walls],
        "fences": [{"offset_m": s * far, "start_m": -20.0, "end_m": LENGTH_M + 20.0,
                    "height_m": float(random.uniform(1.0, 2.0)), "density": float(random.uniform(0.25, 0.6))}
                   for s in fences],
        "guardrails": [{"offset_m": s * (near - 0.2), "start_m": -20.0, "end_m": LENGTH_M + 20.0} for s in rails],
        "plantings": [{"station_m": float(random.uniform(8, LENGTH_M - 8)), "offset_m": s * (near + 2.0),
                       "length_m": float(random.uniform(5, 15)), "width_m": float(random.uniform(1.5, 2.5)),
                       "height_m": float(random.uniform(0.15, 0.8))} for s in sides if random.random() < 0.5],
        "boxes": [p | {"length_m": float(random.uniform(0.5, 1.5)), "width_m": 0.5,
                       "height_m": float(random.uniform(0.8, 1.6))} for p in places(2, (0.3, 2.0))],
    }  # fmt: skip
