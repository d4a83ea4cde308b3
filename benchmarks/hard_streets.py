"""Streets drawn at random that are harder than real ones: crowded, worn, on broken ground, seen with all errors.

A street is 40 to 60 m of a town, suburb, old town, country road, works' street or motorway. What stands on it stands
close together and hides one another; much of it looks like something else. The scanner, its mounting, the speed, the
passes and all errors are drawn, too. The same seed gives the same scene.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from roadscan.simulate import Scene
from roadscan.simulate.scene.roadside import Roadside
from roadscan.simulate.vehicles import SIZES_M

KINDS: Final = ("town", "suburb", "old_town", "country", "industrial", "motorway")
"""Kinds of streets."""
SCANNERS: Final = ("HDL-64E", "HDL-32E", "VLP-16", "OS1-128", "XT32")
"""Models of lidars."""
_OFF: Final = {key: {"on": False} for key in ("profilers", "sick", "camera", "imu", "gnss", "encoder")}
_LEAD_M: Final = 60.0
_FIRINGS_A_SECOND: Final = {"HDL-64E": 1.33e6, "HDL-32E": 0.69e6, "VLP-16": 0.29e6, "OS1-128": 1.31e6, "XT32": 0.64e6}
_MOST_FIRINGS: Final = 3.0e6
"""Firings of all passes of a street, at most, for its time; a quarter more of those with a million a second."""
_UPRIGHT: Final = {"lever_arm_body_m": (0.0, 0.0, -1.73), "roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 0.0}
_HALF_LANE: Final = {"town": 3.25, "suburb": 3.0, "old_town": 2.75, "country": 3.25, "industrial": 3.75,
                     "motorway": 7.5}  # fmt: skip


def hard_street(seed: int) -> Scene:
    """Return the street of a seed."""
    random = np.random.default_rng([seed, 37])
    model = str(random.choice(SCANNERS))
    longest = 44.0 if _FIRINGS_A_SECOND[model] > 1e6 else 60.0
    street = _Street(random, KINDS[seed % len(KINDS)], float(random.uniform(40.0, longest)))
    _lay_ground(street)
    for add in (_fronts, _boundaries, _green, _posts, _traffic, _furnish, _hang_wires):
        add(street)
    nothing: dict[str, list[Any]] = {kind: [] for kind in Roadside.model_fields}
    return Scene.load("urban_street").changed(
        id=f"hard-{seed}", title=f"{street.kind}, {street.length_m:.0f} m", seed=5000 + seed, length_m=street.length_m,
        road=_road(street), roadside=nothing | street.things, **_survey(street, model),
    )  # fmt: skip


@dataclass
class _Street:
    """A street as it is drawn: widths, and the things that stand on it."""

    random: np.random.Generator
    kind: str
    length_m: float
    half_m: float = 0.0
    """Half the width of the lanes."""
    paved_m: float = 0.0
    """From the middle to the kerb, or to where the paving ends."""
    walk_m: float = 0.0
    """Width of the sidewalk beyond it."""
    edge_m: float = 0.0
    """From the middle to gardens and fronts."""
    patches: list[dict[str, Any]] = field(default_factory=list)
    things: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def chance(self, share: float) -> bool:
        """Return whether a thing of a share of streets is on this one."""
        return bool(self.random.random() < share)

    def between(self, low: float, high: float) -> float:
        """Return a number, each as likely as the other."""
        return float(self.random.uniform(low, high))

    def log_between(self, low: float, high: float) -> float:
        """Return a number, each size as likely as the other."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def side(self) -> float:
        """Return −1 (left) or 1 (right)."""
        return float(self.random.choice([-1.0, 1.0]))

    def one_of(self, *names: str) -> str:
        """Return one of some names."""
        return str(self.random.choice(names))

    def add(self, kind: str, **what: Any) -> None:
        """Add a thing."""
        self.things.setdefault(kind, []).append(what)

    def places(self, most: int, near_m: float, far_m: float) -> list[tuple[float, float]]:
        """Return stations and offsets of up to `most` things between two distances from the middle, on both sides."""
        count = int(self.random.integers(0, most + 1))
        return [(self.between(-5.0, self.length_m + 5.0), self.side() * self.between(near_m, far_m))
                for _ in range(count)]  # fmt: skip

    @property
    def ends(self) -> dict[str, float]:
        """First and last station of what is as long as the street."""
        return {"start_m": -25.0, "end_m": self.length_m + 25.0}

    def stretch(self, shortest_m: float, longest_m: float) -> dict[str, float]:
        """Return first and last station of a part of the street."""
        start = self.between(-15.0, self.length_m - shortest_m)
        return {"start_m": start, "end_m": start + self.between(shortest_m, longest_m)}


