"""Estimates mountings with covariance from the survey file's evidence, and stores them in the table ``mountings``."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from roadscan.calibrate.evidence import Directions, Evidence, Orientation, Ties, Traverse
from roadscan.calibrate.unknowns import Estimate, ObjectPose
from roadscan.core.errors import ConfigError, DamagedError, RunError, nearest
from roadscan.core.extras import can_draw, need
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.grid import ALL_RUNS
from roadscan.core.settings.calibration import CalibrationSettings, ObjectEvidence, OverlapEvidence
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import DatedMountings, SurveyPlan, plan_survey
from roadscan.georeference.sources import load_mountings
from roadscan.navigation.tasks.recorded_pictures import CALIBRATION, NOT_DRAWN, keep_file, picture_key
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store

if TYPE_CHECKING:
    from roadscan.calibrate.estimator import Calibration, Prior
    from roadscan.calibrate.picture import CalibrationPicture
    from roadscan.calibrate.tasks.calibration_evidence import Collected


Report = Callable[[str], None]

_HELD: Final = 0.9
"""A σ above this share of the prior's counts as that of the prior."""
PICTURE: Final = "products/calibration/calibration.png"
TEXT: Final = "products/calibration/calibration.txt"
_PICTURE, _TEXT = "picture", "report"
"""Units of their records."""


@dataclass(frozen=True)
class Calibrated:
    """Results of a calibration."""

    calibration: Calibration
    rows: list[dict[str, Any]]
    """Rows of the table ``mountings``."""
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
    from roadscan.calibrate.estimator import calibrate
    from roadscan.calibrate.in_words import mounting_rows, report
    from roadscan.calibrate.picture import CalibrationPicture
    from roadscan.calibrate.tasks.calibration_evidence import collect

    config = survey.config
    if not config.calibration:
        raise ConfigError(
            "the survey file names no evidence for a calibration",
            expected='[[calibration]] with kind = "overlap", "object", "stop_and_go" or "reference"',
        )
    if any(entry.kind == "reference" for entry in config.calibration):
        need("small_gicp", 'a [[calibration]] with kind = "reference"')
    settings = config.navigation.calibration
    calibrated = _sound_mountings(store, say)
    plan = plan_survey(survey, store, calibrated)
    collected: list[Collected] = []
    for entry in config.calibration:
        say(f"evidence: {entry.kind}")
        collected.append(collect(plan, entry, settings))
    sensors = list(dict.fromkeys(sensor for one in collected for sensor in one.sensors))
    priors = {name: _prior(survey, name) for name in sensors}
    traverses = {number: t for one in collected for number, t in one.traverses.items()}
    objects = _objects(collected, priors, traverses, settings, say)
    say(f"estimating: {', '.join(sensors)}")
    finder = _Finder(collected, say)
    calibration = calibrate(priors, finder, traverses, settings, objects)
    _refuse_empty(finder, [entry.kind for entry in config.calibration])
    known = _determined(calibration)
    if not known:
        raise RunError(
            "the evidence determines no part of any mounting; nothing is written:\n" + report(calibration),
            change="see docs/calibration.md, what to drive",
        )
    for name in sensors:
        if name not in known:
            say(f"not determined at all, not written: {name}")
    since = 0 if settings.valid_from is None else gps_ns_from_utc(settings.valid_from)
    rows = mounting_rows(
        replace(calibration, sensors={name: calibration.sensors[name] for name in known}),
        run=ALL_RUNS,
        valid_from_gps_ns=since,
        estimated_at=dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        key=_key(plan, sensors),
    )
    _keep(store, rows, say)
    text = report(calibration)
    _keep_report(store, rows[0]["calibration"], text, CalibrationPicture.of(calibration, config.id))
    return Calibrated(calibration, rows, text)


def _keep_report(store: Store, calibration: str, text: str, picture: CalibrationPicture) -> None:
    """Write report and picture; their records contain all that is needed to write them again."""
    manifest = Manifest(store)
    _write_report(store, manifest, _TEXT, {"calibration": calibration, "text": text})
    _write_report(store, manifest, _PICTURE, {"calibration": calibration, "picture": picture.as_values()})


