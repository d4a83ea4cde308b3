"""The navigation picture: what it states is what was put in; bytes do not depend on when it is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.crs import world_from_geodetic
from roadscan.core.gpstime import NS_PER_S
from roadscan.navigation.inertial.readings import GnssSolutions, Innovations, Solution
from roadscan.navigation.picture import (
    NavigationPicture,
    _antenna_arm,
    _axis,
    _residuals,
    _summary,
    draw_navigation,
)
from tests.drawing import drawn


@pytest.fixture(autouse=True)
def pictures() -> Iterator[None]:
    """These tests look at drawings."""
    with drawn():
        yield


WORLD = "EPSG:4978"
ARM = np.array([0.5, -0.2, -1.5])
FIRST = 1_461_922_200 * NS_PER_S
LAT, LON = 48.1, 11.6


def level() -> np.ndarray:
    """ECEF from north, east, down, as SciPy has it."""
    return Rotation.from_euler("ZY", [LON, -90.0 - LAT], degrees=True).as_matrix()


def picture(*, odometer: bool = True) -> NavigationPicture:
    """A drive north-east of 60 s with an outage from 20 to 35 s; GNSS lies 0.10 m east and 0.04 m below."""
    t = np.arange(0.0, 60.0, 0.02)
    epochs = FIRST + np.rint(t * NS_PER_S).astype(np.int64)
    ecef_from_ned = level()
    origin = world_from_geodetic(WORLD, np.array([[LON, LAT, 500.0]]))[0]
    body = Rotation.from_matrix(ecef_from_ned) * Rotation.from_euler("ZYX", [45.0, 2.0, -1.0], degrees=True)
    ned = np.stack([8 * t, 8 * t, 0.0 * t], axis=1)
    position = origin + ned @ ecef_from_ned.T
    out = (t > 20.0) & (t < 35.0)
    sigma = np.where(out, 0.15, 0.012)
    covariance = np.einsum("n,ij->nij", sigma**2, np.diag([1.0, 1.0, 4.0]))
    at = np.arange(0, t.size, 10)
    at = at[~out[at]]
    shifted = position[at] + body.apply(ARM) + ecef_from_ned @ [0.0, 0.10, 0.04]
    gnss = GnssSolutions(
        WORLD, epochs[at], shifted, np.tile(1e-4 * np.eye(3), (at.size, 1, 1)),
        np.where(np.arange(at.size) % 7 == 0, "float", "fixed"), np.zeros((at.size, 3)), np.full((at.size, 3), 0.03),
    )  # fmt: skip
    seconds = epochs[::50]
    walk = np.cumsum(np.random.default_rng(1).standard_normal((seconds.size, 3)), axis=0)
    states = {
        "gyro_bias_imu_rad_per_s": (1e-6 * walk, np.full_like(walk, 1e-5)),
        "accel_bias_imu_m_per_s2": (1e-3 * walk, np.full_like(walk, 1e-2)),
    }
    if odometer:
        states["odometer_scale"] = (1.009 + 1e-5 * walk[:, 0], np.full(seconds.size, 2e-4))
    weight = np.ones(at.size)
    weight[[5, 9]], weight[30] = 0.4, 0.0
    innovations = Innovations(
        epochs[at], np.full(at.size, "gnss position"), np.zeros((at.size, 3)), 1.0 / np.maximum(weight, 0.05), weight
    )
    solution = Solution(
        WORLD, epochs, position, np.tile(body.as_quat(scalar_first=True), (t.size, 1)),
        np.tile([8.0, 8.0, 0.0], (t.size, 1)),
        covariance, 1e-6 * np.tile(np.eye(3), (t.size, 1, 1)), 1e-4 * np.tile(np.eye(3), (t.size, 1, 1)),
        np.full((t.size, 3), np.radians(0.02)), states, seconds, innovations,
    )  # fmt: skip
    return NavigationPicture("run 'monday'", solution, gnss, ARM)


def test_residuals_outages_and_summary_are_what_was_put_in() -> None:
    one = picture()
    axis = _axis(one)
    assert axis.outages_s == [pytest.approx((20.0, 35.0), abs=0.21)]
    residuals = _residuals(one, axis)
    assert residuals.ned_m == pytest.approx(np.tile([0.0, -0.10, -0.04], (one.gnss.epochs_gps_ns.size, 1)), abs=1e-5)
    text = _summary(one, residuals, axis)
    assert text.startswith("2026-05-04T09:29:42 UTC, 60 s, 0.68 km")
    assert "σ horizontal 0.017 m median, 0.212 m worst; down 0.024 / 0.300 m; heading 0.020° / 0.020°" in text
    assert "1 outage, 15 s without GNSS, the longest 15 s" in text
    assert "RMS 0.100 m horizontal, 0.040 m down" in text
    assert "2 down-weighted, 1 refused" in text


def test_lever_arm_that_was_estimated_counts() -> None:
    one = picture()
    states = one.solution.states | {"antenna_lever_arm_body_m": (np.tile(ARM + 0.01, (2, 1)), np.ones((2, 3)))}
    changed = replace(one, solution=replace(one.solution, states=states))
    assert _antenna_arm(changed) == pytest.approx(ARM + 0.01)


def test_gnss_between_the_pieces_of_a_solution_has_no_residual() -> None:
    one = picture()
    pieces = ((FIRST, FIRST + 10 * NS_PER_S), (FIRST + 40 * NS_PER_S, FIRST + 60 * NS_PER_S))
    cut = replace(one, solution=replace(one.solution, pieces=pieces))
    seconds = _residuals(cut, _axis(cut)).seconds
    assert not ((seconds > 10.0) & (seconds < 40.0)).any()
    assert seconds.size > 100


@pytest.mark.slow
def test_picture_is_written_whole_and_always_the_same(tmp_path: Path) -> None:
    draw_navigation(tmp_path / "a.png", picture())
    draw_navigation(tmp_path / "b.png", picture())
    first = (tmp_path / "a.png").read_bytes()
    assert first == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]
    assert b"tIME" not in first
    assert b"Software" not in first
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    assert image.shape == (1485, 1650, 3)
    # Outages are shaded in every panel over time, and nowhere in a run without them.
    shade = (np.abs(image.astype(int) - [201, 217, 243]).max(axis=2) < 3).sum()
    assert shade > 50_000
    one = picture()
    whole = replace(
        one.gnss, epochs_gps_ns=np.linspace(FIRST, FIRST + 59 * NS_PER_S, one.gnss.quality.size).astype(int)
    )
    draw_navigation(tmp_path / "c.png", replace(one, gnss=whole))
    image = cv2.imread(str(tmp_path / "c.png"))
    assert (np.abs(image.astype(int) - [201, 217, 243]).max(axis=2) < 3).sum() < 1000


@pytest.mark.slow
def test_picture_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        draw_navigation(tmp_path / "missing" / "a.png", picture())
    assert list(tmp_path.iterdir()) == []


def test_bare_solution_has_a_picture(tmp_path: Path) -> None:
    """No odometer, no states, no innovations, no GNSS position inside."""
    one = picture(odometer=False)
    bare = replace(one.solution, states={}, state_epochs_gps_ns=np.zeros(0, np.int64), innovations=None)
    nothing = replace(one.gnss, position_world_m=one.gnss.position_world_m * np.nan)
    draw_navigation(tmp_path / "a.png", NavigationPicture("bare", bare, nothing, ARM))
    assert (tmp_path / "a.png").stat().st_size > 20_000