# --- ground ------------------------------------------------------------------------------------------


def _lay_ground(street: _Street) -> None:
    """Draw widths, then patches, terraces, banks, ditches, gutters, bays and beds."""
    kind, between = street.kind, street.between
    street.half_m = _HALF_LANE[kind] + between(-0.25, 0.5)
    beside = {"town": (1.8, 2.5), "suburb": (0.3, 2.2), "old_town": (0.2, 0.6), "country": (0.3, 1.2),
              "industrial": (0.5, 3.0), "motorway": (1.5, 3.0)}[kind]  # fmt: skip
    street.paved_m = street.half_m + between(*beside)
    walk = {"town": (1.8, 4.5), "suburb": (1.0, 2.5), "old_town": (0.8, 2.0), "industrial": (0.0, 2.0)}
    street.walk_m = between(*walk[kind]) if kind in walk else 0.0
    street.edge_m = street.paved_m + max(street.walk_m, 0.3) + between(0.2, 1.5)
    for _ in range(int(street.random.integers(1, 5))):  # wet, dark, bright, repaired
        length, width = street.log_between(0.6, 12.0), between(0.5, 3.0)
        street.patches.append({
            "station_m": between(0, street.length_m), "offset_m": between(-street.paved_m + 1, street.paved_m - 1),
            "length_m": length, "width_m": width, "height_m": between(-0.006, 0.006),
            "edge_m": 0.02, "shade": between(25, 120),
        })  # fmt: skip
    _break_ground(street)


def _break_ground(street: _Street) -> None:
    """Add what the ground beside the road does."""
    between, chance, length = street.between, street.chance, street.length_m + 50.0
    for side in (-1.0, 1.0):
        here = {"station_m": street.length_m / 2, "length_m": length, "shade": between(75, 110)}
        begin = street.edge_m + 0.4
        choice = street.random.random()
        if choice < 0.2:  # a terrace behind a wall
            rise, start = between(0.4, 2.2), begin + between(0.3, 2.0)
            street.patches.append({**here, "offset_m": side * (start + 6.0), "width_m": 12.0, "height_m": rise,
                                   "edge_m": 0.05})  # fmt: skip
            street.add("walls", offset_m=side * (start - 0.12), **street.ends, height_m=rise + between(0.0, 0.5),
                       thickness_m=0.2, shade=between(90, 160))  # fmt: skip
        elif choice < 0.4:  # a steep bank, up or down
            rise = between(0.6, 2.8) * (1.0 if chance(0.6) else -1.0)
            width = 14.0
            street.patches.append({**here, "offset_m": side * (begin + width / 2), "width_m": width, "height_m": rise,
                                   "edge_m": min(abs(rise) / between(0.4, 1.2), 6.5)})  # fmt: skip
        elif choice < 0.55 and street.walk_m == 0.0:  # a ditch
            width = between(1.2, 2.5)
            street.patches.append({**here, "offset_m": side * (street.paved_m + 0.8 + width / 2), "width_m": width,
                                   "height_m": -between(0.3, 0.9), "edge_m": 0.45 * width})  # fmt: skip
        elif choice < 0.75:  # a raised bed
            street.patches.append({
                "station_m": between(5, street.length_m - 5), "length_m": between(3, 12), "width_m": 1.4,
                "offset_m": side * (begin + 1.2), "height_m": between(0.1, 0.6), "edge_m": 0.05,
                "shade": between(60, 100),
            })  # fmt: skip
        if chance(0.35) and street.paved_m - street.half_m > 1.0:  # bays, a little higher than the lanes
            wide = street.paved_m - street.half_m - 0.25
            street.patches.append({
                "station_m": between(8, street.length_m - 8), "length_m": between(8, 25), "width_m": wide,
                "offset_m": side * (street.half_m + 0.1 + wide / 2), "height_m": between(0.02, 0.05),
                "edge_m": between(0.01, 0.04), "shade": between(60, 140),
            })  # fmt: skip
        if chance(0.3):  # a gutter
            street.patches.append({**here, "offset_m": side * (street.paved_m - 0.16), "width_m": 0.3,
                                   "height_m": -between(0.008, 0.025), "edge_m": 0.1,
                                   "shade": between(80, 150)})  # fmt: skip


