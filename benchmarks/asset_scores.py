"""What was found on a simulated street, held against what stands there: by points, along lines, by area, by cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import geopandas
import laspy
import numpy as np
import numpy.typing as npt
import pandas as pd
import rasterio
import scipy.spatial
import shapely

from benchmarks.asset_streets import LOW_POST_M, Street
from benchmarks.timing import Figure
from roadscan.assets import classes
from roadscan.assets.kinds.street_furniture import JUDGES

Float64 = npt.NDArray[np.float64]

NEAR_M: Final = 0.5
"""A post or a plate is the one that stands there when it is found so near to it."""
_STEP_M: Final = 0.1
_HIT_M: Final = 0.2
"""What no return hits within this is hidden: finders of edges look so far."""
_PAINT_FROM: Final = 150.0
"""Digital numbers of the simulator: paint is 190, a kerb 135."""
_CELL_M: Final = 0.1
_PLATE_BEFORE_POST_M: Final = 0.04
_HEIGHT_SHARE: Final = {"round": 1.0, "triangle": math.sqrt(3.0) / 2.0, "octagon": 1.0, "diamond": 1.0}
_POST_OF_SIGN_M: Final = 0.06
POINTS: Final = ("sign", "pole", "lighting", "signal", "tree", "delineator")
LINES: Final = {"kerb": 0.05, "guardrail": 0.15, "facade": 0.3, "fence": 0.15, "lane_line": 0.05}
"""How near a line has to lie (m)."""
AREAS: Final = ("sidewalk", "landscape_area")
NONE_THERE: Final = ("wall", "barrier", "attenuator", "median")
"""Kinds that the streets lack, but for boxes."""
_MANHOLE_M: Final = 1.0
"""A round patch that is no wider is a manhole's cover."""
_FURNITURE: Final = (*JUDGES, "litter_bin")


class Judged(NamedTuple):
    """An object that was found."""

    kind: str
    probability: float
    is_right: float
    """1 or 0; of a line or an area its share that is right."""


# --- what is true ------------------------------------------------------------------------------------


def true_points(street: Street) -> dict[str, pd.DataFrame]:
    """Foot, size and heading of what stands at a place, by kind; a sign stands on a pole of its own."""
    things = street.things[street.things.station_m.between(*street.ends_m)]
    posts = things[things.kind == "pole"]
    signs = things[things.kind == "sign"]
    sign_posts = signs.assign(width_m=_POST_OF_SIGN_M)
    return {
        "sign": signs,
        "pole": pd.concat([posts[posts.size_up_m > LOW_POST_M], sign_posts]),
        "delineator": posts[posts.size_up_m <= LOW_POST_M],
        "lighting": things[things.kind == "lamp_post"],
        "signal": things[things.kind == "signal"],
        "tree": things[things.kind == "tree"],
    }


def true_lines(street: Street) -> dict[str, shapely.Geometry]:
    """Lines of barriers, kerbs and painted lines, by kind."""
    side, road = street.scene.roadside, street.scene.road
    sign = {"left": -1.0, "right": 1.0}
    kerbs = [
        street.line(sign[k.side] * (road.paved_m + k.face_m / 2), -math.inf, math.inf) for k in road.kerbs
    ]  # fmt: skip
    fronts = []
    for one in side.facades:
        fronts.append(street.line(one.offset_m, one.start_m, one.end_m))
        for station in (one.start_m, one.end_m):
            if street.ends_m[0] <= station <= street.ends_m[1]:
                away = one.offset_m + math.copysign(one.depth_m, one.offset_m)
                east, north, _ = street.surface.place(np.full(2, station), np.array([one.offset_m, away]))
                fronts.append(shapely.LineString(np.column_stack([east, north])))
    return {
        "kerb": shapely.union_all(kerbs),
        "guardrail": shapely.union_all([street.line(g.offset_m, g.start_m, g.end_m) for g in side.guardrails]),
        "fence": shapely.union_all([street.line(f.offset_m, f.start_m, f.end_m) for f in side.fences]),
        "facade": shapely.union_all(fronts),
        "lane_line": shapely.union_all([street.line(m.offset_m, m.start_m, m.end_m) for m in road.markings]),
    }


