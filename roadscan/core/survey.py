"""The survey: what was driven, on which map, and what to make of it (``SURVEY.toml``)."""

from __future__ import annotations

import datetime as dt
import functools
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self, cast

from pydantic import Field, create_model, model_validator

from roadscan.core.clock_evidence import MotionEvidence, PairEvidence
from roadscan.core.crs import Anchor, Geoid, MapFrame, check_not_mirrored
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.gpstime import Clock, TimeSystem, check_week, gps_ns_from_utc
from roadscan.core.grid import LanePass, PassId, RunId
from roadscan.core.plugins import found_kinds
from roadscan.core.rig import Rig, Sensor
from roadscan.core.settings.calibration import CalibrationEvidence, CalibrationSettings
from roadscan.core.settings.navigation import OdometryConfig, PpkSettings, SmootherConfig, SplineConfig
from roadscan.core.settings.segmentation import RoadSegmentation
from roadscan.core.strict import MEANINGS, NAME_PATTERN, Strict, load_toml

ENTRY_POINT_GROUP: Final = "roadscan.survey_sections"


class AnchorConfig(Strict):
    """Ties the local frame to the Earth."""

    latitude_deg: float = Field(ge=-90, le=90)
    """Geodetic latitude of the origin (degrees)."""
    longitude_deg: float = Field(ge=-180, le=360)
    """Longitude of the origin (degrees)."""
    height_m: float
    """Ellipsoidal height of the origin (m)."""
    heading_deg: float = 0.0
    """Heading of the local y axis, clockwise from true north (degrees)."""
    crs: str = "EPSG:4979"
    """Geographic CRS of the three numbers above."""


class LocalConfig(Strict):
    """A local engineering frame: x to the right of y, z up, metres."""

    name: str = "local"
    """Name written into the products."""
    anchor: AnchorConfig | None = None
    """Where the frame lies on the Earth; needed only to mix it with Earth-bound data."""


