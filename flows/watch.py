"""Flow `watch`: starts a flow run for each folder that arrived below a watched folder or bucket."""

from __future__ import annotations

import time
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from prefect import flow, get_run_logger
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import State
from prefect.deployments import run_deployment
from prefect.events import emit_event
from prefect.exceptions import ObjectNotFound
from prefect.states import Completed
from prefect.utilities.hashing import hash_objects

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.flows.expected import failed
from roadscan.survey.arrival.watched import FleetTemplate, Record, Watched

What = Literal["arrived", "refused", "changed", "published", "failed"]


def tell(what: What, survey: str, **payload: Any) -> None:
    """Emit the event `roadscan.survey.WHAT`; its resource is `roadscan.survey.NAME`."""
    resource = {"prefect.resource.id": f"roadscan.survey.{survey}", "prefect.resource.name": survey}
    emit_event(f"roadscan.survey.{what}", resource=resource, payload={"survey": survey, **payload})


@flow(name="watch", persist_result=False)
def watch(watched: str, fleet: str, surveys: str = ".", deployment: str = "arrival/fleet") -> State[Any]:
    """Look at each folder once: start a run for one that is complete, name one that is refused, leave others.

    Parameters
    ----------
    watched : folder or URL of a bucket; each folder in it is a survey's raw logs.
    fleet : the fleet's template, which answers what `roadscan init` asks.
    surveys : folder of surveys, which keeps what is known of each folder.
    deployment : deployment of the flow `arrival` that is started.

    Returns
    -------
    Names of folders by what became of them: `started`, `refused`, `changed`.

    Raises
    ------
    RoadscanError
        where the watched folder does not answer or the template is wrong, and at the end where a folder could not be
        looked at; all others were.
    """
    log = get_run_logger()
    new: dict[str, list[str]] = {"started": [], "refused": [], "changed": []}
    faults: list[RoadscanError] = []
    try:
        place, template = Watched(watched, Path(surveys)), FleetTemplate.load(Path(fleet))
        names = place.names()
        _check_deployed(deployment)
    except RoadscanError as error:
        return failed(error)
    parameters = {"watched": watched, "fleet": fleet, "surveys": surveys}
    for name in names:
        try:
            known = place.record(name)
            found, is_new = place.look(name, template, time.time())
        except RoadscanError as error:
            log.error("%s: %s", name, error)
            faults.append(error)
            continue
        if not is_new:
            continue
        if found.state == "started" and not found.reason:
            _start(deployment, template, name, found, parameters)
            new["started"].append(name)
        elif found.state != "coming":
            what: What = "refused" if found.state == "refused" else "changed"
            log.warning("%s is %s: %s", name, what, found.reason)
            new[what].append(name)
            tell(what, name, reason=found.reason)
        if known != found:
            place.keep(name, found)
    if faults:
        return failed(faults[0])
    return Completed(data=new)


def _start(deployment: str, template: FleetTemplate, name: str, found: Record, parameters: dict[str, str]) -> None:
    """Ask for a run; the server starts no second one for the same files of the same place, whoever asks."""
    parameters = parameters | {"name": name}
    run: Any = run_deployment(
        deployment,
        parameters=parameters,
        flow_run_name=name,
        timeout=0,
        as_subflow=False,
        idempotency_key=hash_objects("roadscan arrival", parameters, found.listing),
        work_queue_name=next((q for pattern, q in template.queues.items() if fnmatchcase(name, pattern)), None),
    )
    get_run_logger().info("%s arrived: flow run %s", name, run.id)
    tell("arrived", name, flow_run=str(run.id))


def _check_deployed(deployment: str) -> None:
    """Raise ConfigError where the server has no such deployment."""
    with get_client(sync_client=True) as client:
        try:
            client.read_deployment_by_name(deployment)
        except ObjectNotFound:
            raise ConfigError(
                f"the server has no deployment {deployment}",
                change="prefect deploy --all --prefect-file deploy/arrival.yaml",
            ) from None
