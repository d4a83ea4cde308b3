"""Exports heights of a pass as an OpenCRG grid."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan import __version__
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.kernels.curved_grid import accumulate_curved
from roadscan.compute.reference_line import ReferenceLine
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.grid import QUANTUM_M, LanePass
from roadscan.core.survey import Survey
from roadscan.export.export import Exported, published, source_in
from roadscan.formats.clouds.opencrg_file import CurvedRegularGrid, write_crg
from roadscan.formats.clouds.opencrg_header import encoding_named
from roadscan.georeference.place import EVERYWHERE
from roadscan.georeference.plan.plan import SurveyPlan, plan_survey
from roadscan.georeference.sources import Georeferencer, RawSlice, ReadingSource
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.store.logs import DataFile
from roadscan.store.store import Store

_MOST_NODES: Final = 1 << 28  # larger grids are refused


@dataclass(frozen=True)
class CrgSettings:
    """Settings of an OpenCRG grid of a pass."""

    pass_id: int | None = None
    """Pass; not needed where the run has only one."""
    u_step_m: float = 0.05
    """Distance from row to row (m)."""
    v_step_m: float = 0.05
    """Distance from column to column."""
    left_m: float = 2.0
    """Reach of the grid to the left of the vehicle's path."""
    right_m: float = 2.0
    """Reach of the grid to its right."""
    smoothing_m: float = 10.0
    """Length over which the path is smoothed into the reference line."""
    hole_m: float = 0.25
    """Longest hole that is closed by straight lines between its neighbours."""
    encoding: str = "KRBI"
    """KRBI, KDBI, LRFI or LDFI."""


def export_opencrg(
    survey: Survey, store: Store, run: str, sensor: str, out: Path, settings: CrgSettings = CrgSettings()
) -> Exported:
    """Write the heights that a sensor measured in a pass as one OpenCRG grid along the vehicle's smoothed path.

    Points are placed as for tiles, and averaged at the node nearest to them.

    Raises
    ------
    ConfigError
        if run, sensor or pass are unknown, a step is not above 0, or `out` is not empty.
    RunError
        if no point falls into the grid.
    """
    columns, encoding = _columns(settings), encoding_named(settings.encoding)
    plan = plan_survey(survey, store)
    source, files = source_in(plan, run, sensor)
    lane_pass = _pass(plan, run, settings.pass_id)
    if source.trajectory is None:
        raise ConfigError(
            f"'{sensor}' in run '{run}' is a cloud without a trajectory", expected="a profiler or lidar of the rig"
        )
    line, knots_gps_ns, steps = _driven_line(plan, source, lane_pass, settings)
    first = -math.floor(settings.right_m / settings.v_step_m + 1e-9) * settings.v_step_m
    if len(line.vertices_m) * columns > _MOST_NODES:
        raise ConfigError(
            f"the grid would have {len(line.vertices_m):,} × {columns:,} nodes",
            expected=f"at most {_MOST_NODES:,}",
            change="widen the steps, or cut the pass",
        )
    sums = CurvedHeights(line, first, settings.v_step_m, columns)
    with published(out) as folder:
        points = 0
        for epochs, easting, northing, quanta in _placed(plan, source, files, lane_pass):
            near = steps[np.clip(np.searchsorted(knots_gps_ns, epochs), 0, steps.size - 1)]
            points += epochs.size - sums.add(easting, northing, quanta, near)
        if not points:
            raise RunError(f"no point of '{sensor}' in pass {lane_pass.pass_id} falls into the grid")
        grid, notes = _grid(sums, settings, _comments(plan, source, lane_pass))
        name = f"{run}_{sensor}_pass{lane_pass.pass_id}.crg"
        write_crg(grid, folder / name, encoding)
    return Exported((out / name,), (f"{points:,} points at {grid.rows:,} × {grid.v_m.size:,} nodes", *notes))


def _columns(settings: CrgSettings) -> int:
    s = settings
    if not (s.u_step_m > 0 and s.v_step_m > 0 and s.left_m + s.right_m >= s.v_step_m and s.hole_m >= 0):
        raise ConfigError(
            f"steps of {s.u_step_m:g} × {s.v_step_m:g} m, reach {s.left_m:g} + {s.right_m:g} m, holes {s.hole_m:g} m",
            expected="steps above 0, two columns or more, and no negative hole",
        )
    return math.floor(s.right_m / s.v_step_m + 1e-9) + math.floor(s.left_m / s.v_step_m + 1e-9) + 1