class MapConfig(Strict):
    """Map frame of the survey and its heights."""

    crs: str | None = None
    """Projected CRS, such as "EPSG:25832"; its unit is used in the products. One that counts south, then west
    (EPSG:5513, EPSG:2065), is refused: left and right would be exchanged."""
    local: LocalConfig | None = None
    """A local engineering frame, in place of `crs`, or the frame of local poses beside it."""
    height: Literal["ellipsoidal", "orthometric"] = "ellipsoidal"
    """Kind of the products' heights; orthometric needs `geoid`."""
    geoid: str | None = None
    """File name of the geoid grid (GTX or GeoTIFF as PROJ reads it); never downloaded."""
    grids: Path | None = None
    """Folder with geoid grids, relative to the survey file."""
    vertical_crs: str | None = None
    """Vertical CRS of the map, such as "EPSG:7837": it stands in the products' WKT, and clouds whose file names one of
    another datum are brought into it."""
    max_datum_error_m: float = Field(default=0.05, ge=0)
    """Largest accepted error of a change of datum between logs and map (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.crs is None and self.local is None:
            raise ValueError('say where the map is: crs = "EPSG:…" or [map.local]')
        return self

    def geoid_named(self, name: str, folder: Path) -> Geoid:
        """Return the geoid grid of a name: from `grids`, below the survey's `folder`, else from PROJ's folders."""
        return Geoid.found(name, None if self.grids is None else folder / self.grids)

    def frame(self, folder: Path) -> MapFrame:
        """Return the map frame of these settings, for a survey file in `folder`.

        Raises
        ------
        CrsError
            if the CRS is none of a map, or its axes are mirrored: left and right would be exchanged.
        """
        if self.crs is not None:
            check_not_mirrored(self.crs)
        anchor = None
        if self.local is not None and self.local.anchor is not None:
            anchor = Anchor(**self.local.anchor.model_dump())
        return MapFrame(
            crs=self.crs,
            local_name=self.local.name if self.local else "",
            anchor=anchor,
            height=self.height,
            geoid=self.geoid_named(self.geoid, folder) if self.geoid and self.height == "orthometric" else None,
            vertical_crs=self.vertical_crs,
            max_datum_error_m=self.max_datum_error_m,
        )


class ClockConfig(Strict):
    """Time system of a log and the clock's measured error."""

    system: TimeSystem
    """gps, gps_week_seconds, gps_adjusted, unix_gps, unix_utc, unix_tai, utc_hour or free."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of numeric stamps."""
    week: int | None = Field(default=None, ge=0, le=5000)
    """GPS week of the log's first stamp, in full: a receiver that counts modulo 1024 shows too small a one."""
    date: dt.date | None = None
    """UTC date of the log's first stamp; stands for the week, and resolves the hour of `utc_hour`."""
    offset_s: float = Field(default=0.0, ge=-4e9, le=4e9)
    """Measured correction added to every stamp (s)."""
    drift_ppm: float = 0.0
    """Measured rate error (parts per million) from `reference_s` on."""
    reference_s: float = 0.0
    """Stamp at which `offset_s` was measured (s of the log's count)."""
    pairs: PairEvidence | None = None
    """Pairs of (stamp, GPS time) that offset and drift are computed from, in place of stating them."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.week is not None and self.date is not None:
            raise ValueError("give week or date, not both")
        if self.week is not None:
            check_week(self.week)
        if self.pairs is None and self.system is TimeSystem.FREE and self.offset_s == 0.0:
            raise ValueError("a free-running clock needs offset_s, measured against GPS time, or pairs of stamps")
        if self.pairs is not None:
            if self.offset_s or self.drift_ppm or self.reference_s:
                raise ValueError("give pairs, or offset_s and drift_ppm, not both")
            if self.system is TimeSystem.UTC_HOUR:
                raise ValueError("stamps past the hour cannot be paired: state the measured offset_s")
        return self

    def clock(self) -> Clock:
        """Return the clock of these settings; corrections from pairs are added by the caller."""
        return Clock(**self.model_dump(exclude={"pairs"}))


class ClockDefaults(Strict):
    """Time system of logs that state none, and the week or date of those that state neither."""

    system: TimeSystem | None = None
    """Time system of a log that states no clock and whose format asks for one; a log that knows its time keeps
    it. Not `free`: such a clock is one sensor's own. Left out, only `week` or `date` is a default."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the stamps of such a log."""
    week: int | None = Field(default=None, ge=0, le=5000)
    """GPS week, in full, of logs whose clock is `gps_week_seconds` and states neither week nor date."""
    date: dt.date | None = None
    """UTC date of logs whose clock is `gps_week_seconds` or `utc_hour` and states neither week nor date, and of NMEA
    logs without one."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.week is not None and self.date is not None:
            raise ValueError("give week or date, not both")
        if self.week is not None:
            check_week(self.week)
        if self.system is TimeSystem.FREE:
            raise ValueError("a free-running clock is one sensor's own: state it with its log")
        return self

    def clock(self) -> Clock | None:
        """Return the clock of a log that states none; None where there is no default."""
        return None if self.system is None else Clock(self.system, self.unit, self.week, self.date)

    def dated(self, clock: ClockConfig) -> ClockConfig:
        """Return a stated clock, with the default week or date where it has none."""
        lacks = clock.week is None and clock.date is None
        if lacks and clock.system is TimeSystem.GPS_WEEK:
            return clock.model_copy(update={"week": self.week, "date": self.date})
        if lacks and clock.system is TimeSystem.UTC_HOUR:
            return clock.model_copy(update={"date": self.date})
        return clock


class LogDefaults(Strict):
    """What holds for all logs of the runs that do not state it themselves; ground control states its own."""

    crs: str | None = None
    """CRS of positions of a log that states none, and whose file names none."""
    height: Literal["ellipsoidal", "orthometric"] | None = None
    """Kind of heights of a log that states none, and of which neither file, CRS nor format says it. A log whose file
    says that its heights are of another kind is refused until it states its own."""
    geoid: str | None = None
    """Geoid grid of logs with orthometric heights that name none."""
    clock: ClockDefaults | None = None
    """Time system, and week or date."""


class LogConfig(Strict):
    """One raw log."""

    path: Path
    """File or folder, relative to the survey file."""
    format: str | None = None
    """Format name (`roadscan formats`); found from the bytes where left out and unambiguous."""
    sensor: str | None = None
    """Sensor of the rig that wrote it; trajectories need none."""
    clock: ClockConfig | None = None
    """Time system; required unless the format states its own."""
    crs: str | None = None
    """CRS of positions in the log (for example "EPSG:4979", or "local"), where it holds any."""
    height: Literal["ellipsoidal", "orthometric"] | None = None
    """Kind of heights in the log; required where it holds any and neither its file, nor its CRS (such as "EPSG:4979"),
    nor its format says it."""
    geoid: str | None = None
    """Geoid grid that brings the log's orthometric heights to the ellipsoid."""
    options: dict[str, Any] = {}
    """Settings of the format (`roadscan formats NAME`)."""

    def completed(self, defaults: LogDefaults) -> LogConfig:
        """Return the log with the default geoid, week and date where it states none.

        Default CRS, kind of heights and time system are not put in: only the log's reader knows whether its file says
        its own.
        """
        geoid = defaults.geoid if self.geoid is None and self.height != "ellipsoidal" else self.geoid
        clock = self.clock
        if clock is not None and defaults.clock is not None:
            clock = defaults.clock.dated(clock)
        return self.model_copy(update={"geoid": geoid, "clock": clock})


