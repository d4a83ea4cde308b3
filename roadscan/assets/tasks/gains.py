"""Gains of the intensity: samples of some squares make one small table, by which evidence is calibrated."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.assets.ground.settings import GroundSettings
from roadscan.assets.intensity import IntensitySample, gains_of, intensity_sample
from roadscan.assets.make_scene import make_scene
from roadscan.assets.tasks.load_returns import LoadedSquare, ReturnsTask, load_squares
from roadscan.assets.tasks.plan import AssetPlan
from roadscan.core.ids import TileId
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.compute import reason_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.store import bytes_digest
from roadscan.store.writer import parquet_bytes
from roadscan.tiles.blocks import Block
from roadscan.tiles.tasks.tile_files import publish_file
from roadscan.tiles.tasks.tiles import TaskResult

SAMPLES: Final = "intensity_samples"
GAINS: Final = "intensity_gains"
_UNIT: Final = "all"
_MOST_SQUARES: Final = 24
"""Number of sampled squares; a digest of their place selects them."""
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

    def due(self, manifest: Manifest) -> list[tuple[TileId, str]]:
        """Returns samples that are missing or stale."""
        return [(s, key) for s, key in self.samples if not manifest.is_current(SAMPLES, str(s), key)]

    def units(self) -> set[str]:
        """Returns names of the samples in the manifest."""
        return {str(square) for square, _ in self.samples}

    def key(self, manifest: Manifest) -> str:
        """Returns the key of the table, once all samples exist."""
        held = manifest.of(SAMPLES)
        read = [(unit, held[unit].digest) for unit in sorted(self.units()) if unit in held]
        return key_of(code_digest("roadscan.assets.tasks.gains:write_gains"), read)


def plan_gains(plan: AssetPlan) -> GainsPlan:
    """Returns the sampled squares: of those with many returns some, by a digest of their place; none where the
    survey asks for raw intensities.
    """
    if plan.config.intensity == "raw":
        return GainsPlan(())
    many = [square for square in plan.keys if plan.readings[square] >= _LEAST_RETURNS] or list(plan.keys)
    chosen = sorted(many, key=lambda s: hashlib.blake2b(str(s).encode(), digest_size=8).digest())[:_MOST_SQUARES]
    code = code_digest("roadscan.assets.tasks.gains:find_samples")
    ordered = sorted(chosen, key=lambda s: (s.row, s.column))
    return GainsPlan(tuple((square, key_of(code, plan.keys[square])) for square in ordered))


def sample_tasks(
    plan: AssetPlan, due: Sequence[tuple[TileId, str]], squares: Sequence[TileId] = ()
) -> list[SampleTask]:
    """Returns a task for each sample that is due, or for some of them."""
    wanted = set(squares) or {square for square, _ in due}
    return [SampleTask(plan.load((square,)), (key,), plan.config.ground) for square, key in due if square in wanted]


def find_samples(task: SampleTask) -> TaskResult:
    """Write the samples of the squares of a task (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    keys = dict(zip(task.load.squares, task.keys, strict=True))
    for loaded in load_squares(task.load):
        try:
            records.append(_sampled(task, loaded, keys[loaded.square]))
        except Exception as error:  # noqa: BLE001  one square's fault must not stop the others
            failures.append((f"{SAMPLES}/{loaded.square}", reason_of(error)))
    return TaskResult.of(records, failures)


def _sampled(task: SampleTask, loaded: LoadedSquare, key: str) -> OutputRecord:
    grid, unit = task.load.grid, str(loaded.square)
    if not len(loaded.returns):
        return OutputRecord(SAMPLES, unit, key, "", 0, "")
    scene = make_scene(loaded.returns, grid.own_box, grid.window_box, loaded.drive_xyh_m, task.ground)
    sample = intensity_sample(scene)
    known = np.isfinite(sample.range_m) & np.isfinite(sample.incidence_deg)  # the place of a sensor may be unknown
    if not known.any():
        return OutputRecord(SAMPLES, unit, key, "", 0, "")
    rows = pa.table({name: getattr(sample, name)[known] for name in _COLUMNS})
    rows = rows.append_column("unit", pa.array(np.full(rows.num_rows, sample.unit)))
    store = task.load.readings.store
    with store.scratch() as folder:
        path = folder / "sample.parquet"
        pq.write_table(rows, path, compression="zstd", write_page_checksum=True, version="2.6")
        return publish_file(store, path, f"tables/{SAMPLES}/{unit}.parquet", SAMPLES, unit, key)


def write_gains(gains: GainsPlan, manifest: Manifest, plan: AssetPlan, key: str) -> OutputRecord:
    """Write the gains that explain all samples best."""
    held, store = manifest.of(SAMPLES), plan.survey.store
    samples = []
    for square, _ in gains.samples:
        record = held.get(str(square))
        if record is not None and record.path:
            rows = store.parse_table(read_recorded(store, record), record.path)
            columns = {name: rows[name].to_numpy() for name in _COLUMNS}
            unit = float(rows["unit"][0].as_py())
            samples.append(IntensitySample(plan.grid.corner_m(square), plan.sensors, **columns, unit=unit))
    schema = table_schema(GAINS)
    content = parquet_bytes(gains_of(samples).cast(schema.arrow()), schema)
    target = f"{schema.location}/{GAINS}.parquet"
    store.write_bytes(target, content)
    return OutputRecord(GAINS, _UNIT, key, target, len(content), bytes_digest(content))


def current_gains(plan: GainsPlan, manifest: Manifest) -> OutputRecord | None:
    """Returns the table of gains; None where it is missing or stale, or the survey asks for none."""
    if not plan.samples or plan.due(manifest):
        return None
    record = manifest.get(GAINS, _UNIT)
    return record if record is not None and manifest.is_current(GAINS, _UNIT, plan.key(manifest)) else None
