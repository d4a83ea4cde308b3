"""Tasks on a Dask cluster whose workers die."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

import roadscan
from roadscan.core.errors import RoadscanError, RunError
from roadscan.run.engine import compute_on
from roadscan.run.engine.compute_on import embedded
from roadscan.run.engine.on_dask import OnDask
from roadscan.run.telling import Listener, Teller, ToldCompute, UnitEnded

DEADLY = 7


@pytest.fixture(scope="module")
def cluster() -> Iterator[OnDask]:
    """Two workers. A cluster that another test started in this process has left its settings in the environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
        with embedded(2) as opened:
            yield opened


@pytest.mark.slow
def test_only_the_task_that_kills_its_worker_is_lost(cluster: OnDask) -> None:
    ended = {done.task: done for done in cluster.map(squared, range(20))}
    assert sorted(ended) == list(range(20))
    error = ended.pop(DEADLY).error
    assert isinstance(error, RoadscanError)
    assert "died" in str(error)
    assert {task: done.result for task, done in ended.items()} == {task: task**2 for task in ended}


@pytest.mark.slow
def test_a_task_is_told_with_the_worker_that_did_it(cluster: OnDask) -> None:
    heard: list[UnitEnded] = []
    listener = Listener()
    listener.hear = lambda event: heard.append(event) if isinstance(event, UnitEnded) else None  # type: ignore[method-assign,assignment]
    told = ToldCompute(cluster, Teller("survey", [listener], print))
    (process,) = (done.result for done in told.map(worker, [0]))
    assert [done.result for done in told.map(squared, [DEADLY])] == [None]
    assert isinstance(next(told.map(inverse, [0])).error, ZeroDivisionError)
    fine, dead, wrong = heard
    assert (fine.outcome, fine.host, fine.process) == ("done", socket.gethostname(), process)
    assert process != os.getpid()
    assert (dead.outcome, dead.host, dead.seconds) == ("failed", None, None) and "died" in dead.reason
    assert wrong.outcome == "failed" and wrong.process not in (None, os.getpid()) and "zero" in wrong.reason


def test_an_error_is_the_tasks_own(cluster: OnDask) -> None:
    (done,) = cluster.map(inverse, [0])
    assert isinstance(done.error, ZeroDivisionError)


@pytest.mark.parametrize(("made", "kind"), [("unsendable", TypeError), ("deadly", RoadscanError)])
def test_a_result_that_cannot_be_sent_is_its_tasks_error(cluster: OnDask, made: str, kind: type[Exception]) -> None:
    ended = {done.task: done for done in cluster.map(result_of, [made, "sound"])}
    assert isinstance(ended[made].error, kind)
    assert ended["sound"].result == "sound"


@pytest.mark.slow
def test_a_scheduler_that_dies_while_it_is_asked_is_named(tmp_path: Path) -> None:
    told = tmp_path / "scheduler.json"
    words = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    words += ["--no-dashboard", "--scheduler-file", str(told)]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as scheduler:
        while not told.exists():
            time.sleep(0.05)
        with Client(scheduler_file=str(told), timeout="2s") as client:
            asked = OnDask(client)
            assert asked.workers == 1
            scheduler.kill()
            with pytest.raises(RunError, match=r"the Dask scheduler tcp://127\.0\.0\.1:\d+ is gone"):
                asked.workers  # noqa: B018 — asking is what is tried


@pytest.mark.slow
def test_workers_that_are_gone_for_good_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compute_on, "_LOST_S", 0.5)
    with embedded(1) as alone:
        dask_cluster = alone._client.cluster
        (nanny,) = dask_cluster.workers.values()
        dask_cluster.sync(nanny.close)
        assert [done.result for done in alone.map(squared, [3])] == [9]


@pytest.mark.slow
def test_a_worker_of_another_version_that_joins_later_does_no_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import roadscan\nroadscan.__version__ = '0.0.7'\n")
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as local,
        Client(local) as client,
    ):
        running = OnDask(client).map(version_of, range(100))
        ended = [next(running)]
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
        local.scale(2)
        client.wait_for_workers(2)
        other = max(local.scheduler.workers.values(), key=lambda worker: worker.name).address
        ended += running
        assert {done.task: done.result for done in ended} == dict.fromkeys(range(100), roadscan.__version__)
        assert f"workers are refused: {other} has roadscan 0.0.7; expected roadscan" in caplog.text
        assert other not in client.nthreads()


def test_workers_keep_their_memory(cluster: OnDask) -> None:
    (done,) = cluster.map(environment, ["MALLOC_TRIM_THRESHOLD_"])
    assert int(done.result or 0) >= 1 << 30
    (done,) = cluster.map(environment, ["OMP_NUM_THREADS"])
    assert done.result == "1"


def version_of(_: int) -> str:
    time.sleep(0.02)
    return roadscan.__version__


def worker(_: int) -> int:
    return os.getpid()


def squared(number: int) -> int:
    if number == DEADLY:
        os._exit(9)
    time.sleep(0.01)
    return number**2


class Deadly:
    def __reduce__(self) -> str:
        os._exit(9)


def result_of(name: str) -> object:
    return {"unsendable": threading.Lock(), "deadly": Deadly()}.get(name, name)


def inverse(number: int) -> float:
    return 1 / number


def environment(name: str) -> str | None:
    return os.environ.get(name)
