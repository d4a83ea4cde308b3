"""deploy/automations.yaml and its settings, judged by Prefect's own matching of events."""

from __future__ import annotations

import asyncio
import json
from datetime import timedelta
from typing import Any
from uuid import uuid4

import pytest
import yaml
from prefect.client.orchestration import get_client
from prefect.server.events.ordering import EventArrivedEarly, get_triggers_causal_ordering
from prefect.server.events.schemas.automations import AutomationCore, EventTrigger
from prefect.server.events.schemas.events import ReceivedEvent
from prefect.settings import PREFECT_SERVER_EVENTS_CAUSAL_ORDERING, temporary_settings
from prefect.types._datetime import now

from roadscan.flows.automations import install, save_address
from tests.conftest import REPOSITORY

DEPLOY = REPOSITORY / "deploy"


def trigger(name: str) -> EventTrigger:
    """The trigger of an automation."""
    block = json.dumps(str(uuid4()))
    asked: list[dict[str, Any]] = yaml.safe_load((DEPLOY / "automations.yaml").read_text())["automations"]
    (one,) = (automation for automation in asked if automation["name"] == name)
    found = AutomationCore.model_validate_json(json.dumps(one).replace('"NOTIFY"', block)).trigger
    assert isinstance(found, EventTrigger)
    return found


def happened(state: str, flow: str, runs: int = 1, *, deployed: bool = True) -> ReceivedEvent:
    """A state change of a flow run, with the labels that the server gives it."""
    related = [{"prefect.resource.id": f"prefect.flow.{uuid4()}", "prefect.resource.role": "flow"}]
    related[0]["prefect.resource.name"] = flow
    if deployed:
        related.append({"prefect.resource.id": f"prefect.deployment.{uuid4()}", "prefect.resource.role": "deployment"})
    resource = {"prefect.resource.id": f"prefect.flow-run.{uuid4()}", "prefect.run-count": str(runs)}
    values = {"event": f"prefect.flow-run.{state}", "resource": resource, "related": related}
    return ReceivedEvent.model_validate({"occurred": now("UTC"), "id": uuid4(), **values})


def test_a_run_whose_process_died_is_started_again_three_times() -> None:
    again = trigger("roadscan crashed runs go on")
    for flow in ("survey", "reprocess", "arrival"):
        assert [runs for runs in range(6) if again.covers(happened("Crashed", flow, runs))] == [1, 2, 3]
    assert not again.covers(happened("Crashed", "watch"))
    assert not again.covers(happened("Crashed", "survey", deployed=False))
    assert again.starts_after("prefect.flow-run.Crashed")
    assert not again.starts_after("prefect.flow-run.Failed")


def test_each_failure_is_told_once() -> None:
    told = {name: trigger(f"roadscan {name}") for name in ("run failed", "look failed", "run crashed")}

    def who(event: ReceivedEvent) -> list[str]:
        return [name for name, one in told.items() if one.covers(event)]

    assert who(happened("Failed", "survey")) == ["run failed"]
    assert who(happened("Failed", "watch")) == ["look failed"]
    assert who(happened("Failed", "arrival")) == []  # the flow's own event says why
    assert who(happened("Failed", "survey", deployed=False)) == []
    assert [who(happened("Crashed", flow)) for flow in ("survey", "arrival", "watch")] == [["run crashed"]] * 3


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_api")
def test_without_an_address_no_automation_sends_messages() -> None:
    """Those that did are removed, and the address of before is not readable."""
    file = DEPLOY / "automations.yaml"
    block = save_address("http://127.0.0.1:9/of-a-pager")
    assert [line.partition(": ")[0] for line in asyncio.run(install(file, block))] == ["installed"] * 9
    with get_client(sync_client=True) as client:
        saved = client.read_block_document_by_name("roadscan", "custom-webhook", include_secrets=False)
        assert "pager" not in str(saved.data)
    said = asyncio.run(install(file, None))
    assert sum(line.startswith("removed, since no block sends messages: ") for line in said) == 5
    with get_client(sync_client=True) as client:
        left = {one.name for one in client.read_automations()}
    assert left == {line.partition(": ")[2] for line in said if line.startswith("installed: ")}


def test_an_event_does_not_wait_long_for_one_that_never_comes() -> None:
    """Prefect's scheduler sends none for the runs that it plans, and the next event of such a run follows it."""

    async def heard(event: ReceivedEvent, depth: int = 0) -> None:
        pass

    async def come_and_wait(waited_s: float) -> None:
        """An event that came some seconds ago is looked at; it has to wait, or the server takes it up."""
        event = happened("Pending", "survey")
        event.follows, event.received = uuid4(), now("UTC") - timedelta(seconds=waited_s)
        with temporary_settings({PREFECT_SERVER_EVENTS_CAUSAL_ORDERING: "roadscan.flows.ordering"}):
            ordering = get_triggers_causal_ordering()
        await ordering.record_follower(event)
        assert [one.id for one in await ordering.get_lost_followers()] == ([event.id] if waited_s > 10 else [])
        async with ordering.preceding_event_confirmed(heard, event):
            pass

    asyncio.run(come_and_wait(10.5))
    with pytest.raises(EventArrivedEarly):
        asyncio.run(come_and_wait(9.5))
