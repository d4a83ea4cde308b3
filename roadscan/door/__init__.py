"""The Python interface: a survey's tables, cells, points and files as pandas, GeoPandas, xarray, Arrow and DuckDB.

The command line prints the results of these functions.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from roadscan.core.errors import ConfigError, RoadscanError, nearest
from roadscan.core.extras import needed
from roadscan.run.session import Reporter, Session

if TYPE_CHECKING:
    import duckdb
    import geopandas as gpd
    import pandas as pd
    import pyarrow as pa
    import xarray as xr

    from roadscan.core.gpstime import Clock
    from roadscan.core.grid import Bounds
    from roadscan.core.survey import Survey
    from roadscan.core.witness import Finding
    from roadscan.ingest.reading.format import Reject
    from roadscan.inventory.inventory import Inventory
    from roadscan.run.session import Selection
    from roadscan.store.store import Store
    from roadscan.survey.plan import RunPlan
    from roadscan.survey.status import Status

__all__ = ["LogTables", "MadeProduct", "OpenSurvey", "open_survey", "read_log"]

Instant = dt.datetime | int | str
"""An instant: a datetime with zone, ISO 8601 text with zone, or GPS nanoseconds since 1980-01-06."""
Box = tuple[float, float, float, float]
"""West, south, east, north on the map (m)."""


def open_survey(survey_file: str | Path = "SURVEY.toml") -> OpenSurvey:
    """Return the survey that a survey file describes; nothing is read yet.

    Raises
    ------
    ConfigError
        where the survey file or its rig file is wrong.
    """
    session = Session.open(survey_file)
    return OpenSurvey(Path(survey_file), session.survey, session.store)


@dataclass
class OpenSurvey:
    """A survey and its store."""

    file: Path
    """The survey file."""
    survey: Survey
    store: Store

    @property
    def id(self) -> str:
        """Name of the survey."""
        return self.survey.config.id

    @property
    def runs(self) -> list[str]:
        """Names of the recorded drives."""
        return [run.id for run in self.survey.config.runs]

    @property
    def crs(self) -> str | None:
        """CRS of the map; None for a local one."""
        return self.survey.config.map.crs

    def run(
        self,
        stages: Sequence[str] | None = None,
        *,
        workers: int | None = 0,
        scheduler: str | None = None,
        tiles: Sequence[str] | None = None,
        report: Callable[[str], None] | None = None,
    ) -> Status:
        """Compute what is missing or stale; return the resulting status.

        Parameters
        ----------
        stages : names of stages; all by default.
        workers : processes of an embedded cluster, None for one a core; 0 computes in this process.
        scheduler : address of a Dask scheduler, in place of the embedded cluster.
        tiles : tiles to compute whether stale or not, by name.
        report : receives each step.

        Raises
        ------
        RunError
            at the end, if a unit failed; everything else is finished and kept.
        """
        from roadscan.run.engine.compute_on import compute_on
        from roadscan.run.stage import stage_named
        from roadscan.survey.run import run_stages

        chosen = None if stages is None else [stage_named(name) for name in stages]
        with compute_on(workers, scheduler) as compute:
            session = Session(self.survey, self.store, compute, _selection(tiles), _Heard(report or (lambda _: None)))
            run_stages(session, chosen)
        return self.status()

    def status(self) -> Status:
        """What is ingested, current, stale and failed."""
        from roadscan.survey.status import survey_status

        return survey_status(self.session)

    def plan(self, workers: int | None = None) -> RunPlan:
        """What the next run would do on so many workers, stage by stage; reads no log through and writes nothing."""
        from roadscan.survey.plan import run_plan

        return run_plan(self.survey, self.store, workers)

    def verify(self) -> list[str]:
        """Return the faults of all files that the store should have, each read and compared with its record; and the
        lost rows.
        """
        from roadscan.inventory.of_survey import inventory_faults
        from roadscan.store.salvage import read_lost
        from roadscan.survey.status import verify_store

        return (
            verify_store(self.store)
            + inventory_faults(self.survey)
            + [f"lost: {one.told}" for one in read_lost(self.store)]
        )

    def report(self) -> str:
        """Return the report page as self-contained HTML."""
        from roadscan.report.page import report_page

        return report_page(self.session)

    def changes_since(self, earlier: OpenSurvey) -> gpd.GeoDataFrame:
        """Return changes of the road's condition since an earlier survey: a row per quantity of a section, with a line.

        Raises
        ------
        RoadscanError
            where the maps differ, or a survey has no sections of condition.
        """
        from roadscan.condition.tasks.compare import compare_surveys

        geopandas: Any = needed("geopandas", "a GeoDataFrame")

        found = compare_surveys(earlier.session, self.session)
        return geopandas.GeoDataFrame(found.table.to_pandas(), geometry=found.lines, crs=self.crs)

    @property
    def inventory(self) -> Inventory:
        """Return the inventory of assets to which the survey belongs, with the file that people edit."""
        from roadscan.inventory.of_survey import open_inventory

        return open_inventory(self.session)

    def connect(self, *, unconfined: bool = False) -> duckdb.DuckDBPyConnection:
        """Return a DuckDB connection with one view per table of the survey; the caller closes it.

        Its statements reach the store and memory; `unconfined` lets them read and write any file.
        """
        from roadscan.navigation.tasks.navigate import known_keys
        from roadscan.store.query.sql import connect

        return connect(self.store, known_keys(self.survey, self.store), unconfined=unconfined)

    def sql(self, statement: str, *, unconfined: bool = False) -> duckdb.DuckDBPyRelation:
        """Return the answer to an SQL statement; `.df()`, `.arrow()`, `.pl()` or `.fetchall()` fetch it.

        It is computed when it is fetched. Its files are not verified against their records, as those of `table` are.
        `unconfined` lets the statement read and write any file.

        Raises
        ------
        RoadscanError
            where DuckDB refuses the statement.
        """
        import duckdb

        from roadscan.store.query.sql import missing_table
        from roadscan.survey.ask import not_made

        try:
            return self.connect(unconfined=unconfined).sql(statement)
        except duckdb.Error as error:
            missing = missing_table(error)
            told = None if missing is None else not_made(missing, self.survey)
            raise told or RoadscanError(
                f"the query failed: {error}", change="sql('SHOW TABLES') lists what there is"
            ) from error

    @property
    def tables(self) -> list[str]:
        """Return the names of the existing tables."""
        with self.connect() as connection:
            return sorted(name for (name,) in connection.execute("SHOW TABLES").fetchall())

    def table(
        self,
        name: str,
        *,
        run: str | None = None,
        sensor: str | None = None,
        start: Instant | None = None,
        end: Instant | None = None,
    ) -> pd.DataFrame:
        """Return a table as a DataFrame; as a GeoDataFrame in the map's CRS where it has a geometry.

        Parameters
        ----------
        name : a table of `schemas/`.
        run, sensor : only rows of one drive or sensor.
        start, end : only rows from `start` on and before `end`, of tables in time. They open only the partitions that
            hold the span.

        Raises
        ------
        RoadscanError
            where there is no such table (yet), no such column, run or sensor, the span ends before it starts, or
            a file of the answer is damaged.
        """
        from roadscan.survey.ask import ask, not_made

        known = self.tables
        if name not in known:
            raise not_made(name, self.survey) or RoadscanError(
                f"there is no table '{name}'{nearest(name, known)}", expected="one of: " + ", ".join(known)
            )
        where = [f"{c} = '{_quoted(v)}'" for c, v in (("run", run), ("sensor", sensor)) if v is not None]
        source = f'"{name}"'
        if start is not None or end is not None:
            first = _gps_ns(start) if start is not None else 0
            last = _gps_ns(end) - 1 if end is not None else 2**62
            if last < first - 1:
                raise ConfigError(f"the span ends ({end}) before it starts ({start})", expected="start before end")
            source = f"{name}_between({first}, {last})"
        statement = f"SELECT * FROM {source}" + (" WHERE " + " AND ".join(where) if where else "")
        rows = ask(self.survey, self.store, statement)
        if not rows.num_rows:
            self._check_values(name, {"run": run, "sensor": sensor})
        return _frame(rows, self.crs)

    def assets(self, kind: str) -> pd.DataFrame:
        """Return assets of a kind, such as `pole` or `kerb`, as a GeoDataFrame in the map's CRS, with heights.

        Raises
        ------
        RoadscanError
            where there is no such kind, or its table is not made (yet).
        """
        from roadscan.store.asset_schema import asset_schema

        return self.table(asset_schema(kind).table)

    def trajectory(self, run: str, *, start: Instant | None = None, end: Instant | None = None) -> pd.DataFrame:
        """Return a run's poses on the map as they place readings: with clocks, corrections and smoothing applied.

        Returns
        -------
        Indexed by `epoch_gps_ns`; columns easting_m, northing_m, height_m, roll_deg, pitch_deg, heading_deg
        (of the body: x forward, y right, z down; heading clockwise from the map's local north), and
        sigma_north_m, sigma_east_m, sigma_down_m (NaN where they are not known).
        """
        from roadscan.door.extracts import poses_on_map

        self._check_run(run)
        limits = (_gps_ns(start) if start is not None else None, _gps_ns(end) if end is not None else None)
        return poses_on_map(self.session, run, *limits)

    def cells(self, *, bbox: Box | None = None, tile: str | None = None) -> xr.Dataset:
        """Return cells of the survey, or of a part of it, as a grid.

        Returns
        -------
        Dataset over `y` and `x` (centres of the cells on the map, metres, ascending) with `height_m` (robust height,
        NaN where there is no reading), `intensity` (mean) and `count`; attribute `crs`.

        Raises
        ------
        ConfigError
            where the part holds no cells, or has more than 400 million.
        """
        from roadscan.door.extracts import cell_grid

        return cell_grid(self.session, _box(bbox), tile)

    def points(self, tile: str) -> pd.DataFrame:
        """Return points of a tile, computed from the raw readings with all filters and corrections.

        Returns
        -------
        A row a point: easting_m, northing_m, height_m, epoch_gps_ns, intensity, pass_id, sensor.

        Raises
        ------
        ConfigError
            where no reading touches the tile.
        """
        from roadscan.door.extracts import points_of_tile

        return points_of_tile(self.session, tile)

    def pictures_of(
        self, easting_m: float, northing_m: float, height_m: float | None = None, *, reach_m: float = 60.0
    ) -> pd.DataFrame:
        """Return pictures that see a place of the map (m), the one with the finest resolution first.

        Without a height it is that of the surveyed ground there. Obstacles between are not considered.

        Returns
        -------
        Columns run, camera, file, u_px, v_px (from the centre of the upper left pixel), distance_m, resolution_m,
        sigma_u_px, sigma_v_px (1 σ of the pixel), name (RUN/CAMERA/FILE).

        Raises
        ------
        RoadscanError
            where the height is unknown, or the survey has no pictures with poses.
        """
        import pandas

        from roadscan.site.where import PictureOfPlace, pictures_of_place

        found = pictures_of_place(self.session, easting_m, northing_m, height_m, reach_m)
        names = [f.name for f in dataclasses.fields(PictureOfPlace)]
        return pandas.DataFrame([{n: getattr(one, n) for n in names} for one in found], columns=names)

    def measured(
        self, picture: str | Path, pixels: Sequence[Sequence[float]], *, sigma_px: float = 0.5, reach_m: float = 60.0
    ) -> pd.DataFrame:
        """Return the places on the surveyed ground that pixels (u, v) of a picture show, in their order.

        Parameters
        ----------
        picture : its path, or RUN/CAMERA/FILE.
        pixels : counted from the centre of the upper left one, u to the right and v downwards.
        sigma_px : 1 σ of a measured pixel, on each axis.
        reach_m : how far a ray is followed (m).

        Returns
        -------
        A row a pixel: u_px, v_px, easting_m, northing_m, height_m, sigma_easting_m, sigma_northing_m, sigma_height_m,
        distance_m, incidence_deg (between ray and ground), reason (why there is no place; its numbers are NaN then),
        warning. `attrs["covariance_m2"]` holds the covariances (n, 3, 3), `attrs["assumed"]` the σ that nothing states.

        Raises
        ------
        RoadscanError
            where the picture is unknown or has no pose, or a pixel lies outside it.
        """
        import pandas

        from roadscan.measuring.measure import measure
        from roadscan.measuring.words import COLUMNS, place_rows

        found = measure(self.session, picture, pixels, sigma_px, reach_m)
        frame = pandas.DataFrame(place_rows(found.places), columns=list(COLUMNS))
        frame.attrs["covariance_m2"] = [one.covariance_m2.tolist() for one in found.places]
        frame.attrs["assumed"] = found.assumed
        return frame

    def met(
        self,
        first: str | Path,
        first_pixel: Sequence[float],
        second: str | Path,
        second_pixel: Sequence[float],
        *,
        sigma_px: float = 0.5,
    ) -> pd.Series:
        """Return the place where the rays of pixels of two pictures meet; no ground takes part.

        Returns
        -------
        The entries of a row of :meth:`measured`, and `gap_m`, by which the rays pass each other. `warning` names rays
        that meet at less than 5° or pass each other by more than their σ explains.

        Raises
        ------
        RoadscanError
            where a picture is unknown, both are the same, or the rays do not meet before the cameras.
        """
        import pandas

        from roadscan.measuring.measure import meet
        from roadscan.measuring.words import place_rows

        place, gap_m = meet(self.session, (first, second), (first_pixel, second_pixel), sigma_px)
        return pandas.Series({**place_rows([place])[0], "gap_m": gap_m})

    @property
    def products(self) -> dict[str, MadeProduct]:
        """Return products that have files, by name."""
        manifest = self.session.manifest
        return {name: MadeProduct(name, self) for name in sorted(manifest.files()) if self.paths_of(name)}

    def paths_of(self, product: str) -> list[str]:
        """Return the full paths of a product's files, in order of their names."""
        session = self.session
        own = (r.path for r in session.manifest.of(product).values() if r.path)
        return sorted(session.store.path(path) for path in own)

    def _check_values(self, table: str, wanted: dict[str, str | None]) -> None:
        """Refuse a run or sensor that neither the survey file nor the table knows."""
        from roadscan.survey.ask import ask

        for column, value in wanted.items():
            stated = self.runs if column == "run" else self.survey.rig.sensors
            if value is None or value in stated:
                continue
            held = ask(self.survey, self.store, f'SELECT DISTINCT {column} FROM "{table}"').column(0).to_pylist()
            known = sorted({*stated, *held})
            if value not in known:
                raise ConfigError(
                    f"unknown {column} '{value}'{nearest(value, known)}", expected="one of: " + ", ".join(known)
                )

    def _check_run(self, run: str) -> None:
        if run not in self.runs:
            raise ConfigError(
                f"unknown run '{run}'{nearest(run, self.runs)}", expected="one of: " + ", ".join(self.runs)
            )

    @property
    def session(self) -> Session:
        """The session of the survey, for code that goes deeper."""
        return Session(self.survey, self.store)


@dataclass(frozen=True)
class MadeProduct:
    """Files of a product."""

    name: str
    survey: OpenSurvey = field(repr=False)

    @property
    def title(self) -> str:
        """Description of the product, in a line."""
        from roadscan.tiles.product import products

        known = products().get(self.name)
        return "" if known is None else known.title

    def paths(self) -> list[str]:
        """Full paths of its files, in order of their names."""
        return self.survey.paths_of(self.name)


@dataclass(frozen=True)
class LogTables(Mapping[str, "pa.Table"]):
    """Content of a log: Arrow tables by name, with the columns of `schemas/`."""

    path: Path
    format: str
    tables: dict[str, pa.Table]
    attributes: dict[str, Any]
    """Attributes needed to understand the rows: scan geometry, world frame, CRS."""
    rejects: list[Reject]
    """Records that could not be read, with the reason."""
    findings: list[Finding] = field(default_factory=list)
    """Findings of its reader."""

    def __getitem__(self, name: str) -> pa.Table:
        """Return a table by name."""
        if name not in self.tables:
            raise KeyError(f"{self.path} ({self.format}) has no table '{name}'; it has {', '.join(self.tables)}")
        return self.tables[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the tables."""
        return iter(self.tables)

    def __len__(self) -> int:
        """Return the number of tables."""
        return len(self.tables)


def read_log(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002  the survey file's word
    clock: Clock | Mapping[str, Any] | str | None = None,
    crs: str | None = None,
    height: Literal["ellipsoidal", "orthometric"] | None = None,
    geoid: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> LogTables:
    """Return the tables of one log of any format, without a survey.

    Parameters
    ----------
    path : file or folder.
    format : name (`roadscan formats`); found from the content where left out.
    clock : time system, where the format does not state its own: as in the survey file,
        ``{"system": "gps_week_seconds", "week": 2405}``, or as text, ``"gps_week_seconds,week=2405"``.
    crs, height, geoid : of positions, as in the survey file; never assumed.
    options : settings of the format (`roadscan formats NAME`).

    Raises
    ------
    RoadscanError
        where the log cannot be read as stated, or something that it needs is not stated.
    """
    from roadscan.core.crs import Geoid
    from roadscan.door.extracts import read_tables
    from roadscan.ingest.reading.format import LogSource, format_named, format_of

    file = Path(path)
    found = format_of(file) if format is None else format_named(format)
    source = LogSource(
        path=file, options=found.options.parse(dict(options or {}), file=file), clock=_clock(clock), sensor=None,
        crs=crs, height=height, geoid=None if geoid is None else Geoid.found(geoid), map=None,
    )  # fmt: skip
    tables, attributes, rejects, findings = read_tables(found, source)
    return LogTables(file, found.name, tables, attributes, rejects, findings)


class _Heard(Reporter):
    """Forwards the lines of a run."""

    def __init__(self, hear: Callable[[str], None]) -> None:
        self._hear = hear

    def line(self, text: str) -> None:
        """Forward a line."""
        self._hear(text)


def _selection(tiles: Sequence[str] | None) -> Selection | None:
    from roadscan.core.grid import TileId
    from roadscan.run.session import Selection

    return None if tiles is None else Selection(tuple(map(TileId.parse, tiles)))


def _box(bbox: Box | None) -> Bounds | None:
    from roadscan.core.grid import Bounds

    if bbox is None:
        return None
    west, south, east, north = bbox
    if not (west < east and south < north):
        raise ConfigError(f"bbox {tuple(bbox)}", expected="west, south, east, north on the map (m), in this order")
    return Bounds(west, south, east, north)


def _clock(stated: Clock | Mapping[str, Any] | str | None) -> Clock | None:
    from roadscan.core.gpstime import Clock
    from roadscan.core.survey import ClockConfig

    if stated is None or isinstance(stated, Clock):
        return stated
    if isinstance(stated, str):
        from roadscan.ingest.inspect.provisional import parse_clock

        return parse_clock(stated)
    return ClockConfig.parse(dict(stated)).clock()


def _gps_ns(instant: Instant) -> int:
    from roadscan.core.gpstime import gps_ns_from_utc

    if isinstance(instant, int | np.integer):
        return int(instant)
    try:
        moment = dt.datetime.fromisoformat(instant) if isinstance(instant, str) else instant
    except ValueError:
        moment = None
    if not isinstance(moment, dt.datetime):
        raise ConfigError(
            f"{instant!r} is no instant", expected="whole GPS nanoseconds, a datetime, or text as 2026-05-04T09:30:00Z"
        )
    if moment.tzinfo is None:
        raise ConfigError(f"{moment} has no zone", expected="UTC, such as 2026-05-04T09:30:00Z")
    return gps_ns_from_utc(moment)


def _quoted(text: str) -> str:
    return text.replace("'", "''")


def _frame(rows: pa.Table, crs: str | None) -> pd.DataFrame:
    """Return a DataFrame, or a GeoDataFrame where a column has geometries."""
    kinds = {name: str(kind) for name, kind in zip(rows.schema.names, rows.schema.types, strict=True)}
    shapes = [name for name, kind in kinds.items() if "geoarrow" in kind or (kind == "binary" and name in _GEOMETRIES)]
    frame = rows.to_pandas()
    if not shapes:
        return cast("pd.DataFrame", frame)
    geopandas: Any = needed("geopandas", "a GeoDataFrame")
    for name in shapes:
        frame[name] = geopandas.GeoSeries.from_wkb(frame[name], crs=crs)
    return cast("pd.DataFrame", geopandas.GeoDataFrame(frame, geometry=shapes[0], crs=crs))


_GEOMETRIES = ("geometry", "outline", "line", "centre", "footprint")
"""Columns of GeoParquet tables that DuckDB returns as WKB."""