def true_areas(street: Street) -> dict[str, shapely.Geometry]:
    """Areas of plants, and of sidewalks where a façade or a fence ends them."""
    side, road = street.scene.roadside, street.scene.road
    walks = []
    for kerb in road.kerbs:
        sign = -1.0 if kerb.side == "left" else 1.0
        for one in (*side.facades, *side.fences):
            if one.offset_m * sign > road.paved_m:
                near = sign * (road.paved_m + kerb.face_m)
                walks.append(street.area(near, one.offset_m, one.start_m, one.end_m))
    beds = [
        street.area(p.offset_m - p.width_m / 2, p.offset_m + p.width_m / 2, s - p.length_m / 2, s + p.length_m / 2)
        for p in side.plantings
        for s in [p.station_m + n * p.every_m for n in range(p.count if p.every_m > 0.0 else 1)]
    ]
    return {"sidewalk": shapely.union_all(walks), "landscape_area": shapely.union_all(beds)}


def true_spots(street: Street) -> dict[str, shapely.Geometry]:
    """Where covers and drains lie, furniture stands and wires hang, by kind."""
    side, (east, north) = street.scene.roadside, street.things[["easting_m", "northing_m"]].to_numpy().T
    round_ones = [p for p in street.scene.road.patches if p.shape == "circle" and p.length_m <= _MANHOLE_M]
    lids = [street.line(p.offset_m, p.station_m - 0.1, p.station_m + 0.1) for p in round_ones]
    wires = [[street.surface.place(np.array([at]), np.array([to]))[:2] for at, to in
              ((w.station_m, w.offset_m), (w.to_station_m, w.to_offset_m))] for w in side.wires]  # fmt: skip
    kinds = {"cover": ("cover", "drain"), "street_furniture": _FURNITURE}
    found = {
        kind: shapely.union_all(shapely.points(east, north)[street.things.kind.isin(names).to_numpy()])
        for kind, names in kinds.items()
    }
    found["cover"] = shapely.union_all([found["cover"], *lids])
    return found | {"wire": shapely.union_all([shapely.LineString(np.array(w)[:, :, 0]) for w in wires])}


def boxes(street: Street) -> shapely.Geometry:
    """Outlines of the boxes, which may be found as walls, barriers or façades."""
    found = []
    for one in street.things[street.things.kind == "box"].itertuples():
        sine, cosine = math.sin(math.radians(one.heading_deg)), math.cos(math.radians(one.heading_deg))
        a, b = one.length_m / 2, one.width_m / 2
        ring = [(one.easting_m + u * sine + v * cosine, one.northing_m + u * cosine - v * sine)
                for u, v in ((a, b), (a, -b), (-a, -b), (-a, b))]  # fmt: skip
        found.append(shapely.Polygon(ring))
    return shapely.union_all(found)


def overhead(street: Street) -> shapely.Geometry:
    """What hangs over the street, seen from above: slabs, arms, crowns."""
    found = []
    for one in street.things[street.things.kind.isin(["overhead", "tree", "lamp_post", "signal"])].itertuples():
        place = shapely.Point(one.easting_m, one.northing_m)
        reach = math.hypot(one.length_m, one.width_m) / 2 if one.kind == "overhead" else max(one.width_m, one.length_m)
        found.append(place.buffer(reach + 0.3))
    return shapely.union_all(found)


# --- objects one by one ------------------------------------------------------------------------------


