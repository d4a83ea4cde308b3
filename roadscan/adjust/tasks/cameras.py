"""Pictures and cameras in an adjustment.

What goes in: tie points, and control points measured in pictures. What comes out: the table `camera_corrections`,
residuals, and what is said of cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from roadscan.adjust.adjustment import CameraErrors
from roadscan.adjust.bundle.measurements import Measurements, Numbers
from roadscan.adjust.bundle.outcome import ControlOfPictures, FreeCameras, PictureOutcome
from roadscan.adjust.bundle.solve import PictureEvidence
from roadscan.adjust.control import ControlPoint
from roadscan.adjust.observations import CameraPrior
from roadscan.adjust.settings import AdjustConfig, CameraPriors
from roadscan.adjust.tasks.edge_scores import (
    BORESIGHTS,
    RETURNS,
    SCORES,
    DepthTask,
    EdgeTask,
    boresight_findings,
    boresight_lines,
    boresight_rows,
    depth_tasks,
    edge_tasks,
    load_boresights,
    load_returns,
    write_returns,
    write_scores,
)
from roadscan.adjust.tasks.mountings import Mounted, adjusted_cameras, asks_pictures, camera_sigma
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.counted import counted, listed
from roadscan.core.grid import of_run
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan, mountings_of, trajectory_source
from roadscan.georeference.sources import load_mountings, road_key
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.pictures.exposures import Exposures, camera_pictures, exposures_of
from roadscan.pictures.lens import COLUMNS, JOINT, JOINT_TABLE, TABLE
from roadscan.pictures.points import POINTS, measured_points
from roadscan.pictures.ties.tracks import ALL, TRACKS
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store

AskedOfPictures = DepthTask | EdgeTask
Collect = Callable[[str, Callable[[Any], OutputRecord], Sequence[AskedOfPictures]], None]
"""Updates the files of a product: its name, the function that writes one, and the tasks."""
_NAMED: Final = 5  # Names that a note lists.
_START_PX: Final = 0.5
"""1 σ of a tie point (px) until its residuals show it."""
_BLUNT_PX: Final = 8.0
"""Diameter (px) from which on the place of a feature is the less certain the larger it is, by the simulator's truth: σ
is 0.19 px below 6 px, 0.26 at 8, 0.46 at 15, 0.62 at 30."""
_BESIDE_NS: Final = 1_000_000_000
"""Time (ns) before the first picture and after the last one that corrections reach: clocks and rows are off by less."""


def exposure_epochs(plan: SurveyPlan) -> dict[str, Int64]:
    """Returns the epochs (e,), ascending, of the pictures of each run; none where pictures take no part."""
    found: dict[str, list[Int64]] = {}
    for name in adjusted_cameras(plan.survey):
        for taken in camera_pictures(plan, name):
            found.setdefault(taken.record.run, []).append(taken.epochs_gps_ns)
    epochs = {run: np.unique(np.concatenate(parts)) for run, parts in found.items()}
    return {run: own for run, own in epochs.items() if own.size}


def exposure_span(epochs_gps_ns: Int64) -> tuple[int, int]:
    """Returns first and last epoch (GPS ns) that corrections of pictures reach."""
    return int(epochs_gps_ns[0]) - _BESIDE_NS, int(epochs_gps_ns[-1]) + _BESIDE_NS


def pictures_key(plan: SurveyPlan, manifest: Manifest) -> list[Any]:
    """Returns what the evidence of pictures depends on, for the key of the solution. It reads no pose."""
    if not asks_pictures(plan.survey):
        return []
    tracks, cameras = manifest.get(TRACKS, ALL), adjusted_cameras(plan.survey)
    clocks, mountings = load_clocks(plan.store), load_mountings(plan.store)
    logs = list[list[Any]]()
    for record in plan.records:
        if record.tables.get("images") and record.sensor in cameras:
            posed = [file.digest for file in trajectory_source(record.run, plan.records).files]
            seat = mountings_of(record.run, record.sensor, cameras[record.sensor].mounting(), mountings)
            logs.append([record.key, posed, repr(of_run(clocks, record.run, record.sensor)), repr(seat)])
        elif record.tables.get(POINTS):
            logs.append([record.key, record.run, record.sensor])
    stated = [[name, one.model_dump(mode="json")] for name, one in cameras.items()]
    logs += [[s.key, *road_key(s), [f.digest for f in files]] for s, files in plan.sources if s.table == "returns"]
    return ["" if tracks is None else tracks.digest, plan.ground.max_gap_s, stated, logs]


def pictures_of(
    plan: SurveyPlan, manifest: Manifest, runs: Sequence[str], mounted: Mounted, points: Sequence[ControlPoint],
    collect: Collect,
) -> PictureEvidence | None:  # fmt: skip
    """Returns the evidence of a survey's pictures; None where they take no part, or show nothing.

    Parameters
    ----------
    runs : by which observations number them.
    mounted : the mountings that are estimated.
    points : control points of the survey.
    collect : updates what tasks write.
    """
    if not asks_pictures(plan.survey):
        return None
    exposures, notes = exposures_of(plan)
    sensors = sorted({camera.sensor for camera in exposures.cameras})
    priors = AdjustConfig.of(plan.survey).cameras
    cameras = tuple(CameraPrior(one, camera_sigma(plan.survey.rig.sensors[one], priors)[1]) for one in sensors)
    seats, keys = [("*", camera.sensor) for camera in exposures.cameras], [one.key for one in mounted.priors]
    numbers = Numbers(
        np.array([runs.index(camera.run) for camera in exposures.cameras], np.int32),
        np.array([keys.index(one) if one in keys else -1 for one in seats], np.int32),
        np.array([sensors.index(camera.sensor) for camera in exposures.cameras], np.int32),
    )
    index = {_named(exposures, k): k for k in range(len(exposures))}
    logs = [camera.log for camera in exposures.cameras]
    of_logs = {(logs[c], str(f)): k for k, (c, f) in enumerate(zip(exposures.camera, exposures.file, strict=True))}
    tracks = _tracks(plan.store, manifest, of_logs)
    control, number, more = _control(plan, priors, index, points)
    notes = (*notes, *more)
    tied = int(tracks.point.max(initial=-1)) + 1
    whole = _joined(tracks, control, tied)
    if not whole.point.size:
        return None
    surveyed = [points[k] for k in number.tolist()]
    place = _world(plan, exposures, surveyed)
    sigma = np.array([[p.sigma_horizontal_m, p.sigma_height_m] for p in surveyed]).reshape(-1, 2)
    measured = Measurements(
        exposures, whole.picture, whole.pixel, whole.sigma_px, whole.point,
        np.concatenate([np.full((tied, 3), np.nan), place]), np.concatenate([np.full((tied, 2), np.nan), sigma]),
    )  # fmt: skip
    is_check = np.array([False] * tied + [p.role != "gcp" for p in surveyed], bool)
    tasks = depth_tasks(
        plan, exposures, (tracks.picture, tracks.pixel), priors,
        lambda sensor: float(camera_sigma(plan.survey.rig.sensors[sensor], priors)[0][3:6].max()),
    )  # fmt: skip
    collect(RETURNS, write_returns, tasks)
    returns = load_returns(manifest, tasks, mounted, plan)
    compared = edge_tasks(plan, exposures, priors)
    collect(SCORES, write_scores, compared)
    edges = load_boresights(manifest, compared, mounted, numbers, plan, priors)
    named = np.concatenate([np.full(tied, -1), [p.number for p in surveyed]]).astype(np.int64)
    return PictureEvidence(
        measured, numbers, cameras, named, ~is_check[measured.point], priors.sigma_shared_px, notes, returns,
        (priors.sigma_depth_m, priors.sigma_shared_depth_m), edges,
    )  # fmt: skip


def _named(exposures: Exposures, number: int) -> tuple[str, str, str]:
    camera = exposures.cameras[exposures.camera[number]]
    return camera.run, camera.sensor, str(exposures.file[number])


class _Part(NamedTuple):
    """Measurements of some points."""

    picture: Int64
    """(m,) number of the picture."""
    pixel: Float64
    """(m, 2)"""
    sigma_px: Float64
    """(m,)"""
    point: Int64
    """(m,) number of the point, from 0."""


def _joined(tracks: _Part, control: _Part, tied: int) -> _Part:
    """Returns tie points, then control points."""
    return _Part(
        np.concatenate([tracks.picture, control.picture]), np.concatenate([tracks.pixel, control.pixel]),
        np.concatenate([tracks.sigma_px, control.sigma_px]), np.concatenate([tracks.point, control.point + tied]),
    )  # fmt: skip


def _tracks(store: Store, manifest: Manifest, index: dict[tuple[str, str], int]) -> _Part:
    """Returns the measurements of tie points; `index` numbers pictures by log and file."""
    record = manifest.get(TRACKS, ALL)
    if record is None or not record.path:
        return _Part(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    rows = recorded_table(store, record)
    names = zip(*(rows.column(c).to_pylist() for c in ("log", "file")), strict=True)
    picture = np.array([index.get(one, -1) for one in names], np.int64)
    here = picture >= 0
    pixel = np.stack([rows.column(c).to_numpy() for c in ("u_px", "v_px")], axis=-1).astype(np.float64)
    number = np.unique(rows.column("track").to_numpy()[here], return_inverse=True)[1].astype(np.int64)
    size = rows.column("size_px").to_numpy().astype(np.float64)[here]
    return _Part(picture[here], pixel[here], _START_PX * np.hypot(1.0, size / _BLUNT_PX), number)


def _control(
    plan: SurveyPlan, priors: CameraPriors, index: dict[tuple[str, str, str], int], points: Sequence[ControlPoint]
) -> tuple[_Part, Int64, list[str]]:
    """Returns measurements of control points, the control point of each point, and notes on those left out."""
    found = measured_points(plan.store, plan.records, plan.survey.rig)
    known = {one.name: k for k, one in enumerate(points) if not one.is_of_line}
    unknown, unplaced = set[str](), set[str]()
    picture, point, values = list[int](), list[int](), list[tuple[float, float, float]]()
    for row in found.rows.to_pylist():
        at = index.get((row["run"], row["sensor"], row["picture"]))
        if row["point"] not in known:
            unknown.add(row["point"])
        elif at is None:
            unplaced.add(row["picture"])
        else:
            picture.append(at)
            point.append(known[row["point"]])
            values.append((row["u_px"], row["v_px"], row["sigma_px"] or priors.sigma_control_px))
    number, own = np.unique(np.array(point, np.int64), return_inverse=True)
    notes = [*found.notes]
    notes += [f"no control point is called {listed(sorted(unknown), _NAMED)}: not used"] if unknown else []
    notes += [f"no pose for {listed(sorted(unplaced), _NAMED)}: points in it are not used"] if unplaced else []
    measured = np.array(values, np.float64).reshape(-1, 3)
    part = _Part(np.array(picture, np.int64), measured[:, :2], measured[:, 2], own.astype(np.int64))
    return part, number.astype(np.int64), notes


def _world(plan: SurveyPlan, exposures: Exposures, points: Sequence[ControlPoint]) -> Float64:
    """Returns places (p, 3) of control points in the world frame of the poses."""
    if not points:
        return np.zeros((0, 3))
    enh = np.array([[p.easting_m, p.northing_m, p.height_m] for p in points])
    return plan.ground.map.world_from_map(exposures.cameras[0].world, enh)


_UPPER: Final = np.triu_indices(JOINT)
"""Entries of a joint covariance that the table holds."""
_SAME: Final = 0.01
"""Values that change by no more than this share of their σ stay, so that what rests on them stays current."""
_KNOWN: Final = 0.7
"""A value whose σ fell below this share of the stated one is determined: its variance is halved."""
_LEAST_SHARE: Final = 0.7
"""Share of the measurements of tie points that count, at least: of right pictures it is 0.85 to 0.92."""
_MOST_PX: Final = 1.0  # RMS of tie points (px), at most: of right pictures it is 0.3 to 0.5.
PICTURE_FIT: Final = Witness(
    "picture_fit",
    input="pictures",
    fault="Stamps, lens or mounting of a camera are wrong by more than the adjustment can take out.",
    asks="tie points: how many of their measurements agree with one another, and to how many pixels",
    does="it is told; the measurements that disagree do not count",
    told=("findings",),
)
PICTURE_LENS: Final = Witness(
    "picture_lens",
    input="pictures",
    fault="The lens is not the one that the rig file states: another zoom or camera, or pictures that were rectified.",
    asks="tie points and the turns of the poses: focal length and k1 that they have without those that are stated",
    does="it is told; the lens is used as stated, with its σ",
    told=("findings",),
)
PICTURE_STAMPS: Final = Witness(
    "picture_stamps",
    input="pictures",
    fault="The stamps of the pictures are late or early, or those of the pictures before or after.",
    asks="tie points and the turns of the poses: the time by which one follows the other",
    does="it is told; the stamps are used as they are, with their σ",
    told=("findings",),
)
_LEAST_FOCAL: Final = 0.01
"""A focal length is reported as wrong from this share on: 0.2 m across at 20 m."""
_LEAST_K1: Final = 0.02  # k1 is wrong from here on: the right one of `drive_left` was found up to 0.014 off.
_LEAST_CLOCK_S: Final = 0.005  # A clock is reported as wrong from here on (s): 10 cm at 70 km/h.
_WORDS: Final = {
    "focal_x_px": ("focal length", 1.0, "px"), "centre_x_px": ("principal point, right", 1.0, "px"),
    "centre_y_px": ("principal point, down", 1.0, "px"), "k1": ("k1", 1.0, ""), "clock_s": ("clock", 1e3, "ms"),
    "line_time_s": ("row time", 1e6, "µs"),
}  # fmt: skip
"""What is said of a camera: words, factor and unit."""


def publish_cameras(store: Store, found: CameraErrors | None) -> None:
    """Update the tables; a solution that changes nothing leaves the corrections as they are."""
    _publish_joint(store, found)
    table = read_small(store, TABLE)
    before = {row["sensor"]: row for row in ([] if table is None else table.to_pylist())}
    after: dict[str, dict[str, Any]] = {}
    for k, sensor in enumerate(() if found is None else found.sensors):
        if found is not None and found.error[k].any():
            row = _row(found, k)
            known = before.get(sensor)
            after[sensor] = known if known is not None and _stays(known, row) else row
    if after == before:
        return
    if after:
        write_small(store, TABLE, [after[sensor] for sensor in sorted(after)])
    else:
        store.remove(small_path(TABLE))


def _publish_joint(store: Store, found: CameraErrors | None) -> None:
    rows = [
        {
            "run": one.run,
            "sensor": one.sensor,
            "epoch_gps_ns": int(epoch),
            "covariance": values[_UPPER].tolist(),
            "later": later.ravel().tolist(),
        }
        for one in (() if found is None else found.joint)
        for epoch, values, later in zip(one.epochs_gps_ns.tolist(), one.covariance, one.later, strict=True)
    ]
    if rows:
        write_small(store, JOINT_TABLE, rows)
    elif store.exists(small_path(JOINT_TABLE)):
        store.remove(small_path(JOINT_TABLE))


def _row(found: CameraErrors, k: int) -> dict[str, Any]:
    columns = {"": found.error[k], "sigma_": found.sigma[k], "prior_sigma_": found.prior_sigma[k]}
    return {"sensor": found.sensors[k]} | {
        f"{prefix}{name}": float(value)
        for prefix, values in columns.items()
        for name, value in zip(COLUMNS, values, strict=True)
    }


def _stays(known: dict[str, Any], row: dict[str, Any]) -> bool:
    return all(abs(known[c] - row[c]) <= _SAME * row[f"sigma_{c}"] for c in COLUMNS)


def picture_rows(found: PictureOutcome | None) -> dict[str, list[dict[str, Any]]]:
    """Returns rows of the tables of the outcome."""
    if found is None:
        return {}
    measured = found.measured
    rows: list[dict[str, Any]] = []
    for m, picture in enumerate(measured.picture.tolist()):
        camera = measured.exposures.cameras[measured.exposures.camera[picture]]
        point = int(measured.point[m])
        rows.append(
            {
                "run": camera.run, "sensor": camera.sensor, "file": str(measured.exposures.file[picture]),
                "point": found.names[point] or None, "track": None if found.names[point] else point,
                "u_px": float(measured.pixel[m, 0]), "v_px": float(measured.pixel[m, 1]),
                "sigma_px": float(measured.sigma_px[m]),
                "before_u_px": _finite(found.before_px[m, 0]), "before_v_px": _finite(found.before_px[m, 1]),
                "after_u_px": _finite(found.after_px[m, 0]), "after_v_px": _finite(found.after_px[m, 1]),
                "weight": _finite(found.weight[m]),
            }
        )  # fmt: skip
    control = [_control_row(one) for one in found.control]
    edges = boresight_rows(found.edges)
    depths = list(_depth_rows(found))
    return {"picture_residuals": rows, "picture_control": control, "depth_residuals": depths, BORESIGHTS: edges}


def _depth_rows(found: PictureOutcome) -> Iterator[dict[str, Any]]:
    """Yield rows of the table of distances from surfaces of lidars."""
    if found.depths is None:
        return
    measured, depths = found.measured, found.depths
    away = np.linalg.norm(depths.surfaces.point_body_m - depths.surfaces.lever_body_m, axis=1)
    for k, m in enumerate(depths.surfaces.measurement.tolist()):
        picture = int(measured.picture[m])
        camera = measured.exposures.cameras[measured.exposures.camera[picture]]
        yield {
            "run": camera.run, "sensor": camera.sensor, "file": str(measured.exposures.file[picture]),
            "track": int(measured.point[m]), "lidar": str(depths.surfaces.lidar[k]), "distance_m": float(away[k]),
            "sigma_m": float(depths.sigma_m[k]), "before_m": _finite(depths.before_m[k]),
            "after_m": _finite(depths.after_m[k]), "weight": float(depths.weight[k]),
        }  # fmt: skip


def _control_row(one: ControlOfPictures) -> dict[str, Any]:
    row: dict[str, Any] = {"point": one.point.name, "role": one.point.role, "pictures": one.pictures}
    for word, values in (("before", one.before_m), ("after", one.after_m), ("sigma", one.sigma_m)):
        row |= {f"{word}_{axis}_m": _finite(v) for axis, v in zip(("north", "east", "down"), values, strict=True)}
    return row


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def picture_findings(found: PictureOutcome | None) -> list[Finding]:
    """Returns findings where pictures do not fit to one another, whatever the poses, and not to edges of lidars."""
    if found is None:
        return []
    edges = boresight_findings(found.edges)
    if found.against_edges:
        said = (
            "range edges of lidars, or the stated lever arm of the camera beside them, contradict tie points by "
            f"{found.against_edges:.1f} σ: these are of things that move, the poses are off by more than is stated, or "
            "the lever arm is; tie points count as if those of a picture were off by "
            f"{found.shared_px:.2g} px in common"
        )
        edges.append(PICTURE_FIT.finds("pictures", said))
    if not found.measured.is_tie.any():
        return edges
    tie = found.measured.is_tie
    share, left = float((found.weight[tie] > 0.0).mean()), found.rms_px(after=True)
    if share >= _LEAST_SHARE and left <= _MOST_PX:
        return edges
    said = (
        f"{share:.0%} of the measurements of tie points agree with one another, to {left:.2f} px: of right stamps, "
        f"lens and mounting it is {_LEAST_SHARE:.0%} or more, to {_MOST_PX:g} px; corrections of the poses rest on them"
    )
    return [PICTURE_FIT.finds("pictures", said), *edges]


def camera_findings(free: FreeCameras | None) -> list[Finding]:
    """Returns findings on lenses and clocks that are not what the rig file and the stamps say."""
    if free is None:
        return []
    # Stamps that are wrong bend what is found of the lens: that is reported once they are right.
    return [said for k in range(len(free.stated)) for said in _of_clock(free, k) or _of_lens(free, k)]


def _of_lens(free: FreeCameras, k: int) -> list[Finding]:
    """Returns a finding where the focal length or k1 of a camera is not the stated one."""
    focal, said = float(free.focal_px[k]), list[str]()
    for name, word, least in (
        ("focal_x_px", "focal length", _LEAST_FOCAL * focal), ("focal_y_px", "focal length", _LEAST_FOCAL * focal),
        ("k1", "distortion k1", _LEAST_K1),
    ):  # fmt: skip
        error, sigma = free.off(k, name)
        if abs(error) > least and not any(word in one for one in said):
            unit = " px" if word == "focal length" else ""
            said.append(f"{word} {error:+.3g}{unit} (σ {sigma:.2g}) from the stated one")
    if not said:
        return []
    text = (
        f"tie points, and the turns of the poses, say of the lens: {', '.join(said)}; it is used as stated, and poses "
        "take up the difference. Calibrate it (roadscan camera interior), or state how well it is known "
        "(adjust.cameras)"
    )
    return [PICTURE_LENS.finds(free.stated[k].sensor, text)]


def _of_clock(free: FreeCameras, k: int) -> list[Finding]:
    """Returns a finding where the stamps of a camera are not those of the poses."""
    (error, sigma), lag = free.off(k, "clock_s"), free.lag[k]
    if lag:
        side = "late" if lag > 0 else "early"
        turns = "the turns from picture to picture are those of the poses"
        said = f"{turns} if stamps are {side} by {counted(abs(lag), 'picture')}"
    elif abs(error) > _LEAST_CLOCK_S:
        said = (
            f"pictures turn as the poses do if {1e3 * error:+.0f} ms (σ {1e3 * sigma:.0f} ms) are added to their stamps"
        )
    else:
        return []
    text = (
        f"{said}; stamps are used as they are, and poses take up the difference. Mend the stamps, or let the "
        "adjustment estimate a clock that is off by less than a picture (adjust.cameras.sigma_clock_s)"
    )
    return [PICTURE_STAMPS.finds(free.stated[k].sensor, text)]


def picture_lines(found: PictureOutcome | None, cameras: CameraErrors | None, free: FreeCameras | None) -> list[str]:
    """Returns what pictures said, in words."""
    if found is None:
        return []
    tie = found.measured.is_tie
    used = int(((found.weight > 0.0) & tie).sum())
    pictures = np.unique(found.measured.picture[(found.weight > 0.0)]).size
    points = np.unique(found.measured.point[tie]).size
    lines = [
        f"{pictures:,} of {len(found.measured.exposures):,} pictures take part, with {used:,} of {int(tie.sum()):,} "
        f"measurements of {points:,} tie points: RMS {found.rms_px(after=False):.2f} px before, "
        f"{found.rms_px(after=True):.3f} px after; 1 σ of one is {found.sigma_px:.2f} px; χ² over redundancy "
        f"{found.chi_square:.3f} (95 %: {found.bounds[0]:.3f} to {found.bounds[1]:.3f})"
    ]
    for role, word in (("gcp", "control points"), ("check", "check points")):
        own = [one for one in found.control if one.point.role == role and np.isfinite(one.after_m).all()]
        if own:
            was, now = (np.sqrt(np.mean([(v**2).sum() for v in values])) for values in (
                [one.before_m for one in own], [one.after_m for one in own],
            ))  # fmt: skip
            lines.append(
                f"{counted(len(own), word[:-1])} in pictures: RMS in space {1e3 * was:.0f} mm before, "
                f"{1e3 * now:.1f} mm after"
            )
    if found.depths is not None:
        holds = found.depths.weight > 0.0
        was, now = (
            float(np.nanmedian(np.abs(v[holds]))) if holds.any() else float("nan")
            for v in (found.depths.before_m, found.depths.after_m)
        )
        lines.append(
            f"{int(holds.sum()):,} of {holds.size:,} depths of the lidar at tie points count: half of them "
            f"within {1e3 * was:.0f} mm before, {1e3 * now:.0f} mm after; "
            f"{found.moving:,} tie points that it saw elsewhere (things that move) are left out"
        )
    return [*lines, *boresight_lines(found.edges), *_camera_lines(cameras, free), *found.notes]


def _camera_lines(cameras: CameraErrors | None, free: FreeCameras | None) -> list[str]:
    lines = list[str]()
    if cameras is None:
        return lines
    for k, sensor in enumerate(cameras.sensors):
        words = []
        for name, (word, factor, unit) in _WORDS.items():
            column = COLUMNS.index(name)
            error, sigma, prior = (v[k, column] for v in (cameras.error, cameras.sigma, cameras.prior_sigma))
            if name == "focal_x_px" and prior > 0.0 and sigma >= _KNOWN * prior and free is not None:
                words.append(f"a focal length that is off by more than {free.seen_from(k):.1%} would show")
            if prior > 0.0 and sigma < _KNOWN * prior:
                words.append(f"{word} {factor * error:+.3g} {unit} (σ {factor * sigma:.2g})".replace("  ", " "))
        if words:
            lines.append(f"lens and clock of {sensor}: {'; '.join(words)}")
    return lines
