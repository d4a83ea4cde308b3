"""Flow `survey`: a whole run, from raw logs to products. One Prefect task a stage."""

from __future__ import annotations

from prefect import Task, flow, get_run_logger
from prefect.cache_policies import NO_CACHE

from roadscan.jobs.compute import compute_on
from roadscan.jobs.selection import Selection
from roadscan.jobs.stages import STAGES, Reporter, Run, Stage, close_run
from roadscan.model.survey import Survey
from roadscan.tables.store import Store


class FlowReporter(Reporter):
    """Sends a run's news to the flow run's log."""

    def __init__(self) -> None:
        self._logger = get_run_logger()
        self._shown: dict[str, int] = {}

    def line(self, text: str) -> None:
        """Log one line."""
        self._logger.info(text)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Log each tenth of a stage."""
        tenth = 10 * done // total if total else 10
        if self._shown.get(stage) != tenth:
            self._shown[stage] = tenth
            self._logger.info(f"{stage}: {done} of {total}")


def run_flow(
    survey_file: str, workers: int | None, scheduler: str | None, selection: Selection | None = None
) -> dict[str, float]:
    """Run all stages as Prefect tasks of the current flow run."""
    loaded = Survey.load(survey_file)
    store = Store(loaded.store_url, loaded.config.id)
    with compute_on(workers, scheduler) as compute, store.lock():
        run = Run(loaded, store, compute, selection, FlowReporter())
        for stage in STAGES:
            stage_task(stage, run)()
        close_run(run)
    return {"raw_bytes_read": float(run.raw_bytes_read)}


def stage_task(stage: Stage, run: Run) -> Task[[], None]:
    """A stage as a Prefect task; what the stages share stays in this process and is not sent to the API."""

    def step() -> None:
        stage.run(run)

    return Task(step, name=stage.name, task_run_name=stage.name, cache_policy=NO_CACHE, persist_result=False)


@flow(name="survey", log_prints=False)
def survey(survey_file: str, workers: int | None = None, scheduler: str | None = None) -> dict[str, float]:
    """Run a survey: ingest → footprints → tiles → products; only what is missing or stale is done.

    Parameters
    ----------
    survey_file : path of the survey file.
    workers : processes of the embedded cluster, 0 for none, None for one a core.
    scheduler : address of a Dask scheduler to use instead.
    """
    return run_flow(survey_file, workers, scheduler)
