"""Mistakes that surveys are made with, and what roadscan prints of each: the table of ``docs/troubleshooting.md``.

Each mistake is made in a survey of a few poses and profiles, and the command is run on it. `docs/generate.py` writes
what was printed into the page; ``tests/survey/test_mistakes.py`` holds each to one clear message before any long work.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyproj import datadir

FIRST_GPS_S: Final = 1_461_922_218
"""2026-05-04 09:30:00 UTC."""
_WEEK_S: Final = 604_800

SURVEY: Final = """\
id = "street"
map = { crs = "EPSG:25832" }
rig.sensors.profiler = { kind = "profiler", lever_arm_body_m = [0.0, 0.0, 0.0] }

[[runs]]
id = "monday"

[[runs.logs]]
path = "poses.csv"
crs = "EPSG:25832"
height = "ellipsoidal"
clock = { system = "gps" }
options = { heading = "grid" }

[[runs.logs]]
path = "scans.parquet"
sensor = "profiler"
"""
"""A survey without a mistake."""


@dataclass(frozen=True)
class Mistake:
    """Something wrong with a survey."""

    name: str
    """In words, for the page."""
    remedy: str
    """What to do, for the page."""
    swap: tuple[str, str] = ("", "")
    """Text of the survey file, and what stands there by mistake."""
    make: Callable[[Path], object] = lambda _: None
    """What is done to the survey's folder."""
    command: tuple[str, ...] = ("run", "SURVEY.toml", "--workers", "0")
    denied: str = ""
    """File that must not be read."""


_PROJ_FOLDERS = " or ".join([*datadir.get_data_dir().split(os.pathsep), datadir.get_user_data_dir()])  # type: ignore[attr-defined]
"""Where PROJ keeps grids, as messages name it."""


def write_survey(folder: Path, mistake: Mistake) -> Path:
    """Write a survey with a mistake; returns its file."""
    write_poses(folder / "poses.csv", FIRST_GPS_S)
    write_scans(folder / "scans.parquet", FIRST_GPS_S + 0.2)
    file = folder / "SURVEY.toml"
    old, new = mistake.swap
    if old and old not in SURVEY:
        raise ValueError(f"{mistake.name}: the survey file has no {old}")
    file.write_text(SURVEY.replace(old, new) if old else SURVEY, encoding="utf-8")
    mistake.make(folder)
    return file


