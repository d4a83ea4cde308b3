"""The row of a survey in the catalogue of its fleet, from the records and small tables of its store."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from roadscan import __version__
from roadscan.core.counted import counted
from roadscan.core.errors import DamagedError, RoadscanError, StoreError
from roadscan.core.gpstime import iso_from_gps_ns, utc_from_gps_ns
from roadscan.fleet.members import Found
from roadscan.report.blocks import COLOURS, WIDTH, Block, Drawing, Line, MapPage, Paragraph, Part, Table
from roadscan.report.page import html_page
from roadscan.run.keys import key_of
from roadscan.store.digest import bytes_hold
from roadscan.store.history import last_run
from roadscan.store.logs import DataFile, LogRecord, read_log_records
from roadscan.store.manifest import Manifest, is_changing, read_failures, read_recorded
from roadscan.store.stamp import stamp_of_info
from roadscan.store.store import Store

FORM: Final = 1
"""Number of the way in which a row is made: another one makes all rows anew."""
_PASSING: Final = ("manifest/verified.parquet", "manifest/sources", "manifest/lock", "manifest/lease")
"""Beginnings of files of the manifest that say nothing of a survey; reading it may write the first two."""
_POSITION: Final = ("x_world_m", "y_world_m", "z_world_m")
_SECOND_NS: Final = 1_000_000_000
"""A length is taken between one pose a second (ns), so that noise of 200 poses a second does not lengthen it."""
_MOST_NOTES: Final = 3
"""Notes of a survey that are written out."""


@dataclass
class Row:
    """A row of the catalogue."""

    values: dict[str, Any]
    """By column; the geometry apart."""
    place: shapely.Geometry | None = None
    """Bounding polygon (longitude, latitude)."""


@dataclass
class _Told:
    """What was wrong while a row was made."""

    notes: list[str]
    damaged: list[StoreError] = field(default_factory=list)

    def words(self) -> str:
        every = [*self.notes, *map(str, self.damaged)]
        more = f" (and {len(every) - _MOST_NOTES} more)" if len(every) > _MOST_NOTES else ""
        return " | ".join(every[:_MOST_NOTES]) + more


def row_key(found: Found, notes: Sequence[str]) -> str:
    """Return what a survey's row follows from, without reading the store: names, sizes and times of its manifest."""
    store = found.store
    if store is None:
        return key_of(FORM, __version__, found.file, found.fault, notes)
    folder = store.path("manifest")
    listed = store.fs.find(folder, detail=True) if store.exists("manifest") else {}
    start = len(store.fs._strip_protocol(store.root)) + 1
    files = sorted(
        (path[start:], *stamp_of_info(one)) for path, one in listed.items() if not path[start:].startswith(_PASSING)
    )
    survey = found.survey
    stated = None if survey is None else [survey.config.model_dump(mode="json"), survey.rig.name]
    return key_of(FORM, __version__, found.file, store.root, stated, files, notes)


def row_of(found: Found, notes: Sequence[str]) -> Row:
    """Return the row of a survey; `notes` are known of it already. Damage is counted and noted, and raises nothing."""
    faults = _Told([*([found.fault] if found.fault else []), *notes])
    values: dict[str, Any] = {
        "survey": found.id, "title": "", "survey_file": found.file, "store": "", "state": "not run", "failed": 0,
        "version": "", "rig": "", "sensors": "", "runs": 0, "logs": 0, "map_crs": "", "key": row_key(found, notes),
    }  # fmt: skip
    if found.survey is not None:
        values |= {"title": found.survey.config.title, "rig": found.survey.rig.name}
    place = None if found.store is None else _of_store(found, found.store, values, faults)
    values |= {"damaged": len(faults.damaged), "notes": faults.words()}
    return Row(values, place)