def judged(street: Street) -> Iterator[Judged]:
    """Each object that was found, its probability, and whether it is what it says."""
    points, lines, areas, solid = true_points(street), true_lines(street), true_areas(street), boxes(street)
    paint, above = _painted(street), overhead(street)
    road = street.scene.road
    edges = shapely.union_all(
        [street.line(s * road.paved_m, -math.inf, math.inf) for s in (-1.0, 1.0)]
        + [lines[kind] for kind in ("guardrail", "fence", "facade")]
    )
    # behind a kerb all is sidewalk, as far as the ground goes
    behind = [(road.paved_m, road.edge_m) if k.side == "right" else (-road.paved_m, -road.edge_m) for k in road.kerbs]
    areas["sidewalk"] = shapely.union_all([street.area(*offsets, -math.inf, math.inf) for offsets in behind])
    region = street.area(-60.0, 60.0, -math.inf, math.inf)

    def near(kind_lines: shapely.Geometry, within_m: float) -> Callable[[Any], float]:
        return lambda g: _share_of(_inside(street, _samples(g)), kind_lines, within_m)

    def on_line(kind: str) -> Callable[[Any], float]:
        own, box = near(lines[kind], max(LINES[kind], 0.15)), near(solid, 0.3)
        # a chain that follows a box is a wall, whichever kind of one
        return lambda g: max(own(g), box(g))

    def in_area(area: shapely.Geometry) -> Callable[[Any], float]:
        return lambda g: _share_within(shapely.make_valid(shapely.force_2d(g)).intersection(region), area)

    def at_place(kind: str) -> Callable[[Any], float]:
        return lambda g: float(_nearest(points[kind], g.x, g.y)[1] <= NEAR_M)

    rules: dict[str, Callable[[Any], float]] = {kind: on_line(kind) for kind in LINES}
    rules |= {kind: near(solid, 0.3) for kind in NONE_THERE}
    rules |= {kind: in_area(areas[kind]) for kind in AREAS}
    rules |= {kind: at_place(kind) for kind in POINTS}
    rules |= {"road_marking": in_area(paint), "road_edge": near(edges, 0.3)}
    rules["clearance"] = lambda g: float(shapely.dwithin(shapely.force_2d(g), above, 0.5))
    for kind, rule in rules.items():
        table = street.found(kind)
        for shape, probability in zip(table.geometry, table["probability"], strict=True):
            yield Judged(kind, float(probability), rule(shape) >= 0.5)


def _painted(street: Street) -> shapely.Geometry:
    """Outlines of zebra crossings and stop bars, and of lines."""
    road = street.scene.road
    found = [street.area(c.from_m, c.to_m, c.station_m - c.length_m / 2, c.station_m + c.length_m / 2)
             for c in road.crosswalks]  # fmt: skip
    found += [street.area(b.from_m, b.to_m, b.station_m - b.width_m / 2, b.station_m + b.width_m / 2)
              for b in road.stop_bars]  # fmt: skip
    # the end of a line far off may be a marking of its own
    found += [street.line(m.offset_m, m.start_m, m.end_m).buffer(m.width_m / 2) for m in road.markings]
    return shapely.union_all([f.buffer(0.1) for f in found])


def _nearest(some: pd.DataFrame, x: float, y: float) -> tuple[int, float]:
    """Row of the thing nearest to a place, and how far off; infinitely where there is none."""
    if not len(some):
        return -1, math.inf
    away = np.hypot(some.easting_m.to_numpy() - x, some.northing_m.to_numpy() - y)
    return int(np.argmin(away)), float(away.min())


def _samples(shape: shapely.Geometry) -> Any:
    """Points each 0.1 m along a line or an outline, seen from above."""
    flat = shapely.force_2d(shape)
    lines = flat.boundary if flat.geom_type.endswith("Polygon") and flat.area > 0.05 else flat
    if lines.geom_type.endswith("Polygon"):
        lines = shapely.LineString(shapely.get_coordinates(lines))
    parts = []
    for line in getattr(lines, "geoms", [lines]):
        if line.length > 0.0:
            steps = np.arange(_STEP_M / 2, line.length, _STEP_M)
            parts.append(shapely.line_interpolate_point(line, steps))
    return np.concatenate(parts) if parts else np.zeros(0, object)


def _share_near(shape: shapely.Geometry, target: shapely.Geometry, within_m: float) -> float:
    return _share_of(_samples(shape), target, within_m)


def _share_of(points: Any, target: shapely.Geometry, within_m: float) -> float:
    """Share of points that lie so near to a target."""
    if not points.size or target.is_empty:
        return 0.0
    shapely.prepare(target)
    return float(shapely.dwithin(points, target, within_m).mean())


def _share_within(shape: shapely.Geometry, target: shapely.Geometry) -> float:
    flat = shapely.make_valid(shapely.force_2d(shape))
    return float(flat.intersection(target).area / flat.area) if flat.area > 0.0 else 0.0


# --- figures -----------------------------------------------------------------------------------------


def figures_of(street: Street) -> Iterator[Figure]:
    """All figures of a street, beside the bars that were asked for."""
    yield from points_figures(street)
    yield from line_figures(street)
    yield from area_figures(street)
    yield from clearance_figures(street)
    yield from marking_figures(street)
    yield from ground_figures(street)


