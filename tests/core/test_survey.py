"""The survey file: what it refuses, paths, passes."""

from __future__ import annotations

import copy
import datetime as dt
import inspect
from pathlib import Path
from typing import Any

import pytest

from roadscan.core import rig as rig_module
from roadscan.core import survey as survey_module
from roadscan.core.errors import ConfigError, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, TimeSystem, gps_ns_from_utc
from roadscan.core.grid import LanePass, PassId, RunId
from roadscan.core.strict import Strict, meanings
from roadscan.core.survey import Survey, survey_file_model

MINIMAL: dict[str, Any] = {
    "id": "town",
    "map": {"crs": "EPSG:32632"},
    "runs": [{"id": "monday", "logs": [{"path": "raw/poses.csv"}]}],
}


def changed(*path: str | int, to: Any) -> dict[str, Any]:
    """The minimal survey with one value replaced or added."""
    values = copy.deepcopy(MINIMAL)
    here: Any = values
    for key in path[:-1]:
        here = here.setdefault(key, {}) if isinstance(here, dict) else here[key]
    here[path[-1]] = to
    return values


def test_a_survey_file_with_its_rig(tmp_path: Path) -> None:
    (tmp_path / "RIG.toml").write_text('[sensors.top]\nkind = "lidar"\n')
    file = tmp_path / "SURVEY.toml"
    file.write_text(
        """
        id = "town"
        rig = "RIG.toml"
        store = "out"
        [map]
        crs = "EPSG:32632"
        [[runs]]
        id = "monday"
        [[runs.logs]]
        path = "raw/top.pcap"
        sensor = "top"
        clock = { system = "utc_hour", unit = "us", date = 2026-05-04 }
        """
    )
    survey = Survey.load(file)
    assert survey.sensor("top").kind == "lidar"
    assert survey.store_url == str(tmp_path / "out")
    log = survey.config.runs[0].logs[0]
    assert survey.resolve(log.path) == tmp_path / "raw/top.pcap"
    assert survey.resolve(Path("/data/x")) == Path("/data/x")
    assert log.clock is not None
    clock = log.clock.clock()
    assert (clock.system, clock.unit, clock.date) == (TimeSystem.UTC_HOUR, "us", dt.date(2026, 5, 4))


def test_an_object_store_stays_a_url(tmp_path: Path) -> None:
    assert Survey.parse(changed("store", to="s3://bucket/x"), folder=tmp_path).store_url == "s3://bucket/x"


def test_map_frame_of_the_settings() -> None:
    config = survey_file_model().parse(
        changed(
            "map",
            to={
                "crs": "EPSG:25832",
                "height": "orthometric",
                "geoid": "g.tif",
                "local": {"anchor": {"latitude_deg": 52, "longitude_deg": 9, "height_m": 80, "heading_deg": 30}},
            },
        )
    )
    frame = config.map.frame(Path())
    assert frame.geoid is not None
    assert (frame.crs, frame.geoid.grid) == ("EPSG:25832", "g.tif")
    assert frame.anchor is not None
    assert frame.anchor.heading_deg == 30.0
    ellipsoidal = (
        survey_file_model().parse(changed("map", to={"crs": "EPSG:25832", "geoid": "g.tif"})).map.frame(Path())
    )
    assert ellipsoidal.geoid is None