class RunConfig(Strict):
    """One recorded drive."""

    id: str = Field(pattern=NAME_PATTERN)
    """Name of the run."""
    logs: list[LogConfig] = Field(min_length=1)
    """Logs of this run."""


class PassConfig(Strict):
    """One traverse of a lane. Without any, each run is one pass."""

    id: int = Field(ge=1, le=65_535)
    """Pass number, the point_source_id of LAS."""
    run: str
    """Run it belongs to."""
    start: dt.datetime | None = None
    """First instant, with zone (2026-05-04T09:30:00Z); from the run's start where left out."""
    end: dt.datetime | None = None
    """First instant after it, with zone; to the run's end where left out."""
    lane: str = ""
    """Lane, as the road authority names it."""
    direction: str = ""
    """Direction of travel, as the road authority names it."""


class ControlConfig(Strict):
    """Surveyed points."""

    path: Path
    """CSV, GeoJSON or GeoPackage, relative to the survey file."""
    format: str | None = None
    """Format name; found from the file where left out."""
    crs: str
    """CRS of the coordinates, such as "EPSG:25832" or "local"; never assumed."""
    height: Literal["ellipsoidal", "orthometric"]
    """Kind of the heights; never assumed."""
    geoid: str | None = None
    """Geoid grid of orthometric heights, where they must become ellipsoidal."""
    options: dict[str, Any] = {}
    """Settings of the format."""


class NavigationConfig(Strict):
    """Where poses come from, and how they are interpolated."""

    solve: Literal["missing", "always", "never"] = "missing"
    """Runs whose trajectory is computed from GNSS and IMU: those without a trajectory log, all that have both, none."""
    smoother: SmootherConfig = SmootherConfig()
    """How it is computed."""
    odometry: OdometryConfig | None = None
    """Poses from a lidar's sweeps, for runs with neither a trajectory nor GNSS: a local map."""
    ppk: PpkSettings | None = None
    """Base station and settings of logs of raw GNSS observations (format = "ppk"); their options go before it."""
    spline: SplineConfig = SplineConfig()
    """Whether and how trajectory logs are smoothed where GNSS dropped out."""
    calibration: CalibrationSettings = CalibrationSettings()
    """What all evidence of a calibration of mountings shares."""

    max_gap_s: float = Field(default=1.0, gt=0)
    """Between two poses farther apart than this there is no pose: readings there are counted, not placed."""


