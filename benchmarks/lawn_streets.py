"""Streets whose lawns are flush with the pavement and as bright to a lidar, with cameras on them, drawn at random."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import geopandas
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import shapely
from scipy.spatial.transform import Rotation

from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]

_SHADE: Final = np.array([0.24, 0.27, 0.33])
"""Share of the light, red to blue, that is left in the shade: that of the sky."""
_DIRT_PX: Final = (8, 30)  # Least and greatest radius of dirt on the lens (pixels).
_SETTINGS: Final = {"returns alone": "[assets.pictures]\non = false\n", "with pictures": ""}


def with_and_without_pictures(survey: Path, folder: Path, asset_settings: str = "") -> Iterator[tuple[str, Path]]:
    """Copy a survey twice into a folder, once told to leave out its pictures, and name each copy's survey file."""
    text = survey.read_text()
    for name, settings in _SETTINGS.items():
        copy = folder / f"{survey.parent.name} {name}"
        shutil.copytree(survey.parent, copy)
        file = copy / "SURVEY.toml"
        file.write_text(f"{text}\n[assets]\n{asset_settings}{settings}")
        yield name, file


def lawn_street(seed: int) -> Scene:
    """A street of 40 m with mown grass on both sides, without kerbs."""
    random = np.random.default_rng(seed)
    between = random.uniform
    asphalt = float(between(60, 95))
    half, beside = float(between(2.8, 3.4)), float(between(0.2, 1.5))
    walk = float(random.choice([0.0, between(1.0, 1.8)]))
    edge = half + beside + walk
    kerbs = [{"side": side, "height_m": float(between(0.06, 0.12))} for side in ("left", "right")] if walk else []
    road: dict[str, Any] = {
        "alignment": [{"kind": "arc", "length_m": 300.0, "radius_m": float(random.choice([-1, 1]) * between(80, 300))}],
        "lanes": 2, "lane_width_m": half, "shoulder_width_m": beside, "shoulder_slope": 0.025,
        "verge_width_m": walk + 8.0, "verge_slope": float(between(0.02, 0.035 if walk else 0.11)), "cross_slope": 0.025,
        "grade": float(between(-0.03, 0.03)), "roughness": {"iso_class": "B"}, "waves": [],
        "potholes": [], "cracks": [], "ruts": [], "kerbs": kerbs,
        "grass": {"height_m": float(between(0.012, 0.025)), "from_m": walk, "shade": asphalt + float(between(-6, 6))},
        "brightness": {"asphalt": asphalt, "shoulder": asphalt, "verge": asphalt, "kerb": 100.0, "marking": 170.0},
        "markings": [
            {"offset_m": 0.0, "width_m": 0.12, "dash_m": 3.0, "gap_m": 3.0, "worn": 0.3},
            {"offset_m": half - 0.1, "width_m": 0.12, "worn": 0.3, "colour": "yellow"},
            {"offset_m": -half + 0.7, "width_m": 1.2, "start_m": 8.0, "end_m": 22.0, "worn": 0.3, "colour": "green"},
        ],
        "patches": [{"station_m": float(between(8, 30)), "offset_m": 1.2, "length_m": 4.0, "width_m": 1.5,
                     "height_m": 0.002, "edge_m": 0.02, "shade": asphalt * 0.6}],
    }  # fmt: skip
    return Scene.load("demo").changed(
        id=f"lawn-{seed}", seed=seed, length_m=40.0, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}],
        road=road, profilers={"on": False}, lidar={"range_max_m": 25.0},
        vehicle={"speed_m_per_s": float(between(7, 13))},
        roadside={
            "parked_cars": [{"station_m": float(between(24, 34)), "offset_m": half - 0.2}],
            "trees": [{"station_m": float(between(5, 35)), "offset_m": edge + 2.5, "height_m": 7.0}],
        },
        camera={
            "on": True, "colour": True, "every_m": 2.0, "width_px": 720, "height_px": 460, "focal_px": 520.0,
            "noise": 3.0, "blur_px": 0.6, "vignetting": 0.2, "jpeg_quality": 85, "range_max_m": 40.0,
            "exposure": {"walk": 0.06, "step": 0.4, "steps_per_100": 8.0},
            "clock": {"offset_s": float(between(-0.006, 0.006)), "known": False},
            "mount": {"lever_arm_body_m": [0.9, -0.25, -1.15], "pitch_deg": -14.0, "heading_deg": 1.5,
                      "error": {"roll_deg": float(between(-0.15, 0.15)), "pitch_deg": float(between(-0.15, 0.15)),
                                "heading_deg": float(between(-0.15, 0.15))}},
        },
        albedo={"road": {"contrast": 0.2}, "verge": {"contrast": 0.28, "finest_m": 0.02, "coarsest_m": 1.3},
                "beside": {}},
        noise={"lidar_range_m": 0.015, "intensity": 6.0, "position_m": 0.012, "attitude_deg": 0.02,
               "heading_deg": 0.04},
    )  # fmt: skip


