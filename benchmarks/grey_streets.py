"""Streets of asphalt with flush sidewalks in sharp shadows, drawn at random, and streets without any edge."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Final, NamedTuple

import geopandas
import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.lawn_streets import lawn_street, spoil
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]

LENGTH_M: Final = 60.0
_END_M: Final = 6.0  # What lies so near to an end is not judged (m).
_PIECE_M: Final = 1.0  # What is drawn along the road is drawn in pieces of this length (m).
_SLAB_M: Final = 0.5  # Distance of joints between slabs (m).


class Greys(NamedTuple):
    """What a street is drawn with beside its scene."""

    walk_m: float
    """Width of the sidewalk; infinite where it goes on as far as the ground does."""
    tint: Float64
    """(3,) brightness of the sidewalk in pictures over that of the simulator, red to blue in linear light."""
    slabs: bool
    """Whether it has joints."""


def greys_of(seed: int) -> Greys:
    """Returns what a street is drawn with."""
    random = np.random.default_rng([seed, 11])
    walk = float(random.choice([random.uniform(1.6, 3.0), np.inf], p=[0.75, 0.25]))
    tint = random.uniform(0.75, 1.3) * (1.0 + random.uniform(-0.03, 0.03, 3))
    return Greys(walk, tint, bool(random.random() < 0.6))


def grey_street(seed: int, model: str, edge: bool = True) -> Scene:
    """A street of 60 m, driven once. Without an edge one pavement goes on beside the road as far as the ground does.

    What is behind a sidewalk is a façade, a lawn or nothing. Its intensity differs by 15 to 60 % from that of asphalt.
    Half of the streets have other asphalt on the lane that is not driven.
    """
    plain, greys = lawn_street(seed), greys_of(seed)
    random = np.random.default_rng([seed, 12])
    between = random.uniform
    road = plain.road.model_dump()
    half, paved, asphalt = plain.road.lane_width_m, plain.road.paved_m, road["brightness"]["asphalt"]
    ratio = float(random.choice([between(0.65, 0.85), between(1.2, 1.6)]))
    walk = asphalt * ratio if edge else asphalt
    kerb = float(random.choice([0.0, between(0.005, 0.012)]))
    lawn = bool(random.random() < 0.35) and np.isfinite(greys.walk_m)
    side = [-1.0, 1.0]
    road["brightness"] |= {"verge": walk, "kerb": float(between(min(asphalt, walk), max(asphalt, walk)))}
    road["kerbs"] = [{"side": s, "height_m": kerb} for s in ("left", "right")] if kerb and edge else []
    road |= {"verge_width_m": 8.0, "verge_slope": float(between(0.02, 0.03)), "shoulder_slope": 0.025}
    road["grass"] = {"height_m": 0.02, "from_m": greys.walk_m, "shade": asphalt + 4.0} if lawn and edge else None
    road["markings"] = [
        {"offset_m": 0.0, "width_m": 0.12, "dash_m": 3.0, "gap_m": 4.0, "worn": 0.3},
        *({"offset_m": s * (half - 0.1), "width_m": 0.12, "worn": float(between(0.3, 0.6))} for s in side),
    ]
    lane = {"station_m": LENGTH_M / 2, "offset_m": -half / 2, "length_m": 2.0 * LENGTH_M, "width_m": half,
            "height_m": 0.0005, "edge_m": 0.01, "shade": float(asphalt * random.choice([0.8, 1.2]))}  # fmt: skip
    other_lane = bool(random.random() < 0.5)
    road["patches"] = [lane] * other_lane + [
        {"station_m": float(between(10, 50)), "offset_m": float(random.choice(side) * between(0.8, paved - 0.5)),
         "length_m": long, "width_m": wide, "height_m": 0.002, "edge_m": 0.01, "shade": float(asphalt * share)}
        for long, wide, share in ((16.0, 0.8, 0.75), (5.0, 1.4, 1.35), (12.0, 2.2, 0.6), (20.0, 0.5, 1.3))
    ]  # fmt: skip
    seams = []
    for shade in (26.0, 30.0, asphalt * 1.3):
        at, off = float(between(5, 20)), float(random.choice(side) * between(0.4, paved + 0.8))
        corners = [(at + 6.0 * k, off + float(between(-0.05, 0.05))) for k in range(6)]
        seams.append({"points_m": corners, "width_m": float(between(0.05, 0.12)), "shade": float(shade)})
    road["tyre_marks"] = seams
    road["stains"] = [  # wet places
        {"station_m": float(between(5, 55)), "offset_m": float(random.choice(side) * between(0, paved + 1)),
         "length_m": float(between(2, 7)), "width_m": float(between(0.5, 2)), "shade": float(asphalt * 0.55)}
        for _ in range(4)
    ]  # fmt: skip
    roadside: dict[str, Any] = {
        "parked_cars": [{"station_m": float(between(24, 34)), "offset_m": float(random.choice(side)) * (paved - 0.9)}],
        "trees": [],
    }
    if np.isfinite(greys.walk_m) and not lawn and edge:
        roadside["facades"] = [
            {"offset_m": s * (paved + greys.walk_m), "start_m": 3.0, "end_m": LENGTH_M - 3.0, "height_m": 7.0}
            for s in side
        ]
    lidar = plain.lidar.model_dump() | {"model": model}
    noise = plain.noise.model_dump() | {"intensity": float(between(6, 14))}
    return plain.changed(
        id=f"grey-{seed}-{model.lower()}{'' if edge else '-none'}", length_m=LENGTH_M, road=road, lidar=lidar,
        bag={"on": model == "VLP-16", "trajectory": model == "VLP-16"},
        noise=noise, passes=[{"lane": 2}], vehicle={"speed_m_per_s": float(between(9, 14))}, roadside=roadside,
    )  # fmt: skip


def drawn(seed: int, model: str, folder: Path, edge: bool = True) -> Path:
    """Simulate a street into a folder, with shadows along it in all pictures; its survey file."""
    file = folder / "SURVEY.toml"
    if not file.exists():
        simulate(grey_street(seed, model, edge), folder)
        shade(folder, seed, edge)
    return file


def shade(folder: Path, seed: int, edge: bool) -> None:
    """Draw the colour of the sidewalks, their joints and long shadows of walls with sharp edges into all pictures."""
    known, random, greys = truth.load(folder), np.random.default_rng([seed, 13]), greys_of(seed)
    surface, paved, length = known.surface, known.scene.road.paved_m, known.scene.length_m
    tinted: list[tuple[list[Float64], Float64]] = []
    if edge:
        wide = min(greys.walk_m, 8.0)
        for side in (-1.0, 1.0):
            tinted.append((_along(surface, 0.0, length, side * paved, side * (paved + wide)), greys.tint))
            if greys.slabs:
                joints = [_bar(surface, at, at + 0.012, side * paved, side * (paved + wide))
                          for at in np.arange(0.0, length, _SLAB_M)]  # fmt: skip
                for off in np.arange(_SLAB_M, wide, _SLAB_M):
                    joints += _along(surface, 0.0, length, side * (paved + off), side * (paved + off + 0.012))
                tinted.append((joints, np.full(3, 0.5)))
    shadows = []
    for side in (-1.0, 1.0):  # of walls and rows of houses: edges along the road, near its own edge and within the lane
        begin = 0.0
        while begin < length:
            end = begin + random.uniform(8.0, 25.0)
            inner = paved + random.choice([random.uniform(-1.6, -0.4), random.uniform(-0.3, 0.4),
                                           random.uniform(0.4, 1.5)])  # fmt: skip
            outer = inner + random.choice([8.0, random.uniform(0.5, 2.0)])
            if random.random() < 0.75:
                shadows += _along(surface, begin, min(end, length), side * inner, side * outer)
            begin = end + random.uniform(0.0, 6.0)
    spoil(folder, seed, shadows, blur_px=0.5, tinted=tinted)


def _along(surface: Surface, begin: float, end: float, inner: float, outer: float) -> list[Float64]:
    """Outlines (n, 3) of a strip along the road, piece by piece: one that is partly behind a camera is not drawn."""
    at = np.linspace(begin, end, max(round((end - begin) / _PIECE_M), 1) + 1)
    return [_bar(surface, a, b, inner, outer) for a, b in itertools.pairwise(at)]


def _bar(surface: Surface, begin: float, end: float, inner: float, outer: float) -> Float64:
    s, o = np.array([begin, end, end, begin]), np.array([inner, inner, outer, outer])
    return np.column_stack(surface.place(s, o))


class Found(NamedTuple):
    """How well the edges of a street's carriageway were found."""

    true_m: float
    """Length of its edges; 0 on a street without."""
    near: tuple[float, float]
    """Share of it that has a found edge within 0.15 m, and within 0.3 m."""
    length_m: float
    """Length of the edges found, of those more than 1.5 m beyond true ones or any at walls too."""
    right: float
    """Share of it within 0.3 m of a true one; NaN where there is none."""
    errors_m: Float64
    """(n,) errors of those within 0.5 m, outwards, each quarter of a metre."""
    sigmas_m: Float64
    by_type_m: dict[str, float]
    """Length by what makes the edge."""


