"""Seams between passes after the adjustment, through raw logs: three lanes of a motorway, and a deck in five strips.

A seam is judged by the poses, not by the ties that made it: a point of the road on the border of two strips is placed
by each of the two passes as if each had seen it, by its true place in the vehicle's frame and by the adjusted pose. The
difference is the step and the shift that the border shows. Then a fifth of the ties are replaced by false matches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.adjust.observations import FIXED, Observations
from roadscan.adjust.tasks import solution
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_of
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Reporter, Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

STAGES = ("ingest", "navigate", "footprints", "adjust")
STEP_MM, SHIFT_MM = 1.0, 5.0
FALSE_SHARE = 0.2
_OFF = {"on": False}
_ERRORS = {"position_m": 0.010, "attitude_deg": 0.005, "time_constant_s": 60.0, "control_m": 0.002}


def figures(folder: Path) -> Iterator[Figure]:
    """Of each site: RMS of step and shift at the seams as recorded, adjusted, and adjusted with false matches."""
    length = Settings.current().seam_m
    for name, scene, seams in (
        ("three lanes", motorway(length), (-1.8, 1.8)),
        ("deck", deck(length), (-1.2, 0.0, 1.2, 2.4)),
    ):
        survey_file = simulate(scene, folder / name.replace(" ", "-")).survey_file
        stations = np.arange(2.0, length - 2.0, 1.0)
        results = {}
        for how in ("recorded", "adjusted", "false"):
            session = adjusted(survey_file, how)
            results[how] = seam_errors(session, survey_file.parent, stations, seams)
        for k, (what, bar) in enumerate((("step", STEP_MM), ("shift", SHIFT_MM))):
            before, after, false = (1e3 * rms(results[how][:, k]) for how in ("recorded", "adjusted", "false"))
            yield Figure(f"{name}: {what} at the seams (bar {bar:g})", after, "mm", before, "as recorded")
            yield Figure(f"{name}: {what}, a fifth of the ties false (bar 1.1)", false, "mm", after, "without")


def rms(values: Float64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def motorway(length_m: float) -> Scene:
    """Three lanes, each driven once, painted lines between them."""
    return Scene.load("highway_three_lanes").changed(
        length_m=length_m, lidar=_OFF, imu=_OFF, gnss=_OFF, encoder=_OFF, camera=_OFF,
        profilers={"spacing_m": 0.01, "readings": 600, "head_imus": None},
        vehicle={"standstill_s": 0.0}, noise=_ERRORS, control={"spacing_m": length_m / 2.0 - 2.0},
        roadside={"guardrails": [], "signs": [], "poles": [], "trees": [], "moving_cars": []},
    )  # fmt: skip


def deck(length_m: float) -> Scene:
    """A concrete deck with joints, in five strips 1.2 m apart."""
    return Scene.load("reference_site").changed(
        length_m=length_m, lidar=_OFF, imu=_OFF, gnss=_OFF, encoder=_OFF, camera=_OFF,
        road={"joints": [{"spacing_m": 5.0, "width_m": 0.010, "depth_m": 0.015, "start_m": 2.5, "end_m": length_m}],
              "targets": [], "roughness": {"iri_m_per_km": 1.5}, "cracks": [], "alligators": [], "potholes": [],
              "patches": [], "stains": [], "tyre_marks": []},
        passes=[{"lane": 2, "offset_m": offset} for offset in (-3.6, -2.4, -1.2, 0.0, 1.2)],
        profilers={"spacing_m": 0.01, "readings": 600, "head_imus": None},
        vehicle={"standstill_s": 0.0}, noise=_ERRORS, roadside={"poles": [], "trees": []},
    )  # fmt: skip


def adjusted(survey_file: Path, how: str) -> Session:
    """The survey with a store of its own: its poses as recorded, adjusted, or adjusted with false matches."""
    survey = Survey.load(survey_file)
    values = survey.config.model_dump() | {"rig": survey.rig.model_dump()}
    values["adjust"]["on"] = how != "recorded"
    store = Store(str(survey_file.parent / f"store-{how}"), survey.config.id)
    with compute_on(Settings.current().workers) as compute, tampered(how == "false"):
        session = Session(Survey.parse(values, folder=survey.folder), store, compute, None, Reporter())
        run_stages(session, [stage_named(name) for name in STAGES])
    return Session(session.survey, store)


def tampered(on: bool) -> Any:
    """While open, a fifth of the ties are false matches, off by up to 0.1 m, where `on`."""
    original: Callable[..., Any] = solution.adjust

    def with_false(observations: Observations, *rest: Any) -> Any:
        tie = ~(observations.run == FIXED).any(axis=1)
        rng = np.random.default_rng(5)
        false = tie & (rng.uniform(size=observations.size) < FALSE_SHARE)
        observations.observed_m[false] += rng.uniform(-0.1, 0.1, int(false.sum()))
        return original(observations, *rest)

    return mock.patch.object(solution, "adjust", with_false if on else original)


def seam_errors(session: Session, folder: Path, stations: Float64, seams: tuple[float, ...]) -> Float64:
    """(n, 2) step and shift across the road (m) between what the two passes nearest a seam make of its points."""
    known = truth.load(folder)
    found = []
    for offset in seams:
        east, north, _ = known.surface.place(stations, offset)
        height = known.surface.height_m(east, north, texture=False)
        road = np.column_stack([east, north, height])
        errors = {
            run.id: placed_error(session, known.trajectory_file(run.id), run.id, road)
            for run in session.survey.config.runs
        }
        side = {run: float(np.median(e[1])) for run, e in errors.items()}
        left = max((v, r) for r, v in side.items() if v <= 0.0)[1]
        right = min((v, r) for r, v in side.items() if v > 0.0)[1]
        apart = errors[left][0] - errors[right][0]
        ahead = np.gradient(road[:, 1]), np.gradient(road[:, 0])  # north, east; grid and true north differ by a degree
        across = (apart[:, 1] * ahead[0] - apart[:, 0] * ahead[1]) / np.hypot(*ahead)
        found.append(np.column_stack([apart[:, 2], across]))
    return np.concatenate(found)


def placed_error(session: Session, true_poses: Path, run: str, road_map_m: Float64) -> tuple[Float64, Float64]:
    """Error (n, 3) north, east, down of road points as a run places them, and how far to its right they lie (n,)."""
    earth = Earth(session.survey.config.map.crs)
    world = earth.ecef_from_map(road_map_m)
    true = pq.read_table(true_poses).to_pandas()
    position = true[["x_world_m", "y_world_m", "z_world_m"]].to_numpy()
    turns = Rotation.from_quat(true[["qw", "qx", "qy", "qz"]].to_numpy(), scalar_first=True)
    ahead = turns.apply(np.array([1.0, 0.0, 0.0]))
    behind_m = float(np.mean([h.lever_arm_body_m[0] for h in session.survey.rig.sensors.values()]))
    # The scanners stand behind the body's origin: a point is seen when it is as far behind it as they are.
    seen = np.array([np.argmin(np.abs(((p - position) * ahead).sum(axis=1) - behind_m)) for p in world])
    body = turns[seen].inv().apply(world - position[seen])
    source = next(s for s, _ in plan_of(session).sources if s.run == run)
    epochs = true["epoch_gps_ns"].to_numpy()[seen]
    trajectory = load_trajectory(session.store, source.trajectory, [(int(epochs.min()), int(epochs.max()))], 1.0)
    poses = trajectory.poses(epochs, strict=True)
    placed = poses.position_world_m + np.einsum("nij,nj->ni", poses.world_from_body, body)
    north_east_down = earth.ecef_from_level(world).inv().apply(placed - world)
    return north_east_down, body[:, 1]
