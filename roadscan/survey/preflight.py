"""Preflight: finds all mistakes of a survey that show before any log is read completely; one line per cause.

A check is a function of :class:`Asked` that yields errors. To add one, write it and list it in ``CHECKS`` with the
first stage that would fail of what it finds. Checks are independent: one that needs the map says nothing where the map
itself is at fault, since another check reports that. Of a log its header is read, of logs of positions the first block.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import functools
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from roadscan.core.counted import size_in_words
from roadscan.core.crs import (
    LOCAL_WORLD,
    MapFrame,
    crs_from_text,
    geodetic_from_world,
    one_vertical_datum,
    world_frame_of,
)
from roadscan.core.errors import ConfigError, CrsError, FormatError, RoadscanError, StoreError
from roadscan.core.extras import can_draw, missing, need
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.grid import TileGrid
from roadscan.core.rig import SensorKind
from roadscan.core.survey import ControlConfig, LogConfig, Survey
from roadscan.core.witness import Witness
from roadscan.georeference.place import CloudFrame
from roadscan.georeference.plan.road import centre_lines_of, load_buffer, looks_across
from roadscan.ingest.epoch_order import one_stamp_logs
from roadscan.ingest.inspect.diagnosis import cannot_be_opened, claimed_format, is_there
from roadscan.ingest.overlap import LookedAt, NothingPlacedError, key_of_look, look_at, named, never_meeting, no_row
from roadscan.ingest.place_checks import without_fix
from roadscan.ingest.planned_logs import CONTROL_RUN, log_options, log_source, plan_logs
from roadscan.ingest.reading.format import LogFormat, LogHeader, LogSource, Reject, Rows, format_named
from roadscan.ingest.sources import claimed_before, listed_name, remembered_logs
from roadscan.navigation.odometry import LIBRARY, WHAT
from roadscan.navigation.tasks.clocks import check_clocks
from roadscan.navigation.tasks.navigation_logs import unknown_imu, unknown_way
from roadscan.navigation.tasks.odometry_trajectory import LOCAL_MAP
from roadscan.pictures.frames.stage import no_folder_of_frames
from roadscan.run.session import Selection
from roadscan.run.stage import stage_named, stages
from roadscan.store.logs import Fault, has_log, read_log_records
from roadscan.store.store import Store
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.tasks.found_regions import none_across
from roadscan.surface.tasks.surface_plan import check_cameras, checked_surface
from roadscan.tiles.product import ProductContext
from roadscan.tiles.tasks.wanted_products import check_product, wanted_surface_products, wanted_tile_products

FARTHEST_DEG: Final = 10.0
"""Positions farther than this outside the area of the map's CRS are refused (degrees): a metre of such a map is no
metre of the road. Between 1° and that a run goes on, and says so."""
_NEAR_DEG: Final = 1.0  # between this and `FARTHEST_DEG` outside, the run goes on with a note

WORST_SCALE: Final = 0.05
"""Largest scale error of an accepted map: on Web Mercator far from the equator, for example, widths of lanes and areas
of potholes would be wrong by as much. Maps that surveyors use keep within 0.002."""

KINDS: Final[dict[str, tuple[SensorKind, ...]]] = {
    "scans": ("profiler", "lidar"),
    "returns": ("lidar",),
    "cloud": ("lidar", "profiler", "camera"),
    "gnss": ("gnss",),
    "imu": ("imu",),
    "encoder": ("encoder",),
    "images": ("camera",),
    "trajectory": ("gnss", "imu"),
    "trajectory_accuracy": ("gnss", "imu"),
}
"""Kinds of sensors whose logs fill a table; tables that are not listed may come from any."""

_PLACED: Final = ("scans", "returns")
_POSITIONS: Final = ("trajectory", "gnss")


Place: TypeAlias = np.ndarray[tuple[int], np.dtype[np.float64]]
"""Longitude, latitude (°) and ellipsoidal height (m)."""


@dataclass(frozen=True)
class CheckedLog:
    """A log of the survey file, opened as far as possible."""

    run: str
    config: LogConfig | ControlConfig
    path: Path
    format: LogFormat | None = None
    source: LogSource | None = None
    header: LogHeader | None = None
    """None where the log cannot be opened, or was ingested and moved away."""
    error: RoadscanError | None = None

    @property
    def yields(self) -> tuple[str, ...]:
        """Tables that it fills, none where its format is unknown."""
        return () if self.format is None else self.format.yields


class Asked:
    """A survey and its store, with cached answers that several checks need."""

    def __init__(self, survey: Survey, store: Store) -> None:
        self.survey = survey
        self.store = store

    @cached_property
    def frame(self) -> MapFrame | None:
        """The map, None where its settings are faulty."""
        try:
            return self.survey.frame()
        except RoadscanError:
            return None

    @cached_property
    def logs(self) -> list[CheckedLog]:
        """Logs of the survey file with their headers."""
        known = remembered_logs(self.store, self.survey.folder)
        listed: list[tuple[str, LogConfig | ControlConfig]] = [
            (run.id, log) for run in self.survey.config.runs for log in run.logs
        ]
        listed += [(CONTROL_RUN, control) for control in self.survey.config.control]
        return [_checked(self.survey, run, config, known) for run, config in listed]

    @cached_property
    def beginnings(self) -> list[_Beginning]:
        """First positions of logs."""
        return [_beginning(log) for log in self.logs]

    @cached_property
    def places(self) -> list[tuple[CheckedLog, Place, float]]:
        """Logs of positions, their first positions, and how far these are outside the area of the map's CRS (°)."""
        frame = self.frame
        return [
            (one.log, one.place, frame.beyond_area_deg(one.place))
            for one in self.beginnings
            if frame is not None and one.place is not None
        ]

    @cached_property
    def due(self) -> list[CheckedLog]:
        """Logs of which the store has no rows yet."""
        held = {(record.run, record.path) for record in read_log_records(self.store, damaged=[])}
        return [log for log in self.logs if (log.run, str(log.config.path)) not in held]

    @cached_property
    def times(self) -> list[LookedAt]:
        """When the logs of runs that are not ingested were recorded, by a first look."""
        due = {log.run for log in self.due}
        found: list[LookedAt] = []
        for log in self.logs:
            if log.run not in due or log.format is None or log.source is None or log.header is None:
                continue
            sensor = getattr(log.config, "sensor", None) or log.format.yields[0]
            seen = look_at(log.run, sensor, log.format, log.source, log.header)
            if seen is not None:
                found.append(named(seen, str(log.config.path)))
        return found

    @cached_property
    def time_faults(self) -> list[Fault]:
        """Logs that cannot meet the poses of their run, and those whose clock stood still."""
        return [*never_meeting(self.survey, self.times), *one_stamp_logs([t.record for t in self.times if t.ends])]

    def yields(self, run: str) -> set[str]:
        """Return the tables that the logs of a run fill."""
        return {table for log in self.logs if log.run == run for table in log.yields}

    def is_solved(self, run: str) -> bool:
        """Return whether a run has poses, or GNSS and IMU from which they are computed."""
        yields = self.yields(run)
        solve = self.survey.config.navigation.solve
        return "trajectory" in yields or (solve != "never" and {"gnss", "imu"} <= yields)

    @property
    def by_lidar(self) -> list[str]:
        """Runs whose poses come from their lidar's sweeps."""
        if self.survey.config.navigation.odometry is None:
            return []
        runs = [run.id for run in self.survey.config.runs]
        return [run for run in runs if "returns" in self.yields(run) and not self.is_solved(run)]