def _of_store(found: Found, store: Store, values: dict[str, Any], faults: _Told) -> shapely.Geometry | None:
    """Fill in what the store tells, and return the survey's place."""
    values["store"] = store.root
    try:
        wanted = found.member().logs
        manifest = Manifest(store, faults.damaged)
        logs = [r for r in read_log_records(store, damaged=faults.damaged) if wanted is None or r.key in wanted]
    except RoadscanError as error:
        faults.damaged.append(StoreError(str(error)))
        return None
    failures = read_failures(store)
    done = bool(manifest.table().num_rows or logs)
    finished = "unfinished" if is_changing(store) else "finished"
    values |= {
        "state": "not run" if not done else "failed" if failures else finished,
        "failed": len(failures),
        "sensors": ",".join(sorted({r.sensor for r in logs} - {"trajectory", "control"})),
        "runs": len({r.run for r in logs}),
        "logs": len(logs),
    }
    values |= _of_history(store, faults.damaged)
    values |= _of_trajectories(store, logs, faults.damaged)
    values |= _of_sections(_table(store, manifest, "condition_sections", faults.damaged))
    return _of_tiles(_table(store, manifest, "tile_table", faults.damaged), values)


def _of_history(store: Store, damaged: list[StoreError]) -> dict[str, Any]:
    try:
        last = last_run(store)
    except StoreError as error:
        damaged.append(error)
        return {}
    return {} if last is None else {"last_run_gps_ns": last["began_gps_ns"], "version": last["version"]}


def _of_trajectories(store: Store, logs: Sequence[LogRecord], damaged: list[StoreError]) -> dict[str, Any]:
    """Return the span of the trajectories, and the length of the longest of each run."""
    spans = [span for log in logs if (span := log.span("trajectory")) is not None]
    if not spans:
        return {}
    lengths_m: dict[tuple[str, str], float] = {}
    before = len(damaged)
    for log in logs:
        for file in log.tables.get("trajectory", ()):
            poses = _poses(store, file, damaged)
            if poses is not None:
                key = log.run, log.sensor
                lengths_m[key] = lengths_m.get(key, 0.0) + length_m(*poses)
    longest: dict[str, float] = {}
    for (run, _), one in lengths_m.items():
        longest[run] = max(longest.get(run, 0.0), one)
    first, last = min(s[0] for s in spans), max(s[1] for s in spans)
    return {
        "first_epoch_gps_ns": first,
        "last_epoch_gps_ns": last,
        "year": utc_from_gps_ns(first).year,
        "driven_km": None if len(damaged) > before else sum(longest.values()) / 1e3,
    }


def length_m(epoch_gps_ns: npt.NDArray[np.int64], position_m: npt.NDArray[np.float64]) -> float:
    """Return the length (m) of a way from poses in their order: (n,) epochs, (n, 3) positions on straight axes."""
    second = epoch_gps_ns // _SECOND_NS
    kept = np.flatnonzero(np.concatenate([[True], np.diff(second) != 0]))
    corners = position_m[np.unique(np.append(kept, len(second) - 1))]
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())


def _poses(store: Store, file: DataFile, damaged: list[StoreError]) -> tuple[Any, Any] | None:
    try:
        content = store.read_bytes(file.path)
        if not bytes_hold(content, file.digest):
            change = "`roadscan verify --repair` reads its log again"
            raise DamagedError("the file is not as it was recorded", change=change, file=store.path(file.path))
        table = store.parse_table(content, file.path, ["epoch_gps_ns", *_POSITION])
    except StoreError as error:
        damaged.append(error)
        return None
    return table["epoch_gps_ns"].to_numpy(), np.column_stack([table[name].to_numpy() for name in _POSITION])


def _table(store: Store, manifest: Manifest, product: str, damaged: list[StoreError]) -> pa.Table | None:
    """Return the table of a product with one file, None where it is not made or damaged."""
    try:
        records = [record for record in manifest.of(product).values() if record.path.endswith(".parquet")]
        tables = [pq.ParquetFile(pa.BufferReader(read_recorded(store, one))).read(use_threads=False) for one in records]
    except StoreError as error:
        damaged.append(error)
        return None
    return pa.concat_tables(tables, promote_options="default") if tables else None


