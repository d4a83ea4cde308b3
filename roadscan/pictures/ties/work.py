"""The work of tie points: features a picture, matches a picture with those it is compared with, tracks of a survey."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.gpstime import NS_PER_S
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.navigation.tasks.pose_sigma import usual_pose_sigma
from roadscan.pictures.exposures import Camera, Exposures, exposures_of
from roadscan.pictures.files import read_picture
from roadscan.pictures.lens import rays_of
from roadscan.pictures.settings import PictureTiesConfig
from roadscan.pictures.ties.features import DESCRIPTOR, Features, features_of
from roadscan.pictures.ties.matching import Relative, matches
from roadscan.pictures.ties.pairs import pairs_of
from roadscan.pictures.ties.tracks import places_of, spread, tracks_of, widest_parallax_rad
from roadscan.pictures.views import Lens
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import parquet_bytes

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]

FEATURES: Final = "picture_features"
MATCHES: Final = "picture_matches"
CHAINS: Final = "picture_chains"
TRACKS: Final = "picture_tracks"
ALL: Final = "all"
"""Unit of chains and tracks in the manifest."""

_LEAST_TURN_DEG: Final = 0.03
"""1 σ of the turn between two neighbouring pictures, at least (degrees): that of a good attitude over a second."""
_LEAST_SHIFT_M: Final = 0.01
"""1 σ of the way between two pictures, at least (m)."""
_BORESIGHT_DEG: Final = 0.5
"""1 σ of the boresight of a camera whose rig file states none (degrees): measured by hand, or by a drawing."""
_CORRELATED_S: Final = 30.0
"""Time (s) after which the errors of two poses have nothing in common, about: half of it in a GNSS/INS solution."""
_BLACK: Final = 8
"""Fewest features of a picture that shows anything."""


@dataclass(frozen=True)
class FeatureTask:
    """One picture."""

    store: Store
    path: Path
    lens: Lens
    most: int
    unit: str
    key: str


@dataclass(frozen=True)
class Partner:
    """A picture that another one is compared with."""

    unit: str
    """Unit of its features."""
    lens: Lens
    relative: Relative


@dataclass(frozen=True)
class MatchTask:
    """One picture with those that it is compared with."""

    store: Store
    record: OutputRecord
    """Its features."""
    records: tuple[OutputRecord, ...]
    """Features of the others."""
    lens: Lens
    partners: tuple[Partner, ...]
    number: int
    """Number of the picture."""
    unit: str
    key: str


@dataclass(frozen=True)
class TieWork:
    """The pictures of a survey, and the pairs that are compared."""

    exposures: Exposures
    notes: tuple[str, ...]
    units: tuple[str, ...]
    """Of each picture."""
    features: tuple[FeatureTask, ...]
    pairs: Int64
    settings: PictureTiesConfig
    sigma: Float64
    """(c, 6) 1 σ of the poses of each camera's run."""

    def camera(self, number: int) -> Camera:
        """Returns the camera of a picture."""
        return self.exposures.cameras[int(self.exposures.camera[number])]


def plan_ties(plan: SurveyPlan) -> TieWork:
    """Returns the work of a survey's tie points; it reads no picture."""
    settings = PictureTiesConfig.of(plan.survey)
    exposures, notes = exposures_of(plan)
    code = code_digest(f"{__name__}:find_features")
    units, tasks = [], []
    for number in range(len(exposures)):
        camera = exposures.cameras[exposures.camera[number]]
        unit = key_of(camera.run, camera.sensor, camera.log, str(exposures.file[number]))
        key = key_of(code, camera.log, unit, settings.features, camera.lens.size_px, camera.rig.own_vehicle_px)
        units.append(unit)
        tasks.append(FeatureTask(plan.store, exposures.path(number), camera.lens, settings.features, unit, key))
    sigma = [
        usual_pose_sigma(
            plan.store, plan.records, trajectory_source(c.run, plan.records), plan.survey.config.navigation.calibration
        )
        for c in exposures.cameras
    ]
    pairs = pairs_of(exposures, settings)
    return TieWork(exposures, notes, tuple(units), tuple(tasks), pairs, settings, np.array(sigma).reshape(-1, 6))