def drawn(seed: int, folder: Path) -> Path:
    """Simulate a street into a folder, with shadows on the ground and dirt on the lens; its survey file."""
    file = folder / "SURVEY.toml"
    if not file.exists():
        simulate(lawn_street(seed), folder)
        spoil(folder, seed)
    return file


def spoil(
    folder: Path,
    seed: int,
    more: Sequence[Float64] = (),
    blur_px: float = 1.0,
    tinted: Sequence[tuple[Sequence[Float64], Float64]] = (),
) -> None:
    """Draw shadows of trees and houses on the ground of all pictures of a survey, and dirt on the lens.

    more : outlines (n, 3) of further shadows; blur_px : 1 σ of the edges of all (pixels). tinted : outlines of ground
    and its brightness over that of the simulator, red to blue (3,).
    """
    known, random = truth.load(folder), np.random.default_rng([seed, 1])
    shadows = [_shadow(random, known.surface, known.scene.length_m) for _ in range(9)] + list(more)
    camera = known.scene.camera
    size = camera.width_px, camera.height_px
    dirt = np.ones((size[1], size[0]), np.float32)
    for _ in range(6):
        spot = np.zeros_like(dirt)
        at = (int(random.integers(0, size[0])), int(random.integers(0, size[1])))
        cv2.circle(spot, at, int(random.integers(*_DIRT_PX)), 1.0, -1)
        dirt -= 0.6 * cv2.GaussianBlur(spot, (0, 0), 6.0)
    dirt = np.clip(dirt, 0.3, 1.0)
    matrix = np.array([[camera.focal_px, 0, (size[0] - 1) / 2], [0, camera.focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])
    earth = Earth(known.scene.map.crs)
    for run in sorted(p.stem for p in (known.folder / "camera").glob("*.parquet")):
        for pose in pq.read_table(known.camera_file(run)).to_pylist():
            path = folder / "raw" / run / "camera" / Path(pose["file"]).name
            picture = np.asarray(cv2.imread(str(path)), np.float32)
            turn = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")])
            light = np.ones((*dirt.shape, 1), np.float32)
            for outlines, left in [(shadows, _SHADE), *tinted]:
                drawn_on = np.zeros(dirt.shape, np.float32)
                for outline in outlines:
                    world = earth.ecef_from_map(outline)
                    own = turn.inv().apply(world - [pose[f"{a}_world_m"] for a in "xyz"])[:, [1, 2, 0]]
                    if (own[:, 2] < 0.7).any():
                        continue
                    pixel = cv2.projectPoints(own, np.zeros(3), np.zeros(3), matrix, np.zeros(5))[0][:, 0]
                    corners = np.clip(np.round(pixel * 8), -80000, 80000).astype(np.int32)
                    cv2.fillPoly(drawn_on, [corners], 1.0, shift=3)
                drawn_on = cv2.GaussianBlur(drawn_on, (0, 0), blur_px)[..., None]
                light = light * (1.0 - drawn_on * (1.0 - left[::-1]))
            # light is linear, digital numbers are its power of 1/2.2
            spoiled = picture * light ** (1 / 2.2) * dirt[..., None] + 70.0 * (1.0 - dirt[..., None])
            done, data = cv2.imencode(".jpg", np.clip(spoiled, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 88])
            if done:
                path.write_bytes(data.tobytes())


def _shadow(random: np.random.Generator, surface: Surface, length_m: float) -> Float64:
    """Outline (n, 3) of a shadow on the ground that lies across the road's edge or beside it."""
    station, offset = random.uniform(0, length_m), random.choice([-1, 1]) * random.uniform(2.0, 7.0)
    long, wide = random.uniform(0.6, 3.0), random.uniform(0.5, 3.5)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rough = 1.0 + 0.25 * np.sin(3 * angle + random.uniform(0, 6)) + 0.15 * np.sin(7 * angle + random.uniform(0, 6))
    return np.column_stack(surface.place(station + long * rough * np.cos(angle), offset + wide * rough * np.sin(angle)))


class Found(NamedTuple):
    """How well lawns were found on a street, and road edges where the pavement ends at one."""

    area_m2: float
    """True area of lawns up to 8 m from the middle of the road, without what is beyond the ends."""
    found: float
    """Share of it that is found."""
    right: float
    """Share of what is found that is lawn; NaN where nothing is."""
    edge: float
    """Share of the lawns' edges that have a found one within 0.5 m."""
    errors_m: Float64
    """(n,) errors of these, across the road; positive outwards."""
    sigma_m: float
    """What the areas state, mean over these edges."""
    road_edges_m: Float64
    """(k,) errors of road edges that lie within 1 m of a paved edge."""
    road_sigma_m: float


_BESIDE_M: Final = 8.0  # Lawns are judged up to this far from the middle (m).
_END_M: Final = 3.0  # What lies so near to an end is not judged (m).


def score(folder: Path, survey_file: Path) -> Found:
    """Returns how well the products of a survey hold against the truth in a folder."""
    known, store = truth.load(folder), Session.open(survey_file).store
    tables = {name: geopandas.read_parquet(store.path(f"products/assets/{name}.parquet"))
              for name in ("landscape_areas", "road_edges")}  # fmt: skip
    surface, road = known.surface, known.scene.road
    paved = road.paved_m
    edge = paved + (road.grass.from_m if road.grass else 0.0)
    station = np.arange(_END_M, known.scene.length_m - _END_M, 0.1)
    offset = np.concatenate([side * np.arange(0.05, _BESIDE_M, 0.1) for side in (-1.0, 1.0)])
    s, o = (a.ravel() for a in np.meshgrid(station, offset, indexing="ij"))
    areas = tables["landscape_areas"]
    which = _areas_at(areas, surface, s, o)
    is_lawn = np.abs(o) > edge
    found = which >= 0
    errors, sigmas, edges = [], [], 0
    beside = np.arange(-0.5, 0.5, 0.01)
    for side in (-1.0, 1.0):
        for at in np.arange(_END_M, known.scene.length_m - _END_M, 0.25):
            edges += 1
            own = _areas_at(areas, surface, np.full(beside.size, at), side * (edge + beside))
            first = np.flatnonzero(own >= 0)
            if first.size and first[0] > 0:
                errors.append(beside[first[0]])
                sigmas.append(float(areas["sigma_horizontal_m"].iloc[own[first[0]]]))
    off, off_sigma = [], []
    for shape, sigma in zip(tables["road_edges"].geometry, tables["road_edges"]["sigma_horizontal_m"], strict=True):
        points = shapely.get_coordinates(shapely.segmentize(shape, 0.25))
        at, away = surface.station_offset_m(points[:, 0], points[:, 1])
        error = np.abs(away) - paved
        error = error[(at >= _END_M) & (at <= known.scene.length_m - _END_M) & (np.abs(error) < 1.0)]
        off += error.tolist()
        off_sigma += [float(sigma)] * error.size
    return Found(
        float(is_lawn.sum()) * 0.01, float(found[is_lawn].mean()),
        float(is_lawn[found].mean()) if found.any() else float("nan"), len(errors) / edges, np.array(errors),
        float(np.mean(sigmas)) if sigmas else float("nan"), np.array(off),
        float(np.mean(off_sigma)) if off_sigma else float("nan"),
    )  # fmt: skip


def _areas_at(areas: Any, surface: Surface, station_m: Float64, offset_m: Float64) -> npt.NDArray[np.int64]:
    """Returns the number (n,) of the area at places, −1 where there is none."""
    east, north, _ = surface.place(station_m, offset_m)
    out = np.full(east.size, -1, np.int64)
    if len(areas):
        points = shapely.points(east, north)
        point, area = shapely.STRtree(areas.geometry.to_numpy()).query(points, predicate="intersects")
        np.maximum.at(out, point, area)
    return out
