"""Control points of a survey: a task and a file of the table `control_sightings` for each point that passes saw."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.adjust.control import ControlPoint, PickedPlace, Sighting, WrongPoint, moved_m, passes_by, sight_shifted
from roadscan.adjust.observations import RunPrior
from roadscan.adjust.places import Shift, Track, Traverse, shifted
from roadscan.adjust.settings import AdjustConfig, LineUse, TargetConfig, TargetSettings
from roadscan.adjust.targets.shapes import Chequered, Disc, Shape, SurveyedLine
from roadscan.adjust.tasks.near import (
    Circle,
    NearFile,
    NearReader,
    Remounted,
    Sources,
    changes_key,
    near_files,
    remounted_of,
)
from roadscan.adjust.tasks.tracks import runs_of
from roadscan.compute.arrays import way_along
from roadscan.core.errors import ConfigError
from roadscan.core.frames import rotation_from_rph, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import MapSettings, MountingChanges, road_key
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

TABLE: Final = "control_lines"
CONTROL_LINE: Final = Witness(
    "control_line",
    input="control lines",
    fault="A surveyed line lies elsewhere than surveyed, or was painted or built anew since.",
    asks="poses, ties, control points and all other lines: the normalised leave-one-out residual of each point of the "
    "line against the quantile of adjust.control.false_alarm; the intensities and heights of each pass that saw it",
    does="points of the line that are contradicted do not count; what is not found does not count either",
    told=("findings",),
)
_LEAST: Final = 3
"""A line of at least this many points that is found at none of them, though passes saw the road there, is reported."""


def line_points(plan: SurveyPlan, first: int) -> list[ControlPoint]:
    """Returns points along all surveyed lines, each `adjust.lines.each_m`; first : number of the first of them."""
    settings, found = AdjustConfig.of(plan.survey).lines, list[ControlPoint]()
    for record in plan.records:
        for file in record.tables.get(TABLE, ()):
            for row in read_groups(plan.store, file.path, range(len(file.group_rows))).to_pylist():
                found += _of_line(row, settings, first + len(found))
    return found


def _of_line(row: Mapping[str, Any], settings: LineUse, first: int) -> Iterator[ControlPoint]:
    heights = row["height_m"] or [math.nan] * len(row["easting_m"])
    way = shapely.LineString(np.stack([row["easting_m"], row["northing_m"]], axis=-1))
    vertices = np.array(way.coords)
    station = way_along(vertices)
    count = max(1, round(way.length / settings.each_m))
    across, upright = row["sigma_horizontal_m"], row["sigma_height_m"]
    for k in range(count):
        at = (k + 0.5) * way.length / count
        before = min(int(np.searchsorted(station, at, side="right")) - 1, len(station) - 2)
        east, north = vertices[before + 1] - vertices[before]
        place = way.interpolate(at)
        shape = SurveyedLine(row["kind"], row["name"], float(math.atan2(east, north)))
        yield ControlPoint(
            first + k, f"{row['name']} at {at:.1f} m", row["role"], row["kind"], place.x, place.y,
            float(np.interp(at, station, heights)), across or settings.sigma_across_m,
            upright or settings.sigma_height_m, shape,
        )  # fmt: skip


def lines_line(sightings: Sequence[Sighting]) -> str:
    """Returns how many points of lines were found; "" without lines."""
    own = [one for one in sightings if one.point.is_of_line]
    found = {one.point.number for one in own if one.is_placed}
    lines = {one.point.shape.line for one in own if isinstance(one.point.shape, SurveyedLine)}
    seen = {one.point.number for one in own}
    return (
        f"{len(lines)} surveyed lines: found at {len(found)} of {len(seen)} points that passes came by" if own else ""
    )


def line_findings(wrong: Sequence[WrongPoint], sightings: Sequence[Sighting]) -> list[Finding]:
    """Returns findings on lines that are contradicted, and on lines that are found nowhere; wrong : points of lines."""
    points, places = defaultdict[str, set[str]](set), dict[str, str]()
    found = set[str]()
    for one in sightings:
        if isinstance(one.point.shape, SurveyedLine) and one.status != "unseen":
            points[one.point.shape.line].add(one.point.name)
            places[one.point.name] = one.point.shape.line
            found |= {one.point.shape.line} if one.is_placed else set()
    findings = list[Finding]()
    by_line = defaultdict[str, list[WrongPoint]](list)
    for bad in wrong:
        by_line[places[bad.name]].append(bad)
    for line, own in sorted(by_line.items()):
        names = {name for one in own for name in (one.name, *one.alternatives) if places.get(name) == line}
        away = [(one.horizontal_m, "across") for one in own if np.isfinite(one.horizontal_m)]
        away += [(abs(one.height_m), "in height") for one in own if np.isfinite(one.height_m)]
        size, way = max(away)
        worst = max(own, key=lambda one: np.nan_to_num(one.sigmas))
        text = (
            f"all other evidence contradicts {len(names)} of its {len(points[line])} points, by up to "
            f"{1e3 * size:.1f} mm {way} ({worst.sigmas:.1f} σ, where {worst.limit:.1f} σ are the limit): not used"
        )
        findings.append(CONTROL_LINE.finds(f"line '{line}'", text, left_out=len(names)))
    for line, names in sorted(points.items()):
        if line not in found and len(names) >= _LEAST:
            text = f"it is found at none of its {len(names)} points that passes saw; it does not count"
            findings.append(CONTROL_LINE.finds(f"line '{line}'", text, left_out=len(names)))
    return findings


SIGHTINGS: Final = "control_sightings"
"""Table, and product of its files in the manifest."""

HAND: Final = "hand"
"""Role of an end of a tie by hand."""

_PICKED_COLUMNS: Final = ("run", "name", "easting_m", "northing_m")
_FIT_RADII: Final = 1.5
"""Readings are taken this far around the search, in radii of the target."""


@dataclass(frozen=True)
class ControlTask:
    """A point, and the row groups that saw it; it carries no data."""

    store: Store
    ground: MapSettings
    settings: TargetSettings
    runs: tuple[str, ...]
    sigma_pose_m: tuple[float, ...]
    """1 σ of each pass's recorded poses, on each horizontal axis."""
    point: ControlPoint
    passes: tuple[tuple[Traverse, ...], ...]
    """The traverses of each pass's sensors."""
    picked: tuple[PickedPlace | None, ...]
    """The place that the user picked in each pass."""
    files: tuple[NearFile, ...]
    key: str
    round: int = 0
    """Round whose solution places the readings; 0: the recorded poses do."""
    shifts_m: tuple[Shift, ...] = ()
    """Shift of each pass by that solution; none in round 0."""
    changes: MountingChanges = field(default_factory=dict)
    """Changes of mountings with which that solution places readings; none in round 0."""

    @property
    def unit(self) -> str:
        """Returns its name in the manifest."""
        again = f"-round-{self.round}" if self.round else ""
        return f"{'hand' if self.point.role == HAND else 'point'}-{self.point.number:06d}{again}"

    @property
    def bytes(self) -> int:
        """Returns the approximate number of compressed bytes to read."""
        return sum(one.bytes for one in self.files)


