"""Writes the section table, a row for each section and lane, as GeoParquet, CSV and GeoPackage."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import shapely

from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.condition.tasks.lines import LANES, LINES
from roadscan.condition.tasks.values import VALUES
from roadscan.core.grid import TileId
from roadscan.run.keys import code_digest, key_of
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


TILES: Final = "condition_tiles"
_FILE: Final = f"{TILES}.parquet"
_PER_M: Final = 2
"""Places of a lane's middle that are counted per metre."""
_RUTS: Final = ("rut_depth_left_mm", "rut_depth_right_mm")
_MEANS: Final = {
    "mri_m_per_km": "mri_m_per_km", "ride_number": "ride_number",
    "cracked_wheel_path_percent": "cracked_wheel_path_percent", "mpd_mean_mm": "mpd_mean_mm",
    "texture_rms_mean_mm": "texture_rms_mean_mm", "ravelled_percent": "ravelled_percent",
}  # fmt: skip
"""Columns that are means of a quantity of sections, weighted by their length in the tile."""
_GREATEST: Final = {"mri_max_m_per_km": "mri_m_per_km", "faulting_max_mm": "faulting_max_mm"}
"""Columns that are the greatest value of a quantity."""


def due_tiles(files: SectionFiles, manifest: Manifest) -> str:
    """Return the key of the table where it is missing or stale, else an empty string."""
    code = code_digest("roadscan.condition.tasks.sections:write_tiles")
    placed = [(r.unit, r.digest) for name in (LINES, LANES) for r in manifest.of(name).values()]
    key = key_of(code, files.key, sorted(placed), files.context.grid)
    return "" if manifest.is_current(TILES, _FILE, key) else key


def write_tiles(files: SectionFiles, key: str) -> OutputRecord:
    """Write the table."""
    rows = tile_rows(files)
    schema, target = table_schema(TILES), f"products/{TILES}/{_FILE}"
    table = pa.Table.from_pylist([row for row, _ in rows], schema.arrow())
    shapes = np.array([*(shape for _, shape in rows), None], object)[:-1]
    with files.store.scratch() as folder:
        path = folder / _FILE
        write_geo_table(path, table, "outline", shapes, ["Polygon"], files.context, counterclockwise=True)
        size, digest = path.stat().st_size, file_digest(path)
        files.store.publish(path, target)
    return OutputRecord(TILES, _FILE, key, target, size, digest)


def tile_rows(files: SectionFiles) -> list[tuple[dict[str, Any], shapely.Polygon]]:
    """Return rows of ``schemas/condition_tiles.toml`` with their outlines, by row and column of the grid."""
    grid = files.context.grid
    found: dict[TileId, _Sums] = {}
    ways = {(lane.road, lane.name): _Way.of(files.roads.lines[lane.road], lane, files) for lane in files.roads.lanes}
    for name, way in ways.items():
        for tile, count in way.counts(slice(None)):
            own = found.setdefault(tile, _Sums())
            own.lanes.add(name)
            own.places += count
    for road, lane, rows in _values(files):
        _add(found, ways[road, lane], rows)
    ordered = sorted(found.items(), key=lambda one: (one[0].row, one[0].column))
    made = []
    for tile, sums in ordered:
        b = grid.bounds(tile)
        place = {"tile": str(tile), "easting_m": b.easting_min_m, "northing_m": b.northing_min_m}
        outline = shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m)
        made.append((place | sums.row(), outline))
    return made


