"""What moves is hidden where it is when a picture is taken: an oncoming car and a person who walks, simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from roadscan.measuring.measure import posed_pictures
from roadscan.privacy.hider import ClassedReturns, Hider
from roadscan.privacy.settings import PrivacyConfig
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate
from tests.measuring.drive import CAMERA, Drive

pytestmark = pytest.mark.nightly

CAR = {"what": "car", "station_m": 50.0, "offset_m": -1.8, "speed_m_per_s": -8.0}
PERSON = {"what": "person", "station_m": 22.0, "offset_m": -4.5, "speed_m_per_s": 1.4}
SIZES = {"car": (4.4, 1.8, 1.5), "person": (0.5, 0.5, 1.7)}
LARGE_PX = {"car": 45.0, "person": 15.0}
"""Width from which they are asked for: the car at 25 m; farther away its returns are too few to be classed."""


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    scene = Scene.load("demo").changed(
        length_m=40.0, profilers={"on": False}, lidar={"range_max_m": 40.0}, camera=CAMERA | {"every_m": 3.0},
        passes=[{"lane": 2}], roadside={"moving_cars": [CAR, PERSON]},
    )  # fmt: skip
    one = Drive(simulate(scene.noiseless(), tmp_path_factory.mktemp("moving") / "survey").survey_file)
    with one.survey_file.open("a") as survey:
        survey.write('\n[assets]\nkinds = ["pole"]\nexports = []\nbare_earth = false\nintensity = "raw"\n')
    one.run(products__make=["tile_table"], adjust__on=False)
    return one


def outline_px(drive: Drive, file: str, thing: dict[str, object], seconds: float) -> np.ndarray | None:
    """Least and greatest pixel of a moving thing's box; None where it is not wholly in the picture."""
    length, width, height = SIZES[str(thing["what"])]
    station = float(thing["station_m"]) + float(thing["speed_m_per_s"]) * seconds  # type: ignore[arg-type]
    corners = []
    for a, b in ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)):
        east, north, _ = drive.known.surface.place(
            np.array([station + a * length]), float(thing["offset_m"]) + b * width
        )  # type: ignore[arg-type]
        ground = float(drive.known.height_m(east, north)[0])
        corners += [[east[0], north[0], ground + up] for up in (0.2, height)]
    pixel = drive.pixels(file, np.array(corners))
    return np.array([pixel.min(axis=0), pixel.max(axis=0)]) if np.isfinite(pixel).all() else None


def test_what_moves_is_hidden_where_it_is(street: Drive, tmp_path: Path) -> None:
    session = Session.open(street.survey_file)
    poses = posed_pictures(session).pictures
    hider = Hider(PrivacyConfig(pictures="blur"), ClassedReturns.of(session), None)
    first = min(pose["epoch_gps_ns"] for pose in street.poses.values())
    covered: dict[str, list[float]] = {"car": [], "person": []}
    for number, file in enumerate(poses.files):
        regions = hider.regions(poses, number, np.zeros((1, 1, 3), np.uint8))
        mask = np.zeros((400, 640), bool)
        for one in regions:
            mask[max(0, int(one.top)) : int(one.bottom) + 1, max(0, int(one.left)) : int(one.right) + 1] = True
        for thing in (CAR, PERSON):
            box = outline_px(street, file, thing, (int(poses.epochs_gps_ns[number]) - first) / 1e9)
            if box is not None and box[1, 0] - box[0, 0] >= LARGE_PX[str(thing["what"])]:
                (left, top), (right, bottom) = box.astype(int)
                covered[str(thing["what"])].append(float(mask[top : bottom + 1, left : right + 1].mean()))
    assert len(covered["car"]) >= 4 and len(covered["person"]) >= 3
    assert min(covered["car"]) > 0.95 and min(covered["person"]) > 0.95
