"""Lines that pictures show, in products of a survey whose lidar tells little of paint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.asset_streets import processed
from benchmarks.lawn_streets import with_and_without_pictures
from benchmarks.paint_streets import paint_street, score
from roadscan.simulate import simulate

KINDS = "kinds = ['lane_line', 'road_marking']\nclassified = false\nbare_earth = false\nexports = []\n"


@pytest.mark.slow
def test_pictures_add_lines_to_products_where_intensity_is_noise(tmp_path: Path) -> None:
    """A street of 34 m whose intensities scatter by half of the asphalt's: the lidar misses a tenth of the paint."""
    scene = paint_street(5, "HDL-32E", intensity_noise=40.0).changed(length_m=34.0)
    raw, found = tmp_path / "raw", {}
    simulate(scene, raw)
    for name, file in with_and_without_pictures(raw / "SURVEY.toml", tmp_path, KINDS):
        street = processed(scene, file.parent)
        found[name] = score(file.parent, file), street.tables["lane_line"]
    (alone, own), (both, lines) = found["returns alone"], found["with pictures"]
    assert both.found >= alone.found + 0.015
    assert both.right >= alone.right - 0.01
    assert both.marking_f1 > alone.marking_f1
    assert (own["returns"] > 0).all()
    assert (lines["returns"] == 0).any()
    assert (lines["first_epoch_gps_ns"] >= own["first_epoch_gps_ns"].min()).all()
    assert (lines["passes"] > 0).all()
    assert float(np.sqrt(np.mean(both.aside_m**2))) < 2.0 * float(np.sqrt(np.mean(both.aside_sigma_m**2)))