def score(folder: Path, survey_file: Path, edge: bool = True) -> Found:
    """Returns how well the road edges of a survey hold against the truth in a folder."""
    known, store = truth.load(folder), Session.open(survey_file).store
    edges = geopandas.read_parquet(store.path("products/assets/road_edges.parquet"))
    surface, paved = known.surface, known.scene.road.paved_m
    places, sigma, types = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, object)]
    for shape, own, name in zip(edges.geometry, edges["sigma_horizontal_m"], edges["type"], strict=True):
        points = shapely.get_coordinates(shapely.segmentize(shape, 0.05))
        at = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
        every = np.arange(0.0, at[-1], 0.25)
        places.append(np.column_stack([np.interp(every, at, points[:, k]) for k in (0, 1)]))
        sigma.append(np.full(every.size, float(own)))
        types.append(np.full(every.size, str(name), object))
    place, sigmas, what = np.concatenate(places), np.concatenate(sigma), np.concatenate(types)
    s, o = surface.station_offset_m(place[:, 0], place[:, 1])
    judged = (s >= _END_M) & (s <= known.scene.length_m - _END_M)
    s, o, sigmas, what = s[judged], o[judged], sigmas[judged], what[judged]
    error = np.abs(o) - paved if edge else np.full(o.size, np.inf)
    station = np.arange(_END_M, known.scene.length_m - _END_M, 0.25)
    shares = []
    for limit in (0.15, 0.3):
        hit = [np.abs(s[(np.sign(o) == side) & (np.abs(error) <= limit), None] - station).min(axis=0, initial=9.0) < 0.2
               for side in (-1.0, 1.0)]  # fmt: skip
        shares.append(float(np.mean(hit)) if edge else float("nan"))
    own_error = np.abs(error) <= 0.5
    return Found(
        2.0 * 0.25 * station.size if edge else 0.0, (shares[0], shares[1]), 0.25 * o.size,
        float(np.mean(np.abs(error) <= 0.3)) if o.size else float("nan"), error[own_error], sigmas[own_error],
        {str(name): 0.25 * float(np.count_nonzero(what == name)) for name in np.unique(what.astype(str))},
    )  # fmt: skip
