"""`roadscan iri`, `roadscan mpd` and their functions in Python, on files as users have them."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.condition.profiles.profile_files import StatedUnits


def told(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def refused(*words: str | Path) -> str:
    outcome = told(*words)
    assert outcome.exit_code != 0
    return str(outcome.exception)


@pytest.fixture
def road() -> tuple[np.ndarray, np.ndarray]:
    x = np.arange(1600) * 0.125
    waves = ((0.004, 7.1, 0.3), (0.006, 11.3, 1.0), (0.01, 17.9, 2.0))
    return x, np.asarray(sum(a * np.sin(2 * np.pi * x / wave + phase) for a, wave, phase in waves))


def test_published_segments_by_the_command(recordings: Path) -> None:
    file = recordings / "iri" / "profile_a.txt"
    outcome = told("iri", file, "--x-unit", "m", "--height-unit", "m", "--segment", "100", "--json")
    rows = json.loads(outcome.stdout)["rows"]
    assert [row["iri_m_per_km"] for row in rows[:5]] == pytest.approx(
        [3.29852, 2.44211, 3.55511, 4.08554, 2.70790], abs=1e-3
    )
    assert (rows[0]["note"], rows[-1]["note"], rows[-1]["to_m"]) == ("start", "short", 1022.0)
    text = told("iri", file, "--x-unit", "m", "--height-unit", "m", "--stations", "478,578,778").stdout
    assert text.splitlines()[0].split()[:3] == ["from_m", "to_m", "iri_m_per_km"]
    assert text.splitlines()[2].split()[:3] == ["478.000", "578.000", "3.298"]
    assert "--x-unit m" in refused("iri", file)
    assert "one of m, cm" in refused("iri", file, "--x-unit", "m", "--height-unit", "furlong")


@pytest.mark.slow
def test_the_figures_of_captif_by_the_command(recordings: Path, tmp_path: Path) -> None:
    file = tmp_path / "station_0.dat"
    file.write_bytes(gzip.decompress((recordings / "texture" / "station_0.dat.gz").read_bytes()))
    span = ("--columns", "2,3", "--from", "0.06232", "--to", "1.870388")
    (row,) = json.loads(told("mpd", file, *span, "--json").stdout)["rows"]
    assert row["mpd_mm"] == pytest.approx(3.277751, abs=1e-5) and row["stdev_mm"] == pytest.approx(0.853088, abs=1e-5)
    assert (row["valid_segments"], row["segments"], row["note"]) == (17, 18, "dropouts 1")
    assert "1,2" in refused("mpd", file)
    assert len(told("mpd", file, *span, "--segment", "0.5").stdout.splitlines()) == 2 + 4
    assert "multiple" in refused("mpd", file, *span, "--segment", "0.25")


def test_erd_of_two_wheel_paths_there_and_back(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, left = road
    right = np.roll(left, 40)
    file = tmp_path / "road.erd"
    rs.write_erd(file, x + 100.0, np.stack([left, right]), title="A road")
    read = rs.read_profile(file)
    assert read.names == ("LElev", "RElev")
    assert read.x_m == pytest.approx(x + 100.0) and np.abs(read.height_m - [left, right]).max() < 6e-8
    rows = json.loads(told("iri", file, "--segment", "50", "--json").stdout)["rows"]
    table = rs.iri(x + 100.0, np.stack([left, right]), segment_m=50.0)
    assert [row["mri_m_per_km"] for row in rows] == pytest.approx(table.mri_m_per_km.tolist(), abs=1e-4)
    assert table.mri_m_per_km.to_numpy() == pytest.approx((table.iri_1_m_per_km + table.iri_2_m_per_km) / 2)
    assert (table.hri_m_per_km < table.mri_m_per_km).all()
    one = json.loads(told("iri", file, "--columns", "RElev", "--json").stdout)
    assert one["profiles"] == ["RElev"] and "iri_m_per_km" in one["rows"][0]
    for wrong, said in ((np.delete(x, 5), "even"), (x, "no height")):
        heights = np.where(np.arange(wrong.size) == 7, np.nan, left[: wrong.size])
        with pytest.raises(rs.RoadscanError, match=said):
            rs.write_erd(file, wrong, heights)


def test_units_of_text(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, h = road
    named, feet = tmp_path / "named.csv", tmp_path / "feet.txt"
    named.write_text("station_m,height_mm\n" + "\n".join(f"{a},{1e3 * b}" for a, b in zip(x, h, strict=True)))
    feet.write_text("\n".join(f"{a / 0.3048} {b / 0.0254}" for a, b in zip(x, h, strict=True)))
    whole = rs.iri(x, h).iri_m_per_km[0]
    a, b = rs.read_profile(named), rs.read_profile(feet, StatedUnits("ft", "in"))
    assert rs.iri(a.x_m, a.height_m).iri_m_per_km[0] == pytest.approx(whole, rel=1e-9)
    assert rs.iri(b.x_m, b.height_m).iri_m_per_km[0] == pytest.approx(whole, rel=1e-6)
    assert "--height-unit m" in refused("iri", named, "--height-unit", "m")  # it says mm itself
    assert "rejected" in told("iri", _with(named, "spoilt\n")).stderr


def test_decimal_commas_and_kilometres(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, h = road
    whole = rs.iri(x, h).iri_m_per_km[0]
    file = tmp_path / "comma.csv"
    for separator in (";", "\t", " "):
        lines = [f"{a / 1e3:.6f}{separator}{1e3 * b:.4f}".replace(".", ",") for a, b in zip(x, h, strict=True)]
        file.write_text("\n".join([f"station_km{separator}height_mm", *lines]))
        read = rs.read_profile(file)
        assert rs.iri(read.x_m, read.height_m).iri_m_per_km[0] == pytest.approx(whole, rel=1e-4)
    file.write_text("station_m;height_mm\n" + "\n".join(f"1,{k:03d};2,{k:03d}" for k in range(200)))
    assert "is a decimal mark, or parts thousands" in refused("iri", file)


def _with(file: Path, line: str) -> Path:
    file.write_text(file.read_text() + "\n" + line)
    return file


def test_what_is_no_profile(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, h = road
    file = tmp_path / "p.ppf"
    file.write_bytes(b"*\0\0\0\x01binary")
    assert "PPF" in refused("iri", file)
    assert "no such file" in refused("iri", tmp_path / "none")
    unsorted = tmp_path / "unsorted.txt"
    unsorted.write_text("x_m h_m\n0 1\n2 1\n1 1\n")
    assert "record 4" in refused("iri", unsorted)
    for height, said in ((1e3 * h, "millimetres"), (h[:80], "long")):
        with pytest.raises(rs.RoadscanError, match=said):
            rs.iri(x[: height.size], height)
    with pytest.raises(rs.RoadscanError, match="profile 2"):
        rs.iri(x, np.stack([h, 1e3 * h]))
    assert rs.iri(x, 1e-3 * h).note[0] == "start, flat"
    assert rs.iri(x, 12.0 * h).note[0] == "start, wild"
    stepped = rs.iri(x, np.where(x > 100, h + 1.0, h), segment_m=50.0)
    assert stepped.note.tolist() == ["start", "", "start, jump", "short"]
    texture = np.arange(0.0, 1.0, 1e-4)
    assert rs.mpd(texture, 1e-6 * np.sin(2 * np.pi * texture / 0.02)).note[0] == "flat"
    with pytest.raises(rs.RoadscanError, match="several"):
        rs.mpd(texture, np.zeros((2, texture.size)))


def test_an_erd_file_that_counts_its_numbers_wrong(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    """Two wheel paths read as one give 38 % of their roughness."""
    x, h = road
    file = tmp_path / "road.erd"
    rs.write_erd(file, x, np.stack([h, h]))
    text = file.read_text()
    counts = text.splitlines()[1]
    for wrong in (
        counts.replace("       2,", "       1,", 1), counts.replace("1600", " 800"),
        counts.replace("       2,", "       3,", 1).replace("1600", "  -1"),
    ):  # fmt: skip
        file.write_text(text.replace(counts, wrong))
        assert "3,200 numbers" in refused("iri", file)


def test_a_sample_a_foot(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    """Stations in feet, and in metres rounded to a millimetre."""
    x, h = road
    foot = np.arange(600)
    at = np.interp(0.3048 * foot, x, h)
    feet, metres = tmp_path / "feet.csv", tmp_path / "metres.csv"
    feet.write_text("x_ft,height_mil\n" + "\n".join(f"{a},{b / 2.54e-5:.2f}" for a, b in zip(foot, at, strict=True)))
    metres.write_text("x_m,height_m\n" + "\n".join(f"{0.3048 * a:.3f},{b:.6f}" for a, b in zip(foot, at, strict=True)))
    for file in (feet, metres):
        (row,) = json.loads(told("iri", file, "--json").stdout)["rows"]
        assert row["iri_m_per_km"] == pytest.approx(rs.iri(0.3048 * foot, at).iri_m_per_km[0], rel=2e-3)
        assert row["note"] == "start"


def test_lengths_and_stations_that_are_no_numbers(road: tuple[np.ndarray, np.ndarray]) -> None:
    x, h = road
    for call in (
        lambda: rs.iri(x, h, segment_m=np.inf), lambda: rs.iri(x, h, stations_m=[0.0, np.nan, 100.0]),
        lambda: rs.iri(x, h, stations_m=[0.0, np.inf]), lambda: rs.localised_roughness(x, h, np.nan),
        lambda: rs.road_spectrum(x, h, np.nan), lambda: rs.mpd(1e-4 * x, h, segment_m=np.inf),
    ):  # fmt: skip
        with pytest.raises(rs.RoadscanError, match=r"finite|multiple"):
            call()


def test_localised_roughness(road: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, h = road
    h = h + 0.02 * np.exp(-(((x - 120.0) / 0.4) ** 2))
    file = tmp_path / "bump.erd"
    rs.write_erd(file, x, h)
    limit = 1.3 * rs.iri(x, h).iri_m_per_km[0]
    found = rs.localised_roughness(x, h, limit)
    worst = found.loc[found.peak_m_per_km.idxmax()]
    assert worst.from_m < 120.0 < worst.to_m and worst.peak_m_per_km > limit
    rows = json.loads(told("iri", file, "--localised", str(limit), "--json").stdout)["rows"]
    assert len(rows) == len(found) and rows[0]["from_m"] == pytest.approx(found.from_m[0], abs=0.13)
    assert rs.localised_roughness(x, h, 1e3).empty


# --- samples that are no road -----------------------------------------------------------------------


def measured(seed: int = 3, step_m: float = 0.05, length_m: float = 200.0) -> tuple[np.ndarray, np.ndarray]:
    """Stations and heights (mm) of a road whose slope is white, but for waves of 100 m and more: an IRI near 2 m/km."""
    x = np.arange(0.0, length_m, step_m)
    z = np.cumsum(np.random.default_rng(seed).normal(0.0, 1.6, x.size) * np.sqrt(step_m))
    half = int(50 / step_m)
    means = np.convolve(np.pad(z, half, mode="reflect"), np.full(2 * half + 1, 1 / (2 * half + 1)), "valid")
    return x, z - means


def texture(seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Places and heights (mm) of 3 m of texture, a mean profile depth near 1 mm."""
    x = np.arange(0.0, 3000.0, 0.5)
    wave = np.exp(-0.5 * (np.arange(-20, 21) / 5) ** 2)
    return x, 0.6 * np.convolve(
        np.random.default_rng(seed).normal(size=x.size), wave / np.sqrt((wave**2).sum()), "same"
    )


