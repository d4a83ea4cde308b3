"""What is killed: the stages of a run, and the commands after it, each from the state in which it is called."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from roadscan.core.survey import Survey
from roadscan.demo.demo import write_height
from roadscan.inventory.of_survey import open_inventory
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate import simulate
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.kills.states import Place, State
from tests.surveys import small_scene

SURVEY: Final = "survey/SURVEY.toml"
RUN: Final = ("run", SURVEY, "--workers", "0")
ON_DASK: Final = ("run", SURVEY, "--workers", "2")
ARCHIVE: Final = "{other}/archive"
"""Folder of the archive: beside the survey, or in the bucket."""
GONE: Final = ("manifest/outputs", "manifest/logs", "tables/footprints", "tiles", "products")
"""What is taken away from a finished store, for a run to make again."""
PICTURES: Final = tuple(f"run-1/camera/{number:06d}.jpg" for number in (0, 1))
_OFTEN: Final = 3.0
"""Weight of a stage alone: it costs least."""
_SELDOM: Final = 0.3
"""Weight of a run from a stage on."""
_RARELY: Final = 0.1
"""Weight of a run that makes most of a store again, or starts workers: it costs ten times as much as a stage."""
_START_S: Final = 12.0
"""Time (s) that a run's workers take to start and do the rest."""
_SECTIONS: Final = """
[condition]

[surface]
method = "cells"
sigma_m = 0.003

[assets]
kinds = ["pole", "sign"]
exports = []
classified = false
bare_earth = false

[colours]

[inventory]
store = "{other}/inventory"
name = "street"
epoch = "2026-spring"
home = "../inventory.gpkg"
"""


@dataclass(frozen=True)
class Step:
    """A command that is killed."""

    name: str
    command: tuple[str, ...]
    before: str
    """Name of the state in which it is called."""
    after: str
    """Name of the state that it leaves."""
    seconds: float
    """Processor time within which it is killed; time where it runs on workers."""
    writes: int
    """Writes within which it is killed, where it runs on no workers."""
    records: str = ""
    """Digest of the records of outputs that it leaves."""
    weight: float = 1.0
    """How often it is drawn."""


@dataclass
class Base:
    """States and steps of a place, kept in a folder."""

    states: dict[str, State]
    steps: list[Step]

    def save(self, file: Path) -> None:
        """Write them."""
        file.write_text(json.dumps({"states": self.states, "steps": [asdict(one) for one in self.steps]}))

    @classmethod
    def load(cls, file: Path) -> Base:
        """Read them."""
        told = json.loads(file.read_text())
        states = {name: {k: (d, t) for k, (d, t) in state.items()} for name, state in told["states"].items()}
        return cls(states, [Step(**(one | {"command": tuple(one["command"])})) for one in told["steps"]])