def _road(street: _Street) -> dict[str, Any]:
    """Return the road of the scene."""
    kind, between, chance = street.kind, street.between, street.chance
    has_kerb = kind in ("town", "suburb", "old_town") or chance(0.4 if kind == "industrial" else 0.1)
    low = 0.02 if kind == "old_town" else 0.03
    kerbs = [
        {"side": side, "height_m": street.log_between(low, 0.15), "face_m": 0.02,
         "ramps": [{"station_m": between(0, street.length_m), "length_m": between(2.0, 6.0),
                    "height_m": between(0.0, 0.03)} for _ in range(int(street.random.integers(0, 3)))]}
        for side in ("left", "right") if has_kerb
    ]  # fmt: skip
    face = float(street.random.choice([0.012, 0.02, 0.05, 0.1]))
    for kerb in kerbs:
        kerb["face_m"] = face
    concrete = chance(0.2)
    rough = {"town": "BC", "suburb": "BC", "old_town": "DE", "country": "CD", "industrial": "DE", "motorway": "A"}[kind]
    arc = between(90.0, 400.0) * street.side()
    straight = {"kind": "straight", "length_m": 100.0}
    curved = [{"kind": "arc", "length_m": 200.0, "radius_m": arc}]
    grass = {"height_m": street.log_between(0.02, 0.3), "from_m": street.walk_m, "shade": between(60, 110)}
    return {
        "alignment": curved if chance(0.4) else [straight], "lead_m": _LEAD_M, "lanes": 2,
        "lane_width_m": street.half_m, "shoulder_width_m": street.paved_m - street.half_m,
        "shoulder_slope": between(0.01, 0.05), "verge_width_m": street.edge_m - street.paved_m + 16.0,
        "verge_slope": between(-0.04, 0.08), "cross_slope": between(0.01, 0.04), "grade": between(-0.06, 0.06),
        "grades": [], "roughness": {"iso_class": street.one_of(*rough)}, "texture": None, "kerbs": kerbs, "ruts": [],
        "humps": [{"station_m": between(5, street.length_m - 5), "height_m": between(0.03, 0.09), "top_m": 1.5,
                   "ramp_m": between(0.8, 1.5)}] if chance(0.15) else [],
        "potholes": [], "cracks": [], "alligators": [], "patches": street.patches,
        "grass": grass if kind != "town" or chance(0.5) else None,
        "stains": [{"station_m": between(0, street.length_m), "offset_m": between(-street.half_m, street.half_m),
                    "length_m": between(0.3, 2.0), "width_m": between(0.2, 0.8), "shade": between(15, 150)}
                   for _ in range(int(street.random.integers(0, 8)))],
        "tyre_marks": _seams(street), "markings": _markings(street), "stop_bars": [], "crosswalks": _crossings(street),
        "brightness": {"asphalt": between(95, 130) if concrete else between(45, 95), "marking": between(110, 230),
                       "shoulder": between(50, 130), "verge": between(70, 150), "kerb": between(70, 160)},
    }  # fmt: skip


def _seams(street: _Street) -> list[dict[str, Any]]:
    """Return seams of tar, dark or bright when wet, and the joint of two layings: long, thin, and no marking."""
    between = street.between
    seams = []
    for _ in range(int(street.random.integers(0, 5))):
        offset, start = between(-street.half_m, street.half_m), between(-10, street.length_m - 5)
        points = [(start + 4.0 * n, offset + between(-0.08, 0.08)) for n in range(int(street.random.integers(2, 12)))]
        seams.append({"points_m": points, "width_m": between(0.04, 0.2), "shade": between(15, 150)})
    return seams


