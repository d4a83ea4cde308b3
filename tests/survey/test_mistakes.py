"""A mistake costs one clear message before any long work; the page that lists them is made of these messages."""

from __future__ import annotations

import datetime as dt
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from docs.mistakes import FIRST_GPS_S, MISTAKES, Mistake, heard, write_scans, write_survey
from roadscan.cli import app
from roadscan.core.errors import RoadscanError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.store.digest import checked_json, parse_checked
from tests.surveys import Simulated

SOUND = Mistake("none", "")


def said(folder: Path, *arguments: str) -> tuple[int, str]:
    """Exit code of a command in a survey's folder, and all that it printed."""
    result = CliRunner().invoke(app, [arguments[0], str(folder / "SURVEY.toml"), *arguments[1:]])
    if isinstance(result.exception, RoadscanError):  # `main` prints it and ends with 2
        return 2, f"{result.output}{result.exception}"
    return result.exit_code, result.output


def run(folder: Path) -> tuple[int, str]:
    """The same of a whole run."""
    return said(folder, "run", "--workers", "0")


def changed(folder: Path, *swaps: tuple[str, str], make: Callable[[Path], object] = lambda _: None) -> Path:
    """A survey in `folder` with texts of its file exchanged."""
    write_survey(folder, SOUND)
    file = folder / "SURVEY.toml"
    text = file.read_text()
    for old, new in swaps:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)
    make(folder)
    return folder


# --- the list ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: m.name)
def test_a_mistake_costs_one_message(mistake: Mistake) -> None:
    found = heard(mistake)
    assert found.code == 2
    assert found.text.startswith("roadscan: ")
    assert found.text.count("\n") == 0
    assert "Traceback" not in found.text
    assert found.computed == 0
    assert found.logs == 0
    assert found.seconds < 20
    if mistake.command[0] == "run":
        assert found.dry_code == 2


def test_a_survey_without_a_mistake_begins(tmp_path: Path) -> None:
    write_survey(tmp_path, SOUND)
    code, text = said(tmp_path, "run", "--dry-run")
    assert code == 0
    assert "would fail" not in text


def test_all_causes_at_once_a_line_each(tmp_path: Path) -> None:
    changed(
        tmp_path,
        ('"scans.parquet"', '"scan.parquet"'),
        ("EPSG:25832\" }", 'EPSG:25832", height = "orthometric", geoid = "region.tif" }'),
        ("[[runs]]", '[products]\nmake = ["lass"]\noptions.geotiff.band = 1\n\n[tiles]\ncell_m = 0.05\n\n[[runs]]'),
    )  # fmt: skip
    code, text = run(tmp_path)
    assert code == 2
    lines = [line for line in text.splitlines() if line.startswith("  - ")]
    for words in ("'region.tif' was not found", "scan.parquet: the log does not exist", "'lass' (did", "'band' (did"):
        assert sum(words in line for line in lines) == 1
    assert len(lines) == 4
    assert not (tmp_path / "store").exists()
    for command in (("run", "--dry-run"), ("status",)):
        code, text = said(tmp_path, *command)
        assert code == (2 if command[0] == "run" else 1)
        assert text.count("a run would fail: ") == 4
    for stage in ("ingest", "footprints", "tile", "surfaces", "products"):
        assert said(tmp_path, stage, "--workers", "0")[0] == 2, stage


def test_a_geoid_is_missed_once(tmp_path: Path) -> None:
    """However many logs name it."""
    log = '[[runs.logs]]\npath = "{}.csv"\ncrs = "EPSG:4937"\nheight = "orthometric"\ngeoid = "region.tif"\n'
    log += 'clock = {{ system = "gps" }}\n\n'
    scans = '[[runs.logs]]\npath = "scans'
    changed(tmp_path, (scans, log.format("a") + log.format("b") + scans))
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(
            "time_s,longitude_deg,latitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
        )
    _, text = run(tmp_path)
    assert text.count("region.tif") == 1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('system = "gps" }', 'system = "gps", offset_s = 1e300 }', "'clock.offset_s' of log 'poses.csv'"),
        ('system = "gps" }', 'system = "gps", drift_ppm = -inf }', "'clock.drift_ppm' of log 'poses.csv'"),
        ("lever_arm_body_m = [0.0,", "lever_arm_body_m = [nan,", "lever_arm_body_m.0' (got nan)"),
        ('kind = "profiler",', 'kind = "profiler", range_max_m = nan,', "range_max_m' (got nan)"),
    ],
)
def test_numbers_that_are_none_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    """TOML has nan and inf; no distance, angle or time is either."""
    code, text = run(changed(tmp_path, (old, new)))
    assert code == 2 and words in text and "expected " in text
    assert not (tmp_path / "store").exists()


