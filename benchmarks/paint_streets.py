"""Streets with lines, bars, crossings and arrows, and with what looks like paint to a camera, drawn at random."""

from __future__ import annotations

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


def paint_street(seed: int, model: str, intensity_noise: float = 6.0) -> Scene:
    """A street of 60 m, driven once, with paint, light patches of asphalt, tar seams and wet places.

    intensity_noise : 1 σ of a return's intensity; that of asphalt is 60 to 95.
    """
    plain = lawn_street(seed)
    random = np.random.default_rng([seed, 7])
    between = random.uniform
    road = plain.road.model_dump()
    half, paved = plain.road.lane_width_m, plain.road.paved_m
    asphalt = road["brightness"]["asphalt"]
    worn = [float(between(0.1, 0.5)) for _ in range(3)]
    width = [float(between(0.10, 0.20)) for _ in range(3)]
    stop = float(between(40, 50))
    road["markings"] = [
        {"offset_m": 0.0, "width_m": width[0], "dash_m": 3.0, "gap_m": float(between(3, 6)), "worn": worn[0]},
        {
            "offset_m": half - 0.15,
            "width_m": width[1],
            "worn": worn[1],
            "colour": str(random.choice(["white", "yellow"])),
        },
        {"offset_m": -half + 0.15, "width_m": width[2], "worn": worn[2]},
    ]
    road["stop_bars"] = [{"station_m": stop, "from_m": 0.3, "to_m": half - 0.4, "worn": 0.2}]
    road["crosswalks"] = [{"station_m": stop - 24.0, "from_m": -half + 0.5, "to_m": half - 0.5, "worn": 0.2}]
    road["symbols"] = [{"station_m": stop - 6.0, "offset_m": half / 2, "shape": "ahead", "worn": 0.2}]
    side = [-1.0, 1.0]
    road["patches"] = [
        {"station_m": float(between(8, 52)), "offset_m": float(random.choice(side) * between(0.8, half - 0.7)),
         "length_m": float(between(1.5, 6)), "width_m": float(between(0.3, 1.2)), "height_m": 0.002, "edge_m": 0.01,
         "shade": float(asphalt * share)}
        for share in (1.35, 1.6, 0.6, 1.3)
    ]  # fmt: skip
    seams = []
    for shade in (26.0, 30.0, asphalt * 1.3):
        at, off = float(between(5, 20)), float(random.choice(side) * between(0.4, half - 0.4))
        corners = [(at + 6.0 * k, off + float(between(-0.05, 0.05))) for k in range(5)]
        seams.append({"points_m": corners, "width_m": float(between(0.05, 0.12)), "shade": float(shade)})
    road["tyre_marks"] = seams
    road["stains"] = [  # wet places
        {"station_m": float(between(5, 55)), "offset_m": float(between(-half, half)),
         "length_m": float(between(1, 5)), "width_m": float(between(0.5, 2)), "shade": float(asphalt * 0.55)}
        for _ in range(3)
    ]  # fmt: skip
    road["grass"] = None
    lidar = plain.lidar.model_dump() | {"model": model}
    camera = plain.camera.model_dump() | {"every_m": 2.5}
    return plain.changed(
        id=f"paint-{seed}-{model.lower()}", length_m=LENGTH_M, road=road, lidar=lidar, camera=camera,
        bag={"on": model == "VLP-16", "trajectory": model == "VLP-16"},
        noise=plain.noise.model_dump() | {"intensity": intensity_noise},
        passes=[{"lane": 2}], vehicle={"speed_m_per_s": float(between(15, 22))},
        roadside={"parked_cars": [{"station_m": float(between(24, 34)), "offset_m": paved + 0.5}],
                  "trees": [{"station_m": float(between(5, 35)), "offset_m": paved + 3.0, "height_m": 7.0}]},
    )  # fmt: skip


def drawn(seed: int, model: str, folder: Path) -> Path:
    """Simulate a street into a folder, with sharp shadows on the ground and dirt on the lens; its survey file."""
    file = folder / "SURVEY.toml"
    if not file.exists():
        simulate(paint_street(seed, model), folder)
        random, known = np.random.default_rng([seed, 2]), truth.load(folder)
        spoil(folder, seed, cast_shadows(random, known.surface), blur_px=0.4)
    return file


