"""A car's trajectory from its raw IMU and RTK logs, through the command line's own jobs, against the RTK positions."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from roadscan.core.errors import RunError
from roadscan.store.query.sql import query
from tests.real_data.conftest import Place


@pytest.mark.slow
def test_the_recorded_drive_through_the_survey_file(place: Place) -> None:
    file = place.folder / "drive.toml"
    lines = place.run(file, "ingest", "navigate")
    assert any(line.startswith("computed: drive/navigation") for line in lines)
    assert not any(line.startswith("doubtful") for line in lines)
    store = place.store(file)
    poses = query(store, "SELECT * FROM trajectory ORDER BY epoch_gps_ns").to_pandas()
    gnss = query(store, "SELECT * FROM gnss ORDER BY epoch_gps_ns").to_pandas()
    assert (len(gnss), query(store, "SELECT count(*) AS n FROM imu").to_pylist()[0]["n"]) == (2197, 54_858)
    since = (poses["epoch_gps_ns"] - poses["epoch_gps_ns"].iloc[0]).to_numpy() * 1e-9
    asked = (gnss["epoch_gps_ns"] - poses["epoch_gps_ns"].iloc[0]).to_numpy() * 1e-9
    inside = (asked > 0.0) & (asked < since[-1])
    arms = (
        query(
            store,
            "SELECT axis, avg(value) AS arm FROM navigation_states WHERE state = 'antenna_lever_arm_body_m' "
            "GROUP BY axis ORDER BY axis",
        )
        .to_pandas()["arm"]
        .to_numpy()
        .copy()
    )
    assert np.abs(arms - [0.0, -0.05, -0.65]).max() < 0.1
    turn = Rotation.from_quat(poses[["qw", "qx", "qy", "qz"]].to_numpy(), scalar_first=True)
    antenna = poses[["x_world_m", "y_world_m", "z_world_m"]].to_numpy() + turn.apply(arms)
    away = CubicSpline(since, antenna - antenna[0])(asked[inside])
    away -= gnss[["x_world_m", "y_world_m", "z_world_m"]].to_numpy()[inside] - antenna[0]
    level = pyproj.Transformer.from_pipeline(
        "+proj=topocentric +ellps=WGS84 +X_0={} +Y_0={} +Z_0={}".format(*antenna[0])
    )
    east, north, up = level.transform(*(antenna[0] + away).T)
    assert np.sqrt(np.mean(np.hypot(east, north) ** 2)) < 0.03
    assert np.sqrt(np.mean(np.square(up))) < 0.02
    assert store.exists("products/navigation/drive.png")


def test_axes_that_are_not_the_imus_are_refused(place: Place) -> None:
    rig = (place.folder / "drive_rig.toml").read_text()
    lines = rig.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("body_from_sensor"))
    lines[start : start + 5] = ['axes = "frd"']
    (place.folder / "drive_wrong_rig.toml").write_text("\n".join(lines))
    file = place.file(
        "drive.toml",
        {'"drive_rig.toml"': '"drive_wrong_rig.toml"', 'id = "drive"\ntitle': 'id = "wrong"\ntitle'},
        "wrong.toml",
    )
    with pytest.raises(RunError, match="gravity"):
        place.run(file, "ingest", "navigate")
