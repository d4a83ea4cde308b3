"""Clouds that are wrong in a way that single records do not show, through the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app

START_S = 461_922_000.0
"""Adjusted standard GPS time of the first point: 2026-05-04."""
POSIX_S = 1_777_887_000.0
"""The same day in POSIX seconds."""
N = 6_000
DHHN2016, EGM96, EVRF2007 = 7837, 5773, 5621


def road() -> np.ndarray:
    """(n, 3) points of 12 m of road in UTM 32N, in the order of the drive."""
    rng = np.random.default_rng(0)
    along, across = np.sort(rng.uniform(0, 12.0, N)), rng.uniform(-3.0, 3.0, N)
    return np.column_stack([691_000 + along, 5_335_000 + across, 560 + 0.01 * along + 0.02 * np.abs(across)])


def write(
    path: Path, xyz: np.ndarray, vertical: int = DHHN2016, scale: float = 0.001, level: int = 32632, **fields: Any
) -> None:
    """LAS 1.4, point format 6, standard GPS time, with a compound CRS in WKT."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [scale] * 3, [*np.floor(xyz[:, :2].min(axis=0)), 0.0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    crs = pyproj.crs.CompoundCRS("x", [f"EPSG:{level}", f"EPSG:{vertical}"])
    header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.intensity = np.full(len(xyz), 1000)
    for name, values in ({"gps_time": START_S + 1e-4 * np.arange(len(xyz))} | fields).items():
        setattr(las, name, values)
    las.write(path)


def survey(folder: Path, *runs: str, mapped: str = "", options: str = "") -> Path:
    """A survey file of clouds, a run each; `a+b` lists two in one run."""
    text = f'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\nheight = "orthometric"\n{mapped}\n'
    text += "[tiles]\ncell_m = 0.2\n[products]\nmake = []\n"
    for number, run in enumerate(runs):
        text += f'[[runs]]\nid = "r{number}"\n'
        text += "".join(f'[[runs.logs]]\npath = "{name}.las"\n{options}\n' for name in run.split("+"))
    (folder / "SURVEY.toml").write_text(text)
    return folder


def told(name: str, folder: Path) -> tuple[int, dict[str, Any], str]:
    """Exit code of a command, its JSON where it has one, and all its words with the error that ended it."""
    done = CliRunner().invoke(app, [name, str(folder / "SURVEY.toml"), *([] if name == "status" else ["--json"])])
    said = done.stdout.strip()
    words = " ".join(f"{done.output} {done.exception or ''}".split())
    return done.exit_code, json.loads(said) if said.startswith("{") else {}, words


def ingested(folder: Path) -> tuple[np.ndarray, dict[str, int]]:
    """Points (n, 3) of the table, and how many records were left out by reason."""
    code, _, words = told("ingest", folder)
    assert code == 0, words
    opened = rs.open_survey(folder / "SURVEY.toml")
    rows, rejects = opened.table("cloud"), opened.table("rejects")
    reasons: dict[str, int] = {}
    for reason, count in zip(rejects["reason"].tolist(), rejects["records"].tolist(), strict=True):
        reasons[reason] = reasons.get(reason, 0) + count
    return np.column_stack([rows[f"{axis}_m"].to_numpy() for axis in "xyz"]), reasons


@pytest.mark.witness("stray_point")
def test_points_far_from_all_others_are_left_out(tmp_path: Path) -> None:
    """One 3 km east, one 400 m up, one 3 km down; five points on a mast 300 m off the road stay."""
    xyz = road()
    xyz[500, 0] += 3000
    xyz[900, 2] += 400
    xyz[901, 2] -= 3000
    xyz[2000:2005] += [300.0, 0.0, 12.0]
    write(tmp_path / "c.las", xyz)
    points, reasons = ingested(survey(tmp_path, "c"))
    (count,) = reasons.values()
    assert count == 3 and "alone" in next(iter(reasons))
    opened = rs.open_survey(tmp_path / "SURVEY.toml")
    assert sorted(opened.table("rejects")["record"].tolist()) == [500, 900, 901]
    assert len(points) == N - 3 and np.ptp(points[:, 2]) < 20 and np.count_nonzero(points[:, 0] > 691_250) == 5


