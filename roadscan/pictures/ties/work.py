"""The work of tie points: features a picture, matches a picture with those it is compared with, tracks of a survey."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.navigation.tasks.trajectories import usual_pose_sigma
from roadscan.pictures.exposures import Camera, Exposures, exposures_of, read_picture
from roadscan.pictures.lens import Lens, rays_of
from roadscan.pictures.settings import PictureTiesConfig
from roadscan.pictures.ties.matching import DESCRIPTOR, Features, Relative, features_of, matches, pairs_of
from roadscan.pictures.ties.own_vehicle import OWN_VEHICLE, cells_from, cells_of, compare, compared_pictures, detail_of
from roadscan.pictures.ties.own_vehicle import rows_of as rows_of_cells
from roadscan.run.keys import code_digest, key_of
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

FEATURES: Final = "picture_features"
MATCHES: Final = "picture_matches"

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
class OwnVehicleTask:
    """Some pictures of a camera, spread over its drive."""

    store: Store
    exposures: Exposures
    lens: Lens
    records: tuple[OutputRecord | None, ...]
    """Features of each of the pictures."""
    unit: str
    key: str


@dataclass(frozen=True)
class Partner:
    """A picture that another one is compared with."""

    unit: str
    """Unit of its features."""
    lens: Lens
    relative: Relative
    own_vehicle: Bool | None
    """Cells of its camera's pictures that show the vehicle."""


@dataclass(frozen=True)
class MatchTask:
    """One picture with those that it is compared with."""

    store: Store
    record: OutputRecord
    """Its features."""
    records: tuple[OutputRecord, ...]
    """Features of the others."""
    lens: Lens
    own_vehicle: Bool | None
    """Cells of its camera's pictures that show the vehicle."""
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
    detail: dict[str, object] = {
        "features": len(found),
        "hidden": found.hidden,
        "content": bytes_digest(picture.tobytes()),
    }
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
            pa.array(found.of_sky.astype(np.uint8)),
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
    tasks, vehicles = [], _own_vehicles(work, manifest)
    starts = np.searchsorted(work.pairs[:, 0], np.arange(len(work.units) + 1))
    for first, record in enumerate(manifest.get(FEATURES, unit) for unit in work.units):
        others = [int(k) for k in work.pairs[starts[first] : starts[first + 1], 1] if int(k) not in left_out]
        found = [(k, r) for k in others if (r := manifest.get(FEATURES, work.units[k])) is not None and r.path]
        if record is None or not record.path or first in left_out or not found:
            continue
        partners = tuple(_partner(work, first, k, vehicles) for k, _ in found)
        shaping = [[p.unit, p.relative.turn.round(6).tolist(), p.relative.base.round(4).tolist()] for p in partners]
        sigmas = [[p.relative.sigma_turn_rad, p.relative.sigma_direction_rad] for p in partners]
        lenses = [work.camera(k).lens.parameters.tolist() for k in (first, *(k for k, _ in found))]
        own = vehicles[int(work.exposures.camera[first])]
        masks = [
            None if one is None else np.packbits(one).tobytes().hex()
            for one in (own, *(p.own_vehicle for p in partners))
        ]
        key = key_of(code, record.digest, [r.digest for _, r in found], shaping, sigmas, lenses, masks)
        tasks.append(
            MatchTask(
                work.features[first].store, record, tuple(r for _, r in found), work.camera(first).lens, own, partners,
                first, work.units[first], key,
            )
        )  # fmt: skip
    return tasks


def _partner(work: TieWork, first: int, second: int, vehicles: Sequence[Bool | None]) -> Partner:
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
    return Partner(work.units[second], other.lens, relative, vehicles[int(own.camera[1])])