def write_poses(path: Path, first_s: float) -> None:
    """A second along a road to the north-east, 20 poses."""
    lines = ["time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"]
    lines += [f"{first_s + k / 20:.3f},{500_000 + k / 4},{5_300_000 + k / 4},102,0,0,45" for k in range(20)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_scans(path: Path, first_s: float, step_ns: int = 10_000_000) -> None:
    """30 profiles of 40 readings within 0.3 s."""
    epochs = np.round(first_s * 1e9).astype(np.int64) + np.arange(30) * step_ns
    ranges = pa.FixedSizeListArray.from_arrays(np.full(30 * 40, 20_000, np.uint16), 40)
    geometry = {"kind": "cartesian", "readings": 40, "first": -2.0, "step": 0.1, "range_step_m": 1e-4}
    rows = pa.table({"epoch_gps_ns": epochs, "range": ranges})
    pq.write_table(rows.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)


def write_sbet(path: Path) -> None:
    """20 poses as SBET: week seconds, degrees of Munich in radians."""
    at = FIRST_GPS_S % _WEEK_S
    records = [[at + k / 20, 0.84, 0.2 + k * 1e-8, 500.0, *[0.0] * 13] for k in range(20)]
    path.write_bytes(b"".join(struct.pack("<17d", *record) for record in records))


def printed(mistake: Mistake, folder: Path) -> tuple[int, str]:
    """Exit code and words of the command on the survey in `folder`, with its paths as the user would see them there."""
    write_survey(folder, mistake)
    with contextlib.chdir(folder), _denied(mistake.denied):
        code, text = run(*mistake.command)
    return code, text.replace(f"{folder.resolve()}{os.sep}", "").replace(_PROJ_FOLDERS, "PROJ's own")


def run(*arguments: str) -> tuple[int, str]:
    """Exit code and standard error of the command line, in this process; lines of progress left out."""
    from roadscan.cli import main

    out, words = io.StringIO(), io.StringIO()
    code: Any = 0
    argv = mock.patch.object(sys, "argv", ["roadscan", *arguments])
    with argv, contextlib.redirect_stdout(out), contextlib.redirect_stderr(words):
        try:
            main()
        except SystemExit as end:
            code = end.code
    text = words.getvalue()
    return int(code or 0), text[text.find("roadscan: ") :].strip() if "roadscan: " in text else text.strip()


@contextlib.contextmanager
def _denied(name: str) -> Iterator[None]:
    """Let nobody read a file; an administrator may read all, so opening it fails in their place."""
    if not name:
        yield
        return
    opened = Path.open

    def refuse(self: Path, *arguments: Any, **options: Any) -> Any:
        if self.name == name:
            raise PermissionError(13, os.strerror(13), str(self))
        return opened(self, *arguments, **options)

    with mock.patch.object(Path, "open", refuse):
        yield


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def _sbet_log(clock: str) -> tuple[str, str]:
    old = SURVEY[SURVEY.index('path = "poses.csv"') : SURVEY.index('\n\n[[runs.logs]]\npath = "scans')]
    return old, f'path = "poses.sbet"\nformat = "sbet"\ncrs = "EPSG:4937"\nclock = {clock}'


def _with_accuracy(name: str) -> tuple[str, str]:
    old, new = _sbet_log('{ system = "gps_week_seconds", week = 2417 }')
    return old, f'{new}\noptions = {{ accuracy = "{name}" }}'


def _late_accuracy(folder: Path) -> None:
    """An SBET, and σ of 1 cm and 1′ an hour later."""
    _sbet(folder)
    at = FIRST_GPS_S % _WEEK_S + 3600
    records = [[at + k / 20, *[0.01] * 6, *[1.0] * 3] for k in range(20)]
    (folder / "accuracy.out").write_bytes(b"".join(struct.pack("<10d", *record) for record in records))


def _map(settings: str) -> tuple[str, str]:
    return 'map = { crs = "EPSG:25832" }', f"map = {{ {settings} }}"


def _clock(settings: str) -> tuple[str, str]:
    return 'clock = { system = "gps" }', f"clock = {{ {settings} }}"


def _section(text: str) -> tuple[str, str]:
    return "[[runs]]", f"{text}\n\n[[runs]]"


def _poses_crs(line: str) -> tuple[str, str]:
    return 'crs = "EPSG:25832"\nheight', f"{line}height"


def _scans_of(first_s: float) -> Callable[[Path], object]:
    return lambda folder: write_scans(folder / "scans.parquet", first_s)


def _sbet(folder: Path) -> None:
    write_sbet(folder / "poses.sbet")


def _other_files(folder: Path) -> None:
    (folder / "store" / "survey=street").mkdir(parents=True)
    (folder / "store" / "survey=street" / "letter.txt").write_text("Dear")


def _folder(folder: Path) -> None:
    (folder / "raw").mkdir()
    (folder / "raw" / "letter.txt").write_text("Dear")


def _append(text: str) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        with (folder / "SURVEY.toml").open("a") as stream:
            stream.write(text)

    return write


_REPROCESS: Final = ("reprocess", "SURVEY.toml", "--tile")
_POSES: Final = SURVEY[SURVEY.index('path = "poses.csv"') : SURVEY.index('[[runs.logs]]\npath = "scans')]

MISTAKES: Final = (
    Mistake("A key is misspelt", "Correct the key.", _poses_crs('csr = "EPSG:25832"\n')),
    Mistake("The survey file is no TOML", "Mend the line that is named.", _clock("system = gps")),
    Mistake("An id holds a blank", "Take another id.", ('id = "street"', 'id = "Main Street"')),
    Mistake("A log is not there", "Correct its path, which counts from the survey file.", ("scans.p", "scan.p")),
    Mistake("A log is empty", "Copy it again.", make=lambda f: (f / "scans.parquet").write_bytes(b"")),
    Mistake("A log is cut off", "Copy it again; its end is missing.", make=lambda f: _cut(f / "scans.parquet")),
    Mistake(
        "A folder stands where a file is expected",
        "Name the file.",
        ('"scans.parquet"', '"raw"\nformat = "scans"'),
        _folder,
    ),
    Mistake("A log must not be read", "Give yourself the right to read it.", denied="scans.parquet"),
    Mistake("The map's CRS does not exist", "Look the code up.", _map('crs = "EPSG:99999"')),
    Mistake("The map's CRS is geographic", "Take the projected CRS of the region.", _map('crs = "EPSG:4326"')),
    Mistake(
        "The map's CRS is that of another continent",
        "Correct `map.crs`, or `crs` of the log.",
        _map('crs = "EPSG:32617"'),
    ),
    Mistake(
        "The map's CRS does not keep lengths",
        "Take the projected CRS of the region; Web Mercator is for looking at maps.",
        _map('crs = "EPSG:3857", max_datum_error_m = 5.0'),
    ),
    Mistake(
        "The kind of a log's heights is not stated",
        "State `height`, of the log or in `[defaults]`; or a CRS of three axes, such as `EPSG:4979`.",
        ('height = "ellipsoidal"\n', ""),
    ),
    Mistake("A log of positions states no CRS", "State it.", _poses_crs("")),
    Mistake(
        "Poses are local, the map is not",
        "State the CRS of the poses, or tie the local frame to the Earth.",
        _poses_crs('crs = "local"\n'),
    ),
    Mistake(
        "PROJ cannot change the datum well enough",
        "State the CRS that the poses were processed in, or accept the error.",
        _map('crs = "EPSG:31467"'),
    ),
    Mistake(
        "The geoid is missing",
        "Put the grid into `map.grids`.",
        _map('crs = "EPSG:25832", height = "orthometric", geoid = "region.tif"'),
    ),
    Mistake("A log states no clock", "State it.", ('clock = { system = "gps" }\n', "")),
    Mistake("The GPS week is missing", "State `week` or `date`.", _sbet_log('{ system = "gps_week_seconds" }'), _sbet),
    Mistake(
        "The week is another one",
        "Correct `week`.",
        _sbet_log('{ system = "gps_week_seconds", week = 2416 }'),
        _sbet,
    ),
    Mistake("A number is none", "State the number.", _clock('system = "gps", offset_s = nan')),
    Mistake("The clock's unit is wrong", "Correct `unit`.", _clock('system = "gps", unit = "ms"')),
    Mistake("GPS time is stated as Unix time", "Correct `system`.", _clock('system = "unix_utc"')),
    Mistake(
        "UTC is stated as GPS time, both counted from 1970: 18 leap seconds",
        "Correct `system`.",
        _clock('system = "unix_gps"'),
        lambda f: write_poses(f / "poses.csv", FIRST_GPS_S + 315_964_800 - 18),
    ),
    Mistake(
        "The readings are of another hour",
        "Correct the clock, or take the log of this run.",
        make=_scans_of(FIRST_GPS_S + 3600.2),
    ),
    Mistake(
        "The readings are of another year",
        "Take the log of this run.",
        make=_scans_of(FIRST_GPS_S - 365 * 86_400 + 5000),
    ),
    Mistake(
        "All profiles carry one stamp",
        "See to what stamps them.",
        make=lambda f: write_scans(f / "scans.parquet", FIRST_GPS_S + 0.2, step_ns=0),
    ),
    Mistake("An SBET is named as its own accuracy", "Name its SMRMSG.", _with_accuracy("poses.sbet"), _sbet),
    Mistake(
        "The accuracy file is of another hour",
        "Name that of the same mission.",
        _with_accuracy("accuracy.out"),
        _late_accuracy,
    ),
    Mistake(
        "A lever arm is stated in millimetres",
        "State it in metres.",
        ("lever_arm_body_m = [0.0, 0.0, 0.0]", "lever_arm_body_m = [-1200.0, 0.0, -1850.0]"),
    ),
    Mistake("A log names a sensor that the rig does not have", "Correct the name.", ('sensor = "p', 'sensor = "q')),
    Mistake("The sensor's kind does not fit its log", "Correct `kind`.", ('kind = "profiler"', 'kind = "camera"')),
    Mistake("A run has no trajectory", "Add it.", (f"[[runs.logs]]\n{_POSES}", "")),
    Mistake(
        "The segmentation has nothing to segment",
        "Correct the sensor's axes, or take the section out.",
        ('kind = "profiler",', 'kind = "profiler", axes = "flu",'),
        _append("\n[segmentation]\n"),
    ),
    Mistake("A product is not known", "Take one of those listed.", _section('[products]\nmake = ["lass"]')),
    Mistake(
        "A product's option is not known",
        "Take one of those listed.",
        _section("[products.options.las]\nspacing = 1.0"),
    ),
    Mistake("The cells do not divide the tile", "Change one of them.", _section("[tiles]\ncell_m = 0.03")),
    Mistake(
        "The store cannot be written",
        "Name a folder of yours as `store`.",
        ('id = "street"', 'id = "street"\nstore = "poses.csv"'),
    ),
    Mistake("The store's folder holds something else", "Name another folder.", make=_other_files),
    Mistake("A tile is misspelt", "Write COLUMN_ROW.", command=(*_REPROCESS, "a5")),
    Mistake("A tile is asked for before there are any", "Run the survey first.", command=(*_REPROCESS, "5_5")),
)


@dataclass(frozen=True)
class Heard:
    """What came of a mistake."""

    code: int
    """Exit code."""
    text: str
    """What was printed at the end."""
    dry_code: int
    """Exit code of a dry run after it."""
    logs: int
    """Logs that were ingested."""
    computed: int
    """Files that were computed from them."""
    seconds: float
    """Time of the processor that it took."""


@functools.cache
def heard(mistake: Mistake) -> Heard:
    """Make a mistake in a folder of its own and run the command."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()
        began = time.process_time()
        code, text = printed(mistake, folder)
        seconds = time.process_time() - began
        with contextlib.chdir(folder), _denied(mistake.denied):
            dry_code, _ = run("run", "SURVEY.toml", "--dry-run")
        store = folder / "store" / "survey=street"
        computed = [file for name in ("tiles", "products", "manifest/outputs") for file in store.glob(f"{name}/**/*")]
        return Heard(code, text, dry_code, len(list(store.glob("manifest/logs/*"))), len(computed), seconds)
