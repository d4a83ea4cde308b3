"""What the pictures of a batch show: points of the same run around them become depth images and samples of colours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.colours.depth import DepthImages, DepthRule, Seen, depth_images, normals_of, seen_through
from roadscan.colours.gains import BRIGHT, DARK, PictureSample, cells_of, gains_of, is_compared, sample_of
from roadscan.colours.kernels.looks import Camera, Depths, Limits, look
from roadscan.colours.painting import cameras_of, eyes_m
from roadscan.colours.tasks.plan import DEPTHS, Batch, ColourPlan, reach_beyond_m
from roadscan.compute.array_types import Float32, Float64, Int64, UInt8
from roadscan.core.extras import cv2
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import QUANTUM_M
from roadscan.georeference.place import Window
from roadscan.georeference.sources import Georeferencer
from roadscan.pictures.colours import ColourSource
from roadscan.pictures.placed import Pictures
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.tiles.product import publish_file
from roadscan.tiles.tasks.tile_plan import TileTask

_IMAGES: Final = ("nearest", "farthest", "moved")
_TABLE: Final = pa.schema(
    [("camera", pa.string()), ("file", pa.string()), ("epoch_gps_ns", pa.int64())]
    + [(name, pa.int32()) for name in ("rows", "columns", "factor")]
    + [(name, pa.binary()) for name in _IMAGES]
    + [("sharpness", pa.float64()), ("reason", pa.string()), ("cell", pa.list_(pa.int64()))]
    + [("colour", pa.list_(pa.float32()))]
)
"""A row a picture, in the order of the batch: depth images as rows of 16-bit numbers, colours of cubes."""
_SAMPLED: Final = ["camera", "file", "epoch_gps_ns", "sharpness", "reason", "cell", "colour"]
_MOST_POINTS: Final = 6_000_000
"""Points around the pictures of a batch, about: of more, which fast lidars see, a share is used. It bounds memory."""
_SHOWN: Final = 0.02
"""A picture shows something where at least this share of its pixels is neither dark nor overexposed."""
_SAMPLE_REACH: Final = 0.6
"""Pictures are compared on places within this share of the reach."""


@dataclass(frozen=True)
class DepthTask:
    """Pictures of a batch. Sent to workers: it holds no data."""

    unit: str
    key: str
    pictures: Pictures
    readings: TileTask
    rule: DepthRule
    reach_m: float
    beyond_m: float
    seconds: float
    border_px: int

    @property
    def store(self) -> Store:
        """Returns the store of the survey."""
        return self.readings.store


def depth_task(plan: ColourPlan, batch: Batch) -> DepthTask:
    """Returns the task of a batch."""
    config = plan.config
    return DepthTask(
        batch.unit, batch.key, batch.pictures, batch.task(), plan.rule, config.reach_m, reach_beyond_m(config),
        config.seconds, config.border_px,
    )  # fmt: skip


def write_depths(task: DepthTask) -> OutputRecord:
    """Make the depth images of a batch, and write them (runs on a worker)."""
    origin = np.floor(eyes_m(task.pictures)[0])
    seen = _points(task, origin)
    point_m, epochs = seen.point_m, seen.epoch_gps_ns
    cell = cells_of(point_m.astype(np.float64) + origin)
    compared = is_compared(cell)
    source, rows = ColourSource(task.pictures), []
    window = round(task.seconds * NS_PER_S)
    cameras = cameras_of(task.pictures, origin)
    spans = [
        slice(*np.searchsorted(epochs, [own - window, own + window + 1]).tolist())
        for own in task.pictures.epochs_gps_ns.tolist()
    ]
    moved = _moved(task, seen, cameras, spans)
    for number, (camera, near) in enumerate(zip(cameras, spans, strict=True)):
        own = int(task.pictures.epochs_gps_ns[number])
        images = depth_images(seen.part(near), camera, own, task.beyond_m, task.rule, moved[near])
        picture = source.picture(task.pictures, number)
        sharpness, sample = 0.0, PictureSample(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
        reason = source.reason(task.pictures, number) if picture is None else blank(picture)
        if picture is not None and not reason:
            chosen = np.arange(near.start, near.stop)[compared[near]]
            sharpness = sharpness_of(picture)
            sample = _sample(task, number, camera, images, picture, (point_m[chosen], epochs[chosen], cell[chosen]))
        rows.append(_row(task.pictures, number, images, sharpness, reason, sample))
    with task.store.scratch() as folder:
        path = folder / "depths.parquet"
        pq.write_table(pa.Table.from_pylist(rows, schema=_TABLE), path, compression="zstd", use_dictionary=False,
                       row_group_size=1, write_statistics=False, write_page_checksum=True, version="2.6")  # fmt: skip
        return publish_file(task.store, path, f"tables/{DEPTHS}/{task.unit}.parquet", DEPTHS, task.unit, task.key)


def _moved(task: DepthTask, seen: Seen, cameras: Sequence[Camera], spans: Sequence[slice]) -> npt.NDArray[np.bool_]:
    """Returns which points (n,) moved: more pictures of the batch saw through them than saw them there later or before.

    What drives ahead leaves a trail of points along the lane; far ahead the lines of a scan are too wide apart to see
    through it, and a picture that was nearer tells.
    """
    votes = np.zeros((2, len(seen.point_m)), np.uint16)
    for number, (camera, near) in enumerate(zip(cameras, spans, strict=True)):
        own = int(task.pictures.epochs_gps_ns[number])
        for vote, mask in zip(votes, seen_through(seen.part(near), camera, own, task.beyond_m, task.rule), strict=True):
            vote[near] += mask
    return np.asarray(votes[0] > votes[1])


def blank(picture: UInt8) -> str:
    """Returns the words for a picture that shows nothing, black or overexposed; "" of others."""
    brightest = picture.max(axis=2)
    lit, dull = np.mean(brightest >= DARK), np.mean(picture.min(axis=2) <= BRIGHT)
    if min(lit, dull) >= _SHOWN:
        return ""
    return "it is black" if lit < _SHOWN else "it is overexposed"


def sharpness_of(picture: UInt8) -> float:
    """Returns how much of the change between pixels is fine: mean Laplacian over mean gradient of the grey values.

    Motion and a wrong focus take the fine changes first, whatever the picture shows.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())
    coarse = float(np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).mean())
    return fine / coarse if coarse > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class Shown:
    """What a picture of a batch shows, as it was stored."""

    images: DepthImages

    @property
    def depths(self) -> Depths:
        """Returns the depth images as kernels take them."""
        one = self.images
        return Depths(one.nearest, one.farthest, one.moved, float(one.factor))