def control_points(plan: SurveyPlan) -> list[ControlPoint]:
    """Surveyed points of all control logs, in the order of the survey file and of their names, then those that stand
    for surveyed lines.
    """
    config = AdjustConfig.of(plan.survey)
    found: list[ControlPoint] = []
    for record in plan.records:
        for file in record.tables.get("control_points", ()):
            rows = read_groups(plan.store, file.path, range(len(file.group_rows))).to_pylist()
            found += [_point(len(found) + k, row, config) for k, row in enumerate(rows)]
    return found + line_points(plan, len(found))


def _point(number: int, row: Mapping[str, Any], config: AdjustConfig) -> ControlPoint:
    horizontal, upright = row["sigma_horizontal_m"], row["sigma_height_m"]
    return ControlPoint(
        number, row["name"], row["role"], row["code"] or "", row["easting_m"], row["northing_m"], row["height_m"],
        horizontal or config.control.sigma_horizontal_m, upright or config.control.sigma_height_m,
        _shape(config.targets.of_code(row["code"])),
    )  # fmt: skip


def _shape(target: TargetConfig) -> Shape | None:
    match target.shape:
        case "circle":
            return Disc(target.size_m, target.centre_m)
        case "chequered":
            return Chequered(target.size_m)
        case _:
            return None


