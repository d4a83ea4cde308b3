"""Pictures of a place, against OpenCV's projection with the simulator's true poses."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.simulate import simulate, truth
from roadscan.simulate.path import Earth
from tests.surveys import Simulated, small_scene

LENS = {"on": True, "every_m": 3.0, "width_px": 320, "height_px": 240, "focal_px": 260.0,
        "distortion": [-0.10, 0.02, 0.001, -0.002, 0.0]}  # fmt: skip
NO_FILES: dict[str, object] = {"products__make": ["tile_table"], "adjust__on": False}


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """The small survey without errors, with a camera."""
    scene = small_scene(camera=LENS, passes=[{"lane": 2}]).noiseless()
    one = Simulated(simulate(scene, tmp_path_factory.mktemp("where") / "survey").survey_file)
    one.run(**NO_FILES)
    return one


def projected(folder: Path, place: np.ndarray) -> dict[str, tuple[float, float, float]]:
    """Pixel and distance of a place on the map by picture, where it is in the picture."""
    known = truth.load(folder)
    world = Earth(known.scene.map.crs).ecef_from_map(place.reshape(1, 3))[0]
    matrix = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1.0]])
    found = {}
    for pose in pq.read_table(known.camera_file("run-1")).to_pylist():
        turn = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")])
        forward_right_down = turn.inv().apply(world - [pose[f"{a}_world_m"] for a in "xyz"])
        opencv = forward_right_down[[1, 2, 0]]
        if opencv[2] < 0.5 or np.hypot(opencv[0], opencv[1]) > 1.2 * opencv[2]:
            continue
        ((u, v),) = cv2.projectPoints(
            opencv.reshape(1, 3), np.zeros(3), np.zeros(3), matrix, np.array(LENS["distortion"])
        )[0][0]
        if 1.0 <= u <= 318.0 and 1.0 <= v <= 238.0:
            found[Path(pose["file"]).name] = (float(u), float(v), float(np.linalg.norm(opencv)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("above_m", [0.0, 1.5])
def test_pictures_of_a_place_are_those_that_a_projection_gives(driven: Simulated, above_m: float) -> None:
    known = truth.load(driven.survey_file.parent)
    east, north, _ = known.surface.place(np.array([9.0]), 1.0)
    ground = float(known.height_m(east, north)[0])
    place = np.array([east[0], north[0], ground + above_m])
    survey = rs.open_survey(driven.survey_file)
    frame = survey.pictures_of(*place[:2], None if above_m == 0.0 else place[2])
    expected = projected(driven.survey_file.parent, place)
    assert len(frame) >= 2 and {file.name for file in frame["file"]} == set(expected)
    assert frame["resolution_m"].is_monotonic_increasing
    for row in frame.itertuples():
        u, v, distance = expected[row.file.name]
        assert np.hypot(row.u_px - u, row.v_px - v) < 0.5
        assert row.distance_m == pytest.approx(distance, abs=0.01)
        assert row.file.is_file()
    told = CliRunner().invoke(app, ["where", *map(str, place), "--survey", str(driven.survey_file)])
    assert told.exit_code == 0 and str(frame["file"][0]) in told.stdout.splitlines()[2]


@pytest.mark.slow
def test_a_place_beyond_the_survey_needs_a_height(driven: Simulated) -> None:
    with pytest.raises(ConfigError, match="no cell lies within 1 m"):
        rs.open_survey(driven.survey_file).pictures_of(0.0, 0.0)