def _pass(plan: SurveyPlan, run: str, pass_id: int | None) -> LanePass:
    of_run = [p for p in plan.passes if p.run == run]
    chosen = [p for p in of_run if pass_id in {None, int(p.pass_id)}]
    if len(chosen) != 1:
        raise ConfigError(
            f"run '{run}' has {len(of_run)} passes" if pass_id is None else f"run '{run}' has no pass {pass_id}",
            expected="--pass, one of " + ", ".join(str(p.pass_id) for p in of_run),
        )
    return chosen[0]


def _driven_line(
    plan: SurveyPlan, source: ReadingSource, lane_pass: LanePass, settings: CrgSettings
) -> tuple[ReferenceLine, Int64, Int64]:
    """Return a pass's reference line, the trajectory's epochs in it (k,), and the line's step beside each of them."""
    if source.trajectory is None:
        raise ConfigError(f"run '{source.run}' has no trajectory")
    span = (lane_pass.start_gps_ns, lane_pass.end_gps_ns)
    trajectory = load_trajectory(plan.store, source.trajectory, [span], plan.ground.max_gap_s)
    inside = (trajectory.epochs_gps_ns >= span[0]) & (trajectory.epochs_gps_ns < span[1])
    if not inside.any():
        raise RunError(f"the trajectory has no pose in pass {lane_pass.pass_id}")
    enh = plan.ground.map.map_from_world(trajectory.world, trajectory.position_world_m[inside])
    line, steps = ReferenceLine.smoothed(np.ascontiguousarray(enh[:, :2]), settings.u_step_m, settings.smoothing_m)
    return line, trajectory.epochs_gps_ns[inside], steps


def _placed(
    plan: SurveyPlan, source: ReadingSource, files: list[DataFile], lane_pass: LanePass
) -> Iterator[tuple[Int64, Float64, Float64, npt.NDArray[np.int32]]]:
    """Yield epochs (n,), easting and northing (m), and heights (quanta) of a pass's points, chunk by chunk."""
    first, end = lane_pass.start_gps_ns, lane_pass.end_gps_ns
    slices = []
    for file in files:
        spans = source.spans(file.group_spans)
        groups = tuple(k for k, span in enumerate(spans) if span[0] < end and span[1] >= first)
        if groups:
            slices.append(RawSlice(source, file.path, groups, tuple(spans[k] for k in groups), file.bytes))
    placer = Georeferencer(plan.store, plan.ground, slices)
    tile_quanta = plan.ground.grid.size_quanta
    for one in slices:
        for _, points in placer.place(one, EVERYWHERE):
            inside = (points.epoch_gps_ns >= first) & (points.epoch_gps_ns < end)
            whole = points.tiles[inside].astype(np.int64) * tile_quanta + points.quanta[inside, :2]
            easting, northing = (whole * np.float64(QUANTUM_M)).T
            yield points.epoch_gps_ns[inside], easting, northing, points.quanta[inside, 2]


def _comments(plan: SurveyPlan, source: ReadingSource, lane_pass: LanePass) -> tuple[str, ...]:
    frame = plan.ground.map
    return (
        f"written by roadscan {__version__}",
        f"survey {plan.survey.config.id}, run {source.run}, pass {lane_pass.pass_id}, sensor {source.sensor}",
        f"x, y: easting, northing in metres of {frame.crs or frame.local_name or 'local'}",
        f"z: {frame.height} heights in metres" + (f", geoid {frame.geoid.grid}" if frame.geoid else ""),
    )