def read_picked(survey: Survey) -> list[tuple[int, str, str, PickedPlace]]:
    """Returns places that the user picked: line of the file, run, name of the point, place.

    Raises
    ------
    ConfigError
        where the file is not there or a row of it is none.
    """
    targets = AdjustConfig.of(survey).targets
    if targets.picked is None:
        return []
    path = survey.resolve(targets.picked)
    if not path.is_file():
        raise ConfigError("there is no file of picked targets", change="correct adjust.targets.picked", file=path)
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.DictReader(stream)
        missing = [name for name in _PICKED_COLUMNS if name not in (rows.fieldnames or ())]
        if missing:
            raise ConfigError(
                f"the picked targets have no column '{missing[0]}'", expected=", ".join(_PICKED_COLUMNS), file=path
            )
        runs = {run.id for run in survey.config.runs}
        found = []
        for number, row in enumerate(rows, 2):
            if row["run"] not in runs:
                raise _not_picked(row["name"], row["run"], path, number)
            try:
                place = (float(row["easting_m"]), float(row["northing_m"]))
            except (TypeError, ValueError) as error:
                raise ConfigError(str(error), expected="metres", file=path, record=number) from error
            found.append((number, row["run"], row["name"], PickedPlace(*place, targets.picked_sigma_m)))
    return found


def picked_places(plan: SurveyPlan, points: Sequence[ControlPoint]) -> dict[tuple[str, str], PickedPlace]:
    """Returns places that the user picked, by run and name of the point.

    Raises
    ------
    ConfigError
        where the file is not there, a row of it is none, or it names no control point.
    """
    known = {point.name for point in points}
    picked = read_picked(plan.survey)
    for number, run, name, _ in picked:
        if name not in known:
            file = AdjustConfig.of(plan.survey).targets.picked
            raise _not_picked(name, run, None if file is None else plan.survey.resolve(file), number)
    return {(run, name): place for _, run, name, place in picked}


def _not_picked(name: str, run: str, path: Path | None, record: int) -> ConfigError:
    return ConfigError(
        f"a target of point '{name}' was picked in run '{run}'",
        expected="a control point and a run of the survey", file=path, record=record,
    )  # fmt: skip


def control_tasks(
    plan: SurveyPlan,
    sources: Sources,
    tracks: Sequence[Track],
    points: Sequence[ControlPoint],
    priors: Sequence[RunPrior],
) -> list[ControlTask]:
    """Returns a task for each point that a pass saw, with the key of its sightings; none for those of pictures alone.

    priors : of each run, in the order of the survey file.
    """
    targets = AdjustConfig.of(plan.survey).targets
    on_road = [targets.of_code(point.code).shape != "pictures" for point in points]
    passes = [passes_of(plan, tracks, point) if is_on else [] for point, is_on in zip(points, on_road, strict=True)]
    seen = list(zip(points, passes, strict=True))
    return sighting_tasks(plan, sources, priors, seen, picked_places(plan, points))


def _settings(plan: SurveyPlan) -> TargetSettings:
    """Returns the settings of the search for targets."""
    config = AdjustConfig.of(plan.survey)
    return TargetSettings(search_radius_m=config.targets.search_m, height_radius_m=config.control.radius_m)