def match_picture(task: MatchTask) -> OutputRecord:
    """Compare a picture with others and write what they have in common (runs on a worker)."""
    own = load_features(task.store, task.record)
    pixel_rad = 1.0 / float(task.lens.parameters[:2].max())
    shown = _beside_vehicle(own, task.lens, task.own_vehicle)
    first = rays_of(task.lens, own.pixel[shown].astype(np.float64)), own.descriptor[shown]
    names, rows, against = list[str](), list[Int64](), 0
    for partner, record in zip(task.partners, task.records, strict=True):
        other = load_features(task.store, record)
        there = _beside_vehicle(other, partner.lens, partner.own_vehicle)
        second = rays_of(partner.lens, other.pixel[there].astype(np.float64)), other.descriptor[there]
        found, more = matches(first, second, partner.relative, pixel_rad)
        names += [partner.unit] * len(found)
        rows.append(np.stack([shown[found[:, 0]], there[found[:, 1]]], axis=-1))
        against += more
    joined = np.concatenate(rows)
    table = pa.Table.from_arrays(
        [pa.array(names, pa.string()), pa.array(joined[:, 0], pa.int32()), pa.array(joined[:, 1], pa.int32())],
        schema=table_schema(MATCHES).arrow(),
    )
    detail = {"matches": len(joined), "own_vehicle": len(own) - shown.size, "against": against}
    return written(task.store, MATCHES, task.unit, task.key, table, json.dumps(detail))


def _beside_vehicle(features: Features, lens: Lens, own_vehicle: Bool | None) -> Int64:
    """Returns rows of the features that do not lie on the vehicle."""
    if own_vehicle is None:
        return np.arange(len(features))
    return np.flatnonzero(~own_vehicle[cells_of(features, lens)])


def load_features(store: Store, record: OutputRecord) -> Features:
    """Returns the features of a picture."""
    rows = recorded_table(store, record)
    pixel = np.stack([rows.column(name).to_numpy() for name in ("u_px", "v_px")], axis=-1)
    descriptor = rows.column("descriptor").combine_chunks().flatten().to_numpy()
    of_sky = rows.column("of_sky").to_numpy() > 0
    return Features(pixel, rows.column("size_px").to_numpy(), descriptor.reshape(-1, DESCRIPTOR), of_sky)


def own_vehicle_tasks(work: TieWork, manifest: Manifest) -> list[OwnVehicleTask]:
    """Returns a task for each camera of a run that has pictures to be compared."""
    code, tasks = code_digest(f"{__name__}:find_own_vehicle"), []
    for number, camera in enumerate(work.exposures.cameras):
        pictures = compared_pictures(work.exposures, number)
        if camera.lens.is_around or pictures.size < 2:
            continue
        own = work.exposures.at(pictures)
        records = tuple(manifest.get(FEATURES, work.units[k]) for k in pictures.tolist())
        digests = ["" if one is None else one.digest for one in records]
        posed = [v.round(4).tobytes().hex() for v in (own.world_from_opencv, own.eye_world_m, own.level_from_body)]
        unit = key_of(camera.run, camera.sensor, camera.log)
        key = key_of(code, digests, posed, camera.lens.parameters.tolist())
        tasks.append(OwnVehicleTask(work.features[0].store, own, camera.lens, records, unit, key))
    return tasks


def find_own_vehicle(task: OwnVehicleTask) -> OutputRecord:
    """Find what stands still in the pictures of a camera and write it (runs on a worker)."""

    def load(number: int) -> Features | None:
        record = task.records[number]
        return None if record is None or not record.path else load_features(task.store, record)

    found = compare(task.exposures, np.arange(len(task.exposures)), task.lens, load)
    rows = pa.Table.from_arrays(rows_of_cells(found), schema=table_schema(OWN_VEHICLE).arrow())
    return written(task.store, OWN_VEHICLE, task.unit, task.key, rows, detail_of(found))


def _own_vehicles(work: TieWork, manifest: Manifest) -> list[Bool | None]:
    """Returns the cells of each camera's pictures that show its vehicle; None where none do."""
    found = list[Bool | None]()
    for camera in work.exposures.cameras:
        record = manifest.get(OWN_VEHICLE, key_of(camera.run, camera.sensor, camera.log))
        there = record is not None and record.path and record.figures()["cells"]
        found.append(cells_from(recorded_table(work.features[0].store, record)) if record and there else None)
    return found


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