def find_features(task: FeatureTask) -> OutputRecord:
    """Find the features of a picture and write them (runs on a worker)."""
    try:
        picture = read_picture(task.path, task.lens.size_px, grey=True)
    except (ImageError, OSError) as error:
        # The picture is lost, and named; another one may stand in its place by the next run.
        return OutputRecord(FEATURES, task.unit, task.key, "", 0, "", json.dumps({"features": 0, "why": str(error)}))
    found = features_of(picture, task.most, task.lens.hidden)
    detail: dict[str, object] = {"features": len(found), "content": bytes_digest(picture.tobytes())}
    if len(found) < _BLACK:
        grey = f"mean grey value {picture.mean():.0f}"
        detail["why"] = f"it shows {len(found)} features ({grey}): black, blank or covered"
        return OutputRecord(FEATURES, task.unit, task.key, "", 0, "", json.dumps(detail))
    schema = table_schema(FEATURES)
    rows = pa.Table.from_arrays(
        [
            pa.array(found.pixel[:, 0]), pa.array(found.pixel[:, 1]), pa.array(found.size_px),
            pa.ListArray.from_arrays(
                pa.array(np.arange(0, DESCRIPTOR * len(found) + 1, DESCRIPTOR), pa.int32()),
                pa.array(found.descriptor.ravel()),
            ),
        ],
        schema=schema.arrow(),
    )  # fmt: skip
    return written(task.store, FEATURES, task.unit, task.key, rows, json.dumps(detail))


def written(store: Store, product: str, unit: str, key: str, rows: pa.Table, detail: str) -> OutputRecord:
    """Write the rows of a unit; returns its record."""
    schema = table_schema(product)
    content = parquet_bytes(rows, schema)
    target = f"{schema.location}/{unit}.parquet"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(product, unit, key, target, len(content), bytes_digest(content), detail)


def match_tasks(work: TieWork, manifest: Manifest) -> list[MatchTask]:
    """Returns a task for each picture that has features and is compared with others that have some."""
    code = code_digest(f"{__name__}:match_picture")
    left_out = {number for number, _ in odd_pictures(work, manifest)}
    tasks = []
    starts = np.searchsorted(work.pairs[:, 0], np.arange(len(work.units) + 1))
    for first, record in enumerate(manifest.get(FEATURES, unit) for unit in work.units):
        others = [int(k) for k in work.pairs[starts[first] : starts[first + 1], 1] if int(k) not in left_out]
        found = [(k, r) for k in others if (r := manifest.get(FEATURES, work.units[k])) is not None and r.path]
        if record is None or not record.path or first in left_out or not found:
            continue
        partners = tuple(_partner(work, first, k) for k, _ in found)
        shaping = [[p.unit, p.relative.turn.round(6).tolist(), p.relative.base.round(4).tolist()] for p in partners]
        sigmas = [[p.relative.sigma_turn_rad, p.relative.sigma_direction_rad] for p in partners]
        lenses = [work.camera(k).lens.parameters.tolist() for k in (first, *(k for k, _ in found))]
        key = key_of(code, record.digest, [r.digest for _, r in found], shaping, sigmas, lenses)
        tasks.append(
            MatchTask(
                work.features[first].store, record, tuple(r for _, r in found), work.camera(first).lens, partners,
                first, work.units[first], key,
            )
        )  # fmt: skip
    return tasks


def _partner(work: TieWork, first: int, second: int) -> Partner:
    """Returns the second picture as the recorded poses place it beside the first."""
    own = work.exposures.at(np.array([first, second]))
    turns, eyes = own.world_from_opencv, own.eye_world_m
    base = turns[0].T @ (eyes[1] - eyes[0])
    one, other = work.camera(first), work.camera(second)
    apart_s = abs(int(own.epoch_gps_ns[1] - own.epoch_gps_ns[0])) / NS_PER_S
    share = 1.0 if one.run != other.run else 1.0 - float(np.exp(-apart_s / _CORRELATED_S))
    sigma = np.sqrt(2.0 * share) * work.sigma[own.camera].max(axis=0)
    turn = max(float(sigma[3:].max()), np.radians(_LEAST_TURN_DEG))
    shift = max(float(sigma[:3].max()), _LEAST_SHIFT_M) / max(float(np.linalg.norm(base)), 1e-3)
    stated_deg = [max(c.rig.boresight_sigma_deg or (_BORESIGHT_DEG,)) for c in (one, other)]
    boresight = float(np.hypot(*np.radians(stated_deg)))
    # A boresight that is off turns the base as both cameras see it; of two cameras it turns them against each other.
    if one.sensor != other.sensor:
        turn = float(np.hypot(turn, boresight))
    relative = Relative(turns[1].T @ turns[0], base, turn, float(np.hypot(shift, boresight)))
    return Partner(work.units[second], work.camera(second).lens, relative)


