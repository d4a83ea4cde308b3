"""`[defaults]` of the survey file: what all logs share is stated once, and no log that knows better is touched."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from roadscan.arrays import write_profiles
from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.ingest.planned_logs import plan_logs
from roadscan.store.store import Store

WEEK = 2417
FIRST_NS = (WEEK * 604_800 + 120_618) * 10**9
SURVEY = """
id = "shared"
map = {{ crs = "EPSG:25832" }}
rig.sensors.profiler = {{ kind = "profiler" }}
products.make = ["tile_table"]
{defaults}
[[runs]]
id = "drive"
logs = [
  {{ path = "a.sbet"{crs}{clock} }},
  {{ path = "scans.parquet", sensor = "profiler" }},
]
[[runs]]
id = "other"
logs = [{{ path = "utc.csv", crs = "EPSG:25832", height = "ellipsoidal", options = {{ heading = "grid" }} }}]
"""
OWN = {"crs": ', crs = "EPSG:4937"', "clock": f', clock = {{ system = "gps_week_seconds", week = {WEEK} }}'}
DEFAULTS = f"""
[defaults]
crs = "EPSG:4937"
clock = {{ system = "gps_week_seconds", week = {WEEK} }}
"""


def write_logs(folder: Path) -> None:
    """Poses that know neither week nor CRS, profiles of GPS nanoseconds, poses of calendar times in UTC."""
    t = np.arange(200) / 100
    rows = [(120_618.0 + s, 0.872, 0.157 + 1e-7 * s, 100.0, *[0.0] * 6, 1.5, *[0.0] * 6) for s in t]
    (folder / "a.sbet").write_bytes(b"".join(struct.pack("<17d", *row) for row in rows))
    epochs = FIRST_NS + 10**8 + np.arange(20) * 50_000_000
    write_profiles(folder / "scans.parquet", epochs, np.full((20, 11), -2.0), np.linspace(-1, 1, 11), quantum=1e-4)
    head = "time_utc,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg\n"
    lines = [f"2026-05-04T09:30:0{k}.000Z,500000,5300000,100,0,0,0\n" for k in range(3)]
    (folder / "utc.csv").write_text(head + "".join(lines))


def run(folder: Path, text: str) -> Path:
    """The survey's products, by the command line."""
    folder.mkdir()
    write_logs(folder)
    (folder / "SURVEY.toml").write_text(text)
    outcome = CliRunner().invoke(app, ["run", str(folder / "SURVEY.toml"), "--workers", "0"])
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    return folder / "store" / "survey=shared"


def test_defaults_do_what_each_log_would_state(tmp_path: Path) -> None:
    stated = run(tmp_path / "stated", SURVEY.format(defaults="", **OWN))
    shared = run(tmp_path / "shared", SURVEY.format(defaults=DEFAULTS, crs="", clock=""))
    tables = [pq.read_table(root / "products" / "tile_table" / "tiles.parquet") for root in (stated, shared)]
    assert tables[0].num_rows > 0
    assert tables[0].column("points").to_pylist() == [220]
    assert tables[0].equals(tables[1])
    # Calendar times with a zone stay UTC: 1777887000 POSIX seconds, GPS counts from 315964800 and is 18 s ahead.
    epochs = [
        pq.read_table(f).column("epoch_gps_ns").to_pylist()
        for f in (shared / "tables" / "trajectory").glob("**/*.parquet")
    ]
    assert [(1_777_887_000 - 315_964_800 + 18 + k) * 10**9 for k in range(3)] in epochs


def test_a_week_completes_clocks_and_changes_no_key(tmp_path: Path) -> None:
    """A log that gets its week from the defaults is the log that states it; without defaults nothing changes."""
    write_logs(tmp_path)
    keys = []
    for defaults, week in (("", f", week = {WEEK}"), (f"[defaults]\nclock = {{ week = {WEEK} }}\n", "")):
        clock = f', clock = {{ system = "gps_week_seconds"{week} }}'
        (tmp_path / "SURVEY.toml").write_text(SURVEY.format(defaults=defaults, crs=OWN["crs"], clock=clock))
        planned, unplanned = plan_logs(Survey.load(tmp_path / "SURVEY.toml"), Store(str(tmp_path / "store"), "shared"))
        assert not unplanned
        keys.append({p.format.name: p.key for p in planned})
    assert keys[0]["sbet"] == keys[1]["sbet"]


def test_another_default_reads_the_log_again(tmp_path: Path) -> None:
    write_logs(tmp_path)
    keys = set()
    for week in (WEEK, WEEK + 1):
        text = SURVEY.format(defaults=DEFAULTS.replace(str(WEEK), str(week)), crs="", clock="")
        (tmp_path / "SURVEY.toml").write_text(text)
        planned, _ = plan_logs(Survey.load(tmp_path / "SURVEY.toml"), Store(str(tmp_path / "store"), "shared"))
        keys |= {p.key for p in planned if p.format.name == "sbet"}
    assert len(keys) == 2


@pytest.mark.parametrize(
    ("defaults", "own", "height", "geoid"),
    [
        ('height = "orthometric"\ngeoid = "g.tif"', "", "orthometric", "g.tif"),
        ('height = "orthometric"\ngeoid = "g.tif"', ', height = "ellipsoidal"', "ellipsoidal", None),
        ('height = "orthometric"\ngeoid = "g.tif"', ', geoid = "own.tif"', "orthometric", "own.tif"),
        ('geoid = "g.tif"', "", None, "g.tif"),
        ('geoid = "g.tif"', ', height = "orthometric"', "orthometric", "g.tif"),
    ],
)
def test_heights_and_geoid(tmp_path: Path, defaults: str, own: str, height: str | None, geoid: str | None) -> None:
    write_logs(tmp_path)
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(defaults=f"[defaults]\n{defaults}\n", crs=own, clock=""))
    planned, _ = plan_logs(Survey.load(tmp_path / "SURVEY.toml"), Store(str(tmp_path / "store"), "shared"))
    source = next(p.source for p in planned if p.format.name == "sbet")
    assert (source.any_height, source.geoid.grid if source.geoid else None) == (height, geoid)


@pytest.mark.parametrize(
    ("clock", "says"),
    [
        ('{ system = "free" }', "one sensor's own"),
        ("{ week = 2417, date = 2026-05-04 }", "not both"),
        ("{ week = 369 }", "modulo 1024"),
        ("{ offset_s = 0.1 }", "unknown key 'defaults.clock.offset_s'"),
    ],
)
def test_clocks_that_cannot_be_shared(tmp_path: Path, clock: str, says: str) -> None:
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(defaults=f"[defaults]\nclock = {clock}\n", crs="", clock=""))
    with pytest.raises(ConfigError, match=says):
        Survey.load(tmp_path / "SURVEY.toml")
