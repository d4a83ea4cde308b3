"""Streets between rows of parked cars: windows of cars and houses mirror beams, and flanks of cars stand in line."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets import classes
from roadscan.assets.ground.bare_earth import bare_earth
from roadscan.assets.ground.mirror_images import lowest_without_mirror_images
from roadscan.assets.ground.surface import Place, grid_over
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns
from roadscan.assets.settings import GroundSettings
from roadscan.simulate import Scene
from tests.assets.edges.streets import returns_of
from tests.assets.streets import Street, street

LOW_M = -3.0


def beside_a_screen(passing: float, imaged: float) -> Returns:
    """A level road, a screen of 1.5 m along its edge (y = 6 m), and 3 m below it the land behind the screen.

    passing, imaged : shares of the lines to the screen that pass it, and of which images lie up to 8 m behind it.
    """
    draw, n = np.random.default_rng(65), 200_000
    sensor = np.column_stack([draw.uniform(0.0, 20.0, n), np.full(n, 1.0), np.full(n, 2.0)])
    down = np.tan(np.radians(draw.uniform(1.0, 30.0, n)))
    turn = np.radians(draw.uniform(30.0, 150.0, n))
    away = np.minimum(2.0 / down, 5.0 / np.sin(turn))
    at_screen = (2.0 / down > 5.0 / np.sin(turn)) & (2.0 - down * away < 1.5)
    kind = draw.uniform(size=n)
    passes, image = at_screen & (kind < passing), at_screen & (kind > 1.0 - imaged) & (2.0 - down * away > 0.3)
    away[passes] = (2.0 - LOW_M) / down[passes]
    away[image] += draw.uniform(0.0, 8.0, n)[image]
    end = sensor + np.column_stack([away * np.cos(turn), away * np.sin(turn), -down * away])
    return returns_of(end, np.zeros(n), np.arange(n), sensor)


@pytest.mark.parametrize(("passing", "imaged", "least", "most"), [
    (0.0, 0.01, 0, 5), (0.1, 0.0, 350, 400), (0.3, 0.0, 500, 540),
])  # fmt: skip
def test_what_lies_low_behind_a_solid_screen_is_no_ground_and_behind_a_mesh_it_is(
    passing: float, imaged: float, least: int, most: int
) -> None:
    """Of all returns, 140, 509 and 520 cells behind the screen would be low."""
    returns = beside_a_screen(passing, imaged)
    lowest = lowest_without_mirror_images(returns, grid_over(Box(0.0, 0.0, 20.0, 20.0), 0.5), 0.15)
    assert np.abs(lowest[6:10]).max() <= 1e-3
    behind = lowest[14:]
    assert least <= np.count_nonzero(behind < -0.3) <= most


MESH_M = 0.7


def two_rows(length_m: float, mesh_m: float | None = None) -> Scene:
    """A street of 10.5 m between kerbs, driven both ways, between cars parked 1.2 m apart and the fronts of houses.

    mesh_m : how far behind the cars a mesh of 1.4 m stands (m), if one does.
    """
    scene = Scene.load("urban_street")
    side = {name: [] for name in type(scene.roadside).model_fields}
    side["vehicles"] = [
        {"what": "car", "station_m": -18.0 + 5.6 * k, "offset_m": offset, "heading_deg": heading,
         "form": (7 * k + first) % 60}
        for offset, heading, first in ((4.2, 0.0, 1), (-4.2, 180.0, 5)) for k in range(int((length_m + 36.0) / 5.6) + 1)
    ]  # fmt: skip
    side["facades"] = [
        {"offset_m": offset, "start_m": -40.0, "end_m": length_m + 40.0, "height_m": 10.0} for offset in (-8.2, 8.2)
    ]
    side["fences"] = [] if mesh_m is None else [
        {"offset_m": sign * (5.1 + mesh_m), "start_m": -20.0, "end_m": length_m + 20.0, "height_m": 1.4}
        for sign in (-1.0, 1.0)
    ]  # fmt: skip
    kerbs = [{"side": one, "height_m": 0.12} for one in ("left", "right")]
    nothing = {name: [] for name in ("humps", "patches", "potholes", "grades", "crosswalks", "stop_bars")}
    return scene.changed(
        length_m=length_m, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}], roadside=side,
        road={"alignment": [{"kind": "straight", "length_m": 200.0}], "kerbs": kerbs, "grade": 0.0, **nothing},
        lidar={"range_max_m": 30.0}, **{key: {"on": False} for key in ("profilers", "sick", "camera")},
    )  # fmt: skip


@pytest.fixture(scope="module")
def parked() -> Street:
    return street(two_rows(24.0))


@pytest.fixture(scope="module")
def meshed() -> Street:
    return street(two_rows(24.0, MESH_M))


def seen_by(parked: Street, passes: tuple[int, ...]) -> tuple[Returns, np.ndarray, np.ndarray, np.ndarray, Box]:
    """Returns of some passes, what each hit, their stations and offsets, and a window around them."""
    chosen = np.isin(parked.returns.pass_id, passes)
    returns, hit = parked.returns.at(chosen), parked.object_id[chosen]
    xy = np.stack([returns.x_m, returns.y_m])
    window = Box(*np.floor(xy.min(axis=1)).tolist(), *np.ceil(xy.max(axis=1)).tolist())
    return returns, hit, *parked.surface.station_offset_m(*(xy.T + returns.corner_m).T), window


@pytest.mark.slow
@pytest.mark.parametrize("passes", [(1,), (1, 2)])
def test_the_road_between_two_rows_of_parked_cars_is_ground(parked: Street, passes: tuple[int, ...]) -> None:
    """The second pass sees what the other sides of the street mirror: images below both fronts lifted the road off."""
    returns, hit, station, offset, window = seen_by(parked, passes)
    ground = bare_earth(Place(returns, window, GroundSettings()))
    judged = (station > 2.0) & (station < 22.0) & (hit == 0)
    road = judged & (np.abs(offset) < 2.5)
    error = ground.model.height_at(returns.x_m[road], returns.y_m[road]) - returns.height_m[road]
    assert ground.on_ground[road].mean() >= 0.999
    assert np.sqrt(np.mean(error**2)) <= 0.02
    sidewalk = judged & (np.abs(offset) > 5.4) & (np.abs(offset) < 8.0)
    assert ground.on_ground[sidewalk].mean() >= 0.75
    assert not ground.below[judged].any()


@pytest.mark.slow
@pytest.mark.parametrize("passes", [(1,), (1, 2)])
def test_cars_of_a_row_are_vehicles_and_no_fence(parked: Street, passes: tuple[int, ...]) -> None:
    """Flanks that count as lines leave 13 % of the returns on cars over by one pass."""
    returns, hit, station, offset, window = seen_by(parked, passes)
    drive = parked.drive_xyh_m[np.isin(parked.drive_xyh_m[:, 3], passes)]
    scene = make_scene(returns, window, window, drive)
    car = (hit > 0) & (np.abs(offset) < 5.2) & (station > 2.0) & (station < 22.0) & (scene.above_ground_m > 0.3)
    assert np.isin(scene.classes[car], (classes.VEHICLE, classes.PERSON)).mean() >= 0.98


@pytest.mark.slow
@pytest.mark.parametrize(("passes", "least"), [((1,), 0.8), ((1, 2), 0.4)])
def test_a_mesh_close_behind_a_row_of_cars_is_parted_from_them(
    meshed: Street, passes: tuple[int, ...], least: float
) -> None:
    """Where the rim alone is cut out of the row, 0.32 and 0.03 of the returns of the mesh are left."""
    returns, hit, station, offset, window = seen_by(meshed, passes)
    scene = make_scene(returns, window, window, meshed.drive_xyh_m[np.isin(meshed.drive_xyh_m[:, 3], passes)])
    judged = (hit > 0) & (station > 2.0) & (station < 22.0) & (scene.above_ground_m > 0.3)
    is_user = np.isin(scene.classes, (classes.VEHICLE, classes.PERSON))
    assert (~is_user)[judged & (np.abs(np.abs(offset) - 5.1 - MESH_M) < 0.12)].mean() >= least
    assert is_user[judged & (np.abs(offset) < 5.2)].mean() >= 0.98
