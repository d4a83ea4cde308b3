"""Reference lines and lanes of a survey: found from its drives or a layer, stored as two small tables.

Estimates the random walk of a trajectory's heights from the trajectory itself.

A vehicle's body moves slowly: at 2 Hz, its main frequency, a fourth difference of poses 5 ms apart keeps 2 · 10⁻⁵ of
the movement, at 10 Hz, the frequency of the wheels, 1 %. The rest is the random walk of the poses, whose fourth
difference has 20 times the variance of its steps. Its spectrum is that of a road of waviness 2: it adds to roughness.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.condition.roads import Drive, StatedLine, find_roads
from roadscan.condition.settings import ConditionConfig
from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.grid import LanePass, PassId
from roadscan.core.survey import Survey
from roadscan.formats.vectors.road_lines import LineLayer, RoadLinesOptions, place_in_map, read_lines, sidecars
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.ingest.reading.format import Reject
from roadscan.navigation.tasks.trajectories import TrajectorySource, usual_pose_sigma
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table
from roadscan.tiles.tasks.wanted_products import product_context

LINES: Final = "reference_lines"
LANES: Final = "lanes"
_UNIT: Final = "all"
_STEP_M: Final = 0.25
"""Edge of the cubes by which positions are thinned: one is kept in each cube passed."""
_POSITION: Final = ["epoch_gps_ns", *(f"{a}_world_m" for a in "xyz")]
_LINE_SETTINGS: Final = (
    "reference", "layer_crs", "layer_options", "lanes", "same_road_m", "smoothing_m", "lane_smoothing_m",
    "lane_width_m",
)  # fmt: skip


def lines_key(plan: SurveyPlan, config: ConditionConfig) -> str:
    """Return the key of the two tables: paths of the passes, settings, layer and code."""
    drives = [[[f.digest for f in source.files], _stated(one)] for one, source in _driven(plan)]
    accuracy = [f.digest for r in plan.records for f in r.tables.get("trajectory_accuracy", ())]
    layer = _layer_file(plan, config)
    files = [] if layer is None else [file_digest(file) for file in (layer, *sidecars(layer))]
    settings = {name: config.model_dump(mode="json")[name] for name in _LINE_SETTINGS}
    code = code_digest("roadscan.condition.tasks.lines:write_lines")
    context = product_context(plan)
    return key_of(code, drives, accuracy, files, settings, context.survey_id, context.map)


def _stated(one: LanePass) -> list[object]:
    return [one.pass_id, one.run, one.start_gps_ns, one.end_gps_ns, one.lane]


def _driven(plan: SurveyPlan) -> Iterator[tuple[LanePass, TrajectorySource]]:
    """Return passes whose run has a trajectory, by number."""
    placed = {s.run for s, _ in plan.sources if s.trajectory is not None}
    for one in sorted(plan.passes, key=lambda p: p.pass_id):
        if one.run in placed:
            yield one, trajectory_source(one.run, plan.records)


def _layer_file(plan: SurveyPlan, config: ConditionConfig) -> Path | None:
    return None if config.layer is None else plan.survey.resolve(config.layer)


def find_lines(plan: SurveyPlan, config: ConditionConfig) -> Roads:
    """Find the lines and lanes: from the drives, or those of the layer that were driven."""
    drives = [Drive(one.pass_id, _path_m(plan, one, source), one.lane) for one, source in _driven(plan)]
    lines, lanes = find_roads(drives, stated_lines(plan.survey, config, plan.ground.map), config)
    return Roads({line.road: line for line in lines}, tuple(_with_roll(plan, lanes)))


def roads_key(plan: SurveyPlan) -> str:
    """Return the key of the lines and lanes of :func:`survey_roads`."""
    return lines_key(plan, ConditionConfig.of(plan.survey))


def survey_roads(plan: SurveyPlan, manifest: Manifest) -> tuple[Roads, str]:
    """Return lines and lanes of a survey, and their key: as the stage `condition` stored them, or found now.

    A survey without a section `[condition]` has those of its drives.
    """
    config, key = ConditionConfig.of(plan.survey), roads_key(plan)
    if current_lines(manifest, key):
        return load_roads(plan.store, manifest, product_context(plan)), key
    return find_lines(plan, config), key


def write_lines(plan: SurveyPlan, config: ConditionConfig, key: str) -> list[OutputRecord]:
    """Find the lines and lanes and write their tables."""
    roads, context = find_lines(plan, config), product_context(plan)
    return [
        _write_lines(plan.store, list(roads.lines.values()), config.reference, key, context),
        _write_lanes(plan.store, roads.lines, roads.lanes, key, context),
    ]


def _with_roll(plan: SurveyPlan, lanes: Sequence[Lane]) -> list[Lane]:
    """Return lanes with σ of roll and height of their drives, and the random walk of these heights."""
    settings = plan.survey.config.navigation.calibration
    known = {
        one.pass_id: (*usual_pose_sigma(plan.store, plan.records, source, settings), _wander(plan, one, source))
        for one, source in _driven(plan)
    }

    def greatest(lane: Lane, number: int) -> float:
        own = [known[PassId(p)] for p in lane.passes] or list(known.values())
        return max((float(sigma[number]) for sigma in own), default=0.0)

    return [
        replace(
            lane, sigma_roll_deg=math.degrees(greatest(lane, 3)), sigma_height_m=greatest(lane, 2),
            wander_m2_per_m=greatest(lane, 6),
        )
        for lane in lanes
    ]  # fmt: skip


def _wander(plan: SurveyPlan, one: LanePass, source: TrajectorySource) -> float:
    """Return the variance of the random walk of a pass's heights per metre of travel (m²/m)."""
    rows = list(_rows(plan.store, one, source))
    if not rows:
        return 0.0
    epoch, world = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return height_wander(epoch, plan.ground.map.map_from_world(source.world, world))


