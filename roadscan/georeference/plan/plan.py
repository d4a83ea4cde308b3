"""The plan of a survey: sources of readings, map settings and passes, from which every stage starts."""

from __future__ import annotations

import datetime as dt
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Self, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, NavigationError, RunError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns, utc_from_gps_ns
from roadscan.core.grid import LanePass, RunId, TileGrid, of_run
from roadscan.core.rig import UNMOUNTED, Mounting, Mountings, Rig, Sensor
from roadscan.core.survey import Survey
from roadscan.georeference.place import HeightLimits
from roadscan.georeference.plan.road import centre_lines_key, centre_lines_of, check_road, road_of
from roadscan.georeference.road_profiles import TICK_NS, WINDOW_NS
from roadscan.georeference.sources import (
    CentreLines,
    MapSettings,
    MountingChanges,
    RawSlice,
    ReadingSource,
    change_of,
    load_mounting_changes,
    load_mountings,
)
from roadscan.ingest.epoch_order import one_stamp_logs
from roadscan.ingest.ingest import DATA_TABLES
from roadscan.ingest.overlap import NothingPlacedError, apart_logs
from roadscan.ingest.reading.format import known_format
from roadscan.ingest.sources import same_points
from roadscan.navigation.tasks.clocks import load_clocks
from roadscan.navigation.tasks.navigate import records_of, records_with_trajectories
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_all_corrections
from roadscan.poses.trajectory import STENCIL_KNOTS, Allowance, Corrections, allowance_for, largest
from roadscan.run.keys import code_digest, grid_key, key_of
from roadscan.run.session import Session, found_once
from roadscan.store.logs import NAVIGATION, DataFile, Fault, LogRecord
from roadscan.store.store import Store

UInt64 = npt.NDArray[np.uint64]


@dataclass(frozen=True)
class KnownCorrections:
    """Corrections of all runs and of the mountings of all sensors, as stored in the tables."""

    by_run: Mapping[str, Corrections]
    mountings: MountingChanges = field(default_factory=dict)

    @classmethod
    def load(cls, store: Store) -> Self:
        """Read the tables. Damage is reported here, before tiles depend on it."""
        return cls(load_all_corrections(store), load_mounting_changes(store))

    def allowance(self, run: str, sensor: str) -> Allowance:
        """Return the allowance for corrections in bounds on a run's recorded poses and a sensor's stated mounting.

        Raises
        ------
        NavigationError
            where its corrections are no corrections.
        """
        own = self.by_run.get(run)
        try:
            change = change_of(self.mountings, run, sensor)
            return allowance_for(own, (0.0, 0.0) if change is None else change.largest)
        except ValueError:
            shift, turn = largest(own)
            raise NavigationError(
                f"the corrections of run '{run}' are as large as {shift:,.3g} m and {turn:.3g} rad",
                expected="corrections of recorded poses: metres and radians, small ones",
                change="remove the table `corrections`, or put a right one in its place",
            ) from None

    def digests(self, source: ReadingSource, spans_gps_ns: Int64, max_gap_s: float) -> UInt64:
        """Return a digest (n,) of the corrections that affect readings of spans (n, 2) of time; 0 where there are none.

        It combines that of the mounting and the sum of the digests of the knots in each span, and beyond it as far as
        interpolation uses them.
        """
        own = self.by_run.get(source.run)
        mounted = np.uint64(0) if source.trajectory is None else self._mounting_digest(source.run, source.sensor)
        if own is None or source.trajectory is None:
            return np.full(len(spans_gps_ns), mounted, np.uint64)
        wide = beyond_ns(source, max_gap_s)
        knots, sums = own.epochs_gps_ns, self._sums[source.run]
        first = np.searchsorted(knots, spans_gps_ns[:, 0] - wide, side="right") - 1
        last = np.searchsorted(knots, spans_gps_ns[:, 1] + wide, side="left")
        found: UInt64 = sums[np.minimum(last, knots.size - 1) + 1] - sums[np.maximum(first, 0)]
        return found + mounted

    def _mounting_digest(self, run: str, sensor: str) -> np.uint64:
        change = change_of(self.mountings, run, sensor)
        if change is None:
            return np.uint64(0)
        return np.uint64(int.from_bytes(hashlib.blake2b(change.values.tobytes(), digest_size=8).digest(), "little"))

    @cached_property
    def _sums(self) -> dict[str, UInt64]:
        """Return for each run the sums (k + 1,) of the digests of the knots before each, modulo 2⁶⁴."""
        return {run: np.append(np.uint64(0), np.cumsum(_digests(own))) for run, own in self.by_run.items()}