def _of_sections(table: pa.Table | None) -> dict[str, Any]:
    """Return the condition of the lanes, weighted by length."""
    if table is None:
        return {}
    of = {name: _numbers(table, name) for name in table.column_names if pa.types.is_floating(table[name].type)}
    length_m = of["station_to_m"] - of["station_from_m"]
    ruts = np.mean([of["rut_depth_mean_left_mm"], of["rut_depth_mean_right_mm"]], axis=0)
    with_mri = np.isfinite(of["mri_m_per_km"])
    weight = np.where(with_mri, length_m, 0.0)
    sigma = np.sqrt(np.sum((weight * np.where(with_mri, of["sigma_mri_m_per_km"], 0.0)) ** 2))
    return {
        "lane_km": float(length_m.sum()) / 1e3,
        "mri_km": float(weight.sum()) / 1e3,
        "mri_m_per_km": _mean(of["mri_m_per_km"], length_m),
        "sigma_mri_m_per_km": float(sigma / weight.sum()) if with_mri.any() and np.isfinite(sigma) else None,
        "rut_depth_mean_mm": _mean(ruts, length_m),
        "cracked_wheel_path_percent": _mean(of["cracked_wheel_path_percent"], length_m),
    }


def _of_tiles(table: pa.Table | None, values: dict[str, Any]) -> shapely.Geometry | None:
    """Fill in the figures of the tiles, and return the convex hull of their outlines (longitude, latitude)."""
    if table is None:
        return None
    values["area_m2"] = float(_numbers(table, "area_m2").sum())
    for name in ("sigma_horizontal_m", "sigma_down_m", "height_std_median_m"):
        known = _numbers(table, name)
        known = known[np.isfinite(known)]
        values[name] = float(np.median(known)) if known.size else None
    about: Mapping[str, Any] = json.loads(table.schema.metadata[b"geo"])
    stated = about["columns"][about["primary_column"]]["crs"]
    if stated is None:
        return None
    from pyproj import CRS, Transformer

    crs = CRS.from_json_dict(stated)
    values["map_crs"] = ":".join(crs.to_authority() or ())
    turned = Transformer.from_crs(crs, "OGC:CRS84", always_xy=True)
    corners = shapely.get_coordinates(shapely.from_wkb(table[about["primary_column"]].to_numpy()))
    lon_lat = np.column_stack(turned.transform(corners[:, 0], corners[:, 1]))
    return shapely.orient_polygons(shapely.convex_hull(shapely.multipoints(lon_lat)))


def _numbers(table: pa.Table, name: str) -> npt.NDArray[np.float64]:
    """Return a column as numbers, NaN where it is null."""
    return np.asarray(table[name].to_numpy(), dtype=np.float64)