def check_layer(survey: Survey) -> None:
    """Read the layer of reference lines, where the survey file states one.

    Raises
    ------
    FormatError, ConfigError, CrsError
        if it does not exist, cannot be read as stated or brought into the map, or a feature cannot be used.
    """
    config = ConditionConfig.stated(survey)
    if config is not None and config.layer is not None:
        stated_lines(survey, config, survey.frame())


def stated_lines(survey: Survey, config: ConditionConfig, frame: MapFrame) -> list[StatedLine]:
    """Return the lines of the survey file's layer; none where it has none.

    Raises
    ------
    FormatError, ConfigError, CrsError
        if the layer cannot be read as stated, or a feature cannot be used.
    """
    if config.layer is None:
        return []
    path = survey.resolve(config.layer)
    layer = LineLayer.of(path, RoadLinesOptions.parse(config.layer_options, file=path), config.layer_crs)
    found: list[StatedLine] = []
    for item in read_lines(layer, place_in_map(layer.crs, frame, path), need_widths=False):
        if isinstance(item, Reject):
            raise ConfigError(
                f"feature {item.record} of the layer (counted from 0) cannot be used: {item.reason}",
                expected="lines that lie in the map",
                change="mend the feature, or take it out of the layer",
                file=path,
            )
        parts = zip(item.shapes, item.ids, item.parts, item.names, strict=True)
        for number, (shape, line, part, name) in enumerate(parts):
            first, last = item.measures[number].tolist()
            known = not np.isnan(first + last)
            found.append(
                StatedLine(
                    line if part == 0 else f"{line}.{part}", shapely.get_coordinates(shape), name,
                    first if known else None, last if known else None,
                )
            )  # fmt: skip
    return found


def _path_m(plan: SurveyPlan, one: LanePass, source: TrajectorySource) -> npt.NDArray[np.float64]:
    """Return (k, 2) easting and northing along a pass."""
    parts = [np.zeros((0, 3)), *_positions(plan.store, one, source)]
    world = np.concatenate(parts)
    frame: MapFrame = plan.ground.map
    return frame.map_from_world(source.world, world)[:, :2] if len(world) else np.zeros((0, 2))


def _positions(store: Store, one: LanePass, source: TrajectorySource) -> Iterator[npt.NDArray[np.float64]]:
    for _, place in _rows(store, one, source):
        moved = np.ones(len(place), bool)
        moved[1:] = (np.diff(np.floor(place / _STEP_M), axis=0) != 0).any(axis=1)
        yield place[moved]


def _rows(
    store: Store, one: LanePass, source: TrajectorySource
) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """Yield epochs (n,) and positions (n, 3) in the world frame, row group by row group."""
    for file in sorted(source.files, key=lambda f: f.span or (0, 0)):
        if file.span is not None and (file.span[1] < one.start_gps_ns or file.span[0] >= one.end_gps_ns):
            continue
        for group in range(len(file.group_rows)):
            rows = read_groups(store, file.path, [group], _POSITION)
            epoch = rows.column("epoch_gps_ns").to_numpy()
            own = (epoch >= one.start_gps_ns) & (epoch < one.end_gps_ns)
            place = np.stack([rows.column(name).to_numpy()[own] for name in _POSITION[1:]], axis=-1)
            if len(place):
                yield epoch[own], place


def _write_lines(
    store: Store, lines: Sequence[RoadLine], source: str, key: str, context: ProductContext
) -> OutputRecord:
    columns = {
        "road": [line.road for line in lines],
        "name": [line.name for line in lines],
        "source": [source] * len(lines),
        "first_station_m": [line.first_m for line in lines],
        "length_m": [line.length_m for line in lines],
        "measure_from": [line.measure_from for line in lines],
        "measure_per_m": [line.measure_per_m for line in lines],
    }
    return _write(store, LINES, columns, [line.nodes_m for line in lines], key, context)


