"""A wall between two carriageways, seen from one side and from both: found, and as high as it is."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kinds.kerb import Kerb, KerbOptions
from roadscan.assets.kinds.surfaces import Barrier, Fence, Guardrail, SurfaceKind, Wall
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.simulate import Scene
from tests.assets.streets import Street, street

LENGTH_M, HEIGHT_M, THICK_M = 22.0, 0.85, 0.25


def divided_road(radius_m: float) -> Scene:
    """Two lanes on both sides of a concrete wall, driven there and back 6.75 m beside it; radius 0: straight."""
    scene = Scene.load("urban_street")
    side = {name: [] for name in type(scene.roadside).model_fields}
    side["walls"] = [{"offset_m": 0.0, "start_m": 1.0, "end_m": LENGTH_M + 1.0, "height_m": HEIGHT_M,
                      "thickness_m": THICK_M}]  # fmt: skip
    bend = {"kind": "arc", "radius_m": radius_m} if radius_m else {"kind": "straight"}
    nothing = {name: [] for name in ("humps", "patches", "potholes", "grades", "crosswalks", "stop_bars", "kerbs")}
    return scene.changed(
        length_m=LENGTH_M + 2.0, passes=[{"lane": 3}, {"lane": 2, "direction": "backward"}], roadside=side,
        road={"alignment": [{"length_m": 200.0, **bend}], "grade": 0.0, "lanes": 4, "lane_width_m": 4.5, **nothing},
        lidar={"range_max_m": 30.0}, **{key: {"on": False} for key in ("profilers", "sick", "camera")},
    )  # fmt: skip


@pytest.fixture(scope="module", params=[0.0, 60.0], ids=["straight", "curved"])
def driven(request: pytest.FixtureRequest) -> Street:
    return street(divided_road(request.param))


@pytest.mark.slow
@pytest.mark.parametrize("passes", [(1,), (1, 2)])
def test_each_face_that_was_seen_is_a_barrier_as_high_as_it_is(driven: Street, passes: tuple[int, ...]) -> None:
    """A voxel holds both faces, 0.25 m apart; and from above the top is seen with each."""
    returns = driven.returns.at(np.isin(driven.returns.pass_id, passes))
    xy = np.stack([returns.x_m, returns.y_m])
    window = Box(*np.floor(xy.min(axis=1)).tolist(), *np.ceil(xy.max(axis=1)).tolist())
    scene = make_scene(returns, window, window, driven.drive_xyh_m[np.isin(driven.drive_xyh_m[:, 3], passes)])
    kinds: list[SurfaceKind] = [Barrier(), Guardrail(), Wall(), Fence()]
    found = {kind.name: list(kind.objects(kind.evidence(scene, None).pieces, None, {})) for kind in kinds}
    assert [name for name, objects in found.items() if objects] == ["barrier"]
    along = dict.fromkeys([THICK_M, 0.0][: len(passes)], 0.0)
    for one in found["barrier"]:
        offset = driven.surface.station_offset_m(*np.array(one.geometry.coords)[:, :2].T)[1]
        face = min(along, key=lambda place: abs(place - float(np.median(offset))))
        assert np.abs(offset - face).max() <= 0.06
        assert abs(one.attributes["asset_height_m"] - HEIGHT_M) <= 0.03
        along[face] += one.attributes["length_m"]
    assert min(along.values()) >= 0.95 * LENGTH_M
    kerb, options = Kerb(), KerbOptions()
    for one in kerb.objects(kerb.joined(kerb.evidence(scene, options).pieces), options, {}):
        offset = driven.surface.station_offset_m(*np.array(one.geometry.coords)[:, :2].T)[1]
        assert np.abs(offset - THICK_M / 2).min() >= 1.0