def _write_report(store: Store, manifest: Manifest, unit: str, values: dict[str, Any]) -> None:
    from roadscan.calibrate.picture import CalibrationPicture, draw_calibration

    def write(path: Path) -> None:
        if unit == _TEXT:
            path.write_text(values["text"], encoding="utf-8", newline="\n")
        else:
            draw_calibration(path, CalibrationPicture.of_values(values["picture"]))

    detail = json.dumps(values, sort_keys=True)
    if unit == _PICTURE and not can_draw():
        manifest.add([OutputRecord(CALIBRATION, unit, NOT_DRAWN, "", 0, "", detail)])
        return
    key, target = picture_key(detail), TEXT if unit == _TEXT else PICTURE
    keep_file(store, manifest, (CALIBRATION, unit), key, target, write, detail)


def renew_reports(store: Store, say: Report = lambda _: None) -> None:
    """Write the last calibration's report and picture again where they are missing or damaged."""
    if not store.exists(small_path("mountings")):
        return
    manifest = Manifest(store)
    for unit, record in manifest.of(CALIBRATION).items():
        if record.key == NOT_DRAWN and not can_draw():
            continue
        if not manifest.is_current(CALIBRATION, unit, picture_key(record.detail)):
            _write_report(store, manifest, unit, record.figures())
            say(f"drawn: {TEXT if unit == _TEXT else PICTURE}")


class _Finder:
    """Combines all evidence; it reports how much each round finds, and remembers what found nothing."""

    def __init__(self, collected: Sequence[Collected], say: Report) -> None:
        self._collected = collected
        self._say = say
        self._round = 0
        self.counts: list[int] = [0] * len(collected)
        """Observations of each entry in the last round."""

    def __call__(self, estimate: Estimate) -> list[Evidence]:
        self._round += 1
        found = [list(one.find(estimate)) for one in self._collected]
        self.counts = [sum(_size(evidence) for evidence in one) for one in found]
        self._say(f"round {self._round}: {', '.join(f'{count:,}' for count in self.counts)} observations")
        return [evidence for one in found for evidence in one]


def _size(evidence: Evidence) -> int:
    match evidence:
        case Ties():
            return len(evidence.weight)
        case Directions():
            return len(evidence.sigma_rad)
        case Orientation():
            return 1


def _refuse_empty(finder: _Finder, kinds: Sequence[str]) -> None:
    """Raise an error for requested evidence that yields nothing, which would otherwise make the calibration smaller."""
    counted = enumerate(zip(kinds, finder.counts, strict=True), 1)
    empty = [f"number {number} ({kind})" for number, (kind, count) in counted if not count]
    if empty:
        raise RunError(
            f"of the [[calibration]] entries, {', '.join(empty)} found not one place that was seen twice; "
            "nothing is written",
            change="check its area, runs and object; profiles have to be dense (2.5 mm along and across for overlap)",
        )


def _determined(calibration: Calibration) -> list[str]:
    """Return the sensors of which the evidence determines any part."""
    return [n for n, one in calibration.sensors.items() if (one.sigma < _HELD * one.prior_sigma).any()]


def _objects(
    collected: Sequence[Collected],
    priors: dict[str, Prior],
    traverses: dict[int, Traverse],
    settings: CalibrationSettings,
    say: Report,
) -> dict[str, ObjectPose]:
    """Locate the calibration objects with the mountings that all other evidence gives."""
    from roadscan.calibrate.estimator import calibrate

    locating = [one.locate for one in collected if one.locate is not None]
    if not locating:
        return {}
    others = [one for one in collected if one.locate is None]
    mountings = {name: prior.mounting for name, prior in priors.items()}
    if others:
        say("estimating without the objects")
        mountings |= calibrate(priors, _Finder(others, say), traverses, settings).mountings
    estimate = Estimate(mountings, dict.fromkeys(mountings, 0.0), {}, {})
    return {name: pose for locate in locating for name, pose in locate(estimate).items()}


