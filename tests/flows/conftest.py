"""A tiny simulated survey, and a Prefect server of the tests' own."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from prefect.events.worker import EventsWorker
from prefect.logging.handlers import APILogWorker
from prefect.settings import PREFECT_API_URL, PREFECT_HOME, temporary_settings
from prefect.utilities.asyncutils import run_coro_as_sync

from roadscan.simulate import Scene, SimulatedSurvey, simulate
from tests.flows.prefect_server import PrefectApi, running_server

SCENE = Scene(id="city", length_m=20.0, lidar={"on": False}, profilers={"spacing_m": 0.1, "readings": 200})
"""Twenty metres of road, one pass, two profilers, no noise and no lost reading."""


@pytest.fixture(scope="package")
def prefect_api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrefectApi]:
    """The server; flows that run in this process use it too. It ends with these tests: idle, it takes 5 % of a core."""
    folder = tmp_path_factory.mktemp("prefect")
    with running_server(folder) as api, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DO_NOT_TRACK", "1")
        with temporary_settings({PREFECT_API_URL: api.url, PREFECT_HOME: folder}):
            yield api
            run_coro_as_sync(_send_what_waits())


async def _send_what_waits() -> None:
    """Send logs and events before the server ends (as Prefect's own test harness does), or the exit waits for it."""
    for sent in (APILogWorker.instance().drain(), EventsWorker.drain_all()):
        if inspect.isawaitable(sent):
            await sent


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """The raw logs, written once; tests work on copies."""
    return simulate(SCENE, tmp_path_factory.mktemp("simulated") / "city")


@pytest.fixture
def survey_file(simulated: SimulatedSurvey, tmp_path: Path) -> Path:
    """Survey file of a copy that has no store yet: `city/SURVEY.toml`."""
    shutil.copytree(simulated.folder, tmp_path / "city")
    return tmp_path / "city" / simulated.survey_file.name