class FilterConfig(Strict):
    """Which readings become points, beside the range limits of each sensor in the rig file.

    Points of clouds (LAS, E57, PLY) were placed by another program: of these filters the absolute heights and the
    centre lines hold for them; neither range limits nor heights relative to the vehicle do, since neither sensor nor
    pose of such a point is known.
    """

    height_min_m: float | None = None
    """Lowest height kept, above the map's zero (m)."""
    height_max_m: float | None = None
    """Highest height kept (m)."""
    above_body_min_m: float | None = None
    """Lowest height kept, relative to the IMU reference point at the same instant (m)."""
    above_body_max_m: float | None = None
    """Highest height kept, relative to the IMU reference point at the same instant (m)."""
    centre_line: Path | None = None
    """Vector layer of road centre lines (shapefile, TIGER/Line zipped too, GeoPackage, GeoJSON), relative to the
    survey file; only points near one of its lines are kept."""
    centre_line_crs: str | None = None
    """CRS of the layer, such as "EPSG:4269" or "local"; needed where the layer does not name its own."""
    centre_line_width: str = "buffer"
    """How far beside a line points are kept: "buffer", `centre_line_buffer_m` beside every line; "class", half the
    width of the road's class (MTFCC of TIGER/Line) or of its lanes, and `centre_line_margin_m`; or the name of
    the attribute with the road's width, of which half is kept, and the margin (a road without one goes by its lanes
    or class)."""
    centre_line_buffer_m: float = Field(default=15.0, gt=0)
    """Kept beside a line (m), on each side, for "buffer" and for roads whose width is not known."""
    centre_line_margin_m: float = Field(default=8.0, ge=0)
    """Kept beyond the edge of a road of known width (m): for roadside features, and for the error of the lines (the
    Census Bureau aims at 7.6 m in 95 % of cases for TIGER/Line)."""
    keep_marked: bool = False
    """Keep the points that a filter leaves out in the point files (LAS without `spacing_m`), withheld and marked by
    class: 7 too low, 18 too high, 64 nearer and 65 farther than the sensor's range limits, 66 off the centre lines;
    of `[segmentation]` 67 above the surface, 68 scattered, 69 grazing, 70 off the carriageway, 71 overlapping.
    Cells, rasters and figures never use them; a tile that holds no other point gets no files."""
    centre_line_options: dict[str, Any] = {}
    """Settings of the layer (`roadscan formats road_lines`): its name, attributes, units, widths by class."""


CellColumns = Literal["full", "surface"]
"""Columns of the table `cells`."""


