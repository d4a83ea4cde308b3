"""Surveys of GNSS and IMU alone, doubtful trajectories, and pictures that have a record: through the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.survey import Survey
from roadscan.report.blocks import Paragraph
from roadscan.report.section import Material
from roadscan.report.sections.navigation import Navigation
from roadscan.run.session import Session
from roadscan.simulate import simulate
from roadscan.simulate.sensors.gnss import COLUMNS, Solutions, write_pos
from roadscan.store.logs import read_log_records
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.drawing import drawn
from tests.navigation.test_navigate import navigating_scene
from tests.navigation.walks import OUTAGES, Walked, walked

PICTURE = "products/navigation/run-1.png"
RUN = """
[[runs]]
id = "run-1"

[[runs.logs]]
path = "{raw}/imu.csv"
format = "imu_csv"
sensor = "imu"
clock = {{ system = "gps", unit = "ns" }}

[[runs.logs]]
path = "{raw}/gnss.pos"
format = "rtklib_pos"
sensor = "gnss"
crs = "EPSG:4979"

[[runs.logs]]
path = "{raw}/encoder.csv"
format = "encoder_csv"
sensor = "encoder"
clock = {{ system = "gps", unit = "ns" }}
options = {{ record = "total" }}
"""


@dataclass
class Place:
    """A survey of GNSS, IMU and odometer, and what the command line says of it."""

    file: Path
    said: str = field(default="")

    @property
    def store(self) -> Store:
        survey = Survey.load(self.file)
        return Store(survey.store_url, survey.config.id)

    def do(self, *words: str) -> int:
        """Exit code of a command."""
        done = CliRunner().invoke(app, [words[0], str(self.file), *words[1:]])
        self.said = done.output
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return done.exit_code


def survey_of(folder: Path, raw: Path, rig: Path, extra: str = "") -> Place:
    """A survey file beside logs that lie elsewhere."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(rig.read_text())
    (folder / "SURVEY.toml").write_text(
        f'id = "alone"\nrig = "rig.toml"\n\n[map]\ncrs = "EPSG:25832"\n\n'
        f'[navigation.smoother]\nimu_samples = "instant"\n{extra}\n'
        f"{RUN.format(raw=raw)}"
    )
    return Place(folder / "SURVEY.toml")


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folder of raw logs, and a rig file."""
    made = simulate(navigating_scene(profilers={"on": False}), tmp_path_factory.mktemp("alone") / "survey").survey_file
    return made.parent / "raw" / "run-1", made.parent / "RIG.toml"


@pytest.fixture(scope="module")
def alone(driven: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The survey of GNSS, IMU and odometer, run once."""
    place = survey_of(tmp_path_factory.mktemp("run"), *driven)
    with drawn():
        assert place.do("run", "--workers", "0") == 0, place.said
    return place


@pytest.mark.slow
def test_a_survey_of_gnss_and_imu_alone_ends_well(alone: Place) -> None:
    assert alone.do("run", "--workers", "0") == 0
    assert "drawn:" not in alone.said and "computed:" not in alone.said
    assert alone.said.count("nothing to place: the survey has no log of scans, returns or points") == 1
    assert alone.do("status") == 0
    assert "no tiles: nothing to place" in alone.said
    assert alone.do("run", "--dry-run") == 0
    assert "no tiles: nothing to place" in alone.said
    assert alone.do("verify") == 0
    assert "every file is whole" in alone.said
    for stage in ("footprints", "tile", "products"):
        assert alone.do(stage, "--workers", "0") == 0
        assert "nothing to place" in alone.said


@pytest.mark.slow
def test_status_waits_for_a_trajectory(driven: tuple[Path, Path], tmp_path: Path) -> None:
    place = survey_of(tmp_path, *driven)
    assert place.do("ingest", "--workers", "0") == 0
    assert place.do("status") == 1
    assert "trajectory of run 'run-1': waiting" in place.said