def match_picture(task: MatchTask) -> OutputRecord:
    """Compare a picture with others and write what they have in common (runs on a worker)."""
    own = _load(task.store, task.record)
    pixel_rad = 1.0 / float(task.lens.parameters[:2].max())
    first = rays_of(task.lens, own.pixel.astype(np.float64)), own.descriptor
    names, rows = list[str](), list[Int64]()
    for partner, record in zip(task.partners, task.records, strict=True):
        other = _load(task.store, record)
        second = rays_of(partner.lens, other.pixel.astype(np.float64)), other.descriptor
        found = matches(first, second, partner.relative, pixel_rad)
        names += [partner.unit] * len(found)
        rows.append(found)
    joined = np.concatenate(rows)
    table = pa.Table.from_arrays(
        [pa.array(names, pa.string()), pa.array(joined[:, 0], pa.int32()), pa.array(joined[:, 1], pa.int32())],
        schema=table_schema(MATCHES).arrow(),
    )
    return written(task.store, MATCHES, task.unit, task.key, table, json.dumps({"matches": len(joined)}))


def _load(store: Store, record: OutputRecord) -> Features:
    """Returns the features of a picture."""
    rows = recorded_table(store, record)
    pixel = np.stack([rows.column(name).to_numpy() for name in ("u_px", "v_px")], axis=-1)
    descriptor = rows.column("descriptor").combine_chunks().flatten().to_numpy()
    return Features(pixel, rows.column("size_px").to_numpy(), descriptor.reshape(-1, DESCRIPTOR))


def odd_pictures(work: TieWork, manifest: Manifest) -> list[tuple[int, str]]:
    """Returns numbers of pictures that give no tie points, with the reason: unreadable, black, or a copy of another."""
    found = list[tuple[int, str]]()
    before: dict[str, int] = {}
    for number, unit in enumerate(work.units):
        record = manifest.get(FEATURES, unit)
        if record is None:
            continue
        detail: Mapping[str, Any] = json.loads(record.detail)
        content = detail.get("content")
        if "why" in detail:
            found.append((number, str(detail["why"])))
        elif content in before:
            found.append((number, f"it is the same picture as {work.exposures.name(before[content])}"))
        elif content is not None:
            before[content] = number
    return found


def chains_key(work: TieWork, tasks: Sequence[MatchTask], manifest: Manifest) -> str:
    """Returns the key of the chains."""
    made = [(record.digest if (record := manifest.get(MATCHES, task.unit)) is not None else "") for task in tasks]
    settings = work.settings.model_dump(mode="json")
    return key_of(code_digest(f"{__name__}:write_chains"), settings, [task.key for task in tasks], made)


def write_chains(work: TieWork, tasks: Sequence[MatchTask], manifest: Manifest, store: Store) -> OutputRecord:
    """Join all matches to chains, and write those that are kept."""
    number = {unit: k for k, unit in enumerate(work.units)}
    counts = np.zeros(len(work.units), np.int64)
    for k, unit in enumerate(work.units):
        record = manifest.get(FEATURES, unit)
        counts[k] = 0 if record is None or not record.path else json.loads(record.detail)["features"]
    starts = np.concatenate([[0], np.cumsum(counts)])
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for task in tasks:
        record = manifest.get(MATCHES, task.unit)
        if record is None or not record.path:
            continue
        rows = recorded_table(store, record)
        names = rows.column("other").dictionary_encode().combine_chunks()
        others = np.array([number[name] for name in names.dictionary.to_pylist()], np.int64)
        first.append(starts[task.number] + rows.column("first").to_numpy())
        second.append(starts[others[names.indices.to_numpy()]] + rows.column("second").to_numpy())
    picture = np.repeat(np.arange(len(work.units)), counts)
    features, track = tracks_of(np.concatenate(first), np.concatenate(second), picture)
    pixel, size = _pixels(work, manifest, store, (features, picture[features], starts))
    kept, figures = _kept(work, track, picture[features], pixel)
    rows = rows_of(work, track[kept], picture[features][kept], (pixel[kept], size[kept]))
    odd = [[work.exposures.name(number), why] for number, why in odd_pictures(work, manifest)]
    detail = json.dumps({**figures, "odd": odd})
    return written(store, CHAINS, ALL, chains_key(work, tasks, manifest), rows, detail)


