"""Computes values of the indices for sections of a lane: the table `condition_values`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.condition.index import ConditionIndex, Value, condition_indices
from roadscan.condition.lane_data import (
    PIECE_M,
    CrackOnLane,
    CrossSections,
    EdgeRows,
    EdgesOnLane,
    LaneData,
    LaneLines,
    Profile,
    TextureSquares,
    columns_of,
    edges_on_lane,
    located,
)
from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.condition.settings import SectionConfig
from roadscan.condition.survey_lane import window_m2
from roadscan.condition.tasks.stretches import (
    CROSS_SECTIONS,
    EDGE_PIECE_M,
    EDGES,
    LANE_LINES,
    LANE_TEXTURE,
    OF_STRETCHES,
    PROFILES,
    STRETCH_M,
    edge_unit,
    unit_of,
)
from roadscan.core.witness import Finding
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import read_geo_table
from roadscan.tiles.tasks.tiles import TaskResult

VALUES: Final = "condition_values"
_FINDINGS: Final = "findings"
"""Member of a record's detail with findings."""
_GROUP_M: Final = 1000.0
"""Approximate length of sections computed together, over which ravelling takes the lane's texture."""


@dataclass(frozen=True, eq=False)
class Group:
    """A sequence of sections of a lane; it holds no data."""

    line: RoadLine
    lane: Lane
    number: int
    sections_m: tuple[tuple[float, float], ...]
    profiles: tuple[OutputRecord, ...]
    """Records of the stretches of profiles along it, and before and behind it."""
    cross_sections: tuple[OutputRecord, ...]
    texture: tuple[OutputRecord, ...]
    lines: tuple[OutputRecord, ...]
    """Records of the same stretches' texture and painted lines."""
    cracks: OutputRecord | None
    """Record of the table of cracks, where there is one."""
    edges: tuple[OutputRecord, ...] | None
    """Records of the road's edges along it; None where none are requested."""
    beside: Mapping[str, bool]
    """True where no other lane lies between this one and the edge, by side in the direction of travel."""
    indices: tuple[tuple[str, str], ...]
    """Names of the indices to compute, with the keys of their values."""

    def unit(self, index: str) -> str:
        """Return the name of an index's values in the manifest."""
        return f"{index}/{self.lane.road}/{self.lane.name}/{self.number:05d}"


@dataclass(frozen=True, eq=False)
class GroupTask:
    """Values of some indices of a group. Sent to workers."""

    store: Store
    config: SectionConfig
    cell_m: float
    context: ProductContext
    group: Group

    @property
    def units(self) -> tuple[str, ...]:
        """Names of the indices' values."""
        return tuple(self.group.unit(name) for name, _ in self.group.indices)

    def singly(self) -> list[GroupTask]:
        """Return a task for each index."""
        return [replace(self, group=replace(self.group, indices=(one,))) for one in self.group.indices]


