"""`roadscan iri` and `roadscan mpd` beside the sample program of ASTM E1926, and on steps, kerbs and potholes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from typer.testing import CliRunner

from roadscan.cli import app

K1, K2, C, MU = 653.0, 63.3, 6.0, 0.15
MOTION = np.array([[0, 1, 0, 0], [-K2, -C, K2, C], [0, 0, 0, 1], [K2 / MU, C / MU, -(K1 + K2) / MU, -C / MU]])


def rows(folder: Path, *words: str, x: np.ndarray, height: np.ndarray, command: str = "iri") -> list[dict[str, Any]]:
    """Rows that the command prints of a profile."""
    file = folder / "profile.csv"
    np.savetxt(file, np.column_stack([x, height]), "%.9f", ",", header="x_m,height_m", comments="")
    outcome = CliRunner().invoke(app, [command, str(file), *words, "--json"])
    assert outcome.exit_code == 0, outcome.output
    return list(json.loads(outcome.stdout)["rows"])


def fine_road(seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """420 m of a road each 5 mm, waves of 0.1 to 80 m, whose density falls with the square of frequency."""
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 420.0, 0.005)
    per_m = np.fft.rfftfreq(x.size, 0.005)
    size = np.divide(1.0, per_m, out=np.zeros_like(per_m), where=(per_m > 0.0125) & (per_m < 10.0))
    h = np.fft.irfft(size * np.exp(2j * np.pi * rng.random(per_m.size)), x.size)
    return x, 0.004 * h / h.std()


def e1926(height_m: np.ndarray, step_m: float, from_m: float, to_m: float) -> float:
    """IRI by the steps of the standard's sample program: state transition, average over whole steps near 250 mm."""
    transition = expm(MOTION * step_m * 3.6 / 80.0)
    push = np.linalg.solve(MOTION, transition - np.eye(4))[:, 3] * K1 / MU
    count = max(int(0.25 / step_m + 0.5), 1) if step_m < 0.25 else 1
    slope = (height_m[count:] - height_m[:-count]) / (count * step_m)
    start = round(11.0 / step_m)
    rise = (height_m[start] - height_m[0]) / (start * step_m)
    state, felt = np.array([rise, 0.0, rise, 0.0]), [0.0]
    for one in slope:
        state = transition @ state + push * one
        felt.append(abs(state[0] - state[2]) * step_m)
    x, total = step_m * np.arange(len(felt)), np.cumsum(felt)
    return float(1e3 * (np.interp(to_m, x, total) - np.interp(from_m, x, total)) / (to_m - from_m))


@pytest.mark.parametrize("step_m", [0.05, 0.1, 0.125, 0.1524, 0.166, 0.17, 0.2, 0.22, 0.24, 0.25, 0.3, 0.3048])
def test_each_spacing_reads_as_the_sample_program_of_the_standard(step_m: float, tmp_path: Path) -> None:
    fine, h = fine_road()
    x = step_m * np.arange(int(400.0 / step_m))
    height = np.interp(x, fine, h)
    (row,) = rows(tmp_path, "--stations", "100,300", x=x, height=height)
    assert row["iri_m_per_km"] == pytest.approx(e1926(height, step_m, 100.0, 300.0), rel=5e-4)
    assert row["note"] == ""
    assert row["accuracy_class"] == (1 if step_m <= 0.25 else 2)


@pytest.mark.parametrize(
    ("draw", "even"),
    [
        (lambda rng: rng.uniform(0.025, 0.494, 2000), False),
        (lambda rng: rng.normal(0.3, 0.004, 1500), False),
        (lambda rng: rng.normal(0.3048, 0.002, 1450), True),
    ],
)
def test_uneven_spacing_has_a_value_with_its_class(draw: Any, even: bool, tmp_path: Path) -> None:
    """Wide steps lose short waves: up to 5 % of the value on a road with waves of all lengths."""
    fine, h = fine_road()
    x = np.concatenate([[0.0], np.cumsum(draw(np.random.default_rng(3)))])
    x = x[x < 400.0]
    (row,) = rows(tmp_path, "--stations", "100,300", x=x, height=np.interp(x, fine, h))
    true = e1926(h[::10], 0.05, 100.0, 300.0)
    assert row["iri_m_per_km"] == pytest.approx(true, rel=0.05)
    assert row["accuracy_class"] == 2
    assert row["note"] == ("" if even else "uneven")


