"""Order of events on the Prefect server, which `PREFECT_SERVER_EVENTS_CAUSAL_ORDERING=roadscan.flows.ordering` names.

Prefect holds an event back until the one that it follows has come, for 15 minutes at most. Its scheduler sends no event
of a run that it plans. So what happened to a run that began within five minutes of being planned was told a quarter of
an hour late, also its death. Here an event waits 10 s.
"""

from __future__ import annotations

from datetime import timedelta

from prefect.server.events.ordering import memory

memory.PRECEDING_EVENT_LOOKBACK = timedelta(seconds=10)  # type: ignore[attr-defined]
# Events of one run come over two connections, the server's own and that of the run's process: a second apart at most.

CausalOrdering = memory.CausalOrdering
"""Prefect's own, by the name under which the server looks for it."""
