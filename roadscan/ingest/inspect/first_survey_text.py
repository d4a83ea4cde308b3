"""Writes a first ``SURVEY.toml`` and ``RIG.toml`` from the logs that were found in a folder.

What the logs say stands there as a setting. What has to be stated and is not known stands there as a question: a
line that begins with ``#?`` and holds the setting with ???? for the unknown. Such a file is valid TOML, and
:func:`roadscan.core.strict.load_toml` refuses it by the first line that is still open.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyproj
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError
from roadscan.core.frames import DIRECTIONS
from roadscan.core.gpstime import NS_PER_S, WEEK_S, iso_from_gps_ns
from roadscan.core.strict import OPEN_QUESTION
from roadscan.core.toml_text import toml, toml_key
from roadscan.ingest.inspect.first_cell_size import cell_lines
from roadscan.ingest.inspect.first_survey import FoundFolder, FoundLog, FoundRun, overlaps
from roadscan.ingest.inspect.inspect import LogReport
from roadscan.ingest.inspect.log_figures import Extent
from roadscan.ingest.inspect.provisional import Need
from roadscan.ingest.reading.format import LogFormat, Part
from roadscan.store.codecs.image_files import tags_in_words

RIG_NAME: Final = "RIG.toml"
_WIDTH: Final = 110  # characters of a comment line
_MOST_UNKNOWN: Final = 200  # unidentified files that are listed
_READS: Final = ("profiler", "lidar", "camera")
_SYSTEMS: Final = (
    "gps (seconds since 1980-01-06), gps_week_seconds (with week or date),",
    "gps_adjusted (LAS: gps − 1e9), unix_utc (POSIX), unix_gps (from 1970, no leap seconds), unix_tai (PTP),",
    "utc_hour (with date), free (with a measured offset_s). unit: s, ms, us or ns.",
)
_TURNED: Final = (*_READS, "imu")
"""Kinds of sensors whose axes have to be stated."""


@dataclass(frozen=True)
class FirstSurvey:
    """The files that were written."""

    survey_file: Path
    rig_file: Path | None
    """None where no log needs a sensor."""
    questions: int
    """Lines in both files that the user has to complete."""
    found: FoundFolder


def refuse_to_overwrite(survey_file: Path) -> None:
    """Raise :class:`ConfigError` if the survey file, or a rig file beside it, already exists."""
    for file in (survey_file, survey_file.parent / RIG_NAME):
        if file.exists():
            raise ConfigError(
                "the file is there already, and is never overwritten",
                change="name another place with --out, or move it away",
                file=file,
            )


def write_first_survey(found: FoundFolder, survey_file: Path) -> FirstSurvey:
    """Write the survey file, and beside it the rig file.

    Raises
    ------
    ConfigError
        if one of them is there already, or if no log was found.
    """
    refuse_to_overwrite(survey_file)
    rig_file = survey_file.parent / RIG_NAME if found.sensors else None
    if not found.runs:
        raise ConfigError(
            "no log that roadscan can read was found",
            expected="logs of the formats that `roadscan formats` lists",
            change="`roadscan inspect FILE` says of a file what it is",
            file=found.folder,
        )
    folder = survey_file.resolve().parent
    folder.mkdir(parents=True, exist_ok=True)
    texts = {survey_file: "\n".join(survey_lines(found, folder)) + "\n"}
    if rig_file is not None:
        texts[rig_file] = "\n".join(_rig(found)) + "\n"
    for file, text in texts.items():
        with file.open("x", encoding="utf-8") as out:
            out.write(text)
    questions = sum(line.startswith(OPEN_QUESTION) for text in texts.values() for line in text.splitlines())
    return FirstSurvey(survey_file, rig_file, questions, found)


# --- the survey file ------------------------------------------------------------------------------


def survey_lines(found: FoundFolder, folder: Path) -> Iterator[str]:
    """Yield the lines of the first survey file that is to lie in `folder`."""
    yield "# A first survey file, written by `roadscan init` from what the logs say."
    yield f"# Lines that begin with {OPEN_QUESTION} wait for you: the logs do not say it, and roadscan does not guess."
    yield f"# Complete each (???? is what is not known), take its {OPEN_QUESTION} away; `roadscan run` names the next."
    yield ""
    yield f"id = {toml(_survey_id(found))}"
    yield 'title = ""'
    if found.sensors:
        yield f"rig = {toml(RIG_NAME)}"
    yield 'store = "store"'
    yield from _map(found)
    yield from cell_lines(found)
    if any(need.key == "clock" for log in found.logs for need in log.report.opened.needs):
        yield ""
        yield "# Time systems of clocks: " + _SYSTEMS[0]
        yield from (f"#   {line}" for line in _SYSTEMS[1:])
    for run in found.runs:
        yield from _run(run, folder)
    for log in found.control:
        yield from _control(log, folder)
    yield from _lines(found, folder)
    yield from _remarks(found, folder)


def _survey_id(found: FoundFolder) -> str:
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in found.folder.name)
    return name.strip("-._")[:64] or "survey"


def _map(found: FoundFolder) -> Iterator[str]:
    yield ""
    yield "[map]"
    logs = [*found.logs, *found.control]
    stated = [log for log in logs if not log.report.opened.needs_key("crs") and _extents(log.report)]
    cloud = next((log for log in stated if _projected(log.report)), None)
    placed = next((log for log in stated if _degrees(log.report) is not None), None)
    guessed = next((log for log in logs if _degrees(log.report) is not None), None)
    if cloud is not None:
        yield f"crs = {toml(str(_projected(cloud.report)))}  # as {cloud.path.name} states for its points"
    elif placed is not None:
        extent = _extents(placed.report)[0]
        yield from _utm_line(placed, extent.frame, is_known=True)
    elif guessed is not None:
        yield from _utm_line(guessed, "EPSG:4979", is_known=False)
    elif any(extent.frame == LOCAL_WORLD for log in stated for extent in _extents(log.report)):
        yield 'local = { name = "local" }  # the poses are in a local frame'
    elif (lidar := found.only_lidar) is not None and not found.control:
        yield _question('local = { name = "local, no position on Earth" }')
        yield from _remark(
            "No log has positions. If there is one that has, add it to the folder, and run `roadscan init` again. If "
            "not, the lidar's sweeps are matched with one another, which makes a local map: it has no position on "
            "Earth, and its errors grow with the way."
        )
        yield ""
        yield "[navigation.odometry]"
        yield _question(f"lidar = {toml(lidar)}")
        yield '# the sensor whose sweeps make the poses; pip install "roadscan[odometry]" brings what does it'
        return
    else:
        yield _question('crs = "????"')
        yield '# The map of the products: a projected CRS ("EPSG:25832"), or, for poses that are not tied to the Earth,'
        yield '# local = { name = "local" } in place of crs.'
    yield '# height = "orthometric"  # and geoid = "…", grids = "…"; ellipsoidal unless it is stated'


def _utm_line(log: FoundLog, frame: str, *, is_known: bool) -> Iterator[str]:
    degrees = _degrees(log.report)
    zone = None if degrees is None else _utm_zone(frame, degrees)
    if zone is None:
        yield _question('crs = "????"')
        yield f"# The map of the products: a projected CRS that holds {log.path.name}."
        return
    code, name = zone
    if is_known:
        yield f"crs = {toml(code)}  # {name}: holds {log.path.name}, whose CRS its file states"
        return
    yield _question(f"crs = {toml(code)}")
    yield f"# {name} would hold {log.path.name} if its positions are in WGS 84, which it does not say."


def _run(run: FoundRun, folder: Path) -> Iterator[str]:
    yield ""
    yield "[[runs]]"
    yield f"id = {toml(run.id)}"
    for log in run.logs:
        yield ""
        yield from _remark(_summary(log.report))
        yield "[[runs.logs]]"
        yield from _log(log, folder)
        yield from _needs(log, run)
        for what, count in list({f.what: f.count for f in log.report.figures.faults}.items())[:3]:
            yield from _remark(f"wrong with it: {count:,} × {what} (roadscan inspect says more)")


def _log(log: FoundLog, folder: Path) -> Iterator[str]:
    yield f"path = {_path(log.path, folder)}"
    others = [name for name in log.inspection.formats if name != log.format.name and log.part is None]
    also = f"  # the content fits {', '.join(others)} too" if others else ""
    yield f"format = {toml(log.format.name)}{also}"
    if log.sensor:
        yield f"sensor = {toml(log.sensor)}"
    for setting, value in {} if log.part is None else log.part.options.items():
        yield f"options.{setting} = {toml(value)}"
    for setting, companion in log.companions.items():
        yield f"options.{setting} = {_path(companion.path, log.path.parent)}"
        yield from _remark(f"{companion.format.title}; it lies beside this log in time: {_summary(companion.report)}")
    if log.format.accompanies:
        mains = " or ".join(log.format.accompanies)
        yield from _remark(
            f"no log of {mains} was found that this one belongs to by its time: it is read by itself alone"
        )


def _needs(log: FoundLog, run: FoundRun) -> Iterator[str]:
    before = ""
    for need in log.needs:
        yield _question(need.line)
        yield from _alternatives(need)
        said = need.reason
        if need.is_generic:
            said = f"its time system is not in the file; {log.format.name}: {log.format.time}"
        if need.reason != before:
            yield from (line for words in (said, _hint(need, log, run)) if words for line in _remark(words))
        before = need.reason


def _alternatives(need: Need) -> Iterator[str]:
    """Yield the alternatives to a question, as comments."""
    for lines in need.alternatives:
        yield "# or, in its place:"
        yield from (f"# {line}" for line in lines)


def _hint(need: Need, log: FoundLog, run: FoundRun) -> str:
    """Return what other logs of the run, or the stamps themselves, suggest for a missing clock."""
    time = log.report.time
    if need.key != "clock" or time is None:
        return ""
    for other in run.logs:
        known = other.report.time
        if known is None or known.assumed is not None:
            continue
        if time.is_past_the_hour:
            return f"{other.path.name} of this run is of {iso_from_gps_ns(known.first_gps_ns)[:10]}"
        if "week" in need.line and overlaps(log.report, other.report):
            week = known.first_gps_ns // (WEEK_S * NS_PER_S)
            return f"week {week} would make it overlap with {other.path.name}, whose time is known"
    stamps = [f"{moment} as {system}" for system, moment in time.would_be().items()]
    return "the first stamp would be " + ", ".join(stamps) if stamps else ""


def _control(log: FoundLog, folder: Path) -> Iterator[str]:
    yield ""
    yield from _remark(_summary(log.report))
    yield "[[control]]"
    yield f"path = {_path(log.path, folder)}"
    yield f"format = {toml(log.format.name)}"
    yield _question('crs = "????"')
    yield '# CRS of its coordinates, such as "EPSG:25832", or "local"; never assumed.'
    yield _question('height = "????"')
    yield '# "ellipsoidal" or "orthometric" (then also geoid = "…"); never assumed.'
    for need in log.needs:
        if need.key not in {"crs", "height"}:
            yield _question(need.line)
            yield from _alternatives(need)
            yield from _remark(need.reason)


def _lines(found: FoundFolder, folder: Path) -> Iterator[str]:
    if found.lines:
        yield ""
        yield "# Vector layers with lines. If one holds the road's centre lines, it can limit the points:"
        yield "# [filters]"
        yield from (f"# centre_line = {_path(path, folder)}" for path in found.lines)


def _remarks(found: FoundFolder, folder: Path) -> Iterator[str]:
    if found.references:
        yield ""
        yield "# Clouds without times of a drive (reference scans). List one in a run only if its points belong there:"
        for log in found.references:
            yield f"# path = {_path(log.path, folder)}, format = {toml(log.format.name)}"
            yield from _remark("  " + "; ".join(need.reason for need in log.report.opened.needs))
    if found.odometries:
        yield ""
        yield "# Poses that begin at an origin of their own are not listed: IMU and GNSS make the trajectory. One whose"
        yield "# frame is the map's, by what its program says, may stand in a run in place of them:"
        for log in found.odometries:
            topic = "" if log.part is None else f", options.topic = {toml(log.part.name)}"
            yield f"# path = {_path(log.path, folder)}, format = {toml(log.format.name)}{topic}"
    if found.settings:
        yield ""
        yield "# Settings files that are there already:"
        yield from (f"# {_path(path, folder)}: {kind.words}" for path, kind in found.settings)
    if found.unknown:
        yield ""
        yield "# Files that were not understood:"
        for path, words in found.unknown[:_MOST_UNKNOWN]:
            yield from _remark(f"{_path(path, folder)}: {words}")
        if len(found.unknown) > _MOST_UNKNOWN:
            yield f"# and {len(found.unknown) - _MOST_UNKNOWN:,} more"


# --- the rig file ---------------------------------------------------------------------------------


_GRADES: Final = (
    'how good it is, since its readings make the trajectory: "mems", "industrial", "tactical", "navigation", or a '
    "table of its data sheet"
)


def _rig(found: FoundFolder) -> Iterator[str]:
    yield "# A first rig file, written by `roadscan init`: the sensors that the logs name."
    yield f"# TO DO: complete each line that begins with {OPEN_QUESTION} and take its {OPEN_QUESTION} away."
    yield "# Lever arms run from the IMU reference point to the sensor's origin, in metres forward, right, down."
    yield ""
    yield 'name = ""'
    for name, log in sorted(found.sensors.items()):
        yield from _sensor(name, log)
        if log.sensor_kind == "imu" and not any(one.is_trajectory for one in found.logs):
            yield _question('imu = "????"')
            yield from _remark(_GRADES)


def _sensor(name: str, log: FoundLog) -> Iterator[str]:
    kind = str(log.sensor_kind)
    header = log.report.header
    yield ""
    yield from _remark(f"wrote {log.path.name} ({log.format.name})")
    yield f"[sensors.{toml_key(name)}]"
    yield f"kind = {toml(kind)}"
    if isinstance(header.get("model"), str):
        yield f"model = {toml(header['model'])}"
    if log.format.vehicle_axes:
        yield from _remark("its readings are in the vehicle's frame already: no axes, no lever arm")
    else:
        yield from _mounting(kind, log)
    if kind in {"profiler", "lidar"}:
        yield from _ranges(log.report)
    if isinstance(header.get("exif"), dict):
        yield from _interior(header["exif"])


def _interior(tags: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a picture's tags state, and the interior orientation that follows, to be confirmed."""
    yield from _remark(f"The EXIF tags of {tags['file']} say: {tags_in_words(tags)}. None of it is used.")
    if "focal_px" in tags:
        width, height = tags["size_px"]
        interior = {
            "width_px": width,
            "height_px": height,
            "focal_px": [tags["focal_px"]] * 2,
            "principal_px": [(width - 1) / 2, (height - 1) / 2],
        }
        yield f"# interior = {toml(interior)}"
        yield from _remark("if they are right: to some per cent, without distortion. `roadscan camera` calibrates.")