Check: TypeAlias = Callable[[Asked], Iterator[RoadscanError]]


def check_map(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the CRS is known, projected and not compound, and that there is a geoid where heights need one."""
    yield from _faults(asked.survey.frame)


def check_geoids(asked: Asked) -> Iterator[RoadscanError]:
    """Check that every named geoid grid exists."""
    config = asked.survey.config
    named = [config.map.geoid if config.map.height == "orthometric" else None]
    named += [log.config.geoid if log.config.height != "ellipsoidal" else None for log in asked.logs]
    for geoid in (asked.survey.geoid(grid) for grid in dict.fromkeys(named)):
        if geoid is not None:
            yield from _faults(geoid.check)
    yield from _uncovered(asked)


def _uncovered(asked: Asked) -> Iterator[RoadscanError]:
    """Yield the error of the map's geoid where its grid does not cover the first position of a log."""
    geoid = None if asked.frame is None else asked.frame.geoid
    if geoid is None or geoid.file is None:
        return
    for log, (longitude, latitude, *_), _ in asked.places:
        faults = list(_faults(functools.partial(geoid.undulation_m, longitude, latitude)))
        if faults:
            yield faults[0].at(log.path)
            return


def check_logs(asked: Asked) -> Iterator[RoadscanError]:
    """Check that every log can be opened, with all statements its reader needs: clock, CRS, sensor, settings."""
    for log in asked.logs:
        if log.error is not None:
            yield log.error


def check_positions(asked: Asked) -> Iterator[RoadscanError]:
    """Check that every log of positions has at least one."""
    for one in asked.beginnings:
        if one.error is not None:
            yield one.error


def check_programs(asked: Asked) -> Iterator[RoadscanError]:
    """Check that programs which compute the rows of logs are installed, where such rows are due."""
    lacking = {log.format.name: error for log in asked.logs if log.format and (error := log.format.lacks())}
    if lacking:
        planned, _ = plan_logs(asked.survey, asked.store, only_looks=True)
        due = [log.format.name for log in planned if not has_log(asked.store, log.key)]
        yield from (error for name, error in lacking.items() if name in due)


def check_kinds(asked: Asked) -> Iterator[RoadscanError]:
    """Check that each sensor's kind fits the content of its logs."""
    for log in asked.logs:
        sensor = None if log.source is None or log.error is not None else log.source.sensor  # a reader may have told it
        allowed = {kind for table in log.yields for kind in KINDS.get(table, (sensor.kind if sensor else "lidar",))}
        if sensor is not None and sensor.kind not in allowed and isinstance(log.config, LogConfig):
            yield ConfigError(
                f"the sensor '{log.config.sensor}' is of kind {sensor.kind}, and the log yields "
                f"{' and '.join(log.yields)}",
                expected="a sensor of kind " + " or ".join(sorted(allowed)),
                change="name another sensor, or correct its kind in the rig file",
                file=log.path,
            )


def check_lever_arms(asked: Asked) -> Iterator[RoadscanError]:
    """Check that lever arms are not longer than a vehicle."""
    most_m = asked.survey.config.checks.lever_arm_max_m
    for name, sensor in asked.survey.rig.sensors.items():
        if max(map(abs, sensor.lever_arm_body_m)) > most_m:
            stated = ", ".join(f"{component:g}" for component in sensor.lever_arm_body_m)
            yield ConfigError(
                f"the lever arm of sensor '{name}' is [{stated}] m",
                expected=f"components of at most {most_m:g} m (checks.lever_arm_max_m)",
                change="state lever_arm_body_m in metres; of a vehicle that is as long, raise checks.lever_arm_max_m",
            )


def check_times(asked: Asked) -> Iterator[RoadscanError]:
    """Check that a log of readings is left that meets the poses of its run, and whose clock did not stand still."""
    found = asked.time_faults
    faulty = {key for fault in found for key in fault.keys}
    readings = [log for log in asked.logs if {*_PLACED, "cloud"} & set(log.yields)]
    if readings and all(key_of_look(log.run, log.path) in faulty for log in readings):
        yield NothingPlacedError.of(found)


def _cloud_of(survey: Survey, attributes: Mapping[str, Any]) -> CloudFrame:
    geoid, vertical = survey.geoid(attributes.get("geoid")), attributes.get("vertical_crs")
    return CloudFrame(attributes["crs"], attributes["height"], geoid, vertical)


def check_datums(asked: Asked) -> Iterator[RoadscanError]:
    """Check that positions of every log can be transformed to the map."""
    astray = [log for log, _, beyond_deg in asked.places if beyond_deg > FARTHEST_DEG]  # that is told, and is enough
    for log in asked.logs:
        if asked.frame is None or log.header is None or log in astray:
            continue
        if isinstance(log.config, LogConfig) and not asked.yields(log.run) & {*_PLACED, "cloud"}:
            continue  # nothing of its run enters the map
        if "cloud" in log.yields:
            cloud = _cloud_of(asked.survey, log.header.attributes)
            faults = (
                [] if cloud.is_in(asked.frame) else list(_faults(functools.partial(cloud.check, asked.frame), log.path))
            )
            yield from faults
            if faults or cloud.is_in(asked.frame) or cloud.is_by_proj(asked.frame):
                continue
        stated = log.header.attributes.get("world_frame") or log.header.attributes.get("crs")
        crs = stated or (log.config.crs if isinstance(log.config, ControlConfig) else None)
        if crs is not None and not (crs == LOCAL_WORLD and asked.frame.is_local):
            world = LOCAL_WORLD if crs == LOCAL_WORLD else world_frame_of(str(crs))
            yield from _faults(lambda frame=asked.frame, world=world: frame.check_world(world), log.path)  # type: ignore[misc]


VERTICAL_DATUM: Final = Witness(
    name="vertical_datum",
    input="cloud",
    fault="Heights of a cloud count from another vertical datum than those of the map, or of another cloud.",
    asks="the vertical CRS that the file names, against map.vertical_crs, or that of the other clouds",
    does="heights are transformed where PROJ knows the operation within map.max_datum_error_m and has its grid, or by "
    "the geoids of log and map; otherwise the run ends before it computes",
    told=("error",),
)


def check_vertical_datums(asked: Asked) -> Iterator[RoadscanError]:
    """Check that clouds have one vertical datum where the map states none."""
    if asked.frame is None or asked.frame.is_local or asked.frame.vertical_crs is not None:
        return
    first: tuple[str, CheckedLog] | None = None
    for log in asked.logs:
        vertical = None if log.header is None else log.header.attributes.get("vertical_crs")
        if vertical is None or log.header is None or log.header.attributes.get("geoid") is not None:
            continue
        first = first or (vertical, log)
        if not one_vertical_datum(vertical, first[0]):
            yield CrsError(
                f"its heights are of {crs_from_text(vertical).name} ({vertical}), those of {first[1].config.path} of "
                f"{crs_from_text(first[0]).name} ({first[0]})",
                expected="clouds of one vertical datum, or a map that says into which they are brought",
                change=f'state map.vertical_crs = "{first[0]}"; or name the geoid of each log and map.geoid',
                file=log.path,
            )


def check_area(asked: Asked) -> Iterator[RoadscanError]:
    """Check that positions lie in the area of the map's CRS."""
    for log, place, beyond_deg in asked.places:
        if beyond_deg > FARTHEST_DEG:
            yield CrsError(
                f"the positions begin near {_place_words(place)}, far outside the area of {_map_words(asked)}",
                expected="the CRS of the region that was driven",
                change="correct map.crs, or the crs of the log",
                file=log.path,
            )


def check_scale(asked: Asked) -> Iterator[RoadscanError]:
    """Check that a metre of the map is a metre of the road."""
    for log, place, beyond_deg in asked.places:
        scale = 1.0 if asked.frame is None or beyond_deg > FARTHEST_DEG else asked.frame.length_scale(place)
        if abs(scale - 1.0) > WORST_SCALE:
            yield CrsError(
                f"the positions begin near {_place_words(place)}, where 1 m on the ground is {scale:.2f} m in "
                f"{_map_words(asked)}",
                expected="a map that keeps lengths",
                change="state the projected CRS of the region as map.crs, such as its UTM zone",
                file=log.path,
            )


def check_imu(asked: Asked) -> Iterator[RoadscanError]:
    """Runs without a trajectory, whose IMU and GNSS receiver make one: the rig file has to say how good the IMU is."""
    stated = asked.survey.config.navigation.smoother.imu
    for run in asked.survey.config.runs:
        logs = [log for log in asked.logs if log.run == run.id and isinstance(log.config, LogConfig)]
        tables = {table for log in logs for table in log.yields}
        imus = {str(log.config.sensor) for log in logs if "imu" in log.yields and isinstance(log.config, LogConfig)}
        name = next(iter(imus)) if stated is None and len(imus) == 1 else stated
        sensor = asked.survey.rig.sensors.get(name or "")
        is_made = "gnss" in tables and "trajectory" not in tables and name in imus
        if is_made and sensor is not None and sensor.imu_errors() is None:
            yield unknown_imu(str(name))


def check_poses(asked: Asked) -> Iterator[RoadscanError]:
    """Check that each run with readings has poses, or data from which they are computed."""
    for run in asked.survey.config.runs:
        yields = asked.yields(run.id)
        unknown = any(log.format is None for log in asked.logs if log.run == run.id)
        poses = asked.is_solved(run.id) or run.id in asked.by_lidar
        if not unknown and not poses and yields & set(_PLACED):
            yield ConfigError(
                f"run '{run.id}' has readings ({', '.join(sorted(yields & set(_PLACED)))}) and no trajectory",
                expected="one trajectory log, or several in one datum; or logs of GNSS and IMU with navigation.solve",
                change=f"add its trajectory to the logs of run '{run.id}'"
                + ("; or state [navigation.odometry] for a local map" if "returns" in yields else ""),
            )


def check_encoders(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the way of a tick is known where poses are computed of an encoder that only counts ticks."""
    for log in asked.logs:
        wheels = {} if log.header is None else log.header.attributes.get("wheels", {})
        quantities = {quantity for wheel in wheels.values() for quantity in wheel}
        made = asked.is_solved(log.run) and "trajectory" not in asked.yields(log.run)
        if made and "ticks" in quantities and "distance" not in quantities:
            sensor = asked.survey.rig.sensors.get(getattr(log.config, "sensor", None) or "")
            if sensor is None or sensor.metres_per_tick is None:
                yield unknown_way(str(log.config.path))


def check_videos(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the store is a folder where key frames of videos are wanted."""
    videos = [log for log in asked.logs if log.header is not None and log.header.attributes.get("kind") == "video"]
    if videos and not asked.store.is_folder and stage_named("video_frames").is_asked(asked.survey):
        yield no_folder_of_frames()


def check_odometry(asked: Asked) -> Iterator[RoadscanError]:
    """Check that what makes poses from sweeps is installed, and that the map takes poses of a local frame."""
    frame = asked.frame
    if asked.by_lidar:
        yield from _faults(lambda: need(LIBRARY, WHAT))
        if frame is not None:
            yield from _faults(lambda: frame.check_world(LOCAL_WORLD))


def check_segmentation(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the segmentation applies to at least one sensor with profiles across the road."""
    settings, found = asked.survey.config.segmentation, _tables_of_sensors(asked)
    if settings is None or any(log.format is None for log in asked.logs):
        return
    for name in settings.sensors or ():
        if "scans" not in found.get(name, {"scans"}):
            yield ConfigError(
                f"segmentation.sensors names '{name}', whose readings are {' and '.join(sorted(found[name]))}",
                expected="a sensor with profiles, rows of the table scans",
                change="take it out of the list",
            )
    if settings.sensors is None and found and not _segmented(asked):
        known = ", ".join(f"{name} ({' and '.join(sorted(tables))})" for name, tables in sorted(found.items()))
        yield ConfigError(
            f"[segmentation] would do nothing: no sensor has profiles that lie across the road; there is {known}",
            expected="scans of a sensor that looks down, its x along the driving direction",
            change="name sensors of scans in segmentation.sensors, or take the section out",
        )


def check_products(asked: Asked) -> Iterator[RoadscanError]:
    """Check that products and their settings are known, and that they fit the cells."""
    from roadscan.surface.reconstruction import SurfaceGrid

    survey, stated = asked.survey, asked.survey.config.products
    faults = [
        fault
        for name in dict.fromkeys([*(stated.make or ()), *stated.options])
        for fault in _faults(lambda name=name: check_product(survey, name))  # type: ignore[misc]
    ]
    yield from faults
    if faults or asked.frame is None:
        return
    grid = TileGrid(survey.config.tiles.size_m, survey.config.tiles.cell_m)
    surface, nowhen = SurfaceConfig.stated(survey), dt.date(1980, 1, 6)
    cell_m = None if surface is None else SurfaceGrid(grid, surface).cell_m
    context = ProductContext(survey.config.id, "", asked.frame, grid, (), nowhen, cell_m)
    yield from _faults(lambda: wanted_tile_products(survey, context))
    yield from _faults(lambda: wanted_surface_products(survey, context))
    yield from _faults(lambda: check_cameras(survey))


def check_surface(asked: Asked) -> Iterator[RoadscanError]:
    """Settings of the surface fit the tiles, its polygons lie on the map, and what computes it is installed."""
    surface = SurfaceConfig.stated(asked.survey)
    if surface is not None:
        yield from _faults(lambda: need("cv2", "the section [surface]"), None)
    if surface is not None and asked.frame is not None:
        yield from _faults(lambda: checked_surface(asked.survey, surface))
    if surface is not None and surface.regions == "found" and _none_across(asked):
        yield none_across(_tables_of_sensors(asked))


def check_centre_lines(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the layer of centre lines can be read and lies on the map."""
    frame = asked.frame
    if frame is not None:
        for fault in _faults(lambda: centre_lines_of(asked.survey)):
            yield fault
            return
        lines = centre_lines_of(asked.survey)
        if lines is not None:
            yield from _faults(lambda: load_buffer(lines, frame))


def check_motion_clocks(asked: Asked) -> Iterator[RoadscanError]:
    """Check that ``[[clocks]]`` names existing sensors and runs."""
    yield from _faults(lambda: check_clocks(asked.survey))


def check_passes(asked: Asked) -> Iterator[RoadscanError]:
    """Check that passes have a time zone, and end after they start."""
    for one in asked.survey.config.passes:
        faults = [f for at in (one.start, one.end) if at for f in _faults(lambda at=at: gps_ns_from_utc(at), None)]  # type: ignore[misc]
        yield from faults
        if not faults and one.start and one.end and one.end <= one.start:
            yield ConfigError(f"pass {one.id} ends before it starts", change="swap its start and end")


def check_store(asked: Asked) -> Iterator[RoadscanError]:
    """Check that the store can be written, that no newer version wrote it, and that it has only a survey's files."""
    yield from _faults(asked.store.check_version)
    if not asked.store.is_folder:
        yield from _faults(lambda: asked.store.exists("manifest"))
        return
    root = Path(asked.store.root)
    above = next(folder for folder in (root, *root.parents) if folder.exists())
    if not above.is_dir():
        yield StoreError("the store cannot be written: a file stands in its way", change=_STORE, file=above)
    elif not os.access(above, os.W_OK | os.X_OK) or _is_read_only(above):
        yield StoreError("the store cannot be written: no right to write there", change=_STORE, file=above)
    elif above == root and _is_foreign(root):
        yield StoreError(
            "the folder is no store of roadscan: it holds other files",
            change="name another folder as store, or another id of the survey",
            file=root,
        )


def _is_foreign(root: Path) -> bool:
    """Return whether a folder contains files, and none of a store."""
    names = {entry.name for entry in root.iterdir()}
    return bool(names) and not names & {"manifest", "tables", "tiles", "products", ".staging"}


_STORE: Final = "name a folder of yours as store in the survey file, or see to its rights"

CHECKS: Final[tuple[tuple[str, Check], ...]] = (
    ("ingest", check_store),
    ("ingest", check_map),
    ("ingest", check_geoids),
    ("ingest", check_logs),
    ("ingest", check_positions),
    ("ingest", check_programs),
    ("ingest", check_kinds),
    ("ingest", check_lever_arms),
    ("ingest", check_datums),
    ("ingest", check_vertical_datums),
    ("ingest", check_area),
    ("ingest", check_scale),
    ("ingest", check_products),
    ("ingest", check_passes),
    ("ingest", check_times),
    ("navigate", check_motion_clocks),
    ("navigate", check_imu),
    ("navigate", check_encoders),
    ("navigate", check_odometry),
    ("video_frames", check_videos),
    ("footprints", check_poses),
    ("footprints", check_segmentation),
    ("footprints", check_centre_lines),
    ("surfaces", check_surface),
)
"""Checks with the first stage that would fail because of their errors."""


@dataclass(frozen=True)
class Preflight:
    """Errors that would end a run, and notes."""

    causes: tuple[RoadscanError, ...]
    notes: tuple[str, ...]
    failing: tuple[str, ...] = ()
    """Logs that would fail while others continue, with the reason."""

    def begin(self, report: Callable[[str], None]) -> None:
        """Report the notes; raise the only error, or one that lists them all, a line each."""
        for note in self.notes:
            report(f"note: {note}")
        if len(self.causes) == 1:
            raise self.causes[0]
        if self.causes:
            lines = "".join(f"\n  - {cause}" for cause in self.causes)
            raise ConfigError(f"{len(self.causes)} things would fail, so nothing was read:{lines}")


def preflight(survey: Survey, store: Store, last_stage: str = "", selection: Selection | None = None) -> Preflight:
    """Run all checks that stages up to `last_stage` need (all, where none is named), for some tiles or for all."""
    with store.looked():
        return _preflight(survey, store, last_stage, selection)


def _preflight(survey: Survey, store: Store, last_stage: str, selection: Selection | None) -> Preflight:
    if selection is not None and not store.exists("manifest/outputs"):
        raise ConfigError("tiles are chosen, and none is computed yet", change="run `roadscan run` first")
    asked = Asked(survey, store)
    names = [stage.name for stage in stages()]
    due = set(names[: names.index(last_stage) + 1] if last_stage else names)
    found = [cause for stage, check in CHECKS if stage in due for cause in check(asked)]
    found += [cause for stage in stages() if stage.name in due for cause in stage.check(survey)]
    failing = () if found else tuple(": ".join(fault.told) for fault in asked.time_faults)
    return Preflight(tuple(_grouped(found)), tuple(_notes(asked)), failing)


_NAMED: Final = 3
"""Logs with the same fault that are named."""


def _grouped(found: Sequence[RoadscanError]) -> Iterator[RoadscanError]:
    """Yield one error for each cause: a fault of several logs is reported once, with the first of them."""
    by_cause: dict[tuple[str, str, str], list[RoadscanError]] = {}
    for one in found:
        by_cause.setdefault((one.arrived, one.expected, one.change), []).append(one)
    for (arrived, expected, change), same in by_cause.items():
        files = list(dict.fromkeys(one.file for one in same))
        if len(files) == 1:
            yield same[0]
            continue
        named = [file for file in files if file is not None]
        others = len(named) - _NAMED
        place = ", ".join(named[:_NAMED]) + (f" and {others} more" if others > 0 else "") if None not in files else None
        yield type(same[0])(arrived, expected=expected, change=change, file=place)


def _notes(asked: Asked) -> Iterator[str]:
    if not can_draw():
        yield f"pictures of figures are not drawn: {missing('matplotlib', 'drawing').change}"
    for run in asked.by_lidar:
        yield f"run '{run}' has no positions, its poses come from its lidar: {LOCAL_MAP}"
    found, settings = _tables_of_sensors(asked), asked.survey.config.segmentation
    if settings is not None and (segmented := _segmented(asked)) and (rest := sorted(found.keys() - segmented)):
        yield (
            f"[segmentation] applies to {', '.join(sorted(segmented))}; all readings of {', '.join(rest)} count, "
            "whether they hit the road or not"
        )
    yield from _room(asked)
    for log, place, beyond_deg in asked.places:
        if _NEAR_DEG < beyond_deg <= FARTHEST_DEG:
            yield (
                f"{log.path}: its positions begin near {_place_words(place)}, {beyond_deg:.1f}° outside the area of "
                f"{_map_words(asked)}: distances on the map differ from those on the ground"
            )


def _room(asked: Asked) -> Iterator[str]:
    """Yield a note where the store's disk has less room than the logs have that are still to be ingested.

    Rows take a third to three times the space of their log: a run may end well with less room, and badly with more.
    """
    if not asked.store.is_folder:
        return
    root = Path(asked.store.root)
    needed = 0
    for log in asked.due:
        with contextlib.suppress(OSError):  # a log that cannot be opened is reported separately
            needed += log.path.stat().st_size
    disk = shutil.disk_usage(next(folder for folder in (root, *root.parents) if folder.exists()))
    if disk.total and disk.free < needed:
        yield (
            f"the logs that are not ingested yet have {size_in_words(needed)}, and {size_in_words(disk.free)} are free "
            "on the store's disk: the run may stop for want of room; what is finished then stays"
        )


def _none_across(asked: Asked) -> bool:
    """Return whether no profiles lie across the road, as far as the headers of all logs tell the mountings."""
    scans = [log for log in asked.logs if "scans" in log.yields]
    if not scans or _segmented(asked) or any(log.format is None or log.header is None for log in asked.logs):
        return False
    sensors = [
        asked.survey.sensor(log.config.sensor).mounted_as(log.header.attributes.get("mounting", {}))
        for log in scans
        if log.header is not None and isinstance(log.config, LogConfig) and log.config.sensor is not None
    ]
    return bool(sensors) and not any(looks_across(sensor.mounting()) for sensor in sensors)


def _tables_of_sensors(asked: Asked) -> dict[str, set[str]]:
    """Return the tables of readings by the sensors of the survey's logs."""
    found: dict[str, set[str]] = {}
    for log in asked.logs:
        placed = set(log.yields) & set(_PLACED)
        if placed and isinstance(log.config, LogConfig) and log.config.sensor is not None:
            found.setdefault(log.config.sensor, set()).update(placed)
    return found


def _segmented(asked: Asked) -> set[str]:
    """Return the sensors of the survey's logs whose profiles are segmented."""
    settings = asked.survey.config.segmentation
    if settings is None:
        return set()
    scanners = {name for name, tables in _tables_of_sensors(asked).items() if "scans" in tables}
    if settings.sensors is not None:
        return scanners & set(settings.sensors)
    return {name for name in scanners if looks_across(asked.survey.sensor(name).mounting())}


@dataclass(frozen=True)
class _Beginning:
    """First block of positions of a log."""

    log: CheckedLog
    place: Place | None = None
    """None for a local frame, and where the log does not say."""
    error: RoadscanError | None = None
    """Why it has no position."""


def _beginning(log: CheckedLog) -> _Beginning:
    """Read a log of positions up to its first rows: it has none only where it ends before them."""
    if log.format is None or log.source is None or log.header is None or not set(_POSITIONS) & set(log.yields):
        return _Beginning(log)
    items = log.format.beginning(log.source, log.header)
    reasons: Counter[str] = Counter()
    try:
        for item in items:
            if isinstance(item, Reject):
                reasons[item.reason] += item.records
            elif isinstance(item, Rows) and item.batch.num_rows:
                return _Beginning(log, _place_of(item, str(log.header.attributes.get("world_frame", LOCAL_WORLD))))
    except OSError:  # it was opened just now; the full read reports its faults
        return _Beginning(log)
    except RoadscanError as error:
        error.file = error.file or str(log.path)
        return _Beginning(log, error=error)
    finally:
        getattr(items, "close", lambda: None)()
    return _Beginning(log, error=no_row(reasons, log.path))


def _place_of(rows: Rows, world: str) -> Place | None:
    if world == LOCAL_WORLD or rows.table not in _POSITIONS:
        return None
    xyz = np.column_stack([rows.batch.column(f"{axis}_world_m").to_numpy(zero_copy_only=False) for axis in "xyz"])
    known = xyz[np.isfinite(xyz).all(axis=1)]
    known = known[~without_fix(known)] if not without_fix(known).all() else known
    if not len(known):
        return None
    middle = np.median(known, axis=0)  # a single wrong pose, even the first, is not the drive's beginning
    nearest = known[np.argmin(np.linalg.norm(known - middle, axis=1))]
    place: Place = geodetic_from_world(world, nearest[None])[0]
    return place


def _place_words(place: Place) -> str:
    return f"longitude {place[0]:.1f}°, latitude {place[1]:.1f}°"


def _map_words(asked: Asked) -> str:
    area = crs_from_text(asked.survey.config.map.crs or "").area_of_use
    return f"map.crs '{asked.survey.config.map.crs}'" + (f" ({area.name.split('. ')[0].rstrip('.')})" if area else "")


def _checked(survey: Survey, run: str, config: LogConfig | ControlConfig, logs: Mapping[str, Any]) -> CheckedLog:
    """Open a log up to its header."""
    path = survey.resolve(config.path)
    known = logs.get(listed_name(path, survey.folder))
    if not is_there(path) and known is not None:
        return CheckedLog(run, config, path, format_named(config.format or known["format"]))
    format_: LogFormat | None = None
    source: LogSource | None = None
    try:
        if cannot := cannot_be_opened(path):
            raise cannot
        stated = config.format or claimed_before(path, known)
        format_ = format_named(stated) if stated else claimed_format(path)
        options = log_options(survey, config, format_, path)
        source = log_source(survey, config, path, format_, options)
        for file in format_.companions(path, options):
            if not is_there(file):
                raise FormatError("a file that the log's options name does not exist", file=file)
        return CheckedLog(run, config, path, format_, source, format_.header(source))
    except OSError as error:
        fault = FormatError(f"it cannot be opened: {error.strerror or error}", file=path)
        return CheckedLog(run, config, path, format_, source, error=fault)
    except RoadscanError as error:
        error.file = error.file or str(path)
        return CheckedLog(run, config, path, format_, source, error=error)


def _is_read_only(folder: Path) -> bool:
    """Return whether the file system is read-only, which an administrator cannot see from the folder's permissions."""
    return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)


def _faults(check: Callable[[], object], file: Path | None = None) -> Iterator[RoadscanError]:
    """Yield the RoadscanError of a function; with the given file, where it names none."""
    try:
        check()
    except RoadscanError as error:
        if error.file is None and file is not None:
            error.file = str(file)
        yield error