def cast_shadows(random: np.random.Generator, surface: Surface) -> list[Float64]:
    """Outlines (n, 3) on the ground: posts, and walls between which a strip of light of a line's width is left."""
    between, out = random.uniform, []
    for _ in range(4):  # posts, across and along
        at, off, turn = between(5, 55), between(-4, 4), between(-0.3, 0.3) + random.choice([0.0, np.pi / 2])
        out.append(_bar(surface, at, off, turn, between(3, 6), between(0.08, 0.3)))
    for _ in range(2):
        at, off, turn, gap = between(10, 50), between(-2.5, 2.5), between(-0.1, 0.1), between(0.1, 0.3)
        wide = between(0.6, 1.5)
        out += [_bar(surface, at, off + side * (wide + gap) / 2, turn, 6.0, wide) for side in (-1.0, 1.0)]
    return out


def _bar(surface: Surface, at: float, off: float, turn: float, length: float, width: float) -> Float64:
    s = np.concatenate([np.linspace(-1, 1, 12), np.linspace(1, -1, 12)]) * length / 2
    o = np.repeat([-1.0, 1.0], 12) * width / 2
    cos, sin = np.cos(turn), np.sin(turn)
    return np.column_stack(surface.place(at + s * cos - o * sin, off + s * sin + o * cos))


class Found(NamedTuple):
    """How well paint was found on a street."""

    line_m: float
    """True length of the paint of lane lines, without the gaps of dashed ones."""
    found: float
    """Share of it beside which a lane line was found within 0.1 m."""
    pattern: float
    """Share of it that belongs to a line of the right pattern, solid or dashed."""
    right: float
    """Share of the found lines' length that lies within 0.1 m of a true one; NaN where none is found."""
    pieces: int
    """Number of lines of which most lies on true ones."""
    marking_f1: float
    """F1 of cells of 0.1 m of all paint, gaps of dashed lines among them."""
    other_f1: float
    """The same of what is no line."""
    aside_m: Float64
    """(n,) offsets of found lines, each 0.5 m."""
    aside_sigma_m: Float64
    width_error_m: Float64
    """(k,) errors of the widths of the lines that are right."""
    width_sigma_m: Float64


def score(folder: Path, survey_file: Path) -> Found:
    """Returns how well the products of a survey hold against the truth in a folder."""
    known, store = truth.load(folder), Session.open(survey_file).store
    lines, others = (
        geopandas.read_parquet(store.path(f"products/assets/{name}.parquet"))
        for name in ("lane_lines", "road_markings")
    )
    surface, road = known.surface, known.scene.road
    ends = _END_M, known.scene.length_m - _END_M

    def line(offset: float) -> shapely.Geometry:
        at = np.arange(*ends, 0.25)
        east, north, _ = surface.place(at, np.full(at.size, offset))
        return shapely.LineString(np.column_stack([east, north]))

    merged = shapely.union_all([line(m.offset_m) for m in road.markings])
    shapes = shapely.force_2d(lines.geometry.to_numpy())
    whole = shapely.union_all(shapes) if len(shapes) else shapely.LineString()
    painted = [_painted_places(known.scene, surface, m.offset_m, ends) for m in road.markings]
    at = np.concatenate(painted)
    is_right = np.concatenate([
        _within(points, shapely.buffer(shapes[lines["type"] == ("dashed" if m.dash_m else "solid")], 0.1))
        for points, m in zip(painted, road.markings, strict=True)
    ])  # fmt: skip
    places = shapely.union_all(at)
    found = shapely.distance(at, whole) <= 0.1 if len(shapes) else np.zeros(at.size, np.bool_)
    right, total, aside, aside_sigma, width_error, width_sigma = 0, 0, [], [], [], []
    for k, shape in enumerate(shapes):
        points = shapely.line_interpolate_point(shape, np.arange(0.05, shape.length, 0.1))
        xy = shapely.get_coordinates(points)
        station, offset = surface.station_offset_m(xy[:, 0], xy[:, 1])
        inside = (station >= ends[0]) & (station <= ends[1])
        if not inside.any():
            continue
        near = shapely.distance(points[inside], merged) <= 0.1
        right, total = right + int(near.sum()), total + near.size
        if near.mean() >= 0.7:
            own = int(np.argmin([abs(float(np.median(offset[inside])) - m.offset_m) for m in road.markings]))
            on_paint = near & (shapely.distance(points[inside], places) <= 0.15)
            aside += (offset[inside][on_paint] - road.markings[own].offset_m)[::5].tolist()
            aside_sigma += [float(lines["sigma_horizontal_m"].iloc[k])] * len(near[on_paint][::5])
            width_error.append(float(lines["width_m"].iloc[k]) - road.markings[own].width_m)
            width_sigma.append(float(lines["sigma_size_m"].iloc[k]))
    is_line, is_other = _painted(known.scene, surface, ends)
    off = _cells(surface, ends, road.paved_m)
    flat = shapely.points(off[:, 0], off[:, 1])
    drawn_lines = [shapely.buffer(g, w / 2, cap_style="flat") for g, w in zip(shapes, lines["width_m"], strict=True)]
    told_other = _within(flat, shapely.force_2d(others.geometry.to_numpy()))
    told = told_other | _within(flat, np.array(drawn_lines, dtype=object))
    return Found(
        0.1 * at.size, float(found.mean()), float(is_right.mean()), right / total if total else float("nan"),
        len(width_error),
        _f1(is_line | is_other, told), _f1(is_other, told_other), np.array(aside), np.array(aside_sigma),
        np.array(width_error), np.array(width_sigma),
    )  # fmt: skip


