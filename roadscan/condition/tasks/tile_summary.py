"""Writes the table of condition by tile: a row for each tile, with values of the lanes in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.tasks.lines import LANES, LINES
from roadscan.condition.tasks.sections import SectionFiles
from roadscan.condition.tasks.values import VALUES
from roadscan.core.ids import TileId
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.tiles.products.geo_table import write_geo_table

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
    code = code_digest("roadscan.condition.tasks.tile_summary:write_tiles")
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