@dataclass(frozen=True, eq=False)
class _Way:
    """Places of a lane's middle, and the tiles that contain them."""

    station_m: npt.NDArray[np.float64]
    tile: npt.NDArray[np.int64]
    """(n, 2) column and row."""

    @classmethod
    def of(cls, line: RoadLine, lane: Lane, files: SectionFiles) -> _Way:
        station = (np.arange(lane.first_m * _PER_M, lane.last_m * _PER_M, dtype=np.float64) + 0.5) / _PER_M
        places = line.places(station, lane.offsets(station))[:, :2]
        return cls(station, np.floor(places / files.context.grid.size_m).astype(np.int64))

    def counts(self, own: slice) -> Iterator[tuple[TileId, int]]:
        """Return the tiles of some of the places, with their number."""
        tiles, counts = np.unique(self.tile[own], axis=0, return_counts=True)
        for (column, row), count in zip(tiles.tolist(), counts.tolist(), strict=True):
            yield TileId(column, row), count


class _Sums:
    """Sums over a tile."""

    def __init__(self) -> None:
        self.lanes: set[tuple[str, str]] = set()
        self.places = 0
        self.weighed: dict[str, npt.NDArray[np.float64]] = {}
        """Weight, weight · value, weight · variance of a quantity."""
        self.greatest: dict[str, float] = {}
        self.share = [0.0, 0]

    def add(self, quantity: str, weight: float, value: float, sigma: float) -> None:
        """Add a value."""
        sums = self.weighed.setdefault(quantity, np.zeros(3))
        sums += weight * np.array([1.0, value, sigma * sigma])
        self.greatest[quantity] = max(self.greatest.get(quantity, value), value)

    def row(self) -> dict[str, Any]:
        """Return its columns."""
        row: dict[str, Any] = {
            "lanes": len(self.lanes),
            "lane_length_m": self.places / _PER_M,
            "share_measured": self.share[0] / self.share[1] if self.share[1] else 0.0,
        }
        row |= {name: self._mean(quantity) for name, quantity in _MEANS.items()}
        row |= {name: self.greatest.get(quantity) for name, quantity in _GREATEST.items()}
        row |= {"rut_depth_mean_mm": self._mean("ruts"), "rut_depth_max_mm": self.greatest.get("ruts")}
        row |= {"sigma_mri_m_per_km": self._sigma("mri_m_per_km"), "sigma_rut_depth_mean_mm": self._sigma("ruts")}
        return row

    def _mean(self, quantity: str) -> float | None:
        held = self.weighed.get(quantity)
        return None if held is None else float(held[1] / held[0])

    def _sigma(self, quantity: str) -> float | None:
        """Return the root mean square: errors along a road are taken as fully correlated."""
        held = self.weighed.get(quantity)
        return None if held is None or np.isnan(held[2]) else float(np.sqrt(held[2] / held[0]))


def _values(files: SectionFiles) -> Iterator[tuple[str, str, Sequence[Mapping[str, Any]]]]:
    """Yield the values for the table, one file at a time, with their road and lane."""
    wanted = pa.array(sorted({*_MEANS.values(), *_GREATEST.values(), *_RUTS}))
    for record in files.values:
        table = recorded_table(files.store, record)
        rows = table.filter(pc.is_in(table["quantity"], wanted))
        rows = rows.cast(pa.schema([table_schema(VALUES).arrow().field(n) for n in rows.column_names]))
        if rows.num_rows:
            yield rows["road"][0].as_py(), rows["lane"][0].as_py(), rows.to_pylist()


def _add(found: Mapping[TileId, _Sums], way: _Way, rows: Sequence[Mapping[str, Any]]) -> None:
    for row in rows:
        value, sigma = row["value"], np.nan if row["sigma"] is None else row["sigma"]
        if row["extent"] == "section":
            if value is not None:
                own = slice(*np.searchsorted(way.station_m, (row["station_from_m"], row["station_to_m"])).tolist())
                for tile, count in way.counts(own):
                    found[tile].add(row["quantity"], count, value, sigma)
            continue
        place = min(int(np.searchsorted(way.station_m, row["station_from_m"])), way.station_m.size - 1)
        sums = found[TileId(*way.tile[place].tolist())]
        sums.share = [sums.share[0] + row["share"], sums.share[1] + 1]
        if value is not None:
            sums.add("ruts", 1.0, value, sigma)