def _mounting(kind: str, log: FoundLog) -> Iterator[str]:
    if log.part is not None and log.part.mounting:
        yield from _stated_by_container(log.part, kind)
        return
    if log.part is not None and log.part.unmounted:
        yield from _remark(f"The recording states no mounting of the frame {log.part.frame}: {log.part.unmounted}.")
    known = {} if log.is_assumed else log.report.header.get("mounting", {})
    for key, value in known.items():
        yield f"{key} = {toml(value)}  # as the log says"
    if kind in _TURNED and "axes" not in known:
        yield from _axes(log.format)
    if "lever_arm_body_m" not in known:
        if kind in {*_READS, "gnss"}:
            yield _question("lever_arm_body_m = [????, ????, ????]")
            yield "# measured on the vehicle: forward, right, down (m)"
        else:
            yield "# lever_arm_body_m = [0.0, 0.0, 0.0]  # forward, right, down (m), if it is not the reference point"
    if kind in _READS and "axes" not in known:
        yield _question("boresight = { roll_deg = 0.0, pitch_deg = 0.0, heading_deg = 0.0 }")
        yield "# how far it is turned from those axes, by its mount (a tilted scanner) or a calibration; 0 by neither"


def _stated_by_container(part: Part, kind: str) -> Iterator[str]:
    """Yield the mounting that a container states, as questions: what its frames are on the vehicle it does not say."""
    for key, value in part.mounting.items():
        if key == "lever_arm_body_m" or kind in _TURNED:
            yield _question(f"{key} = {toml(value)}")
    yield from _remark(
        f"the frame {part.frame} as the recording's static transforms place it on the frame {part.parent}: right if "
        f"{part.parent} is x ahead, y left, z up, and its origin is the vehicle's reference point"
    )


