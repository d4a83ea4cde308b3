"""``roadscan sql``: whole text, UTC, CSV for scripts, and tables that are not made yet."""

from __future__ import annotations

import csv
import datetime as dt
import io
import json
import math

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import RoadscanError
from tests.surveys import Simulated

LEAP_SECONDS = {
    "1980-01-06": 0,
    "1981-07-01": 1,
    "1999-01-01": 13,
    "2005-12-31": 13,
    "2006-01-01": 14,
    "2016-12-31": 17,
    "2017-01-01": 18,
    "2026-05-04": 18,
}
"""GPS - UTC at the midnight with which a day begins, from IERS Bulletin C."""


def sql(survey: Simulated, statement: str, *options: str) -> str:
    """What the command prints."""
    command = ["sql", statement, "--survey", str(survey.survey_file), *options]
    return CliRunner().invoke(app, command, catch_exceptions=False).stdout


def rows(survey: Simulated, statement: str) -> list[dict[str, str]]:
    """Rows of its CSV, as Python's own reader reads it."""
    return list(csv.DictReader(io.StringIO(sql(survey, statement, "--csv"))))


def test_long_text_is_printed_whole(finished: Simulated) -> None:
    assert f"a{'b' * 400}c" in sql(finished, "SELECT 'a' || repeat('b', 400) || 'c' AS text")


@pytest.mark.slow
def test_utc_is_exact_at_leap_seconds(finished: Simulated) -> None:
    for day, leap in LEAP_SECONDS.items():
        midnight = dt.datetime.fromisoformat(f"{day}T00:00:00+00:00")
        gps_s = int((midnight - dt.datetime(1980, 1, 6, tzinfo=dt.UTC)).total_seconds()) + leap
        (row,) = rows(finished, f"SELECT utc({gps_s}123456789) AS t, utc({gps_s + 1}::BIGINT * 1000000000) AS later")
        assert row == {"t": f"{day}T00:00:00.123456Z", "later": f"{day}T00:00:01Z"}


def test_csv_is_what_scripts_read(finished: Simulated) -> None:
    statement = "SELECT tile, sum(points) AS points, any_value(passes) AS passes, utc(min(first_epoch_gps_ns)) AS t, "
    statement += (
        "any_value(sigma_down_m) AS sigma, {'n': 1, 'x': [0.5]} AS nested, NULL AS nothing FROM tiles GROUP BY tile"
    )
    found = rows(finished, statement)
    store = finished.store()
    table = pq.read_table(store.path("products/tile_table/tiles.parquet")).to_pylist()
    assert len(found) == len(table)
    for one in table:
        (row,) = [r for r in found if r["tile"] == one["tile"]]
        assert row["points"] == str(one["points"])
        assert json.loads(row["passes"]) == one["passes"]
        assert json.loads(row["nested"]) == {"n": 1, "x": [0.5]}
        assert row["nothing"] == ""
        assert math.isclose(float(row["sigma"]), one["sigma_down_m"])
        gps_s = one["first_epoch_gps_ns"] / 1e9
        utc = dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(seconds=gps_s - 18)
        assert row["t"].endswith("Z")
        assert abs((dt.datetime.fromisoformat(row["t"]) - utc).total_seconds()) < 1e-5


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("cracks", 'not made yet; add "cracks" to [products] make'),
        ("potholes", 'not made yet; add "potholes" to [products] make'),
        ("mountings", "not made yet; `roadscan calibrate` makes it"),
        ("gnss_between(1, 2)", "nmea"),
    ],
)
def test_a_table_that_is_not_made_says_what_makes_it(finished: Simulated, table: str, words: str) -> None:
    with pytest.raises(RoadscanError) as told:
        sql(finished, f"SELECT * FROM {table}")
    assert words in str(told.value)