@pytest.mark.witness("marked_points")
def test_points_that_the_file_marks_are_left_out(tmp_path: Path) -> None:
    k = np.arange(N)
    noise = np.where(k % 50 == 0, 7, np.where(k % 50 == 1, 18, 2))
    marks = {"classification": noise, "withheld": k % 50 == 2, "synthetic": k % 50 == 3}
    xyz = road()
    xyz[k % 50 < 3, 2] -= 30
    write(tmp_path / "c.las", xyz, **marks)
    points, reasons = ingested(survey(tmp_path, "c"))
    assert len(points) == N - 3 * N // 50 and points[:, 2].min() > 559
    assert {("noise" in reason, "withheld" in reason): n for reason, n in reasons.items()} == {
        (True, False): 2 * N // 50,
        (False, True): N // 50,
    }
    assert f"{N // 50} of its points are marked synthetic" in told("status", tmp_path)[2]
    kept, reasons = ingested(survey(tmp_path, "c", options="options = { keep_marked = true }"))
    assert len(kept) == N and not reasons


@pytest.mark.witness("time_in_future")
def test_posix_time_under_the_bit_of_gps_time_is_named(tmp_path: Path) -> None:
    write(tmp_path / "c.las", road(), gps_time=POSIX_S + 1e-4 * np.arange(N))
    code, _, words = told("run", survey(tmp_path, "c"))
    assert code != 0 and "lies in the future (2068-" in words
    assert "as 'unix_utc' it would be 2026-05-04" in words and 'clock = { system = "unix_utc" }' in words
    looked = CliRunner().invoke(app, ["inspect", str(tmp_path / "c.las")])
    assert f"{N:,} × the time lies in the future" in " ".join(looked.output.split())
    points, reasons = ingested(survey(tmp_path, "c", options='clock = { system = "unix_utc" }'))
    assert len(points) == N and not reasons


