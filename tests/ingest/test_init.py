"""``roadscan init``: a first survey file from a folder of logs, and the way from there to the same tiles."""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial import KDTree
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.strict import OPEN_QUESTION
from roadscan.core.survey import Survey
from roadscan.ingest.inspect.first_survey import FoundFolder, find_logs
from roadscan.ingest.inspect.first_survey_text import FirstSurvey, write_first_survey
from roadscan.simulate import simulate, truth
from tests.answers import answer_questions, first_survey, roadscan, spared
from tests.formats.sick_files import encode_scans, write_telegrams
from tests.ingest.test_inspect import sbet, written
from tests.surveys import Simulated, outputs, small_scene


def runs_of(found: FoundFolder) -> dict[str, list[str]]:
    """Names of the logs by run."""
    return {run.id: sorted(os.path.relpath(log.path, found.folder) for log in run.logs) for run in found.runs}


def complete(file: Path, answers: dict[str, dict[str, str]]) -> None:
    """Answer questions, and commented settings, with TOML values by key.

    Answers stand under the path of the log that a block of lines begins with, or under its table's header.
    """
    place = ""
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            place = line.strip("[]")
        elif line.startswith("path = "):
            place = tomllib.loads(line)["path"]
        key = re.match(r"#\??\s*([\w.]+) = ", line)
        answer = None if key is None else answers.get(place, {}).get(key[1])
        lines.append(line if key is None or answer is None else f"{key[1]} = {answer}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    return str(value).lower() if isinstance(value, bool) else str(value)


def answers_of(original: Survey, first: FirstSurvey) -> dict[str, dict[str, str]]:
    """What the simulator's own survey and rig files say, for the questions of the first survey."""
    values = tomllib.loads((original.folder / "SURVEY.toml").read_text())
    said = {"map": {"crs": toml(values["map"]["crs"])}}
    names = {str(log.path.relative_to(first.found.folder)): log.sensor for log in first.found.logs}
    stated = [log for run in values["runs"] for log in run["logs"]]
    for log in [*stated, *values["control"]]:
        settings = {f"options.{name}": value for name, value in log.get("options", {}).items()} | log
        said[f"logs/{log['path']}"] = {name: toml(value) for name, value in settings.items()}
        if "sensor" in log:
            sensor = original.rig.sensors[log["sensor"]]
            keys = ("axes", "lever_arm_body_m", "boresight", "range_min_m", "range_max_m")
            mounted = sensor.model_dump(include=set(keys))
            said[f"sensors.{names[log['path']]}"] = {key: toml(mounted[key]) for key in keys}
    return said


@pytest.fixture
def first(simulated: Simulated, tmp_path: Path) -> FirstSurvey:
    """A first survey file from the raw logs and control points of the simulated survey."""
    source = simulated.survey_file.parent
    shutil.copytree(source / "raw", tmp_path / "logs" / "raw")
    shutil.copy(source / "control.csv", tmp_path / "logs")
    return write_first_survey(find_logs(tmp_path / "logs"), tmp_path / "SURVEY.toml")


@pytest.mark.slow
def test_a_simulated_survey_is_found_and_grouped(first: FirstSurvey, simulated: Simulated) -> None:
    survey = Survey.load(simulated.survey_file)
    stated = {
        run.id: sorted(str(log.path) for log in run.logs if log.format in {"sbet", "scans", "velodyne_pcap"})
        for run in survey.config.runs
    }
    found = runs_of(first.found)
    assert {run: [log for log in logs if log in stated[run]] for run, logs in found.items()} == stated
    assert set(survey.rig.sensors) <= set(first.found.sensors)
    assert [log.path.name for log in first.found.control] == ["control.csv"]


@pytest.mark.slow
def test_the_file_names_the_next_thing_to_complete(first: FirstSurvey, simulated: Simulated) -> None:
    """Question after question is named with its line; each goes away once it is answered."""
    assert "crs" not in tomllib.loads(first.survey_file.read_text())["map"]
    assert first.rig_file is not None
    whole = answers_of(Survey.load(simulated.survey_file), first)
    asked = 0
    for file in (first.survey_file, first.rig_file):
        questions = [x for x in file.read_text().splitlines() if x.startswith(OPEN_QUESTION)]
        for number, line in enumerate(questions):
            with pytest.raises(ConfigError) as caught:
                Survey.load(first.survey_file)
            told = str(caught.value)
            lines = file.read_text().splitlines()
            assert told.startswith(f"{file}: line {lines.index(line) + 1} is not completed")
            assert f"({len(questions) - number} open in all): {line.removeprefix('#? ')};" in told
            file.write_text(file.read_text().replace(line + "\n", line.replace("#?", "#!", 1) + "\n", 1))
            asked += 1
        file.write_text(file.read_text().replace("#! ", "#? "))
        complete(file, whole)
    assert asked == first.questions > 5
    assert Survey.load(first.survey_file).config.runs


@pytest.mark.slow
def test_what_other_logs_say_is_hinted_and_not_filled_in(first: FirstSurvey) -> None:
    text = first.survey_file.read_text()
    assert '#? clock = { system = "gps_week_seconds", week = ???? }' in text
    assert "week 2417 would make it overlap with" in text  # 2026-05-04 lies in GPS week 2417
    assert '#? crs = "EPSG:32632"\n# WGS 84 / UTM zone 32N would hold trajectory.sbet' in text
    assert "week = 2417" not in text


@pytest.mark.slow
def test_completing_it_gives_the_same_tiles(finished: Simulated, first: FirstSurvey) -> None:
    """All questions answered with what the simulator's own files say: the same tiles, byte for byte."""
    original = Survey.load(finished.survey_file)
    assert first.rig_file is not None
    for file in (first.survey_file, first.rig_file):
        complete(file, answers_of(original, first))
        assert OPEN_QUESTION + " " not in "\n".join(file.read_text().splitlines()[4:])
    config = original.config
    named = first.survey_file.read_text().replace('id = "logs"', f"id = {toml(config.id)}", 1)
    first.survey_file.write_text(named.replace('title = ""', f"title = {toml(config.title)}", 1))
    done = Simulated(first.survey_file)
    done.run(passes=config.model_dump()["passes"], adjust__on=False)
    expected = {path: data for path, data in outputs(finished.store()).items() if path.startswith("tiles/")}
    made = {path: data for path, data in outputs(done.store()).items() if path.startswith("tiles/")}
    assert len(expected) > 10
    assert made.keys() == expected.keys()
    assert [path for path in expected if made[path] != expected[path]] == []


@pytest.mark.slow
def test_nothing_is_overwritten(first: FirstSurvey) -> None:
    before = first.survey_file.read_bytes()
    with pytest.raises(ConfigError, match="never overwritten"):
        write_first_survey(first.found, first.survey_file)
    with pytest.raises(ConfigError, match=r"RIG\.toml: .*never overwritten"):
        write_first_survey(first.found, first.survey_file.with_name("OTHER.toml"))
    assert first.survey_file.read_bytes() == before


@pytest.mark.slow
def test_the_command_says_what_it_did(first: FirstSurvey, tmp_path: Path) -> None:
    (tmp_path / "logs" / "notes.txt").write_text("rain from ten o'clock\n")
    done = CliRunner().invoke(app, ["init", str(tmp_path / "logs"), "--out", str(tmp_path / "second" / "SURVEY.toml")])
    assert done.exit_code == 0, done.exception
    assert "not understood: notes.txt: text" in done.stdout
    assert "lines to complete (they begin with #?)" in done.stdout
    assert '# "../logs/notes.txt": text' in (tmp_path / "second" / "SURVEY.toml").read_text()
    again = CliRunner().invoke(app, ["init", str(tmp_path / "logs"), "--out", str(tmp_path / "second" / "SURVEY.toml")])
    assert again.exit_code != 0


# --- grouping ------------------------------------------------------------------------------------------


def test_logs_join_the_drive_whose_time_they_share(tmp_path: Path) -> None:
    """Two drives in one folder, an hour apart: time decides, not names."""
    written(tmp_path / "a.sbet", sbet(100_000 + np.arange(2_000) / 200))
    written(tmp_path / "b.sbet", sbet(103_600 + np.arange(2_000) / 200))
    sigma = np.column_stack([103_600 + np.arange(20) / 2, np.full((20, 9), 0.01)])
    (tmp_path / "a_accuracy.smrmsg").write_bytes(sigma.astype("<f8").tobytes())
    found = find_logs(tmp_path)
    assert runs_of(found) == {"a": ["a.sbet"], "b": ["b.sbet"]}
    assert [(log.path.name, one.path.name, setting) for log, one, setting in found.pairs] == [
        ("b.sbet", "a_accuracy.smrmsg", "accuracy")
    ]


def smrmsg(path: Path, first_s: float, records: int = 20) -> None:
    sigma = np.column_stack([first_s + np.arange(records) / 2, np.full((records, 9), 0.01)])
    path.write_bytes(sigma.astype("<f8").tobytes())


def test_pairs_in_one_folder_are_told_by_time_then_by_name(tmp_path: Path) -> None:
    """Two missions one after another, and two at the same time of the week; one accuracy file is of none of them."""
    for name, first_s in (("A", 100_000.0), ("B", 100_009.0), ("C", 200_000.0), ("D", 200_000.0)):
        written(tmp_path / f"sbet_{name}.out", sbet(first_s + np.arange(2_000) / 200))
        smrmsg(tmp_path / f"smrmsg_{name}.out", first_s)
    smrmsg(tmp_path / "smrmsg_lost.out", 400_000.0)
    found = find_logs(tmp_path)
    named = {log.path.name: one.path.name for log, one, _ in found.pairs}
    assert named == {f"sbet_{name}.out": f"smrmsg_{name}.out" for name in "ABCD"}
    text = write_first_survey(found, tmp_path / "SURVEY.toml").survey_file.read_text()
    values = tomllib.loads(text)
    logs = {log["path"]: log for run in values["runs"] for log in run["logs"]}
    assert logs["sbet_C.out"]["options"] == {"accuracy": "smrmsg_C.out"}
    assert [path for path in logs if "smrmsg" in path] == ["smrmsg_lost.out"]
    assert "# no log of sbet was found that this one belongs to by its time" in text


def test_folders_pair_what_names_do_not(tmp_path: Path) -> None:
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        written(tmp_path / folder / "sbet.out", sbet(100_000 + np.arange(2_000) / 200))
        smrmsg(tmp_path / folder / "smrmsg.out", 100_000.0)
    pairs = [(log.path, one.path) for log, one, _ in find_logs(tmp_path).pairs]
    assert len(pairs) == 2
    assert all(one.parent == log.parent for log, one in pairs)


def test_logs_without_a_trajectory_are_grouped_by_folder(tmp_path: Path) -> None:
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        sigma = np.column_stack([103_600 + np.arange(20) / 2, np.full((20, 9), 0.01)])
        (tmp_path / folder / "sigma.smrmsg").write_bytes(sigma.astype("<f8").tobytes())
    assert runs_of(find_logs(tmp_path)) == {"monday": ["monday/sigma.smrmsg"], "tuesday": ["tuesday/sigma.smrmsg"]}


def test_stores_hidden_files_and_links_are_left_out(tmp_path: Path) -> None:
    for folder in ("store/survey=x", ".hidden", "drive"):
        (tmp_path / folder).mkdir(parents=True)
        written(tmp_path / folder / "a.sbet", sbet(100_000 + np.arange(100) / 200))
    (tmp_path / "link").symlink_to(tmp_path / "drive", target_is_directory=True)
    assert runs_of(find_logs(tmp_path)) == {"drive": ["drive/a.sbet"]}


def test_a_damaged_log_is_listed_with_its_reason(tmp_path: Path) -> None:
    written(tmp_path / "a.sbet", sbet(100_000 + np.arange(100) / 200))
    (tmp_path / "cut.las").write_bytes(b"LASF" + bytes(50))
    found = find_logs(tmp_path)
    ((path, words),) = found.unknown
    assert path.name == "cut.las"
    assert "cannot be read" in words
    made = write_first_survey(found, tmp_path / "out" / "SURVEY.toml")
    assert made.rig_file is None
    assert "rig" not in tomllib.loads(made.survey_file.read_text())


def test_a_log_whose_file_states_its_crs_fills_the_map_in(tmp_path: Path) -> None:
    import pyproj

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_crs(pyproj.CRS("EPSG:25832+7837"))
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.full(3, 500_000.0), np.full(3, 5.4e6), np.full(3, 100.0)
    cloud.gps_time = np.array([4.6e8, 4.6e8 + 1, 4.6e8 + 2])
    cloud.write(tmp_path / "street.las")
    made = write_first_survey(find_logs(tmp_path), tmp_path / "out" / "SURVEY.toml")
    survey = Survey.load(made.survey_file)
    assert made.questions == 0
    assert survey.config.map.crs == "EPSG:25832"
    assert [log.format for log in survey.config.runs[0].logs] == ["las"]


@pytest.mark.parametrize("stamped", [False, True])
def test_settings_that_exclude_each_other_are_one_question(tmp_path: Path, stamped: bool) -> None:
    ranges = np.random.default_rng(1).integers(1, 8000, (40, 181), dtype=np.uint16)
    stamps = 10**18 + np.arange(40) * 13_333_333
    (tmp_path / "logs").mkdir()
    write_telegrams(tmp_path / "logs/a.lms", encode_scans(ranges, "mm"), stamps if stamped else None)
    first = write_first_survey(find_logs(tmp_path / "logs"), tmp_path / "SURVEY.toml")
    lines = first.survey_file.read_text().splitlines()
    about = [line for line in lines if re.match(r"#\?? options\.", line)]
    by_rate = ['# options.first_stamp_s = "????"', '# options.scans_per_s = "????"']
    if stamped:
        assert about == ["#? options.stamped = true", '# options.stamps = "????"', *by_rate]
    else:
        assert about == ['#? options.stamps = "????"', *by_rate, "# options.stamped = true"]
    assert lines.count("# or, in its place:") == 2
    assert sum(line.startswith("#? clock = ") for line in lines) == 1


def test_odd_names_stay_valid(tmp_path: Path) -> None:
    folder = tmp_path / 'Straße "1" \\ ü'
    folder.mkdir()
    written(folder / "fähre # 1.sbet", sbet(100_000 + np.arange(100) / 200))
    made = write_first_survey(find_logs(folder), tmp_path / "SURVEY.toml")
    values = tomllib.loads(made.survey_file.read_text(encoding="utf-8"))
    path = values["runs"][0]["logs"][0]["path"]
    assert (tmp_path / path).is_file()
    answers = {"map": {"crs": '"EPSG:32632"'}, path: {"clock": '{ system = "gps" }', "crs": '"EPSG:4979"'}}
    complete(made.survey_file, answers)
    assert Survey.load(made.survey_file).config.runs[0].id


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no log that roadscan can read"):
        write_first_survey(find_logs(tmp_path), tmp_path / "SURVEY.toml")
    with pytest.raises(ConfigError, match="no such folder"):
        find_logs(tmp_path / "none")


@pytest.mark.slow
def test_the_folder_of_recordings_is_sorted(recordings: Path, tmp_path: Path) -> None:
    """Passes of the same streets are runs of their own; what belongs to one drive stays together."""
    found = find_logs(recordings / "two_pass")
    assert {log.format.name for log in found.logs} == {"pospac"}
    assert len(found.runs) == len(found.logs) == 4
    assert [path.name for path, _ in found.unknown] == ["T_radar_lidar.txt"]
    av2 = find_logs(recordings / "av2_drive")
    assert [sorted(log.format.name for log in run.logs) for run in av2.runs] == [["argoverse", "pose_quaternions"]]
    assert next(log.path for log in av2.logs if log.format.name == "argoverse") == av2.folder
    made = write_first_survey(av2, tmp_path / "SURVEY.toml")
    assert tomllib.loads(made.survey_file.read_text())["runs"]


# --- by its questions alone ----------------------------------------------------------------------------


@pytest.mark.slow
def test_two_missions_in_one_folder_become_a_map_with_its_sigma(tmp_path: Path) -> None:
    """SBET, SMRMSG and PCAP of two passes side by side: every return where the simulator's beam hit."""
    scene = small_scene(length_m=6.0, profilers={"on": False}, lidar={"range_max_m": 6.0}).noiseless()
    made = simulate(scene, tmp_path / "simulated", write_hits=True)
    original = Survey.load(made.survey_file)
    logs = tmp_path / "logs"
    logs.mkdir()
    for number, run in enumerate(original.config.runs, 1):
        raw = made.survey_file.parent / run.logs[0].path.parent
        for kind, name in (("sbet", "trajectory.sbet"), ("smrmsg", "trajectory.smrmsg"), ("lidar", "lidar.pcap")):
            ending = "pcap" if kind == "lidar" else "out"
            shutil.copy(raw / name, logs / f"{kind}_mission{number}.{ending}")
    survey_file, said = first_survey(logs)
    assert "paired: smrmsg_mission2.out with sbet_mission2.out, as its options.accuracy" in said
    (lidar,) = [s for s in original.rig.sensors.values() if s.kind == "lidar"]
    stated = lidar.model_dump(include={"axes", "lever_arm_body_m", "boresight"})
    rig_answers = {key: f"{key} = {toml(value)}" for key, value in stated.items()}
    answers = {
        "map.crs": 'crs = "EPSG:32632"',
        "clock": 'clock = { system = "gps_week_seconds", week = 2417 }',
        "crs": f"crs = {toml(original.config.runs[0].logs[0].crs)}",
    }
    assert answer_questions(survey_file, answers) == 5
    rig_file = survey_file.with_name("RIG.toml")
    names = re.findall(r"^\[sensors\.(\S+)\]", rig_file.read_text(), re.MULTILINE)
    assert answer_questions(rig_file, {f"sensors.{n}.{k}": v for n in names for k, v in rig_answers.items()}) == 3
    spared(survey_file)
    done = roadscan("run", survey_file, "--workers", "0")
    assert done.exit_code == 0, done.output
    tiles = [laspy.read(file) for file in (tmp_path / "store/survey=logs/tiles/las").glob("*.laz")]
    found = np.concatenate([np.column_stack([tile.x, tile.y, tile.z]) for tile in tiles])
    files = [truth.load(made.survey_file.parent).hits_file(run.id, "lidar") for run in original.config.runs]
    hits = [pq.read_table(file, columns=["easting_m", "northing_m", "height_m"]).to_pandas() for file in files]
    expected = np.concatenate([one.dropna().to_numpy() for one in hits])
    assert len(found) == len(expected) > 10_000
    for one, other in ((found, expected), (expected, found)):
        assert KDTree(other).query(one)[0].max() < 2e-3  # packets hold 2 mm and 0.01°
    asked = roadscan("sql", "--survey", survey_file, "SELECT count(*) AS n FROM trajectory WHERE sigma_north_m IS NULL")
    assert asked.stdout.split()[-1] == "0", asked.output
