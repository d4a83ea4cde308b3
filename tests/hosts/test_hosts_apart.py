"""Scheduler, workers, object store and driver on hosts of their own: the bytes are those of a run alone."""

from __future__ import annotations

import re
import time

import pytest

from roadscan.store.lease import LEASE_S
from tests.hosts.conftest import Cluster, assert_same, contents

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(600)]

RUN_S = 300.0
"""Longest that a run may take: on hosts without faults it takes 30 s, with a slow store two minutes."""


def test_a_run_gives_the_bytes_of_a_run_alone(cluster: Cluster, alone: dict[str, bytes]) -> None:
    store = cluster.fresh("whole")
    assert cluster.run("whole").ended(RUN_S) == 0
    assert_same(contents(store), alone)


@pytest.mark.parametrize(
    ("name", "seconds"), [("one", 10), ("scheduler", 10), ("store", 10), ("driver", 10), ("one", 45), ("driver", 45)]
)
def test_a_link_that_is_cut_changes_nothing(cluster: Cluster, alone: dict[str, bytes], name: str, seconds: int) -> None:
    """After 30 s, Dask takes a connection for lost: then the worker joins anew, or the driver connects again."""
    store = cluster.fresh(f"cut-{name}-{seconds}")
    run = cluster.run(f"cut-{name}-{seconds}")
    run.wait_for("footprints: 0 of")
    with cluster.cut(name):
        time.sleep(seconds)
    assert run.ended(RUN_S) == 0, run.said()
    assert_same(contents(store), alone)


@pytest.mark.parametrize("name", ["one", "scheduler", "store"])
def test_slow_links_that_lose_packets_change_nothing(cluster: Cluster, alone: dict[str, bytes], name: str) -> None:
    store = cluster.fresh(f"slow-{name}")
    link = cluster.link(name)
    link.delay_s, link.lost = 0.01, 0.01
    run = cluster.run(f"slow-{name}")
    assert run.ended(RUN_S) == 0, run.said()
    link.delay_s, link.lost = 0.0, 0.0
    assert_same(contents(store), alone)


def test_a_worker_that_is_killed_is_named_with_its_task_and_memory(cluster: Cluster, alone: dict[str, bytes]) -> None:
    store = cluster.fresh("worker")
    run = cluster.run("worker")
    run.wait_for("footprints: 0 of")
    cluster.stop(cluster.workers[0])
    assert run.ended(RUN_S) == 0, run.said()
    assert_same(contents(store), alone)
    (told,) = re.findall(r"a worker died: (.*)", run.said())
    place = re.escape(cluster.workers[0].address)
    assert re.match(rf"tcp://{place}:\d+, in footprint_task \S+.*; its memory was [\d,]+ MiB of [\d,]+ MiB", told), told


def test_a_scheduler_that_is_killed_ends_the_run_in_words(cluster: Cluster, alone: dict[str, bytes]) -> None:
    store = cluster.fresh("scheduler")
    run = cluster.run("scheduler")
    run.wait_for("footprints: 0 of")
    cluster.stop(cluster.scheduler)
    assert run.ended(90.0) != 0
    assert f"the Dask scheduler {cluster.address} is gone" in run.said()
    assert "Traceback" not in run.said()
    cluster.restart()
    assert cluster.run("scheduler-again").ended(RUN_S) == 0
    assert_same(contents(store), alone)


@pytest.mark.parametrize("after", ["read: run-1/lidar", "footprints: 0 of", "tiles: 0 of", "products: 0 of"])
def test_a_driver_that_is_killed_is_followed_by_another(cluster: Cluster, alone: dict[str, bytes], after: str) -> None:
    """The next is refused while the lease of the dead one holds, and goes on when it is over."""
    name = "driver-" + re.sub(r"\W+", "-", after)
    store = cluster.fresh(name)
    run = cluster.run(name)
    run.wait_for(after)
    run.kill()
    free = time.monotonic() + LEASE_S + 1.0
    refused = cluster.run(f"{name}-refused")
    assert refused.ended(30.0) == 2, refused.said()
    assert "process 1 on driver" in refused.said()
    time.sleep(free - time.monotonic())
    again = cluster.run(f"{name}-again")
    assert again.ended(RUN_S) == 0, again.said()
    assert_same(contents(store), alone)


def test_clocks_that_are_off_by_minutes_change_nothing(cluster: Cluster, alone: dict[str, bytes]) -> None:
    """What Python's `time` says is moved: libfaketime slows waits of threads down by a factor of ten and more."""
    store = cluster.fresh("clocks")
    for host, minutes in zip(cluster.workers, (7, -11), strict=True):
        cluster.stop(host)
        cluster.start_worker(host, cluster.moved_clock(host, minutes)).wait_for("Registered to")
    run = cluster.run("clocks", cluster.moved_clock(cluster.driver, 3))
    assert run.ended(RUN_S) == 0, run.said()
    for host in cluster.workers:
        cluster.stop(host)
    assert_same(contents(store), alone)


def test_a_worker_with_another_version_is_refused(cluster: Cluster, alone: dict[str, bytes]) -> None:
    cluster.stop(cluster.scheduler)
    store = cluster.fresh("version")
    other, late = cluster.workers
    cluster.stop(late)
    cluster.give_version(other, "0.0.7")
    run = cluster.run("version-none")
    assert run.ended(RUN_S) != 0
    assert re.search(r"the workers at \S+ have another version: \S+ has roadscan 0\.0\.7", run.said()), run.said()
    assert "expected roadscan" in run.said().replace("expected: ", "expected ")
    cluster.start_worker(late).wait_for("Registered to")
    run = cluster.run("version-one")
    run.wait_for("footprints: 0 of")
    assert re.search(r"workers are refused: \S+ has roadscan 0\.0\.7; expected roadscan", run.said()), run.said()
    cluster.give_version(other, "0.0.8", "later")
    assert run.ended(RUN_S) == 0, run.said()
    assert re.search(r"workers are refused: \S+ has roadscan 0\.0\.8; expected roadscan", run.said()), run.said()
    cluster.stop(other)
    assert_same(contents(store), alone)