def beyond_ns(source: ReadingSource, max_gap_s: float) -> int:
    """Return how far beyond their epochs (ns) poses affect the readings of a source."""
    geometry = source.attribute.get("scan_geometry") or {}
    profile_s = float(geometry.get("reading_period_ns", 0.0)) * int(geometry.get("readings", 1)) / NS_PER_S
    turns = WINDOW_NS + TICK_NS if source.road is not None and source.road.turns is not None else 0
    return round((STENCIL_KNOTS * max_gap_s + profile_s) * NS_PER_S) + turns


def _digests(corrections: Corrections) -> UInt64:
    """Return a digest (k,) of each knot: its epoch and its six values."""
    columns = [corrections.epochs_gps_ns, *corrections.north_east_down_m.T, *corrections.roll_pitch_heading_rad.T]
    rows = np.column_stack([np.ascontiguousarray(column).view(np.uint64) for column in columns])
    found = b"".join(hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows)
    return np.frombuffer(found, np.uint64)


DatedMountings: TypeAlias = Mapping[tuple[str, str], Sequence[tuple[int, Mounting]]]
"""Calibrated mountings by run ('*' for all) and sensor, with the epochs from which they apply, ascending."""

_SAME_MOUNTING = 1e-3
"""Mountings that differ by less (m, or in the rotation's elements) count as equal."""


@dataclass(frozen=True)
class SurveyPlan:
    """What stages after ingest know about a survey."""

    survey: Survey
    store: Store
    records: tuple[LogRecord, ...]
    ground: MapSettings
    sources: tuple[tuple[ReadingSource, tuple[DataFile, ...]], ...]
    """Each sensor's readings in each run, with their data files."""
    passes: tuple[LanePass, ...]
    centre_lines: CentreLines | None
    """Layer that limits points to the road."""
    tile_key: str
    """Hash of all that changes any tile, besides its readings."""
    apart: tuple[Fault, ...] = ()
    """Logs that do not overlap the poses of their run: none of their readings is used."""
    corrections: KnownCorrections = field(default_factory=lambda: KnownCorrections({}))
    """Corrections of the poses in force."""

    @property
    def raw_bytes(self) -> int:
        """Compressed bytes of all readings."""
        return sum(f.bytes for _, files in self.sources for f in files)

    @property
    def date(self) -> dt.date:
        """UTC date of the first reading; of a survey without any, of its first picture."""
        pictures = (f.span[0] for r in self.records for f in r.tables.get("images", ()) if f.span is not None)
        return utc_from_gps_ns(min((p.start_gps_ns for p in self.passes), default=min(pictures, default=0))).date()

    def pass_key(self, run: str) -> list[object]:
        """Key by which a run's tiles become stale when its passes change: ids, and the spans in the survey file."""
        stated = [(p.id, p.start, p.end) for p in self.survey.config.passes if p.run == run]
        return list(stated) or [p.pass_id for p in self.passes if p.run == run]

    def corrected_anew(self) -> SurveyPlan:
        """Return the plan with the corrections that the table contains now."""
        corrections = KnownCorrections.load(self.store)
        sources = tuple((_with_room(source, corrections), files) for source, files in self.sources)
        return replace(self, sources=sources, corrections=corrections)

    def slices(self) -> list[RawSlice]:
        """Return all data files, whole."""
        return [RawSlice.whole(source, f) for source, files in self.sources for f in files]


