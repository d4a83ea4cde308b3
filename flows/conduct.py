"""What all flows share: the stages as tasks of the current flow run, one Prefect task a stage."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

from prefect import Task, get_run_logger
from prefect.cache_policies import NO_CACHE
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import State
from prefect.runtime import flow_run
from prefect.settings import PREFECT_API_URL
from prefect.states import Completed

from roadscan.core.errors import RoadscanError, RunError
from roadscan.core.survey import Survey
from roadscan.flows.expected import failed, failed_stage, log_without_tracebacks
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.progress import LineReporter
from roadscan.run.session import Selection, Session
from roadscan.run.stage import Stage, stages
from roadscan.run.told import Asked, reported_run
from roadscan.store.store import Store
from roadscan.survey.preflight import preflight
from roadscan.survey.run import close_run, run_stage

log_without_tracebacks()

_BY_WORKER = "PREFECT__FLOW_RUN_ID"
"""Variable that Prefect's workers set for the process of a run."""
_LOOK_S = 1.0
"""Time between looks at the worker (s)."""


class FlowReporter(LineReporter):
    """Sends a run's news to the flow run's log; progress at most twice a minute."""

    def __init__(self) -> None:
        super().__init__(every_s=30.0)
        self._logger = get_run_logger()

    def line(self, text: str) -> None:
        """Log one line."""
        self._logger.info(text)


def end_with_worker() -> None:
    """Let this process end soon after the worker that started it, if one did.

    Nobody reads the run's output then. A run whose Dask workers were about to start has waited for them for ever, and
    lived as far as the server could see.
    """
    worker = os.getppid()

    def look() -> None:
        while os.getppid() == worker:
            time.sleep(_LOOK_S)
        os.kill(os.getpid(), signal.SIGKILL)

    if _BY_WORKER in os.environ:
        threading.Thread(target=look, name="roadscan-worker-lives", daemon=True).start()


def run_name() -> str:
    """Name of a flow run: its survey file and that file's folder, such as `city/SURVEY.toml`."""
    return "/".join(Path(flow_run.parameters["survey_file"]).parts[-2:])


def conduct(
    survey_file: str,
    workers: int | None,
    scheduler: str | None,
    selection: Selection | None = None,
    events: str | None = None,
    metrics: str | None = None,
) -> State[Any]:
    """Run all stages; returns the flow run's final state.

    An error that the user can mend makes the run Failed with the error's own words; any other keeps its traceback.
    """
    end_with_worker()
    try:
        survey = Survey.load(survey_file)
        store = Store(survey.store_url, survey.config.id)
        store.check_free()
        run = Session(survey, store, selection=selection, reporter=FlowReporter())
        with reported_run(run, [stage.name for stage in stages()], Asked.of(events, metrics)):
            preflight(survey, store, selection=selection).begin(run.reporter.line)
            with store.lock(), compute_on(workers, scheduler) as run.compute:
                for stage in stages():
                    ended = stage_task(stage, run)()
                    if ended is not None:
                        ended.result()  # raises the error of the stage
                close_run(run, stages())
    except RoadscanError as error:
        return failed(error)
    return Completed(data={"raw_bytes_read": float(run.raw_bytes_read)})


def stage_task(stage: Stage, run: Session) -> Task[[], State[Any] | None]:
    """A stage as a Prefect task; what the stages share stays in this process and is not sent to the API."""

    def step() -> State[Any] | None:
        try:
            run_stage(run, stage)
        except RoadscanError as error:
            return failed_stage(error)
        return None

    return Task(
        step,
        name=stage.name,
        description=stage.title,
        task_run_name=stage.name,
        cache_policy=NO_CACHE,
        persist_result=False,
    )


def require_api() -> None:
    """Check that the Prefect API answers, where one is configured.

    Raises
    ------
    RunError
        where none answers at that address.
    """
    url = PREFECT_API_URL.value()
    if url is None:
        return
    with get_client(sync_client=True) as client:
        fault = client.api_healthcheck()
    if fault is not None:
        raise RunError(
            f"no Prefect API answers at {url} ({fault})",
            change="start its server, or unset PREFECT_API_URL to run without Prefect",
        )
