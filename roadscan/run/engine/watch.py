"""Watches the workers of a cluster: says which died, of what task, with how much memory; refuses other versions."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from distributed import Client, get_worker
from tornado.ioloop import PeriodicCallback

from roadscan import __version__
from roadscan.core.errors import RoadscanError, RunError

log = logging.getLogger(__name__)

_LOOK_S = 2.0
"""Time between two looks at what the workers say of themselves (s): they say it once in half a second to two."""

WORKERLESS_S = 300.0
"""Time without any worker after which a run with tasks ends (s): workers on a queue need minutes to start."""


@dataclass
class _Heard:
    """What a worker last said of itself."""

    name: str
    at_s: float
    memory_bytes: int
    most_bytes: int
    """Most that it said since it is watched."""
    limit_bytes: int

    def memory(self, now_s: float) -> str:
        """Return its memory in words."""
        limit = f" of {_size(self.limit_bytes)}" if self.limit_bytes else ""
        return (
            f"its memory was {_size(self.memory_bytes)}{limit} {now_s - self.at_s:.0f} s before, "
            f"and {_size(self.most_bytes)} at most"
        )


class Watch:
    """Listens to the workers of a client's cluster, until the client closes."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._heard: dict[str, _Heard] = {}
        self._told: dict[str, str] = {}
        self._workerless_since_s: float | None = None
        self._looks = PeriodicCallback(self._look, _LOOK_S * 1000)
        client.loop.add_callback(self._looks.start)
        client.loop.add_callback(self._look)

    async def _look(self) -> None:
        if self._client.status in ("closing", "closed"):
            self._looks.stop()
            return
        with contextlib.suppress(OSError, AttributeError):  # no connection, or no scheduler at this moment
            self._hear((await self._client.scheduler.identity())["workers"])

    def _hear(self, workers: Mapping[str, Mapping[str, Any]]) -> None:
        now_s = time.monotonic()
        if workers:
            self._workerless_since_s = None
        elif self._workerless_since_s is None:
            self._workerless_since_s = now_s
        for address, said in workers.items():
            memory = int(said["metrics"].get("memory", 0))
            before = self._heard.get(address)
            most = max(memory, before.most_bytes if before else 0)
            self._heard[address] = _Heard(str(said["name"]), now_s, memory, most, int(said["memory_limit"] or 0))

    def check_workers(self) -> None:
        """Check that there has been a worker of late.

        Raises
        ------
        RunError
            where tasks wait, and nobody has been there to do them for :data:`WORKERLESS_S`.
        """
        since_s = self._workerless_since_s
        if since_s is not None and time.monotonic() - since_s > WORKERLESS_S:
            known = ", ".join(self._told.values())
            raise RunError(
                f"no worker has been at the scheduler for {WORKERLESS_S:g} s" + (f" ({known})" if known else ""),
                expected="a worker that does the tasks that wait",
                change="start workers, and run again: what is finished stays",
            )

    def refuse(self, error: OtherVersionError) -> str:
        """Send away a worker that has refused a task, once; return who it is, and why."""
        address = str(error.record)
        if address not in self._told:
            self._told[address] = f"{address} has {error.arrived}"
            refuse(self._client, {address: error.arrived})
        return self._told[address]

    def death(self, worker: Any, key: str, titles: Mapping[str, str]) -> str:
        """Return who died, of what and with how much memory; say it once a worker.

        Parameters
        ----------
        worker : its state as the scheduler last knew it (`KilledWorker.last_worker`).
        key : a task that it held.
        titles : what the tasks are that it may have held.
        """
        if worker.address not in self._told:
            begun = [one for one in worker.executing if one in titles] or [key]
            heard = self._heard.get(worker.address)
            name = "" if worker.name == worker.address else f" ({worker.name})"
            memory = heard.memory(time.monotonic()) if heard else "it had said nothing of its memory"
            said = f"{worker.address}{name}, in {titles[begun[0]]}; {memory}"
            self._told[worker.address] = said
            log.warning("a worker died: %s", said)
        return self._told[worker.address]


def _size(number: int) -> str:
    return f"{number / 2**20:,.0f} MiB"


def title_of(function: Callable[..., Any], task: Any) -> str:
    """Return what a task is, in a few words: its function, and the pieces, tiles or unit that it names."""
    pieces = getattr(task, "pieces", ())
    if pieces:
        more = f" and {len(pieces) - 1} more" if len(pieces) > 1 else ""
        return title_of(task.function, pieces[0]) + more
    tiles = getattr(getattr(task, "block", None), "tiles", ())
    unit = f"{tiles[0]} … {tiles[-1]}" if tiles else getattr(task, "unit", getattr(task, "target", ""))
    return f"{function.__name__} {unit}".strip()


class OtherVersionError(RoadscanError):
    """A task came to a worker with another version of roadscan; `record` is the worker's address."""


def check_version(expected: str) -> None:
    """Check that this worker has the version of the run that sent a task (runs on a worker, before the task is read).

    Raises
    ------
    OtherVersionError
        where it has another.
    """
    if __version__ != expected:
        raise OtherVersionError(f"roadscan {__version__}", expected=f"roadscan {expected}", record=get_worker().address)


def refuse_others(client: Client, scheduler: str) -> None:
    """Send away the workers of an external scheduler that have another version of roadscan.

    Those that join later are found by :func:`check_version` at their first task.

    Raises
    ------
    RunError
        where no worker has this one: then the run is the odd one, and the workers stay.
    """
    found = client.get_versions(packages=["roadscan"])["workers"]
    others = {
        address: f"roadscan {said['packages'].get('roadscan') or 'none'}"
        for address, said in found.items()
        if said["packages"].get("roadscan") != __version__
    }
    if others and len(others) == len(found):
        raise RunError(
            f"the workers at {scheduler} have another version: {_in_words(others)}",
            expected=f"roadscan {__version__}, as this command has",
            change="install the same version in all places, and start the workers again",
        )
    if others:
        refuse(client, others)


def refuse(client: Client, others: Mapping[str, str]) -> None:
    """Send workers away, and say which version each has (by its address)."""
    log.warning("workers are refused: %s; expected roadscan %s, as this command has", _in_words(others), __version__)
    client.retire_workers(list(others), close_workers=True, remove=True)


def _in_words(others: Mapping[str, str]) -> str:
    return "; ".join(f"{address} has {version}" for address, version in others.items())