def _prior(survey: Survey, name: str) -> Prior:
    """Return the rig file's prior of a sensor."""
    from roadscan.calibrate.estimator import Prior

    if name not in survey.rig.sensors:
        known = survey.rig.sensors
        raise ConfigError(
            f"calibration names the unknown sensor '{name}'{nearest(name, known)}", expected=", ".join(known)
        )
    settings = survey.config.navigation.calibration
    return Prior.of(survey.rig.sensors[name], settings, settings.range_offset_sigma_m.get(name, 0.0))


def outdated_calibrations(plan: SurveyPlan) -> list[str]:
    """Return, in words, calibrations in the table that were made from other logs, rig, settings or code."""
    by_key: dict[str, dict[str, str]] = {}
    table = read_small(plan.store, "mountings")
    for row in () if table is None else table.to_pylist():
        if row["calibration"]:
            by_key.setdefault(row["calibration"], {})[row["sensor"]] = row["estimated_at"] or ""
    return [
        f"the mountings of {', '.join(sensors)} (calibrated {max(sensors.values())}) stand above the rig file, and "
        "were made from other logs, rig, settings or code; `roadscan calibrate` makes them anew"
        for key, sensors in by_key.items()
        if not all(s in plan.survey.rig.sensors for s in sensors) or _key(plan, _asked(plan)) != key
    ]


def _asked(plan: SurveyPlan) -> list[str]:
    """Return the sensors that the survey file's evidence names and the rig has."""
    named: list[str] = []
    for entry in plan.survey.config.calibration:
        named += entry.sensors if isinstance(entry, OverlapEvidence | ObjectEvidence) else [entry.sensor]
    return [name for name in named if name in plan.survey.rig.sensors]


def _key(plan: SurveyPlan, sensors: Iterable[str]) -> str:
    """Return the key of the calibration's inputs: logs, rig, settings, code."""
    config = plan.survey.config
    return key_of(
        code_digest("roadscan.calibrate.tasks.calibration_evidence", "roadscan.calibrate.estimator"),
        [r.key for r in plan.records],
        {name: plan.survey.rig.sensors[name].model_dump(mode="json") for name in sorted(set(sensors))},
        [entry.model_dump(mode="json") for entry in config.calibration],
        config.navigation.calibration.model_dump(mode="json"),
    )


def _sound_mountings(store: Store, say: Report) -> DatedMountings:
    """Read the table; where it is damaged, the rig file's mountings serve to find readings."""
    try:
        return load_mountings(store)
    except DamagedError as error:
        say(f"the table `mountings` is damaged ({error.arrived}): the rig file's mountings are taken to begin with")
        return {}


def _keep(store: Store, rows: list[dict[str, Any]], say: Report) -> None:
    """Put rows into the table; those of the same run, sensor and instant are replaced, all others stay."""
    sort = table_schema("mountings").sort
    try:
        table = read_small(store, "mountings")
    except DamagedError:
        table = None
        aside = store.set_aside(small_path("mountings"))
        say(f"the damaged table was set aside ({aside}): mountings that only it held have to be calibrated again")
    known = [] if table is None else table.to_pylist()
    places = {tuple(row[c] for c in sort) for row in rows}
    write_small(store, "mountings", [*(row for row in known if tuple(row[c] for c in sort) not in places), *rows])


def mounting_lines(store: Store) -> list[str]:
    """Return a line for each calibrated mounting; none of a damaged table, which `roadscan verify` reports."""
    try:
        table = read_small(store, "mountings")
    except DamagedError:
        return []
    picture = f"; picture {PICTURE}" if store.exists(PICTURE) else ""
    lines = []
    for row in [] if table is None else table.to_pylist():
        lever = [row[f"sigma_lever_{a}_m"] for a in ("forward", "right", "down")]
        angles = [row[f"sigma_{a}_deg"] for a in ("roll", "pitch", "heading")]
        largest_m, largest_deg = (
            max((v for v in own if v is not None), default=float("nan")) for own in (lever, angles)
        )
        held = f", not determined: {row['not_determined']}" if row["not_determined"] else ""
        lines.append(
            f"mounting of {row['sensor']} (runs {row['run']}): calibrated {row['estimated_at'] or ''} from "
            f"{row['method'] or ''}, σ at most {1e3 * largest_m:.1f} mm and {largest_deg:.3f}°{held}"
            f"{picture if row['calibration'] else ''}"
        )
    return lines
