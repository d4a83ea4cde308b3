"""Writes the section table, a row for each section and lane, as GeoParquet, CSV and GeoPackage."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import shapely

from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.tasks.lines import Roads
from roadscan.condition.tasks.values import VALUES
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import in_crs_unit, write_geo_table

if TYPE_CHECKING:
    import pandas as pd


_WRITTEN: Final = "2000-01-01T00:00:00.000Z"
"""Date of change that a GeoPackage has to state: constant, so that equal tables give equal bytes."""


def write_layer(path: Path, table: pa.Table, shapes_m: npt.NDArray[Any], context: ProductContext) -> None:
    """Write rows with their lines (n,) on the map (m) as one layer, named as the file, in the CRS's unit."""
    import pyogrio  # slow to import

    shapes = in_crs_unit(shapes_m, context)
    frame = table.to_pandas()
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapes),
        field_data=[frame[name].to_numpy() for name in frame.columns],
        fields=list(frame.columns),
        layer=path.stem,
        driver="GPKG",
        geometry_type="LineString",
        crs=context.map.crs,
    )
    with sqlite3.connect(path) as file:
        file.execute("UPDATE gpkg_contents SET last_change = ?", (_WRITTEN,))
    file.close()


SECTIONS: Final = "condition_sections"
_TABLE: Final = f"{SECTIONS}.parquet"
_ROW: Final = ["road", "lane", "station_from_m", "station_to_m"]
_SIGMAS: Final = {
    "sigma_mri_m_per_km": ("mri_m_per_km",),
    "sigma_ride_number": ("ride_number",),
    "sigma_psd_worse_cm3": ("psd_worse_cm3",),
    "sigma_rut_depth_mean_mm": ("rut_depth_mean_left_mm", "rut_depth_mean_right_mm"),
    "sigma_cross_slope_mean_percent": ("cross_slope_mean_percent",),
    "sigma_faulting_mean_mm": ("faulting_mean_mm",),
    "sigma_mpd_mean_mm": ("mpd_mean_mm",),
    "sigma_texture_rms_mean_mm": ("texture_rms_mean_mm",),
    "sigma_ravelled_percent": ("ravelled_percent",),
    "sigma_lane_width_m": ("lane_width_m",),
}
"""Columns of standard deviations, with the quantities whose greatest σ each contains."""
_SAID: Final = {"lane_width_from": "lane_width_m", "iso_8608_class": "psd_worse_cm3"}
"""Columns with the remark of a quantity: the origin of its value, or its class."""
_MAIN: Final = ("mri_m_per_km", "rut_depth_mean_left_mm", "rut_depth_mean_right_mm", "cross_slope_mean_percent")
"""Quantities whose measured share is in the row."""


@dataclass(frozen=True, eq=False)
class SectionFiles:
    """Inputs of the section table."""

    store: Store
    context: ProductContext
    roads: Roads
    values: tuple[OutputRecord, ...]
    key: str


def plan_sections(
    store: Store, manifest: Manifest, roads: Roads, units: Sequence[str], context: ProductContext
) -> SectionFiles:
    """Return the files of the section table, from the values of these units."""
    held = manifest.of(VALUES)
    values = tuple(held[u] for u in sorted(units) if u in held)
    code = code_digest("roadscan.condition.tasks.sections:write_sections")
    named = [[line.road, line.name, line.measure_from, line.measure_per_m] for line in roads.lines.values()]
    key = key_of(code, [(r.unit, r.digest) for r in values], named, context.map, context.survey_id)
    return SectionFiles(store, context, roads, values, key)


def due_files(files: SectionFiles, manifest: Manifest) -> list[str]:
    """Return names of the files that are missing or stale."""
    return [name for name in _WRITERS if not manifest.is_current(SECTIONS, name, files.key)]


def write_sections(files: SectionFiles) -> list[OutputRecord]:
    """Write all files of the section table."""
    table, shapes = section_table(files)
    detail = json.dumps(
        {"sections": table.num_rows, "not_measured": _not_measured(_of_sections(files))}, sort_keys=True
    )
    records: list[OutputRecord] = []
    with files.store.scratch() as folder:
        for name, write in _WRITERS.items():
            path = folder / name
            write(path, table, shapes, files.context)
            size, digest, target = path.stat().st_size, file_digest(path), f"products/{SECTIONS}/{name}"
            files.store.publish(path, target)
            records.append(OutputRecord(SECTIONS, name, files.key, target, size, digest, detail))
    return records