LOG = ("runs", 0, "logs", 0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (changed("runs", to=[]), "'runs': expected a list of at least 1 .0 given."),
        (changed("id", to="a b"), "'id' .got 'a b'"),
        (changed("map", to={}), "'map': say where the map is"),
        (changed("map", "heigth", to="orthometric"), r"unknown key 'map\.heigth' \(did you mean 'height'\?\)"),
        (changed(*LOG, "clok", to={}), r"unknown key 'clok' of log 'raw/poses\.csv' \(did you mean 'clock'\?\)"),
        (changed(*LOG, "clock", to={"system": "gps_week_seconds", "week": 2400, "date": "2026-01-01"}), "week or date"),
        (changed(*LOG, "clock", to={"system": "free"}), "needs offset_s"),
        (changed(*LOG, "clock", to={"unit": "s"}), r"key 'clock\.system' of log 'raw/poses\.csv' is missing"),
        (changed("runs", to=MINIMAL["runs"] * 2), "two runs have the same id"),
        (changed("passes", to=[{"id": 1, "run": "mondy"}]), r"unknown run 'mondy' \(did you mean 'monday'\?\)"),
        (changed("passes", to=[{"id": 1, "run": "monday"}] * 2), "two passes have the same id"),
        (
            changed("passes", to=[{"id": 65_536, "run": "monday"}]),
            "'id' of pass 65536 .got 65536.: expected 65535 or less",
        ),
        (changed("tiles", "cell_m", to=0.03), "cell_m 0.03 does not divide size_m 10"),
        (changed("tiles", "cell_m", to=10 / 3), "even number of cells"),
        (changed("tiles", "cell_m", to=0.0001), "make cell_m larger"),
        (
            changed("control", to=[{"path": "gcp.csv"}]),
            r"key 'crs' of control log 'gcp\.csv' is missing; key 'height' of control log",
        ),
        (changed(*LOG, "sensor", to="top"), "names the unknown sensor 'top'.*it has none"),
        (
            changed("rig", to={"sensors": {"top": {"kind": "lidar", "axs": "frd"}}}),
            r"'rig\.sensors\.top\.axs' \(did you mean 'axes'\?\)",
        ),
    ],
)
def test_refused(values: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        Survey.parse(values, folder=tmp_path, file="SURVEY.toml")


def test_unknown_sensor_names_the_nearest(tmp_path: Path) -> None:
    values = changed("rig", to={"sensors": {"roof_lidar": {"kind": "lidar"}}})
    values["runs"][0]["logs"][0]["sensor"] = "roof_lidr"
    with pytest.raises(ConfigError, match=r"'raw/poses\.csv'.*'roof_lidr' \(did you mean 'roof_lidar'\?\)"):
        Survey.parse(values, folder=tmp_path)


TWO_RUNS: dict[str, Any] = {
    **MINIMAL,
    "runs": [{"id": "a", "logs": [{"path": "a"}]}, {"id": "b", "logs": [{"path": "b"}]}],
}
NINE = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, tzinfo=dt.UTC))
SPANS = {RunId("a"): (NINE, NINE + 60 * NS_PER_S), RunId("b"): (NINE + 600 * NS_PER_S, NINE + 660 * NS_PER_S)}


def test_each_run_is_a_pass_where_none_is_stated(tmp_path: Path) -> None:
    survey = Survey.parse(TWO_RUNS, folder=tmp_path)
    assert survey.passes(SPANS) == [
        LanePass(PassId(1), RunId("a"), SPANS[RunId("a")][0], SPANS[RunId("a")][1] + 1),
        LanePass(PassId(2), RunId("b"), SPANS[RunId("b")][0], SPANS[RunId("b")][1] + 1),
    ]
    # A run without data leaves the other's number as it is.
    only_b = survey.passes({RunId("b"): SPANS[RunId("b")]})
    assert [(p.pass_id, p.run) for p in only_b] == [(2, "b")]


def test_stated_passes(tmp_path: Path) -> None:
    noon = "2026-05-04T09:00:30Z"
    stated = [
        {"id": 7, "run": "a", "end": noon, "lane": "R1"},
        {"id": 1, "run": "a", "start": noon, "direction": "up"},
    ]
    survey = Survey.parse({**TWO_RUNS, "passes": stated}, folder=tmp_path)
    half = NINE + 30 * NS_PER_S
    first, last = SPANS[RunId("a")]
    assert survey.passes(SPANS) == [
        LanePass(PassId(1), RunId("a"), half, last + 1, "", "up"),
        LanePass(PassId(2), RunId("b"), SPANS[RunId("b")][0], SPANS[RunId("b")][1] + 1),
        LanePass(PassId(7), RunId("a"), first, half, "R1", ""),
    ]


def test_a_pass_whose_time_has_no_zone(tmp_path: Path) -> None:
    survey = Survey.parse(
        {**TWO_RUNS, "passes": [{"id": 1, "run": "a", "start": "2026-05-04T09:00:00"}]}, folder=tmp_path
    )
    with pytest.raises(TimeSystemError, match="no time zone"):
        survey.passes(SPANS)


MODELS = [
    value
    for module in (survey_module, rig_module)
    for value in vars(module).values()
    if inspect.isclass(value) and issubclass(value, Strict) and value.__module__ == module.__name__
]


@pytest.mark.parametrize("model", MODELS)
def test_every_setting_is_documented(model: type[Strict]) -> None:
    assert model.__doc__
    assert [name for name, meaning in meanings(model).items() if not meaning] == []
