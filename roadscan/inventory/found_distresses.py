"""Distresses of the pavement that a run found, as rows of their kinds in the inventory.

Tables of distresses have no heights: those come from overviews of the tiles, as do the inventory's other queries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import object_names
from roadscan.assets.tasks.tables import along_roads
from roadscan.assets.visibility import BANDS_M, PASSES
from roadscan.compute.array_types import Float64, Int64
from roadscan.condition.tasks.lines import survey_roads
from roadscan.core.errors import SchemaError
from roadscan.core.grid import QUANTA_PER_M, TileId
from roadscan.georeference.plan.plan import plan_of
from roadscan.inventory.state import reference_points
from roadscan.run.session import Session
from roadscan.store.asset_schema import AssetColumn, AssetSchema, asset_kind_names, asset_schema
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.tiles.mosaics.products import StoredTiles
from roadscan.tiles.product import ProductContext, TileSummary
from roadscan.tiles.products.geo_table import in_crs_unit, read_geo_table
from roadscan.tiles.pyramid import Level, overview_factors
from roadscan.tiles.tasks.tile_figures import summary_of
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE
from roadscan.tiles.tasks.wanted_products import product_context

NOT_KNOWN: Final = -1  # Passes where it is not known how many there were.
_HELD_SQUARES: Final = 4096
"""Squares kept in memory, some 50 kB each."""
_EDGE: Final = b"edge_m"


class Visibility(Protocol):
    """Passes of a survey that had places in sight."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes (n,) that should have seen assets of a kind, -1 where that is not known.

        Parameters
        ----------
        places_m : (n, 3) easting, northing, height of their reference points in the map (m).
        """


class Unknown:
    """A survey without such figures."""

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns -1 everywhere."""
        return np.full(len(places_m), NOT_KNOWN, dtype=np.int64)


class VisibilityGrid:
    """Passes by cell of a grid of the map and height above the ground; places in no cell were seen by none.

    A point asset reaches upwards: it was in sight if the band of its place was, or the band above. Of lines
    and areas the place itself counts.

    Parameters
    ----------
    cells : columns as the table `asset_visibility` has them; its metadata `edge_m` states the edge of a cell (m).

    Raises
    ------
    SchemaError
        where a column is missing, or the edge is not stated.
    """

    def __init__(self, cells: pa.Table) -> None:
        wanted = ("column", "row", "ground_height_m", *PASSES)
        missing = [name for name in wanted if name not in cells.column_names]
        edge = (cells.schema.metadata or {}).get(_EDGE)
        if missing or edge is None:
            lacks = f"has no column '{missing[0]}'" if missing else "does not state the edge of its cells (`edge_m`)"
            raise SchemaError(f"the table of visibility {lacks}", expected=", ".join(wanted))
        self.edge_m = float(edge)
        keys = _keys(*(np.asarray(cells[name].to_numpy(), np.int64) for name in ("column", "row")))
        order = np.argsort(keys)
        self._keys = keys[order]
        self._ground_m = cells["ground_height_m"].to_numpy()[order]
        passes = np.stack([np.asarray(cells[name].to_numpy(), np.int32) for name in PASSES], axis=1)
        self._passes = passes[order]

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes of the cells in which the places lie."""
        out = np.zeros(len(places_m), dtype=np.int64)
        cell = np.floor(places_m[:, :2] / self.edge_m).astype(np.int64)
        keys = _keys(cell[:, 0], cell[:, 1])
        at = np.minimum(np.searchsorted(self._keys, keys), max(self._keys.size - 1, 0))
        held = np.flatnonzero(self._keys[at] == keys) if self._keys.size else np.zeros(0, np.int64)
        at = at[held]
        above_m = places_m[held, 2] - self._ground_m[at]
        band = np.clip(np.searchsorted(BANDS_M, above_m, side="right") - 1, 0, len(PASSES) - 1)
        out[held] = self._passes[at, band]
        if asset_schema(kind).geometry == "PointZ":
            over = np.minimum(band + 1, len(PASSES) - 1)
            out[held] = np.maximum(out[held], self._passes[at, over])
        return out


class VisibilityOfSquares:
    """Passes of a survey whose squares are read one by one, on demand.

    Parameters
    ----------
    edge_m : edge of the squares (m).
    read : returns the cells of a square; None where no sensor looked there.
    """

    def __init__(self, edge_m: float, read: Callable[[TileId], pa.Table | None]) -> None:
        self._edge_m = edge_m

        @lru_cache(_HELD_SQUARES)
        def grid(square: TileId) -> VisibilityGrid | None:
            cells = read(square)
            return None if cells is None else VisibilityGrid(cells)

        self._grid = grid

    def expected_passes(self, kind: str, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Returns the passes of the cells in which the places lie; none where no sensor looked."""
        out = np.zeros(len(places_m), dtype=np.int64)
        of_place = np.floor(places_m[:, :2] / self._edge_m).astype(np.int64)
        squares, number = np.unique(of_place, axis=0, return_inverse=True)
        order = np.argsort(number.reshape(-1), kind="stable")
        ends = np.searchsorted(number.reshape(-1)[order], np.arange(len(squares) + 1))
        for at, (column, row) in enumerate(squares.tolist()):
            own = order[ends[at] : ends[at + 1]]
            grid = self._grid(TileId(column, row))
            if grid is not None:
                out[own] = grid.expected_passes(kind, places_m[own])
        return out