def sighting_tasks(
    plan: SurveyPlan,
    sources: Sources,
    priors: Sequence[RunPrior],
    seen: Sequence[tuple[ControlPoint, Sequence[tuple[Traverse, ...]]]],
    picked: Mapping[tuple[str, str], PickedPlace],
    again: tuple[int, Sequence[tuple[Shift, ...]], MountingChanges] | None = None,
) -> list[ControlTask]:
    """Returns a task for each point that the traverses of one or more passes saw.

    again : round, shifts of each point's passes, and changes of mountings; none where the recorded poses and the stated
    mountings place the readings.
    """
    runs, settings, (number, shifts, changes) = runs_of(plan), _settings(plan), again or (0, (), {})
    code = code_digest(f"{__name__}:sight_control")
    shaping = [code, settings.model_dump(mode="json"), plan.ground.max_gap_s, runs]
    tasks: list[ControlTask] = []
    for (point, passes), moved in zip(seen, shifts if number else [()] * len(seen), strict=True):
        if not passes:
            continue
        files = tuple(near_files(sources, [t for own in passes for t in own], runs))
        own = tuple(picked.get((runs[p[0].run], point.name)) for p in passes)
        sigma = tuple(_sigma_pose_m(priors[p[0].run], p[0]) for p in passes)
        read = [one.key(road_key(one.source)) for one in files]
        key = key_of(
            shaping, asdict(point), [[asdict(t) for t in p] for p in passes], [str(o) for o in own], sigma, read,
            *([number, moved, *changes_key(files, changes)] if number else []),
        )  # fmt: skip
        tasks.append(
            ControlTask(
                plan.store, plan.ground, settings, runs, sigma, point, tuple(passes), own, files, key, number, moved,
                changes,
            )
        )  # fmt: skip
    return tasks


def _sigma_pose_m(prior: RunPrior, traverse: Traverse) -> float:
    ends = np.array([traverse.first_gps_ns, traverse.last_gps_ns], np.int64)
    return float(prior.sigma_at(ends)[:, :2].max())


def _radius_m(point: ControlPoint, settings: TargetSettings) -> float:
    reach = 0.0 if point.shape is None else _FIT_RADII * point.shape.reach_m
    return max(settings.search_radius_m + reach if point.shape is not None else 0.0, settings.height_radius_m)


def passes_of(plan: SurveyPlan, tracks: Sequence[Track], point: ControlPoint) -> list[tuple[Traverse, ...]]:
    """Returns traverses by a point, those of one run at one time together."""
    radius_m, apart_s = _radius_m(point, _settings(plan)), AdjustConfig.of(plan.survey).places.return_s
    every = sorted(
        (t for track in tracks for t in passes_by(track, point.easting_m, point.northing_m, radius_m, apart_s)),
        key=lambda t: (t.run, t.first_gps_ns, t.sensor),
    )
    found: list[list[Traverse]] = []
    for one in every:
        last = found[-1] if found else None
        ends = max(t.last_gps_ns for t in last) if last else 0
        if last and last[0].run == one.run and one.first_gps_ns - ends < apart_s * NS_PER_S:
            last.append(one)
        else:
            found.append([one])
    return [tuple(one) for one in found]


def sight_control(task: ControlTask) -> OutputRecord:
    """Determine what each pass saw of a point and write it (runs on a worker)."""
    reader = NearReader(task.store, task.ground, [one.remounted(task.changes) for one in task.files], task.runs)
    remounted = remounted_of(task.files, task.changes)
    found = []
    moved = task.shifts_m or ((0.0, 0.0, 0.0),) * len(task.passes)
    for own, picked, sigma_pose_m, shift in zip(task.passes, task.picked, task.sigma_pose_m, moved, strict=True):
        reach_m = _radius_m(task.point, task.settings) + float(np.hypot(*shift[:2]))
        circle = Circle(task.point.easting_m, task.point.northing_m, reach_m)
        heads = [shifted(reader.of(traverse, circle), np.array(shift)) for traverse in own]
        # Profiles are dense and returns sparse: of a pass with both, the profiles are used.
        dense = [h for h in heads if not h.returns and h.pose.size] or heads
        one = sight_shifted(task.point, dense, task.settings, sigma_pose_m, picked, np.array(shift))
        found.append(_as_stated(one, remounted.get((task.runs[one.run], one.sensor))))
    schema = table_schema(SIGHTINGS)
    rows = pa.Table.from_pylist([_row(one, task.runs, task.round) for one in found], schema=schema.arrow())
    content = parquet_bytes(rows, schema)
    target = f"{schema.location}/{task.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(SIGHTINGS, task.unit, task.key, target, len(content), bytes_digest(content))