def plan_survey(
    survey: Survey, store: Store, calibrated: DatedMountings | None = None, records: Sequence[LogRecord] | None = None
) -> SurveyPlan:
    """Build the plan from the tables and the survey file; reads no readings.

    `calibrated` stand in for the table of mountings where they are given, `records` for those of the survey's logs and
    trajectories.

    Raises
    ------
    NothingToPlaceError
        where no log of the survey is of a format that holds readings.
    RunError
        where a log is not ingested, a trajectory not computed, or logs of readings hold none.
    """
    records = tuple(records_with_trajectories(survey, store) if records is None else records)
    survey = Survey(survey.config, _mounted_rig(survey.rig, records), survey.folder)
    config, ground = survey.config, _ground(survey)
    known = load_mountings(store) if calibrated is None else calibrated
    clocks = load_clocks(store)
    apart = (*apart_logs(survey, records, clocks, estimated=True), *one_stamp_logs(records))
    corrections = KnownCorrections.load(store)
    copies = {later.key for first, later in same_points(records) if first.run == later.run}
    used = [record for record in _without(records, apart) if record.key not in copies]
    sources = tuple(_sources(survey, store, used, ground, known, corrections))
    if not sources and apart and any(r.tables.get(t) for r in records for t in DATA_TABLES):
        raise NothingPlacedError.of(apart)
    if not sources:
        if not any(yields_readings(r.format) for r in records):
            raise NothingToPlaceError(
                "nothing to place: the survey has no log of scans, returns or points",
                change="add one where there should be; logs, trajectories and clocks are in their tables",
            )
        raise RunError(
            "the survey has no readings", expected="at least one log of scans, returns or points with rows in it"
        )
    passes = tuple(_passes(survey, sources))
    centre_lines = centre_lines_of(survey)
    tile_key = key_of(
        code_digest("roadscan.tiles.tasks.tiles:compute_tiles"),
        config.tiles.cell_m,
        config.tiles.cell_table,
        centre_lines_key(centre_lines),
    )
    return SurveyPlan(survey, store, records, ground, sources, passes, centre_lines, tile_key, apart, corrections)


def plan_without_readings(survey: Survey, store: Store) -> SurveyPlan:
    """Return the plan of a survey for what needs poses and pictures alone: it has no readings, passes and tiles."""
    records = tuple(records_with_trajectories(survey, store))
    survey = Survey(survey.config, _mounted_rig(survey.rig, records), survey.folder)
    corrections = KnownCorrections.load(store)
    return SurveyPlan(survey, store, records, _ground(survey), (), (), None, "", (), corrections)


def _ground(survey: Survey) -> MapSettings:
    """Return the map of a survey with the limits of its points."""
    f, config = survey.config.filters, survey.config
    unlimited = float("inf")
    heights = HeightLimits(
        -unlimited if f.height_min_m is None else f.height_min_m,
        unlimited if f.height_max_m is None else f.height_max_m,
        -unlimited if f.above_body_min_m is None else f.above_body_min_m,
        unlimited if f.above_body_max_m is None else f.above_body_max_m,
    )
    return MapSettings(
        map=survey.frame(),
        grid=TileGrid(config.tiles.size_m, config.tiles.cell_m),
        heights=heights,
        max_gap_s=config.navigation.max_gap_s,
        marks=f.keep_marked,
    )


def _without(records: Sequence[LogRecord], faults: Sequence[Fault]) -> list[LogRecord]:
    keys = {key for fault in faults for key in fault.keys}
    return [record for record in records if record.key not in keys]


class NothingToPlaceError(RunError):
    """A survey without logs of readings, such as one of GNSS and IMU alone: no fault, but no tiles either."""


def yields_readings(log_format: str) -> bool:
    """Return whether logs of a format (or trajectories computed by a method) contain readings to georeference."""
    known = known_format(log_format)
    return known is not None and not set(DATA_TABLES).isdisjoint(known.yields)


