"""Makes the server post a message to ROADSCAN_ALERT_URL for each run that failed or crashed; without a URL, none.

An automation of Prefect and the webhook that it calls; both are replaced where they are there already.
"""

import os

from prefect.automations import Automation
from prefect.blocks.webhook import Webhook
from prefect.events import EventTrigger
from prefect.events.actions import CallWebhook

NAME = "roadscan-run-failed"
MESSAGE = """{
  "run": {{ flow_run.name | tojson }},
  "flow": {{ flow.name | tojson }},
  "state": {{ flow_run.state.name | tojson }},
  "reason": {{ flow_run.state.message | tojson }},
  "address": {{ flow_run | ui_url | tojson }}
}"""


def alert(url: str) -> None:
    """Create the webhook and the automation."""
    block = Webhook(url=url).save(NAME, overwrite=True)
    trigger = EventTrigger(
        expect={"prefect.flow-run.Failed", "prefect.flow-run.Crashed"},
        match={"prefect.resource.id": "prefect.flow-run.*"},
        for_each={"prefect.resource.id"},
        posture="Reactive",
        threshold=1,
    )
    made = Automation(name=NAME, trigger=trigger, actions=[CallWebhook(block_document_id=block, payload=MESSAGE)])
    try:
        before = Automation.read(name=NAME)
    except ValueError:
        made.create()
        return
    before.delete()
    made.create()


if __name__ == "__main__":
    if url := os.environ.get("ROADSCAN_ALERT_URL"):
        alert(url)