def points_figures(street: Street) -> Iterator[Figure]:
    """Recall and precision of what stands at a place, and how well it is measured."""
    truth = true_points(street)
    bars = {"sign": 0.98, "pole": 0.98, "tree": 0.90, "delineator": 0.90}
    for kind in POINTS:
        some, found = truth[kind], street.found(kind)
        if not len(some) and not len(found):
            continue
        right = [_nearest(some, g.x, g.y) for g in found.geometry]
        held = {k for k, away in right if away <= NEAR_M}
        if len(some):
            yield Figure(f"{kind}: recall of {len(some)}", len(held) / len(some), "", bars.get(kind))
        if len(found):
            share = sum(away <= NEAR_M for _, away in right) / len(found)
            yield Figure(f"{kind}: precision of {len(found)}", share, "", bars.get(kind))
        pairs = [(some.iloc[k], found.iloc[i]) for i, (k, away) in enumerate(right) if away <= NEAR_M]
        yield from _sizes(street, kind, pairs)


def _sizes(street: Street, kind: str, pairs: list[tuple[Any, Any]]) -> Iterator[Figure]:
    """How far off measures are, in the worst case and of signs and poles."""
    if not pairs:
        return
    if kind in ("pole", "lighting", "signal", "delineator"):
        away = [math.hypot(t.easting_m - f.geometry.x, t.northing_m - f.geometry.y) for t, f in pairs]
        yield Figure(f"{kind}: axis, worst", 1000 * max(away), "mm")
    if kind == "pole":
        wide = [abs(t.width_m - f.diameter_m) for t, f in pairs]
        yield Figure("pole: diameter, worst", 1000 * max(wide), "mm", 20.0)
    if kind == "sign":
        errors = list(_errors_of_signs(street, pairs))
        yield Figure("sign: centre, worst", 1000 * max(e.centre_m for e in errors), "mm", 30.0)
        yield Figure("sign: size, worst", 1000 * max(e.size_m for e in errors), "mm", 50.0)
        yield Figure("sign: facing, worst", max(e.facing_deg for e in errors), "°", 5.0)


class SignError(NamedTuple):
    """How far off a sign is measured."""

    centre_m: float
    size_m: float
    """The greater one of width and height."""
    facing_deg: float
    sigma_m: float
    """Stated σ of the size."""


def sign_errors(street: Street) -> list[SignError]:
    """Errors of the signs that stand where one was found."""
    some, found = true_points(street)["sign"], street.found("sign")
    right = [(_nearest(some, g.x, g.y), i) for i, g in enumerate(found.geometry)]
    return list(_errors_of_signs(street, [(some.iloc[k], found.iloc[i]) for (k, away), i in right if away <= NEAR_M]))


def _errors_of_signs(street: Street, pairs: list[tuple[Any, Any]]) -> Iterator[SignError]:
    """Of pairs of a thing of the truth and a sign that was found there."""
    described = {round(s.station_m, 2): s for s in _signs(street)}
    for thing, sign in pairs:
        one = described[round(thing.station_m, 2)]
        ahead = math.radians(thing.heading_deg - 90.0)
        side = 1.0 if one.faces == "forward" else -1.0
        tall = one.width_m * _HEIGHT_SHARE[one.shape] if one.shape in _HEIGHT_SHARE else one.height_m
        middle = (
            thing.easting_m + side * _PLATE_BEFORE_POST_M * math.sin(ahead),
            thing.northing_m + side * _PLATE_BEFORE_POST_M * math.cos(ahead),
            thing.height_m + one.clearance_m + tall / 2,
        )
        off = math.dist(middle, (sign.geometry.x, sign.geometry.y, sign.geometry.z))
        size = max(abs(sign.width_m - one.width_m), abs(sign.plate_height_m - tall))
        facing = math.degrees(ahead) + (0.0 if side > 0.0 else 180.0)
        turn = abs((sign.facing_deg - facing + 180.0) % 360.0 - 180.0)
        yield SignError(off, size, turn, float(sign.sigma_size_m))


def _signs(street: Street) -> list[Any]:
    out = []
    for sign in street.scene.roadside.signs:
        count = sign.count if sign.every_m > 0.0 else 1
        out += [sign.model_copy(update={"station_m": sign.station_m + n * sign.every_m}) for n in range(count)]
    return out


