"""The edge between asphalt and a flush sidewalk in products, with sharp shadows along the road."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.asset_streets import processed
from benchmarks.grey_streets import grey_street, score, shade
from benchmarks.lawn_streets import with_and_without_pictures
from roadscan.simulate import simulate

KINDS = "kinds = ['road_edge', 'lane_line']\nclassified = false\nbare_earth = false\nexports = []\n"


@pytest.mark.slow
def test_pictures_show_the_edge_of_a_flush_sidewalk_before_a_facade(tmp_path: Path) -> None:
    """A street of 40 m: returns alone take the façade behind the sidewalk for the edge of the road."""
    scene = grey_street(2, "HDL-32E").changed(length_m=40.0)
    raw, found = tmp_path / "raw", {}
    simulate(scene, raw)
    shade(raw, 2, edge=True)
    for name, file in with_and_without_pictures(raw / "SURVEY.toml", tmp_path, KINDS):
        processed(scene, file.parent)
        found[name] = score(file.parent, file)
    alone, both = found["returns alone"], found["with pictures"]
    assert alone.near[1] < 0.1
    assert both.near[1] > alone.near[1] + 0.3
    assert both.right > alone.right + 0.3
    assert both.by_type_m["surface"] > 15.0
    assert float(np.sqrt(np.mean(both.errors_m**2))) < 3.0 * float(np.sqrt(np.mean(both.sigmas_m**2)))
