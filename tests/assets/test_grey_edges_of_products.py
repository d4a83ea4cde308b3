"""The edge between asphalt and a flush sidewalk in products, with sharp shadows along the road."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.asset_streets import processed
from benchmarks.grey_streets import grey_street, score, shade
from roadscan.simulate import simulate

KINDS = "kinds = ['road_edge', 'lane_line']\nclassified = false\nbare_earth = false\nexports = []\n"


@pytest.mark.slow
def test_pictures_show_the_edge_of_a_flush_sidewalk_before_a_facade(tmp_path: Path) -> None:
    """A street of 40 m: returns alone take the façade behind the sidewalk for the edge of the road."""
    scene = grey_street(2, "HDL-32E").changed(length_m=40.0)
    raw, found = tmp_path / "raw", {}
    simulate(scene, raw)
    shade(raw, 2, edge=True)
    survey = (raw / "SURVEY.toml").read_text()
    for name, pictures in (("alone", "[assets.pictures]\non = false\n"), ("with pictures", "")):
        folder = tmp_path / name
        shutil.copytree(raw, folder)
        (folder / "SURVEY.toml").write_text(f"{survey}\n[assets]\n{KINDS}{pictures}")
        processed(scene, folder)
        found[name] = score(folder, folder / "SURVEY.toml")
    alone, both = found["alone"], found["with pictures"]
    assert alone.near[1] < 0.1
    assert both.near[1] > alone.near[1] + 0.3
    assert both.right > alone.right + 0.3
    assert both.by_type_m["surface"] > 15.0
    assert float(np.sqrt(np.mean(both.errors_m**2))) < 3.0 * float(np.sqrt(np.mean(both.sigmas_m**2)))