def judged(folder: Path, command: str, x: np.ndarray, z: np.ndarray, *words: str) -> tuple[list[dict], str]:
    """Rows of `iri` or `mpd`, and what it says beside them."""
    names = "station_m,height_mm" if command == "iri" else "place_mm,height_mm"
    file = folder / "profile.csv"
    file.write_text("\n".join([names, *(f"{a:.4f},{b:.5f}" for a, b in zip(x, z, strict=True)), ""]))
    outcome = told(command, file, "--json", *words)
    assert outcome.exit_code == 0, outcome.output
    return json.loads(outcome.stdout)["rows"], outcome.stderr


@pytest.mark.witness("profile_samples")
def test_a_stuck_sensor_and_spikes_are_left_out(tmp_path: Path) -> None:
    x, z = measured()
    ((sound,), silence) = judged(tmp_path, "iri", x, z)
    assert silence == "" and sound["note"] == "start"
    stuck = z.copy()
    stuck[1000:2000] = stuck[1000]
    ((row,), said) = judged(tmp_path, "iri", x, stuck)
    assert "left out" in said and "999 samples from 50.05 m to 99.95 m repeat the height" in said
    assert (row["note"], row["measured_share"]) == ("start, gap, stuck", pytest.approx(0.75, abs=0.01))
    parts, _ = judged(tmp_path, "iri", x, stuck, "--segment", "50")
    whole, _ = judged(tmp_path, "iri", x, z, "--segment", "50")
    assert parts[1]["iri_m_per_km"] is None and parts[1]["note"] == "gap, stuck"
    assert parts[3]["iri_m_per_km"] == pytest.approx(whole[3]["iri_m_per_km"], rel=1e-3)
    spiked = z.copy()
    spiked[::7] += 40.0
    ((row,), said) = judged(tmp_path, "iri", x, spiked)
    assert f"{len(x[::7])} of its samples are spikes" in said and row["note"] == "start, spikes"
    assert row["iri_m_per_km"] == pytest.approx(sound["iri_m_per_km"], rel=0.01)


