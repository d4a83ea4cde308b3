"""A boresight that the rig file has wrong: passes side by side find it, and say so."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.adjust.tasks.outcome import known_findings
from roadscan.simulate import Scene, simulate
from roadscan.store.manifest import Manifest
from roadscan.store.small_tables import read_small, small_path
from tests.adjust.adjusted_site import adjust, cell_errors
from tests.surveys import Simulated

pytestmark = pytest.mark.nightly

OFF = {"on": False}
WRONG_DEG = 0.05
"""The rig file's roll of the right head minus the true one."""
CHANGES: dict[str, object] = {
    "adjust__targets": {"shape": "circle", "size_m": 0.30, "centre_m": 0.06},
    "adjust__ties": {"cell_m": 0.05},
    "products__make": ["tile_table"],
}
COMPONENTS = ("forward_m", "right_m", "down_m", "roll_deg", "pitch_deg", "heading_deg", "range_scale")


def site() -> Scene:
    """Four passes over one lane, one of them the other way, and heads that see 0.4 m of the road together."""
    places = ((2.0, 3.2), (20.0, 0.6), (40.0, 3.2), (58.0, 0.6))
    bare: dict[str, Any] = {
        k: [] for k in ("joints", "cracks", "alligators", "potholes", "patches", "stains", "tyre_marks")
    }
    right = {"lever_arm_body_m": (-2.28, 0.99, -1.11), "roll_deg": -0.35, "pitch_deg": 0.25, "heading_deg": -0.5}
    return Scene.load("reference_site").changed(
        road={
            "targets": [{"station_m": s, "offset_m": o, "role": "gcp"} for s, o in places],
            "alignment": [{"kind": "straight", "length_m": 260.0}], **bare,
        },
        length_m=60.0, lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF,
        profilers={
            "spacing_m": 0.05, "readings": 300, "head_imus": None, "width_m": 2.4,
            "right": {**right, "error": {"roll_deg": WRONG_DEG}},
        },
        passes=[
            {"lane": 2, "offset_m": -0.6}, {"lane": 2}, {"lane": 2, "offset_m": 0.4},
            {"lane": 2, "direction": "backward"},
        ],
        noise={"position_m": 0.015, "attitude_deg": 0.003, "time_constant_s": 60.0, "control_m": 0.001},
        vehicle={"speed_m_per_s": 10.0, "standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Run whole, into the store ``store``."""
    one = Simulated(simulate(site(), tmp_path_factory.mktemp("mounted") / "survey").survey_file)
    one.run(**CHANGES)
    return one


@pytest.mark.witness("mounting")
def test_a_wrong_boresight_is_found_named_and_applied(survey: Simulated) -> None:
    table = read_small(survey.store(), "mounting_corrections")
    assert table is not None
    found = {row["sensor"]: row for row in table.to_pylist()}
    assert set(found) == {"profiler_right"}  # nothing contradicts the other's
    roll, sigma = (np.degrees(found["profiler_right"][name]) for name in ("roll_rad", "sigma_roll_rad"))
    assert abs(roll + WRONG_DEG) < 3.0 * sigma
    assert sigma < 0.008
    assert roll < -0.04
    # Nothing tells of what a head that looks straight down does not feel.
    heading = found["profiler_right"]
    assert heading["sigma_heading_rad"] > 0.9 * heading["prior_sigma_heading_rad"]
    said = [one for one in known_findings(Manifest(survey.store())) if one.witness == "mounting"]
    assert [one.subject for one in said] == ["profiler_right"]
    assert f"boresight roll {roll:+.4f}° (σ {sigma:.4f}°" in said[0].text
    assert np.mean(np.abs(cell_errors(survey, survey.store()))) < 0.003


def test_the_mounting_is_applied_once_and_a_second_run_does_nothing(survey: Simulated) -> None:
    store = survey.store()
    before = (
        store.read_bytes(small_path("mounting_corrections")),
        store.read_bytes(small_path("corrections")),
    )
    run = survey.run(**CHANGES)
    assert run.raw_bytes_read == 0
    assert (
        store.read_bytes(small_path("mounting_corrections")),
        store.read_bytes(small_path("corrections")),
    ) == before


def test_sigmas_of_zero_leave_mountings_as_they_are_stated(survey: Simulated) -> None:
    survey.run("store-stated", **CHANGES, adjust__mountings={f"sigma_{name}": 0.0 for name in COMPONENTS})
    store = survey.store("store-stated")
    assert not store.exists(small_path("mounting_corrections"))
    stated, estimated = (np.sqrt(np.mean(cell_errors(survey, one) ** 2)) for one in (store, survey.store()))
    assert estimated < stated


TURNED_DEG = 0.4
"""Pitch of the lidar in the rig file minus the true one: 40 times the σ that is stated of it, and of the poses'."""


@pytest.mark.witness("mounting")
def test_one_drive_tells_the_pitch_of_its_lidar_and_no_control_is_blamed(tmp_path: Path) -> None:
    """A lidar sees the same planes from before and from behind; variance components alone would widen the poses."""
    one = lidar_alone(tmp_path, {"length_m": 50.0}, {"pitch_deg": TURNED_DEG})
    table = read_small(one.store(), "mounting_corrections")
    assert table is not None
    [row] = table.to_pylist()
    pitch, sigma = np.degrees(row["pitch_rad"]), np.degrees(row["sigma_pitch_rad"])
    assert abs(pitch + TURNED_DEG) < 3.0 * sigma < 0.06
    findings = known_findings(Manifest(one.store()))
    [said] = [found for found in findings if found.witness == "mounting"]
    assert f"boresight pitch {pitch:+.4f}°" in said.text and "attitudes of all poses" in said.text
    assert not [found for found in findings if found.witness in ("control_point", "control_datum", "stated_sigma")]


@pytest.mark.witness("mounting")
def test_control_tells_the_roll_of_a_lidar_and_is_not_blamed_for_it(tmp_path: Path) -> None:
    """On a road that falls to its sides, a lidar that is rolled looks like control that lies aside."""
    one = lidar_alone(tmp_path, {}, {"roll_deg": TURNED_DEG})
    table = read_small(one.store(), "mounting_corrections")
    assert table is not None
    [row] = table.to_pylist()
    # The lidar is tilted forward: a roll about its own axis turns it about two axes of the body.
    tilt = math.radians(18.4)
    for name, truth_deg in (("roll", -TURNED_DEG * math.cos(tilt)), ("heading", TURNED_DEG * math.sin(tilt))):
        found, sigma = np.degrees(row[f"{name}_rad"]), np.degrees(row[f"sigma_{name}_rad"])
        assert abs(found - truth_deg) < 3.0 * sigma < 0.15
    findings = known_findings(Manifest(one.store()))
    assert [found for found in findings if found.witness == "mounting" and "boresight roll" in found.text]
    assert not [found for found in findings if found.witness in ("control_point", "control_datum", "stated_sigma")]


def lidar_alone(folder: Path, changes: Mapping[str, object], error: Mapping[str, float]) -> Simulated:
    """Adjusts one drive along `urban_street` whose lidar, its only sensor, is mounted otherwise than stated."""
    scene = Scene.load("urban_street").changed(
        passes=[{"lane": 2, "stops": []}], vehicle={"speed_m_per_s": 10.0, "standstill_s": 0.0},
        profilers=OFF, camera=OFF, sick=OFF, imu=OFF, gnss=OFF, encoder=OFF,
        lidar={"range_max_m": 30.0, "mount": {"error": dict(error)}},
        noise={
            "position_m": 0.02, "down_m": 0.03, "attitude_deg": 0.01, "heading_deg": 0.03, "time_constant_s": 30.0,
        },
        **changes,
    )  # fmt: skip
    one = Simulated(simulate(scene, folder / "survey").survey_file)
    adjust(one, stages=("ingest", "navigate", "footprints", "adjust"))
    return one
