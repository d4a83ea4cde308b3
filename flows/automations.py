"""Installs automations in the Prefect server: ``python -m roadscan.flows.automations FILE --notify BLOCK``.

Where the environment names an address in `ROADSCAN_ALERT_URL`, messages are posted to it, and no block is needed.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import typer
import yaml
from prefect.blocks.notifications import CustomWebhookNotificationBlock
from prefect.client.orchestration import get_client
from prefect.events.schemas.automations import AutomationCore
from prefect.exceptions import ObjectNotFound
from prefect.types import SecretDict

from roadscan.core.errors import ConfigError

_NOTIFY = "NOTIFY"
"""In the file, in place of the id of the block that sends messages: the server gives the id."""


async def install(file: Path, notify: str | None) -> list[str]:
    """Create each automation of the file, or bring the one of its name up to date; return what was done.

    Parameters
    ----------
    notify : block that sends messages, `TYPE/NAME`; without it, automations that need one are left out, and removed
        where they are there already.

    Raises
    ------
    ConfigError
        where the server has no such block.
    """
    asked: list[dict[str, Any]] = yaml.safe_load(file.read_text(encoding="utf-8"))["automations"]
    done = []
    async with get_client() as client:
        if notify is not None:
            kind, _, name = notify.partition("/")
            try:
                block = await client.read_block_document_by_name(name, kind)
            except ObjectNotFound:
                raise ConfigError(f"the server has no block {notify}", expected="TYPE/NAME of a saved block") from None
            asked = json.loads(json.dumps(asked).replace(f'"{_NOTIFY}"', f'"{block.id}"'))
        for one in asked:
            known = await client.read_automations_by_name(one["name"])
            if f'"{_NOTIFY}"' in json.dumps(one):
                for former in known:
                    await client.delete_automation(former.id)
                    done.append(f"removed, since no block sends messages: {one['name']}")
                continue
            wanted = AutomationCore.model_validate(one)
            if known:
                await client.update_automation(known[0].id, wanted)
            else:
                await client.create_automation(wanted)
            done.append(f"installed: {wanted.name}")
    return done


def save_address(url: str) -> str:
    """Save a block that posts messages to an address; return its name. The address, which may be a key, is hidden."""
    block = CustomWebhookNotificationBlock(
        name="roadscan",
        url="{{address}}",
        secrets=SecretDict({"address": url}),
        json_data={"subject": "{{subject}}", "body": "{{body}}"},
        headers=None,
        cookies=None,
    )
    block.save("roadscan", overwrite=True)
    return "custom-webhook/roadscan"


if __name__ == "__main__":
    import asyncio

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--notify", help="block that sends messages, TYPE/NAME")
    arguments = parser.parse_args()
    address = os.environ.get("ROADSCAN_ALERT_URL")
    notify = arguments.notify or (save_address(address) if address else None)
    for line in asyncio.run(install(arguments.file, notify)):
        typer.echo(line)