def _markings(street: _Street) -> list[dict[str, Any]]:
    """Return lines, worn."""
    between, chance, half = street.between, street.chance, street.half_m
    width = between(0.1, 0.2)
    lines = []
    if chance(0.85):
        dash = {"dash_m": between(1.0, 6.0), "gap_m": between(1.0, 9.0)} if chance(0.8) else {}
        lines.append({"offset_m": between(-0.1, 0.1), "width_m": width, "worn": between(0.1, 0.9), **dash})
    for side in (-1.0, 1.0):
        if chance(0.65):
            dash = {"dash_m": 1.0, "gap_m": 1.0} if chance(0.2) else {}
            lines.append({"offset_m": side * (half - between(0.1, 0.3)), "width_m": between(0.1, 0.3),
                          "worn": between(0.1, 0.9), **dash})  # fmt: skip
    if street.kind == "motorway":
        lines += [{"offset_m": side * half / 2, "width_m": width, "dash_m": 6.0, "gap_m": 12.0,
                   "worn": between(0.1, 0.7)} for side in (-1.0, 1.0)]  # fmt: skip
    return lines


def _crossings(street: _Street) -> list[dict[str, Any]]:
    if street.kind == "motorway" or not street.chance(0.35):
        return []
    return [{"station_m": street.between(5, street.length_m - 5), "from_m": -street.half_m, "to_m": street.half_m,
             "length_m": street.between(2.5, 4.0), "worn": street.between(0.1, 0.9)}]  # fmt: skip


# --- what stands there -------------------------------------------------------------------------------


def _fronts(street: _Street) -> None:
    """Add rows of houses, with what is on their fronts."""
    share = {"town": 0.85, "suburb": 0.5, "old_town": 0.95, "country": 0.15, "industrial": 0.7, "motorway": 0.05}
    back = {"town": (0.2, 2.0), "suburb": (3.0, 9.0), "old_town": (-0.8, 0.3), "country": (3.0, 10.0),
            "industrial": (1.0, 8.0), "motorway": (8.0, 12.0)}[street.kind]  # fmt: skip
    for side in (-1.0, 1.0):
        if not street.chance(share[street.kind]):
            continue
        start = -25.0
        while start < street.length_m + 20.0:
            end, away = start + street.between(8.0, 25.0), street.edge_m + street.between(*back)
            window = street.between(0.7, 2.2)
            storey = street.between(2.7, 3.6)
            street.add("facades", offset_m=side * away, start_m=start, end_m=end, height_m=street.between(3.5, 15.0),
                       storey_m=storey, window_m=min(window, storey - 0.5), bay_m=window + street.between(0.5, 2.5),
                       glass=street.between(0.3, 0.9), depth_m=6.0, shade=street.between(90, 200))  # fmt: skip
            _dress(street, side, away, start, end)
            start = end + (0.0 if street.chance(0.6) else street.between(1.5, 6.0))


def _dress(street: _Street, side: float, away: float, start: float, end: float) -> None:
    """Add doors, steps, balconies and the signs of shops to a front."""
    most = {"door": 1, "steps": 1, "balcony": 2, "shop_sign": 2, "hanging_sign": 1}
    before = {"door": 0.06, "steps": 0.45, "balcony": 0.6, "shop_sign": 0.08, "hanging_sign": 0.5}
    for what, count in most.items():
        for _ in range(int(street.random.integers(0, count + 1))):
            bright = street.between(60, 255) if "sign" in what else street.between(50, 170)
            street.add("furniture", what=what, station_m=street.between(start + 1, end - 1),
                       offset_m=side * (away - before[what]), scale=street.between(0.7, 1.4), shade=bright)  # fmt: skip