class Guest:
    """The process in whose forks commands run."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, log: Path) -> None:
        self._process, self._folder, self.log = process, folder, log

    def ask(self, command: tuple[str, ...], **kill: float) -> dict[str, Any]:
        """Run a command, killed or not; what became of it."""
        assert self._process.stdin is not None and self._process.stdout is not None
        told = {"command": command, "folder": str(self._folder), "log": str(self.log), **kill}
        print(json.dumps(told), file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def said(self) -> str:
        """What the last command printed."""
        return self.log.read_text(encoding="utf-8", errors="replace")


@contextmanager
def guest(folder: Path, log: Path) -> Iterator[Guest]:
    """That process, until the block ends."""
    words = [sys.executable, "-m", "tests.kills.guest"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as process:
        try:
            yield Guest(process, folder, log)
        finally:
            assert process.stdin is not None
            process.stdin.close()


def prepare(place: Place, runs: Guest, said: Callable[[str], object]) -> Base:
    """Make a survey and call every command once, undisturbed: the states before and after each."""
    _write_survey(place)
    made = Base({"raw": place.take()}, [])
    before = "raw"
    survey = Survey.load(place.work / SURVEY)
    asked = [stage for stage in stages() if stage.is_asked(survey)]
    costs = []
    for stage in asked:
        command = ("stage", stage.name, SURVEY)
        answer = _checked(runs, command)
        costs.append((stage.name, before, answer["seconds"], answer["writes"]))
        after = f"after {stage.name}"
        made.states[after] = place.take()
        step = Step(f"stage: {stage.name}", command, before, after, answer["seconds"], answer["writes"])
        made.steps.append(replace(step, records=records_of(place), weight=_OFTEN))
        before = after
        said(f"{stage.name}: {answer}")
    answer = _checked(runs, RUN)
    costs.append(("report", before, answer["seconds"], answer["writes"]))
    made.states["run"] = place.take()
    known = records_of(place)
    made.steps += [Step(f"run: {n}", RUN, b, "run", 1.2 * s + 0.2, w + 3, known, _SELDOM) for n, b, s, w in costs]
    made.steps += [
        Step(f"workers: {n}", ON_DASK, b, "run", _START_S + 3 * s, w, known, _RARELY) for n, b, s, w in costs if s > 0.5
    ]
    all_s, all_writes = sum(s for _, _, s, _ in costs), sum(w for *_, w in costs)
    root = f"survey={survey.config.id}/"
    for gone in GONE:
        kept = {name: of for name, of in made.states["run"].items() if f"{root}{gone}/" not in name}
        made.states[f"without {gone}"] = kept
        made.steps.append(Step(f"run: {gone}", RUN, f"without {gone}", "run", all_s, all_writes, known, _RARELY))
    place.put(made.states["run"])
    _prepare_commands(place, runs, made, said)
    return made


def _prepare_commands(place: Place, runs: Guest, made: Base, said: Callable[[str], object]) -> None:
    archive = ARCHIVE.format(other=other_of(place))
    names = [word for one in PICTURES for word in ("--picture", one)]
    publish = ("publish", SURVEY, "--out", "site")
    commands: list[tuple[str, tuple[str, ...], Callable[[Place], None] | None]] = [
        ("inventory publish", ("inventory", "publish", SURVEY), None),
        ("inventory pull", ("inventory", "pull", SURVEY, "--who", "eva", "--why", "seen"), _edit),
        ("inventory publish again", ("inventory", "publish", SURVEY), None),
        ("inventory undo", ("inventory", "undo", "2", "--survey", SURVEY, "--who", "eva"), None),
        ("publish", publish, None),
        ("run with an inventory", RUN, None),
        ("publish again", publish, None),
        ("publish one file", ("publish", SURVEY, "--single", "page.html"), None),
        ("archive", ("archive", SURVEY, "--to", archive), None),
        ("restore", ("archive", SURVEY, "--to", archive, "--restore"), _lose_logs),
        ("clean a product", ("clean", SURVEY, "--product", "geotiff", "--remove"), None),
        ("run after clean", RUN, None),
        ("forget", ("forget", SURVEY, *names, "--why", "asked", "--archive", archive, "--remove"), None),
        ("run after forget", RUN, None),
        ("clean", ("clean", SURVEY, "--remove"), None),
        ("publish after forget", publish, None),
        ("archive again", ("archive", SURVEY, "--to", archive), None),
    ]
    before = place.take()
    for name, command, change in commands:
        if change is not None:
            change(place)
            before = place.take()
        answer = _checked(runs, command)
        said(f"{name}: {answer}: {runs.said().strip().splitlines()[-1:]}")
        made.states[f"before {name}"], made.states[f"after {name}"] = before, place.take()
        made.steps.append(
            Step(
                name, command, f"before {name}", f"after {name}", answer["seconds"], answer["writes"], records_of(place)
            )
        )
        before = made.states[f"after {name}"]


def _checked(runs: Guest, command: tuple[str, ...]) -> dict[str, Any]:
    answer = runs.ask(command)
    if answer["ended"] != "0":
        raise AssertionError(f"{' '.join(command)}, undisturbed: {answer}: {runs.said()}")
    return answer


def other_of(place: Place) -> str:
    """What lies beside the store, as the survey file names it."""
    return ".." if place.fs is None else "s3://roads"


def store_of(place: Place) -> Store:
    """The survey's store."""
    survey = Survey.load(place.work / SURVEY)
    url = str(place.work / "survey/store") if place.fs is None else "s3://roads/kills"
    return Store(url, survey.config.id)


def records_of(place: Place) -> str:
    """Digest of all records of outputs, whatever file each stands in."""
    return bytes_digest(repr(sorted(map(repr, Manifest(store_of(place)).all()))).encode())


def _write_survey(place: Place) -> None:
    place.put({})
    poles = [{"station_m": s, "offset_m": 6.5, "height_m": 3.0, "diameter_m": 0.12} for s in (2.0, 7.0)]
    scene = small_scene(
        length_m=9.0, lidar={"range_max_m": 8.0}, roadside={"poles": poles},
        camera={"on": True, "every_m": 4.0, "width_px": 480, "height_px": 300, "focal_px": 400.0},
    )  # fmt: skip
    made = simulate(scene, place.work / "survey")
    shutil.rmtree(place.work / "survey/truth", ignore_errors=True)
    text = made.survey_file.read_text()
    if place.fs is not None:
        text = f'store = "s3://roads/kills"\n{text}'
    (place.work / SURVEY).write_text(text + _SECTIONS.format(other=other_of(place)))


def _edit(place: Place) -> None:
    """Change the height of a pole in the inventory's home, as a person does in QGIS."""
    inventory = open_inventory(Session.open(place.work / SURVEY))
    write_height(inventory.home.name, str(inventory.assets("pole")["asset_id"].iloc[0]))


def _lose_logs(place: Place) -> None:
    shutil.rmtree(place.work / "survey/raw/run-2")
