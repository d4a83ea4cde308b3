"""Simulates a survey: drives every pass, writes its logs, and the truth beside them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError
from roadscan.core.extras import need
from roadscan.simulate import files, truth
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive, drives_of
from roadscan.simulate.files import CONTROL_FILE, RIG_FILE, SURVEY_FILE, control_marks, write_true_control
from roadscan.simulate.logs import Pass, SimulatedLog
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import Object, objects_of
from roadscan.simulate.truth import TRUTH_FOLDER

_AT_ONCE: Final = 2
"""Logs that are written in parallel by threads: the kernels release the interpreter lock."""


@dataclass(frozen=True)
class SimulatedSurvey:
    """Counts of what was written."""

    folder: Path
    survey_file: Path
    rig_file: Path
    control_file: Path
    truth_folder: Path
    profiles: int
    """Profiles of both heads."""
    readings: int
    """Readings in them."""
    returns: int
    """Returns of the lidar."""
    poses: int
    """Poses of the trajectories."""


def simulate(
    scene: Scene,
    folder: str | Path,
    *,
    write_hits: bool = False,
    progress: Callable[[str], None] | None = None,
    overwrite: bool = False,
) -> SimulatedSurvey:
    """Write the survey of a scene as raw logs. Same scene, same bytes; memory does not grow with its length.

    Parameters
    ----------
    scene : what to simulate.
    folder : where to write ``SURVEY.toml``, ``RIG.toml``, ``control.csv``, ``raw/`` and ``truth/``;
        empty, new, or holding the survey of this very scene.
    write_hits : also write ``truth/hits/<run>/<sensor>.parquet``: where each beam met the surface, exactly (for
        profilers one row a profile, NaN where the beam missed; for the line scanner one row a turn of its mirror; for
        the lidar one row a recorded return).
    progress : called with the name of each log before it is written.
    overwrite : write survey file, rig file and control points anew also where they were edited.

    Raises
    ------
    ConfigError
        where the folder holds something else, one of these files was edited, or the map's CRS cannot be used; where
        the scene has a camera or a bag, and OpenCV or rosbags is not installed.
    """
    if scene.cameras:
        need("cv2", "a simulated camera")
    if scene.bag.on:
        need("rosbags.typesys", "a simulated bag")
    target = Path(folder)
    _prepare(scene, target, overwrite)
    earth = Earth(scene.map.crs)
    surface, ride = Surface(scene), Surface(scene, ride=True)
    drives = drives_of(scene, earth, ride)
    known = truth.Truth(scene, surface, target / truth.TRUTH_FOLDER)
    truth.save_objects(scene, surface, target)
    casts = scene.lidar.on or scene.sick.on or bool(scene.cameras)
    world = World(scene, surface) if casts else None
    things = world.objects if world is not None else objects_of(scene, surface)
    logs = [_pass(known, world, things, drive, target, write_hits).logs() for drive in drives]
    counts: Counter[str] = Counter()
    for drive, listed in zip(drives, logs, strict=True):
        counts.update(_written(files.run_id(drive.number), listed, progress or (lambda _: None)))
    files.write_rig(scene, known.rig_file, nominal=False)
    files.write_clocks(scene, known.clocks_file)
    if scene.cameras or scene.roadside.targets:
        write_true_control(control_marks(scene, surface), known.control_file)
    if scene.cameras:
        files.write_cameras(scene, known.cameras_file)
    with written_for_the_user(target) as new:
        files.write_rig(scene, new / files.RIG_FILE)
        files.write_control(scene, surface, new / files.CONTROL_FILE)
        files.write_survey(scene, earth, surface, logs, new / files.SURVEY_FILE)
    return SimulatedSurvey(
        folder=target,
        survey_file=target / files.SURVEY_FILE,
        rig_file=target / files.RIG_FILE,
        control_file=target / files.CONTROL_FILE,
        truth_folder=target / truth.TRUTH_FOLDER,
        profiles=counts["readings"] // scene.profilers.readings,
        readings=counts["readings"],
        returns=counts["returns"],
        poses=counts["poses"],
    )


def _pass(
    known: truth.Truth, world: World | None, things: list[Object], drive: Drive, folder: Path, write_hits: bool
) -> Pass:
    """Return one pass with its created folders."""
    run = files.run_id(drive.number)
    raw = folder / "raw" / run
    needed = [raw, known.trajectory_file(run).parent]
    needed += [known.camera_file(run, name).parent for name in known.scene.cameras]
    needed += [known.hits_file(run, "").parent] if write_hits else []
    for one in needed:
        one.mkdir(parents=True, exist_ok=True)

    def hits(sensor: str) -> Path | None:
        return known.hits_file(run, sensor) if write_hits else None

    def camera(name: str) -> Path:
        return known.camera_file(run, name)

    return Pass(known.scene, known.surface, world, things, drive, raw, known.trajectory_file(run), camera, hits)


def _written(run: str, logs: list[SimulatedLog], tell: Callable[[str], None]) -> Counter[str]:
    """Write the logs of a pass, two at a time; return the number of records of each content."""

    def write(log: SimulatedLog) -> tuple[str, int]:
        tell(f"{run}/{log.name}")
        return log.content, sum(log.write())

    counts: Counter[str] = Counter()
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for content, records in pool.map(write, logs):
            counts[content] += records
    return counts


def _prepare(scene: Scene, folder: Path, overwrite: bool) -> None:
    """Make the folder; refuse one that contains anything but this scene's survey, or edited files."""
    if folder.exists() and not folder.is_dir():
        raise ConfigError("this is a file", expected="a folder to write the survey into", file=folder)
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / truth.TRUTH_FOLDER / truth.SCENE_FILE).is_file():
            raise ConfigError(
                "the folder is not empty and holds no simulated survey",
                expected="a new or empty folder",
                change="name another folder",
                file=folder,
            )
        if truth.load(folder).scene != scene:
            raise ConfigError(
                "the folder holds the survey of another scene",
                expected="a new or empty folder",
                change="name another folder, or remove this one first",
                file=folder,
            )
        if not overwrite:
            refuse_edited(folder)
    truth.save(scene, folder)