def _boundaries(street: _Street) -> None:
    """Add garden walls, hedges with and without a wall at their foot, fences of all densities, gates and rails."""
    between, chance = street.between, street.chance
    for side in (-1.0, 1.0):
        at = street.edge_m - between(0.0, 0.3)
        if street.kind == "motorway" or (street.kind == "country" and chance(0.5)):
            rail = street.paved_m + between(0.3, 0.7)
            street.add("guardrails", offset_m=side * rail, **street.ends, post_every_m=2.0 + 2.0 * chance(0.5),
                       height_m=between(0.65, 0.85))  # fmt: skip
            if chance(0.4):
                street.add("walls", offset_m=side * (rail + between(0.5, 1.5)), **street.ends,
                           height_m=between(0.5, 3.5), shade=between(90, 150))  # fmt: skip
        if street.kind == "town" and chance(0.6):
            continue
        start = -25.0
        while start < street.length_m + 20.0:
            span = {"start_m": start, "end_m": start + between(5.0, 22.0)}
            _boundary(street, side * at, span)
            start = span["end_m"]
            if chance(0.5):
                street.add("fences", what="gate", offset_m=side * at, start_m=start + 0.1,
                           end_m=start + between(1.2, 3.5), height_m=between(0.9, 1.6),
                           style=street.one_of("pickets", "mesh"), density=between(0.25, 0.7),
                           picket_m=0.05)  # fmt: skip
                start += 3.6


def _boundary(street: _Street, offset_m: float, span: dict[str, float]) -> None:
    between = street.between
    choice = street.random.random()
    if choice < 0.22:
        street.add("walls", offset_m=offset_m, **span, height_m=between(0.3, 1.5), thickness_m=between(0.12, 0.4),
                   shade=between(80, 170))  # fmt: skip
    elif choice < 0.5:
        street.add("hedges", offset_m=offset_m, **span, height_m=between(0.5, 2.5), width_m=between(0.4, 1.4),
                   passing=street.log_between(0.005, 0.4), ragged_m=between(0.0, 0.5) * street.chance(0.6),
                   foot_wall_m=between(0.15, 0.5) * street.chance(0.3), shade=between(70, 120))  # fmt: skip
    elif choice < 0.9:
        style = street.one_of("mesh", "mesh", "pickets", "panels")
        street.add("fences", offset_m=offset_m, **span, height_m=between(0.8, 2.2), style=style,
                   density=between(0.15, 0.85) if style == "mesh" else between(0.4, 0.85),
                   picket_m=between(0.04, 0.14), post_every_m=between(1.5, 3.0), shade=between(70, 170))  # fmt: skip
        if street.chance(0.25):  # on a low wall
            street.add("walls", offset_m=offset_m, **span, height_m=between(0.2, 0.6), thickness_m=0.2)


def _green(street: _Street) -> None:
    """Add trees of all forms, bushes, beds, and trees whose trunks stand in hedges."""
    between, chance = street.between, street.chance
    most = {"town": 5, "suburb": 8, "old_town": 2, "country": 9, "industrial": 3, "motorway": 5}[street.kind]
    for station, offset in street.places(most, street.paved_m + 0.5, street.edge_m + 4.0):
        _tree(street, station, offset)
    for hedge in street.things.get("hedges", []):
        if chance(0.3):
            middle = between(hedge["start_m"] + 0.5, hedge["end_m"] - 0.5)
            _tree(street, middle, hedge["offset_m"] + np.sign(hedge["offset_m"]) * hedge["width_m"] / 2)
    for station, offset in street.places(3, street.paved_m + 1.0, street.edge_m + 3.0):
        street.add("plantings", station_m=station, offset_m=offset, length_m=between(2, 12), width_m=between(0.8, 2.0),
                   height_m=between(0.15, 1.2), tuft_m=between(0.3, 0.8), density=between(0.4, 0.9))  # fmt: skip


