"""Small simulated surveys, each written and run once for all tests that ask for it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute, Inline
from roadscan.run.session import Reporter, Selection, Session
from roadscan.run.stage import stages
from roadscan.simulate import Scene, simulate
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.drawing import drawn


class Lines(Reporter):
    """Remembers what a run said."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def line(self, text: str) -> None:
        self.lines.append(text)


@dataclass
class Simulated:
    """A simulated survey and its store."""

    survey_file: Path

    def store(self, name: str = "store") -> Store:
        survey = Survey.load(self.survey_file)
        return Store(str(self.survey_file.parent / name), survey.config.id)

    def run(
        self,
        name: str = "store",
        compute: Compute | None = None,
        selection: Selection | None = None,
        **changes: object,
    ) -> Session:
        """Run all stages into the store `name`, with dotted settings changed (``tiles__block_tiles=1``)."""
        survey = changed(Survey.load(self.survey_file), changes)
        run = Session(survey, self.store(name), compute or Inline(), selection, Lines())
        run_stages(run, stages())
        return run

    def copy_to(self, folder: Path) -> Simulated:
        """A copy of the raw logs and of all that the survey file names; without a store."""
        shutil.copytree(self.survey_file.parent, folder, ignore=shutil.ignore_patterns("store*"))
        return Simulated(folder / self.survey_file.name)

    def copy_with_store_to(self, folder: Path) -> Simulated:
        """The same with the store ``store``: as if it had been run there."""
        shutil.copytree(self.survey_file.parent, folder, ignore=shutil.ignore_patterns("store-*"))
        return Simulated(folder / self.survey_file.name)


def changed(survey: Survey, changes: dict[str, object]) -> Survey:
    """The survey with settings changed."""
    values = survey.config.model_dump()
    values["rig"] = survey.rig.model_dump()
    for dotted, value in changes.items():
        *path, last = dotted.split("__")
        place = values
        for part in path:
            place = place[part]
        place[last] = value
    return Survey.parse(values, folder=survey.folder)


def outputs(store: Store) -> dict[str, bytes]:
    """Every product file of a store."""
    paths = [p for top in ("tiles", "products") for p in store.files(top)]
    return {p: store.read_bytes(p) for p in paths}


def small_scene(**changes: object) -> Scene:
    """14 m of the demo's road, coarse, with both kinds of sensors: 15 tiles."""
    scene = Scene.load("demo").changed(
        length_m=14.0, profilers={"spacing_m": 0.1, "readings": 200}, lidar={"range_max_m": 8.0}
    )
    return scene.changed(**changes) if changes else scene


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Two passes of a short road, raw logs only; the poses hold as they were recorded."""
    folder = tmp_path_factory.mktemp("simulated") / "survey"
    survey_file = simulate(small_scene(), folder).survey_file
    with survey_file.open("a") as stream:
        stream.write("\n[adjust]\non = false\n")
    return Simulated(survey_file)


@pytest.fixture(scope="session")
def finished(simulated: Simulated) -> Simulated:
    """The same, run once in this process into the store ``store``."""
    with drawn():
        simulated.run()
    return simulated


@pytest.fixture(scope="session")
def raw_site(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Raw logs of three passes over painted targets, with errors of centimetres in the poses."""
    from tests.adjust.adjusted_site import site

    return Simulated(simulate(site(), tmp_path_factory.mktemp("adjusted") / "survey").survey_file)


@pytest.fixture(scope="session")
def adjusted(raw_site: Simulated) -> Simulated:
    """The same, run whole into the store ``store``."""
    from tests.adjust.adjusted_site import CIRCLES, NO_FILES

    raw_site.run(**CIRCLES, **NO_FILES)
    return raw_site