@pytest.mark.slow
def test_the_report_tells_of_the_trajectory(alone: Place) -> None:
    """It is handed the trajectory's own record among those of the logs, which must not seem to be a trajectory log."""
    material = Material(Session(Survey.load(alone.file), alone.store))
    lines = [block.text for block in Navigation().blocks(material) if isinstance(block, Paragraph)]
    assert any("poses by the smoother" in line for line in lines)


@pytest.mark.slow
def test_status_tells_of_the_trajectory(alone: Place) -> None:
    assert alone.do("status") == 0
    (line,) = [one for one in alone.said.splitlines() if one.startswith("trajectory of run")]
    rows = query(
        alone.store,
        "SELECT count(*) AS n, median(sqrt(sigma_north_m**2 + sigma_east_m**2)) AS middle, max(sigma_down_m) AS down, "
        "(max(epoch_gps_ns) - min(epoch_gps_ns)) / 1e9 AS s FROM trajectory",
    ).to_pylist()[0]
    share = query(alone.store, "SELECT avg((weight < 1)::int) AS share FROM innovations").to_pylist()[0]["share"]
    assert f"{rows['n']:,} poses by the smoother" in line
    assert f"({rows['s']:,.1f} s)" in line
    assert f"horizontal {rows['middle']:.3f} /" in line and f"/ {rows['down']:.3f} m" in line
    assert f"{share:.1%} of the updates are outliers" in line
    assert "not doubted" in line and line.endswith(f"picture {PICTURE}")


@pytest.mark.slow
@pytest.mark.witness("computed_poses")
def test_doubt_stays_in_status(driven: tuple[Path, Path], tmp_path: Path) -> None:
    """Heights that scatter five times more than their σ says, and are believed."""
    raw, rig = driven
    worse = tmp_path / "raw"
    worse.mkdir()
    for name in ("imu.csv", "encoder.csv"):
        (worse / name).write_bytes((raw / name).read_bytes())
    noise = np.random.default_rng(1).normal(0.0, 0.09, 10_000)
    out = []
    for number, line in enumerate((raw / "gnss.pos").read_text().splitlines()):
        words = line.split()
        wrong = line if line.startswith("%") else line.replace(words[4], f"{float(words[4]) + noise[number]:.5f}", 1)
        out.append(wrong)
    (worse / "gnss.pos").write_text("\n".join(out) + "\n")
    place = survey_of(tmp_path / "survey", worse, rig, "measure_noise = false")
    assert place.do("run", "--workers", "0") == 0
    assert "doubtful: run 'run-1'" in place.said and "are outliers (at most 10%)" in place.said
    for _ in range(2):  # another run computes nothing, and still says so
        assert place.do("status") == 0
        assert "note: trajectory of run 'run-1': doubtful" in place.said
        assert place.do("run", "--workers", "0") == 0
        assert "known: run-1/navigation" in place.said and "doubtful: run 'run-1'" in place.said


def removed(file: Path) -> None:
    file.unlink()


def flipped(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [removed, flipped])
def test_a_damaged_picture_is_seen_and_drawn_again(alone: Place, damage: Callable[[Path], None]) -> None:
    """The same bytes come back, and nothing is solved for them."""
    file = Path(alone.store.path(PICTURE))
    before = file.read_bytes()
    damage(file)
    assert alone.do("verify") == 1
    assert PICTURE in alone.said and "the next run makes it again" in alone.said
    records = [r.key for r in read_log_records(alone.store)]
    with drawn():
        assert alone.do("run", "--workers", "0") == 0
    assert f"drawn: {PICTURE}" in alone.said and "computed:" not in alone.said
    assert file.read_bytes() == before
    assert [r.key for r in read_log_records(alone.store)] == records
    assert alone.do("verify") == 0


@pytest.mark.slow
def test_the_picture_of_a_run_that_is_no_more_goes(driven: tuple[Path, Path], tmp_path: Path) -> None:
    place = survey_of(tmp_path, *driven)
    assert place.do("run", "--workers", "0") == 0
    assert place.store.exists(PICTURE)
    place.file.write_text(place.file.read_text() + '\n[navigation]\nsolve = "never"\n')
    assert place.do("run", "--workers", "0") == 0
    assert not place.store.exists(PICTURE)