_WRITTEN: Final = "written.json"
"""File in the truth folder with digests of the files as the simulator wrote them."""
_EDITED: Final = (RIG_FILE, CONTROL_FILE, SURVEY_FILE)


def refuse_edited(folder: Path) -> None:
    """Raise :class:`ConfigError` if a user edited a file of the simulated survey in `folder`."""
    record = folder / TRUTH_FOLDER / _WRITTEN
    written = json.loads(record.read_bytes()) if record.is_file() else {}
    arrived = "the file was edited since the simulator wrote it"
    if not written:
        arrived = "nothing tells whether the file was edited: it is not of this version of the simulator"
    for name in _EDITED:
        file = folder / name
        if file.is_file() and _digest(file) not in written.get(name, []):
            raise ConfigError(
                arrived,
                expected="a new or empty folder, or a survey as it was simulated",
                change="name another folder, or add --force to overwrite it",
                file=file,
            )


@contextlib.contextmanager
def written_for_the_user(folder: Path) -> Iterator[Path]:
    """Return a folder for the files; at the end their digests are stored, and they are moved to `folder`.

    If it is interrupted, both the old and the new digests are stored.
    """
    record = folder / TRUTH_FOLDER / _WRITTEN
    with tempfile.TemporaryDirectory(dir=folder / TRUTH_FOLDER) as scratch:
        yield Path(scratch)
        new = {name: Path(scratch) / name for name in _EDITED}
        written = {name: [_digest(file)] for name, file in new.items()}
        old = {name: [_digest(folder / name)] for name in _EDITED if (folder / name).is_file()}
        record.write_text(json.dumps({name: written[name] + old.get(name, []) for name in _EDITED}, indent=1) + "\n")
        for name, file in new.items():
            file.replace(folder / name)
        record.write_text(json.dumps(written, indent=1) + "\n")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
