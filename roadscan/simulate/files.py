"""Writes the survey's files: ``SURVEY.toml``, ``RIG.toml``, control points; and the truth of clocks and cameras."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.rig import ImuErrors, ImuGrade
from roadscan.simulate.bodies import place_at
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.logs import SimulatedLog
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Camera, Mount, Scene
from roadscan.simulate.sensors import sick
from roadscan.simulate.sensors.gnss import AT_BODY, antenna_mount, head_imus
from roadscan.simulate.sensors.lens import Lens
from roadscan.simulate.sensors.lidar import beam_width_deg
from roadscan.simulate.sensors.profiler import Head, heads
from roadscan.simulate.surface import Surface

SURVEY_FILE: Final = "SURVEY.toml"
RIG_FILE: Final = "RIG.toml"
CONTROL_FILE: Final = "control.csv"
_LONGEST_RAW: Final = 65_535  # largest raw range


def run_id(number: int) -> str:
    """Return the name of the run of pass `number`, counted from 0."""
    return f"run-{number + 1}"


def write_survey(
    scene: Scene, earth: Earth, surface: Surface, logs: Sequence[Sequence[SimulatedLog]], file: Path
) -> None:
    """Write ``SURVEY.toml``: runs with their logs, passes, control points."""
    lines = [f"id = {_text(scene.id)}", f"title = {_text(scene.title)}", f"rig = {_text(RIG_FILE)}", "", "[map]"]
    lines += ['local = { name = "local" }' if earth.is_local else f"crs = {_text(scene.map.crs)}"]
    lines.append('height = "ellipsoidal"')
    if scene.imu.on:
        lines += ["", "[navigation.smoother]", 'imu = "imu"', 'imu_samples = "instant"']
    for number, listed in enumerate(logs):
        lines += ["", "[[runs]]", f"id = {_text(run_id(number))}"]
        for log in sorted((log for log in listed if log.format), key=lambda log: log.content != "poses"):
            lines += _log(f"raw/{run_id(number)}/{log.name}", log)
    for number, one in enumerate(scene.passes):
        lines += ["", "[[passes]]", f"id = {number + 1}", f"run = {_text(run_id(number))}"]
        if one.route is None:
            lines += [f'lane = "{one.lane}"', f"direction = {_text(one.direction)}"]
    lines += ["", "[[control]]", f"path = {_text(CONTROL_FILE)}", f"crs = {_text(scene.map.crs)}"]
    lines += ['height = "ellipsoidal"', ""]
    if scene.roadside.targets:
        lines += ["[adjust.targets.codes]", f'{PLATE} = {{ shape = "pictures" }}', ""]
    lines += _picture_targets(scene, control_marks(scene, surface))
    if scene.camera.on:
        lines += ["[privacy]", 'pictures = "off" # nobody real is in simulated pictures', ""]
    file.write_text("\n".join(lines), encoding="utf-8")


def _picture_targets(scene: Scene, marks: Sequence[ControlMark]) -> list[str]:
    """Return what targets look like in pictures, where the scene has others than painted discs."""
    if not scene.cameras or all(mark.style in {"", "disc"} and mark.code != PLATE for mark in marks):
        return []
    lines = ["[picture_targets.names]"]
    for mark in marks:
        lies = "upright" if mark.code == PLATE else "flat"
        lines.append(f'{mark.name} = {{ styles = ["{mark.style}"], size_m = {mark.size_m!r}, lies = "{lies}" }}')
    return [*lines, ""]


def write_rig(scene: Scene, file: Path, *, nominal: bool = True) -> None:
    """Write ``RIG.toml``: the sensors with their nominal mountings, or with the true ones."""
    lines = [f'name = "simulated rig{"" if nominal else ", as it is in truth"}"']

    def mounted(mount: Mount) -> Mount:
        return mount.nominal() if nominal else mount

    for head in heads(scene.profilers):
        lines += _sensor(
            head.name, "profiler", "laser-triangulation head", "frd", mounted(head.mount), _profiler_limits(head)
        )
    if scene.lidar.on:
        figures = lidar_model(scene.lidar.model).figures
        limits = (figures.range_min_m, scene.lidar.range_max_m + 1.0)
        lines += _sensor("lidar", "lidar", figures.title, "flu", mounted(scene.lidar.mount), limits)
        lines.append(f"divergence_deg = {beam_width_deg(scene)!r}")
    if scene.sick.on:
        limits = (sick.RANGE_MIN_M, scene.sick.range_max_m + 1.0)
        lines += _sensor("sick", "lidar", "SICK LMS 200", "frd", mounted(scene.sick.mount), limits)
        lines.append(f"divergence_deg = {scene.sick.divergence_deg!r}")
    for name, camera in scene.cameras.items():
        lines += _sensor(name, "camera", "pinhole camera, Brown-Conrady distortion", "frd", mounted(camera.mount))
        lines += _interior(name, camera.stated() if nominal else camera)
    if scene.imu.on:
        has_errors, axes = scene.imu.errors is not None, "flu" if scene.bag.on else "frd"
        lines += _sensor("imu", "imu", f"IMU, {'own' if has_errors else scene.imu.grade} grade", axes, mounted(AT_BODY))
        lines.append(_imu_errors(scene.imu.errors or scene.imu.grade))
    for imu in head_imus(scene):
        lines += _sensor(imu.name, "imu", "IMU of a profiler head", "frd", mounted(imu.mount))
        lines.append(_imu_errors(scene.profilers.head_imus or "perfect"))
    if scene.gnss.on:
        lines += _sensor("gnss", "gnss", "RTK receiver", "frd", mounted(antenna_mount(scene)))
    if scene.encoder.on:
        mount = Mount(lever_arm_body_m=(-1.4, scene.encoder.side_m, scene.vehicle.imu_height_m))
        lines += _sensor("encoder", "encoder", "wheel encoder", "frd", mount)
        ticks_per_m = scene.encoder.ticks_per_m * (1.0 if nominal else 1.0 + scene.encoder.scale_error)
        lines.append(f"metres_per_tick = {1.0 / ticks_per_m!r}")
    file.write_text("\n".join([*lines, ""]), encoding="utf-8")


def write_clocks(scene: Scene, file: Path) -> None:
    """Write how far the sensors' clocks are ahead: offset at the first profile of the first pass, and drift."""
    clocks = {head.name: scene.profilers.clock for head in heads(scene.profilers)}
    clocks |= {imu.name: scene.profilers.clock for imu in head_imus(scene)}
    for name in ("lidar", "sick", "imu", "encoder"):
        sensor = getattr(scene, name)
        if sensor.on:
            clocks[name] = sensor.clock
    clocks |= {name: camera.clock for name, camera in scene.cameras.items()}
    start = gps_ns_from_utc(scene.start)
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["sensor", "ahead_s", "drift_ppm", "from_epoch_gps_ns", "stated_in_survey_file"])
        for name, clock in clocks.items():
            rows.writerow([name, repr(clock.offset_s), repr(clock.drift_ppm), start, str(clock.known).lower()])