def test_no_limit_of_range_can_be_stated(tmp_path: Path) -> None:
    changed(tmp_path, ('kind = "profiler",', 'kind = "profiler", range_max_m = inf,'))
    assert said(tmp_path, "run", "--dry-run")[0] == 0


# --- times that do not meet -------------------------------------------------------------------------


def apart_words(folder: Path, scans_gps_s: float, *swaps: tuple[str, str]) -> str:
    """What is said of scans at another time."""
    changed(folder, *swaps)
    write_scans(folder / "scans.parquet", scans_gps_s)
    code, text = run(folder)
    assert code == 2
    assert not list((folder / "store").rglob("tiles/*"))
    return text


def utc(seconds_later: float) -> str:
    """UTC of the first pose and so many seconds, by the calendar alone."""
    at = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC) + dt.timedelta(seconds=seconds_later)
    return at.isoformat(sep=" ", timespec="seconds")[:19]


def test_both_spans_are_told(tmp_path: Path) -> None:
    assert gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)) == FIRST_GPS_S * 10**9
    text = apart_words(tmp_path, FIRST_GPS_S + 86_400 * 3 + 0.2)
    assert f"the scans last from {utc(86_400 * 3)} to {utc(86_400 * 3)} UTC" in text
    assert f"the poses of run 'monday' from {utc(0)} to {utc(0)} UTC" in text


@pytest.mark.parametrize(
    ("shift_s", "words"),
    [
        (3600, "clock.offset_s = -3600 (1 h earlier"),
        (-7200, "clock.offset_s = 7200 (2 h later"),
        (18, "clock.offset_s = -18 (the 18 leap seconds"),
        (1024 * 7 * 86_400, "(1024 weeks: a receiver that counts weeks modulo 1024) for scans.parquet"),
        (-1024 * 7 * 86_400, "clock.offset_s = 619315200 (1024 weeks"),
        (315_964_800, "clock.offset_s = -315964800 (seconds counted from 1970 in place of 1980"),
        (1_000_000_000, 'clock.system = "gps_adjusted" in place of "gps" (1,000,000,000 s later) for poses.csv'),
    ],
)
def test_what_would_make_them_meet(tmp_path: Path, shift_s: int, words: str) -> None:
    assert words in apart_words(tmp_path, FIRST_GPS_S + shift_s + 0.2)


def test_logs_that_cannot_meet_are_told_before_they_are_read(tmp_path: Path) -> None:
    """As large logs are: by their first chunk, and by their end where that is found in a moment."""
    clock = 'crs = "EPSG:4937"\nclock = { system = "gps_week_seconds", week = %d }\nformat = "sbet"'
    old = 'crs = "EPSG:25832"\nheight = "ellipsoidal"\nclock = { system = "gps" }\noptions = { heading = "grid" }'
    changed(tmp_path, ('"poses.csv"', '"poses.sbet"'), (old, clock % 2416))
    at = FIRST_GPS_S % 604_800
    poses = np.zeros((70_000, 17))
    poses[:, 0], poses[:, 1], poses[:, 2], poses[:, 3] = at + np.arange(70_000) / 200, 0.84, 0.16, 500.0
    poses.astype("<f8").tofile(tmp_path / "poses.sbet")
    assert (tmp_path / "poses.sbet").stat().st_size > 8 << 20
    for command in ("run", "--dry-run"), ("status",), ("run", "--workers", "0"):
        code, text = said(tmp_path, *command)
        assert code == (1 if command[0] == "status" else 2)
        assert re.search(r"from 2026-04-27 09:30:00 to 2026-04-27 09:35:49 UTC", text)
        assert "clock.week = 2417 (1 week later" in text
    assert not list((tmp_path / "store").rglob("tables/*"))
    text = (tmp_path / "SURVEY.toml").read_text()
    (tmp_path / "SURVEY.toml").write_text(text.replace("2416", "2417"))
    for shift_s, code in ((0.0, 0), (340.0, 0), (-1.0, 2), (350.0, 2)):
        write_scans(tmp_path / "scans.parquet", FIRST_GPS_S + shift_s)
        assert said(tmp_path, "run", "--dry-run")[0] == code, shift_s