def _axes(log_format: LogFormat) -> Iterator[str]:
    """Yield the question of how a sensor's axes point, with instructions and usual answers."""
    usual = log_format.usual_axes
    yield _question(f"axes = {toml(next(iter(usual), '????'))}")
    letters = ", ".join(f"{word[0]}({word[1:]})" for word in DIRECTIONS.values())
    on_sensor = f" On the sensor itself, {log_format.axes_on_sensor}." if log_format.axes_on_sensor else ""
    yield from _remark(f"Where its x, y and z point on the vehicle, a letter each: {letters}.{on_sensor}")
    for axes, case in usual.items():
        words = ", ".join(f"{axis} {DIRECTIONS[letter]}" for axis, letter in zip("xyz", axes, strict=True))
        yield from _remark(f"  {axes} ({words}) if {case}")


def _ranges(report: LogReport) -> Iterator[str]:
    for table in report.figures.tables.values():
        readings = table.readings
        if readings is not None and readings.range_min_m is not None and readings.range_max_m is not None:
            yield f"# range_min_m = 0.0  # leaves out the own vehicle; the log holds {readings.range_min_m:.3f} m"
            yield f"# range_max_m = 100.0  # the log holds up to {readings.range_max_m:.3f} m"


# --- pieces ---------------------------------------------------------------------------------------


