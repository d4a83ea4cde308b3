"""Ingest of a line-rate pair: two logs of Arrow IPC, as a capture program writes them, into partitioned Parquet.

The pair is the one of Laurent et al.: 28,000 profiles/s of 4,000 readings together, 16 bits of range and 8 of
intensity, 336 MB/s. `ROADSCAN_LOG_GB` is the size of each of the two logs (default 1).
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
import psutil
import pyarrow as pa

from benchmarks.timing import Figure
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import IngestResult, ingest
from roadscan.run.engine.compute import Compute
from roadscan.run.engine.compute_on import compute_on
from roadscan.store.store import Store

READINGS = 4_000
PROFILES_HZ = 28_000
HEADS = 2
RUNS = 5
_BATCH = 500
_BANK = 2_000
"""Different profiles; a log repeats them from random starts."""
_EPOCH_GPS_NS = 1_462_000_000_000_000_000
_GEOMETRY = {"kind": "cartesian", "readings": READINGS, "first": -2.0, "step": 0.001, "range_offset_m": 1.5,
             "range_step_m": 0.0001}  # fmt: skip
_BAR = 1.0


def line_rate_figures(folder: Path) -> Iterator[Figure]:
    """Real-time factor, bytes a reading and memory, from logs to published tables, fingerprints included."""
    profiles = int(float(os.environ.get("ROADSCAN_LOG_GB", "1")) * 1e9 / (3 * READINGS))
    for head in range(HEADS):
        write_log(folder / f"head-{head}.arrow", profiles, head)
    survey = _survey(folder)
    seconds: list[float] = []
    with compute_on(HEADS) as compute:
        for run in range(RUNS + 1):  # the first starts the workers and is not counted
            shutil.rmtree(folder / "store", ignore_errors=True)
            took, results = _timed(survey, Store(str(folder / "store"), "pair"), compute)
            seconds += [took] if run else []
        peaks = _peaks_mb()
    readings = HEADS * profiles * READINGS
    stored = sum(f.bytes for r in results for f in r.record.tables["scans"])
    took = median(seconds)
    recorded_s = HEADS * profiles / PROFILES_HZ
    text = f"scans pair → Parquet: {HEADS} logs of {3 * readings / HEADS / 1e9:.1f} GB, 2 workers, median of {RUNS}"
    yield Figure(text, readings / took / 1e6, "M readings/s")
    yield Figure(f"scans pair → Parquet: times real time (bar: {_BAR:g})", recorded_s / took, "x")
    yield Figure("scans pair → Parquet: wall time of two cores", 2e9 * took / readings, "ns/reading")
    yield Figure("scans pair → Parquet: stored (raw: 3)", stored / readings, "B/reading")
    yield Figure("scans pair → Parquet: peak memory of a worker (bar: 1,536)", max(peaks), "MiB")


def write_log(path: Path, profiles: int, seed: int) -> None:
    """A road with roughness, noise and a cross fall; one reading of a thousand without a return, few outliers."""
    rng = np.random.default_rng(seed)
    road = 30_000 + 2_000 * np.sin(np.arange(READINGS) / 500)
    bank = road + 0.3 * np.cumsum(rng.normal(0, 2, (_BANK, READINGS)), axis=1) + rng.normal(0, 4, (_BANK, READINGS))
    odd = rng.random(bank.shape)
    bank[odd < 1e-4] += 3_000
    ranges = np.where(odd > 0.999, 0, bank.clip(1, 65_535)).astype(np.uint16)
    bright = rng.normal(120, 12, bank.shape).clip(0, 255).astype(np.uint8)
    schema = pa.schema(
        [("epoch_gps_ns", pa.int64()), _lists("range", pa.uint16()), _lists("intensity", pa.uint8())],
        metadata={"roadscan.scan_geometry": json.dumps(_GEOMETRY)},
    )
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        for first in range(0, profiles, _BATCH):
            count = min(_BATCH, profiles - first)
            start = rng.integers(0, _BANK - count)
            epochs = _EPOCH_GPS_NS + (first + np.arange(count)) * (HEADS * 10**9 // PROFILES_HZ)
            lists = [
                pa.FixedSizeListArray.from_arrays(pa.array(values[start : start + count].ravel()), type=field.type)
                for values, field in zip((ranges, bright), list(schema)[1:], strict=True)
            ]
            writer.write_batch(pa.record_batch([pa.array(epochs), *lists], schema=schema))


def _lists(name: str, kind: pa.DataType) -> pa.Field:
    return pa.field(name, pa.list_(pa.field("element", kind, nullable=False), READINGS), nullable=False)


def _survey(folder: Path) -> Survey:
    lines = ['id = "pair"', 'store = "store"', "[map]", 'crs = "EPSG:25832"']
    for head in range(HEADS):
        lines += [f"[rig.sensors.head-{head}]", 'kind = "profiler"']
    lines += ["[[runs]]", 'id = "run"']
    for head in range(HEADS):
        lines += ["[[runs.logs]]", f'path = "head-{head}.arrow"', 'format = "scans"', f'sensor = "head-{head}"']
    (folder / "SURVEY.toml").write_text("\n".join(lines))
    return Survey.load(folder / "SURVEY.toml")


def _timed(survey: Survey, store: Store, compute: Compute) -> tuple[float, list[IngestResult]]:
    started = time.perf_counter()
    results = ingest(survey, store, compute=compute)
    return time.perf_counter() - started, results


def _peaks_mb() -> list[float]:
    """Most memory (MiB) that each worker ever held, mapped pages of logs included."""
    peaks = []
    for process in psutil.Process().children(recursive=True):
        text = Path(f"/proc/{process.pid}/status").read_text()
        peaks += [int(line.split()[1]) / 1024 for line in text.splitlines() if line.startswith("VmHWM")]
    return peaks