def plan_groups(
    roads: Roads, manifest: Manifest, config: SectionConfig, cell_m: float, *, with_edges: bool
) -> list[Group]:
    """Return all groups of sections, with all indices; `with_edges`: whether the road's edges are requested."""
    held = {name: dict(manifest.of(name)) for name in OF_STRETCHES}
    indices, cracks = condition_indices(), manifest.get("cracks", "cracks.parquet")
    of_cracks = None if cracks is None else cracks.digest
    entry = "roadscan.condition.tasks.values:values_of_group"
    codes = {name: code_digest(entry, name_of(type(one))) for name, one in indices.items()}
    found_edges = dict(manifest.of(EDGES)) if with_edges else {}
    lead = max((one.lead_m for one in indices.values()), default=0.0)
    settings = config.model_dump(mode="json")
    many = max(1, round(_GROUP_M / config.section_m))
    found: list[Group] = []
    for lane in roads.lanes:
        sections = sections_of(lane, config.section_m)
        for number in sorted({k // many for k, _, _ in sections}):
            own = tuple((a, b) for k, a, b in sections if k // many == number)
            near = [unit_of(lane, k) for k in range(
                max(int(own[0][0] - lead) // STRETCH_M, 0), int(own[-1][1] + lead) // STRETCH_M + 1
            )]  # fmt: skip
            read = {name: tuple(records[u] for u in near if u in records) for name, records in held.items()}
            shape = [
                lane.sign,
                lane.width_m,
                lane.width_from,
                lane.sigma_roll_deg,
                lane.sigma_height_m,
                lane.wander_m2_per_m,
                own,
                [(r.unit, r.digest) for name in OF_STRETCHES for r in read[name]],
                cell_m,
            ]
            edges: tuple[OutputRecord, ...] | None = None
            beside = _beside(lane, roads.lanes)
            if with_edges:
                pieces = range(int(own[0][0]) // EDGE_PIECE_M, int(own[-1][1]) // EDGE_PIECE_M + 1)
                units = [edge_unit(lane.road, piece) for piece in pieces]
                edges = tuple(found_edges[u] for u in units if u in found_edges)
                shape += [[(r.unit, r.digest) for r in edges], sorted(beside.items())]
            keys = tuple(
                (name, key_of(codes[name], settings, shape, of_cracks if indices[name].needs_cracks else None))
                for name in sorted(indices)
            )
            line = roads.lines[lane.road].stretch(own[0][0] - 20.0, own[-1][1] + 20.0)
            found.append(
                Group(line, lane, number, own, read[PROFILES], read[CROSS_SECTIONS], read[LANE_TEXTURE],
                      read[LANE_LINES], cracks, edges, beside, keys)
            )  # fmt: skip
    return found


def _beside(lane: Lane, lanes: Sequence[Lane]) -> dict[str, bool]:
    """Return whether no other lane lies on a side of a lane, by side in the direction of travel."""
    found = {"left": True, "right": True}
    for other in lanes:
        first, last = max(lane.first_m, other.first_m), min(lane.last_m, other.last_m)
        if other.road != lane.road or other is lane or last <= first:
            continue
        station = np.arange(first, last + 1, dtype=np.float64)
        away = lane.sign * float(np.median(other.offsets(station) - lane.offsets(station)))
        if abs(away) > 0.5 * min(lane.width_m, other.width_m):
            found["right" if away > 0.0 else "left"] = False
    return found


def sections_of(lane: Lane, section_m: float) -> list[tuple[int, float, float]]:
    """Return number, begin and end of each section of a lane: multiples of the length, cut at the lane's ends."""
    first, last = int(lane.first_m // section_m), int(np.ceil(lane.last_m / section_m))
    cut = [(k, max(k * section_m, lane.first_m), min((k + 1) * section_m, lane.last_m)) for k in range(first, last)]
    return [(k, float(a), float(b)) for k, a, b in cut if b - a > 0.5]


def due_groups(groups: Sequence[Group], manifest: Manifest) -> list[Group]:
    """Return groups with the indices whose values are missing or stale."""
    found = []
    for one in groups:
        due = tuple((name, key) for name, key in one.indices if not manifest.is_current(VALUES, one.unit(name), key))
        if due:
            found.append(replace(one, indices=due))
    return found


def values_of_group(task: GroupTask) -> TaskResult:
    """Compute and write the values of some indices (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    known = condition_indices()
    try:
        lane = load_lane(task)
    except Exception as error:  # noqa: BLE001  a damaged file costs these values
        return TaskResult.of((), [(u, reason_of(error)) for u in task.units], {damaged_file(error)})
    for name, key in task.group.indices:
        try:
            records.append(_write(task, known[name], key, lane))
        except Exception as error:  # noqa: BLE001  one index's fault must not stop the others
            failures.append((task.group.unit(name), reason_of(error)))
            damaged.add(damaged_file(error))
    return TaskResult.of(records, failures, damaged)


def _write(task: GroupTask, index: ConditionIndex, key: str, lane: LaneData) -> OutputRecord:
    schema, group = table_schema(VALUES), task.group
    values = sorted(index.values(lane), key=lambda v: (v.from_m, v.quantity, v.to_m))
    content = parquet_bytes(values_table(group.lane, index, values), schema)
    target = f"{schema.location}/{group.unit(index.name)}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    lane_name = f"road {group.lane.road}, lane {group.lane.name}"
    doubts = [asdict(replace(value.finding, subject=lane_name)) for value in values if value.finding is not None]
    detail = json.dumps({_FINDINGS: doubts}) if doubts else ""
    return OutputRecord(VALUES, group.unit(index.name), key, target, len(content), bytes_digest(content), detail)


def value_findings(manifest: Manifest) -> list[Finding]:
    """Return findings on the heights from which the stored values come."""
    records = (record for _, record in sorted(manifest.of(VALUES).items()))
    return [Finding.of(one) for record in records for one in record.figures().get(_FINDINGS, ())]


def values_table(lane: Lane, index: ConditionIndex, values: Sequence[Value]) -> pa.Table:
    """Return rows of ``schemas/condition_values.toml``."""
    units = {q.name: q.unit for q in index.quantities}
    n = len(values)

    def number(name: str) -> pa.Array:
        return pa.array(np.array([getattr(v, name) for v in values], np.float64), from_pandas=True)

    columns = {
        "road": pa.array([lane.road] * n, pa.string()),
        "lane": pa.array([lane.name] * n, pa.string()),
        "index": pa.array([index.name] * n, pa.string()),
        "quantity": pa.array([v.quantity for v in values], pa.string()),
        "unit": pa.array([units[v.quantity] for v in values], pa.string()),
        "extent": pa.array([v.extent for v in values], pa.string()),
        "station_from_m": number("from_m"),
        "station_to_m": number("to_m"),
        "value": number("value"),
        "sigma": number("sigma"),
        "share": number("share"),
        "reason": pa.array([v.reason or None for v in values], pa.string()),
    }
    return pa.table(columns, schema=table_schema(VALUES).arrow())


def load_lane(task: GroupTask) -> LaneData:
    """Load the profiles, cross-sections and features of a group's lane."""
    group = task.group
    profiles = _tables(task.store, group.profiles, table_schema(PROFILES).arrow())
    crossings = _tables(task.store, group.cross_sections, table_schema(CROSS_SECTIONS).arrow())
    cross = _cross_sections(crossings, task.config, group.lane.width_m)
    edges = _edges(task)
    if edges is not None:
        cross = _on_road(cross, edges)
    return LaneData(
        sign=group.lane.sign,
        width_m=group.lane.width_m,
        width_from=group.lane.width_from,
        cell_m=task.cell_m,
        sections_m=group.sections_m,
        profiles={side: _profile(profiles, side, group.lane.sign) for side in ("left", "right")},
        cross_sections=_within(cross, group.sections_m),
        texture=_texture(_tables(task.store, group.texture, table_schema(LANE_TEXTURE).arrow()), group.lane),
        lines=_lines(_tables(task.store, group.lines, table_schema(LANE_LINES).arrow())),
        config=task.config,
        curvature_per_m=group.line.curvature_per_m(_within(cross, group.sections_m).station_m),
        cracks=_cracks(task),
        edges=edges,
        window_m2=window_m2(task.config, task.cell_m),
        sigma_roll_rad=math.radians(group.lane.sigma_roll_deg),
        sigma_pose_height_m=group.lane.sigma_height_m,
        wander_m2_per_m=group.lane.wander_m2_per_m,
    )


def _edges(task: GroupTask) -> EdgesOnLane | None:
    """Return the road's edges beside the lane along the group; None where none are requested."""
    group = task.group
    if group.edges is None:
        return None
    table = _tables(task.store, group.edges, table_schema(EDGES).arrow())
    names = ("station_m", "offset_m", "sigma_offset_m", "drop_m", "sigma_drop_m")
    rows = {}
    for side in ("left", "right"):
        own = table.filter(pc.equal(table["side"], side))
        rows[side] = EdgeRows(*(own[name].to_numpy().astype(np.float64) for name in names))
    return edges_on_lane(rows, group.lane, (group.sections_m[0][0], group.sections_m[-1][1]), group.beside)


def _on_road(cross: CrossSections, edges: EdgesOnLane) -> CrossSections:
    """Return cross-sections without heights beyond the road's edges."""
    inside = np.array([edges.inside(np.full(cross.offset_m.size, s), cross.offset_m) for s in cross.station_m])
    inside = inside.reshape(cross.height_m.shape)
    height, sigma = (np.where(inside, values, np.nan) for values in (cross.height_m, cross.sigma_m))
    return replace(cross, height_m=height, sigma_m=sigma)


def _cracks(task: GroupTask) -> tuple[CrackOnLane, ...] | None:
    """Return cracks near the lane along the group; None where there is no table of cracks, or no index needs it."""
    group, known = task.group, condition_indices()
    if group.cracks is None or not any(known[name].needs_cracks for name, _ in group.indices):
        return None
    table, shapes = read_geo_table(read_recorded(task.store, group.cracks), task.context)
    from_m, to_m = group.sections_m[0][0], group.sections_m[-1][1]
    station = np.unique(np.append(np.arange(from_m, to_m), to_m))
    middle = shapely.LineString(group.line.places(station, group.lane.offsets(station))[:, :2])
    found = []
    for row, shape in zip(table.select(["type", "width_mean_m"]).to_pylist(), shapes, strict=True):
        if middle.distance(shape) > group.lane.width_m:
            continue
        near = shapely.get_parts(shapely.segmentize(shape, PIECE_M))
        ends = [shapely.get_coordinates(part) for part in near]
        centre = np.concatenate([0.5 * (xy[1:] + xy[:-1]) for xy in ends])
        length = np.concatenate([np.hypot(*np.diff(xy, axis=0).T) for xy in ends])
        guess = float(station[0]) + middle.project(shape.centroid)
        at, own = located(group.line, group.lane, centre, guess)
        found.append(CrackOnLane(row["type"], row["width_mean_m"], at, own, length))
    return tuple(found)


def _within(cross: CrossSections, sections_m: Sequence[tuple[float, float]]) -> CrossSections:
    return cross.between(sections_m[0][0], sections_m[-1][1])


def _tables(store: Store, records: Sequence[OutputRecord], schema: pa.Schema) -> pa.Table:
    parts = [recorded_table(store, r) for r in records]
    return pa.concat_tables([schema.empty_table(), *(p.cast(schema) for p in parts)])


def _profile(table: pa.Table, side: str, sign: int) -> Profile:
    rows = table.filter(pc.equal(table["path"], side))
    known: Mapping[str, npt.NDArray[Any]] = {
        name: rows[name].to_numpy() for name in ("station_m", "easting_m", "northing_m", "height_m", "sigma_height_m")
    }
    order = np.argsort(known["station_m"], kind="stable")[:: 1 if sign > 0 else -1]
    return Profile(
        known["station_m"][order],
        np.column_stack([known["easting_m"][order], known["northing_m"][order]]),
        known["height_m"][order],
        known["sigma_height_m"][order].astype(np.float64),
    )


def _cross_sections(table: pa.Table, config: SectionConfig, width_m: float) -> CrossSections:
    order = np.argsort(table["station_m"].to_numpy(), kind="stable")
    count = 2 * int(width_m / 2 / config.cross_section_step_m + 1e-6) + 1
    offset = config.cross_section_step_m * (np.arange(count, dtype=np.float64) - count // 2)

    return CrossSections(
        table["station_m"].to_numpy()[order], offset, _lists(table, "relative_height_m", count)[order],
        _lists(table, "sigma_height_m", count)[order], table["height_m"].to_numpy()[order],
    )  # fmt: skip


def _texture(table: pa.Table, lane: Lane) -> TextureSquares:
    order = np.argsort(table["station_m"].to_numpy(), kind="stable")
    offset = columns_of(lane)
    names = ("texture_mm", "loss_mm", "mpd_mm", "intensity", "passes_share")
    held = (_lists(table, name, offset.size)[order] for name in names)
    return TextureSquares(table["station_m"].to_numpy()[order], offset, *held)


def _lines(table: pa.Table) -> LaneLines:
    held = table.sort_by([("station_m", "ascending"), ("side", "ascending")])
    station, own, width, contrast = (
        held[name].to_numpy() for name in ("station_m", "own_offset_m", "width_m", "contrast")
    )
    return LaneLines(station, tuple(held["side"].to_pylist()), own, width, contrast)


def _lists(table: pa.Table, name: str, count: int) -> npt.NDArray[np.float64]:
    """Return (rows, count) values of a column of lists."""
    flat = table[name].combine_chunks().flatten().to_numpy().astype(np.float64)
    held: npt.NDArray[np.float64] = flat.reshape(table.num_rows, count)
    return held