def _grid(sums: CurvedHeights, settings: CrgSettings, comments: tuple[str, ...]) -> tuple[CurvedRegularGrid, list[str]]:
    """Return the grid of all rows and columns with a point, and notes on its holes."""
    line = sums.line
    heights, filled = fill_holes(
        sums.heights_m(), int(settings.hole_m / settings.v_step_m), int(settings.hole_m / settings.u_step_m)
    )
    rows, columns = (np.flatnonzero(~np.isnan(heights).all(axis=a)) for a in (1, 0))
    if rows[-1] - rows[0] < 1 or columns[-1] - columns[0] < 1:
        raise RunError("the points fill a single row or column of the grid", change="make the steps smaller")
    first, last = int(rows[0]), int(rows[-1])
    kept = heights[first : last + 1, columns[0] : columns[-1] + 1]
    inner = inner_holes(kept)
    notes = [f"{filled:,} nodes in holes of up to {settings.hole_m:g} m lie on straight lines between their neighbours"]
    if inner:
        notes.append(
            f"{inner:,} nodes in wider holes stay open: OpenCRG's own tools accept holes at the road's borders only"
        )
    base = float(np.floor(np.nanmin(kept)))
    x, y = line.vertices_m[first].tolist()
    grid = CurvedRegularGrid(
        v_m=sums.v_first_m + sums.v_step_m * np.arange(columns[0], columns[-1] + 1),
        z_m=kept - base,
        u_step_m=line.step_m,
        x_start_m=x,
        y_start_m=y,
        z_start_m=base,
        phi_rad=line.phi_rad[first:last],
        comments=(*comments, f"{filled} of {kept.size} nodes are interpolated"),
    )
    return grid, notes


@dataclass(frozen=True, eq=False)
class CurvedHeights:
    """Sums of heights beside a reference line; a point counts at the nearest node.

    Nodes stand at the line's vertices, `v_step_m` apart from `v_first_m` (right, negative) to the left.
    """

    line: ReferenceLine
    v_first_m: float
    v_step_m: float
    columns: int
    sums: Int64 = field(init=False)
    """(rows, columns) sums of heights, quanta."""
    counts: npt.NDArray[np.int32] = field(init=False)
    """(rows, columns) points per node."""

    def __post_init__(self) -> None:
        shape = (len(self.line.vertices_m), self.columns)
        object.__setattr__(self, "sums", np.zeros(shape, np.int64))
        object.__setattr__(self, "counts", np.zeros(shape, np.int32))

    def add(self, x_m: Float64, y_m: Float64, height_quanta: npt.NDArray[np.int32], steps: Int64) -> int:
        """Add points (n,); return how many lie beside the grid.

        Parameters
        ----------
        steps : (n,) a step of the line near each point; where the line crosses itself it says which branch is meant.
        """
        line = self.line
        return int(
            accumulate_curved(
                x_m, y_m, height_quanta, steps, line.vertices_m, line.left, line.step_m, self.v_first_m, self.v_step_m,
                self.sums, self.counts,
            )
        )  # fmt: skip

    def heights_m(self) -> Float64:
        """Return (rows, columns) mean height of each node; NaN where no point lies."""
        mean = np.full(self.sums.shape, np.nan)
        np.divide(self.sums * QUANTUM_M, self.counts, out=mean, where=self.counts > 0)
        return mean


def fill_holes(heights_m: Float64, v_nodes: int, u_nodes: int) -> tuple[Float64, int]:
    """Fill small holes by linear interpolation, first across the road, then along it.

    Parameters
    ----------
    heights_m : (rows, columns), NaN in holes.
    v_nodes, u_nodes : most nodes that a hole may span across and along; holes at an edge stay.

    Returns
    -------
    The heights, and how many nodes were filled.
    """
    across = _filled(heights_m, v_nodes)
    filled = _filled(across.T, u_nodes).T
    return np.ascontiguousarray(filled), int(np.isnan(heights_m).sum() - np.isnan(filled).sum())


def _filled(values: Float64, most: int) -> Float64:
    """Return values with holes of at most `most` neighbours along the second axis filled by linear interpolation."""
    known = ~np.isnan(values)
    where = np.arange(values.shape[1])
    before = np.maximum.accumulate(np.where(known, where, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, where, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    gap = ~known & (before >= 0) & (after < values.shape[1]) & (after - before - 1 <= most)
    row, column = np.nonzero(gap)
    left, right = before[gap], after[gap]
    part = (column - left) / (right - left)
    out = values.copy()
    out[gap] = (1 - part) * values[row, left] + part * values[row, right]
    return out


def inner_holes(heights_m: Float64) -> int:
    """Return how many nodes without a height lie between others of their row, including rows without any."""
    known = ~np.isnan(heights_m)
    begun = np.logical_or.accumulate(known, axis=1)
    goes_on = np.logical_or.accumulate(known[:, ::-1], axis=1)[:, ::-1]
    return int((begun & goes_on & ~known).sum()) + int((~known.any(axis=1)).sum())