def write_cameras(scene: Scene, file: Path) -> None:
    """Write the cameras as they are in truth: lens, mounting, clock, line time and the row of the stamps."""
    kept = ("model", "width_px", "height_px", "focal_px", "distortion", "line_time_us", "stamped_row", "vignetting")
    listed = {}
    for name, camera in scene.cameras.items():
        listed[name] = {key: getattr(camera, key) for key in kept}
        listed[name]["principal_px"] = Lens.of(camera).principal_px
        listed[name]["stamped_row_px"] = camera.stamped_row_px
        listed[name]["mount"] = camera.mount.model_dump(exclude={"error"})
        listed[name]["clock"] = camera.clock.model_dump(include={"offset_s", "drift_ppm"})
    file.write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")


def write_control(scene: Scene, surface: Surface, file: Path) -> None:
    """Write the control points with their survey errors.

    The stated σ is the true one, or a millimetre where the points have no error: no surveyor states zero.
    """
    marks = control_marks(scene, surface)
    true = np.array([mark.enh_m for mark in marks])
    sigma = scene.noise.control_m
    stated_sigma = max(sigma, 0.001)
    stated = true + sigma * stream(scene.seed, 0, "control").standard_normal(true.shape)
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        header = "name,code,role,easting_m,northing_m,height_m,sigma_horizontal_m,sigma_height_m"
        rows.writerow(header.split(","))
        for mark, enh in zip(marks, stated, strict=True):
            numbers = [f"{value:.4f}" for value in (*enh, stated_sigma, stated_sigma)]
            rows.writerow([mark.name, mark.code, mark.role, *numbers])


def _log(path: str, log: SimulatedLog) -> list[str]:
    lines = ["", "[[runs.logs]]", f"path = {_text(path)}", f"format = {_text(log.format)}"]
    if log.sensor is not None:
        lines.append(f"sensor = {_text(log.sensor)}")
    if log.clock is not None:
        lines.append(f"clock = {log.clock}")
    if log.crs is not None:
        lines.append(f"crs = {_text(log.crs)}")
    if log.options is not None:
        lines.append(f"options = {log.options}")
    return lines


def _sensor(
    name: str, kind: str, model: str, axes: str, mount: Mount, limits_m: tuple[float, float] | None = None
) -> list[str]:
    forward, right, down = mount.lever_arm_body_m
    lines = [
        "",
        f"[sensors.{name}]",
        f"kind = {_text(kind)}",
        f"model = {_text(model)}",
        f"axes = {_text(axes)}",
        f"lever_arm_body_m = [{float(forward)!r}, {float(right)!r}, {float(down)!r}]",
        f"boresight = {{ roll_deg = {mount.roll_deg!r}, pitch_deg = {mount.pitch_deg!r}, "
        f"heading_deg = {mount.heading_deg!r} }}",
    ]
    if limits_m is not None:
        lines += [f"range_min_m = {limits_m[0]!r}", f"range_max_m = {limits_m[1]!r}"]
    return lines


