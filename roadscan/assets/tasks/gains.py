"""What the search of all squares shares: samples of the map make tables of the intensity's gains and of statistics."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.assets.edges.steps import raster_of
from roadscan.assets.intensity import (
    GAINS_SCHEMA,
    IntensitySample,
    constant_intensities,
    gains_of,
    intensity_sample,
    light_of,
)
from roadscan.assets.kinds.landscape_area import roughness_of_road_m
from roadscan.assets.scene import Measured, Scene, Statistics, together
from roadscan.assets.settings import GroundSettings
from roadscan.assets.tasks.load_returns import LoadedSquare, ReturnsTask, load_squares, scene_of
from roadscan.assets.tasks.plan import AssetPlan, cut_squares, grid_of, readings_of, square_key
from roadscan.assets.tiling import AssetGrid, Halos
from roadscan.assets.upright.panels import highest_elevation_deg
from roadscan.core.grid import TileId
from roadscan.run.engine.compute import reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.tiles.product import publish_file
from roadscan.tiles.tasks.tile_plan import Block
from roadscan.tiles.tasks.tiles import TaskResult


class Shared(NamedTuple):
    """Records of the tables. Sent to workers: they carry no data."""

    statistics: OutputRecord
    gains: OutputRecord | None
    """None where intensities are used as recorded."""

    @property
    def key(self) -> tuple[str, str]:
        """Returns the digests of both."""
        return self.statistics.digest, "" if self.gains is None else self.gains.digest

    def read_gains(self, store: Store) -> pa.Table | None:
        """Returns the gains of the intensity; None where it is used as recorded."""
        return None if self.gains is None else recorded_table(store, self.gains)

    def read_statistics(self, store: Store) -> Statistics:
        """Returns the statistics of the survey."""
        rows = recorded_table(store, self.statistics)
        return Statistics(dict(zip(rows["statistic"].to_pylist(), rows["value"].to_pylist(), strict=True)))


SAMPLES: Final = "intensity_samples"
GAINS: Final = "intensity_gains"
_UNIT: Final = "all"
STATISTICS: Final = "scene_statistics"
CONSTANT: Final = "constant_intensities"
"""Key, in the detail of the tables' records, of the sensors whose intensity is always the same."""
_EDGE_M: Final = 40.0
"""Edge of the sampled squares (m). They are the same however the survey is cut for its search."""
_HALOS: Final = Halos(2.0, 6.0, 24.0)
"""Halos of the samples (m): medians over them do not depend on what few returns near their borders are taken for."""
_MOST_SQUARES: Final = 24
"""Number of sampled squares; a digest of their place selects them."""
_BLOCK_SQUARES: Final = 4
"""Edge of the largest block of squares of one task: neighbours read the same row groups."""
_LEAST_RETURNS: Final = 20_000  # Squares with fewer returns are sampled only if no square has more.
_COLUMNS: Final = ("place", "sensor", "laser", "range_m", "incidence_deg", "intensity", "returns")


@dataclass(frozen=True)
class SampleTask:
    """Some squares to be sampled. Sent to workers: it carries no data."""

    load: ReturnsTask
    keys: tuple[str, ...]
    ground: GroundSettings

    @property
    def block(self) -> Block:
        """Returns the squares."""
        return Block(self.load.squares)


@dataclass(frozen=True)
class GainsPlan:
    """Samples of a survey, and the table made from them."""

    samples: tuple[tuple[TileId, str], ...]
    """Sampled squares, with the key of each sample."""
    calibrated: bool = True
    """Whether gains are wanted beside the statistics."""

    @property
    def tables(self) -> tuple[str, ...]:
        """Returns the tables that are made of the samples."""
        return (GAINS, STATISTICS) if self.calibrated else (STATISTICS,)

    def due(self, manifest: Manifest) -> list[tuple[TileId, str]]:
        """Returns samples that are missing or stale."""
        return [(s, key) for s, key in self.samples if not manifest.is_current(SAMPLES, str(s), key)]

    def units(self) -> set[str]:
        """Returns names of the samples in the manifest."""
        return {str(square) for square, _ in self.samples}

    def key(self, manifest: Manifest) -> str:
        """Returns the key of the tables, once all samples exist."""
        held = manifest.of(SAMPLES)
        read = [(unit, held[unit].digest) for unit in sorted(self.units()) if unit in held]
        return key_of(code_digest("roadscan.assets.tasks.gains:write_gains"), read)


def plan_gains(plan: AssetPlan) -> GainsPlan:
    """Returns the sampled squares: of those with many returns some, by a digest of their place."""
    grid, tiles = _grid(plan), plan.tiles.tiles
    readings = readings_of(grid, tiles)
    many = [square for square in readings if readings[square] >= _LEAST_RETURNS] or list(readings)
    chosen = sorted(many, key=lambda s: hashlib.blake2b(str(s).encode(), digest_size=8).digest())[:_MOST_SQUARES]
    code = code_digest("roadscan.assets.tasks.gains:find_samples")
    ordered = sorted(chosen, key=lambda s: (s.row, s.column))
    keys = [key_of(code, square_key(plan.common, grid, square, tiles)) for square in ordered]
    return GainsPlan(tuple(zip(ordered, keys, strict=True)), plan.config.intensity == "calibrated")