def read_shown(store: Store, record: OutputRecord) -> list[Shown]:
    """Returns what the pictures of a batch show, in its order."""
    table = recorded_table(store, record)
    found = []
    for row in table.select(["rows", "columns", "factor", *_IMAGES]).to_pylist():
        shape = row["rows"], row["columns"]
        nearest, farthest, moved = (np.frombuffer(row[name], "<u2").reshape(shape) for name in _IMAGES)
        found.append(Shown(DepthImages(nearest, farthest, moved, row["factor"])))
    return found


@dataclass(frozen=True, eq=False)
class Sampled:
    """Samples of the pictures of a batch."""

    cameras: list[str]
    files: list[str]
    epochs_gps_ns: list[int]
    sharpness: list[float]
    reasons: list[str]
    samples: list[PictureSample]


def read_samples(store: Store, record: OutputRecord) -> Sampled:
    """Returns the samples of a batch, in its order."""
    table = recorded_table(store, record, _SAMPLED)
    samples = [
        PictureSample(np.asarray(c, np.int64), np.asarray(v, np.float32).reshape(-1, 3))
        for c, v in zip(table["cell"].to_pylist(), table["colour"].to_pylist(), strict=True)
    ]
    cameras, files, epochs, sharpness, reasons = (table[name].to_pylist() for name in _SAMPLED[:5])
    return Sampled(cameras, files, epochs, sharpness, reasons, samples)


def _points(task: DepthTask, origin_m: Float64) -> Seen:
    """Returns the points around the pictures, from an origin in the map, in the order of time."""
    parts = list(_parts(task, origin_m))
    point = np.concatenate([np.zeros((0, 3), np.float32), *(p for p, _ in parts)])
    epochs = np.concatenate([np.zeros(0, np.int64), *(e for _, e in parts)])
    order = np.argsort(epochs, kind="stable")
    point = point[order]
    return Seen(point, normals_of(point), epochs[order])


