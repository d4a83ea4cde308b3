"""What commands cost on simulated stores: a large one in a folder, two in an object store, a fleet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.commands import command
from benchmarks.simulated_store import TinyFiles, simulated_fleet, simulated_survey
from benchmarks.timing import Figure
from roadscan.core.survey import Survey
from roadscan.run.session import Session
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

_STATUS_S, _STATUS_MB = 5.0, 500.0
"""Bars of `roadscan status` on 100,000 tiles: wall time and peak memory."""
_REQUESTS = 100.0
"""Bar of an idle run on 10,000 objects."""
_POSES_PER_S = 200
"""Of the survey in the object store, as a real drive has them."""
_FLEET_KM = 1.0
_SITE_KM = 0.5
"""Of the survey that is published: each tile is drawn in hundreds of pictures."""


def of_folder(folder: Path, km: float) -> Iterator[Figure]:
    """`status` of a store in a folder."""
    file = simulated_survey(folder, "large", 1000 * km)
    store = _ran(file, km)
    tiles = Manifest(store).files()["tile"]
    manifest = sum(store.size(path) or 0 for path in store.files("manifest"))
    yield Figure(f"{km:,.0f} km, {tiles:,} tiles: bytes of the manifest", manifest / 1e6, "MB")
    command("status", file)  # modules are compiled, and the system holds the folders
    done = command("status", file)
    _check(done.code, done.output)
    yield Figure(f"{tiles:,} tiles: status", done.wall_s, "s", _STATUS_S, "bar")
    yield Figure(f"{tiles:,} tiles: status, processor time", done.cpu_s, "s")
    yield Figure(f"{tiles:,} tiles: status, peak memory", done.peak_mb, "MB", _STATUS_MB, "bar")


def of_object_store(folder: Path, km: float) -> Iterator[Figure]:
    """Requests of commands on a store of moto's S3 server, counted there."""
    commands = {"idle run": ("run",), "status": ("status",), "verify": ("verify",)}
    yield from _of_objects(folder, "objects", km, commands)


def of_site(folder: Path) -> Iterator[Figure]:
    """The same of `publish`: a new site, and the same again."""
    publish = ("publish", "--no-clouds", "--out", folder / "published")
    yield from _of_objects(folder, "site", _SITE_KM, {"publish": publish, "publish again": publish})


def _of_objects(folder: Path, name: str, km: float, commands: Mapping[str, tuple[str | Path, ...]]) -> Iterator[Figure]:
    from tests.object_store import served

    with served() as objects:
        file = simulated_survey(folder, name, 1000 * km, f"{objects.url}/roads", _POSES_PER_S)
        objects.requests.clear()
        store = _ran(file, km)
        held = len(store.fs.find(store.root))
        yield Figure(f"{held:,} objects: requests of a first run", len(objects.requests), "")
        for told, (command_name, *options) in commands.items():
            objects.requests.clear()
            done = command(command_name, file, *options)
            _check(done.code, done.output)
            bar = _REQUESTS if told == "idle run" else None
            yield Figure(f"{held:,} objects: requests of {told}", len(objects.requests), "", bar, "bar" if bar else "")
            yield Figure(f"{held:,} objects: {told}, processor time", done.cpu_s, "s")
            yield Figure(f"{held:,} objects: {told}, peak memory", done.peak_mb, "MB")


def of_fleet(folder: Path, surveys: int) -> Iterator[Figure]:
    """A catalogue, the same again, and a question to all surveys."""
    place = simulated_fleet(folder, surveys, 1000 * _FLEET_KM)
    asked = ("sql", "--fleet", place, "SELECT count(*) AS n FROM tiles")
    for told, own in (("catalogue", ("fleet", place)), ("catalogue again", ("fleet", place)), ("sql --fleet", asked)):
        done = command(*own)
        _check(done.code, done.output)
        yield Figure(f"fleet of {surveys}: {told}, processor time", done.cpu_s, "s")
        yield Figure(f"fleet of {surveys}: {told}, peak memory", done.peak_mb, "MB")


def _ran(file: Path, km: float) -> Store:
    survey = Survey.load(file)
    store = Store(survey.store_url, survey.config.id)
    run_stages(Session(survey, store, TinyFiles(1000 * km)))
    return store


def _check(code: int, output: str) -> None:
    if code:
        raise RuntimeError(f"a command ended with {code}: {output[-2000:]}")