@pytest.mark.slow
def test_noise_that_was_measured_stands_in_the_record(alone: Place) -> None:
    (record,) = [r for r in read_log_records(alone.store) if r.sensor == "navigation"]
    assert isinstance(record.attributes["measured_noise"], dict)
    assert json.dumps(record.attributes["doubts"]) == "[]"


WALKING_RIG = """
name = "carried"

[sensors.imu]
kind = "imu"
axes = "frd"
lever_arm_body_m = [0.0, 0.0, 0.0]
imu = "mems"

[sensors.gnss]
kind = "gnss"
lever_arm_body_m = {arm}
lever_arm_sigma_m = [0.03, 0.03, 0.03]
"""


def written_walk(walk: Walked, folder: Path) -> Path:
    """Logs of a walk, GNSS outside the outages, and a rig file; the folder of the logs."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    imu, gnss = walk.imu, walk.masked
    samples = np.concatenate([imu.angular_rate_rad_per_s, imu.specific_force_m_per_s2], axis=1)
    table = pd.DataFrame(np.column_stack([np.zeros(len(samples)), samples]), columns=list(COLUMNS))
    table[COLUMNS[0]] = imu.epochs_gps_ns
    table.to_csv(raw / "imu.csv", index=False)
    position = walk.walk.earth.geographic_from_ecef(gnss.position_world_m)
    sigma = np.sqrt(np.einsum("nii->ni", gnss.covariance_ned_m2))
    count = gnss.epochs_gps_ns.size
    solutions = Solutions(gnss.epochs_gps_ns, position, gnss.velocity_ned_m_per_s, np.ones(count, np.int64), sigma)
    list(write_pos(solutions, raw / "gnss.pos"))
    arm = walk.vehicle.antenna_lever_arm_body_m.round(4).tolist()
    (folder / "carried.toml").write_text(WALKING_RIG.format(arm=arm))
    return raw


@pytest.mark.parametrize("sigma_factor", [1.0, 3.0])
def test_a_walk_through_the_command_line(tmp_path: Path, sigma_factor: float) -> None:
    """The σ in the table against the truth in four outages; no setting says that it is no car."""
    walk = walked(2, sigma_factor=sigma_factor)
    raw = written_walk(walk, tmp_path)
    place = survey_of(tmp_path / "survey", raw, tmp_path / "carried.toml")
    text = place.file.read_text()
    place.file.write_text(text[: text.rindex("[[runs.logs]]")])  # no encoder
    assert place.do("run", "--workers", "0") == 0
    assert "measured noise: sideways_m_per_s" in place.said
    rows = query(place.store, "SELECT * FROM trajectory ORDER BY epoch_gps_ns").to_pandas()
    since = walk.walk.seconds(rows["epoch_gps_ns"].to_numpy())
    rows = rows[np.any([(since >= a) & (since < a + length) for a, length in OUTAGES], axis=0)]
    position = np.array(rows[[f"{a}_world_m" for a in "xyz"]])
    truth = walk.walk.poses(rows["epoch_gps_ns"].to_numpy()).position_ecef_m
    error = walk.walk.earth.ecef_from_level(truth).inv().apply(position - truth)
    sigma = rows[[f"sigma_{a}_m" for a in ("north", "east", "down")]].to_numpy()
    for axes in (slice(0, 2), slice(2, 3)):
        assert 0.5 < np.sqrt((error[:, axes] ** 2).sum() / (sigma[:, axes] ** 2).sum()) < 1.5
    share = query(
        place.store, "SELECT avg((weight < 1)::int) AS share FROM innovations WHERE kind LIKE 'gnss%'"
    ).to_pylist()[0]["share"]
    assert share < 0.05
    assert place.do("status") == 0
    assert "not doubted" in place.said