def _mounted_rig(rig: Rig, records: Sequence[LogRecord]) -> Rig:
    """Return the rig with the mountings that logs state, where the rig file states none."""
    sensors = dict(rig.sensors)
    for name, sensor in rig.sensors.items():
        own = [r for r in records if r.sensor == name and (r.tables.get("scans") or r.tables.get("returns"))]
        mounted = {r.path: sensor.mounted_as(r.attributes.get("mounting", {})) for r in own}
        first = next(iter(mounted.values()), sensor)
        other = next((path for path, one in mounted.items() if not _mounted_alike(one, first)), None)
        if other is not None:
            raise ConfigError(
                f"logs of the sensor '{name}' say different mountings: {next(iter(mounted))} and {other}",
                expected="one mounting of a sensor",
                change="give each log a sensor of its own, or state axes and lever_arm_body_m in the rig file",
            )
        sensors[name] = first
    return rig.model_copy(update={"sensors": sensors})


def _mounted_alike(one: Sensor, other: Sensor) -> bool:
    pairs = zip(one.mounting().arrays(), other.mounting().arrays(), strict=True)
    return all(np.allclose(a, b, rtol=0.0, atol=_SAME_MOUNTING) for a, b in pairs)


def _sources(
    survey: Survey,
    store: Store,
    records: Sequence[LogRecord],
    ground: MapSettings,
    calibrated: DatedMountings,
    corrections: KnownCorrections,
) -> list[tuple[ReadingSource, tuple[DataFile, ...]]]:
    clocks = load_clocks(store)
    found: list[tuple[ReadingSource, tuple[DataFile, ...]]] = []
    for record in records:
        for table in DATA_TABLES:
            files = record.tables.get(table, ())
            if not files:
                continue
            trajectory = None if table == "cloud" else trajectory_source(record.run, records)
            sensor = survey.rig.sensors.get(record.sensor)
            nominal = sensor.mounting() if sensor else UNMOUNTED
            mountings = mountings_of(record.run, record.sensor, nominal, calibrated)
            clock = of_run(clocks, record.run, record.sensor)
            geoid = survey.geoid(record.attributes.get("geoid"))
            limits = (sensor.range_min_m, sensor.range_max_m) if sensor else (0.0, float("inf"))
            key = key_of(
                asdict(mountings),
                None if clock is None else (clock.offset_s, clock.drift, clock.reference_gps_ns),
                limits,
                None if trajectory is None else [trajectory.world, [f.digest for f in trajectory.files]],
                record.attributes,
                survey.config.map.model_dump(mode="json"),
                [grid_key(survey.geoid(survey.config.map.geoid)), grid_key(geoid)],
                asdict(ground.heights),
                ground.max_gap_s,
                ground.grid.size_m,
                ground.marks,
                record.run,
                record.sensor,
            )
            source = ReadingSource(
                record.run, record.sensor, table, tuple(sorted(record.attributes.items())), trajectory, mountings,
                *limits, key, clock, road_of(survey.config.segmentation, record.sensor, table, nominal), geoid=geoid,
            )  # fmt: skip
            found.append((_with_room(source, corrections), files))
    check_road(survey.config.segmentation, [source for source, _ in found])
    return found


def _with_room(source: ReadingSource, corrections: KnownCorrections) -> ReadingSource:
    """Return a source with the change of its mounting, whose footprints allow for corrections."""
    if source.trajectory is None:
        return source
    change = change_of(corrections.mountings, source.run, source.sensor)
    return replace(source, allowance=corrections.allowance(source.run, source.sensor), mounting_change=change)


def mountings_of(run: str, sensor: str, nominal: Mounting, calibrated: DatedMountings) -> Mountings:
    """Return a sensor's mountings: the rig file's until the first calibrated one of its run (or of all), and so on."""
    dated = list(of_run(calibrated, run, sensor) or [])
    if not dated or dated[0][0] > 0:
        dated = [(0, nominal), *dated]
    return Mountings(tuple(since for since, _ in dated), tuple(mounting for _, mounting in dated))