def line_figures(street: Street) -> Iterator[Figure]:
    """Share of each kind of line that is found, and share of what is found that lies on one."""
    bars = {"kerb": (0.97, 0.98), "guardrail": (0.95, 0.95), "facade": (0.95, 0.95), "fence": (0.90, 0.90)}
    solid = boxes(street)
    for kind, truth in true_lines(street).items():
        if truth.is_empty:
            continue
        found = street.tables.get(kind, geopandas.GeoDataFrame(geometry=[]))
        points = [_inside(street, _samples(g)) for g in found.geometry]
        every = np.concatenate([np.zeros(0, object), *points])
        if kind == "facade":
            every = every[~shapely.dwithin(every, solid, 0.4)] if not solid.is_empty else every
        lines = shapely.union_all([_as_line(g) for g in found.geometry])
        within, (full, right) = LINES[kind], bars.get(kind, (None, None))
        if kind != "lane_line":  # those of dashed lines lie between dashes too
            yield Figure(f"{kind}: within {within} m, found", _share_near(truth, lines, within), "", full)
        if kind == "kerb":
            places = _samples(truth)
            hit = _hit(street, shapely.get_coordinates(places))
            yield Figure(f"kerb: length that returns hit within {_HIT_M} m", float(hit.mean()), "")
            yield Figure(f"kerb: within {within} m, found where hit", _share_of(places[hit], lines, within), "", full)
        shapely.prepare(truth)
        if every.size:
            share = float(shapely.dwithin(every, truth, within).mean())
            yield Figure(f"{kind}: within {within} m, right", share, "", right)
        yield from _kerb_heights(street, found, truth) if kind == "kerb" else ()
        yield from _lane_lines(street, street.found(kind)) if kind == "lane_line" else ()
    for kind in NONE_THERE:
        table = street.found(kind)
        false = sum(_share_near(g, solid, 0.3) < 0.5 for g in table.geometry)
        yield Figure(f"{kind}: false ones", float(false), "")
    for kind, places in true_spots(street).items():
        shapes = shapely.force_2d(street.found(kind).geometry.to_numpy())
        false = sum(_share_of(_samples(g) if g.length else np.array([g]), places, NEAR_M) < 0.5 for g in shapes)
        yield Figure(f"{kind}: false ones of {len(shapes)}", float(false), "")


def _hit(street: Street, places_m: Float64) -> npt.NDArray[np.bool_]:
    """Which places (n, 2) have a return on the ground near: what no return hits, no method can see."""
    parts = [np.zeros((0, 2))]
    for x, y, z, _ in _classified(street):
        on_ground = np.abs(z - street.surface.height_m(x, y, texture=False)) <= 0.1
        parts.append(np.column_stack([x, y])[on_ground])
    near = scipy.spatial.cKDTree(np.concatenate(parts)).query(places_m, distance_upper_bound=_HIT_M)[0]
    return np.asarray(np.isfinite(near))


def _grid_within(area: shapely.Geometry, every_m: float = 0.1) -> Float64:
    """Places (n, 2) at even distances within an area."""
    west, south, east, north = area.bounds
    x, y = (v.ravel() for v in np.meshgrid(np.arange(west, east, every_m), np.arange(south, north, every_m)))
    return np.column_stack([x, y])[shapely.contains_xy(area, x, y)]


def _classified(street: Street) -> Iterator[tuple[Float64, Float64, Float64, npt.NDArray[np.uint8]]]:
    """Place (m) and class of the returns of each square."""
    for path in street.session.store.files("products/classified_points", ".laz"):
        with laspy.open(street.session.store.path(path)) as reader:
            las = reader.read()
        x, y, z = (np.asarray(v) * u for v, u in zip((las.x, las.y, las.z), street.units_m, strict=True))
        yield x, y, z, np.asarray(las.classification)


def _as_line(shape: shapely.Geometry) -> shapely.Geometry:
    flat = shapely.force_2d(shape)
    return shapely.LineString(shapely.get_coordinates(flat)) if flat.geom_type == "Polygon" else flat


def _inside(street: Street, points: Any) -> Any:
    """Points between the ends of what is judged."""
    if not points.size:
        return points
    station, _ = street.along(shapely.get_x(points), shapely.get_y(points))
    return points[(station >= street.ends_m[0]) & (station <= street.ends_m[1])]


