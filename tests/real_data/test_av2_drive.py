"""The Argoverse 2 drive: sweeps placed by quaternion poses, against the city's raster of ground heights."""

from __future__ import annotations

from pathlib import Path

import ground_raster
import numpy as np
import pandas as pd
import pytest
from las_points import read_points
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from tests.real_data.conftest import Place


@pytest.fixture(scope="module")
def points(place: Place, av2: Path) -> pd.DataFrame:
    return read_points(place.products(av2))


@pytest.mark.slow
def test_ground_returns_lie_on_the_citys_raster(place: Place, points: pd.DataFrame) -> None:
    """Published: median −0.006 m, median absolute deviation 0.026 m."""
    above = ground_raster.ground(ground_raster.differences(points, place.recordings / "av2_drive"))
    assert len(above) > 25_000
    assert abs(above.median()) <= 0.01
    assert ground_raster.deviation(above) <= 0.03


@pytest.mark.slow
def test_every_return_is_where_its_sweeps_pose_puts_it(place: Place, points: pd.DataFrame) -> None:
    folder = place.recordings / "av2_drive"
    poses = pd.read_feather(folder / "city_SE3_egovehicle.feather").set_index("timestamp_ns")
    expected = []
    for file in (folder / "sensors" / "lidar").glob("*.feather"):
        pose = poses.loc[int(file.stem)]
        turn = Rotation.from_quat([pose.qx, pose.qy, pose.qz, pose.qw])
        sweep = pd.read_feather(file)[["x", "y", "z"]].to_numpy().astype(float)
        expected.append(turn.apply(sweep) + pose[["tx_m", "ty_m", "tz_m"]].to_numpy())
    made, true = points[["x", "y", "z"]].to_numpy(), np.concatenate(expected)
    assert len(made) == len(true) == 198_695
    for one, other in ((made, true), (true, made)):
        distance, _ = KDTree(other).query(one)
        assert distance.max() < 1e-4  # coordinates are written in steps of 0.1 mm
