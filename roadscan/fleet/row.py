"""The row of a survey in the catalogue of its fleet, from the records and small tables of its store."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from roadscan import __version__
from roadscan.core.errors import DamagedError, RoadscanError, StoreError
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.fleet.members import Found
from roadscan.run.engine.fingerprint import key_of
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
