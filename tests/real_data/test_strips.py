"""A vendor's cloud: in, tiled, out again, and nothing lost."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pytest
import round_trip

from roadscan.core.errors import RunError
from tests.real_data.conftest import Place

STEPS = dict.fromkeys("xyz", 0.01)


def round_tripped(place: Place, survey_file: Path, steps: dict[str, float]) -> pd.DataFrame:
    place.run(survey_file)
    tiles = sorted(place.products(survey_file).glob("tiles/las/*.laz"))
    assert len(tiles) > 5
    return round_trip.in_order(pd.concat([round_trip.recorded(tile, steps) for tile in tiles]))


@pytest.mark.slow
def test_nothing_is_lost(place: Place, strips_las: Path) -> None:
    original = round_trip.in_order(round_trip.recorded(strips_las, STEPS))
    assert len(original) == 14_408
    made = round_tripped(place, place.folder / "strips.toml", STEPS)
    assert len(made) == len(original)
    assert set(round_trip.differences(original, made).values()) == {0}
    assert sorted(made.source_id.unique()) == [54, 55, 56, 58]
    assert (original.nunique() > 1).sum() >= 11  # most fields could differ


def test_every_field_of_the_file_is_compared(strips_las: Path) -> None:
    names = set(laspy.read(strips_las).point_format.dimension_names)
    compared = set(round_trip.recorded(strips_las, STEPS).columns) - {"x", "y", "z", "scan_angle_deg", "source_id"}
    assert names - compared == {"X", "Y", "Z", "scan_angle_rank", "point_source_id"}


def test_nothing_is_lost_in_feet(place: Place, strips_las: Path) -> None:
    """The file names no CRS; taken as feet, its coordinates and heights come back in feet."""
    changed = {
        'id = "strips"': 'id = "strips-ft"',
        '[map.local]\nname = "as the file: its CRS is not stated"': '[map]\ncrs = "EPSG:3419"',
        'crs = "local"': 'crs = "EPSG:3419"\nheight = "ellipsoidal"\noptions = { vertical_unit = "us_survey_foot" }',
    }
    survey_file = place.file("strips.toml", changed, "strips-ft.toml")
    made = round_tripped(place, survey_file, STEPS)
    original = round_trip.in_order(round_trip.recorded(strips_las, STEPS))
    assert set(round_trip.differences(original, made).values()) == {0}
    tile = next(place.products(survey_file).glob("tiles/las/*.laz"))
    header = laspy.read(tile).header
    assert header.parse_crs().axis_info[0].unit_name == "US survey foot"
    assert np.all(header.scales <= 0.001)


def test_a_bit_that_belies_the_stamps_is_refused(place: Place, strips_las: Path) -> None:
    changed = {'clock = { system = "gps_adjusted" }': "", 'id = "strips"': 'id = "strips-wrong"'}
    survey_file = place.file("strips.toml", changed, "strips-wrong.toml")
    with pytest.raises(
        RunError, match=r"seconds of the GPS week.*159214342\.370.*clock = \{ system = \"gps_adjusted\""
    ):
        place.run(survey_file, "ingest")
    assert place.records(survey_file) == []