def _kerb_heights(street: Street, found: geopandas.GeoDataFrame, truth: shapely.Geometry) -> Iterator[Figure]:
    """Height of kerbs that are kerbs, and not dropped: greatest error of 95 % of their length."""
    full = {"left": 0.0, "right": 0.0} | {k.side: k.height_m for k in street.scene.road.kerbs}
    off, length = [], []
    for one in found[found["type"] != "dropped"].itertuples():
        if _share_near(one.geometry, truth, 0.15) < 0.5:
            continue
        _, offset = street.along(one.easting_m, one.northing_m)
        off.append(abs(one.step_m - full["left" if float(offset) < 0.0 else "right"]))
        length.append(one.length_m)
    if off:
        order = np.argsort(off)
        below = int((np.cumsum(np.array(length)[order]) <= 0.95 * sum(length)).sum())
        worst = off[order[min(below, len(off) - 1)]]
        yield Figure("kerb: height, 95 % of the length", 1000 * worst, "mm", 8.0)


def _lane_lines(street: Street, found: geopandas.GeoDataFrame) -> Iterator[Figure]:
    """Width and type of lane lines, by length."""
    off, typed, length = [], [], []
    for one in found.itertuples():
        coordinates = shapely.get_coordinates(one.geometry)
        station, offset = street.along(*coordinates.T)
        middle = float(np.median(station))
        lines = [m for m in street.scene.road.markings if m.start_m <= middle <= m.end_m]
        near = [m for m in lines if abs(m.offset_m - float(np.median(offset))) <= 0.15]
        if near:
            off.append(abs(one.width_m - near[0].width_m))
            typed.append(one.type == ("dashed" if near[0].dash_m > 0.0 else "solid"))
            length.append(one.length_m)
    if length:
        total = np.array(length)
        yield Figure("lane_line: width, worst", 1000 * max(off), "mm", 10.0)
        yield Figure("lane_line: type right, by length", float(total @ np.array(typed) / total.sum()), "", 0.98)


def area_figures(street: Street) -> Iterator[Figure]:
    """Share of sidewalks and landscape areas that is found, and share of what is found that is one."""
    judged_on = true_areas(street)
    beyond = street.area(-60.0, 60.0, -math.inf, math.inf)
    for kind, truth in judged_on.items():
        if truth.is_empty:
            continue
        table = street.tables.get(kind, geopandas.GeoDataFrame(geometry=[]))
        found = shapely.union_all([shapely.make_valid(shapely.force_2d(g)) for g in table.geometry])
        # where no façade or fence ends a sidewalk, nobody says how wide it is
        region = _beside_walls(street) if kind == "sidewalk" else beyond
        found = found.intersection(region)
        both = found.intersection(truth).area
        yield Figure(f"{kind}: area found", both / truth.area, "", 0.90)
        if kind == "sidewalk":
            places = _grid_within(truth)
            hit = _hit(street, places)
            held = shapely.contains_xy(found, places[hit, 0], places[hit, 1])
            yield Figure(f"sidewalk: area that returns hit within {_HIT_M} m", float(hit.mean()), "")
            yield Figure("sidewalk: area found where hit", float(held.mean()), "", 0.90)
        if found.area > 0.0:
            yield Figure(f"{kind}: area right", both / found.area, "", 0.90)


def _beside_walls(street: Street) -> shapely.Geometry:
    side = street.scene.roadside
    parts = [
        street.area(0.0, math.copysign(30.0, w.offset_m), w.start_m, w.end_m) for w in (*side.facades, *side.fences)
    ]
    return shapely.union_all(parts)


def clearance_figures(street: Street) -> Iterator[Figure]:
    """Height of the lowest places under slabs."""
    found = street.found("clearance")
    off = []
    slabs = [o for o in street.scene.roadside.overheads if street.ends_m[0] <= o.station_m <= street.ends_m[1]]
    seen = 0
    for slab in slabs:
        east, north, _ = (float(v) for v in street.surface.place(slab.station_m, slab.offset_m))
        under = float(street.surface.height_m(east, north, texture=False)) + slab.clearance_m
        outline = street.area(
            slab.offset_m - slab.width_m / 2, slab.offset_m + slab.width_m / 2,
            slab.station_m - slab.length_m / 2 - 0.3, slab.station_m + slab.length_m / 2 + 0.3,
        )  # fmt: skip
        own = [g.z - under for g in found.geometry if outline.contains(shapely.Point(g.x, g.y))]
        seen += bool(own)
        off += own
    if slabs:
        yield Figure(f"clearance: slabs found of {len(slabs)}", seen / len(slabs), "")
    if off:
        yield Figure("clearance: height, worst", 1000 * max(map(abs, off)), "mm", 30.0)