def _grid(plan: AssetPlan) -> AssetGrid:
    return grid_of(plan.survey.survey, _EDGE_M, _HALOS)


def sample_tasks(
    plan: AssetPlan, due: Sequence[tuple[TileId, str]], squares: Sequence[TileId] = ()
) -> list[SampleTask]:
    """Returns tasks over neighbouring samples that are due, or a task for each of some of them."""
    if squares:  # those of a task that failed, one by one
        blocks: list[tuple[TileId, ...]] = [(square,) for square in squares]
    else:
        readings = readings_of(_grid(plan), plan.tiles.tiles)
        wanted = {square: readings[square] for square, _ in due}
        blocks = cut_squares(wanted, _BLOCK_SQUARES, plan.config.max_block_returns)
    keys, grid = dict(due), _grid(plan)
    return [SampleTask(plan.load(own, grid), tuple(keys[s] for s in own), plan.config.ground) for own in blocks]


def find_samples(task: SampleTask) -> TaskResult:
    """Write the samples of the squares of a task (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    keys = dict(zip(task.load.squares, task.keys, strict=True))
    for loaded in load_squares(task.load):
        try:
            records.append(_sampled(task, loaded, keys[loaded.squares[0]]))
        except Exception as error:  # noqa: BLE001  one square's fault must not stop the others
            failures.append((f"{SAMPLES}/{loaded.squares[0]}", reason_of(error)))
    return TaskResult.of(records, failures)


def _sampled(task: SampleTask, loaded: LoadedSquare, key: str) -> OutputRecord:
    unit = str(loaded.squares[0])
    if not len(loaded.returns):
        return OutputRecord(SAMPLES, unit, key, "", 0, "")
    scene = scene_of(task.load.grid, loaded, task.ground, Statistics())
    sample, detail = intensity_sample(scene), json.dumps(measured(scene))
    known = np.isfinite(sample.range_m) & np.isfinite(sample.incidence_deg)  # the place of a sensor may be unknown
    if not known.any():
        return OutputRecord(SAMPLES, unit, key, "", 0, "", detail)
    rows = pa.table({name: getattr(sample, name)[known] for name in _COLUMNS})
    rows = rows.append_column("unit", pa.array(np.full(rows.num_rows, sample.unit)))
    store = task.load.readings.store
    with store.scratch() as folder:
        path = folder / "sample.parquet"
        pq.write_table(rows, path, compression="zstd", write_page_checksum=True, version="2.6")
        return publish_file(store, path, f"tables/{SAMPLES}/{unit}.parquet", SAMPLES, unit, key, detail)


def measured(scene: Scene) -> dict[str, Measured]:
    """Returns the statistics of a scene."""
    raster_of(scene)
    roughness_of_road_m(scene)
    highest_elevation_deg(scene)
    return scene.statistics.measured


def write_gains(gains: GainsPlan, manifest: Manifest, plan: AssetPlan, key: str) -> list[OutputRecord]:
    """Write the gains that explain all samples best, and the medians of their statistics."""
    samples = _samples(gains, manifest, plan)
    held = manifest.of(SAMPLES)
    parsed = [held[unit].figures() for unit in sorted(gains.units())]
    told = together({name: Measured(*values) for name, values in one.items()} for one in parsed)
    table = gains_of(samples) if gains.calibrated else GAINS_SCHEMA.empty_table()
    light = light_of(samples, table)
    if light is not None:
        told["ground_light"] = (light, len(samples))
    columns = {
        "statistic": list(told),
        "value": [v for v, _ in told.values()],
        "samples": [n for _, n in told.values()],
    }
    tables = {GAINS: table, STATISTICS: pa.table(columns, table_schema(STATISTICS).arrow()).sort_by("statistic")}
    detail = json.dumps({CONSTANT: constant_intensities(samples)})
    return [_written(plan, name, tables[name], key, detail) for name in gains.tables]


def _written(plan: AssetPlan, name: str, rows: pa.Table, key: str, detail: str) -> OutputRecord:
    schema = table_schema(name)
    content, target = parquet_bytes(rows.cast(schema.arrow()), schema), f"{schema.location}/{name}.parquet"
    plan.survey.store.write_bytes(target, content)
    return OutputRecord(name, _UNIT, key, target, len(content), bytes_digest(content), detail)


def _samples(gains: GainsPlan, manifest: Manifest, plan: AssetPlan) -> list[IntensitySample]:
    held, store, grid = manifest.of(SAMPLES), plan.survey.store, _grid(plan)
    samples = []
    for square, _ in gains.samples:
        record = held.get(str(square))
        if record is not None and record.path:
            rows = recorded_table(store, record)
            columns = {name: rows[name].to_numpy() for name in _COLUMNS}
            unit = float(rows["unit"][0].as_py())
            samples.append(IntensitySample(grid.corner_m(square), plan.sensors, **columns, unit=unit))
    return samples


def current_gains(plan: GainsPlan, manifest: Manifest) -> Shared | None:
    """Returns the tables of gains and statistics; None where one is missing or stale."""
    if not plan.samples or plan.due(manifest):
        return None
    key = plan.key(manifest)
    if not all(manifest.is_current(name, _UNIT, key) for name in plan.tables):
        return None
    records = manifest.get(STATISTICS, _UNIT), manifest.get(GAINS, _UNIT) if plan.calibrated else None
    return None if records[0] is None else Shared(records[0], records[1])
