"""Calibrate: evidence of the survey file → mountings with covariance, in the table ``mountings``."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.jobs.calibration_evidence import Collected, collect
from roadscan.jobs.fingerprint import key_of, solver_version
from roadscan.jobs.plan import SurveyPlan, plan_survey
from roadscan.jobs.readings import MOUNTINGS
from roadscan.model.calibration import CalibrationSettings
from roadscan.model.errors import ConfigError, nearest
from roadscan.model.gpstime import gps_ns_from_utc
from roadscan.model.survey import Survey
from roadscan.navigation.calibration.estimator import Calibration, Prior, calibrate
from roadscan.navigation.calibration.evidence import Evidence, Traverse
from roadscan.navigation.calibration.report import mounting_rows, report
from roadscan.navigation.calibration.unknowns import Estimate, ObjectPose
from roadscan.products.pictures.calibration import draw_calibration
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store

Report = Callable[[str], None]

ALL_RUNS: Final = "*"
PICTURE: Final = "products/calibration/calibration.png"
TEXT: Final = "products/calibration/calibration.txt"


@dataclass(frozen=True)
class Calibrated:
    """What a calibration wrote."""

    calibration: Calibration
    rows: list[dict[str, Any]]
    """Of the table ``mountings``."""
    text: str
    """The report."""


def calibrate_survey(survey: Survey, store: Store, say: Report = lambda _: None) -> Calibrated:
    """Estimate the mountings of all sensors that the survey's evidence names, and write them to the store.

    The rig file stays as it is; from now on readings are placed by the table. A report and a picture lie in
    ``products/calibration/``.

    Raises
    ------
    ConfigError
        where the survey file names no evidence, or sensors that are not of the rig.
    RunError
        where a log is not ingested, or a sensor has no readings there.
    """
    config = survey.config
    if not config.calibration:
        raise ConfigError(
            "the survey file names no evidence for a calibration",
            expected='[[calibration]] with kind = "overlap", "object", "stop_and_go" or "reference"',
        )
    settings = config.navigation.calibration
    plan = plan_survey(survey, store)
    collected: list[Collected] = []
    for entry in config.calibration:
        say(f"evidence: {entry.kind}")
        collected.append(collect(plan, entry, settings))
    sensors = list(dict.fromkeys(sensor for one in collected for sensor in one.sensors))
    priors = {name: _prior(survey, name) for name in sensors}
    traverses = {number: t for one in collected for number, t in one.traverses.items()}
    objects = _objects(collected, priors, traverses, settings, say)
    say(f"estimating: {', '.join(sensors)}")
    calibration = calibrate(priors, _finder(collected), traverses, settings, objects)
    since = 0 if settings.valid_from is None else gps_ns_from_utc(settings.valid_from)
    rows = mounting_rows(
        calibration,
        run=ALL_RUNS,
        valid_from_gps_ns=since,
        estimated_at=dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        key=_key(plan, sensors),
    )
    _keep(store, rows)
    text = report(calibration)
    store.write_bytes(TEXT, text.encode())
    with store.scratch() as folder:
        draw_calibration(folder / "calibration.png", calibration, title=config.id)
        store.publish(folder / "calibration.png", PICTURE)
    return Calibrated(calibration, rows, text)


def _finder(collected: Sequence[Collected]) -> Callable[[Estimate], Sequence[Evidence]]:
    """All evidence as one."""
    return lambda estimate: [found for one in collected for found in one.find(estimate)]


def _objects(
    collected: Sequence[Collected],
    priors: dict[str, Prior],
    traverses: dict[int, Traverse],
    settings: CalibrationSettings,
    say: Report,
) -> dict[str, ObjectPose]:
    """Where the calibration objects lie, as seen with the mountings that all other evidence gives by itself."""
    locating = [one.locate for one in collected if one.locate is not None]
    if not locating:
        return {}
    others = [one for one in collected if one.locate is None]
    mountings = {name: prior.mounting for name, prior in priors.items()}
    if others:
        say("estimating without the objects")
        mountings |= calibrate(priors, _finder(others), traverses, settings).mountings
    estimate = Estimate(mountings, dict.fromkeys(mountings, 0.0), {}, {})
    return {name: pose for locate in locating for name, pose in locate(estimate).items()}


def _prior(survey: Survey, name: str) -> Prior:
    """What the rig file knows of a sensor."""
    if name not in survey.rig.sensors:
        known = survey.rig.sensors
        raise ConfigError(
            f"calibration names the unknown sensor '{name}'{nearest(name, known)}", expected=", ".join(known)
        )
    settings = survey.config.navigation.calibration
    return Prior.of(survey.rig.sensors[name], settings, settings.range_offset_sigma_m.get(name, 0.0))


def _key(plan: SurveyPlan, sensors: Iterable[str]) -> str:
    """What the calibration was made from: logs, rig, settings, code."""
    config = plan.survey.config
    return key_of(
        solver_version(),
        [r.key for r in plan.records],
        {name: plan.survey.rig.sensors[name].model_dump(mode="json") for name in sensors},
        [entry.model_dump(mode="json") for entry in config.calibration],
        config.navigation.calibration.model_dump(mode="json"),
    )


def _keep(store: Store, rows: list[dict[str, Any]]) -> None:
    """Put rows into the table; those of the same run, sensor and instant are replaced, all others stay."""
    schema = table_schema("mountings")
    known: list[dict[str, Any]] = []
    if store.exists(MOUNTINGS):
        known = pq.read_table(pa.BufferReader(store.read_bytes(MOUNTINGS))).to_pylist()
    places = {tuple(row[c] for c in schema.sort) for row in rows}
    kept = [row for row in known if tuple(row[c] for c in schema.sort) not in places]
    ordered = sorted([*kept, *rows], key=lambda row: tuple(row[c] for c in schema.sort))
    table = pa.Table.from_pylist(
        [{c.name: row.get(c.name) for c in schema.columns} for row in ordered], schema=schema.arrow()
    )
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    store.write_bytes(MOUNTINGS, sink.getvalue().to_pybytes())