def marking_figures(street: Street) -> Iterator[Figure]:
    """F1 of cells of 0.1 m; a cell is paint where half of its returns are, in truth and as found."""
    both = told = true = 0
    for every_x, every_y, every_z, code in _classified(street):
        kept = np.isin(code, (classes.GROUND, classes.ROAD, classes.MARKING, classes.KERB, classes.SIDEWALK))
        station, offset = street.along(every_x, every_y)
        kept &= (station >= street.ends_m[0]) & (station <= street.ends_m[1])
        kept &= np.abs(offset) <= street.scene.road.paved_m
        kept[kept] = np.abs(every_z[kept] - street.surface.height_m(every_x[kept], every_y[kept], texture=False)) <= 0.1
        if not kept.any():
            continue
        x, y, marked = every_x[kept], every_y[kept], code[kept] == classes.MARKING
        painted = street.surface.intensity(x, y) > _PAINT_FROM
        place = np.floor(np.stack([x - x.min(), y - y.min()]) / _CELL_M).astype(np.int64)
        _, cell = np.unique(place[0] * 1_000_000 + place[1], return_inverse=True)
        count = np.bincount(cell)
        truth, found = (np.bincount(cell, weights=v) >= count / 2 for v in (painted, marked))
        both, told, true = both + int((truth & found).sum()), told + int(found.sum()), true + int(truth.sum())
    if told + true:
        yield Figure("markings: F1 of cells of 0.1 m", 2 * both / (told + true), "", 0.95)


def ground_figures(street: Street) -> Iterator[Figure]:
    """Root mean square error of bare earth where the ground was seen."""
    road = street.scene.road
    beds = true_areas(street)["landscape_area"]
    off: dict[str, list[Float64]] = {"on the road": [], "beside it": [], "under plants": []}
    for path in street.session.store.files("products/bare_earth", ".tif"):
        with rasterio.open(street.session.store.path(path)) as raster:
            seen = raster.read(1) * street.units_m[2]
            rows, columns = np.nonzero(np.isfinite(seen))
            x, y = (np.asarray(v) * street.units_m[0] for v in rasterio.transform.xy(raster.transform, rows, columns))
        if not x.size:
            continue
        station, offset = street.along(x, y)
        away, error = np.abs(offset), seen[rows, columns] - street.surface.height_m(x, y, texture=False)
        inside = (station >= street.ends_m[0]) & (station <= street.ends_m[1]) & np.isfinite(error)
        planted = shapely.contains_xy(beds, x, y) if not beds.is_empty else np.zeros(x.size, np.bool_)
        off["on the road"].append(error[inside & (away <= road.paved_m - 0.2)])
        beside = inside & (away >= road.paved_m + 0.2) & (away <= road.edge_m - 0.1)
        off["beside it"].append(error[beside & ~planted])
        off["under plants"].append(error[beside & planted])
    for where, bar in (("on the road", 8.0), ("beside it", 15.0), ("under plants", None)):
        errors = np.concatenate(off[where]) if off[where] else np.zeros(0)
        if errors.size:
            yield Figure(f"bare earth: RMSE {where}", 1000 * float(np.sqrt(np.mean(errors**2))), "mm", bar)


def calibration_error(objects: list[Judged], bins: int = 10) -> float:
    """Expected calibration error: mean distance of stated probability and share that is right, over even bins."""
    return error_of_stated(np.array([o.probability for o in objects]), np.array([o.is_right for o in objects]), bins)


def error_of_stated(stated: Float64, right: npt.NDArray[Any], bins: int = 10) -> float:
    """The same of stated probabilities (n,) and what is right of each (n,)."""
    number = np.minimum((stated * bins).astype(int), bins - 1)
    bins_held = [number == b for b in np.unique(number)]
    return float(sum(abs(stated[b].mean() - right[b].mean()) * b.mean() for b in bins_held))


def errors_of_exact(stated: Float64, draws: int = 4000) -> Float64:
    """Calibration errors (draws,) that things with these probabilities (n,) show, each being right with just its own.

    What is right in part, such as a kerb, is drawn as right or wrong: that is the most that chance can add.
    """
    return np.array(
        [error_of_stated(stated, one < stated) for one in np.random.default_rng(1).random((draws, len(stated)))]
    )
