"""Extracts parts of a survey as arrays: poses on the map, cells as a grid, points of a tile; and tables of one log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.extras import needed
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rotation_from_quaternion, rph_from_rotation
from roadscan.core.grid import Bounds, TileId
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of, trajectory_source
from roadscan.ingest.reading.format import LogFormat, LogSource, Reject
from roadscan.navigation.tasks.navigate import records_of
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.run.session import Session
from roadscan.store.schema import table_schema
from roadscan.tiles.cells import read_cells
from roadscan.tiles.tasks.tile_plan import TILE, Block, TilePlan, tiles_of
from roadscan.tiles.tasks.tile_points import load_points
from roadscan.tiles.tasks.wanted_products import product_context

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


_MOST_CELLS: Final = 400_000_000  # larger grids are refused
_RASTERS: Final = {"height_m": "height_robust_m", "intensity": "intensity_mean", "count": "count"}


def poses_on_map(session: Session, run: str, first_gps_ns: int | None, end_gps_ns: int | None) -> pd.DataFrame:
    """Return poses of a run at the knots of its trajectory, indexed by `epoch_gps_ns`, as they place readings.

    Columns: easting_m, northing_m, height_m on the map; roll_deg, pitch_deg, heading_deg of the body (x forward,
    y right, z down) against north, east, down of the place, in a local world against y, x, −z; sigma_north_m,
    sigma_east_m, sigma_down_m (1 σ, NaN where not known).
    """
    import pandas as pd

    source, ground = trajectory_source(run, records_of(session)), plan_of(session).ground
    held = [f.span for f in source.files if f.span is not None]
    first = max(min(s[0] for s in held), first_gps_ns if first_gps_ns is not None else 0)
    last = min(max(s[1] for s in held), end_gps_ns - 1 if end_gps_ns is not None else 2**62)
    poses = load_trajectory(session.store, source, [(first, last)], ground.max_gap_s)
    own = (poses.epochs_gps_ns >= first) & (poses.epochs_gps_ns <= last)
    world, rotation = poses.position_world_m[own], rotation_from_quaternion(poses.quaternion_world_from_body[own])
    place = ground.map.map_from_world(poses.world, world)
    angles = np.degrees(np.stack(rph_from_rotation(_level_from_world(poses.world, world) @ rotation), axis=-1))
    sigma = np.full((len(world), 3), np.nan) if poses.sigma_ned_m is None else poses.sigma_ned_m[own]
    names = ["easting_m", "northing_m", "height_m", "roll_deg", "pitch_deg", "heading_deg"]
    names += ["sigma_north_m", "sigma_east_m", "sigma_down_m"]
    angles[:, 2] %= 360.0
    index = pd.Index(poses.epochs_gps_ns[own], name="epoch_gps_ns")
    return pd.DataFrame(np.column_stack([place, angles, sigma]), index=index, columns=names)


def _level_from_world(world: str, position_world_m: Float64) -> Float64:
    """Return (n, 3, 3) rotations to north, east, down of each place; in a local world to y, x, −z."""
    if world == LOCAL_WORLD:
        return np.broadcast_to(ENU_FROM_NED.T, (len(position_world_m), 3, 3))
    lon_lat = np.radians(geodetic_from_world(world, position_world_m)[:, :2])
    return ecef_from_ned(lon_lat[:, 1], lon_lat[:, 0]).transpose(0, 2, 1)


def cell_grid(session: Session, box: Bounds | None, tile: str | None) -> xr.Dataset:
    """Return cells of the survey, of a box on the map (m) or of one tile, over `y` and `x` (centres, m, ascending).

    Variables: height_m (robust height, NaN where no reading lies), intensity (mean), count.

    Raises
    ------
    ConfigError
        where there are no cells, or more than 400 million places for them.
    """
    xarray: Any = needed("xarray", "a dataset of cells")
    grid = plan_of(session).ground.grid
    records = {TileId.parse(unit): r for unit, r in session.manifest.of(TILE).items() if r.path}
    if tile is not None:
        chosen = {t for t in records if str(t) == tile}
        if not chosen:
            raise ConfigError(
                f"tile {tile} holds no cells{nearest(tile, map(str, records))}", expected="a finished tile"
            )
    else:
        chosen = {t for t in records if box is None or grid.bounds(t).meets(box)}
    if not chosen:
        raise ConfigError("no finished tile lies there", expected="a box that touches a tile (table `tiles`)")
    edge, cell_m = grid.cells_per_edge, grid.cell_m
    first = TileId(min(t.column for t in chosen), min(t.row for t in chosen))
    last = TileId(max(t.column for t in chosen), max(t.row for t in chosen))
    rows, columns = (last.row - first.row + 1) * edge, (last.column - first.column + 1) * edge
    if rows * columns > _MOST_CELLS:
        raise ConfigError(
            f"the part has {rows:,} × {columns:,} places for cells", expected=f"at most {_MOST_CELLS:,}: a smaller bbox"
        )
    images = {name: np.full((rows, columns), 0 if name == "count" else np.nan, np.float32) for name in _RASTERS}
    for one in chosen:
        cells = read_cells(session.store, records[one], edge)
        at = ((one.row - first.row) * edge + cells.row.astype(np.int64),
              (one.column - first.column) * edge + cells.column.astype(np.int64))  # fmt: skip
        for name, column in _RASTERS.items():
            images[name][at] = getattr(cells, column)
    corner = grid.bounds(first)
    x = corner.easting_min_m + (np.arange(columns) + 0.5) * cell_m
    y = corner.northing_min_m + (np.arange(rows) + 0.5) * cell_m
    data: xr.Dataset = xarray.Dataset(
        {name: (("y", "x"), image) for name, image in images.items()}, {"y": y, "x": x},
        {"crs": session.survey.config.map.crs or LOCAL_WORLD, "cell_m": cell_m},
    )  # fmt: skip
    if box is None:
        return data
    return data.sel(x=slice(box.easting_min_m, box.easting_max_m), y=slice(box.northing_min_m, box.northing_max_m))


def points_of_tile(session: Session, tile: str) -> pd.DataFrame:
    """Return points of a tile, computed from the raw readings: position, epoch, intensity, class and pass of each.

    Raises
    ------
    ConfigError
        where no reading touches the tile.
    """
    import pandas as pd

    wanted, grid = TileId.parse(tile), plan_of(session).ground.grid
    if wanted not in tiles_of(session):
        raise ConfigError(f"no reading touches tile {tile}", expected="a tile of the survey (see the tile table)")
    planned = TilePlan(
        plan_of(session), footprints_of(session), tiles_of(session), (), product_context(plan_of(session))
    )
    found = [points for one, points in load_points(planned.task(Block((wanted,)))) if one == wanted]
    columns = ["easting_m", "northing_m", "height_m", "epoch_gps_ns", "intensity", "classification", "pass_id"]
    if not found:
        return pd.DataFrame({name: [] for name in columns})
    (points,), corner = found, grid.bounds(wanted)
    metres = [points.x_quanta * 1e-5 + corner.easting_min_m, points.y_quanta * 1e-5 + corner.northing_min_m]
    values = [*metres, points.height_quanta * 1e-5, *(getattr(points, name) for name in columns[3:])]
    return pd.DataFrame(dict(zip(columns, values, strict=True)) | points.extra)


def read_tables(
    log_format: LogFormat, source: LogSource
) -> tuple[dict[str, pa.Table], dict[str, Any], list[Reject], list[Finding]]:
    """Return a log's tables by name, the attributes of its rows, its rejects, and its findings.

    Rows that break a rule of their schema are rejects, as at ingest.
    """
    header = log_format.header(source)
    parts: dict[str, list[pa.RecordBatch]] = {}
    rejects: list[Reject] = []
    findings: list[Finding] = []
    for item in log_format.read(source, header):
        if isinstance(item, Reject):
            rejects.append(item)
            continue
        if isinstance(item, Finding):
            findings.append(item)
            continue
        schema = table_schema(item.table)
        batch = schema.conform(item.batch, header.list_size)
        sound = np.ones(batch.num_rows, bool)
        for rows, reason in schema.faults(batch):
            sound[rows] = False
            rejects += [Reject(reason, item.first_record + int(row), file=item.file) for row in rows]
        parts.setdefault(item.table, []).append(batch.filter(pa.array(sound)))
    tables = {name: pa.Table.from_batches(batches) for name, batches in parts.items()}
    return tables, dict(header.attributes), rejects, findings