def _write_lanes(
    store: Store, lines: dict[str, RoadLine], lanes: Sequence[Lane], key: str, context: ProductContext
) -> OutputRecord:
    columns = {
        "road": [lane.road for lane in lanes],
        "lane": [lane.name for lane in lanes],
        "direction": [lane.direction for lane in lanes],
        "station_from_m": [lane.first_m for lane in lanes],
        "station_to_m": [lane.last_m for lane in lanes],
        "width_m": [lane.width_m for lane in lanes],
        "width_from": [lane.width_from for lane in lanes],
        "offset_mean_m": [float(np.mean(lane.offset_m)) for lane in lanes],
        "sigma_roll_deg": [lane.sigma_roll_deg for lane in lanes],
        "sigma_height_m": [lane.sigma_height_m for lane in lanes],
        "wander_m2_per_m": [lane.wander_m2_per_m for lane in lanes],
        "passes": [" ".join(map(str, lane.passes)) for lane in lanes],
        "offset_m": [lane.offset_m for lane in lanes],
    }
    shapes = []
    for lane in lanes:
        station = np.arange(lane.first_m, lane.last_m + 1, dtype=np.float64)
        shapes.append(lines[lane.road].places(station, lane.offset_m)[:, :2])
    return _write(store, LANES, columns, shapes, key, context)


def _write(
    store: Store,
    name: str,
    columns: dict[str, Any],
    shapes_m: Sequence[npt.NDArray[np.float64]],
    key: str,
    context: ProductContext,
) -> OutputRecord:
    schema = table_schema(name)
    target = f"{schema.location}/{name}.parquet"
    table = pa.table(columns, schema=schema.arrow())
    shapes = np.array([*map(shapely.LineString, shapes_m), None], object)[:-1]
    with store.scratch() as folder:
        path = folder / f"{name}.parquet"
        write_geo_table(path, table, "line", shapes, ["LineString"], context)
        size, digest = path.stat().st_size, file_digest(path)
        store.publish(path, target)
    return OutputRecord(name, _UNIT, key, target, size, digest, json.dumps({"rows": table.num_rows}))


def current_lines(manifest: Manifest, key: str) -> bool:
    """Return whether both tables exist and are current."""
    return all(manifest.is_current(name, _UNIT, key) for name in (LINES, LANES))


def load_roads(store: Store, manifest: Manifest, context: ProductContext) -> Roads:
    """Load lines and lanes; empty where there are no tables yet."""
    records = [manifest.get(name, _UNIT) for name in (LINES, LANES)]
    if records[0] is None or records[1] is None:
        return Roads({}, ())
    rows, shapes = read_geo_table(read_recorded(store, records[0]), context)
    lines = {
        row["road"]: RoadLine(
            row["road"], shapely.get_coordinates(shape), row["first_station_m"], row["name"], row["measure_from"],
            row["measure_per_m"],
        )
        for row, shape in zip(rows.to_pylist(), shapes, strict=True)
    }  # fmt: skip
    held, _ = read_geo_table(read_recorded(store, records[1]), context)
    lanes = tuple(
        Lane(
            row["road"], row["lane"], 1 if row["direction"] == "forward" else -1, row["station_from_m"],
            np.array(row["offset_m"]), row["width_m"], row["width_from"], tuple(map(int, row["passes"].split())),
            row["sigma_roll_deg"], row["sigma_height_m"], row["wander_m2_per_m"],
        )
        for row in held.to_pylist()
    )  # fmt: skip
    return Roads(lines, lanes)


_LONGEST_STEP_NS: Final = 11_000_000
"""At a longer interval the fourth differences of poses contain the vehicle's movement."""
_WALK: Final = 20.0
"""Variance of the fourth difference of a random walk over that of its steps: 1 + 9 + 9 + 1."""
_SLOWEST_M_PER_S: Final = 1.0  # Slower poses are left out.


def height_wander(epoch_ns: npt.NDArray[np.int64], place_m: Float64) -> float:
    """Return the random walk's variance of pose heights per metre of travel (m²/m); 0 where poses do not show it.

    Parameters
    ----------
    epoch_ns : (n,) ascending.
    place_m : (n, 3) easting, northing, height on the map (m).
    """
    step = np.diff(epoch_ns)
    if step.size < 100 or np.median(step) > _LONGEST_STEP_NS:
        return 0.0
    seconds = 1e-9 * float(np.median(step))
    speed = np.hypot(*np.diff(place_m[:, :2], axis=0).T) / seconds
    even = (np.abs(step - np.median(step)) <= 0.01 * np.median(step)) & (speed > _SLOWEST_M_PER_S)
    fourth = np.diff(place_m[:, 2], 4)
    own = fourth[np.convolve(even, np.ones(4), mode="valid") == 4.0]
    if own.size < 100:
        return 0.0
    spread = scatter_about(own, float(np.median(own)))
    return spread**2 / (_WALK * seconds * float(np.median(speed[even])))