@pytest.mark.witness("points_twice")
def test_a_point_that_stands_twice_counts_once(tmp_path: Path) -> None:
    xyz, times = road(), START_S + 1e-4 * np.arange(N)
    write(tmp_path / "c.las", np.concatenate([xyz, xyz[: N // 2]]), gps_time=np.concatenate([times, times[: N // 2]]))
    points, reasons = ingested(survey(tmp_path, "c"))
    assert len(points) == N and list(reasons.values()) == [N // 2] and "twice" in next(iter(reasons))


def test_returns_of_one_pulse_are_not_one_point(tmp_path: Path) -> None:
    """Half of the points share their time with another, some of them their place too, as second returns do."""
    xyz, times = road(), START_S + 1e-4 * (np.arange(N) // 2)
    xyz[1:200:2] = xyz[0:200:2]
    write(tmp_path / "c.las", xyz, gps_time=times, return_number=1 + np.arange(N) % 2, number_of_returns=np.full(N, 2))
    points, reasons = ingested(survey(tmp_path, "c"))
    assert len(points) == N and not reasons


@pytest.mark.slow
def test_a_cloud_written_anew_at_another_scale_counts_once(tmp_path: Path) -> None:
    write(tmp_path / "c.las", road())
    write(tmp_path / "d.las", road(), scale=0.0001)
    code, said, words = told("run", survey(tmp_path, "c+d"))
    assert code == 0, words
    (finding,) = said["findings"]
    assert finding["witness"] == "same_content" and finding["subject"] == "d.las" and finding["left_out"] == N
    assert said["readings"]["kept"] == N


@pytest.fixture(scope="module")
def twice_driven(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], tuple[dict[str, Any], str]]:
    """Runs a survey of two clouds of one road, the second higher by some metres."""

    def run(up_m: float) -> tuple[dict[str, Any], str]:
        folder = tmp_path_factory.mktemp("twice")
        rng = np.random.default_rng(1)
        write(folder / "a.las", road() + rng.normal(0, [0, 0, 0.003], (N, 3)))
        second = road() + np.array([0.02, 0.0, up_m]) + rng.normal(0, [0, 0, 0.003], (N, 3))
        write(folder / "b.las", second, gps_time=START_S + 1000 + 1e-4 * np.arange(N))
        code, said, words = told("run", survey(folder, "a", "b"))
        assert code == 0, words
        return said, told("status", folder)[2]

    return run


@pytest.mark.slow
@pytest.mark.witness("passes_apart")
def test_two_clouds_of_one_road_at_two_heights_are_named(twice_driven: Callable[[float], Any]) -> None:
    said, status = twice_driven(0.5)
    (finding,) = said["findings"]
    assert finding["witness"] == "passes_apart" and "run 'r1'" in finding["subject"] and "run 'r0'" in finding["text"]
    off_mm = float(finding["text"].split("its heights are ")[1].split(" mm")[0])
    sigma_mm = float(finding["text"].split("(σ ")[1].split(" mm")[0])
    assert abs(off_mm - 500) < 1 and 0 < sigma_mm < 1
    assert "no place where passes overlap" not in status and "points of a cloud are placed already" in status


@pytest.mark.slow
def test_two_clouds_of_one_road_within_their_noise_are_not(twice_driven: Callable[[float], Any]) -> None:
    assert twice_driven(0.01)[0]["findings"] == []


@pytest.mark.slow
@pytest.mark.witness("vertical_datum")
def test_heights_of_another_datum_are_refused_or_transformed(tmp_path: Path) -> None:
    """EGM96 to DHHN2016 takes grids that are not here; EVRF2007 to DHHN2016 is known to 0.1 m without any."""
    write(tmp_path / "c.las", road(), EGM96)
    mapped = f'vertical_crs = "EPSG:{DHHN2016}"'
    code, _, words = told("run", survey(tmp_path, "c", mapped=mapped))
    assert code != 0 and "EGM96" in words and "map.geoid" in words and not list((tmp_path / "store").rglob("cloud/*"))
    write(tmp_path / "d.las", road())
    code, _, words = told("run", survey(tmp_path, "c", "d"))
    assert code != 0 and f'map.vertical_crs = "EPSG:{EGM96}"' in words
    write(tmp_path / "e.las", road(), EVRF2007, level=25832)
    text = survey(tmp_path, "e", mapped=mapped).joinpath("SURVEY.toml").read_text().replace("32632", "25832")
    (tmp_path / "SURVEY.toml").write_text(text.replace("make = []", 'make = ["las"]'))
    code, _, words = told("run", tmp_path)
    assert code != 0 and "known to 0.1 m only" in words
    text = (tmp_path / "SURVEY.toml").read_text().replace(mapped, f"{mapped}\nmax_datum_error_m = 0.1")
    (tmp_path / "SURVEY.toml").write_text(text)
    code, _, words = told("run", tmp_path)
    assert code == 0, words
    tiles = [laspy.read(path) for path in (tmp_path / "store").rglob("tiles/las/**/*.la[sz]")]
    change = pyproj.Transformer.from_crs(
        pyproj.crs.CompoundCRS("a", ["EPSG:25832", f"EPSG:{EVRF2007}"]),
        pyproj.crs.CompoundCRS("b", ["EPSG:25832", f"EPSG:{DHHN2016}"]),
        always_xy=True,
    )
    _, _, heights = change.transform(*road().T)
    assert abs(np.mean(heights - road()[:, 2])) > 0.005  # it changes something
    assert abs(np.mean(np.concatenate([np.asarray(tile.z) for tile in tiles])) - np.mean(heights)) < 1e-3