def _tree(street: _Street, station_m: float, offset_m: float) -> None:
    between, chance = street.between, street.chance
    height, trunk = between(2.5, 11.0), street.log_between(0.1, 0.8)
    crown = min(between(0.25, 0.7) * height, 6.0)
    forked = chance(0.3)
    street.add("trees", station_m=station_m, offset_m=offset_m, height_m=height, trunk_m=trunk, crown_m=crown,
               crown_from_m=between(0.4, 0.9) if chance(0.25) else between(1.2, max(0.5 * height, 1.4)),
               lean_deg=between(0, 40) if chance(0.25) else between(0.1, 6.0), lean_towards_deg=between(0, 360),
               stems=int(street.random.integers(2, 5)) if forked else 1, fork_m=between(0.0, 2.0) * chance(0.8),
               extinction_per_m=street.log_between(0.3, 3.0), bush_m=between(0.5, 2.0) * chance(0.3),
               shade=between(70, 120), trunk_shade=between(50, 130))  # fmt: skip


def _posts(street: _Street) -> None:
    """Add signs, signals, lamps, poles, clusters of posts, and posts next to cars."""
    between, chance, kerb = street.between, street.chance, street.paved_m
    for station, offset in street.places(5, kerb + 0.2, kerb + 2.0):
        bright = chance(0.75)
        street.add("signs", station_m=station, offset_m=offset, width_m=between(0.4, 1.0), height_m=between(0.3, 1.0),
                   shape=street.one_of("round", "rectangle", "rectangle", "triangle", "octagon", "diamond"),
                   clearance_m=between(1.2, 3.0), shade=between(180, 255) if bright else between(90, 180),
                   faces=street.one_of("forward", "backward"), back_shade=between(60, 140))  # fmt: skip
    if chance(0.3):
        street.add("signs", station_m=between(5, street.length_m - 5),
                   offset_m=street.side() * (kerb + between(1.5, 3)), width_m=between(1.2, 3.5),
                   height_m=between(0.8, 2.2), clearance_m=between(1.5, 2.5),
                   shade=between(170, 255), faces=street.one_of("forward", "backward"))  # fmt: skip
    for station, offset in street.places(6, kerb + 0.15, kerb + 2.5):
        street.add("poles", station_m=station, offset_m=offset, height_m=street.log_between(0.7, 9.0),
                   diameter_m=street.log_between(0.05, 0.35), shade=between(50, 200))  # fmt: skip
    for station, offset in street.places(2, kerb + 0.3, kerb + 2.0):
        for _ in range(int(street.random.integers(2, 5))):  # a cluster
            street.add("poles", station_m=station + between(-0.5, 0.5), offset_m=offset + between(-0.3, 0.3),
                       height_m=between(0.8, 4.0), diameter_m=between(0.05, 0.15), shade=between(60, 160))  # fmt: skip
    for station, offset in street.places(2, kerb + 0.3, kerb + 1.2):
        street.add("lamp_posts", station_m=station, offset_m=offset, height_m=between(4.0, 9.0),
                   diameter_m=between(0.1, 0.25), arm_m=between(0.0, 2.5))  # fmt: skip
    if street.kind in ("town", "industrial"):
        for station, offset in street.places(2, kerb + 0.3, kerb + 1.0):
            street.add("signals", station_m=station, offset_m=offset, height_m=between(2.8, 3.6),
                       faces=street.one_of("forward", "backward"))  # fmt: skip


_WHAT: Final = ("car", "car", "car", "van", "van", "lorry", "motorcycle", "bicycle")


def _traffic(street: _Street) -> None:
    """Add what is parked and what moves, and people."""
    between, chance = street.between, street.chance
    wide = street.paved_m - street.half_m
    for side in (-1.0, 1.0):
        if street.kind == "motorway" or not chance(0.75):
            continue
        station = between(-10.0, 5.0)
        while station < street.length_m + 8.0:
            what = str(street.random.choice(_WHAT))
            big = what == "lorry" and street.kind in ("old_town", "suburb")
            what = "van" if big else what
            half = {"car": 2.3, "van": 2.8, "lorry": 4.4, "motorcycle": 1.1, "bicycle": 0.9}[what]
            station += half
            if chance(0.6):
                on_walk = 0.6 if what in ("bicycle", "motorcycle") and chance(0.6) else -min(wide / 2, 1.1)
                street.add("vehicles", what=what, station_m=station, offset_m=side * (street.paved_m + on_walk),
                           heading_deg=between(-4, 4) + 180.0 * chance(0.5), form=int(street.random.integers(0, 60)),
                           glass=between(0.3, 0.7), shade=between(20, 240))  # fmt: skip
                if chance(0.2):  # a post at 0.3 m from it
                    street.add("poles", station_m=station + between(-half, half),
                               offset_m=side * (street.paved_m + 0.3), height_m=between(0.8, 4.0),
                               diameter_m=between(0.06, 0.16))  # fmt: skip
            station += half + between(0.4, 6.0)
    _move(street)