def _pixels(
    work: TieWork, manifest: Manifest, store: Store, chosen: tuple[Int64, Int64, Int64]
) -> tuple[Float64, Float64]:
    """Returns places (m, 2) and diameters (m,) of some features; pictures are read one by one.

    chosen : number of each feature, in order, its picture, and the first feature of every picture.
    """
    features, picture, starts = chosen
    pixel, size = np.empty((features.size, 2)), np.empty(features.size)
    ends = np.searchsorted(picture, np.arange(len(work.units) + 1))
    for number in np.unique(picture).tolist():
        record = manifest.get(FEATURES, work.units[number])
        if record is None:
            continue
        own = slice(ends[number], ends[number + 1])
        found, rows = _load(store, record), features[own] - starts[number]
        pixel[own], size[own] = found.pixel[rows], found.size_px[rows]
    return pixel, size


def _kept(work: TieWork, track: Int64, picture: Int64, pixel: Float64) -> tuple[npt.NDArray[np.bool_], dict[str, int]]:
    """Returns a mask (m,) of the measurements of tracks that are kept, and how many were left out for what.

    A tie point has to lie before its cameras, within reach, and be seen from directions far enough apart.
    """
    if not track.size:
        return np.zeros(0, bool), {"tracks": 0, "found": 0, "behind": 0}
    sight = np.empty((track.size, 3))
    sizes = np.empty((track.size, 2))
    for camera in range(len(work.exposures.cameras)):
        own = work.exposures.camera[picture] == camera
        lens = work.exposures.cameras[camera].lens
        sight[own], sizes[own] = rays_of(lens, pixel[own]), lens.size_px
    eye = work.exposures.eye_world_m[picture]
    ray = np.einsum("nij,nj->ni", work.exposures.world_from_opencv[picture], sight)
    found = places_of(track, eye, ray)
    wide = widest_parallax_rad(track, eye, found.place_m) >= np.radians(work.settings.least_parallax_deg)
    near = np.ones(len(found.place_m), bool)
    near[track[~((found.distance_m > 0.0) & (found.distance_m < work.settings.reach_m))]] = False
    behind = np.zeros(len(found.place_m), bool)
    behind[track[found.distance_m <= 0.0]] = True
    good = np.flatnonzero(wide & near)
    own = np.isin(track, good)
    number = np.searchsorted(good, track[own])
    chosen = spread(number, picture[own], pixel[own], sizes[own], work.settings.measurements)
    kept = np.zeros(track.size, bool)
    kept[np.flatnonzero(own)[chosen[number]]] = True
    figures = {"tracks": int(chosen.sum()), "found": len(near), "behind": int(behind.sum())}
    return kept, figures


def rows_of(work: TieWork, track: Int64, picture: Int64, of_feature: tuple[Float64, Float64]) -> pa.Table:
    """Returns rows of the tables of chains and tracks, by track and picture; tracks are numbered from 0."""
    order = np.lexsort((picture, track))
    exposures, rows = work.exposures, picture[order]
    cameras = [exposures.cameras[k] for k in exposures.camera[rows].tolist()]
    pixel, size = of_feature
    return pa.Table.from_arrays(
        [
            pa.array(np.unique(track[order], return_inverse=True)[1], pa.int64()),
            pa.array([c.run for c in cameras], pa.string()), pa.array([c.sensor for c in cameras], pa.string()),
            pa.array([c.log for c in cameras], pa.string()),
            pa.array(exposures.file[rows].tolist(), pa.string()), pa.array(pixel[order, 0], pa.float32()),
            pa.array(pixel[order, 1], pa.float32()), pa.array(size[order], pa.float32()),
        ],
        schema=table_schema(TRACKS).arrow(),
    )  # fmt: skip


@dataclass(frozen=True)
class Chains:
    """What several pictures show, m measurements, as the features lie."""

    track: Int64
    """(m,) number of the tie point, ascending from 0."""
    picture: Int64
    """(m,) number of the picture."""
    pixel: Float64
    """(m, 2)"""
    size_px: Float64
    """(m,) diameter of the feature."""


def chains_of(work: TieWork, manifest: Manifest, store: Store) -> Chains:
    """Returns the chains of a survey, as they were written last."""
    record = manifest.get(CHAINS, ALL)
    if record is None or not record.path:
        return Chains(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
    rows = recorded_table(store, record)
    logs = [work.exposures.cameras[k].log for k in work.exposures.camera.tolist()]
    number = {one: k for k, one in enumerate(zip(logs, work.exposures.file.tolist(), strict=True))}
    names = zip(*(rows.column(c).to_pylist() for c in ("log", "file")), strict=True)
    pixel = np.stack([rows.column(name).to_numpy() for name in ("u_px", "v_px")], axis=-1)
    picture = np.array([number[one] for one in names], np.int64)
    return Chains(rows.column("track").to_numpy(), picture, pixel.astype(np.float64), rows.column("size_px").to_numpy())
