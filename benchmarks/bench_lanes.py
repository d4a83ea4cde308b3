"""Condition of simulated lanes through the whole pipeline, beside the truth; and what a kilometre of lane costs.

The roads have a prescribed roughness, ruts of 3 to 25 mm and a crown; vehicles drive them at 60 to 100 km/h with a
wandering path and moving springs. True values are those that the true heights give at the same places. The trajectory
is solved from raw IMU and GNSS, or stated with errors of Gauss–Markov processes: these are rougher over short times
than those of any inertial solution, and at 1 m/km they are most of the error.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.timing import Figure
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.tasks.compare import Compared, compared_values
from roadscan.core.strict import load_toml
from roadscan.core.survey import Survey
from roadscan.run.session import Session, manifest_of
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.surface import Surface
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

RUTS_MM: Final = ((3.0, 6.0), (12.0, 25.0))
"""Depths in the left and right wheel path, of lanes 1 and 2."""
_WHEEL_M: Final = 0.85
_STAGES: Final = ("ingest", "navigate", "footprints", "tiles", "condition")


_RAW: Final = {"imu": {"on": True}, "gnss": {"on": True}, "encoder": {"on": True}}
_RAW_FORMATS: Final = ("imu_csv", "rtklib_pos", "encoder_csv")


def rough_scene(iri_m_per_km: float, length_m: float, **changes: Any) -> Scene:
    """A road of two lanes with a prescribed roughness and ruts, driven forward on both at different speeds."""
    centres = (-1.75, 1.75)
    ruts = [
        {"offset_m": centre + side * _WHEEL_M, "width_m": 0.8, "depth_m": depth * 1e-3, "variation": 0.2}
        for centre, depths in zip(centres, RUTS_MM, strict=True)
        for side, depth in zip((-1.0, 1.0), depths, strict=True)
    ]
    values: dict[str, Any] = {
        "id": "rough",
        "length_m": length_m,
        "passes": [{"lane": 1, "speed_m_per_s": 16.7}, {"lane": 2, "speed_m_per_s": 27.7}],
        "road": {
            "lanes": 2,
            "alignment": [
                {"kind": "straight", "length_m": 120.0},
                {"kind": "spiral", "length_m": 40.0},
                {"kind": "arc", "length_m": 80.0, "radius_m": 300.0},
                {"kind": "spiral", "length_m": 40.0},
            ],
            "roughness": {"iri_m_per_km": iri_m_per_km},
            "ruts": ruts,
            "lead_m": 60.0,
            "crown_rounding_m": 0.05,
        },
        "profilers": {"spacing_m": 0.04, "readings": 400},
        "lidar": {"on": False},
        "noise": {"profiler_range_m": 0.0003, "dropout": 0.001, "position_m": 0.002, "attitude_deg": 0.003,
                  "time_constant_s": 30.0},
    }  # fmt: skip
    return Scene.parse(values).changed(**changes)


@dataclass(frozen=True)
class RoughSurvey:
    """A simulated survey with its reference line and lanes stated."""

    file: Path

    @classmethod
    def made(cls, scene: Scene, folder: Path) -> RoughSurvey:
        """Simulate it, and write the true reference line as a layer."""
        file = simulate(scene, folder).survey_file
        surface = Surface(scene)
        station = np.arange(-10.0, scene.length_m + 10.0, 0.5)
        east, north, _ = surface.place(station, 0.0)
        line = {"type": "LineString", "coordinates": np.column_stack([east, north]).tolist()}
        named = {"id": "A1", "name": "Test road", "from_km": 12.0, "to_km": 12.0 + (scene.length_m + 20.0) / 1000}
        layer = {
            "type": "FeatureCollection",
            "crs": {"type": "name", "properties": {"name": scene.map.crs}},
            "features": [{"type": "Feature", "properties": named, "geometry": line}],
        }
        (folder / "line.geojson").write_text(json.dumps(layer))
        return cls(file)

    def session(
        self, store: str, runs: tuple[str, ...] | None = None, *, solved: bool = False, **condition: Any
    ) -> Session:
        """A session of some of its runs (all by default), with a store of its own.

        solved : the trajectory is that of raw IMU and GNSS, which the scene has to log, and not the stated one.
        """
        values = load_toml(self.file)
        lanes = [
            {"name": "1", "offset_m": -1.75, "width_m": 3.5},
            {"name": "2", "offset_m": 1.75, "width_m": 3.5},
        ]
        kept = [run for run in values["runs"] if runs is None or run["id"] in runs]
        for run in kept:
            run["logs"] = [log for log in run["logs"] if log["format"] not in (("sbet",) if solved else _RAW_FORMATS)]
        navigation = {"navigation": {"smoother": {"imu_samples": "instant"}}} if solved else {}
        passes = [p for p in values["passes"] if runs is None or p["run"] in runs]
        measures = {"measure_from_column": "from_km", "measure_to_column": "to_km"}
        stated = {"reference": "layer", "layer": "line.geojson", "layer_options": measures, "lanes": lanes} | condition
        made = values | navigation | {"runs": kept, "passes": passes, "condition": stated, "products": {"make": []}}
        survey = Survey.parse(made, folder=self.file.parent)
        return Session(survey, Store(str(self.file.parent / store), survey.config.id))

    def height_at(self, easting_m: Float64, northing_m: Float64) -> Float64:
        """True heights, without texture."""
        return truth.load(self.file.parent).surface.height_m(easting_m, northing_m, texture=False)


def run(session: Session) -> None:
    """Raw logs to condition."""
    run_stages(session, [stage_named(name) for name in _STAGES])


def driven(found: list[Compared], lanes: tuple[str, ...] = ("1", "2")) -> dict[tuple[str, str], Float64]:
    """(n, 3) found and true values and standard deviations of driven lanes, by extent and quantity."""
    held: dict[tuple[str, str], list[tuple[float, float, float]]] = defaultdict(list)
    for one in found:
        if one.lane in lanes:
            held[one.found.extent, one.found.quantity].append((one.found.value, one.true.value, one.found.sigma))
    return {name: np.array(rows) for name, rows in held.items()}


def figures(folder: Path) -> Iterator[Figure]:
    """Errors of roughness, ruts and slopes, two passes beside each other, and seconds a kilometre."""
    for prescribed in (1.0, 2.0, 4.0):
        made = RoughSurvey.made(rough_scene(prescribed, 520.0, **_RAW), folder / f"iri{prescribed:g}")
        yield from _errors(f"IRI {prescribed:g}, trajectory of IMU and GNSS", driven(list(solved_values(made))))
        session = made.session("store")
        run(session)
        yield from _errors(
            f"IRI {prescribed:g}, stated trajectory", driven(list(compared_values(session, made.height_at)))
        )
    yield from _two_passes(folder / "twice")
    yield from _cost(session)


def solved_values(made: RoughSurvey) -> Iterator[Compared]:
    """Values of each lane from its drive alone, whose trajectory is solved: two such drives differ by centimetres."""
    for lane in ("1", "2"):
        session = made.session(f"solved-{lane}", (f"run-{lane}",), solved=True)
        run(session)
        yield from (one for one in compared_values(session, made.height_at) if one.lane == lane)


def _errors(name: str, held: dict[tuple[str, str], Float64]) -> Iterator[Figure]:
    iri = np.concatenate([held["section", f"iri_{side}_m_per_km"] for side in ("left", "right")])
    iri = iri[np.isfinite(iri).all(axis=1)]
    error = iri[:, 0] - iri[:, 1]
    yield Figure(f"{name}: largest error of a section (bar 2 %, 0.03 at 1)", float(np.abs(error).max()), "m/km")
    yield Figure(f"{name}: the same of its true value", 100 * float(np.abs(error / iri[:, 1]).max()), "%")
    yield Figure(f"{name}: RMS of error over its sigma", float(np.sqrt(np.mean((error / iri[:, 2]) ** 2))), "1")
    ruts = np.concatenate([held["cross_section", f"rut_depth_{side}_mm"] for side in ("left", "right")])
    error = (ruts[:, 0] - ruts[:, 1])[np.isfinite(ruts[:, 0])]
    yield Figure(f"{name}: rut depth, mean error (bar 0.3)", float(error.mean()), "mm")
    yield Figure(f"{name}: rut depth, standard deviation (bar 1.0)", float(error.std()), "mm")
    slope = held["section", "cross_slope_mean_percent"]
    error = slope[:, 0] - slope[:, 1]
    yield Figure(f"{name}: cross-slope, largest error (bar 0.05)", float(np.nanmax(np.abs(error))), "%")


def _two_passes(folder: Path) -> Iterator[Figure]:
    passes = [{"lane": 2, "speed_m_per_s": speed} for speed in (16.7, 27.7)]
    made = RoughSurvey.made(rough_scene(2.0, 320.0, passes=passes), folder)
    found = []
    for number in ("run-1", "run-2"):
        session = made.session(f"store-{number}", (number,))
        run(session)
        found.append(driven(list(compared_values(session, made.height_at)), ("2",))["section", "mri_m_per_km"][:, 0])
    change = 100 * (found[1] / found[0] - 1.0)
    yield Figure("MRI of two passes at 60 and 100 km/h, largest change (bar 1)", float(np.nanmax(np.abs(change))), "%")


def _cost(session: Session) -> Iterator[Figure]:
    """Seconds for a kilometre of lane from the tiles; the second time, when all is compiled."""
    config = ConditionConfig.stated(session.survey)
    lanes_km = 0.0
    for name in ("tables/profiles_longitudinal", "tables/cross_sections", "tables/condition_values"):
        for path in session.store.files(name):
            session.store.remove(path)
    session.forget(manifest_of)
    begun = time.process_time()
    stage_named("condition").run(session)
    spent = time.process_time() - begun
    for path in session.store.files("tables/lanes"):
        table = session.store.read_table(path)
        lanes_km = sum(
            (b - a) / 1000 for a, b in zip(*(table[f"station_{e}_m"].to_pylist() for e in ("from", "to")), strict=True)
        )
    assert config is not None
    yield Figure("all indices of a kilometre of lane, 50 mm cells (bar 20 core-s)", spent / lanes_km, "core-s")