def _painted_places(scene: Scene, surface: Surface, offset: float, ends: tuple[float, float]) -> Any:
    """Returns places each 0.1 m of a line's middle around which a fifth of a metre or more is painted of one."""
    at = np.arange(ends[0] - 0.5, ends[1] + 0.5, 0.01)
    east, north, _ = surface.place(at, np.full(at.size, offset))
    light = surface.intensity(east, north) > 0.5 * (scene.road.brightness.asphalt + scene.road.brightness.marking)
    share = np.convolve(light, np.full(60, 1 / 60), mode="same")
    used = (share >= 0.2) & (at >= ends[0]) & (at < ends[1])
    used &= np.arange(at.size) % 10 == 0
    return shapely.points(east[used], north[used])


def _f1(true: npt.NDArray[np.bool_], told: npt.NDArray[np.bool_]) -> float:
    return float(2 * (true & told).sum() / max(true.sum() + told.sum(), 1))


def _grid(ends: tuple[float, float], half: float) -> tuple[Float64, Float64]:
    s, o = np.meshgrid(np.arange(*ends, 0.1), np.arange(-half, half, 0.1), indexing="ij")
    return s.ravel(), o.ravel()


def _cells(surface: Surface, ends: tuple[float, float], half: float) -> Float64:
    east, north, _ = surface.place(*_grid(ends, half))
    return np.column_stack([east, north])


def _within(points: Any, shapes: Any) -> npt.NDArray[np.bool_]:
    out = np.zeros(len(points), np.bool_)
    if len(shapes):
        out[np.unique(shapely.STRtree(shapes).query(points, predicate="intersects")[0])] = True
    return out


def _painted(scene: Scene, surface: Surface, ends: tuple[float, float]) -> tuple[Any, Any]:
    """Returns masks of cells that are a line, gaps of dashes among them, and that are other paint (by brightness)."""
    road = scene.road
    s, o = _grid(ends, road.paved_m)
    is_line = np.zeros(s.size, np.bool_)
    for one in road.markings:
        is_line |= np.abs(o - one.offset_m) <= one.width_m / 2
    is_other = np.zeros(s.size, np.bool_)
    for bar in road.stop_bars:
        is_other |= (np.abs(s - bar.station_m) <= bar.width_m / 2) & (o >= bar.from_m) & (o <= bar.to_m)
    for walk in road.crosswalks:  # products outline a crossing as a whole
        is_other |= (np.abs(s - walk.station_m) <= walk.length_m / 2) & (o >= walk.from_m) & (o <= walk.to_m)
    for symbol in road.symbols:
        near = (np.abs(s - symbol.station_m) <= symbol.length_m / 2) & (
            np.abs(o - symbol.offset_m) <= symbol.width_m / 2
        )
        east, north, _ = surface.place(s[near], o[near])
        is_other[np.flatnonzero(near)] |= surface.intensity(east, north) > 130.0
    return is_line & ~is_other, is_other