def _mean(values: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> float | None:
    known = np.isfinite(values)
    return float(np.average(values[known], weights=weights[known])) if known.any() else None


_STATES: Final = {"finished": COLOURS[2], "unfinished": COLOURS[5], "failed": COLOURS[1], "not run": COLOURS[6]}
"""Colours of the states on the map."""
_DEGREE_M: Final = math.pi / 180 * 6_371_008.8
"""Length (m) of a degree of a great circle on a sphere of the Earth's mean radius (Moritz 2000)."""
_MOST_SURVEYS: Final = 5_000
"""Rows that the page lists: a page of more than a megabyte opens slowly, and the table holds them all."""


def fleet_page(rows: Sequence[Row]) -> str:
    """Return the page of a catalogue's rows as HTML; the same rows give the same text."""
    ordered = sorted(rows, key=lambda row: str(row.values["survey"]))
    parts = [_map(ordered), _wrong(ordered), _years(ordered), _surveys(ordered)]
    km = sum(row.values.get("driven_km") or 0.0 for row in ordered)
    lead = f"{counted(len(rows), 'survey')}, {km:,.1f} km driven. Times are UTC; σ is one standard deviation."
    shown = [part for part in parts if part.blocks]
    return html_page("Road surveys", "Road surveys", lead, shown, "the records of the surveys' stores")


def _map(rows: Sequence[Row]) -> Part:
    """Return the outlines of the surveys on a map in which a length has one scale, that of the middle latitude."""
    placed = [row for row in rows if row.place is not None and not row.place.is_empty]
    if not placed:
        return Part("map", "Where", [])
    outlines = [shapely.get_coordinates(row.place) for row in placed]
    middle = math.radians(float(np.mean([outline[:, 1].mean() for outline in outlines])))
    turned = [outline * _DEGREE_M * (math.cos(middle), 1.0) for outline in outlines]
    page = MapPage.around(np.concatenate(turned))
    lines, marks = [], []
    for row, places_m in zip(placed, turned, strict=True):
        colour, on_page = _STATES[str(row.values["state"])], page.on_page(places_m)
        lines.append(Line(" ".join(f"{x:.1f},{y:.1f}" for x, y in on_page), colour))
        x, y = on_page.mean(axis=0)
        marks.append((float(x), float(y), str(row.values["survey"]), colour))
    shown = {str(row.values["state"]) for row in placed}
    legend = [(colour, state) for state, colour in _STATES.items() if state in shown]
    caption = "Hulls of the surveys' tiles; each point names its survey."
    without = len(rows) - len(placed)
    caption += f" Without a place on the map: {counted(without, 'survey')}." if without else ""
    drawing = Drawing(WIDTH, page.height, lines, marks=marks, scale_bar=page.scale_bar, legend=legend, caption=caption)
    return Part("map", "Where", [drawing])


def _wrong(rows: Sequence[Row]) -> Part:
    """Return the surveys that need somebody: those with notes, failures or damage, or not run to the end."""
    due = [
        row.values for row in rows if row.values["notes"] or row.values["failed"] or row.values["state"] != "finished"
    ]
    if not due:
        return Part("wrong", "What is wrong", [Paragraph("Nothing: each survey's last run finished.")])
    head = ("survey", "state", "failed", "damaged", "why")
    lines = [[str(one[name]) for name in ("survey", "state", "failed", "damaged", "notes")] for one in due]
    return Part("wrong", "What is wrong", [Table(head, lines, numbers=False, most_rows=_MOST_SURVEYS)])


def _years(rows: Sequence[Row]) -> Part:
    """Return lengths and condition of the network by year; a lane counts as often as it was driven."""
    years = sorted({int(row.values["year"]) for row in rows if row.values.get("year") is not None})
    lines = []
    for year in years:
        of_year = [row.values for row in rows if row.values.get("year") == year]
        lines.append(
            [
                str(year), str(len(of_year)), _sum(of_year, "driven_km"), _sum(of_year, "lane_km"),
                _mean_of(of_year, "mri_m_per_km", "mri_km", ".2f"),
                _mean_of(of_year, "rut_depth_mean_mm", "lane_km", ".1f"),
                _mean_of(of_year, "cracked_wheel_path_percent", "lane_km", ".1f"),
            ]
        )  # fmt: skip
    head = ("year", "surveys", "km driven", "lane km", "MRI (m/km)", "rut (mm)", "cracked (%)")
    caption = "Means are weighted by length. A lane that was driven twice in a year counts twice."
    blocks: list[Block] = [Table(head, lines, caption)] if lines else []
    return Part("years", "By year", blocks)


def _surveys(rows: Sequence[Row]) -> Part:
    figures = ("km", "lane km", "σ height (mm)", "MRI (m/km)")
    head = ("survey", "title", "state", "from", "rig", *figures, "version")
    lines = [
        [
            str(one["survey"]), str(one["title"]), str(one["state"]), _day(one.get("first_epoch_gps_ns")),
            str(one["rig"]), _shown(one.get("driven_km"), ",.2f"), _shown(one.get("lane_km"), ",.2f"),
            _shown(one.get("sigma_down_m"), ".1f", 1e3), _shown(one.get("mri_m_per_km"), ".2f"),
            str(one["version"]),
        ]
        for one in (row.values for row in rows)
    ]  # fmt: skip
    table = Table(head, lines, full_table="fleet", numbers=False, most_rows=_MOST_SURVEYS)
    return Part("surveys", "All surveys", [table] if lines else [])


def _day(epoch_gps_ns: int | None) -> str:
    return "" if epoch_gps_ns is None else iso_from_gps_ns(epoch_gps_ns)[:10]


def _shown(value: float | None, form: str, factor: float = 1.0) -> str:
    return "" if value is None else f"{value * factor:{form}}"


def _sum(rows: Sequence[dict[str, Any]], name: str) -> str:
    known = [float(row[name]) for row in rows if row.get(name) is not None]
    return f"{sum(known):,.2f}" if known else ""


def _mean_of(rows: Sequence[dict[str, Any]], name: str, weight: str, form: str) -> str:
    known = [(row[name], row[weight]) for row in rows if row.get(name) is not None and row.get(weight)]
    total = sum(length for _, length in known)
    return f"{sum(value * length for value, length in known) / total:{form}}" if total else ""