def test_what_is_too_coarse_says_which_limit(tmp_path: Path) -> None:
    fine, h = fine_road()
    file = tmp_path / "coarse.csv"
    x = np.arange(0.0, 400.0, 0.4)
    np.savetxt(file, np.column_stack([x, np.interp(x, fine, h)]), "%.6f", ",", header="x_m,height_m", comments="")
    outcome = CliRunner().invoke(app, ["iri", str(file)])
    assert outcome.exit_code != 0
    assert "a sample each 0.4 m; the coarsest that can be judged is one each 0.306 m" in str(outcome.exception)


DEPTHS_M = (0.02, 0.05, 0.08, 0.099, 0.101, 0.15, 0.2, 0.25, 0.3)


def pothole(x: np.ndarray, depth_m: float) -> np.ndarray:
    return np.where((x > 149.9) & (x < 150.5), -depth_m, 0.0)


def kerb(x: np.ndarray, depth_m: float) -> np.ndarray:
    """A kerb that is crossed; higher ones than 0.2 m are not."""
    return np.where(x > 149.9, min(depth_m, 0.2), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [pothole, kerb])
def test_a_severe_place_grows_with_its_depth_and_is_listed(shape: Any, tmp_path: Path) -> None:
    """From 20 to 300 mm: no cliff, and from 0.1 m on between neighbours the note says that a step was kept."""
    fine, road = fine_road()
    x = np.arange(0.0, 300.0, 0.05)
    found, peaks = [], []
    for depth_m in DEPTHS_M:
        height = np.interp(x, fine, road) + shape(x, depth_m)
        (row,) = rows(tmp_path, "--stations", "100,200", x=x, height=height)
        found.append(row["iri_m_per_km"])
        assert ("step" in row["note"]) == (np.abs(np.diff(height)).max() > 0.1)
        places = rows(tmp_path, "--localised", str(2.0 * found[0]), x=x, height=height)
        here = [one for one in places if one["from_m"] < 150.2 < one["to_m"]]
        peaks.append(max(one["peak_m_per_km"] for one in here))  # listed at each depth
    rise, deeper = np.diff(found), np.diff(np.minimum(DEPTHS_M, 1.0 if shape is pothole else 0.2))
    assert (rise >= 0.0).all() and (rise[deeper > 0.0] > 0.0).all() and (np.diff(peaks) >= 0.0).all()
    # A rigid car is linear: far above the road's own roughness a millimetre adds the same at all depths.
    steep = (rise / np.where(deeper > 0.0, deeper, np.inf))[2:][deeper[2:] > 0.0]
    assert steep.max() < 1.5 * steep.min()


def test_a_step_that_no_road_has_is_a_place_of_its_own(tmp_path: Path) -> None:
    fine, road = fine_road()
    x = np.arange(0.0, 300.0, 0.05)
    height = np.interp(x, fine, road) + np.where(x > 149.9, 0.8, 0.0)
    (row,) = rows(tmp_path, "--stations", "100,200", x=x, height=height)
    assert "jump" in row["note"]
    (place,) = [
        one for one in rows(tmp_path, "--localised", "50", x=x, height=height) if one["from_m"] < 149.9 < one["to_m"]
    ]
    assert (place["note"], place["peak_m_per_km"]) == ("jump", None)
    assert place["peak_station_m"] == pytest.approx(149.925, abs=0.03)


@pytest.mark.parametrize("step_mm", [3.0, 5.0, 9.0, 14.0, 19.0, 21.0, 30.0, 45.0, 61.0, 62.0, 80.0])
def test_a_step_in_texture_costs_its_segment(step_mm: float, tmp_path: Path) -> None:
    """From 3 to 80 mm: the slope that takes the step out of its segment would leave a saw's tooth in the depth."""
    x = np.arange(0.0, 1.0, 1e-4)
    texture = 5e-4 * np.sin(2 * np.pi * x / 0.02)
    (clean,) = rows(tmp_path, x=x, height=texture, command="mpd")
    (row,) = rows(tmp_path, x=x, height=texture + 1e-3 * step_mm * (x > 0.55), command="mpd")
    assert (row["valid_segments"], row["segments"], row["note"]) == (9, 10, "jump 1")
    assert row["mpd_mm"] == pytest.approx(clean["mpd_mm"], rel=0.01)
