"""σ of the poses in σ of an asset's place: of the drives that saw it, as far as they were near."""

from __future__ import annotations

import math
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pytest

from roadscan.assets.tasks.tables import Drives
from roadscan.simulate import Scene, simulate
from tests.assets.posts import Posts, only_kinds
from tests.assets.test_assets import run, session
from tests.surveys import Simulated

S = 1_000_000_000
EAST = np.arange(0.0, 400.0, 10.0)


def drive(
    first_gps_ns: int, position_m: float, down_m: float, heading_rad: float = 0.0, roll_rad: float = 0.0
) -> Drives:
    """400 m eastwards at 10 m/s along northing 0."""
    sigma = np.tile([position_m, position_m, down_m, roll_rad, 0.0, heading_rad], (EAST.size, 1))
    return Drives(np.column_stack([EAST, np.zeros(EAST.size)]), first_gps_ns + np.arange(EAST.size) * S, sigma)


def both(one: Drives, other: Drives) -> Drives:
    return Drives(
        np.concatenate([one.places_m, other.places_m]),
        np.concatenate([one.epochs_gps_ns, other.epochs_gps_ns]),
        np.concatenate([one.sigma, other.sigma]),
    )


@pytest.mark.parametrize(
    ("seen_s", "horizontal_m", "down_m"),
    [((18, 22), 0.3, 0.5), ((1018, 1022), 0.1, 0.2), ((18, 1022), math.sqrt(0.05), math.sqrt(0.145))],
)
def test_sigma_is_that_of_the_drives_that_saw_the_place(
    seen_s: tuple[int, int], horizontal_m: float, down_m: float
) -> None:
    drives = both(drive(0, 0.3, 0.5), drive(1000 * S, 0.1, 0.2))
    found = drives.sigma_m(np.array([[200.0, 0.0]]), np.array([seen_s]) * S)
    assert found[0] == pytest.approx([horizontal_m, down_m], rel=1e-9)


def test_errors_of_angles_grow_with_the_distance() -> None:
    """20 m beside the drive: 0.01 rad of the heading move a place by 0.2 m along, of the roll by 0.1 m up."""
    drives = drive(0, 0.0, 0.0, heading_rad=0.01, roll_rad=0.005)
    found = drives.sigma_m(np.array([[200.0, 20.0], [200.0, 0.0]]), np.array([[18, 22], [18, 22]]) * S)
    assert found == pytest.approx(np.array([[0.2 / math.sqrt(2.0), 0.1], [0.0, 0.0]]), abs=1e-9)


def test_what_is_worse_far_away_does_not_count() -> None:
    drives = drive(0, 0.02, 0.03)
    drives.sigma[:5] = 9.0
    assert drives.sigma_m(np.array([[300.0, 5.0]]), np.array([[0, 39]]) * S)[0] == pytest.approx([0.02, 0.03])


def test_a_place_between_two_poses_has_that_of_the_nearest() -> None:
    drives = drive(0, 0.02, 0.03)
    found = drives.sigma_m(np.array([[200.0, 150.0]]), np.array([[20, 20]]) * S)
    assert found[0] == pytest.approx([0.02, 0.03])


def test_without_drives_nothing_is_added() -> None:
    none = Drives(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 6)))
    assert (none.sigma_m(np.zeros((2, 2)), np.zeros((2, 2), np.int64)) == 0.0).all()


@pytest.mark.slow
def test_poses_that_are_off_by_decimetres_make_places_that_say_so(tmp_path: Path) -> None:
    """A post beside a drive whose trajectory states 0.3 m for each axis, and is off by as much."""
    scene = Scene.load("demo").changed(
        length_m=8.0, passes=[{"lane": 2, "direction": "forward"}], profilers={"on": False},
        lidar={"range_max_m": 8.0}, vehicle={"speed_m_per_s": 16.0},
        noise={"position_m": 0.3, "time_constant_s": 600.0},
        roadside={"poles": [{"station_m": 4.0, "offset_m": -4.6, "height_m": 2.6, "diameter_m": 0.2}]},
    )  # fmt: skip
    street = Simulated(simulate(scene, tmp_path / "survey").survey_file)
    with only_kinds(Posts):
        run(session(street))
    (post,) = geopandas.read_parquet(session(street).store.path("products/assets/poles.parquet")).itertuples()
    (true,) = pd.read_parquet(street.survey_file.parent / "truth/objects.parquet").itertuples()
    assert post.sigma_horizontal_m == pytest.approx(0.3, rel=0.1)
    assert post.sigma_height_m == pytest.approx(0.3, rel=0.1)
    off = post.easting_m - true.easting_m, post.northing_m - true.northing_m, post.height_m - true.height_m
    assert 0.05 < math.hypot(*off) < 3.0 * 0.3 * math.sqrt(3.0)