def trajectory_source(run: str, records: Sequence[LogRecord]) -> TrajectorySource:
    """Return the source of a run's poses; raises :class:`ConfigError` where that is not one trajectory."""
    own = [r for r in records if r.run == run and r.tables.get("trajectory")]
    own = [r for r in own if r.sensor == NAVIGATION] or own  # a computed trajectory replaces the recorded one
    worlds = {r.attributes["world_frame"] for r in own}
    if len(worlds) != 1:
        raise ConfigError(
            f"run '{run}' has " + ("no trajectory" if not worlds else "trajectories in different world frames"),
            expected="one trajectory log, or several in one datum; or logs of GNSS and IMU with navigation.solve",
        )
    ordered = sorted(own, key=lambda r: r.span("trajectory") or (0, 0))
    for before, after in pairwise(ordered):
        (_, last), (first, _) = before.span("trajectory") or (0, 0), after.span("trajectory") or (0, 0)
        if first < last:
            raise ConfigError(
                f"run '{run}' has two trajectories of one time: {before.path} and {after.path} overlap from "
                f"{iso_from_gps_ns(first)} on, and nothing says which of them holds",
                expected="one trajectory log, or several that follow one another",
                change="leave one of them out of the survey file, or list it in a run of its own",
            )
    files = tuple(f for r in own for f in r.tables["trajectory"])
    return TrajectorySource(run, worlds.pop(), files)


def empty_passes(plan: SurveyPlan) -> list[tuple[str, str]]:
    """Return passes during which no log has readings, with the reason."""
    spans = _run_spans(plan.sources)
    found: list[tuple[str, str]] = []
    for one in plan.passes:
        own, run = (one.start_gps_ns, one.end_gps_ns), spans[one.run]
        if own[1] <= run[0] or own[0] > run[1]:
            (start, end), (first, last) = (map(iso_from_gps_ns, span) for span in (own, run))
            reason = (
                f"it lasts from {start} to {end}, the readings of run '{one.run}' from {first} to {last}: "
                "none is of the pass; correct its start and end (their zone, too)"
            )
            found.append((f"pass {one.pass_id}", reason))
    return found


def _passes(
    survey: Survey, sources: Sequence[tuple[ReadingSource, tuple[DataFile, ...]]]
) -> list[LanePass]:  # fmt: skip
    return survey.passes(_run_spans(sources))


def _run_spans(
    sources: Sequence[tuple[ReadingSource, tuple[DataFile, ...]]]
) -> dict[RunId, tuple[int, int]]:  # fmt: skip
    """Return the first and last epoch (GPS ns) of the readings of each run."""
    spans: dict[RunId, tuple[int, int]] = {}
    for source, files in sources:
        run = RunId(source.run)
        for span in (f.span for f in files):
            if span is not None:
                ((first, last),) = source.spans([span])
                before = spans.get(run, (first, last))
                spans[run] = (min(before[0], first), max(before[1], last + _profile_ns(source)))
    return spans


def _profile_ns(source: ReadingSource) -> int:
    """Return the time from a profile's epoch to its last reading (ns)."""
    geometry = source.attribute.get("scan_geometry", {})
    return math.ceil(float(geometry.get("reading_period_ns", 0.0)) * int(geometry.get("readings", 1)))


@found_once
def plan_of(session: Session) -> SurveyPlan:
    """Return the plan of the session's survey."""
    return plan_survey(session.survey, session.store, records=records_of(session))


@found_once
def poses_plan_of(session: Session) -> SurveyPlan:
    """Return the plan of the session's survey; it may have no readings where pictures alone improve the poses."""
    try:
        return plan_of(session)
    except NothingToPlaceError:
        # Where pictures improved the poses before, what they made is withdrawn.
        if not session.survey.has("picture_ties") and not session.manifest.of("adjustment"):
            raise
        return plan_without_readings(session.survey, session.store)


@found_once
def pictures_plan_of(session: Session) -> SurveyPlan:
    """Return the plan of the session's survey; it may have no readings where the survey has pictures."""
    try:
        return plan_of(session)
    except NothingToPlaceError:
        if not any(record.tables.get("images") for record in records_of(session)):
            raise
        return plan_without_readings(session.survey, session.store)
