"""σ of the place and the diameter of shafts against the simulator's truth."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.upright.shafts import sigma_of
from roadscan.assets.upright.standing import uprights_of
from tests.assets.upright.scene import simulated


@pytest.mark.slow
def test_sigma_is_as_large_as_the_errors() -> None:
    """Poles, lamp posts and trunks of the short street: RMS of error over σ of places and radii."""
    scene, table = simulated()
    places, radii = [], []
    standing = table[table["kind"].isin(["pole", "lamp_post", "tree", "signal"])]
    for one in uprights_of(scene):
        x, y = one.shaft.foot_xy_m
        off = np.stack([standing["x"] - x, standing["y"] - y])
        nearest = int(np.argmin(np.hypot(*off)))
        if np.hypot(*off[:, nearest]) > 0.3:
            continue
        sigma, true = sigma_of(scene, one.shaft), standing.iloc[nearest]
        places += list(off[:, nearest] / sigma.place_m)
        if true["kind"] == "pole":
            radii.append((one.shaft.axis.radius_m - true["width_m"] / 2.0) / sigma.radius_m)
    assert len(places) >= 16 and len(radii) >= 5
    assert np.sqrt(np.mean(np.square(places))) <= 1.5
    assert np.sqrt(np.mean(np.square(radii))) <= 1.5
    assert np.sqrt(np.mean(np.square(places))) >= 0.2
