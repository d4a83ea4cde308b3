"""Flow `arrival`: from a folder of raw logs to a published survey."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from prefect import Task, flow, get_run_logger
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.states import Completed

from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.plan import wanted_kinds
from roadscan.core.errors import RoadscanError, RunError, StoreError, may_pass
from roadscan.flows.conduct import end_with_worker
from roadscan.flows.expected import failed
from roadscan.flows.survey import survey
from roadscan.flows.watch import tell
from roadscan.inventory.of_survey import inventory_faults, open_inventory
from roadscan.run.session import Session
from roadscan.site.material import Material
from roadscan.site.site import publish
from roadscan.store.salvage import read_lost
from roadscan.survey.arrival.watched import FleetTemplate, Record, Watched, write_survey
from roadscan.survey.status import verify_store

T = TypeVar("T")

RETRY_AFTER_S = (60.0, 300.0, 900.0, 3600.0)
"""Pauses before a step is tried again (s): a network's break of a minute costs one, a night's upload all four."""
SITE = "site"
"""Folder of the page, beside the survey file."""
_TOLD = 5
"""Most damaged files that an error names."""


class RefusedError(RoadscanError):
    """A folder of which no survey can be made."""


@flow(name="arrival", persist_result=False)
def arrival(
    watched: str,
    fleet: str,
    name: str,
    surveys: str = ".",
    workers: int | None = None,
    scheduler: str | None = None,
    retry_after_s: tuple[float, ...] = RETRY_AFTER_S,
) -> State[Any]:
    """Make a survey of a folder of raw logs, run it, verify its store, publish its page and its inventory.

    A step is tried again where its failure may pass by itself: a place does not answer, a log still changes. A wrong
    setting fails at once. A run that was cancelled or died is resumed by `prefect flow-run retry`; it does what is
    missing.

    Parameters
    ----------
    watched, fleet, surveys : as of the flow `watch`.
    name : the folder, and the survey's id; the survey lies in the folder of this name below `surveys`.
    workers, scheduler : as of the flow `survey`.
    retry_after_s : pauses before a step is tried again (s).

    Returns
    -------
    The survey file.

    Raises
    ------
    RoadscanError
        where a step failed; those before it are done.
    """
    end_with_worker()
    home = Path(surveys) / name

    def step(title: str, work: Callable[[], T]) -> T:
        return retried(title, work, retry_after_s)

    try:
        survey_file = step("admit", lambda: admit(watched, Path(fleet), Path(surveys), name))
        step("run", lambda: run(survey_file, workers, scheduler))
        step("verify", lambda: verify(survey_file))
        if FleetTemplate.load(Path(fleet)).site:
            step("publish", lambda: publish_site(survey_file, home / SITE))
        step("inventory", lambda: publish_inventory(survey_file))
    except RefusedError as error:
        tell("refused", name, reason=str(error))
        return failed(error)
    except RoadscanError as error:
        tell("failed", name, reason=str(error), survey_file=str(home))
        return failed(error)
    except Exception as error:
        tell("failed", name, reason=f"{type(error).__name__}: {error}", survey_file=str(home))
        raise
    tell("published", name, survey_file=str(survey_file))
    return Completed(data={"survey_file": str(survey_file)})


def retried(title: str, work: Callable[[], T], after_s: tuple[float, ...]) -> T:
    """Do a step as a Prefect task, again after each pause as long as its failure may pass by itself."""

    def worth_it(_task: object, _run: object, state: State[Any]) -> bool:
        error = state.data if isinstance(state.data, BaseException) else getattr(state.data, "result", None)
        why = may_pass(error) if isinstance(error, BaseException) else ""
        get_run_logger().warning("%s: %s", title, f"tried again, because {why}" if why else "not tried again")
        return bool(why)

    task: Task[[], T] = Task(
        work,
        name=title,
        task_run_name=title,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=len(after_s),
        retry_delay_seconds=list(after_s),
        retry_condition_fn=worth_it,
    )
    return task()


def admit(watched: str, fleet: Path, surveys: Path, name: str) -> Path:
    """Fetch and check the folder's files, and write the survey file; a folder that is refused is remembered as such."""
    place = Watched(watched, surveys)
    try:
        template = FleetTemplate.load(fleet)
        logs = place.fetch(name, template, surveys / name)
        return write_survey(template, logs, surveys / name, name)
    except RoadscanError as error:
        if may_pass(error):
            raise
        known = place.record(name)
        place.keep(name, Record("refused", known.listing if known else place.listing(name).digest, 0.0, str(error)))
        raise RefusedError(f"{name} is refused: {error}") from error


def run(survey_file: Path, workers: int | None, scheduler: str | None) -> None:
    """Run the survey as a flow run below this one."""
    survey(str(survey_file), workers, scheduler)


def verify(survey_file: Path) -> None:
    """Read every file of the store and of the inventory; StoreError names those that are not whole."""
    session = Session.open(survey_file)
    faults = [*verify_store(session.store, lambda _done, _total: None), *inventory_faults(session.survey)]
    faults += [f"lost: {one.told}" for one in read_lost(session.store) if not one.accepted]
    if faults:
        raise StoreError(
            f"{len(faults):,} files are not whole: {'; '.join(faults[:_TOLD])}",
            change="`roadscan verify` lists all; the next run makes products again, `verify --repair` tables",
        )


def publish_site(survey_file: Path, out: Path) -> None:
    """Publish the survey's page."""
    session = Session.open(survey_file)
    session.hear_of_damage()
    made = publish(Material(session), out)
    if made.failures:
        raise RunError(f"not published: {'; '.join(f'{path}: {why}' for path, why in made.failures[:_TOLD])}")


def publish_inventory(survey_file: Path) -> None:
    """Take in what the run found, and show the inventory in its home, where the survey asks for assets."""
    session = Session.open(survey_file)
    if wanted_kinds(AssetsConfig.of(session.survey)):
        open_inventory(session).publish()