def section_table(files: SectionFiles) -> tuple[pa.Table, npt.NDArray[Any]]:
    """Return rows of ``schemas/condition_sections.toml``, and the middle of the lane along each (m)."""
    long = _of_sections(files)
    schema = table_schema(SECTIONS).arrow()
    if not long.num_rows:
        return schema.empty_table(), np.empty(0, object)
    frame = long.to_pandas()
    grouped = frame.groupby(_ROW, sort=True)
    wide = frame.pivot(index=_ROW, columns="quantity", values="value").sort_index()
    sigma = frame.pivot(index=_ROW, columns="quantity", values="sigma").sort_index()
    rows = wide.reset_index()
    for name, of in _SIGMAS.items():
        known = [q for q in of if q in sigma]
        rows[name] = sigma[known].max(axis=1).to_numpy() if known else np.nan
    for name, quantity in _SAID.items():
        said = frame[(frame["quantity"] == quantity) & frame["value"].notna()].set_index(_ROW)["reason"]
        rows[name] = said.reindex(wide.index).to_numpy()
    main = frame[frame["quantity"].isin(_MAIN)]
    share = main.groupby(_ROW, sort=True)["share"].min()
    rows["share_measured"] = share.reindex(wide.index).fillna(0.0).to_numpy()
    rows["reason"] = grouped.apply(_reasons, include_groups=False).reindex(wide.index).to_numpy()
    lanes = {(lane.road, lane.name): lane for lane in files.roads.lanes}
    of_row = [lanes[road, lane] for road, lane in zip(rows["road"], rows["lane"], strict=True)]
    lines = [files.roads.lines[lane.road] for lane in of_row]
    rows["name"] = [line.name for line in lines]
    rows["direction"] = [lane.direction for lane in of_row]
    for end in ("from", "to"):
        stations = rows[f"station_{end}_m"].to_numpy()
        rows[f"measure_{end}"] = [float(line.measures(s)) for line, s in zip(lines, stations, strict=True)]
    shapes = [
        _middle(line, lane, a, b)
        for line, lane, a, b in zip(lines, of_row, rows["station_from_m"], rows["station_to_m"], strict=True)
    ]
    return _typed(rows, schema), np.array([*shapes, None], object)[:-1]


def _of_sections(files: SectionFiles) -> pa.Table:
    schema = table_schema(VALUES).arrow()
    parts = [recorded_table(files.store, r).cast(schema) for r in files.values]
    held = [p.filter(pc.equal(p["extent"], "section")) for p in parts]
    return pa.concat_tables([schema.empty_table(), *held])


def _not_measured(values: pa.Table) -> dict[str, list[str]]:
    """Return quantities without a value in any section, by the most frequent reason."""
    known = set(values.filter(pc.is_valid(values["value"]))["quantity"].to_pylist())
    reasons: dict[str, list[str]] = {}
    for quantity, reason in zip(values["quantity"].to_pylist(), values["reason"].to_pylist(), strict=True):
        if quantity not in known and reason:
            reasons.setdefault(quantity, []).append(reason)
    found: dict[str, list[str]] = {}
    for quantity, said in sorted(reasons.items()):
        found.setdefault(max(sorted(set(said)), key=said.count), []).append(quantity)
    return found


def known_sections(manifest: Manifest) -> tuple[int, dict[str, list[str]]] | None:
    """Return the number of sections in the table, and the quantities that none has, by reason; None without a table."""
    record = manifest.get(SECTIONS, _TABLE)
    if record is None or not record.detail:
        return None
    told = record.figures()
    return int(told["sections"]), dict(told["not_measured"])


def _reasons(own: pd.DataFrame) -> str | None:
    """Return remarks on a section's values, each once."""
    said: dict[str, list[str]] = {}
    for quantity, value, reason in zip(own["quantity"], own["value"], own["reason"], strict=True):
        if isinstance(reason, str) and (quantity not in _SAID.values() or np.isnan(value)):
            said.setdefault(reason, []).append(quantity)
    return "; ".join(f"{', '.join(names)}: {reason}" for reason, names in said.items()) or None


def _middle(line: RoadLine, lane: Lane, from_m: float, to_m: float) -> shapely.LineString:
    station = np.unique(np.concatenate([[from_m, to_m], np.arange(np.ceil(from_m), to_m)]))
    places = line.places(station, lane.offsets(station))[:: lane.sign, :2]
    return shapely.LineString(places)


def _typed(rows: pd.DataFrame, schema: pa.Schema) -> pa.Table:
    """Return columns of the schema in order, then those that other packages add."""
    import pandas as pd  # slow to import

    columns: dict[str, pa.Array] = {}
    for field in schema:
        values = rows[field.name] if field.name in rows else pd.Series([None] * len(rows), dtype=object)
        columns[field.name] = pa.array(values, field.type, from_pandas=True)
    table = pa.table(columns, schema=schema)
    for name in sorted(set(rows.columns) - set(schema.names)):
        table = table.append_column(name, pa.array(rows[name], pa.float64(), from_pandas=True))
    return table


def _write_parquet(path: Path, table: pa.Table, shapes: npt.NDArray[Any], context: ProductContext) -> None:
    write_geo_table(path, table, "line", shapes, ["LineString"], context)


def _write_csv(path: Path, table: pa.Table, shapes: npt.NDArray[Any], context: ProductContext) -> None:
    pa_csv.write_csv(table, path)


_WRITERS: Final[dict[str, Callable[[Path, pa.Table, npt.NDArray[Any], ProductContext], None]]] = {
    _TABLE: _write_parquet,
    f"{SECTIONS}.csv": _write_csv,
    f"{SECTIONS}.gpkg": write_layer,
}
"""Functions that write the files, by name."""