def _as_stated(one: Sighting, sensor: Remounted | None) -> Sighting:
    """Returns a sighting that a changed mounting placed, moved to where the stated one puts it.

    A lidar sees a place from before and from behind. With a mounting that is off, its readings there lie at several
    heights, and which of them carry the mean says nothing of the road. So they are chosen with the changed mounting,
    and what they say is moved in the mean.
    """
    if sensor is None or one.status == "unseen":
        return one
    east, north, up = moved_m(one, None, (sensor.change, sensor.seat(one.epoch_gps_ns))).tolist()
    return replace(one, easting_m=one.easting_m - east, northing_m=one.northing_m - north, height_m=one.height_m - up)


def _row(one: Sighting, runs: Sequence[str], number: int) -> dict[str, Any]:
    seen = bool(np.isfinite(one.level_from_body).all())
    turned = [float(a) for a in rph_from_rotation(one.level_from_body)] if seen else [None] * 3
    picture = None if one.find is None else one.find.picture
    values: dict[str, Any] = {
        "point": one.point.number,
        "round": number,
        "name": one.point.name,
        "run": runs[one.run],
        "sensor": one.sensor,
        "epoch_gps_ns": one.epoch_gps_ns,
        "status": one.status,
        "why_not": one.why_not,
        "count": one.count,
        "convergence_rad": one.convergence_rad,
        "picture": [] if picture is None else picture.grey.ravel().tolist(),
        "picture_columns": 0 if picture is None else picture.grey.shape[1],
        "picture_cell_m": None if picture is None else picture.cell_m,
    }
    values |= dict(zip(("roll_rad", "pitch_rad", "heading_rad"), turned, strict=True))
    numbers = {
        "easting_m": one.easting_m,
        "northing_m": one.northing_m,
        "covariance_ee_m2": one.covariance_m2[0, 0],
        "covariance_en_m2": one.covariance_m2[0, 1],
        "covariance_nn_m2": one.covariance_m2[1, 1],
        "contrast": one.contrast,
        "score": one.score,
        **{name: getattr(one, name) for name in ("height_m", "sigma_height_m", "slope_east", "slope_north")},
        **dict(zip(("arm_forward_m", "arm_right_m", "arm_down_m"), one.arm_body_m, strict=True)),
    }
    return values | {name: float(value) if np.isfinite(value) else None for name, value in numbers.items()}


def load_sightings(
    store: Store, manifest: Manifest, tasks: Sequence[ControlTask]
) -> tuple[list[Sighting], list[dict[str, Any]]]:
    """Returns sightings of some points, in order, and their rows of the table."""
    sightings, rows = [], []
    last = {task.point.number: task for task in sorted(tasks, key=lambda task: task.round)}
    for task in last.values():
        record = manifest.get(SIGHTINGS, task.unit)
        if record is None or not record.path:
            continue
        for row in recorded_table(store, record).to_pylist():
            sightings.append(_sighting(task.point, row, task.runs))
            rows.append(row)
    return sightings, rows


def _sighting(point: ControlPoint, row: Mapping[str, Any], runs: Sequence[str]) -> Sighting:
    def number(name: str) -> float:
        return float("nan") if row[name] is None else float(row[name])

    covariance = np.array(
        [
            [number("covariance_ee_m2"), number("covariance_en_m2")],
            [number("covariance_en_m2"), number("covariance_nn_m2")],
        ]
    )
    turned = rotation_from_rph(number("roll_rad"), number("pitch_rad"), number("heading_rad"))
    return Sighting(
        point, runs.index(row["run"]), row["sensor"], row["status"], row["why_not"], row["epoch_gps_ns"],
        number("easting_m"), number("northing_m"), covariance, number("height_m"), number("sigma_height_m"),
        number("slope_east"), number("slope_north"), row["count"], number("contrast"), number("score"),
        np.array([number(f"arm_{a}_m") for a in ("forward", "right", "down")]), turned, number("convergence_rad"),
    )  # fmt: skip