def _parts(task: DepthTask, origin_m: Float64) -> Iterator[tuple[Float32, Int64]]:
    readings = task.readings
    if not readings.block.tiles:
        return
    window_ns = round(task.seconds * NS_PER_S)
    first, last = task.pictures.epochs_gps_ns[0] - window_ns, task.pictures.epochs_gps_ns[-1] + window_ns
    eyes = eyes_m(task.pictures)[:, :2] - origin_m[:2]
    low, high = eyes.min(axis=0) - task.beyond_m, eyes.max(axis=0) + task.beyond_m
    size_m = readings.ground.grid.size_m
    share = _MOST_POINTS / max(readings.readings, 1)
    placer = Georeferencer(readings.store, readings.ground, readings.slices)
    for one in readings.slices:
        for _, placed in placer.place(one, Window(*readings.block.box())):
            kept = (placed.epoch_gps_ns >= first) & (placed.epoch_gps_ns <= last)
            corner = np.column_stack([placed.tiles * size_m, np.zeros(len(placed.tiles))]) - origin_m
            point = corner + placed.quanta * QUANTUM_M
            kept &= ((point[:, :2] >= low) & (point[:, :2] <= high)).all(axis=1)
            kept &= _kept(placed.epoch_gps_ns, placed.quanta, share)
            if kept.any():
                yield point[kept].astype(np.float32), placed.epoch_gps_ns[kept]


