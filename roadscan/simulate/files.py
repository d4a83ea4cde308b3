"""The survey's own files: ``SURVEY.toml``, ``RIG.toml`` and the control points."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.model.gpstime import utc_from_gps_ns
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar import RANGE_MIN_M
from roadscan.simulate.noise import stream
from roadscan.simulate.profiler import Head, heads
from roadscan.simulate.scene import Mount, Scene
from roadscan.simulate.surface import Surface

SURVEY_FILE: Final = "SURVEY.toml"
RIG_FILE: Final = "RIG.toml"
CONTROL_FILE: Final = "control.csv"
_LONGEST_RAW: Final = 65_535


def run_id(number: int) -> str:
    """Name of the run of pass `number`, counted from 0."""
    return f"run-{number + 1}"


def write_survey(scene: Scene, drives: Sequence[Drive], file: Path) -> None:
    """Write ``SURVEY.toml``: runs with their logs, passes, control points."""
    crs = _text(drives[0].earth.geographic_crs)
    lines = [
        f"id = {_text(scene.id)}",
        f"title = {_text(scene.title)}",
        f"rig = {_text(RIG_FILE)}",
        "",
        "[map]",
        f"crs = {_text(scene.map.crs)}",
        'height = "ellipsoidal"',
    ]
    for drive in drives:
        day = f"date = {utc_from_gps_ns(drive.start_gps_ns):%Y-%m-%d}"
        folder = f"raw/{run_id(drive.number)}"
        lines += ["", "[[runs]]", f"id = {_text(run_id(drive.number))}"]
        lines += _log(f"{folder}/trajectory.sbet", "sbet", clock=f'{{ system = "gps_week_seconds", {day} }}', crs=crs)
        for head in heads(scene.profilers):
            lines += _log(f"{folder}/{head.name}.parquet", "scans", sensor=head.name)
        if scene.lidar.on:
            clock = f'{{ system = "utc_hour", {day} }}'
            lines += _log(f"{folder}/lidar.pcap", "velodyne_pcap", sensor="lidar", clock=clock)
    for drive in drives:
        one = scene.passes[drive.number]
        lines += ["", "[[passes]]", f"id = {drive.number + 1}", f"run = {_text(run_id(drive.number))}"]
        lines += [f'lane = "{one.lane}"', f"direction = {_text(one.direction)}"]
    lines += ["", "[[control]]", f"path = {_text(CONTROL_FILE)}", f"crs = {_text(scene.map.crs)}"]
    lines += ['height = "ellipsoidal"', ""]
    file.write_text("\n".join(lines), encoding="utf-8")


def write_rig(scene: Scene, file: Path) -> None:
    """Write ``RIG.toml``: the sensors with their mountings."""
    lines = ['name = "simulated rig"']
    for head in heads(scene.profilers):
        lines += _sensor(head.name, "profiler", "laser-triangulation head", "frd", head.mount, _profiler_limits(head))
    if scene.lidar.on:
        limits = (RANGE_MIN_M, scene.lidar.range_max_m + 1.0)
        lines += _sensor("lidar", "lidar", "Velodyne HDL-32E", "flu", scene.lidar.mount, limits)
    file.write_text("\n".join([*lines, ""]), encoding="utf-8")


def write_control(scene: Scene, surface: Surface, file: Path) -> None:
    """Write control points along both edges of the lanes: every third one is a check point.

    The stated σ is the true one, or a millimetre where the points have no error: no surveyor states zero.
    """
    spacing = scene.control.spacing_m
    stations = np.arange(min(spacing, scene.length_m) / 2, scene.length_m, spacing)
    offset = scene.road.half_width_m - scene.control.inset_m
    places = np.stack(np.meshgrid(stations, [-offset, offset], indexing="ij"), axis=-1).reshape(-1, 2)
    easting, northing, _ = surface.place(places[:, 0], places[:, 1])
    true = np.stack([easting, northing, surface.height_m(easting, northing)], axis=-1)
    sigma = scene.noise.control_m
    stated_sigma = max(sigma, 0.001)
    stated = true + sigma * stream(scene.seed, 0, "control").standard_normal(true.shape)
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        header = "name,code,role,easting_m,northing_m,height_m,sigma_horizontal_m,sigma_height_m"
        rows.writerow(header.split(","))
        for i, enh in enumerate(stated):
            role, letter = ("check", "C") if i % 3 == 2 else ("gcp", "G")
            numbers = [f"{value:.4f}" for value in (*enh, stated_sigma, stated_sigma)]
            rows.writerow([f"{letter}{i + 1:03d}", "PAINT", role, *numbers])


def _log(
    path: str, kind: str, *, sensor: str | None = None, clock: str | None = None, crs: str | None = None
) -> list[str]:
    lines = ["", "[[runs.logs]]", f"path = {_text(path)}", f"format = {_text(kind)}"]
    if sensor is not None:
        lines.append(f"sensor = {_text(sensor)}")
    if clock is not None:
        lines.append(f"clock = {clock}")
    if crs is not None:
        lines.append(f"crs = {crs}")
    return lines


def _sensor(name: str, kind: str, model: str, axes: str, mount: Mount, limits_m: tuple[float, float]) -> list[str]:
    forward, right, down = mount.lever_arm_body_m
    return [
        "",
        f"[sensors.{name}]",
        f"kind = {_text(kind)}",
        f"model = {_text(model)}",
        f"axes = {_text(axes)}",
        f"lever_arm_body_m = [{float(forward)!r}, {float(right)!r}, {float(down)!r}]",
        f"boresight = {{ roll_deg = {mount.roll_deg!r}, pitch_deg = {mount.pitch_deg!r}, "
        f"heading_deg = {mount.heading_deg!r} }}",
        f"range_min_m = {limits_m[0]!r}",
        f"range_max_m = {limits_m[1]!r}",
    ]


def _profiler_limits(head: Head) -> tuple[float, float]:
    settings = head.settings
    return settings.range_offset_m, round(settings.range_offset_m + _LONGEST_RAW * settings.range_step_m, 6)


def _text(value: str) -> str:
    """TOML basic string; JSON's escapes are a part of TOML's."""
    return json.dumps(value, ensure_ascii=False)