def _move(street: _Street) -> None:
    """Add traffic and people."""
    between = street.between
    fast = {"town": 9.0, "suburb": 8.0, "old_town": 5.0, "country": 18.0, "industrial": 8.0, "motorway": 24.0}
    for _ in range(int(street.random.integers(0, 4))):
        what = street.one_of("car", "car", "van", "lorry", "motorcycle", "bicycle")
        size = SIZES_M[what]
        side, speed = street.side(), (4.5 if what == "bicycle" else fast[street.kind] * between(0.5, 1.2))
        street.add("moving_cars", what=what, station_m=between(-20, street.length_m), speed_m_per_s=side * speed,
                   offset_m=side * street.half_m * (0.85 if what == "bicycle" else 0.5), form=int(between(0, 60)),
                   length_m=size[0], width_m=size[1], height_m=size[2], shade=between(20, 240))  # fmt: skip
    if street.kind in ("country", "motorway"):
        return
    for _ in range(int(street.random.integers(0, 5))):
        side = street.side()
        street.add("moving_cars", what="person", station_m=between(-5, street.length_m + 5), form=int(between(0, 60)),
                   offset_m=side * (street.paved_m + between(0.4, max(street.walk_m, 0.6))),
                   speed_m_per_s=side * between(0.6, 1.8) * (1.0 if street.chance(0.5) else -1.0), length_m=1.05,
                   width_m=0.55, height_m=between(1.2, 1.95), shade=between(20, 200))  # fmt: skip
    for station, offset in street.places(4, street.paved_m + 0.3, street.edge_m):
        street.add("persons", station_m=station, offset_m=offset, height_m=between(1.1, 1.95), form=int(between(0, 60)),
                   heading_deg=between(0, 360), shade=between(20, 200))  # fmt: skip


def _furnish(street: _Street) -> None:
    """Add furniture between kerb and fronts, covers and drains."""
    between = street.between
    far = max(street.edge_m - 0.4, street.paved_m + 0.8)
    rich = {"town": 1.0, "suburb": 0.8, "old_town": 0.8, "country": 0.3, "industrial": 0.6, "motorway": 0.2}[
        street.kind
    ]
    most = {"cabinet": 3, "bin": 5, "litter_bin": 2, "bench": 2, "hydrant": 2, "bus_shelter": 1, "bollard": 6,
            "advertising_column": 1, "billboard": 1, "letter_box": 1, "parking_meter": 1, "planter": 2,
            "sandwich_board": 2}  # fmt: skip
    for what, count in most.items():
        for station, offset in street.places(round(rich * count), street.paved_m + 0.35, far):
            street.add("furniture", what=what, station_m=station, offset_m=offset, scale=between(0.75, 1.3),
                       heading_deg=float(street.random.choice([0.0, 90.0, 180.0])) + between(-8, 8),
                       shade=between(25, 255))  # fmt: skip
    for station, offset in street.places(4, 0.2, street.half_m):
        size = between(0.5, 0.8)
        street.add("covers", station_m=station, offset_m=offset, length_m=size, width_m=size,
                   height_m=between(0.002, 0.006), shade=between(40, 170))  # fmt: skip
    for station, offset in street.places(3, street.paved_m - 0.4, street.paved_m - 0.3):
        street.add("covers", what="drain", station_m=station, offset_m=offset, length_m=0.5, width_m=0.3,
                   shade=between(20, 60))  # fmt: skip
    for station, offset in street.places(5, street.paved_m - 0.35, street.paved_m + 0.1):  # leaves and gravel
        street.add("plantings", station_m=station, offset_m=offset, length_m=between(0.6, 3.0),
                   width_m=between(0.25, 0.5), height_m=between(0.02, 0.05), tuft_m=0.12, density=0.9,
                   shade=between(50, 120))  # fmt: skip