def _summary(report: LogReport) -> str:
    rows = ", ".join(f"{t.rows:,} rows of {t.name}" for t in report.figures.tables.values())
    begun = "" if report.complete else " in its beginning"
    time = report.time
    if time is None:
        return rows + begun
    if time.assumed is None:
        return f"{rows}{begun}, {iso_from_gps_ns(time.first_gps_ns)[:19]}Z, {time.duration_s:,.1f} s"
    return f"{rows}{begun}, {time.duration_s:,.1f} s"


def _extents(report: LogReport) -> list[Extent]:
    return [table.extent for table in report.figures.tables.values() if table.extent is not None]


def _degrees(report: LogReport) -> tuple[Float64, Float64] | None:
    """Return longitude and latitude of the south-west and the north-east corner."""
    for extent in _extents(report):
        if extent.degrees_low is not None and extent.degrees_high is not None:
            return extent.degrees_low, extent.degrees_high
    return None


def _projected(report: LogReport) -> str | None:
    """Return the projected CRS of the log's points, where its file states one."""
    frames = [extent.frame for extent in _extents(report) if extent.frame != LOCAL_WORLD]
    return next((frame for frame in frames if crs_from_text(frame).is_projected), None)


def _utm_zone(frame: str, degrees: tuple[Float64, Float64]) -> tuple[str, str] | None:
    """Return code and name of the UTM zone, in the datum of `frame`, that contains the middle of the extent."""
    datum = crs_from_text(frame).geodetic_crs
    middle = (degrees[0] + degrees[1]) / 2
    area = AreaOfInterest(*np.repeat([middle], 2, axis=0).ravel().tolist())
    names = [] if datum is None else [_datum_name(datum)]
    zones = [zone for name in names for zone in query_utm_crs_info(datum_name=name, area_of_interest=area)]
    return (f"{zones[0].auth_name}:{zones[0].code}", zones[0].name) if zones else None


def _datum_name(crs: pyproj.CRS) -> str:
    two_d = crs.to_2d() if not crs.is_geocentric else crs
    return "WGS 84" if "WGS 84" in two_d.name else str(two_d.name).split(" (")[0]


def _question(line: str) -> str:
    return f"{OPEN_QUESTION} {line}"


def _remark(text: str) -> Iterator[str]:
    """Yield comment lines of at most `_WIDTH` characters."""
    line = "#"
    for word in text.split():
        if len(line) + 1 + len(word) > _WIDTH and line != "#":
            yield line
            line = "#  "
        line += " " + word
    yield line


def _path(path: Path, folder: Path) -> str:
    try:
        shown = os.path.relpath(path, folder)
    except ValueError:  # on another drive
        shown = str(path)
    return toml(Path(shown).as_posix())