def _kept(epoch_gps_ns: Int64, quanta: npt.NDArray[np.int32], share: float) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of about a share of points, spread evenly; it follows from time and place of each alone."""
    if share >= 1.0:
        return np.ones(epoch_gps_ns.size, np.bool_)
    mixed = epoch_gps_ns.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for k in range(3):
        mixed = (mixed ^ quanta[:, k].astype(np.uint64)) * np.uint64(0xC2B2AE3D27D4EB4F)
    return np.asarray((mixed >> np.uint64(40)) < np.uint64(share * 2**24))


def _sample(
    task: DepthTask, number: int, camera: Camera, images: DepthImages, picture: UInt8,
    points: tuple[Float32, Int64, Int64],
) -> PictureSample:  # fmt: skip
    """Returns the colours of the picture in the cubes that are compared."""
    point_m, epochs, cell = points
    lens = task.pictures.views.lens_of(number)
    limits = Limits(_SAMPLE_REACH * task.reach_m, float(task.border_px), 0.0, 0.0, task.rule.moment_ns, 1.0)
    colour, weight = np.zeros((len(point_m), 3), np.float32), np.zeros(len(point_m), np.float32)
    unknown = np.full((len(point_m), 3), np.nan, np.float32)
    look(
        point_m, epochs, unknown, camera, int(task.pictures.epochs_gps_ns[number]), Shown(images).depths, limits,
        lens.hidden, picture, colour, weight, np.empty(len(point_m), np.uint8),
    )  # fmt: skip
    return sample_of(cell, colour, weight)


def _row(
    pictures: Pictures, number: int, images: DepthImages, sharpness: float, reason: str, sample: PictureSample
) -> dict[str, object]:
    log = pictures.logs[pictures.log[number]]
    rows, columns = images.nearest.shape
    return {
        "camera": log.sensor, "file": pictures.files[number], "epoch_gps_ns": int(pictures.epochs_gps_ns[number]),
        "rows": rows, "columns": columns, "factor": images.factor,
        **{name: getattr(images, name).astype("<u2").tobytes() for name in _IMAGES},
        "sharpness": sharpness, "reason": reason, "cell": sample.cell, "colour": sample.colour.ravel(),
    }  # fmt: skip


GAINS: Final = "picture_gains"
_DIGITS: Final = 3
"""Decimals of gains: a picture more changes those of far ones by less, so their tiles stay as they are."""
_LEAST_WEIGHT: Final = 0.05  # Least weight of a blurred picture.
_SHARP: Final = 2.0  # Power of the relative sharpness that is the weight.


@dataclass(frozen=True)
class GainsTable:
    """The gains of the pictures of a run."""

    run: str
    key: str
    depths: tuple[OutputRecord, ...]
    """Batches of the run, in the order of time."""
    balance: bool


def plan_gains(plan: ColourPlan, manifest: Manifest) -> list[GainsTable]:
    """Returns the tables of all runs; their keys are those of the batches as they stand in the manifest."""
    code = code_digest("roadscan.colours.tasks.depths:write_gains")
    found = []
    for run in sorted({one.run for one in plan.batches}):
        held = [manifest.get(DEPTHS, one.unit) for one in plan.batches if one.run == run]
        records = tuple(one for one in held if one is not None)
        key = key_of(code, plan.config.balance, [one.digest for one in records])
        found.append(GainsTable(run, key, records, plan.config.balance))
    return found


def write_gains(store: Store, table: GainsTable) -> OutputRecord:
    """Compute the gains of a run from the samples of its pictures, and write them."""
    held = [read_samples(store, record) for record in table.depths]
    samples = [one for batch in held for one in batch.samples]
    gains, compared = gains_of(samples) if table.balance else (np.ones((len(samples), 3)), np.zeros(len(samples), int))
    sharpness = np.array([value for batch in held for value in batch.sharpness])
    reasons = [value for batch in held for value in batch.reasons]
    schema = table_schema(GAINS)
    rows = pa.table(
        {
            "run": [table.run] * len(samples), "camera": [v for b in held for v in b.cameras],
            "file": [v for b in held for v in b.files], "epoch_gps_ns": [v for b in held for v in b.epochs_gps_ns],
            **{f"gain_{name}": np.round(gains[:, k], _DIGITS) for k, name in enumerate(("red", "green", "blue"))},
            "compared": compared, "sharpness": sharpness,
            "weight": np.where([bool(v) for v in reasons], 0.0, np.round(weights_of(sharpness), _DIGITS)),
            "reason": [v or None for v in reasons],
        },
        schema=schema.arrow(),
    )  # fmt: skip
    content, target = parquet_bytes(rows, schema), f"{schema.location}/{table.run}.parquet"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(GAINS, table.run, table.key, target, len(content), bytes_digest(content))


def weights_of(sharpness: Float64) -> Float64:
    """Returns the weights (n,) of pictures by their sharpness (n,): 1 from the median of the run on."""
    known = sharpness[sharpness > 0.0]
    if not known.size:
        return np.ones(sharpness.size)
    return np.clip((sharpness / np.median(known)) ** _SHARP, _LEAST_WEIGHT, 1.0)


@dataclass(frozen=True, eq=False)
class PictureGains:
    """Gains and weights of the pictures of a survey, by their numbers."""

    gain: Float64
    """(n, 3) factors of red, green and blue."""
    weight: Float64
    """(n,) of sharpness."""
    reason: tuple[str, ...]
    """(n,) why a picture gives no colour; empty where it does."""


def read_gains(plan: ColourPlan, manifest: Manifest, tables: Sequence[GainsTable]) -> PictureGains:
    """Returns the gains of all pictures of the survey."""
    count = len(plan.pictures)
    gain, weight, reason = np.ones((count, 3)), np.ones(count), [""] * count
    pictures = plan.pictures
    named = zip(pictures.log.tolist(), pictures.files, pictures.epochs_gps_ns.tolist(), strict=True)
    rows: Mapping[tuple[str, str, str, int], int] = {  # two logs may have files of one name
        (pictures.logs[log].run, pictures.logs[log].sensor, file, epoch): number
        for number, (log, file, epoch) in enumerate(named)
    }
    for table in tables:
        record = manifest.get(GAINS, table.run)
        if record is None:
            continue
        held = recorded_table(plan.survey.store, record)
        for row in held.to_pylist():
            number = rows.get((row["run"], row["camera"], row["file"], row["epoch_gps_ns"]), -1)
            if number < 0:
                continue  # a table of other pictures: it is due
            gain[number] = row["gain_red"], row["gain_green"], row["gain_blue"]
            weight[number], reason[number] = row["weight"], row["reason"] or ""
    return PictureGains(gain, weight, tuple(reason))