def test_nothing_is_suggested_where_nothing_fits(tmp_path: Path) -> None:
    text = apart_words(tmp_path, FIRST_GPS_S + 1234)
    assert "would meet" not in text
    assert "check the clocks of both" in text


SECOND = """
[[runs]]
id = "tuesday"

[[runs.logs]]
path = "poses.csv"
crs = "EPSG:25832"
height = "ellipsoidal"
clock = { system = "gps" }
options = { heading = "grid" }

[[runs.logs]]
path = "late.parquet"
sensor = "profiler"
"""


def test_other_logs_go_on_and_the_failure_stays(tmp_path: Path) -> None:
    changed(tmp_path, ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    with (tmp_path / "SURVEY.toml").open("a") as stream:
        stream.write(SECOND)
    write_scans(tmp_path / "late.parquet", FIRST_GPS_S + 3600.2)
    code, text = said(tmp_path, "run", "--dry-run")
    assert code == 2
    assert text.count("a run would fail: late.parquet: the scans last from") == 1
    for _ in range(2):  # what is known is told again
        code, text = run(tmp_path)
        assert code == 2
        assert sum(line.startswith("failed: ingest late.parquet: ") for line in text.splitlines()) == 1
        assert list((tmp_path / "store").rglob("tiles/geotiff/*.tif"))
    code, text = said(tmp_path, "status")
    assert code == 1
    assert text.count("late.parquet: the scans last from") == 1
    assert said(tmp_path, "run", "--dry-run")[0] == 2
    assert said(tmp_path, "tile", "--workers", "0")[0] == 2
    write_scans(tmp_path / "late.parquet", FIRST_GPS_S + 0.2)
    assert run(tmp_path)[0] == 0


def test_a_gnss_log_of_another_day_fails(tmp_path: Path) -> None:
    log = '[[runs.logs]]\npath = "rover.pos"\ncrs = "EPSG:4937"\n\n[[runs.logs]]\npath = "scans'
    changed(tmp_path, ('[[runs.logs]]\npath = "scans', log))
    head = "% GPST latitude(deg) longitude(deg) height(m) Q ns\n"
    (tmp_path / "rover.pos").write_text(
        head + "".join(f"2026/05/06 09:30:{s:02d}.000 47.85 9.0 500.0 1 12\n" for s in range(9))
    )
    code, text = said(tmp_path, "ingest", "--workers", "0")
    assert code == 2
    assert "failed: ingest rover.pos: the gnss last from 2026-05-06 09:29:42 to 2026-05-06 09:29:50 UTC" in text


def test_a_store_that_moved_with_its_survey_knows_its_archived_logs(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    changed(tmp_path / "here", ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    assert run(tmp_path / "here")[0] == 0
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "here").rename(tmp_path / "far" / "away" / "there")
    for name in ("poses.csv", "scans.parquet"):
        (tmp_path / "far" / "away" / "there" / name).unlink()
    code, text = said(tmp_path / "far" / "away" / "there", "status")
    assert code == 0 and text.count("ingested") == 2
    code, text = run(tmp_path / "far" / "away" / "there")
    assert code == 0 and text.count("known: ") == 2


def test_a_run_after_a_stopped_one_leaves_foreign_files_and_tells_of_the_others(tmp_path: Path) -> None:
    changed(tmp_path, ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    assert run(tmp_path)[0] == 0
    folder = tmp_path / "store" / "survey=street"
    (foreign := folder / "tiles" / "geotiff" / "map.qgz").write_text("of a GIS")
    os.utime(foreign, (1e9, 1e9))
    (folder / "manifest" / "changing").write_bytes(b"")  # as a run leaves it that is stopped now
    (left := folder / "tiles" / "geotiff" / "5_5.tif").write_text("whole, and not recorded")
    code, text = run(tmp_path)
    assert code == 0 and foreign.exists() and not left.exists()
    assert "note: removed 1 file that a stopped run left without a record, in tiles/geotiff" in text
    code, text = run(tmp_path)
    assert code == 0 and foreign.exists() and "removed" not in text


def test_an_older_list_of_logs_is_read(tmp_path: Path) -> None:
    """It names them by their absolute paths."""
    changed(tmp_path, ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    assert run(tmp_path)[0] == 0
    for name in ("sources", "sources_copy"):
        file = tmp_path / "store" / "survey=street" / "manifest" / f"{name}.json"
        known = parse_checked(file.read_bytes())
        assert set(known) == {"poses.csv", "scans.parquet"}
        file.write_bytes(checked_json({str((tmp_path / path).resolve()): of for path, of in known.items()}))
    (tmp_path / "scans.parquet").unlink()
    assert said(tmp_path, "status")[0] == 0


# --- stamps and mountings ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.witness("one_stamp")
def test_a_log_of_one_stamp_fails_beside_others(tmp_path: Path) -> None:
    log = '[[runs.logs]]\npath = "more.parquet"\nsensor = "profiler"\n\n'
    scans = '[[runs.logs]]\npath = "scans'
    changed(tmp_path, (scans, log + scans))
    write_scans(tmp_path / "more.parquet", FIRST_GPS_S + 0.3, step_ns=0)
    rows = pq.read_table(tmp_path / "more.parquet")  # equal rows would be one that stands many times
    ranges = pa.FixedSizeListArray.from_arrays((20_000 + np.arange(30 * 40) // 40).astype(np.uint16), 40)
    pq.write_table(rows.set_column(1, rows.schema.field(1), ranges), tmp_path / "more.parquet")
    for command in ("run", "--dry-run"), ("run", "--workers", "0"):
        code, text = said(tmp_path, *command)
        assert code == 2
        assert "more.parquet: its 30 scans carry one stamp" in text
    assert "1,200, of which kept 1,200" in text
    assert said(tmp_path, "status")[0] == 1


@pytest.mark.witness("one_stamp")
def test_rows_of_a_clock_that_stands_for_a_while_are_left_out(tmp_path: Path) -> None:
    changed(tmp_path)
    rows = pq.read_table(tmp_path / "scans.parquet")
    epochs = rows.column(0).to_numpy().copy()
    epochs[8:22] = epochs[8]
    ranges = pa.FixedSizeListArray.from_arrays((20_000 + np.arange(30 * 40) // 40).astype(np.uint16), 40)
    stopped = rows.set_column(0, rows.schema.field(0), pa.array(epochs)).set_column(1, rows.schema.field(1), ranges)
    pq.write_table(stopped, tmp_path / "scans.parquet")
    code, text = said(tmp_path, "run", "--workers", "0")
    assert code == 0, text
    assert "13 rows of 30 carry the stamp of those before" in text
    assert "680, of which kept 680" in text


def test_two_trajectories_of_one_time_are_refused(tmp_path: Path) -> None:
    """The second is the same drive, a metre higher: nothing says which of them holds."""
    text = (changed(tmp_path) / "SURVEY.toml").read_text()
    block = text[text.index('[[runs.logs]]\npath = "poses.csv"') :].split("\n\n")[0]
    changed(tmp_path, (block, block + "\n\n" + block.replace("poses.csv", "higher.csv")))
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    at = lines[0].split(",").index("height_m")
    rows = [line.split(",") for line in lines[1:]]
    higher = [",".join([*row[:at], f"{float(row[at]) + 1:.4f}", *row[at + 1 :]]) for row in rows]
    (tmp_path / "higher.csv").write_text("\n".join([lines[0], *higher]) + "\n")
    code, words = run(tmp_path)
    assert code != 0 and "two trajectories of one time: poses.csv and higher.csv" in words, words


def test_a_longer_vehicle_is_stated(tmp_path: Path) -> None:
    arm = ("lever_arm_body_m = [0.0, 0.0, 0.0]", "lever_arm_body_m = [-12.5, 0.0, 0.0]")
    changed(tmp_path, arm)
    code, text = said(tmp_path, "run", "--dry-run")
    assert code == 2
    assert "the lever arm of sensor 'profiler' is [-12.5, 0, 0] m" in text and "checks.lever_arm_max_m" in text
    changed(tmp_path, arm, ("[[runs]]", "[checks]\nlever_arm_max_m = 13\n\n[[runs]]"))
    assert said(tmp_path, "run", "--dry-run")[0] == 0


# --- readings that are lost -------------------------------------------------------------------------


def damage(folder: Path, lines: slice) -> None:
    file = folder / "poses.csv"
    rows = file.read_text().splitlines()
    rows[lines] = ["1,2,3,4,5,6,7000" for _ in rows[lines]]
    file.write_text("\n".join(rows) + "\n")


@pytest.mark.witness("rejected_share")
def test_reasons_of_rejects_are_printed(tmp_path: Path) -> None:
    changed(tmp_path, make=lambda f: damage(f, slice(2, 8)))
    code, text = said(tmp_path, "ingest", "--workers", "0")
    assert code == 0
    assert re.search(r"poses\.csv .* 14 rows, 6 rejected: 6 × .*heading.*table `rejects`", text)
    assert re.search(r"note: poses\.csv: 6 records were rejected beside 14 rows: 6 × ", text)
    (tmp_path / "SURVEY.toml").write_text("checks.lost_share = 0.31\n" + (tmp_path / "SURVEY.toml").read_text())
    assert "note: " not in said(tmp_path, "ingest", "--workers", "0")[1]


def test_a_log_of_positions_without_one_is_refused(tmp_path: Path) -> None:
    changed(tmp_path, make=lambda f: damage(f, slice(1, None)))
    code, text = run(tmp_path)
    assert code == 2
    assert re.search(r"poses\.csv: not one of its 20 records can be used: 20 × .*heading", text)
    assert not (tmp_path / "store").exists()


def test_a_log_whose_records_are_all_rejected_fails(tmp_path: Path) -> None:
    """Profiles before 1980."""
    changed(tmp_path)
    write_scans(tmp_path / "scans.parquet", -5.0)
    code, text = run(tmp_path)
    assert code == 2
    assert re.search(r"scans\.parquet: not one of its 30 records can be used: 30 × .*table `rejects`", text)


@pytest.mark.witness("no_pose")
def test_readings_without_poses_are_warned_of(tmp_path: Path) -> None:
    """Of profiles over 0.3 s, the last 0.2 s come after the last pose."""
    changed(tmp_path, ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    write_scans(tmp_path / "scans.parquet", FIRST_GPS_S + 0.853)
    code, text = run(tmp_path)
    assert code == 0
    note = r"note: scans\.parquet: \d+ of 1,200 readings \(6\d%\) have no pose"
    assert re.search(note, text)
    assert re.search(note.replace("note:", r"left out\s+"), text)  # the summary
    assert re.search(note, said(tmp_path, "status")[1])
    (report,) = tmp_path.rglob("report.html")
    assert re.search(r"scans\.parquet</td><td[^>]*>\d+ of 1,200 readings \(6\d%\) have no pose", report.read_text())
    code, text = said(tmp_path, "run", "--json", "--workers", "0")
    (found,) = json.loads(text[text.index("{") :])["findings"]
    assert (found["witness"], found["subject"]) == ("no_pose", "scans.parquet")
    assert f"{found['left_out']} of 1,200 readings" in found["text"]


def test_a_log_that_loses_most_readings_is_named_beside_larger_ones(tmp_path: Path) -> None:
    """Of one log of eight, two thirds: 8 % of all readings."""
    log = '[[runs.logs]]\npath = "more_{}.parquet"\nsensor = "profiler"\n\n'
    scans = '[[runs.logs]]\npath = "scans'
    changed(tmp_path, (scans, "".join(map(log.format, range(7))) + scans))
    for number in range(7):
        write_scans(tmp_path / f"more_{number}.parquet", FIRST_GPS_S + 0.1 + 0.01 * number)
    write_scans(tmp_path / "scans.parquet", FIRST_GPS_S + 0.853)
    for code, text in (run(tmp_path), said(tmp_path, "status")):
        assert code == 0
        assert re.findall(r"note: (\S+): \d+ of [\d,]+ readings \(6\d%\) have no pose", text) == ["scans.parquet"]


@pytest.mark.parametrize(
    ("swap", "words"),
    [
        (
            ('kind = "profiler"', 'kind = "profiler", range_max_m = 1.0'),
            "1,200 lie outside range_min_m and range_max_m",
        ),
        (("[[runs]]", "[filters]\nheight_max_m = 50.0\n\n[[runs]]"), "1,200 lie outside the heights of [filters]"),
    ],
)
def test_limits_that_leave_nothing_fail(tmp_path: Path, swap: tuple[str, str], words: str) -> None:
    changed(tmp_path, swap)
    code, text = run(tmp_path)
    assert code == 2
    assert words in text
    assert said(tmp_path, "status")[0] == 1


def test_a_pass_of_another_hour_fails(tmp_path: Path) -> None:
    """The first holds all; the second is stated in local time."""
    passes = [(1, "09:30:00Z", "09:31:00Z"), (2, "11:30:00Z", "11:31:00Z")]
    text = "".join(
        f'[[passes]]\nid = {n}\nrun = "monday"\nstart = 2026-05-04T{start}\nend = 2026-05-04T{end}\n\n'
        for n, start, end in passes
    )
    changed(tmp_path, ("[[runs]]", text + "[[runs]]"), ('id = "street"', 'id = "street"\nproducts.make = ["geotiff"]'))
    code, printed_ = run(tmp_path)
    assert code == 2
    assert "failed: footprints pass 2: it lasts from 2026-05-04T11:30:00Z to 2026-05-04T11:31:00Z" in printed_
    assert "failed: footprints pass 1" not in printed_
    assert list((tmp_path / "store").rglob("tiles/geotiff/*.tif"))


def test_centre_lines_that_leave_nothing_fail(tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": [[9.05, 47.85], [9.06, 47.85]]}
    layer = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": line}]}
    filters = '[filters]\ncentre_line = "lines.geojson"\n\n[[runs]]'
    changed(tmp_path, ("[[runs]]", filters), make=lambda f: (f / "lines.geojson").write_text(json.dumps(layer)))
    code, text = run(tmp_path)
    assert code == 2
    assert "no tile holds a reading: all lie off the centre lines of filters.centre_line" in text
    (tmp_path / "lines.geojson").unlink()
    code, text = run(tmp_path)
    assert code == 2
    assert "lines.geojson: the centre-line layer does not exist" in text


# --- kinds and segmentation -------------------------------------------------------------------------


@pytest.mark.slow
def test_segmentation_says_to_what_it_applies(simulated: Simulated, tmp_path: Path) -> None:
    folder = simulated.copy_to(tmp_path / "survey").survey_file.parent
    text = (folder / "SURVEY.toml").read_text()
    (folder / "SURVEY.toml").write_text(text + "\n[segmentation]\n")
    code, printed_ = said(folder, "run", "--dry-run")
    assert code == 0
    assert "[segmentation] applies to profiler_left, profiler_right; all readings of lidar count" in printed_
    logs = re.sub(r"\[\[runs\.logs\]\]\npath = \"raw/run-\d/profiler_.*\nformat.*\nsensor.*\n", "", text)
    (folder / "SURVEY.toml").write_text(logs + "\n[segmentation]\n")
    code, printed_ = run(folder)
    assert code == 2
    assert "[segmentation] would do nothing" in printed_
    assert "lidar (returns)" in printed_
    (folder / "SURVEY.toml").write_text(logs + '\n[segmentation]\nsensors = ["lidar"]\n')
    assert "segmentation.sensors names 'lidar', whose readings are returns" in run(folder)[1]


@pytest.mark.parametrize("kind", ["gnss", "imu", "encoder", "camera"])
def test_a_kind_that_cannot_have_written_the_log(tmp_path: Path, kind: str) -> None:
    changed(tmp_path, ('kind = "profiler"', f'kind = "{kind}"'))
    code, text = run(tmp_path)
    assert code == 2
    assert f"is of kind {kind}, and the log yields scans; expected a sensor of kind lidar or profiler" in text


# --- σ of control -----------------------------------------------------------------------------------

CONTROL = '[[control]]\npath = "control.csv"\ncrs = "EPSG:25832"\nheight = "ellipsoidal"\n\n[[runs]]'


def with_control(folder: Path, unit: str, *sigmas: str) -> list[str]:
    """What ingesting a survey says of the σ of its control points."""
    changed(folder, ("[[runs]]\n", CONTROL + "\n"))
    lines = [f"P{k},gcp,{500_000 + k},{5_300_000 + k},100,{sigma}" for k, sigma in enumerate(sigmas)]
    text = "\n".join([f"name,role,easting_m,northing_m,height_m,sigma_height_{unit}", *lines, ""])
    (folder / "control.csv").write_text(text)
    assert said(folder, "ingest", "--workers", "0")[0] == 0
    return [line for line in said(folder, "status")[1].splitlines() if "the σ of the" in line]


@pytest.mark.witness("control_sigma")
@pytest.mark.parametrize(
    ("unit", "sigmas", "words"),
    [
        ("m", ("3", "0.004", "5"), "height of 2 of 3 points (3 m to 5 m) is so large"),
        ("m", ("0", "0.004", ""), "height of 1 of 3 points is 0: it counts as not stated"),
        ("mm", ("0.003", "0.004"), "height of 2 of 2 points (3e-06 m to 4e-06 m) is smaller than any survey reaches"),
    ],
)
def test_a_sigma_that_no_survey_has_is_named(tmp_path: Path, unit: str, sigmas: tuple[str, ...], words: str) -> None:
    (found,) = with_control(tmp_path, unit, *sigmas)
    assert words in found


def test_sigmas_that_surveys_have_are_not_doubted(tmp_path: Path) -> None:
    """Precise levelling, tachymetry, GNSS in the field."""
    assert with_control(tmp_path, "mm", "0.2", "3", "25", "150", "") == []


# --- settings that a late stage refuses -------------------------------------------------------------

SURFACE = '[surface]\nmethod = "points"\nsigma_m = 0.002\n'


def picked(*rows: str) -> Callable[[Path], object]:
    """A file of picked targets."""
    return lambda folder: (folder / "picked.csv").write_text("\n".join(["run,name,easting_m,northing_m", *rows]))


def layer(shape: dict[str, object]) -> Callable[[Path], object]:
    """A layer of reference lines with one feature."""
    feature = {"type": "Feature", "properties": {}, "geometry": shape}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    whole = {"type": "FeatureCollection", "crs": crs, "features": [feature]}
    return lambda folder: (folder / "lines.geojson").write_text(json.dumps(whole))


@pytest.mark.parametrize(
    ("section", "make", "words"),
    [
        (
            f'{SURFACE}[products]\nmake = ["crack_pieces"]\n\n[tiles]\ncell_m = 0.05\n\n',
            None,
            "'crack_pieces' got cells of 0.05 × 0.05 m",
        ),
        (f'{SURFACE}regions = "found"\n\n', None, 'surface.regions = "found" needs profiles across the road'),
        ('[adjust]\ntargets = { picked = "picked.csv" }\n\n', picked("sunday,a,1,2"), "picked in run 'sunday'"),
        ('[adjust]\ntargets = { picked = "picked.csv" }\n\n', picked("monday,a,1,x"), "could not convert string"),
        (
            '[condition]\nreference = "layer"\nlayer = "lines.geojson"\n\n',
            layer({"type": "Point", "coordinates": [500000.0, 5300000.0]}),
            "feature 0 of the layer (counted from 0) cannot be used",
        ),
    ],
    ids=["cells", "regions", "run", "metres", "feature"],
)
def test_what_a_late_stage_would_refuse_is_refused_before_a_log_is_read(
    tmp_path: Path, section: str, make: Callable[[Path], object] | None, words: str
) -> None:
    turned = ("[0.0, 0.0, 0.0] }", '[0.0, 0.0, 0.0], axes = "flu" }') if "found" in section else ("", "")
    changed(tmp_path, turned, ("[[runs]]\n", f"{section}[[runs]]\n"), make=make or (lambda _: None))
    code, text = run(tmp_path)
    assert code == 2
    assert words in text
    assert not (tmp_path / "store").exists()
