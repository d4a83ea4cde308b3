"""A robot's scans in the ACES building: placed by odometry, matched to each other, against relations made by hand."""

from __future__ import annotations

import bz2
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pytest
import scan_matching

from roadscan.core.survey import Survey
from roadscan.run.session import Session
from roadscan.survey.status import survey_status
from tests.real_data.conftest import Place

OFFSET_S = 10**9
"""Added to the log's stamps by the survey file; as GPS time, which LAS writes less 10⁹ s."""


@pytest.fixture(scope="module")
def aces(place: Place) -> Path:
    """The survey, finished."""
    survey_file = place.folder / "aces.toml"
    place.run(survey_file)
    return survey_file


@pytest.fixture(scope="module")
def recorded(place: Place) -> np.ndarray:
    """What :func:`recorded_scans` reads."""
    return recorded_scans(place.recordings)


def recorded_scans(recordings: Path) -> np.ndarray:
    """(7374, 184) stamp, x, y, θ and 180 ranges of each scan, by plain Python."""
    text = bz2.decompress((recordings / "lms" / "aces.clf.bz2").read_bytes()).decode()
    lines = [line.split() for line in text.splitlines() if line.startswith("FLASER ")]
    return np.array([[float(w) for w in (line[188], *line[182:185], *line[2:182])] for line in lines])


@pytest.fixture(scope="module")
def points(place: Place, aces: Path) -> pd.DataFrame:
    """Points of the written LAS tiles: stamp, x, y, z."""
    tiles = [laspy.read(file) for file in sorted((place.products(aces) / "tiles" / "las").glob("*.laz"))]
    names = {"stamp": "gps_time", "x": "x", "y": "y", "z": "z"}
    return pd.concat([pd.DataFrame({n: np.asarray(tile[of]) for n, of in names.items()}) for tile in tiles])


def expected_points(recorded: np.ndarray, turning: int = 1, farthest_m: float = 30.0) -> pd.DataFrame:
    """Where the beams end: beam k looks k − 90° from ahead, counter-clockwise seen from above."""
    x, y, theta = recorded[:, 1:4].T
    ranges = recorded[:, 4:]
    angle = theta[:, None] + turning * np.radians(np.arange(180) - 90.0)
    kept = ranges <= farthest_m
    return pd.DataFrame(
        {
            "stamp": np.repeat(recorded[:, 0], 180)[kept.ravel()],
            "x": (x[:, None] + ranges * np.cos(angle))[kept],
            "y": (y[:, None] + ranges * np.sin(angle))[kept],
        }
    )


def cells(points: pd.DataFrame) -> int:
    """Cells of 5 cm with a point in them."""
    column, row = np.floor(points[["x", "y"]].to_numpy() / 0.05).astype(np.int64).T
    return len(np.unique(column * 1_000_000 + row))


@pytest.mark.slow
def test_every_reading_is_accounted_for(place: Place, aces: Path, recorded: np.ndarray) -> None:
    assert recorded.shape == (7_374, 184)
    status = survey_status(Session(Survey.load(aces), place.store(aces)))
    assert status.is_complete
    ranges = recorded[:, 4:]
    assert sum(status.readings.values()) == ranges.size == 7_374 * 180
    assert status.readings["no_return"] == (ranges == 50.0).sum()
    assert status.readings["range"] == ((ranges > 30.0) & (ranges != 50.0)).sum()
    assert status.readings["kept"] == (ranges <= 30.0).sum()


@pytest.mark.slow
def test_points_lie_where_plain_trigonometry_puts_them(points: pd.DataFrame, recorded: np.ndarray) -> None:
    expected = expected_points(recorded)
    assert len(points) == len(expected) > 1_300_000
    assert np.abs(points.z).max() == 0.0
    order = ["stamp", "x", "y"]
    found = points.assign(stamp=points.stamp.round(5)).sort_values(order)[order].to_numpy()
    wanted = expected.round({"stamp": 5, "x": 4, "y": 4}).sort_values(order)[order].to_numpy()
    assert np.abs(found[:, 0] - wanted[:, 0]).max() < 2e-5
    # LAS holds 0.1 mm; a tie of rounding may swap two points of a scan that share an x.
    assert np.quantile(np.abs(found[:, 1:] - wanted[:, 1:]), 0.999) < 1.5e-4
    assert np.abs(found[:, 1] - wanted[:, 1]).max() < 1.5e-4


@pytest.mark.slow
def test_walls_coincide(points: pd.DataFrame, recorded: np.ndarray) -> None:
    """Beams taken the other way round smear the building over nearly twice as many cells."""
    right, wrong = cells(points), cells(expected_points(recorded, turning=-1))
    assert right < 0.65 * wrong


@pytest.mark.slow
def test_relations_are_reproduced(place: Place, aces: Path) -> None:
    """1,189 relations are of poses less than 30 s apart, 90 close a loop; odometry drifts by up to 19 m.

    The relations are no finer than 5 cm: the odometry's translation is corrected by nothing at all in 463 near ones,
    and in 92 % by a step of a lattice of 5 cm. A perfect matcher would show a median of 2 cm.
    """
    recording = scan_matching.read_recording(aces)
    relations = scan_matching.read_relations(place.recordings / "lms" / "aces.relations.gz")
    assert (len(recording.stamps_s), len(relations)) == (7_374, 1_279)
    found = scan_matching.reproduce(recording, relations)
    rows = scan_matching.summary(found)
    assert rows.pairs.tolist()[:3] == [1_189, 1_189, 90]
    odometry, matching = rows.loc["near, odometry"], rows.loc["near, matching"]
    assert odometry[["median_m", "q95_m"]].to_numpy() == pytest.approx([0.050, 0.100], abs=5e-4)
    assert matching.median_m < 0.03
    assert matching.q95_m < 0.095
    assert matching.median_deg < 0.25 < 0.4 < odometry.median_deg
    assert matching.q95_deg < 1.0 < 3.0 < odometry.q95_deg
    assert ((found.odometry_m < 1e-5) & found.near).sum() == 463
    lattice = np.array([0.05 * np.hypot(a, b) for a in range(8) for b in range(8)])
    corrections = found[found.near].odometry_m.to_numpy()
    assert (np.abs(corrections[:, None] - lattice).min(axis=1) < 1e-4).mean() > 0.9
    # What the matcher believes of the loops is right, though it is few: it starts metres off.
    far = rows.loc["far, matching, believed"]
    assert far.pairs >= 15
    assert far.q95_m < 0.15
    assert found[~found.near & found.believed].matching_m.max() < 0.2
    assert rows.loc["far, odometry"].median_m > 4.0
