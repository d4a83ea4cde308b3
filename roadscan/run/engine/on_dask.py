"""Runs tasks on a Dask cluster, and connects to an external scheduler."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import queue
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import dask
from distributed import Client, KilledWorker, get_worker
from distributed.protocol import pickle
from tornado.ioloop import PeriodicCallback

from roadscan import __version__
from roadscan.core.errors import RoadscanError, RunError
from roadscan.core.extras import need
from roadscan.run.engine.compute import Done
from roadscan.store.holders import others_write

log = logging.getLogger(__name__)

_WORKERS_LOOK_S = 2.0
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
        self._looks = PeriodicCallback(self._look, _WORKERS_LOOK_S * 1000)
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


T = TypeVar("T")
R = TypeVar("R")

QUIET_CLIENT = {
    "distributed.admin.low-level-log-length": 50,
    "distributed.admin.large-graph-warning-threshold": "1GB",
}
"""Settings of Dask: its log of messages holds whole tasks, by default the last 1,000 of each worker; and nobody who
runs a survey can change how large a task is."""

_GATEWAY = "gateway:"
"""What an address begins with that names a cluster of dask-gateway."""

_HELD_A_THREAD = 2
"""Least tasks per worker thread that the scheduler holds while there are any …"""

_MORE_HELD = 28
"""… and more in total while many wait, so that one message carries several short tasks."""

_LOST_S = 35.0
"""Time that a lost scheduler has to answer again (s), and between looks whether there are workers: Dask's client tries
for 30 s to reach it."""

_CLIENT_LOOK_S = 0.2
"""Time between looks at a client that connects again (s)."""

_TOGETHER_S = 0.02
"""Seconds for which results wait for others (at most half of them), so that one message requests all."""


class OnDask:
    """Runs tasks on a Dask cluster; a limited number is submitted at a time."""

    def __init__(self, client: Client, workers: int | None = None) -> None:
        """`workers` is how many there are when all are alive, where that is known."""
        self._client, self._workers = client, workers
        self._address = client.scheduler.address
        self._watch = Watch(client)

    @property
    def workers(self) -> int:
        """Threads of all workers, including those that are being restarted."""
        return self._alive() if self._workers is None else self._workers

    def _alive(self) -> int:
        return int(max(1, sum(self._asked(self._client.nthreads).values())))

    def _asked(self, question: Callable[[], R]) -> R:
        """Return the scheduler's answer; it is asked again where the connection breaks meanwhile."""
        until = time.monotonic() + _LOST_S
        while True:
            try:
                return question()
            except OSError:
                self._check_scheduler()
                if time.monotonic() > until:
                    raise
                time.sleep(_CLIENT_LOOK_S)  # the client notices a moment later that it is not connected

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks, most of them in parallel; one is tried once more if its worker, or the scheduler, is lost.

        A worker that has another version does no task, and is lost as well. Tasks that waited at the same worker fail
        with it. So all of them are tried again when the others have ended, on half of the threads and no more than are
        alive, where none waits behind another: what dies there is at fault itself.

        Raises
        ------
        RunError
            The scheduler is gone, or nobody has been there for minutes to do what waits.
        """
        others_write()
        threads = self.workers
        died: list[T] = []
        for done in self._ended(function, tasks, lambda left: _HELD_A_THREAD * threads + min(_MORE_HELD, left // 4)):
            if isinstance(done.error, _LostError):
                died.append(done.task)
            else:
                yield done
        yield from self._ended(function, died, lambda _: max(1, min(threads // 2, self._alive())))

    def send(self, function: Callable[[T], R], tasks: Sequence[T]) -> list[Any]:
        """Submit tasks to the scheduler; return their futures.

        Tasks travel as bytes: the scheduler hands them on without importing or holding what they name.
        """
        keys = [f"{function.__name__}-{uuid.uuid4().hex}" for _ in tasks]
        sent = [pickle.dumps((function, task)) for task in tasks]
        return list(self._client.map(_called, sent, version=__version__, key=keys, pure=False, retries=0))

    def _ended(
        self, function: Callable[[T], R], tasks: Sequence[T], held: Callable[[int], int]
    ) -> Iterator[Done[T, R]]:
        """Yield tasks as they end; `held` returns how many the scheduler should hold for a number of remaining ones."""
        running: dict[str, T] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def hand_out(first: int) -> int:
            left = len(tasks) - first
            chosen = tasks[first : first + max(held(left) - len(running), 0)] if left else []
            if chosen:
                futures = self.send(function, chosen)
                running.update((future.key, task) for future, task in zip(futures, chosen, strict=True))
                for future in futures:
                    future.add_done_callback(ended.put)
            return first + len(chosen)

        handed_out = hand_out(0)
        while running:
            futures = self._taken(ended, len(running) // 2)
            self._check_scheduler()
            own = [running.pop(future.key) for future in futures]
            handed_out = hand_out(handed_out)
            good = {future.key: future for future in futures if future.status == "finished"}
            results = self._asked(functools.partial(self._client.gather, good, errors="skip"))
            batch = {future.key: task for future, task in zip(futures, own, strict=True)}
            for future, task in zip(futures, own, strict=True):
                error = None if future.key in results else self._fault(future, function, running | batch)
                future.release()
                yield Done(task, None if error is not None else pickle.loads(results.pop(future.key)), error)

    def _fault(self, future: Any, function: Callable[[T], R], held: dict[str, T]) -> Exception | None:
        """Return the error of a task, in words where it was lost with its worker or with the scheduler."""
        if future.status != "error":
            return _LostError("the scheduler lost this task", expected="a scheduler that stays", change="run again")
        error: Exception | None = future.exception()
        if isinstance(error, OtherVersionError):
            who = self._watch.refuse(error)
            return _LostError(who, expected=error.expected, change="install the same version in all places")
        if not isinstance(error, KilledWorker):
            return error
        titles = {key: title_of(function, task) for key, task in held.items()}
        death = self._watch.death(error.last_worker, future.key, titles)
        return _LostError(
            f"each worker that began this task died of it, at last {death}",
            expected="a worker that lives",
            change="most often memory is short: give fewer workers (--workers), or smaller tiles ([tiles] size_m)",
        )

    def _check_scheduler(self) -> None:
        """Wait for a scheduler that the client has lost; RunError where it does not come back."""
        until = time.monotonic() + _LOST_S
        while self._client.status == "connecting" and time.monotonic() < until:
            time.sleep(_CLIENT_LOOK_S)
        if self._client.status != "running":
            raise RunError(
                f"the Dask scheduler {self._address} is gone",
                expected="a scheduler that answers until the run ends",
                change="start it and its workers, and run again: what is finished stays",
            )

    def _taken(self, ended: queue.SimpleQueue[Any], wanted: int) -> list[Any]:
        """Return the next futures to end: as many as are wanted, or those of a short time."""
        while True:
            try:
                return _more_of(ended, [ended.get(timeout=_LOST_S)], wanted)
            except queue.Empty:
                self._watch.check_workers()


class _LostError(RoadscanError):
    """A task has no result, because whoever worked at it is gone."""


def _more_of(ended: queue.SimpleQueue[Any], taken: list[Any], wanted: int) -> list[Any]:
    """Return the futures taken, with others that end in a short time."""
    until = time.perf_counter() + _TOGETHER_S
    with contextlib.suppress(queue.Empty):
        while len(taken) < wanted and (left_s := until - time.perf_counter()) > 0:
            taken.append(ended.get(timeout=left_s))
        while True:
            taken.append(ended.get_nowait())
    return taken


def _called(sent: bytes, version: str) -> bytes:
    """Return the serialised result of a function and its task, as :class:`OnDask` sends them (runs on a worker).

    It is made to bytes while the task runs: a result that cannot be is the task's error then, and one whose worker dies
    of it counts as a death. A worker of another version than the run's reads nothing.
    """
    check_version(version)
    function, task = pickle.loads(sent)
    result: bytes = pickle.dumps(function(task))
    _freeze()
    return result


@functools.cache
def _freeze() -> None:
    """Exempt everything loaded for a first task from garbage collection, once per process.

    Else it looks through all of that again and again while records are made.
    """
    gc.collect()
    gc.freeze()


def _client(scheduler: str) -> Client:
    name = scheduler.removeprefix(_GATEWAY)
    if name == scheduler:
        return Client(scheduler, timeout="30s")
    need("dask_gateway", f"--scheduler {scheduler}")
    from dask_gateway import Gateway

    return Gateway().connect(name, shutdown_on_close=False).get_client()


@contextlib.contextmanager
def connected(scheduler: str) -> Iterator[OnDask]:
    """Connect to the cluster of a scheduler (such as ``tls://host:8786``); without workers, tasks wait for one.

    Certificates for TLS come from Dask's configuration (``distributed.comm.tls``). ``gateway:NAME`` is a cluster of
    dask-gateway, whose address and user come from there, too (``gateway.address``, ``gateway.auth``). Workers with
    another version of roadscan are refused.

    Raises
    ------
    RoadscanError
        No scheduler answers, or it does not accept the certificate, or none is stated.
    """
    with dask.config.set(QUIET_CLIENT):
        try:
            client = _client(scheduler)
        except TypeError as error:  # Dask's way to report that it has no certificate
            raise RoadscanError(
                f"the scheduler {scheduler} is reached by TLS, and no certificate is stated",
                expected="distributed.comm.tls in Dask's configuration: ca-file, client.cert and client.key",
                change="state them, as docs/deployment.md shows",
            ) from error
        except (OSError, ValueError) as error:
            raise RoadscanError(
                f"no Dask scheduler answers at {scheduler}",
                expected="tls://host:port or tcp://host:port, as the scheduler was started, or gateway:NAME",
                change=str(error),
            ) from error
        with client:
            refuse_others(client, scheduler)
            yield OnDask(client)
