"""Bounds on where the readings of a data file may lie, from poses, range spans and statistics of row groups."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import ScanGeometry
from roadscan.georeference.charts import charts_along
from roadscan.georeference.reach import RangeSpans, Reach, Touched, joined
from roadscan.georeference.sources import MapSettings, RawSlice, ReadingSource, geometry_of
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.store.codecs.parquet.page_file import opened_parquet
from roadscan.store.digest import ROWS_CHANGE, damage_named
from roadscan.store.readings.packed_returns import box_of, is_packed
from roadscan.store.readings.row_groups import ProfileReader
from roadscan.store.store import Store

_SPAN_COLUMNS = ["range_low", "range_high"]
_CHUNK_READINGS = 1 << 22  # Range readings that are read at a time.
_WINDOW_NS = 120 * NS_PER_S  # Poses are loaded in windows of this length.
_KEPT = threading.local()


def touched_tiles(store: Store, ground: MapSettings, one: RawSlice, file: pq.ParquetFile) -> Touched:
    """Return the tiles that row groups of a slice of scans or returns may touch; groups by place in the slice."""
    reach = _reach(store, ground, one)
    if reach is None:
        return joined([])
    geometry = geometry_of(one.source)
    if geometry is None:
        return _of_returns(reach, one, file)
    counts = [file.metadata.row_group(g).num_rows for g in one.groups]
    if geometry.kind == "polar":
        epochs, spans = _read_spans(store, one, counts, geometry)
        whole = spans.whole(geometry)
        spans = spans if reach.is_loose(whole, geometry) else whole
    else:
        stored = [c for c in _SPAN_COLUMNS if c in file.schema_arrow.names]
        rows = file.read_row_groups(list(one.groups), columns=["epoch_gps_ns", *stored], use_threads=False)
        epochs, spans = rows.column("epoch_gps_ns").to_numpy(), _stored_spans(rows, geometry)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return reach.profiles(_on_time(one, epochs), spans, starts, geometry)


def group_spans(one: RawSlice, file: pq.ParquetFile) -> npt.NDArray[np.int64]:
    """Return first and last epoch (groups, 2), corrected GPS ns, of a slice's row groups, from the file's footer."""
    metadata = file.metadata
    column = metadata.schema.names.index("epoch_gps_ns")
    spans = [_limits(metadata.row_group(g), column) or _span(file, g, "epoch_gps_ns") for g in one.groups]
    return _on_time(one, np.array(spans, dtype=np.int64).ravel()).reshape(-1, 2)


def _reach(store: Store, ground: MapSettings, one: RawSlice) -> Reach | None:
    """Return the poses around a slice and the distance up to which its readings count; None without any pose.

    Poses of whole minutes are loaded and kept for the next slice, since a file may contain only seconds.
    """
    spans = [(a // _WINDOW_NS * _WINDOW_NS, -(-b // _WINDOW_NS) * _WINDOW_NS) for a, b in one.spans]
    wanted = (store.root, one.source.key, one.source.allowance, ground, spans)
    kept: tuple[object, Reach | None] | None = getattr(_KEPT, "reach", None)
    if kept is None or kept[0] != wanted:
        kept = _KEPT.reach = (wanted, _loaded(store, ground, one.source, spans))
    return kept[1]


def _loaded(store: Store, ground: MapSettings, source: ReadingSource, spans: Sequence[tuple[int, int]]) -> Reach | None:
    if source.trajectory is None:
        raise NavigationError(f"run '{source.run}' has no trajectory", expected="a trajectory log in the run")
    trajectory = load_recorded(store, source.trajectory, spans, ground.max_gap_s)
    if trajectory.epochs_gps_ns.size == 0:
        return None
    return Reach(
        trajectory=trajectory,
        charts=charts_along(ground.map, trajectory.world, trajectory.position_world_m),
        mountings=source.mountings,
        range_min_m=0.0 if ground.marks else source.range_min_m,
        range_max_m=np.inf if ground.marks else source.range_max_m,
        tile_quanta=ground.grid.size_quanta,
        allowance=source.allowance,
    )


@contextmanager
def opened(store: Store, one: RawSlice) -> Iterator[pq.ParquetFile]:
    """Open the file of a slice; raises :class:`DamagedError` where it cannot be read."""
    with (
        damage_named("ingested rows cannot be read", one.file, ROWS_CHANGE),
        store.fs.open(store.path(one.file), "rb") as stream,
    ):
        yield opened_parquet(stream)


def _on_time(one: RawSlice, epochs_gps_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return epochs_gps_ns if one.source.clock is None else one.source.clock.applied(epochs_gps_ns)


def _stored_spans(rows: pa.Table, geometry: ScanGeometry) -> RangeSpans:
    """Return the range spans that ingest wrote; the widest span where it wrote none."""
    if any(c not in rows.column_names for c in _SPAN_COLUMNS):
        return RangeSpans.unknown(rows.num_rows, geometry)
    low, high = (rows.column(c).fill_null(whole).to_numpy() for c, whole in zip(_SPAN_COLUMNS, (1, 65535), strict=True))
    return RangeSpans.of_profiles(low, high, geometry)


def _read_spans(
    store: Store, one: RawSlice, counts: Sequence[int], geometry: ScanGeometry
) -> tuple[npt.NDArray[np.int64], RangeSpans]:
    """Compute the profiles' epochs as stored, and the range spans of the parts of each profile, from the readings."""
    step = max(_CHUNK_READINGS // (max(counts) * geometry.readings), 1)
    reader = ProfileReader(store, one.file)
    epochs, parts = [], []
    for start in range(0, len(one.groups), step):
        rows = reader.read(one.groups[start : start + step])
        epochs.append(rows.epoch_gps_ns.copy())
        parts.append(RangeSpans.of_ranges(rows.range))
    low, high = (np.concatenate([getattr(p, name) for p in parts]) for name in ("low", "high"))
    return np.concatenate(epochs), RangeSpans(low, high, parts[0].block_readings)


def _of_returns(reach: Reach, one: RawSlice, file: pq.ParquetFile) -> Touched:
    metadata = file.metadata
    index = {metadata.schema.column(i).name: i for i in range(metadata.num_columns)}
    packed = is_packed(metadata.schema.names)
    epoch = "epoch_gps_ns" if packed else "pose_epoch_gps_ns"
    boxes = np.empty((len(one.groups), 3, 2))
    spans = np.empty((len(one.groups), 2), np.int64)
    readings = np.empty(len(one.groups), np.int64)
    for number, group in enumerate(one.groups):
        part = metadata.row_group(group)
        readings[number] = part.num_rows
        if packed:
            boxes[number] = box_of(metadata.metadata, group) or (-np.inf, np.inf)
        else:
            for axis, name in enumerate("xyz"):
                boxes[number, axis] = _limits(part, index[f"{name}_sensor_m"]) or (-np.inf, np.inf)
        spans[number] = _limits(part, index[epoch]) or _span(file, group, epoch)
    boxes[np.isnan(boxes).any(axis=2)] = (-np.inf, np.inf)
    return reach.returns(_on_time(one, spans.ravel()).reshape(-1, 2), boxes, readings)


def _limits(part: pq.RowGroupMetaData, column: int) -> tuple[float, float] | None:
    """Return the least and greatest value of a column from the statistics of a row group; None without any."""
    statistics = part.column(column).statistics
    return (statistics.min, statistics.max) if statistics is not None and statistics.has_min_max else None


def _span(file: pq.ParquetFile, group: int, column: str) -> tuple[int, int]:
    epochs = file.read_row_groups([group], columns=[column], use_threads=False).column(0).to_numpy()
    return int(epochs.min()), int(epochs.max())
