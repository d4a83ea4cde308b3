"""Simulate a survey: drive every pass, write its logs, and the truth beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from roadscan.model.errors import ConfigError
from roadscan.simulate import files, truth
from roadscan.simulate.drive import Drive
from roadscan.simulate.earth import Earth
from roadscan.simulate.lidar import write_lidar
from roadscan.simulate.profiler import heads, write_profiles
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.simulate.trajectory import write_trajectory


@dataclass(frozen=True)
class SimulatedSurvey:
    """What was written."""

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
) -> SimulatedSurvey:
    """Write the survey of a scene as raw logs. Same scene, same bytes; memory does not grow with its length.

    Parameters
    ----------
    scene : what to simulate.
    folder : where to write ``SURVEY.toml``, ``RIG.toml``, ``control.csv``, ``raw/`` and ``truth/``;
        empty, new, or holding the survey of this very scene.
    write_hits : also write ``truth/hits/<run>/<sensor>.parquet``: where each beam met the surface, exactly (for
        profilers one row a profile, NaN where the beam missed; for the lidar one row a recorded return).
    progress : called with the name of each log before it is written.

    Raises
    ------
    ConfigError
        where the folder holds something else, or the map's CRS cannot be used.
    """
    target = Path(folder)
    _prepare(scene, target)
    earth = Earth(scene.map.crs)
    surface, ride = Surface(scene), Surface(scene, ride=True)
    drives = [Drive(scene, number, earth, ride) for number in range(len(scene.passes))]
    tell = progress or (lambda _: None)
    counts = [_write_run(scene, surface, drive, target, write_hits, tell) for drive in drives]
    files.write_rig(scene, target / files.RIG_FILE)
    files.write_control(scene, surface, target / files.CONTROL_FILE)
    files.write_survey(scene, drives, target / files.SURVEY_FILE)
    readings = sum(c.readings for c in counts)
    return SimulatedSurvey(
        folder=target,
        survey_file=target / files.SURVEY_FILE,
        rig_file=target / files.RIG_FILE,
        control_file=target / files.CONTROL_FILE,
        truth_folder=target / truth.TRUTH_FOLDER,
        profiles=readings // scene.profilers.readings,
        readings=readings,
        returns=sum(c.returns for c in counts),
        poses=sum(c.poses for c in counts),
    )


@dataclass(frozen=True)
class _Counts:
    readings: int
    returns: int
    poses: int


def _write_run(
    scene: Scene, surface: Surface, drive: Drive, folder: Path, write_hits: bool, tell: Callable[[str], None]
) -> _Counts:
    """Write the logs of one pass."""
    run = files.run_id(drive.number)
    known = truth.Truth(scene, surface, folder / truth.TRUTH_FOLDER)
    raw = folder / "raw" / run
    for needed in (raw, known.trajectory_file(run).parent, *([known.hits_file(run, "").parent] if write_hits else [])):
        needed.mkdir(parents=True, exist_ok=True)

    def written(name: str, steps: Iterator[int]) -> int:
        tell(f"{run}/{name}")
        return sum(steps)

    def hits(sensor: str) -> Path | None:
        return known.hits_file(run, sensor) if write_hits else None

    name = "trajectory.sbet"
    poses = written(name, write_trajectory(scene, drive, raw / name, known.trajectory_file(run)))
    readings = 0
    for head in heads(scene.profilers):
        name = f"{head.name}.parquet"
        readings += written(name, write_profiles(scene, surface, drive, head, raw / name, hits(head.name)))
    returns = 0
    if scene.lidar.on:
        name = "lidar.pcap"
        returns = written(name, write_lidar(scene, surface, drive, raw / name, hits("lidar")))
    return _Counts(readings, returns, poses)


def _prepare(scene: Scene, folder: Path) -> None:
    """Make the folder, and refuse one that holds anything but this scene's survey."""
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
    truth.save(scene, folder)