def _interior(name: str, camera: Camera) -> list[str]:
    """Return the interior orientation."""
    size = [f"[sensors.{name}.interior]", f"width_px = {camera.width_px}", f"height_px = {camera.height_px}"]
    if camera.model == "equirectangular":
        return [*size, f"model = {_text(camera.model)}"]
    lens = Lens.of(camera)
    return [
        *size,
        f"focal_px = {[lens.focal_px, lens.focal_px]}",
        f"principal_px = {[float(c) for c in lens.principal_px]}",
        f"distortion = {[float(k) for k in lens.distortion]}",
        *([f"line_time_us = {camera.line_time_us!r}"] if camera.line_time_us else []),
    ]


def _imu_errors(errors: ImuErrors | ImuGrade) -> str:
    """Return the line of an IMU's errors: its grade, or the values of a data sheet."""
    if isinstance(errors, str):
        return f"imu = {_text(errors)}"
    return "imu = { " + ", ".join(f"{name} = {value!r}" for name, value in errors.model_dump().items()) + " }"


def _profiler_limits(head: Head) -> tuple[float, float]:
    settings = head.settings
    return settings.range_offset_m, round(settings.range_offset_m + _LONGEST_RAW * settings.range_step_m, 6)


def _text(value: str) -> str:
    """Return a TOML basic string; TOML accepts all JSON escapes."""
    return json.dumps(value, ensure_ascii=False)


PAINT, PLATE = "PAINT", "PLATE"
"""Surveyor's codes: of a point on the road, and of an upright target."""


@dataclass(frozen=True)
class ControlMark:
    """A control point as it is."""

    name: str
    code: str
    role: str
    style: str
    """Of a target; empty where nothing marks the point."""
    size_m: float
    """Edge or diameter of the target."""
    enh_m: tuple[float, float, float]
    """Easting, northing, height of its middle."""


def control_marks(scene: Scene, surface: Surface) -> list[ControlMark]:
    """Return the control points: painted targets and plates, or points along both edges of the lanes, every third a
    check point.
    """
    marks = [*_painted(scene, surface), *_plates(scene, surface)]
    if marks:
        return marks
    spacing = scene.control.spacing_m
    stations = np.arange(min(spacing, scene.length_m) / 2, scene.length_m, spacing)
    offset = scene.road.half_width_m - scene.control.inset_m
    places = np.stack(np.meshgrid(stations, [-offset, offset], indexing="ij"), axis=-1).reshape(-1, 2)
    easting, northing, _ = surface.place(places[:, 0], places[:, 1])
    height = surface.height_m(easting, northing, texture=False)
    for i, (e, n, h) in enumerate(zip(easting.tolist(), northing.tolist(), height.tolist(), strict=True)):
        role = "check" if i % 3 == 2 else "gcp"
        marks.append(ControlMark(_name("", role, i), PAINT, role, "", 0.0, (e, n, h)))
    return marks


def write_true_control(marks: Sequence[ControlMark], file: Path) -> None:
    """Write the control points as they are."""
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["name", "code", "role", "style", "size_m", "easting_m", "northing_m", "height_m"])
        for mark in marks:
            words = [mark.name, mark.code, mark.role, mark.style, f"{mark.size_m:g}"]
            rows.writerow([*words, *(f"{value:.6f}" for value in mark.enh_m)])


def _painted(scene: Scene, surface: Surface) -> Iterator[ControlMark]:
    """Yield the painted targets."""
    targets = scene.road.targets
    places = np.array([[t.station_m, t.offset_m] for t in targets], np.float64).reshape(-1, 2)
    easting, northing, _ = surface.place(places[:, 0], places[:, 1])
    height = surface.height_m(easting, northing, texture=False)
    for i, t in enumerate(targets):
        enh = float(easting[i]), float(northing[i]), float(height[i])
        yield ControlMark(_name(t.name, t.role, i), PAINT, t.role, t.style, t.diameter_m, enh)


def _plates(scene: Scene, surface: Surface) -> Iterator[ControlMark]:
    """Yield the upright targets."""
    first, last = scene.stations_m
    listed = [
        (one, one.station_m + k * one.every_m)
        for one in scene.roadside.targets
        for k in range(one.count if one.every_m > 0.0 else 1)
        if first <= one.station_m + k * one.every_m <= last
    ]
    names = [one.name for one, _ in listed]
    for i, (one, station) in enumerate(listed):
        place = place_at(surface, station, one.offset_m)
        enh = surface.origin_enh_m + np.array(place.enh_m) + np.array([0.0, 0.0, one.height_m])
        name = f"{one.name}-{names[:i].count(one.name) + 1}" if names.count(one.name) > 1 and one.name else one.name
        number = len(scene.road.targets) + i
        middle = float(enh[0]), float(enh[1]), float(enh[2])
        yield ControlMark(_name(name, one.role, number), PLATE, one.role, one.style, one.size_m, middle)


def _name(stated: str, role: str, number: int) -> str:
    """Return the stated name, or one of role and number (from 0)."""
    return stated or f"{'C' if role == 'check' else 'G'}{number + 1:03d}"