@pytest.mark.witness("profile_steps")
def test_the_rounding_of_heights_is_told(tmp_path: Path) -> None:
    x, z = measured()
    ((sound,), _) = judged(tmp_path, "iri", x, z)
    ((row,), said) = judged(tmp_path, "iri", x, 5.0 * np.round(z / 5.0))
    assert (row["accuracy_class"], row["note"]) == (3, "start, coarse")
    (by,) = re.findall(r"too high by some ([\d.]+) m/km", said)
    assert row["iri_m_per_km"] - float(by) == pytest.approx(sound["iri_m_per_km"], rel=0.05)
    assert row["iri_m_per_km"] > 1.2 * sound["iri_m_per_km"]
    assert judged(tmp_path, "iri", x, 0.5 * np.round(z / 0.5))[1] == ""


@pytest.mark.witness("profile_samples")
def test_texture_of_a_stuck_laser_and_of_coarse_heights(tmp_path: Path) -> None:
    x, z = texture()
    ((sound,), silence) = judged(tmp_path, "mpd", x, z)
    assert silence == "" and sound["note"] == ""
    stuck = z.copy()
    stuck[2000:4000] = stuck[2000]
    ((row,), said) = judged(tmp_path, "mpd", x, stuck)
    assert "repeat the height" in said and row["note"] == "dropouts 10, jump 1, stuck 10"
    assert row["valid_segments"] == 19  # where the laser moves again, its height jumps
    assert row["mpd_mm"] == pytest.approx(sound["mpd_mm"], rel=0.03)
    ((row,), said) = judged(tmp_path, "mpd", x, np.round(z))
    assert row["note"].endswith("coarse") and "steps of 1 mm" in said


def test_sound_profiles_are_not_doubted(recordings: Path) -> None:
    """A levelled road, a drawn check profile, and roads smooth and rough as recorders round them."""
    stations, heights = np.loadtxt(recordings / "iri" / "profile_a.txt").T
    drawn = np.genfromtxt(recordings / "iri" / "worldbank_triangle.csv", delimiter=",", skip_header=1)
    assert rs.iri(stations, heights, segment_m=100.0).attrs["findings"] == []
    assert rs.iri(drawn[:, 0], 1e-3 * drawn[:, 1]).attrs["findings"] == []
    for step_m, scale, rounded_mm in ((0.025, 0.25, 0.1), (0.05, 0.5, 0.1), (0.1, 1.0, 0.5), (0.25, 5.0, 1.0)):
        x, z = measured(7, step_m)
        assert rs.iri(x, 1e-3 * rounded_mm * np.round(scale * z / rounded_mm)).attrs["findings"] == []
    for seed in (21, 26):
        x, z = texture(seed)
        for rounded_mm in (0.01, 0.05):
            assert rs.mpd(1e-3 * x, 1e-3 * rounded_mm * np.round(0.5 * z / rounded_mm)).attrs["findings"] == []