def _hang_wires(street: _Street) -> None:
    """Add wires along and across the road, between poles that carry them."""
    between = street.between
    if not street.chance(0.45):
        return
    side = street.side()
    offset, height = side * (street.paved_m + between(0.4, 1.5)), between(5.0, 8.0)
    first, span = between(-15.0, 0.0), between(20.0, 32.0)
    stations = [first + span * n for n in range(int((street.length_m + 15.0 - first) / span) + 1)]
    for station in stations:
        street.add("poles", station_m=station, offset_m=offset, height_m=height + 0.3, diameter_m=between(0.15, 0.3))
    for start, end in itertools.pairwise(stations):
        for number in range(int(street.random.integers(1, 4))):
            up = height - 0.35 * number
            street.add("wires", station_m=start, offset_m=offset, to_station_m=end, to_offset_m=offset, height_m=up,
                       to_height_m=up, sag_m=between(0.1, 0.7), diameter_m=between(0.012, 0.04))  # fmt: skip
    station = float(street.random.choice(stations))
    street.add("wires", station_m=station, offset_m=offset, to_station_m=station + between(-2, 2),
               to_offset_m=-side * street.edge_m, height_m=height, to_height_m=between(3.5, 6.0),
               sag_m=between(0.1, 0.5), diameter_m=between(0.01, 0.03))  # fmt: skip


# --- the survey --------------------------------------------------------------------------------------


def survey_of_hard_street(random: np.random.Generator, kind: str, length_m: float, model: str) -> dict[str, Any]:
    """Return scanner, mounting, speed, passes and errors of a street of a kind."""
    return _survey(_Street(random, kind, length_m), model)


def _survey(street: _Street, model: str) -> dict[str, Any]:
    """Return scanner, mounting, speed, passes and errors; the lidar alone records."""
    between, chance = street.between, street.chance
    low, high = (12.0, 25.0) if street.kind == "motorway" else (7.0, 14.0)
    a_second = _FIRINGS_A_SECOND[model]
    most_s = (1.25 if a_second > 1e6 else 1.0) * _MOST_FIRINGS / a_second
    least = street.length_m / (most_s - 0.6)
    speed = max(between(low, high), least)
    passes = [{"lane": 1 + n % 2, "direction": "forward" if n % 2 or chance(0.5) else "backward"}
              for n in range(1 + min(int(street.random.integers(0, 3)), int(speed / least) - 1))]  # fmt: skip
    tilted = model != "HDL-64E" and chance(0.4)
    mount = {**_UPRIGHT, "lever_arm_body_m": (between(-1.0, 0.0), between(-0.1, 0.1), -between(1.4, 1.9)),
             "roll_deg": between(-1, 1), "pitch_deg": between(12, 25) if tilted else between(-1.5, 1.5),
             "heading_deg": between(-180, 180) if not tilted else between(-4, 4)}  # fmt: skip
    return {
        "bag": dict.fromkeys(("on", "trajectory"), model in ("HDL-64E", "VLP-16")), "passes": passes,
        "vehicle": {"speed_m_per_s": speed, "standstill_s": 0.0},
        "lidar": {"model": model, "range_max_m": between(28.0, 45.0), "divergence_deg": "data sheet", "errors": "model",
                  "laser_range_m": between(0.0, 0.02), "laser_gain": between(0.0, 0.35), "dark_m": between(25, 70),
                  "false_returns": street.log_between(1e-4, 4e-3), "mount": mount},
        "noise": {"lidar_range_m": between(0.0, 0.012), "intensity": between(3, 12), "dropout": between(0.0, 0.04),
                  "position_m": between(0.002, 0.02), "attitude_deg": between(0.02, 0.15),
                  "attitude_time_constant_s": 8.0, "time_constant_s": 10.0, "pass_step_m": between(0.01, 0.05),
                  "step_m": between(0.01, 0.05) * chance(0.6), "steps_per_minute": 20.0},
        **_OFF,
    }  # fmt: skip
