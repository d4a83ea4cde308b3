"""What a scene refuses, what it leaves out, and the two sides of a sign."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import ConfigError
from roadscan.simulate.kernels.profiles import in_the_way
from roadscan.simulate.scene import Scene, shipped_scenes
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_of, objects_table

LEVEL = {"cross_slope": 0.0, "grade": 0.0, "verge_slope": 0.0}


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("length_m = nan", "length_m"),
        ("pause_s = inf", "pause_s"),
        ("[map]\neasting_m = nan", "map.easting_m"),
        ("[road]\nlead_m = inf", "road.lead_m"),
        ("[[road.humps]]\nstation_m = nan", "road.humps.0.station_m"),
        ("[[road.cracks]]\npoints_m = [[1.0, 2.0], [inf, 2.0]]", "road.cracks.0.points_m.1.0"),
        ("[[road.markings]]\noffset_m = 0.0\nstart_m = nan", "road.markings.0.start_m"),
        ("[[road.markings]]\noffset_m = 0.0\nend_m = -inf", "road.markings.0.end_m"),
        ("[[road.markings]]\noffset_m = inf", "road.markings.0.offset_m"),
        ("[[roadside.poles]]\nstation_m = 1.0\noffset_m = nan", "roadside.poles.0.offset_m"),
        ("[[roadside.fences]]\noffset_m = 5.0\nstart_m = 1.0\nend_m = inf", "roadside.fences.0.end_m"),
        ("[profilers.left]\nlever_arm_body_m = [0.0, nan, 0.0]", "profilers.left.lever_arm_body_m.1"),
        ("[lidar.clock]\noffset_s = nan", "lidar.clock.offset_s"),
        ("[noise]\nposition_m = inf", "noise.position_m"),
    ],
)
def test_numbers_are_finite(text: str, where: str, tmp_path: Path):
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        Scene.load(file)
    assert where in str(error.value)


def test_open_ends_are_infinite():
    Scene().changed(
        road={
            "markings": [{"offset_m": 0.0, "start_m": -math.inf, "end_m": math.inf}],
            "joints": [{"spacing_m": 5.0, "start_m": -math.inf, "end_m": math.inf}],
        }
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": "1980-12-31T23:59:59Z"}, "1981 to 2079"),
        ({"start": "2080-01-01T00:00:00Z"}, "1981 to 2079"),
        ({"start": "0001-01-01T00:00:00+05:00"}, "1981 to 2079"),
        ({"road": {"lead_m": 1001.0}}, "lead_m"),
        ({"road": {"grades": [{"station_m": 5.0, "grade": 0.1, "curve_m": 0.4}]}}, "curve_m"),
        ({"road": {"targets": [{"station_m": 146.0, "offset_m": 0.0}]}}, "road.targets.0.station_m.*beyond the road"),
        ({"road": {"kerbs": [{"side": "left", "ramps": [{"station_m": 5.0, "length_m": 0.4}]}]}}, "length_m"),
    ],
)
def test_what_is_refused(change: dict[str, object], words: str):
    with pytest.raises(ConfigError, match=words):
        Scene().changed(**change)


@pytest.mark.parametrize(
    ("patch", "is_refused"),
    [
        ({"width_m": 0.4, "edge_m": 0.21}, True),
        ({"width_m": 0.4, "edge_m": 0.2}, False),
        ({"shape": "circle", "length_m": 0.5, "edge_m": 0.26}, True),
        ({"shape": "circle", "length_m": 1.0, "width_m": 0.2, "edge_m": 0.4}, False),
    ],
)
def test_patches_reach_their_height(patch: dict[str, object], is_refused: bool):
    patch = {"station_m": 20.25, "offset_m": 1.0, "height_m": -0.02, **patch}
    road = LEVEL | {"patches": [patch]}
    if is_refused:
        with pytest.raises(ConfigError, match=r"edge_m .* more than half"):
            Scene().changed(road=road)
        return
    surface = Surface(Scene().changed(road=road))
    easting, northing, _ = surface.place(20.25, 1.0)
    assert surface.height_m(easting, northing) - surface.origin_enh_m[2] == pytest.approx(-0.02, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("[[roadside.poles]]\nstation_m = 145.1\noffset_m = 5.0", "roadside.poles.0.station_m"),
        ("[[roadside.fences]]\noffset_m = 5.0\nstart_m = -45.2\nend_m = 9.0", "roadside.fences.0.start_m"),
        ("[[roadside.facades]]\noffset_m = 9.0\nstart_m = 5.0\nend_m = 146.0", "roadside.facades.0.end_m"),
        (
            "[[roadside.moving_cars]]\nstation_m = -50.0\noffset_m = 0.0\nspeed_m_per_s = 9.0",
            "roadside.moving_cars.0.station_m",
        ),
    ],
)
def test_things_beyond_the_road_are_refused(text: str, where: str, tmp_path: Path):
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=f"{where}.*goes from -45 to 145") as error:
        Scene.load(file)
    assert str(file) in str(error.value)


@pytest.mark.parametrize("name", [name for name in shipped_scenes() if name != "demo"])
def test_shortened_scenes_leave_out_what_lies_beyond(name: str):
    scene = Scene.load(name)
    targets = [t for t in scene.road.targets if t.station_m < 20.0]
    scene = scene.changed(length_m=20.0, road={"targets": targets})
    surface = Surface(scene)
    table = objects_table(scene, surface)
    first, last = scene.stations_m
    assert first <= np.min(table["station_m"], initial=0.0) <= np.max(table["station_m"], initial=0.0) <= last
    middle = np.concatenate([np.zeros((0, 2)), *(o.bodies[:, 1:3] for o in objects_of(scene, surface))])
    station, _ = surface.station_offset_m(*(middle + surface.origin_enh_m[:2]).T)
    assert not station.size or first - 5.0 < station.min() <= station.max() < last + 5.0


@pytest.mark.parametrize("shape", ["round", "rectangle"])
@pytest.mark.parametrize(("faces", "seen_from"), [("backward", -3.0), ("forward", 3.0)])
def test_signs_have_a_face_and_a_back(shape: str, faces: str, seen_from: float):
    sign = {"station_m": 10.0, "offset_m": 5.0, "shape": shape, "faces": faces}
    scene = Scene().changed(map={"crs": "local", "azimuth_deg": 0.0}, road=LEVEL, roadside={"signs": [sign]})
    bodies = objects_of(scene, Surface(scene))[0].bodies

    def shade_from(ahead: float) -> float:
        # Along the road (north), aside of the post.
        beam = np.zeros((3, 3))
        beam[:, 0] = 5.2, 10.0 + ahead, 2.5
        beam[1, 1] = -np.sign(ahead)
        body, r = in_the_way(bodies, beam, 0.0, 99.0, np.uint64(1))
        assert r == pytest.approx(abs(ahead), abs=0.05)
        return float(bodies[body, 16])

    assert shade_from(seen_from) == 250.0
    assert shade_from(-seen_from) == 90.0