def _keys(column: npt.NDArray[np.int64], row: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Returns one number for each cell."""
    return np.asarray((row << 32) + column)


_PIXEL_M: Final = 0.04
"""Approximate edge of the pixels from which heights are taken (m)."""
_HELD_TILES: Final = 256  # Overviews of tiles kept in memory.


class FoundKind(NamedTuple):
    """Rows that a run found of one kind of distress."""

    kind: str
    rows: pa.Table
    """Columns as `asset_schema(kind).arrow()`."""
    records: Sequence[OutputRecord]
    """Files from which they were read."""


def found_distresses(session: Session) -> Iterator[FoundKind]:
    """Yields rows of each kind of distress that the survey was searched for."""
    searched = {kind: records for kind in asset_kind_names() if (records := _records(session, asset_schema(kind)))}
    if not searched:
        return
    ground = Ground(session)
    roads, _ = survey_roads(plan_of(session), session.manifest)
    for kind, records in searched.items():
        rows, shapes_m = _read(session, records, ground.context)
        yield FoundKind(kind, _Rows(asset_schema(kind), rows, ground.raised(shapes_m)).table(ground, roads), records)


def _records(session: Session, schema: AssetSchema) -> list[OutputRecord]:
    """Returns records of the table of a kind, by path; records without a file mean that nothing was found."""
    return sorted(session.manifest.of(schema.found_in).values(), key=lambda r: r.path) if schema.found_in else []


def _read(
    session: Session, records: Sequence[OutputRecord], context: ProductContext
) -> tuple[pa.Table, npt.NDArray[Any]]:
    parts = [read_geo_table(read_recorded(session.store, r), context) for r in records if r.path.endswith(".parquet")]
    if not parts:
        return pa.table({}), np.empty(0, object)
    rows = pa.concat_tables([rows.replace_schema_metadata(None) for rows, _ in parts], promote_options="permissive")
    return rows, np.concatenate([shapes for _, shapes in parts])


class Ground:
    """The ground that a survey measured, tile by tile."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.context = product_context(plan_of(session))
        cells = {r.unit: r for r in session.manifest.of(TILE).values() if r.path}
        overviews = [r for r in session.manifest.of(OVERVIEWS).values() if r.path and r.unit in cells]
        tiles = StoredTiles(
            session.store, list(cells.values()), [r for r in overviews if r.key == cells[r.unit].key], self.context
        )
        factors = overview_factors(self.context.grid.cells_per_edge) or (1,)
        self._factor = min(factors, key=lambda one: abs(math.log(one * self.context.grid.cell_m / _PIXEL_M)))
        self._records = cells
        self._level = lru_cache(_HELD_TILES)(lambda tile: tiles.overview(tile, self._factor))

    @cached_property
    def first_gps_ns(self) -> int:
        """Returns the GPS time (ns) at which the survey's first pass began."""
        return min((one.start_gps_ns for one in plan_of(self._session).passes), default=0)

    def summaries(self, places_m: Float64) -> list[TileSummary | None]:
        """Returns the figures of the tile of each place (n, 2); None where there are no readings."""
        found: list[TileSummary | None] = [None] * len(places_m)
        for tile, own, _ in self._by_tile(places_m):
            record = self._records.get(str(tile))
            one = None if record is None else summary_of(record)
            for at in own.tolist():
                found[at] = one
        return found

    def heights_m(self, places_m: Float64) -> Float64:
        """Returns heights (n,) at places (n, 2) on the map: of the pixel there, else of the nearest one in the tile.

        Where a tile has no readings, the height of the nearest other place that has one is used.
        """
        from scipy.spatial import cKDTree

        out = np.full(len(places_m), np.nan)
        for tile, own, pixel in self._by_tile(places_m):
            level = self._level(tile)
            if level is not None and len(level):
                place, is_there = _in_level(level, pixel)
                if not is_there.all():
                    tree = cKDTree(np.column_stack([level.column, level.row]))
                    place[~is_there] = tree.query(pixel[~is_there])[1]
                out[own] = level.height_m[place]
        known = np.isfinite(out)
        if known.any() and not known.all():
            out[~known] = out[known][cKDTree(places_m[known]).query(places_m[~known])[1]]
        return np.asarray(np.nan_to_num(out), dtype=np.float64)

    def is_surveyed(self, places_m: Float64) -> npt.NDArray[np.bool_]:
        """Returns a mask (n,) of the places (n, 2) with readings."""
        out = np.zeros(len(places_m), dtype=bool)
        for tile, own, pixel in self._by_tile(places_m):
            level = self._level(tile)
            if level is not None and len(level):
                out[own] = _in_level(level, pixel)[1]
        return out

    def raised(self, shapes_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Returns shapes (n,) raised to the height of the ground, all in the map (m)."""
        places = shapely.get_coordinates(shapes_m)
        if not len(places):
            return shapes_m
        raised = np.column_stack([places, self.heights_m(places)])
        return np.asarray(shapely.set_coordinates(shapely.force_3d(shapes_m), raised))

    def _by_tile(self, places_m: Float64) -> Iterator[tuple[TileId, Int64, Int64]]:
        """Yields each tile with the indices of its places and their pixels (n, 2), column and row."""
        grid = self.context.grid
        quanta = np.floor(places_m * QUANTA_PER_M).astype(np.int64)
        tiles, number = np.unique(quanta // grid.size_quanta, axis=0, return_inverse=True)
        order = np.argsort(number.reshape(-1), kind="stable")
        ends = np.searchsorted(number.reshape(-1)[order], np.arange(len(tiles) + 1))
        for at, (column, row) in enumerate(tiles.tolist()):
            own = order[ends[at] : ends[at + 1]]
            inside = quanta[own] - np.array([column, row]) * grid.size_quanta
            yield TileId(column, row), own, inside // (grid.cell_quanta * self._factor)


def _in_level(level: Level, pixel: Int64) -> tuple[Int64, npt.NDArray[np.bool_]]:
    """Returns positions of pixels (n, 2) in a level, and a mask of those with readings."""
    keys = level.row.astype(np.int64) << 32 | level.column
    wanted = pixel[:, 1] << 32 | pixel[:, 0]
    place = np.minimum(np.searchsorted(keys, wanted), keys.size - 1)
    return place, keys[place] == wanted


class SeenByCells:
    """Expected passes of a survey: of distresses by whether the ground there was measured, else by `assets`.

    Parameters
    ----------
    assets : expected passes of other kinds.
    """

    def __init__(self, session: Session, assets: Visibility) -> None:
        self._session = session
        self._assets = assets

    @cached_property
    def _ground(self) -> Ground:
        return Ground(self._session)

    def expected_passes(self, kind: str, places_m: Float64) -> Int64:
        """Returns the passes (n,) that should have seen assets of a kind; of distresses 1 where there are readings."""
        if not asset_schema(kind).found_in:
            return self._assets.expected_passes(kind, places_m)
        return self._ground.is_surveyed(places_m[:, :2]).astype(np.int64)


class _Rows:
    """Rows of a table of distresses that are converted to the columns of their kind."""

    def __init__(self, schema: AssetSchema, rows: pa.Table, shapes_m: npt.NDArray[Any]) -> None:
        self.schema = schema
        self.rows = rows
        self.shapes_m = _of_type(shapes_m, schema.geometry)

    def table(self, ground: Ground, roads: Any) -> pa.Table:
        """Returns columns as `asset_schema(kind).arrow()`."""
        places = reference_points(self.shapes_m) if len(self.shapes_m) else np.empty((0, 3))
        along = along_roads(places[:, :2], roads)
        tiles = ground.summaries(places[:, :2])
        least_m, first = ground.context.grid.cell_m / math.sqrt(12.0), ground.first_gps_ns
        known = [t or TileSummary.without_readings(TileId(0, 0)) for t in tiles]
        columns: dict[str, Any] = {
            "object": object_names(self.schema.kind, places[:, :2]),
            "easting_m": places[:, 0],
            "northing_m": places[:, 1],
            "height_m": places[:, 2],
            "sigma_horizontal_m": [math.hypot(t.sigma_horizontal_m or 0.0, least_m) for t in known],
            "sigma_height_m": [math.hypot(t.sigma_down_m or 0.0, least_m) for t in known],
            "passes": [len(t.passes) for t in known],
            "first_epoch_gps_ns": [t.first_epoch_gps_ns or first for t in known],
            "last_epoch_gps_ns": [t.last_epoch_gps_ns or first for t in known],
            "road": along.road,
            "station_m": [None if math.isnan(s) else s for s in along.station_m.tolist()],
            "offset_m": [None if math.isnan(o) else o for o in along.offset_m.tolist()],
            "lane": along.lane,
            "geometry": shapely.to_wkb(in_crs_unit(self.shapes_m, ground.context), flavor="iso"),
        }
        columns |= {one.name: self._own(one) for one in self.schema.own}
        nothing = [None] * len(self.shapes_m)
        arrow = self.schema.arrow()
        arrays = [pa.array(columns.get(f.name, nothing), f.type, from_pandas=True) for f in arrow]
        return pa.Table.from_arrays(arrays, schema=arrow)

    def _own(self, column: AssetColumn) -> Any:
        """Returns the values of a column of the kind: those of the table, or the class that another column gives."""
        name = column.class_of or column.name
        if name not in self.rows.column_names:
            return [None] * len(self.shapes_m)
        if not column.class_of:
            return self.rows[name].to_pandas()
        values = self.rows[name].to_numpy()
        classes = np.array(column.values, object)[np.searchsorted(column.up_to, values)]
        return np.where(np.isnan(values), None, classes)


def _of_type(shapes: npt.NDArray[Any], geometry: str) -> npt.NDArray[Any]:
    """Returns shapes of the type that a schema names: single ones are made multi-part where it says so."""
    single = geometry.removeprefix("Multi").removesuffix("Z")
    if single == geometry.removesuffix("Z"):
        return shapes
    make = {"LineString": shapely.MultiLineString, "Polygon": shapely.MultiPolygon}[single]
    out = np.empty(len(shapes), object)
    out[:] = [make([one]) if one.geom_type == single else one for one in shapes]
    return out
