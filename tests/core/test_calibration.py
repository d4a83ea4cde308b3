"""Evidence and settings of a calibration, as the survey file states them."""

from __future__ import annotations

import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.settings.calibration import (
    CalibrationEvidence,
    CalibrationSettings,
    OverlapEvidence,
    StopAndGoEvidence,
)
from roadscan.core.strict import Strict

OBJECT = {"steps": [[1.2, 1.2, 0.02]], "easting_m": 1.0, "northing_m": 2.0}


class Holder(Strict):
    """Stands for the survey file."""

    calibration: list[CalibrationEvidence] = []
    """Evidence."""


def parse(**entry):
    return Holder.parse({"calibration": [entry]}).calibration[0]


def test_kind_says_which_evidence_it_is():
    assert parse(kind="overlap", sensors=["lidar"], runs=["run-1"]) == OverlapEvidence(
        kind="overlap", sensors=["lidar"], runs=["run-1"]
    )
    assert isinstance(parse(kind="stop_and_go", sensor="left", imu="left_imu"), StopAndGoEvidence)
    assert parse(kind="object", sensors=["left", "right"], **OBJECT).kind == "object"
    assert parse(kind="reference", sensor="lidar", path="a.las", crs="local", height="ellipsoidal").geoid is None


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"kind": "overlap", "sensors": ["a"], "runz": []}, r"'calibration.0.runz' \(did you mean 'runs'\?\)"),
        ({"kind": "overlap"}, "key 'calibration.0.sensors' is missing"),
        ({"kind": "overlaps"}, r"0.kind' \(got 'overlaps'\): unknown \(did you mean 'overlap'\?\), expected"),
        ({"sensors": ["a"]}, "key 'calibration.0.kind' is missing"),
        ({"kind": "object", "sensors": ["a"]}, "key 'calibration.0.steps' is missing"),
        ({"kind": "object", "sensors": ["a"], "steps": [[1, 1, 0.02]]}, "key 'calibration.0.easting_m' is missing"),
        ({"kind": "reference", "sensor": "a", "path": "x.las", "crs": "local"}, "'calibration.0.height' is missing"),
        (
            {"kind": "overlap", "sensors": ["a"], "area": dict.fromkeys(
                ("easting_min_m", "easting_max_m", "northing_min_m", "northing_max_m"), 5.0)},
            "the area is empty",
        ),
    ],
)  # fmt: skip
def test_faults_are_named(entry, message):
    with pytest.raises(ConfigError, match=message):
        parse(**entry)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"robust_limit": 7.0}, "reject_limit 6 has to lie above robust_limit 7"),
        ({"valid_from": "2026-05-04T09:30:00"}, "needs a time zone"),
        ({"lever_arm_sigma_m": [0.1, 0.1, -0.1]}, "'lever_arm_sigma_m.2'"),
        ({"determined_below": 1.0}, "'determined_below'"),
    ],
)
def test_settings_that_cannot_be_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        CalibrationSettings.parse(values)