class TileConfig(Strict):
    """The grid."""

    size_m: float = Field(default=10.0, gt=0, allow_inf_nan=False)
    """Edge of a tile (m)."""
    cell_m: float = Field(default=0.05, gt=0, allow_inf_nan=False)
    """Edge of a cell (m); divides the tile's edge. A cell should hold four readings or more, so that its height is a
    median: `run` and `status` name the edge that would where cells hold one (or, where this is left out, fewer than
    four) in the fullest tiles, those with half of all readings."""
    cell_table: CellColumns = "full"
    """What is stored of a cell: `full`, all columns of the table `cells`; `surface`, its place, count, robust height
    (rounded to 2⁻²⁰ m) and mean intensity (rounded to 1/64), which takes a third of the time and a sixth
    of the room. Products of other columns (height_std of the mosaic) need `full`, and so do depths of cracks narrower
    than two cells (`height_min_m`)."""
    block_tiles: int = Field(default=8, ge=1, le=64)
    """Edge of the largest block of work, in tiles; changes no result."""
    max_block_readings: int = Field(default=10_000_000, ge=1)
    """A block expected to hold more readings is cut into smaller ones, down to single tiles; a worker needs
    about 400 MB and 100 bytes a reading. Changes no result."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        cells = self.size_m / self.cell_m
        if abs(cells - round(cells)) > 1e-9:
            raise ValueError(f"cell_m {self.cell_m:g} does not divide size_m {self.size_m:g}")
        if round(cells) > 20_000:
            raise ValueError(f"a tile would have {round(cells)}² cells; make cell_m larger")
        if round(cells) % 2 and round(cells) > 1:
            raise ValueError("a tile needs an even number of cells along its edge (overviews)")
        return self


class ProductConfig(Strict):
    """What the run writes."""

    make: list[str] | None = None
    """Names of products (`roadscan products`); left out, those that it lists as made."""
    options: dict[str, dict[str, Any]] = {}
    """Settings by product name, for example { las = { spacing_m = 0.1 } }."""


class ChecksConfig(Strict):
    """When a run warns of what it lost, and what it refuses; a log that gives nothing at all always fails."""

    lost_share: float = Field(default=0.1, ge=0, le=1)
    """Share of a log's records that are rejected, or of its readings that have no pose, above which `roadscan run` and
    `roadscan status` say so."""
    lever_arm_max_m: float = Field(default=10.0, gt=0)
    """Longest component of a sensor's `lever_arm_body_m` (m). A longer one is refused: it was most likely stated in
    millimetres. State more for a longer vehicle."""


class SurveyConfig(Strict):
    """What every survey states; the tables of the features join it (:func:`survey_file_model`)."""

    id: str = Field(pattern=NAME_PATTERN)
    """Name of the survey; part of the store's path."""
    title: str = ""
    """One line about it."""
    rig: Path | Rig = Rig()
    """Rig file, relative to the survey file, or the rig itself."""
    store: str = "store"
    """Folder (relative to the survey file) or object-store URL that holds tables and products."""
    map: MapConfig
    """Map frame and heights."""
    runs: list[RunConfig] = Field(min_length=1)
    """Recorded drives."""
    defaults: LogDefaults | None = None
    """What holds for all logs that do not state it themselves: CRS, kind of heights, geoid, clock."""
    passes: list[PassConfig] = []
    """Traverses of lanes."""
    control: list[ControlConfig] = []
    """Ground control and check points."""
    clocks: list[MotionEvidence] = []
    """Clocks of sensors that are found from shared motion."""
    calibration: list[CalibrationEvidence] = []
    """What mountings are calibrated from (`roadscan calibrate`)."""
    navigation: NavigationConfig = NavigationConfig()
    """Poses."""
    filters: FilterConfig = FilterConfig()
    """Filters of points."""
    checks: ChecksConfig = ChecksConfig()
    """When a run warns."""
    segmentation: RoadSegmentation | None = None
    """Left out, all readings of profiles count; with it, even as an empty table, only those that hit the road."""
    tiles: TileConfig = TileConfig()
    """Tiles and cells."""
    products: ProductConfig = ProductConfig()
    """Products."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        runs = [run.id for run in self.runs]
        if len(set(runs)) < len(runs):
            raise ValueError("two runs have the same id")
        if self.navigation.ppk and all(log.format != "ppk" for run in self.runs for log in run.logs):
            raise ValueError('[navigation.ppk] is for logs of raw observations, and no log has format = "ppk"')
        if len({p.id for p in self.passes}) < len(self.passes):
            raise ValueError("two passes have the same id")
        for one in self.passes:
            if one.run not in runs:
                raise ValueError(f"pass {one.id} names the unknown run '{one.run}'{nearest(one.run, runs)}")
        return self


class SurveySection(Strict):
    """A table of the survey file that a feature declares: a class in its file ``settings.py``, or of another package by
    an entry point of the group ``roadscan.survey_sections``.
    """

    table: ClassVar[str]
    """Key of the table."""
    meaning: ClassVar[str]
    """What it is for, in a line."""
    may_be_left_out: ClassVar[bool] = False
    """True where a survey file without the table has no such settings; False where defaults apply then."""

    def check_survey(self, config: SurveyConfig) -> None:
        """Raise :class:`ValueError` where the settings do not fit the rest of the survey file."""

    @classmethod
    def of(cls, survey: Survey) -> Self:
        """Return the section of a survey, with default values where its file has none."""
        return cls.stated(survey) or cls()

    @classmethod
    def stated(cls, survey: Survey) -> Self | None:
        """Return the section of a survey; None where it is optional and left out."""
        return cast("Self | None", getattr(survey.config, cls.table))


@functools.cache
def survey_file_model() -> type[SurveyConfig]:
    """Return the model of a whole survey file: the common settings, and a field for each section of a feature."""
    sections: dict[str, type[SurveySection]] = found_kinds("*/settings.py", SurveySection, ENTRY_POINT_GROUP, "table")
    fields: dict[str, Any] = {
        name: (kind | None, None) if kind.may_be_left_out else (kind, kind()) for name, kind in sections.items()
    }
    model = create_model("SurveyFile", __base__=SurveyConfig, __module__=__name__, **fields)
    MEANINGS[model] = {name: kind.meaning for name, kind in sections.items()}
    globals()[model.__name__] = model  # workers find the class by this name
    return model


def _with_defaults(config: SurveyConfig) -> SurveyConfig:
    """Return the survey file with the defaults applied to each log (:meth:`LogConfig.completed`)."""
    defaults = config.defaults
    if defaults is None:
        return config
    runs = [run.model_copy(update={"logs": [log.completed(defaults) for log in run.logs]}) for run in config.runs]
    return config.model_copy(update={"runs": runs})


def _check_section(section: SurveySection, config: SurveyConfig, file: str | Path | None) -> None:
    try:
        section.check_survey(config)
    except ValueError as error:
        raise ConfigError(str(error), file=file) from error


class Survey:
    """A loaded survey file: configuration, rig and folder."""

    def __init__(self, config: SurveyConfig, rig: Rig, folder: Path) -> None:
        self.config = config
        self.rig = rig
        self.folder = folder

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read ``SURVEY.toml`` and the rig it names."""
        file = Path(path)
        return cls.parse(load_toml(file), folder=file.resolve().parent, file=file)

    @classmethod
    def parse(cls, values: dict[str, Any], *, folder: Path, file: str | Path | None = None) -> Self:
        """Validate `values` as a survey file in `folder`."""
        config = _with_defaults(survey_file_model().parse(values, file=file))
        for name in type(config).model_fields.keys() - SurveyConfig.model_fields.keys():
            if (section := getattr(config, name)) is not None:
                _check_section(section, config, file)
        rig = config.rig if isinstance(config.rig, Rig) else Rig.load(folder / config.rig)
        for run in config.runs:
            for log in run.logs:
                if log.sensor is not None and log.sensor not in rig.sensors:
                    raise ConfigError(
                        f"log '{log.path}' names the unknown sensor '{log.sensor}'{nearest(log.sensor, rig.sensors)}",
                        expected="a sensor of the rig: " + (", ".join(rig.sensors) or "it has none"),
                        file=file,
                    )
        chosen = (config.segmentation.sensors or []) if config.segmentation is not None else []
        for name in chosen:
            if name not in rig.sensors:
                raise ConfigError(
                    f"segmentation.sensors names the unknown sensor '{name}'{nearest(name, rig.sensors)}",
                    expected="a sensor of the rig: " + (", ".join(rig.sensors) or "it has none"),
                    file=file,
                )
        return cls(config, rig, folder)

    @property
    def store_url(self) -> str:
        """Return the location of tables and products: an absolute folder, or a URL."""
        store = self.config.store
        return store if "://" in store else str((self.folder / store).resolve())

    def has(self, section: str) -> bool:
        """Return whether the survey file has an optional section."""
        return getattr(self.config, section) is not None

    def resolve(self, path: Path) -> Path:
        """Return the absolute path of a path that is relative to the survey file."""
        return (self.folder / path).resolve()

    def frame(self) -> MapFrame:
        """Return the survey's map, with its geoid grid resolved."""
        return self.config.map.frame(self.folder)

    def geoid(self, name: str | None) -> Geoid | None:
        """Return the geoid grid that the survey file or a log record names; None where it names none."""
        return None if not name else self.config.map.geoid_named(name, self.folder)

    def sensor(self, name: str) -> Sensor:
        """Return a sensor of the rig by name."""
        return self.rig.sensors[name]

    def passes(self, run_spans_gps_ns: dict[RunId, tuple[int, int]]) -> list[LanePass]:
        """Return the passes with their spans; a run without stated passes is one pass.

        Parameters
        ----------
        run_spans_gps_ns : first and last epoch of each run's data.
        """
        stated = {p.run for p in self.config.passes}
        used = {p.id for p in self.config.passes}
        free = (n for n in range(1, 65_536) if n not in used)
        found: list[LanePass] = []
        for run in self.config.runs:
            run_id = RunId(run.id)
            number = None if run.id in stated else PassId(next(free))
            if run_id not in run_spans_gps_ns:
                continue
            first, last = run_spans_gps_ns[run_id]
            if number is not None:
                found.append(LanePass(number, run_id, first, last + 1))
                continue
            for one in self.config.passes:
                if one.run == run.id:
                    start = first if one.start is None else gps_ns_from_utc(one.start)
                    end = last + 1 if one.end is None else gps_ns_from_utc(one.end)
                    found.append(LanePass(PassId(one.id), run_id, start, end, one.lane, one.direction))
        return sorted(found)
