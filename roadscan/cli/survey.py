"""What the commands do with a survey file: load it, open its store, run stages of it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from roadscan.cli.summaries import print_summary
from roadscan.cli.terminal import new_reporter

if TYPE_CHECKING:
    from roadscan.run.session import Selection, Session
    from roadscan.store.store import Store


class Where(NamedTuple):
    """Where tasks run."""

    workers: int | None
    """Processes of the embedded cluster; None: one a core, 0: none."""
    scheduler: str | None = None
    """Address of a Dask scheduler that runs elsewhere."""
    dashboard: bool = False
    """Whether the embedded cluster serves Dask's dashboard."""
    events: Path | None = None
    """File of the run's events; the environment may name one, too."""
    metrics: Path | None = None
    """File of the run's figures for Prometheus; the environment may name one, too."""


def run_survey(
    survey_file: Path, names: Collection[str] | None, where: Where, selection: Selection | None = None
) -> Session:
    """The run of the stages of these names (None: of all), when it is done.

    Raises
    ------
    RunError
        at the end, if any unit failed; all others are finished and kept.
    """
    from roadscan.core.stopping import Stopped
    from roadscan.run.engine.compute_on import compute_on
    from roadscan.run.progress import reporting_compilation
    from roadscan.run.session import Session
    from roadscan.run.stage import stages
    from roadscan.run.told import Asked, reported_run
    from roadscan.survey.preflight import preflight
    from roadscan.survey.run import run_stages

    chosen = tuple(one for one in stages() if names is None or {one.name, one.word} & {*names})
    if not any(one.uses_workers for one in chosen):
        where = where._replace(workers=0)
    run, reporter = Session.open(survey_file), new_reporter()
    run.selection, run.reporter = selection, reporter

    def at(address: str) -> None:
        reporter.line(f"dashboard: {address}")

    asked = Asked.of(where.events, where.metrics)
    with reported_run(run, [stage.name for stage in chosen], asked), reporting_compilation(run.reporter):
        preflight(run.survey, run.store, chosen[-1].name, selection).begin(run.reporter.line)
        with compute_on(where.workers, where.scheduler, at if where.dashboard else None) as run.compute:
            try:
                run_stages(run, chosen)
            except Stopped as stop:
                stop.add_note(f"{reporter.where(run.stage)}; the next run goes on from there")
                raise
            finally:
                reporter.close()
    return run


def run_and_sum_up(
    survey_file: Path,
    names: Collection[str] | None,
    where: Where,
    as_json: bool,
    selection: Selection | None = None,
) -> Session:
    """The same, with a summary of the survey printed at the end, also of a run of which some units failed.

    Whether someone else works on the store is asked first, before the stages are imported.
    """
    from roadscan.core.errors import RunError

    store = opened_store(survey_file)
    store.check_free()
    with store.looked():
        try:
            run = run_survey(survey_file, names, where, selection)
        except RunError:
            sum_up(survey_file, as_json)
            raise
        sum_up(survey_file, as_json)
    return run


def sum_up(survey_file: Path, as_json: bool, beside: dict[str, Any] | None = None) -> None:
    """Print the summary of a survey."""
    from roadscan.core.survey import Survey

    print_summary(Survey.load(survey_file), opened_store(survey_file), as_json=as_json, beside=beside)


def opened_store(survey_file: Path) -> Store:
    """The store that a survey file names."""
    from roadscan.core.survey import Survey
    from roadscan.store.store import Store

    loaded = Survey.load(survey_file)
    return Store(loaded.store_url, loaded.config.id)
